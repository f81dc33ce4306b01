# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the depth error looks from: the middles of parts of a room's air, or the five of the paper.

The paper integrates over all places of a room (eq. 3). A few places stand for the integral best
where they are spread evenly over the air. Then the error of a placement is the same when the scan
is turned, moved or mirrored, whatever its axes.
"""

from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial import distance

from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.depth_error import five_viewpoints
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.structure import Air, STEEP
from ocp_ros.scenes.scene import Scene, turned

#: Viewpoints in the air: a power of two.
COUNT = 16
#: What the variance along a room's long side counts more: in square parts noise would decide.
LONGER = 1.3
#: Decimals of metres: what differs by less is alike.
ROUNDED = 6
#: Degrees: width of a bin of directions of walls; a right angle has 360 of them.
BIN = 0.25

_known: WeakKeyDictionary[Scene, dict[str, np.ndarray]] = WeakKeyDictionary()


def viewpoints_of(scene: Scene, kind: str = 'air') -> np.ndarray:
    """
    Place the viewpoints of the depth error in a room; they are kept with the scene.

    :param kind: ``'air'``: 16 places in the air; ``'paper'``: the five of the paper, in the
        rectangle along the walls.
    :returns: (V, 3) float64, metres, map frame.
    """
    known = _known.setdefault(scene, {})
    if kind not in known:
        known[kind] = air_viewpoints(scene) if kind == 'air' else paper_viewpoints(scene)
    return known[kind]


def air_viewpoints(scene: Scene) -> np.ndarray:
    """
    Place viewpoints in the middles of 16 equal parts of the air at half height.

    The parts are found by halving, each time across the direction in which a part varies most.
    The cells of air lie along the walls, and where they are alike the order is that of the room:
    there are no random numbers and no axes of the scan in it. Where there is too little air at
    half height, all heights count, and where there is none, it is the paper's five.
    """
    angle = wall_direction(scene)
    aligned = turned(scene, -np.rad2deg(angle))
    height = float(scene.bounds[:, 2].mean())
    air = Air(aligned, FreePlane.of(aligned.points, height, 1, 0.0, clearance=0.0),
              centred=True)
    cells = air.cells(height)
    if len(cells) < COUNT:
        cells = air.cells()
    if len(cells) < COUNT:
        return paper_viewpoints(scene)
    parts = [cells]
    while len(parts) < COUNT:
        parts = [half for part in parts for half in _halves(part, aligned)]
    nearest = np.argmin(distance.cdist([part.mean(axis=0) for part in parts], cells), axis=1)
    return cells[nearest] @ rotation_matrix(angle).T


def _halves(cells: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Divide cells (M, 3) in two, across the direction in which they vary most."""
    spread = cells.var(axis=0)
    spread[_long(scene)] *= LONGER
    order = _order(cells, scene, int(np.argmax(spread)))
    return cells[order[:len(cells) // 2]], cells[order[len(cells) // 2:]]


def _long(scene: Scene) -> int:
    """Return the axis, x or y, along which a room is longer."""
    return int(scene.size[1] > scene.size[0])


def _order(cells: np.ndarray, scene: Scene, first: int) -> np.ndarray:
    """
    Order cells (M, 3) as they are in a mirrored room: on each axis from the emptier end on.

    :param first: the axis by which they are ordered first; then it is the longer one.
    """
    middle = scene.bounds.mean(axis=0)
    ends = np.where(scene.points.mean(axis=0) < middle, -1.0, 1.0)
    keys = ((cells - middle) * ends).round(ROUNDED)
    long = _long(scene)
    axes = [first, long, 1 - long, 2]
    return np.lexsort(keys.T[axes[::-1]])


def paper_viewpoints(scene: Scene) -> np.ndarray:
    """Place the five of the paper in the rectangle along the walls; in a box it is the room's."""
    angle = wall_direction(scene)
    axes = rotation_matrix(-angle)[:2, :2]
    low, high = corners_of(scene.points[:, :2] @ axes.T)
    corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
    return five_viewpoints(corners @ axes, float(scene.bounds[:, 2].mean()))


def wall_direction(scene: Scene) -> float:
    """Return the angle of most of the walls to the x axis: radians, from 0 to a right angle."""
    normals = scene.normals_or_estimate
    steep = np.abs(normals[:, 2]) <= STEEP
    if not steep.any():
        return 0.0
    angles = np.rad2deg(np.arctan2(normals[steep, 1], normals[steep, 0])) % 90.0
    count = round(90.0 / BIN)
    bins = np.round(angles / BIN).astype(int) % count
    area = scene.pitch[steep].astype(np.float64) ** 2
    areas = np.bincount(bins, area, count)
    # Neighbouring bins share a wall, across 90 degrees as well.
    best = np.argmax(areas + np.roll(areas, 1) + np.roll(areas, -1))
    off = (angles - best * BIN + 45.0) % 90.0 - 45.0
    near = np.abs(off) <= 1.5 * BIN
    return float(np.deg2rad(best * BIN + np.average(off[near], weights=area[near])))
