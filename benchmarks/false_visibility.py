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
How much of what cameras seem to see is blocked: pairs of a camera and a point.

Rays at the mesh of generated rooms judge candidate poses of a D455, drawn by chance. Three rows:
all views of the engine, those that a scan proves without a word on the scanner's stations, and
with its scans at their stations, as in E57 and PTX files.

    python -m benchmarks.false_visibility --record
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace

from benchmarks import results
import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.geometry.shadow_maps import in_reach
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.generator import generate_room, stations_of
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Scan, Scene
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig

MOUNTS = {'walls': {'on': 'walls'}, 'stands': {'on': 'plane', 'height': 1.6}}
#: Points of a scan, poses of a room and mount, and metres by which a ray is blocked or ends, and
#: within which a scanner measures a point.
POINTS, POSES, BLOCKED_M, REACHED_M, SCANNED_M = 60_000, 20, 0.2, 0.03, 0.01
ROWS = ('all', 'proved', 'proved_known_scans')


def scans_of(seed: int) -> Iterator[Scan]:
    """Yield the scans of a generated room, of other points than those of the benchmark."""
    room = generate_room(seed, 4 * POINTS)
    rays = MeshRays(room.mesh)
    for station in stations_of(seed):
        offsets = room.points - station
        lengths = np.linalg.norm(offsets, axis=1)
        hits = rays.lengths(station, offsets / lengths[:, None])
        yield Scan(station, room.points[hits > lengths - SCANNED_M])


def counts_of(scene: Scene, scans: tuple[Scan, ...], mount: str) -> np.ndarray:
    """
    Count pairs in a room, for each of :data:`ROWS`.

    :returns: (3, 4) seen; blocked by more than 20 cm; seen and visible; visible.
    """
    rig = rig_of(1, 'realsense_d455', mount=MOUNTS[mount])
    problem = Problem.of(scene, rig, SimulationConfig(engine=PROMISING))
    known = Problem.of(replace(scene, scans=scans), rig, problem.simulator.config)
    evidences = [None, *(one.objective.validation.simulator.evidence for one in (problem, known))]
    poses = problem.region.candidates(rig.models[0], 3000)
    rays, order = MeshRays(scene.mesh), problem.simulator.visibility.order
    counts, points = np.zeros((len(ROWS), 4)), scene.points[order]
    for pose in np.random.default_rng(1).permutation(poses)[:POSES]:
        offsets = points - pose[:3].astype(np.float32)
        lengths = np.linalg.norm(offsets, axis=1)
        is_near = in_reach(points, Pose.of(pose), rig.models[0].lens)
        hits = np.full(len(points), np.inf)
        hits[is_near] = rays.lengths(pose[:3], (offsets / lengths[:, None])[is_near])
        is_visible, is_blocked = is_near & (hits > lengths - REACHED_M), hits < lengths - BLOCKED_M
        bits = problem.simulator.look(pose).seen
        for row, evidence in zip(counts, evidences):
            seen = np.unpackbits((bits if evidence is None else evidence.proved(
                bits, pose[:3])).view(np.uint8), bitorder='little')[:len(points)].astype(bool)
            row += [seen.sum(), (seen & is_blocked).sum(), (seen & is_visible).sum(),
                    is_visible.sum()]
    return counts


def rows_of(seeds: list[int]) -> Iterator[dict]:
    """Yield the false visibility and F1 of each room, mount and row."""
    for seed in seeds:
        scene, scans = generate_room(seed, POINTS), tuple(scans_of(seed))
        for mount in MOUNTS:
            for name, (seen, blocked, right, visible) in zip(
                    ROWS, counts_of(scene, scans, mount)):
                yield {'room': seed, 'mount': mount, 'views': name,
                       'blocked': round(float(blocked / seen), 4),
                       'f1': round(float(2.0 * right / (seen + visible)), 4)}


def main(argv: list[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='false_visibility', description=__doc__)
    results.add_rooms(parser)
    results.add_record(parser, 'false_visibility')
    options = parser.parse_args(argv)
    rows = []
    for row in rows_of(results.rooms_of(options)):
        print(row, flush=True)
        rows.append(row)
    means = {name: {key: round(float(np.mean([row[key] for row in rows if row['views'] == name])),
                               4) for key in ('blocked', 'f1')} for name in ROWS}
    print(means)
    if options.record:
        results.write('false_visibility', {'poses': POSES, 'means': means, 'rows': rows},
                      results.command_of('false_visibility', argv))


if __name__ == '__main__':
    main()
