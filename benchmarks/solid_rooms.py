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
Models of buildings beside the rooms in them: what is read, and what plans are worth.

The test rooms get walls and slabs that are thick, ground outside, and furniture of panels; all of
it solid bodies, as CAD and BIM export them. The truth is the plan of the room and rays at its
surfaces.

    python -m benchmarks.solid_rooms --record
"""

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
import time

from benchmarks import results
from benchmarks.drills.file_fuzz import write_obj
from benchmarks.measure import geometric
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.structure import ceiling_of, floor_height, walls_of
from ocp_ros.rooms.furniture import make_solid, Solid
from ocp_ros.rooms.generator import generate_room, mesh_of, plan_of
from ocp_ros.rooms.room_plan import RoomPlan
from ocp_ros.rooms.room_sets import TEST
from ocp_ros.scenes.meshes import sample_faces
from ocp_ros.scenes.scene import Mesh, Scene
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.search.budget import Budget
from ocp_ros.search.rig_plan import RigPlanner
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from scipy.spatial import cKDTree

#: Metres: walls, slabs and panels, and the ground around the building.
WALL, SLAB, PANEL, GROUND = 0.25, 0.3, 0.018, 8.0
#: Cameras, evaluations of a plan, points of a room and those that tell where its surfaces are.
CAMERAS, EVALUATIONS, POINTS, DENSE = 3, 600, 30_000, 400_000


def solid_mesh(plan: RoomPlan) -> Mesh:
    """Build the room of a plan as solid bodies, with ground around it."""
    x, y, z = plan.size
    shell = [((-WALL, -WALL, -SLAB), (x + WALL, y + WALL, 0)),
             ((-WALL, -WALL, z), (x + WALL, y + WALL, z + SLAB)),
             ((-WALL, -WALL, 0), (0, y + WALL, z)), ((x, -WALL, 0), (x + WALL, y + WALL, z)),
             ((0, -WALL, 0), (x, 0, z)), ((0, y, 0), (x, y + WALL, z)),
             ((-GROUND, -GROUND, -2 * SLAB), (x + GROUND, y + GROUND, -SLAB))]
    bodies = [make_solid('wall', low, high) for low, high in shell]
    bodies += [panel for part in plan.solids for panel in panels_of(part)]
    # The shell of a mesh is a room without walls: only the bodies count.
    whole = mesh_of(replace(plan, solids=bodies))
    return Mesh(whole.vertices[8:], whole.triangles[12:] - 8)


def panels_of(part: Solid) -> list[Solid]:
    """Return the panels of a hollow piece; what is as thin as two of them is one."""
    if min(part.size) <= 2.0 * PANEL:
        return [part]
    turn = rotation_matrix(part.yaw)
    found = []
    for axis in range(3):
        size = part.size.copy()
        size[axis] = PANEL
        for side in (-0.5, 0.5):
            off = np.zeros(3)
            off[axis] = side * (part.size[axis] - PANEL)
            found.append(Solid(part.kind, part.centre + turn @ off, size, part.yaw))
    return found


def room_of(seed: int, folder: Path) -> dict:
    """Return what is measured in a room."""
    plan, path = plan_of(seed), folder / f'{seed}.obj'
    write_obj(path, solid_mesh(plan))
    began = time.monotonic()
    scene = load_scene(path, up='z', max_points=POINTS)
    seconds = time.monotonic() - began
    # The surfaces that the room shows, and what a judge looks at on them.
    inner = sample_faces(mesh_of(plan).corners, DENSE)[:, :3]
    away = cKDTree(inner).query(walls_of(scene).points)[0] - _grain(inner)
    rig = rig_of(CAMERAS, 'd455', mount={'on': 'walls', 'height': [1.5, 2.4]})
    room = generate_room(seed, POINTS)
    judge = Simulator(Scene(room.points, room.name, mesh=room.mesh),
                      SimulationConfig(engine=with_rays(PROMISING, room)), rig.models)
    row = {'room': seed, 'seconds_to_read': seconds,
           'floor': abs(floor_height(scene)),
           'ceiling': abs(float(np.median(ceiling_of(scene).points[:, 2]) - plan.size[2])),
           'walls': float(np.quantile(np.maximum(away, 0.0), 0.99))}
    for preset in ('mesh', 'fine'):
        engine = replace(PROMISING, preset=preset)
        planner = RigPlanner(scene, rig, engine, Budget(evaluations=EVALUATIONS))
        poses = planner.plan(rig).answer.poses
        simulator = planner.problem(rig).simulator
        began = time.perf_counter()
        views = [simulator.look(pose, camera) for camera, pose in enumerate(poses)]
        row[f'ms_{preset}'] = 1000.0 * (time.perf_counter() - began) / len(poses)
        thin = Scene(scene.points, scene.name, scene.normals,
                     replace(room.mesh, exact=True))
        truth = Simulator(thin, SimulationConfig(engine=with_rays(engine, thin)), rig.models)
        row[f'share_{preset}'] = abs(_share(views) - _share(
            [truth.look(pose, camera) for camera, pose in enumerate(poses)])) / len(scene)
        row[f'inside_{preset}'] = bool(((poses[:, :3] > 0.0) & (poses[:, :3] < plan.size)).all())
        row[f'delivered_{preset}'] = judge.evaluate(poses).depth_error
    return row


def _grain(points: np.ndarray) -> float:
    """Return how far a surface is from the nearest of its own points at most, metres."""
    away, _ = cKDTree(points).query(points[::50], 2)
    return float(np.quantile(away[:, 1], 0.99))


def _share(views: list) -> int:
    """Return how many points are seen."""
    return int(count_bits(np.bitwise_or.reduce([view.seen for view in views])))


def main(argv: list[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='solid_rooms', description=__doc__)
    parser.add_argument('--rooms', type=int, default=len(TEST), help='how many of the test rooms')
    results.add_record(parser, 'solid_rooms')
    options = parser.parse_args(argv)
    rows = []
    with TemporaryDirectory() as folder:
        for seed in TEST[:options.rooms]:
            rows.append(room_of(seed, Path(folder)))
            print(rows[-1], flush=True)
    found = {'rooms': len(rows), 'evaluations': EVALUATIONS, 'cameras': CAMERAS,
             **{f'{key}_worst': round(max(row[key] for row in rows), 4)
                for key in ('floor', 'ceiling', 'walls', 'share_mesh', 'share_fine')},
             'inside': all(row['inside_mesh'] and row['inside_fine'] for row in rows),
             **{key: round(float(np.median([row[key] for row in rows])), 3)
                for key in ('seconds_to_read', 'ms_mesh', 'ms_fine')},
             'delivered_mesh_over_fine': geometric(
                 [row['delivered_mesh'] / row['delivered_fine'] for row in rows])}
    if options.record:
        results.write('solid_rooms', found, results.command_of('solid_rooms', argv))


if __name__ == '__main__':
    main()
