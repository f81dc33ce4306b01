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
Rooms from measurements: a box with doors, windows and furniture, or the corners of a room.

x runs along the length, y along the width and z up, from the south-west corner of the floor. The
walls are south (y = 0), east, north and west (x = 0).
"""

from collections.abc import Sequence

import numpy as np
from ocp_ros.util import yaml_files as schema
from ocp_ros.util.yaml_files import check, Document, Schema
from scipy.spatial import ConvexHull, QhullError

#: For each wall, the axis normal to it, and whether it is at the far end of that axis.
WALLS = {'south': (1, False), 'east': (0, True), 'north': (1, True), 'west': (0, False)}
#: The number of corners of a room.
CORNERS = 8
#: Metres: the largest room.
MAX_ROOM_M = 100.0
LENGTH: Schema = {'type': 'number', 'minimum': 0.0, 'maximum': MAX_ROOM_M}
OPENING = schema.mapping(
    'a wall, and at, width and height', {'wall': 'south', 'at': 1.0, 'width': 0.9, 'height': 2.1},
    ('wall', 'at', 'width', 'height'), wall=schema.one_of(WALLS, 'south'),
    at=schema.number('metres along the wall, 0 or more, from the corner with the lower x or y',
                     1.0, minimum=0, maximum=MAX_ROOM_M),
    width=schema.number('metres above 0', 0.9, exclusiveMinimum=0, maximum=MAX_ROOM_M),
    height=schema.number('metres above 0', 2.1, exclusiveMinimum=0, maximum=MAX_ROOM_M),
    sill=schema.number('metres above the floor, 0 or more', 0.9, minimum=0, maximum=MAX_ROOM_M))
BOX = schema.mapping(
    'a mapping with the key box', {'box': [[1, 1, 0], [2, 1.8, 0.75]]}, ('box',),
    box=schema.many('the lowest and the highest corner, metres', schema.array(LENGTH, 3, 3),
                    [[1, 1, 0], [2, 1.8, 0.75]], 2, 2))
ROOM = schema.mapping(
    'a room with the key size', {'size': [6, 4.5, 2.7]}, ('size',),
    size=schema.many('length, width and height in metres, each from 1 to 100',
                     {**LENGTH, 'minimum': 1.0}, [6, 4.5, 2.7], 3, 3),
    openings=schema.many('a list of doors and windows that let one look out', OPENING,
                         [{'wall': 'south', 'at': 1.0, 'width': 0.9, 'height': 2.1}], 0, 100),
    boxes=schema.many('a list of boxes', BOX, [{'box': [[1, 1, 0], [2, 1.8, 0.75]]}], 0, 1000))
#: Corners of each face of a box. The number of a corner is 1 (x high) + 2 (y high) + 4 (z high).
FACES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2],
                  [1, 3, 7, 5]])


def solids_of(document: Document) -> np.ndarray:
    """Return the S boxes of a measured room: (S, 2, 3) metres, lowest and highest corners."""
    boxes = document.data.get('boxes', ())
    return np.array([data['box'] for data in boxes], dtype=np.float64).reshape(-1, 2, 3)


def triangles_of(document: Document) -> np.ndarray:
    """
    Return the surfaces of a measured room as triangles.

    :param document: a room that is valid under the schema :data:`ROOM`.
    :returns: (T, 3, 3) metres, the corners of each triangle.
    :raises ConfigurationError: if a box or an opening is not inside the room.
    """
    size = np.array(document.data['size'], dtype=np.float64)
    # The first two faces of a box are the lower and the upper one.
    floor, ceiling = box_faces(np.zeros(3), size)[:2]
    quads = [floor, ceiling]
    for wall in WALLS:
        quads += _wall_rectangles(document, wall, size)
    for k, data in enumerate(document.data.get('boxes', ())):
        low, high = np.array(data['box'], dtype=np.float64)
        if not (low < high).all() or (high > size).any():
            raise document.error(
                ('boxes', k, 'box'), f'corners from {low.tolist()} to {high.tolist()}',
                f'the lowest corner first, and the highest within {size.tolist()}',
                'correct those that are not')
        # The first face is the underside, which is not visible if the box stands on the floor.
        quads += list(box_faces(low, high)[int(low[2] == 0.0):])
    # A diagonal divides each rectangle into two triangles.
    corners = np.array(quads)
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def box_faces(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the faces of a box, the lower, then the upper one first: (6, 4, 3) metres."""
    is_high = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return np.where(is_high, high, low)[FACES]


def _wall_rectangles(document: Document, wall: str, size: np.ndarray) -> list[np.ndarray]:
    """
    Return a wall without its openings, as a list of rectangles (4, 3), metres.

    :param wall: a key of ``WALLS``.
    :param size: (3,) the size of the room, metres.
    :raises ConfigurationError: if an opening reaches out of the wall.
    """
    axis, is_far = WALLS[wall]
    length, height = size[1 - axis], size[2]
    openings = []
    for k, data in enumerate(document.data.get('openings', ())):
        left, low = data['at'], data.get('sill', 0.0)
        right, high = left + data['width'], low + data['height']
        if data['wall'] == wall and (right > length or high > height):
            raise document.error(
                ('openings', k), f'an opening up to {right:g} m along the {wall} wall and '
                f'{high:g} m up', f'one within its {length:g} x {height:g} m', 'correct it')
        if data['wall'] == wall:
            openings.append((left, right, low, high))
    # The edges of all openings divide the wall into a grid of rectangles; those outside of all
    # openings remain.
    edges_along = np.unique([0.0, length, *(edge for opening in openings for edge in opening[:2])])
    edges_up = np.unique([0.0, height, *(edge for opening in openings for edge in opening[2:])])
    rectangles = []
    for left, right in zip(edges_along, edges_along[1:]):
        for low, high in zip(edges_up, edges_up[1:]):
            if not any(start <= left and right <= end and bottom <= low and high <= top
                       for start, end, bottom, top in openings):
                quad = np.zeros((4, 3))
                quad[:, axis] = is_far * size[axis]
                quad[:, 1 - axis] = left, right, right, left
                quad[:, 2] = low, low, high, high
                rectangles.append(quad)
    return rectangles


def room_between(points: np.ndarray) -> tuple[np.ndarray, bool] | None:
    """
    Return the surfaces of a convex room, given its eight corners.

    :param points: (8, 3), in any unit.
    :returns: (T, 3, 3) the corners of triangles, and whether each triangle is one of two in a flat
        side; None if the points are not the corners of a convex room.
    """
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    if len(hull.vertices) < CORNERS:
        return None
    # ``equations`` holds the outward normals of the triangles. The two triangles of a flat side
    # have the same normal, within 3 degrees. So a triangle of a flat side is parallel to at least
    # two: itself and the other one.
    is_parallel = hull.equations[:, :3] @ hull.equations[:, :3].T >= np.cos(np.deg2rad(3.0))
    return points[hull.simplices], bool((is_parallel.sum(axis=1) >= 2).all())


def document_of(size: Sequence[str], openings: Sequence[Sequence[str]],
                boxes: Sequence[Sequence[str]]) -> Document:
    """
    Return the document of a room whose values were typed as text, for example in a command.

    :param size: length, width and height, metres.
    :param openings: the wall of each opening, then at, width, height and, optionally, sill,
        metres.
    :param boxes: x, y, z of the lowest and then of the highest corner of each box, metres.
    :raises ConfigurationError: if the values are not a valid room.
    """
    # If an opening has no sill, zip leaves out the last key.
    document = Document('room', {
        'size': list(map(_number, size)),
        'openings': [{'wall': wall, **dict(zip(('at', 'width', 'height', 'sill'),
                                               map(_number, lengths)))}
                     for wall, *lengths in openings],
        'boxes': [{'box': [list(map(_number, corners[:3])), list(map(_number, corners[3:]))]}
                  for corners in boxes]})
    check(document, ROOM)
    return document


def _number(text: str) -> float | str:
    """Convert text to a number; return other text unchanged, so that the schema refuses it."""
    try:
        value = float(text)
    except ValueError:
        return text
    return value if np.isfinite(value) else text
