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
Moves and rotations of cameras, bounded in length and kept inside the room.

Everywhere, K is the number of cameras.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

#: Metres: the tolerance for rounding.
ROUNDING = 1e-9


def bounded_moves(actions: np.ndarray, max_step: float) -> np.ndarray:
    """
    Return the moves of actions, none longer than ``max_step``.

    :param actions: (K, 2) or (K, 3): x, y or x, y, z of each action, in [-1, 1].
    :param max_step: metres: the length of a move whose action has a length of 1 or more.
    :returns: float64 of the same shape, metres; one row for a single action (2,) or (3,).
    """
    actions = np.atleast_2d(np.asarray(actions, dtype=np.float64))
    length = np.linalg.norm(actions, axis=1, keepdims=True)
    return actions / np.maximum(length, 1.0) * max_step


def order_of(turn: int, cameras: int) -> np.ndarray:
    """Return the camera numbers (K,) in their order at a turn; each turn begins with another."""
    return np.roll(np.arange(cameras), turn)


def drawn_near(rng: np.random.Generator, count: int, radius: float) -> np.ndarray:
    """Draw offsets (count, 2), metres, uniformly from a disc of a radius in metres."""
    # The square root makes the density the same near the centre and near the edge.
    length, angle = radius * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    return length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def outwards(count: int, pitch: float = 0.0) -> np.ndarray:
    """
    Return headings with evenly spread yaws.

    :param count: the number of headings.
    :param pitch: of all headings, radians.
    :returns: (count, 3) yaw, pitch and roll in radians.
    """
    headings = np.zeros((count, 3))
    headings[:, 0] = 2.0 * np.pi * np.arange(count) / count
    headings[:, 1] = pitch
    return headings


def shortened(vectors: np.ndarray, max_length: float) -> np.ndarray:
    """Return K vectors (K, D) of D components, shortened to at most a given length."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors * np.minimum(max_length / np.maximum(length, 1e-12), 1.0)


def towards(positions: np.ndarray, targets: np.ndarray, max_step: float) -> np.ndarray:
    """
    Return positions moved towards targets by at most a given distance.

    :param positions: (K, 2) metres.
    :param targets: (K, 2) metres.
    :param max_step: metres.
    :returns: (K, 2) metres.
    """
    return positions + shortened(targets - positions, max_step)


def turned_towards(headings: np.ndarray, goals: np.ndarray, max_angle: float) -> np.ndarray:
    """
    Return headings rotated towards goal headings by at most a given angle.

    The limit applies to the root of the sum of the squared yaw and pitch. The angle of rotation is
    not larger, since yaw and pitch are the legs of a right-angled triangle on a sphere.

    :param headings: (K, 3) yaw, pitch, roll in radians.
    :param goals: (K, 3) the same; the roll is ignored.
    :param max_angle: radians.
    :returns: (K, 3) radians: the yaw changes in the shorter direction, the roll stays.
    """
    turned = headings.copy()
    turned[:, :2] += shortened(way_between(headings, goals), max_angle)
    turned[:, 0] = wrapped(turned[:, 0])
    return turned


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Return angles wrapped to -pi up to pi radians; angles in this range stay unchanged."""
    return np.where(np.abs(angles) <= np.pi, angles, np.mod(angles + np.pi, 2.0 * np.pi) - np.pi)


def way_between(headings: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """
    Return the rotations from headings to goals.

    :param headings: (..., 3) yaw, pitch, roll in radians.
    :param goals: (..., 3) the same.
    :returns: (..., 2) yaw, in the shorter direction, and pitch, radians.
    """
    rotations = goals[..., :2] - headings[..., :2]
    rotations[..., 0] = wrapped(rotations[..., 0])
    return rotations


def kept_inside(positions: np.ndarray, box: np.ndarray, margin: float) -> tuple[np.ndarray, bool]:
    """
    Return positions moved into the sides of a bounding box; heights do not change.

    :param positions: (K, 3) metres.
    :param box: (2, 3) the lowest and the highest corner of the box, metres.
    :param margin: the distance to keep from the sides, metres, at most up to the middle.
    :returns: positions (K, 3) float64, and whether any position was outside the box itself.
    """
    low, high = box[0, :2], box[1, :2]
    inset = np.minimum(margin, 0.5 * (high - low))
    positions_xy = positions[:, :2]
    any_outside = bool(((positions_xy < low) | (positions_xy > high)).any())
    moved = np.array(positions, dtype=np.float64)
    moved[:, :2] = np.clip(positions_xy, low + inset, high - inset)
    return moved, any_outside


def nearest_place(position: np.ndarray, target: np.ndarray, reach: float,
                  move_onto_mount: Callable[[np.ndarray], np.ndarray],
                  are_allowed: Callable[[np.ndarray], np.ndarray]) -> np.ndarray | None:
    """
    Find the allowed position nearest to a target that one turn reaches.

    :param position: (3,) metres, the position of the camera.
    :param target: (3,) metres, the target of the camera.
    :param reach: the largest move in one turn, metres.
    :param move_onto_mount: returns P positions (P, 3) moved onto the mount of the camera, metres.
    :param are_allowed: returns whether P positions (P, 3) are allowed: (P,) bool.
    :returns: (3,) metres, accurate to about a seventieth of the reach; None if one turn reaches no
        allowed position.
    """
    def usable_positions(positions: np.ndarray) -> np.ndarray:
        moved = move_onto_mount(positions)
        reached = moved[np.linalg.norm(moved - position, axis=1) <= reach + ROUNDING]
        return reached[are_allowed(reached)] if len(reached) else reached

    if len(mounted_target := usable_positions(target[None])):
        return mounted_target[0]
    # Empty until the first search has found a position.
    best = np.empty((0, 3))
    centre = position
    # The number of steps from the centre of a disc to its edge, and of positions on the straight
    # line to the target.
    steps = 10
    line = position + np.linspace(0.0, 1.0, steps)[:, None] * (target - position)
    # The second search is finer: it is in a smaller disc, around the best position so far.
    for scale in (1.0, 0.15):
        positions = usable_positions(
            np.concatenate([best, _disc_positions(centre, scale * reach, steps), line]))
        if len(positions) == 0:
            break
        centre = positions[np.argmin(np.linalg.norm(positions - target, axis=1))]
        # The second search gets this position as a candidate too, so that no result is worse.
        best = centre[None]
    return best[0] if len(best) else None


def _disc_positions(centre: np.ndarray, radius: float, steps: int) -> np.ndarray:
    """Return a square grid of P positions (P, 3), metres, in a horizontal disc."""
    axis = np.linspace(-radius, radius, 2 * steps + 1)
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    inside = np.hypot(x, y) <= radius
    return centre + np.column_stack([x, y, np.zeros_like(x)])[inside]


class MountingErrors(NamedTuple):
    """
    Random errors of the positions at which cameras are mounted.

    :ivar metres: the horizontal displacement of each camera.
    :ivar count: M, the number of random sets of errors.
    :ivar seed: the seed of these errors.
    """

    metres: float
    count: int
    seed: int


def mounted(placement: np.ndarray, errors: MountingErrors) -> np.ndarray:
    """
    Return copies of a placement, in which each camera is displaced in a random direction.

    The seed makes the directions the same for every placement of K cameras.

    :param placement: (K, 3) or (K, 6), metres and radians.
    :param errors: size, number and seed of the errors.
    :returns: (M, K, 3) or (M, K, 6).
    """
    angles = np.random.default_rng(errors.seed).uniform(
        0.0, 2.0 * np.pi, (errors.count, len(placement)))
    moved = np.repeat(placement[None], errors.count, axis=0)
    moved[..., :2] += errors.metres * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return moved
