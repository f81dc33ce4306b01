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

#: The kinds of solids; the room's shell is ceiling, floor and wall.
KINDS = ('ceiling', 'floor', 'wall', 'beam', 'column', 'window', 'door', 'table', 'chair', 'sofa',
         'bookcase', 'board', 'clutter')


class Solid(NamedTuple):
    """
    An upright box.

    :ivar kind: one of ``KINDS``.
    :ivar centre: (3,) metres.
    :ivar size: (3,) metres, along its own axes.
    :ivar yaw: radians, the rotation about the vertical axis.
    """

    kind: str
    centre: np.ndarray
    size: np.ndarray
    yaw: float = 0.0


#: The solids that a piece consists of.
Piece = list[Solid]


def solid(kind: str, low: Sequence[float], high: Sequence[float]) -> Solid:
    """Return the box between two corners (3,), metres."""
    low, high = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)
    return Solid(kind, 0.5 * (low + high), high - low)


def placed(piece: Piece, at: Sequence[float], yaw: float, lift: float = 0.0) -> Piece:
    """Return a piece rotated about its origin, radians, and moved to (x, y) and up, metres."""
    rotation = rotation_matrix(yaw)
    offset = np.array([at[0], at[1], lift])
    return [Solid(part.kind, rotation @ part.centre + offset, part.size, part.yaw + yaw)
            for part in piece]


def table(rng: np.random.Generator, width: float, depth: float) -> Piece:
    """Build a table: a slab on four legs or on two panels."""
    top, thick = rng.uniform(0.70, 0.77), 0.04
    x, y = 0.5 * width, 0.5 * depth
    piece = [solid('table', (-x, -y, top - thick), (x, y, top))]
    if rng.random() < 0.6:
        for sign_x, sign_y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            foot = np.array([sign_x * (x - 0.05), sign_y * (y - 0.05)])
            piece.append(solid('table', (*(foot - 0.03), 0.0), (*(foot + 0.03), top - thick)))
    else:
        for sign in (-1, 1):
            middle = sign * (x - 0.15)
            piece.append(solid('table', (middle - 0.02, -0.8 * y, 0.0),
                               (middle + 0.02, 0.8 * y, top - thick)))
    return piece


def desk(rng: np.random.Generator) -> Piece:
    """Build a desk, mostly with drawers, screens and objects on it; its user sits at +y."""
    width, depth = rng.uniform([1.2, 0.65], [1.8, 0.8])
    piece = table(rng, width, depth)
    top = float(piece[0].centre[2] + 0.02)
    if rng.random() < 0.7:
        piece.append(solid('table', (-0.5 * width + 0.06, -0.5 * depth + 0.06, 0.0),
                           (-0.5 * width + 0.48, 0.5 * depth - 0.08, 0.6)))
    for _ in range(rng.integers(0, 3)):
        wide = rng.uniform(0.45, 0.65)
        screen = [solid('clutter', (-0.5 * wide, -0.02, 0.1), (0.5 * wide, 0.02, 0.45)),
                  solid('clutter', (-0.1, -0.08, 0.0), (0.1, 0.08, 0.1))]
        at = rng.uniform([-0.5 * width + 0.35, -0.2], [0.5 * width - 0.35, -0.05])
        piece += placed(screen, at, rng.uniform(-0.4, 0.4), top)
    return piece + things(rng, width, depth, top, rng.integers(1, 6))


def things(rng: np.random.Generator, width: float, depth: float, lift: float,
           count: int) -> Piece:
    """Scatter small boxes over a rectangle around the origin at a height in metres."""
    piece = []
    for _ in range(count):
        size = rng.uniform([0.12, 0.12, 0.05], [0.5, 0.4, 0.45])
        at = rng.uniform(-0.5, 0.5, 2) * np.maximum([width - 0.4, depth - 0.4], 0.0)
        box = solid('clutter', (*(-0.5 * size[:2]), 0.0), (*(0.5 * size[:2]), size[2]))
        piece += placed([box], at, rng.uniform(-0.6, 0.6), lift)
    return piece


def chair(rng: np.random.Generator) -> Piece:
    """Build a chair on four legs or on a post; it faces +y."""
    seat, wide = rng.uniform(0.42, 0.50), rng.uniform(0.42, 0.52)
    x = 0.5 * wide
    piece = [solid('chair', (-x, -x, seat - 0.06), (x, x, seat)),
             solid('chair', (-x, -x, seat), (x, -x + 0.06, seat + rng.uniform(0.35, 0.55)))]
    if rng.random() < 0.5:
        for sign_x, sign_y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            foot = (x - 0.03) * np.array([sign_x, sign_y])
            piece.append(solid('chair', (*(foot - 0.02), 0.0), (*(foot + 0.02), seat - 0.06)))
    else:
        piece.append(solid('chair', (-0.04, -0.04, 0.08), (0.04, 0.04, seat - 0.06)))
        piece.append(solid('chair', (-0.28, -0.03, 0.02), (0.28, 0.03, 0.08)))
        piece.append(solid('chair', (-0.03, -0.28, 0.02), (0.03, 0.28, 0.08)))
    return piece


def bookcase(rng: np.random.Generator, width: float, depth: float, height: float) -> Piece:
    """Build partly filled open shelves; a low bookcase has a closed front."""
    x, y, board = 0.5 * width, 0.5 * depth, 0.03
    if height < 1.0:
        return [solid('bookcase', (-x, -y, 0.0), (x, y, height))]
    piece = [solid('bookcase', (-x, -y, 0.0), (-x + board, y, height)),
             solid('bookcase', (x - board, -y, 0.0), (x, y, height)),
             solid('bookcase', (-x, -y, 0.0), (x, -y + board, height))]
    levels = np.linspace(0.05, height - board, max(int(height / 0.38), 3))
    for k, level in enumerate(levels):
        piece.append(solid('bookcase', (-x, -y, level), (x, y, level + board)))
        if k + 1 < len(levels) and rng.random() < 0.8:
            room = levels[k + 1] - level - board
            end = -x + board + rng.uniform(0.3, 1.0) * (width - 2 * board)
            piece.append(solid('bookcase', (-x + board, -y + board, level + board),
                               (end, y - rng.uniform(0.02, 0.12),
                                level + board + rng.uniform(0.6, 0.95) * room)))
    return piece


def cabinet(rng: np.random.Generator, width: float, depth: float, height: float) -> Piece:
    """Build a closed cabinet, sometimes with objects on it."""
    piece = [solid('clutter', (-0.5 * width, -0.5 * depth, 0.0),
                   (0.5 * width, 0.5 * depth, height))]
    return piece + things(rng, width, depth, height, rng.integers(0, 5))


def sofa(rng: np.random.Generator, width: float) -> Piece:
    """Build a sofa, or an armchair if it is narrow."""
    x, y, seat = 0.5 * width, 0.42, rng.uniform(0.38, 0.46)
    return [solid('sofa', (-x, -y, 0.05), (x, y, seat)),
            solid('sofa', (-x, -y, seat), (x, -y + 0.22, seat + rng.uniform(0.3, 0.45))),
            solid('sofa', (-x, -y, seat), (-x + 0.18, y, seat + 0.2)),
            solid('sofa', (x - 0.18, -y, seat), (x, y, seat + 0.2))]
