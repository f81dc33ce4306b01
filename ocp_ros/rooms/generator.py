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

"""Generate rooms such as offices and hallways as scans, with the mesh behind the points."""

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.rooms.room_kinds import draw_plan
from ocp_ros.rooms.room_plan import RoomPlan
from ocp_ros.rooms.scanning import sample_surfaces, scan
from ocp_ros.scenes.scene import Mesh, MIN_POINTS, Scene
from ocp_ros.util.settings import check_whole

#: (12, 3) the triangles of a box. A corner's number is 1 (x high) + 2 (y high) + 4 (z high).
BOX_TRIANGLES = np.array([(0, 2, 1), (1, 2, 3), (4, 5, 6), (5, 7, 6), (0, 1, 4), (1, 5, 4),
                          (2, 6, 3), (3, 6, 7), (0, 4, 2), (2, 4, 6), (1, 3, 5), (3, 7, 5)])


def plan_of(seed: int) -> RoomPlan:
    """Return the plan of the room that :func:`generate_room` scans."""
    return draw_plan(np.random.default_rng(seed))


def generate_room(seed: int, n_points: int = 15000, scanned: bool = True) -> Scene:
    """
    Generate an office, a conference room, a lounge, a hallway, a storage room or an open office.

    The same seed gives the same room for any number of points.

    :param seed: any non-negative integer.
    :param n_points: the number of points, to a few per cent.
    :param scanned: whether the points are those of a scan, with noise and occlusion, or lie
        exactly and evenly on all surfaces.
    :returns: a scene that is called ``room-<seed>`` and has the mesh of the room.
    :raises ConfigurationError: for a seed below 0 or too few points.
    """
    check_whole('seed', seed, 0)
    check_whole('n_points', n_points, MIN_POINTS)
    plan = plan_of(seed)
    # Random numbers of the scan are independent of those of the plan.
    rng = np.random.default_rng([seed, 1])
    points = scan(plan, n_points, rng)[0] if scanned else sample_surfaces(plan, n_points, rng)
    return Scene(points, f'room-{seed}', mesh=mesh_of(plan))


def mesh_of(plan: RoomPlan) -> Mesh:
    """Return the mesh of a room: its shell (floor, walls, ceiling) and all solids in it."""
    # The corners of a cube around the origin, in the order of ``BOX_TRIANGLES``.
    unit_corners = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)]) - 0.5
    # The shell begins at the origin.
    vertices = [(unit_corners + 0.5) * plan.size]
    for box in plan.solids:
        vertices.append(unit_corners * box.size @ rotation_matrix(box.yaw).T + box.centre)
    # Each box has eight vertices.
    triangles = BOX_TRIANGLES + 8 * np.arange(len(vertices))[:, None, None]
    return Mesh(np.concatenate(vertices).astype(np.float32),
                triangles.reshape(-1, 3).astype(np.int32))
