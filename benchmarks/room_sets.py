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
Choose the generated rooms of all sets, and print them for ``ocp_ros/rooms/room_sets.py``.

Ratios of depth errors mean nothing where four cameras see all there is, so a room is only taken if
the best of a short search leaves at least 5 % of the depth error that placements leave on average.
"""

import sys

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.budget import Budget
from ocp_ros.search.planner import Scorer, solve
from ocp_ros.search.registry import PLANNERS
from ocp_ros.simulation.problem import space_of
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator

#: The first seed of each set that is looked at, and how many rooms it has.
SEEDS = {'training': (1000, 128), 'validation': (500, 36), 'test': (3000, 10),
         'fresh': (4000, 40)}
#: Points of a room that is chosen.
POINTS = 15000
#: The least share of the mean error, and how much is searched.
LEAST_SHARE, SEARCHED = 0.05, 1000


def difficulty(scene: Scene) -> float:
    """Return the error of the best placement found as a share of the mean random one's."""
    config = SimulationConfig(engine=EngineConfig(preset='fast'))
    simulator, rng = Simulator(scene, config), np.random.default_rng(0)
    space = space_of(simulator)

    def evaluate(positions: np.ndarray) -> tuple[float, float]:
        found = simulator.evaluate(space.placement(positions))
        return found.depth_error, found.space_coverage

    score = Scorer(evaluate, Budget(evaluations=64 + SEARCHED))
    drawn = score([space.random(rng) for _ in range(64)])
    best = solve(PLANNERS['differential_evolution'].make(space, rng, SEARCHED), score, SEARCHED)
    return best.error / float(drawn.error.mean())


def main() -> int:
    """Choose the rooms of all sets and print them."""
    for name, (first, count) in SEEDS.items():
        chosen, seed = [], first
        while len(chosen) < count:
            if difficulty(generate_room(seed, POINTS)) >= LEAST_SHARE:
                chosen.append(seed)
            seed += 1
        print(f'{name}: {count} of {seed - first} rooms: {tuple(chosen)}', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
