# SPDX-License-Identifier: Apache-2.0
"""
The rooms that planners are compared in: none of them was ever trained on.

Ratios of depth errors mean nothing where four cameras see all there is, so a room is only taken if
the best of a short search is worth at least 5 % of what placements are worth on average. Running
this module chooses the rooms anew and prints them.
"""

from pathlib import Path
import sys

import numpy as np

from ocp_ros.planners.registry import OFFLINE
from ocp_ros.planners.scorer import Scorer
from ocp_ros.planners.solve import solve
from ocp_ros.scenes.cached import load_cached
from ocp_ros.scenes.files import READERS
from ocp_ros.scenes.rooms import generate_room
from ocp_ros.scenes.s3dis import chosen_rooms, s3dis_folder, TEST_AREAS
from ocp_ros.scenes.scene import Scene, SceneError, turned
from ocp_ros.simulation.config import EngineConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.simulation.space import Space

#: Seeds of generated rooms, by ``python -m ocp_ros.benchmark.rooms`` on 2026-11-21.
TEST_ROOMS = (3000, 3001, 3004, 3005, 3007, 3009, 3011, 3016, 3020, 3025)
#: Degrees, as in the paper.
ROTATIONS = (0, 60, 120)
#: Points of a room.
POINTS = 15000
#: The first seed that is looked at, the least share of the mean error, and how much is searched.
FIRST, LEAST_SHARE, SEARCHED = 3000, 0.05, 1000


def difficulty(scene: Scene) -> float:
    """Return the error of the best placement found as a share of the mean random one's."""
    config = SimulationConfig(engine=EngineConfig(preset='fast'))
    simulator, rng = Simulator(scene, config), np.random.default_rng(0)
    space = space_of(simulator)
    score = Scorer(simulator)
    drawn = score([space.placement(space.random(rng)) for _ in range(64)])
    best = solve(OFFLINE['differential_evolution'](space, rng, SEARCHED), score, SEARCHED)
    return best.depth_error / float(drawn.depth_error.mean())


def space_of(simulator: Simulator) -> Space:
    """Return where the cameras of a simulator's rig may be."""
    config = simulator.config
    return Space.of(simulator.scene.points, simulator.height, config.rig.cameras,
                    config.episode.wall_margin)


def make_room(name: str, rotation: float, scale: float = 1.0, up: str = 'z') -> Scene:
    """
    Make one room of a comparison.

    :param name: the seed of a generated room, or the path of a scan.
    :param rotation: degrees about the vertical axis.
    :param scale: metres per unit of a scan.
    :param up: the axis of a scan that points up.
    :raises SceneError: if the scan cannot be used.
    """
    if name.isdecimal():
        scene = generate_room(int(name), POINTS)
    else:
        scene = load_cached(name, max_points=POINTS, scale=scale, up=up)
    return turned(scene, rotation) if rotation else scene


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
    found = sorted(str(path.resolve()) for path in Path(folder).glob('*')
                   if path.suffix.lower() in READERS)
    if not found:
        raise SceneError(f'{folder}: found no scans; expected files of {", ".join(READERS)}')
    for path in found:
        try:
            make_room(path, 0.0, scale, up)
        except SceneError as error:
            raise SceneError(f'{error}; every scan in {folder} is compared: convert this file '
                             'first, or move it out') from error
    return found


def main() -> int:
    """Choose the rooms and print how hard they are."""
    chosen, seed = [], FIRST
    while len(chosen) < 10:
        share = difficulty(generate_room(seed, POINTS))
        if share >= LEAST_SHARE:
            chosen.append(seed)
            print(f'room {seed}: best known {100 * share:.1f} % of random')
        seed += 1
    print(f'{len(chosen)} of {seed - FIRST} rooms: {tuple(chosen)}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
