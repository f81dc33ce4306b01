# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The rooms that planners are compared in: none of them was ever trained on.

Ratios of depth errors mean nothing where four cameras see all there is, so a room is only taken if
the best of a short search leaves at least 5 % of the depth error that placements leave on average.
Running this module chooses the rooms of all sets anew and prints them.
"""

from pathlib import Path
import sys

import numpy as np

from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.planners.registry import OFFLINE
from ocp_ros.planners.scorer import Scorer
from ocp_ros.planners.solve import solve
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.scenes.s3dis import chosen_rooms, s3dis_folder, TEST_AREAS
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_files import READERS, scans_in
from ocp_ros.scenes.scene_source import make_room
from ocp_ros.scenes.splits import SEEDS, TEST
from ocp_ros.scenes.synthetic.generator import generate_room
from ocp_ros.simulation.problem import plane_of
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator

#: Seeds of generated rooms.
TEST_ROOMS = TEST
#: Degrees. The judge's errors depend on them no more: rays are cast at the same mesh.
ROTATIONS = (0,)
#: Points of a room that is chosen.
POINTS = 15000
#: The least share of the mean error, and how much is searched.
LEAST_SHARE, SEARCHED = 0.05, 1000


def difficulty(scene: Scene) -> float:
    """Return the error of the best placement found as a share of the mean random one's."""
    config = SimulationConfig(engine=EngineConfig(preset='fast'))
    simulator, rng = Simulator(scene, config), np.random.default_rng(0)
    space = space_of(simulator)
    score = Scorer(simulator)
    drawn = score([space.placement(space.random(rng)) for _ in range(64)])
    best = solve(OFFLINE['differential_evolution'](space, rng, SEARCHED), score, SEARCHED)
    return best.depth_error / float(drawn.error.mean())


def space_of(simulator: Simulator) -> FreePlane:
    """Return where the cameras of a simulator's rig may be."""
    config = simulator.config
    return plane_of(simulator, config.episode, config.rig.cameras)


def rooms_of_s3dis() -> list[str]:
    """
    Return the test rooms of S3DIS, none where ``S3DIS_DIR`` is not set.

    :raises SceneError: if the folder it names is not that of S3DIS.
    """
    folder = s3dis_folder()
    return [] if folder is None else [str(path.resolve()) for area in TEST_AREAS
                                      for path in chosen_rooms(folder, area)]


def rooms_in(folder: Path, scale: float = 1.0, up: str = 'z') -> list[str]:
    """
    Return the scans of a folder.

    :param scale: metres per unit of the scans.
    :param up: the axis of the scans that points up.
    :raises SceneError: if there are none, or one that cannot be used.
    """
    found = [str(path.resolve()) for path in scans_in(folder)]
    if not found:
        raise SceneError(f'{folder}: found no scans; expected files of {", ".join(READERS)}')
    for path in found:
        try:
            make_room(path, 0.0, POINTS, scale, up)
        except SceneError as error:
            raise SceneError(f'{error}; every scan in {folder} is compared: convert this file '
                             'first, or move it out') from error
    return found


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
