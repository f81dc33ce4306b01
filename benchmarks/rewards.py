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
Compare what two ways of playing an episode earn by either reward.

Straight: the cameras go to a good placement and stay. Back and forth: once there they go back to
where they began in small steps, and return in long ones, again and again.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
import sys

from benchmarks import results
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.online.online_planner import matched
from ocp_ros.rig.motion import towards
from ocp_ros.rooms.generator import generate_room
from ocp_ros.search.registry import PLANNERS
from ocp_ros.search.scorer import Scorer
from ocp_ros.search.solve import solve
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem, space_of
from ocp_ros.simulation.simulation_config import EpisodeConfig, RewardConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator

REWARDS = {'potential': RewardConfig(), 'cubic': RewardConfig('paper', 0.01, 0.2)}


def earned(simulator: Simulator, goal: np.ndarray, seed: int, slow: float | None = None
           ) -> tuple[float, float]:
    """
    Play an episode.

    :param goal: (K, 2) metres, where the cameras go.
    :param slow: metres, the steps in which they go back to where they began, again and again;
        None to stay.
    :returns: the sum of its rewards, and the depth error at its end.
    """
    episode = Episode(PlaneProblem(simulator), np.random.default_rng(seed))
    goal, start = goal[matched(episode.turn.positions, goal)], episode.turn.positions[:, :2]
    total, leaving = 0.0, False
    while not episode.turn.truncated:
        here = episode.turn.positions[:, :2]
        way = np.linalg.norm((start if leaving else goal) - here, axis=1).max()
        if slow is not None and way < 1e-6:
            leaving = not leaving
        # In the last turns everybody goes where it is good.
        left = episode.config.turns - episode.turn.step
        leaving &= left * episode.config.max_step > np.linalg.norm(
            goal - here, axis=1).max() + episode.config.max_step
        target = towards(here, start, slow) if leaving else goal
        total += episode.move(target - here).terms.reward
    return total, episode.turn.depth_error


def main(argv: Sequence[str] | None = None) -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(prog='rewards', description=__doc__)
    parser.add_argument('--rooms', type=int, nargs='+', default=[201, 202, 203, 204])
    parser.add_argument('--turns', type=int, default=120)
    parser.add_argument('--slow', type=float, default=0.05, help='metres of a small step')
    results.add_record(parser, 'rewards')
    options = parser.parse_args(argv)
    config = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=32),
                              episode=EpisodeConfig(turns=options.turns))
    rows = []
    print('| room | reward | straight | back and forth | error at the end (m) |')
    print('|---|---|---|---|---|')
    for room in options.rooms:
        simulator = Simulator(generate_room(room, 12000), config)
        planner = PLANNERS['differential_evolution'].make(
            space_of(simulator), np.random.default_rng(0), 600)
        goal = solve(planner, Scorer(simulator), 600).placement[:, :2]
        for name, reward in REWARDS.items():
            simulator.config = replace(config, reward=reward)
            plain, end = earned(simulator, goal, 0)
            gamed, later = earned(simulator, goal, 0, options.slow)
            print(f'| {room} | {name} | {plain:.2f} | {gamed:.2f} | {end:.2f}, {later:.2f} |')
            rows.append({'room': room, 'reward': name, 'straight': plain, 'back_and_forth': gamed,
                         'error_straight': end, 'error_back_and_forth': later})
    if options.record:
        results.write('rewards', {'rooms': rows}, results.command_of('rewards', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
