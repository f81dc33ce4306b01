# Copyright 2026 The ocp_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Measure what rotating cameras is worth: the depth error of the final placement in generated rooms.

Episodes are played with what ``policy_node`` decides, without DDS between it and the simulation.
"""

import argparse
from collections.abc import Sequence
import json
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

from benchmarks import results
import numpy as np
from ocp_ros.geometry.cameras import heading_of
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.shipped_models import find_model
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rooms.generator import generate_room
from ocp_ros.ros.interface.conversions import msg_to_poses, positions_to_msg
from ocp_ros.ros.policy.decider import Decider
from ocp_ros.ros.policy.policy_config import PLANNERS, PolicyNodeConfig
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from rclpy.logging import get_logger
from std_msgs.msg import Header

RIG = """
cameras: [{{sensor: {sensor}, count: {cameras}}}]
mount: {{on: plane, height: 1.9}}
pitch: [0, 60]
"""


def played(options: argparse.Namespace, room: int, max_turn: float, rig_file: str
           ) -> dict[str, Any]:
    """
    Play an episode.

    :param room: seed of the room.
    :param max_turn: radians that a camera may rotate in one turn.
    :returns: depth errors at first and in the end, metres, and milliseconds of the processor for
        each turn.
    """
    config = SimulationConfig(
        RigConfig(cameras=options.cameras, sensors=options.sensor, tilt=options.tilt),
        EngineConfig(error_rows=64), EpisodeConfig(turns=options.turns))
    episode = Episode(PlaneProblem(Simulator(generate_room(room, options.points), config)),
                      np.random.default_rng(options.seed))
    asked = PolicyNodeConfig(planner=options.planner, turns=options.turns, max_turn=max_turn,
                             rig_file=rig_file, max_range=config.placed_rig.farthest,
                             seed=options.seed)
    checkpoint = None if asked.needs_no_weights else Checkpoint.load(find_model(asked.model))
    decider, took = Decider(asked, checkpoint, get_logger('aiming')), []
    decider.reset()
    first = episode.turn.depth_error
    while not episode.turn.truncated:
        turn = episode.turn
        poses = positions_to_msg(turn.positions, Header(frame_id='map'), turn.headings)
        began = time.process_time()
        answer = decider.decide(episode.observed_cloud, poses, turn.step)
        took.append(1e3 * (time.process_time() - began))
        found = msg_to_poses(answer)
        episode.move(np.array([pose.position for pose in found])[:, :2] - turn.positions[:, :2],
                     np.array([heading_of(pose.rotation) for pose in found]))
    return {'room': room, 'max_turn': max_turn, 'first': first, 'final': episode.turn.depth_error,
            'cpu_ms_p50': float(np.median(took)), 'cpu_ms_max': max(took)}


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line of JSON for each episode, then the sums."""
    parser = argparse.ArgumentParser(prog='aiming', description=__doc__)
    parser.add_argument('--rooms', type=int, nargs='+', default=[201, 202, 203, 204])
    parser.add_argument('--sensor', default='realsense_d455')
    parser.add_argument('--cameras', type=int, default=4)
    parser.add_argument('--points', type=int, default=12000)
    parser.add_argument('--turns', type=int, default=30)
    parser.add_argument('--tilt', type=float, default=0.5, help='of the cameras at first, radians')
    parser.add_argument('--max-turn', type=float, default=0.5, help='radians')
    parser.add_argument('--planner', default='lookahead', choices=PLANNERS)
    parser.add_argument('--seed', type=int, default=0)
    results.add_record(parser, 'aiming')
    options = parser.parse_args(argv)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        rig = Path(folder) / 'rig.yaml'
        rig.write_text(RIG.format(sensor=options.sensor, cameras=options.cameras))
        for room in options.rooms:
            for max_turn in (0.0, options.max_turn):
                rows.append(played(options, room, max_turn, str(rig)))
                print(json.dumps(rows[-1]), flush=True)
    sums = {f'{max_turn:g}': sum(row['final'] for row in rows if row['max_turn'] == max_turn)
            for max_turn in (0.0, options.max_turn)}
    print(json.dumps({'sum_by_max_turn': sums}))
    if options.record:
        results.write('aiming', {'rooms': rows, 'sum_by_max_turn': sums},
                      results.command_of('aiming', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
