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
Furniture of generated rooms, as solid boxes in metres.

Each piece stands on the floor around its own origin, with its back to -y; sizes are those of
common office furniture. Kinds are the classes of S3DIS.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix

#: The kinds of solids. The shell of a room has the kinds ceiling, floor and wall.
SOLID_KINDS = ('ceiling', 'floor', 'wall', 'beam', 'column', 'window', 'door', 'table', 'chair',
               'sofa', 'bookcase', 'board', 'clutter')


class Solid(NamedTuple):
    """
    An upright box.

    :ivar kind: one of ``SOLID_KINDS``.
    :ivar centre: (3,) metres.
    :ivar size: (3,) metres, along the axes of the box.
    :ivar yaw: radians, the rotation about the vertical axis.
    """

    kind: str
    centre: np.ndarray
    size: np.ndarray
    yaw: float = 0.0


#: A piece of furniture: its boxes.
Piece = list[Solid]


def make_solid(kind: str, low: Sequence[float], high: Sequence[float]) -> Solid:
    """Return the upright box from its lowest to its highest corner, both (3,), metres."""
    low, high = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)
    return Solid(kind, 0.5 * (low + high), high - low)


def moved_piece(piece: Piece, position: Sequence[float], yaw: float, height: float = 0.0) -> Piece:
    """
    Return a piece that is rotated about its origin and then moved.

    :param position: (2,) metres, where the origin of the piece moves to.
    :param yaw: radians.
    :param height: metres that the piece moves up.
    """
    rotation = rotation_matrix(yaw)
    offset = np.array([position[0], position[1], height])
    return [Solid(box.kind, rotation @ box.centre + offset, box.size, box.yaw + yaw)
            for box in piece]


def _legs(kind: str, x: float, y: float, half_width: float, height: float) -> Piece:
    """Return four legs whose centres are at -x or x, and -y or y; all lengths in metres."""
    return [make_solid(kind, (u - half_width, v - half_width, 0.0),
                       (u + half_width, v + half_width, height)) for u in (-x, x) for v in (-y, y)]


def build_table(rng: np.random.Generator, width: float, depth: float) -> Piece:
    """Build a table of a width and a depth, metres: a slab on four legs or on two panels."""
    top = rng.uniform(0.70, 0.77)
    thickness = 0.04
    # Its sides are at -x, x, -y and y.
    x, y = 0.5 * width, 0.5 * depth
    piece = [make_solid('table', (-x, -y, top - thickness), (x, y, top))]
    if rng.random() < 0.6:
        piece += _legs('table', x - 0.05, y - 0.05, 0.03, top - thickness)
    else:
        for sign in (-1, 1):
            panel_x = sign * (x - 0.15)
            piece.append(make_solid('table', (panel_x - 0.02, -0.8 * y, 0.0),
                                    (panel_x + 0.02, 0.8 * y, top - thickness)))
    return piece


def build_desk(rng: np.random.Generator) -> Piece:
    """Build a desk, mostly with drawers, screens and objects on it; its user sits at +y."""
    width, depth = rng.uniform([1.2, 0.65], [1.8, 0.8])
    piece = build_table(rng, width, depth)
    # The first box of a table is its slab, 4 cm thick.
    top = float(piece[0].centre[2] + 0.02)
    if rng.random() < 0.7:
        piece.append(make_solid('table', (-0.5 * width + 0.06, -0.5 * depth + 0.06, 0.0),
                                (-0.5 * width + 0.48, 0.5 * depth - 0.08, 0.6)))
    for _ in range(rng.integers(0, 3)):
        half_width = 0.5 * rng.uniform(0.45, 0.65)
        screen = [make_solid('clutter', (-half_width, -0.02, 0.1), (half_width, 0.02, 0.45)),
                  make_solid('clutter', (-0.1, -0.08, 0.0), (0.1, 0.08, 0.1))]
        position = rng.uniform([-0.5 * width + 0.35, -0.2], [0.5 * width - 0.35, -0.05])
        piece += moved_piece(screen, position, rng.uniform(-0.4, 0.4), top)
    return piece + scatter_boxes(rng, width, depth, top, rng.integers(1, 6))


def scatter_boxes(rng: np.random.Generator, width: float, depth: float, height: float,
                  count: int) -> Piece:
    """
    Return boxes at random positions on a rectangle around the origin; lengths in metres.

    :param width: the extent of the rectangle along x.
    :param depth: the extent of the rectangle along y.
    :param height: the height of the rectangle above the floor.
    """
    piece = []
    for _ in range(count):
        size = rng.uniform([0.12, 0.12, 0.05], [0.5, 0.4, 0.45])
        # The centres of the boxes stay 0.2 m away from the edges of the rectangle.
        position = rng.uniform(-0.5, 0.5, 2) * np.maximum([width - 0.4, depth - 0.4], 0.0)
        box = make_solid('clutter', (*(-0.5 * size[:2]), 0.0), (*(0.5 * size[:2]), size[2]))
        piece += moved_piece([box], position, rng.uniform(-0.6, 0.6), height)
    return piece


def build_chair(rng: np.random.Generator) -> Piece:
    """Build a chair on four legs or on a post; it faces +y."""
    seat, width = rng.uniform(0.42, 0.50), rng.uniform(0.42, 0.52)
    # The sides of the seat are at -x and x along both axes.
    x = 0.5 * width
    back_top = seat + rng.uniform(0.35, 0.55)
    piece = [make_solid('chair', (-x, -x, seat - 0.06), (x, x, seat)),
             make_solid('chair', (-x, -x, seat), (x, -x + 0.06, back_top))]
    if rng.random() < 0.5:
        piece += _legs('chair', x - 0.03, x - 0.03, 0.02, seat - 0.06)
    else:
        # A post on a cross of two bars.
        piece.append(make_solid('chair', (-0.04, -0.04, 0.08), (0.04, 0.04, seat - 0.06)))
        piece.append(make_solid('chair', (-0.28, -0.03, 0.02), (0.28, 0.03, 0.08)))
        piece.append(make_solid('chair', (-0.03, -0.28, 0.02), (0.03, 0.28, 0.08)))
    return piece


def build_bookcase(rng: np.random.Generator, width: float, depth: float, height: float) -> Piece:
    """Build a bookcase: open shelves, partly filled; if lower than 1 m, one closed box. Metres."""
    # Its sides are at -x, x, -y and y.
    x, y = 0.5 * width, 0.5 * depth
    thickness = 0.03
    if height < 1.0:
        return [make_solid('bookcase', (-x, -y, 0.0), (x, y, height))]
    piece = [make_solid('bookcase', (-x, -y, 0.0), (-x + thickness, y, height)),
             make_solid('bookcase', (x - thickness, -y, 0.0), (x, y, height)),
             make_solid('bookcase', (-x, -y, 0.0), (x, -y + thickness, height))]
    levels = np.linspace(0.05, height - thickness, max(int(height / 0.38), 3))
    for index, level in enumerate(levels):
        piece.append(make_solid('bookcase', (-x, -y, level), (x, y, level + thickness)))
        if index + 1 < len(levels) and rng.random() < 0.8:
            free_height = levels[index + 1] - level - thickness
            books_end = -x + thickness + rng.uniform(0.3, 1.0) * (width - 2 * thickness)
            books_front = y - rng.uniform(0.02, 0.12)
            books_top = level + thickness + rng.uniform(0.6, 0.95) * free_height
            books_low = -x + thickness, -y + thickness, level + thickness
            piece.append(make_solid('bookcase', books_low, (books_end, books_front, books_top)))
    return piece


def build_cabinet(rng: np.random.Generator, width: float, depth: float, height: float) -> Piece:
    """Build a closed cabinet, mostly with objects on it; lengths in metres."""
    x, y = 0.5 * width, 0.5 * depth
    piece = [make_solid('clutter', (-x, -y, 0.0), (x, y, height))]
    return piece + scatter_boxes(rng, width, depth, height, rng.integers(0, 5))


def build_sofa(rng: np.random.Generator, width: float) -> Piece:
    """Build a sofa, or an armchair if the width in metres is small."""
    # Its sides are at -x, x, -y and y.
    x, y = 0.5 * width, 0.42
    seat = rng.uniform(0.38, 0.46)
    back_top = seat + rng.uniform(0.3, 0.45)
    return [make_solid('sofa', (-x, -y, 0.05), (x, y, seat)),
            make_solid('sofa', (-x, -y, seat), (x, -y + 0.22, back_top)),
            make_solid('sofa', (-x, -y, seat), (-x + 0.18, y, seat + 0.2)),
            make_solid('sofa', (x - 0.18, -y, seat), (x, y, seat + 0.2))]
