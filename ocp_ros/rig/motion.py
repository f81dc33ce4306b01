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

"""Moves and rotations of cameras, bounded in length and kept inside the room."""

from collections.abc import Callable

import numpy as np

#: The number of positions from the centre to the edge of the disc that one turn reaches.
DISC_STEPS = 10
#: Metres: the tolerance for rounding.
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
    """Return the order of the cameras at a turn, rotated so that each one is first in turn."""
    return np.roll(np.arange(cameras), turn)


def drawn_near(rng: np.random.Generator, count: int, radius: float) -> np.ndarray:
    """Draw offsets (count, 2), metres, uniformly from a disc."""
    length, angle = radius * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    return length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def outwards(count: int, pitch: float) -> np.ndarray:
    """Return headings evenly spread over all yaws: (count, 3) yaw, pitch and roll in radians."""
    headings = np.zeros((count, 3))
    headings[:, 0] = 2.0 * np.pi * np.arange(count) / count
    headings[:, 1] = pitch
    return headings


def shortened(ways: np.ndarray, longest: float) -> np.ndarray:
    """Shorten vectors (K, D) to at most a given length."""
    length = np.linalg.norm(ways, axis=1, keepdims=True)
    return ways * np.minimum(longest / np.maximum(length, 1e-12), 1.0)


def towards(positions: np.ndarray, targets: np.ndarray, reach: float) -> np.ndarray:
    """
    Move from positions (K, 2) towards targets (K, 2), metres, by at most ``reach`` metres.

    :returns: (K, 2) metres.
    """
    return positions + shortened(targets - positions, reach)


def turned_towards(headings: np.ndarray, goals: np.ndarray, reach: float) -> np.ndarray:
    """
    Rotate cameras towards goals by at most a given angle.

    A yaw and a pitch are the legs of a right-angled triangle on the sphere of rotations, so the
    rotation is at most the root of the sum of their squares.

    :param headings: (K, 3) yaw, pitch, roll in radians.
    :param goals: (K, 3) the same; the roll is ignored.
    :param reach: radians.
    :returns: (K, 3) radians: the yaw changes in the shorter direction, the roll stays.
    """
    turned = headings.copy()
    turned[:, :2] += shortened(way_between(headings, goals), reach)
    turned[:, 0] = wrapped(turned[:, 0])
    return turned


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Wrap angles in radians to -pi up to pi; angles in this range stay unchanged."""
    return np.where(np.abs(angles) <= np.pi, angles,
                    np.mod(angles + np.pi, 2.0 * np.pi) - np.pi)


def way_between(headings: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """
    Return the rotations from headings to goals.

    :param headings: (..., 3) yaw, pitch, roll in radians.
    :param goals: (..., 3) the same.
    :returns: (..., 2) yaw, in the shorter direction, and pitch, radians.
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
    :param margin: the distance to keep from the box's sides, metres, at most up to its middle.
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
    Find the allowed position nearest to a target that one turn reaches.

    :param position: (3,) metres, where the camera is.
    :param target: (3,) metres, the target of the camera.
    :param reach: the largest move in one turn, metres.
    :param mounted: moves positions (P, 3) onto the mount of the camera.
    :param allowed: returns which positions (P, 3) are allowed: (P,) bool.
    :returns: (3,) metres, accurate to about a seventieth of the reach; None if there is none.
    """
    def usable(places: np.ndarray) -> np.ndarray:
        places = mounted(places)
        places = places[np.linalg.norm(places - position, axis=1) <= reach + ROUNDING]
        return places[allowed(places)] if len(places) else places

    if len(there := usable(target[None])):
        return there[0]
    best, middle = np.empty((0, 3)), position
    straight = position + np.linspace(0.0, 1.0, DISC_STEPS)[:, None] * (target - position)
    # The second search is finer, in a smaller disc.
    for scale in (1.0, 0.15):
        places = usable(np.concatenate([best, _disc(middle, scale * reach), straight]))
        if len(places) == 0:
            break
        middle = places[np.argmin(np.linalg.norm(places - target, axis=1))]
        best = middle[None]
    return best[0] if len(best) else None


def _disc(middle: np.ndarray, radius: float) -> np.ndarray:
    """Return positions (P, 3) in a horizontal disc."""
    steps = np.linspace(-radius, radius, 2 * DISC_STEPS + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    within = np.hypot(x, y) <= radius
    return middle + np.column_stack([x, y, np.zeros_like(x)])[within]


def mounted(placement: np.ndarray, off: float, count: int, seed: int) -> np.ndarray:
    """
    Displace cameras by mounting errors, which are the same for every placement.

    :param placement: (K, 3) or (K, 6), metres and radians.
    :param off: the horizontal displacement of each camera, metres.
    :param count: the number M of sets of mounting errors.
    :param seed: the seed of these errors.
    :returns: (M, K, 3) or (M, K, 6).
    """
    angles = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (count, len(placement)))
    moved = np.repeat(placement[None], count, axis=0)
    moved[..., :2] += off * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return moved
