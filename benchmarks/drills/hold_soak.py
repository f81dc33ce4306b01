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
Hold a placement for long: poses are noisy, clocks jump and topics fall silent.

    python -m benchmarks.drills.hold_soak --noise 0.01 --minutes 10

A live rig comes to its final placement; from then on every command has to be that placement.
Writes ``hold_soak.json``: among others ``worst_m``, the farthest that any command was from it, and
``off_m``, the farthest that a camera ended from it on the plane.
"""

import argparse
from pathlib import Path
import sys
import time
from typing import Any

from benchmarks import results
from benchmarks.drills.drill import run_drill
from benchmarks.drills.live_rig import BODY, CAMERAS, episode_in, MAP, OPTICAL, Rig, S
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.demo.watched_nodes import Watch
from ocp_ros.rooms.generator import generate_room
from ocp_ros.ros.interface.conversions import msg_to_positions
from ocp_ros.ros.policy_node import PolicyNode
from rclpy.parameter import Parameter

#: Seconds between messages of the rig, and from one fault to the next.
PERIOD, EVERY = 0.2, 6.0
#: Seconds by which clocks jump, and for which topics are silent.
JUMP, SILENT = 3.0, 4.0
#: What happens, in turn.
FAULTS = ('clock back', 'clock ahead', 'a camera is silent', 'poses are silent')


class Holding:
    """
    A rig and a policy in one process, and what is commanded once the placement is published.

    :param watch: hears the placement, and spins.
    :param noise: standard deviation of the poses that are told, metres.
    :param seed: of the room.
    """

    def __init__(self, watch: Watch, noise: float, seed: int) -> None:
        self.watch = watch
        self.rig = Rig(episode_in(generate_room(seed, 4000)), (BODY, OPTICAL, MAP), PERIOD,
                       context=watch.context)
        self.rig.noise = noise
        self.policy = PolicyNode(context=watch.context, parameter_overrides=[
            Parameter(name, value=value) for name, value in {
                'cloud_topics': ','.join(f'points_{k}' for k in range(CAMERAS)), 'turns': 8,
                'max_step': 2.0, 'voxel_size': 0.01}.items()])
        for node in (self.rig, self.policy):
            watch.executor.add_node(node)
        self.faults = dict.fromkeys(FAULTS, 0)

    def until_placed(self) -> np.ndarray:
        """Play until the placement is published: (K, 3) metres."""
        self.watch.spin_until(lambda: self.watch.node.placement is not None, 300.0, 'placement',
                              [])
        return self.watch.node.placement

    def hold(self, seconds: float) -> list[PoseArray]:
        """Let things go wrong for so long; returns what was commanded meanwhile."""
        first, ends, number = len(self.rig.commands), time.monotonic() + seconds, 0
        while time.monotonic() < ends:
            self.fail(FAULTS[number % len(FAULTS)], number)
            self.spin(EVERY)
            number += 1
        return self.rig.commands[first:]

    def fail(self, fault: str, number: int) -> None:
        """Let one thing go wrong."""
        rig, self.faults[fault] = self.rig, self.faults[fault] + 1
        if fault.startswith('clock'):
            rig.stamp += int(JUMP * S) * (1 if fault == 'clock ahead' else -1)
            return
        if fault == 'poses are silent':
            rig.tells = False
        else:
            rig.silent = {number % CAMERAS}
        self.spin(SILENT)
        rig.tells, rig.silent = True, set()

    def spin(self, seconds: float) -> None:
        """Let the nodes work for a while."""
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            self.watch.executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        """Take the nodes down."""
        for node in (self.policy, self.rig):
            self.watch.executor.remove_node(node)
            node.destroy_node()


def play(options: argparse.Namespace, domain: int, watch: Watch) -> dict[str, Any]:
    """Come to a placement, hold it, and compare."""
    holding = Holding(watch, options.noise, options.seed)
    try:
        placement = holding.until_placed()
        commands = holding.hold(60.0 * options.minutes)
        off = [float(np.linalg.norm(msg_to_positions(one) - placement, axis=1).max())
               for one in commands]
        arrived = np.linalg.norm((holding.rig.positions - placement)[:, :2], axis=1).max()
    finally:
        holding.close()
    faults = [] if commands else ['no command came while the placement was to be held']
    return {'noise_m': options.noise, 'minutes': options.minutes, 'commands': len(commands),
            'worst_m': max(off, default=float('nan')), 'off_m': float(arrived),
            'faults_made': holding.faults, 'faults': faults}


def main(args: list[str] | None = None) -> int:
    """Run the soak."""
    top = argparse.ArgumentParser(prog='hold_soak', description=__doc__,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument('--noise', type=float, default=0.01, help='of poses, metres')
    top.add_argument('--minutes', type=float, default=10.0, help='after the placement')
    top.add_argument('--seed', type=int, default=1, help='of the room')
    top.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    results.add_record(top, 'drills')
    options = top.parse_args(args)
    return run_drill('hold_soak', options, args, play, f'hold_{100.0 * options.noise:g}cm')


if __name__ == '__main__':
    sys.exit(main())
