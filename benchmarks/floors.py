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
Floors of buildings: rooms on both sides of a corridor, with doors and furniture.

What ``ocp plan`` needs for floors of three sizes with a camera for each 12 m2, and what it proves;
and how many cameras ``--count auto`` finds that reach a share in each room:

    python -m benchmarks.floors --record
    python -m benchmarks.floors --record --count --seconds 20
"""

import argparse
from collections.abc import Iterator, Sequence
import time
from typing import Any, NamedTuple

from benchmarks import results
import numpy as np
import ocp_ros
from ocp_ros.scenes.meshes import sample_faces
from ocp_ros.scenes.scene import Mesh, Scene
from ocp_ros.scenes.scene_files import scene_of

#: Metres: thickness of walls, height of rooms, and width and height of doors.
WALL, HEIGHT, DOOR, LINTEL = 0.12, 2.7, 0.9, 2.05
#: Metres: width of the corridor, and depth of the rooms beside it.
CORRIDOR, DEPTH = 1.8, 4.5
#: What ``--count auto`` has to reach in each room.
COUNTED = {'sensor': 'd455', 'by': 'error', 'target': 0.8}


class Floor(NamedTuple):
    """
    A floor on one level.

    :ivar rooms: (R, 2, 2) metres, the lowest and the highest corner of each room.
    :ivar doors: (D, 2, 2) metres, those of the passages through walls, below lintels.
    :ivar boxes: (B, 2, 3) metres, those of furniture.
    """

    rooms: np.ndarray
    doors: np.ndarray
    boxes: np.ndarray

    def room_at(self, places: np.ndarray) -> np.ndarray:
        """Return the index (M,) of the room nearest to each place (M, 2 or 3), metres."""
        offsets = np.maximum(self.rooms[:, 0] - places[:, None, :2],
                             places[:, None, :2] - self.rooms[:, 1])
        return np.argmin(np.maximum(offsets, 0.0).sum(axis=2), axis=1)


def along_corridor(widths: Sequence[Sequence[float]], seed: int = 0, furniture: int = 2) -> Floor:
    """
    Build rooms of given widths on both sides of a corridor, which is room 0.

    :param widths: metres, of the rooms above and below; those below 1.6 m are closets of 2 m2.
    :param furniture: the number of boxes in each room.
    """
    rng = np.random.default_rng(seed)
    length = max(sum(side) + WALL * (len(side) - 1) for side in widths)
    rooms, doors, boxes = [[(0.0, 0.0), (length, CORRIDOR)]], [], []
    for side, upward in zip(widths, (True, False)):
        start = 0.0
        for width in side:
            depth = DEPTH if width >= 1.6 else 2.0 / width
            low = CORRIDOR + WALL if upward else -WALL - depth
            rooms.append([(start, low), (start + width, low + depth)])
            at = start + 0.5 * width - 0.5 * DOOR
            wall = CORRIDOR if upward else -WALL
            doors.append([(at, wall), (at + DOOR, wall + WALL)])
            for _ in range(furniture if width >= 1.6 else 0):
                size = rng.uniform((0.4, 0.4, 0.5), (1.4, 0.8, 2.0))
                # In the half of the room that is away from the door.
                x = rng.uniform(start, start + width - size[0])
                y = (low + depth - size[1] - rng.uniform(0.0, 1.2) if upward else
                     low + rng.uniform(0.0, 1.2))
                boxes.append([(x, y, 0.0), (x + size[0], y + size[1], size[2])])
            start += width + WALL
    return Floor(np.array(rooms), np.array(doors), np.array(boxes).reshape(-1, 2, 3))


def _quads(floor: Floor) -> Iterator[tuple[Sequence[float], Sequence[float]]]:
    """Yield two opposite corners of each level or upright rectangle of a floor."""
    for (x0, y0), (x1, y1) in floor.rooms:
        for z in (0.0, HEIGHT):
            yield (x0, y0, z), (x1, y1, z)
        for x in (x0, x1):
            yield (x, y0, 0.0), (x, y1, HEIGHT)
        for y in (y0, y1):
            # Doors are in the walls along the corridor.
            ends = [x0]
            for (left, bottom), (right, top) in floor.doors:
                if min(abs(bottom - y), abs(top - y)) < 1e-6 and x0 <= left and right <= x1:
                    ends += [left, right]
                    yield (left, y, LINTEL), (right, y, HEIGHT)
            ends = sorted([*ends, x1])
            for left, right in zip(ends[::2], ends[1::2]):
                yield (left, y, 0.0), (right, y, HEIGHT)
    for (x0, y0), (x1, y1) in floor.doors:
        for z in (0.0, LINTEL):
            yield (x0, y0, z), (x1, y1, z)
        for x in (x0, x1):
            yield (x, y0, 0.0), (x, y1, LINTEL)
    for low, high in floor.boxes:
        for axis in range(3):
            for end in (low, high):
                first, second = low.copy(), high.copy()
                first[axis] = second[axis] = end[axis]
                if axis < 2 or end[2] > 0.0:
                    yield first, second


def mesh_of(floor: Floor) -> Mesh:
    """Return the surfaces of a floor as a mesh."""
    vertices = []
    for low, high in _quads(floor):
        low, high = np.array(low, dtype=float), np.array(high, dtype=float)
        flat = int(np.argmin(high - low))
        u, v = (np.where(np.arange(3) == axis, high - low, 0.0)
                for axis in range(3) if axis != flat)
        vertices.append([low, low + u, low + u + v, low + v])
    count = len(vertices)
    triangles = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(count)[:, None, None]
    return Mesh(np.array(vertices, dtype=np.float32).reshape(-1, 3),
                triangles.reshape(-1, 3).astype(np.int32))


def scan_of(floor: Floor, points: int, **reading) -> Scene:
    """Return a floor as it is read from a scan with a number of points and 4 mm of noise."""
    sampled = sample_faces(mesh_of(floor).corners, points)[:, :3]
    return scene_of(sampled + np.random.default_rng(0).normal(0.0, 0.004, sampled.shape),
                    name='floor', **reading)


def planned(rooms: int, cameras: int | str, seconds: float, **asked) -> dict[str, Any]:
    """Plan cameras on the walls of a floor with some rooms on either side of the corridor."""
    floor = along_corridor([[3.4] * rooms] * 2)
    area = float(np.prod(floor.rooms[:, 1] - floor.rooms[:, 0], axis=1).sum())
    begin, used = time.perf_counter(), time.process_time()
    found = ocp_ros.plan(scan_of(floor, int(300 * area)), cameras=cameras, seconds=seconds,
                         **asked)
    scores = found.assessment.found['scores']
    count = found.found.get('count')
    counted = {} if count is None else {
        'reached': count['reached'], 'at_least': count['at_least'], 'fewer_tried': count['fewer'],
        'rooms_that_reach': sum(room['reached'] for room in count['rooms']),
        'least_share_of_a_room': round(min(room['share'] for room in count['rooms']), 3)}
    return {'area_m2': round(area), 'rooms': len(floor.rooms), 'cameras': len(found.poses),
            'rooms_found': len(scores['rooms']), **counted,
            'rooms_without_a_camera': sum(room['cameras'] == 0 for room in scores['rooms']),
            'seen': round(found.seen, 3),
            'least_seen_in_a_room': round(min(room['seen'] for room in scores['rooms']), 3),
            'gap': found.gap and round(found.gap, 4),
            'seconds': round(time.perf_counter() - begin, 1),
            'processor_s': round(time.process_time() - used, 1)}


def main(argv: Sequence[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='floors', description=__doc__)
    parser.add_argument('--seconds', type=float, default=90.0, help='of each search')
    parser.add_argument('--count', action='store_true', help='find the number of cameras')
    results.add_record(parser, 'floors')
    arguments = parser.parse_args(argv)
    rows = {}
    asked = COUNTED if arguments.count else {'sensor': 'd455'}
    for rooms, cameras in ((2, 6), (4, 12), (8, 24))[::2 if arguments.count else 1]:
        name = f'{2 * rooms + 1}_rooms' if arguments.count else str(cameras)
        rows[name] = planned(rooms, 'auto' if arguments.count else cameras, arguments.seconds,
                             **asked)
        print(rows[name], flush=True)
        # What is measured stays if a larger floor is not waited for.
        if arguments.record:
            results.write('floors', {'search_seconds': arguments.seconds, **asked,
                                     'floors': rows}, results.command_of('floors', argv),
                          'counted' if arguments.count else '')


if __name__ == '__main__':
    main()
