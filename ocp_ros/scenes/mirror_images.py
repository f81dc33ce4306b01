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
Mirror images in a scan: a laser beam that hits a mirror yields points behind the wall.

Behind the plane of a wall with a mirror, each point has a counterpart at the mirrored position in
front of the plane. Near the wall there are few such points, since a mirror is smaller than its
wall. A real second room has its floor and walls there, even if it is the same room mirrored.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from ocp_ros.geometry.normals import LEVEL, STEEP
from ocp_ros.scenes.scene import MIN_POINTS, Scene
from scipy.spatial import cKDTree


def without_mirror_images(scene: Scene) -> Scene:
    """Leave out the points behind mirrors, with a note; return the same scene if none."""
    points, normals = scene.points.astype(np.float64), scene.normals_or_estimate
    area = scene.pitch.astype(np.float64) ** 2
    # The largest distance of a mirrored point from its counterpart, metres.
    near = max(0.08, 1.5 * float(np.median(scene.pitch)))
    # With a larger match distance, mirror images look like a real room.
    if near > 0.3:
        return scene
    kept = np.ones(len(points), dtype=bool)
    # A point farther behind a plane than this counts as behind it.
    behind_m = 0.1
    for normal, offset in _planes(points, normals, area):
        away = points @ normal - offset
        behind = kept & (away > behind_m)
        count = np.count_nonzero(behind)
        if (not 0.005 * len(points) <= count < 0.5 * len(points)
                or np.median(away[behind]) < 0.5):
            # Too few points are behind the plane, or they are too near to it.
            continue
        # A real passage has about as much floor and wall within 0.4 m of the plane on both sides.
        across = kept & (np.abs(normals @ normal) < 0.9)
        sides = [np.count_nonzero(across & (side > behind_m) & (side < 0.4))
                 for side in (away, -away)]
        if sides[0] > 0.6 * sides[1]:
            continue
        # Floors and ceilings match their mirror images everywhere, so they are excluded.
        some = np.flatnonzero(behind & (np.abs(normals[:, 2]) < LEVEL))
        some = some[np.random.default_rng(0).permutation(len(some))[:4000]]
        if len(some) < 50:
            continue
        before = cKDTree(points[kept & (away <= behind_m)])
        # Metres from a wall to a mirror on it.
        for hung in (0.0, 0.03, 0.06):
            mirrored = points[some] - 2.0 * (away[some, None] + hung) * normal
            if (before.query(mirrored, distance_upper_bound=near)[0] <= near).mean() >= 0.85:
                kept &= ~behind
                break
    left_out = len(points) - np.count_nonzero(kept)
    if left_out == 0 or len(points) - left_out < MIN_POINTS:
        return scene
    note = (f'found {left_out:,} points behind a wall that mirror the room before it; expected no '
            'mirror image; they are left out: cover mirrors when you scan')
    return replace(scene.only(kept), notes=(*scene.notes, note))


def _planes(points: np.ndarray, normals: np.ndarray, area: np.ndarray
            ) -> Iterator[tuple[np.ndarray, float]]:
    """Yield the largest vertical planes, each from both sides: unit normal (3,) and offset."""
    steep = np.flatnonzero(np.abs(normals[:, 2]) <= STEEP)
    angle = np.rad2deg(np.arctan2(normals[steep, 1], normals[steep, 0])) % 180.0
    turn_deg = 2.0
    bins = np.round(angle / turn_deg).astype(int) % round(180.0 / turn_deg)
    turns = np.deg2rad(turn_deg * bins)
    offset = points[steep, 0] * np.cos(turns) + points[steep, 1] * np.sin(turns)
    # Candidate planes are 10 cm apart.
    cells, place = np.unique(np.stack([bins, np.floor(offset / 0.1).astype(int)], axis=1),
                             axis=0, return_inverse=True)
    areas = np.bincount(place, area[steep], len(cells))
    # The 24 largest planes of at least 1 m2 are tested.
    for cell in np.argsort(-areas, kind='stable')[:24]:
        if areas[cell] < 1.0:
            return
        own = steep[place == cell]
        turn, flat = turns[place == cell][0], normals[own, :2]
        flat = flat * np.sign(flat @ [np.cos(turn), np.sin(turn)])[:, None]
        way = np.append(np.average(flat, axis=0, weights=area[own]), 0.0)
        way /= np.linalg.norm(way)
        middle = float(np.median(points[own] @ way))
        yield way, middle
        yield -way, -middle
