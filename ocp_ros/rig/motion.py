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

"""Moves and turns of cameras: bounded in length, kept inside the room."""

from collections.abc import Callable

import numpy as np

#: Places from the middle to the edge of the disc that a turn reaches, and how often they are
#: sought again, each time so many times nearer together.
ACROSS, FINER = 10, (1.0, 0.15)
#: Metres that a number may be off by rounding.
ROUNDING = 1e-9


def bounded_moves(actions: np.ndarray, max_step: float) -> np.ndarray:
    """
    Turn actions into moves, none longer than ``max_step``.

    :param actions: (K, 2) or (K, 3) in [-1, 1].
    :param max_step: metres.
    :returns: float64 of the same shape, metres; one row for a single action (2,) or (3,).
    """
    actions = np.atleast_2d(np.asarray(actions, dtype=np.float64))
    length = np.linalg.norm(actions, axis=1, keepdims=True)
    return actions / np.maximum(length, 1.0) * max_step


def order_of(turn: int, cameras: int) -> np.ndarray:
    """Return the order in which cameras are asked at a turn: nobody is always the first."""
    return np.roll(np.arange(cameras), turn)


def drawn_near(rng: np.random.Generator, count: int, radius: float) -> np.ndarray:
    """Draw ways (count, 2), metres, evenly from a disc."""
    length, angle = radius * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    return length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def outwards(count: int, pitch: float) -> np.ndarray:
    """Turn cameras to all sides: (count, 3) yaw, pitch and roll in radians."""
    headings = np.zeros((count, 3))
    headings[:, 0] = 2.0 * np.pi * np.arange(count) / count
    headings[:, 1] = pitch
    return headings


def shortened(ways: np.ndarray, longest: float) -> np.ndarray:
    """Shorten ways (K, D) that are longer than some length, in the same unit."""
    length = np.linalg.norm(ways, axis=1, keepdims=True)
    return ways * np.minimum(longest / np.maximum(length, 1e-12), 1.0)


def towards(positions: np.ndarray, targets: np.ndarray, reach: float) -> np.ndarray:
    """
    Go from positions (K, 2) to targets (K, 2), metres, but no farther than some reach, metres.

    :returns: (K, 2) metres.
    """
    return positions + shortened(targets - positions, reach)


def turned_towards(headings: np.ndarray, goals: np.ndarray, reach: float) -> np.ndarray:
    """
    Turn cameras towards goals, but no farther than some angle.

    A yaw and a pitch are legs of a right-angled triangle on the sphere of rotations, so the
    rotation is at most the square root of the sum of their squares.

    :param headings: (K, 3) yaw, pitch, roll in radians.
    :param goals: (K, 3) the same; the roll is not looked at.
    :param reach: radians.
    :returns: (K, 3) radians: the yaw changes the shorter way, the roll stays.
    """
    turned = headings.copy()
    turned[:, :2] += shortened(way_between(headings, goals), reach)
    turned[:, 0] = wrapped(turned[:, 0])
    return turned


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Return angles in radians as -pi up to pi; those that are stay as they are."""
    return np.where(np.abs(angles) <= np.pi, angles,
                    np.mod(angles + np.pi, 2.0 * np.pi) - np.pi)


def way_between(headings: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """
    Tell by how much cameras have to be turned.

    :param headings: (..., 3) yaw, pitch, roll in radians.
    :param goals: (..., 3) the same.
    :returns: (..., 2) yaw, the shorter way, and pitch, radians.
    """
    way = goals[..., :2] - headings[..., :2]
    way[..., 0] = wrapped(way[..., 0])
    return way


def kept_inside(positions: np.ndarray, bounds: np.ndarray, margin: float
                ) -> tuple[np.ndarray, bool]:
    """
    Bring positions back into the bounding box.

    :param positions: (K, 3) metres.
    :param bounds: (2, 3) metres, lowest and highest corner.
    :param margin: metres to keep from the box's sides; at most to its middle.
    :returns: positions (K, 3) float64, and whether any of them was outside the box itself.
    """
    low, high = bounds[0, :2], bounds[1, :2]
    inset = np.minimum(margin, 0.5 * (high - low))
    flat = positions[:, :2]
    outside = bool(((flat < low) | (flat > high)).any())
    inside = np.array(positions, dtype=np.float64)
    inside[:, :2] = np.clip(flat, low + inset, high - inset)
    return inside, outside


def nearest_place(position: np.ndarray, target: np.ndarray, reach: float,
                  mounted: Callable[[np.ndarray], np.ndarray],
                  allowed: Callable[[np.ndarray], np.ndarray]) -> np.ndarray | None:
    """
    Find the allowed place that is nearest to a target, among those that one turn reaches.

    :param position: (3,) metres, where the camera is.
    :param target: (3,) metres, where it was to go.
    :param reach: farthest that it moves in one turn, metres.
    :param mounted: brings places (P, 3) to what the camera hangs on.
    :param allowed: tells at which places (P, 3) it may be: (P,) bool.
    :returns: (3,) metres, found to about a seventieth of the reach; None if there is none.
    """
    def usable(places: np.ndarray) -> np.ndarray:
        places = mounted(places)
        places = places[np.linalg.norm(places - position, axis=1) <= reach + ROUNDING]
        return places[allowed(places)] if len(places) else places

    if len(there := usable(target[None])):
        return there[0]
    best, middle = np.empty((0, 3)), position
    straight = position + np.linspace(0.0, 1.0, ACROSS)[:, None] * (target - position)
    for scale in FINER:
        places = usable(np.concatenate([best, _disc(middle, scale * reach), straight]))
        if len(places) == 0:
            break
        middle = places[np.argmin(np.linalg.norm(places - target, axis=1))]
        best = middle[None]
    return best[0] if len(best) else None


def _disc(middle: np.ndarray, radius: float) -> np.ndarray:
    """Return places (P, 3) in a level disc."""
    steps = np.linspace(-radius, radius, 2 * ACROSS + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    within = np.hypot(x, y) <= radius
    return middle + np.column_stack([x, y, np.zeros_like(x)])[within]


def mounted(placement: np.ndarray, off: float, count: int, seed: int) -> np.ndarray:
    """
    Mount cameras a little off, in the same ways for every placement.

    :param placement: (K, 3) or (K, 6), metres and radians.
    :param off: how far each camera is off, seen from above, metres.
    :param count: how many ways of being off, M.
    :param seed: of these ways.
    :returns: (M, K, 3) or (M, K, 6).
    """
    angles = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (count, len(placement)))
    moved = np.repeat(placement[None], count, axis=0)
    moved[..., :2] += off * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return moved
