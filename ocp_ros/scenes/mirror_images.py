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

#: Degrees and metres between candidate planes, the largest number of planes tested, and the least
#: area of a plane in square metres.
TURN, APART, PLANES, LEAST = 2.0, 0.1, 24, 1.0
#: Metres: beyond ``BEHIND`` points are behind a plane, up to ``BESIDE`` they are near it, and the
#: median of those behind it has to lie beyond ``DEEP``. The largest ratio of near points behind to
#: near points in front; points whose normal has at least the last cosine to that of the plane do
#: not count.
BEHIND, BESIDE, DEEP, LESS, ALONG = 0.1, 0.4, 0.5, 0.6, 0.9
#: The largest number of points tested; the largest distance of a mirrored point from its
#: counterpart: metres at least, and in multiples of the spacing.
TRIED, NEAR, SPACINGS = 4000, 0.08, 1.5
#: Metres: with a larger match distance, mirror images look like a real room.
SPARSE = 0.3
#: Metres: the tested distances of a mirror from its wall.
HUNG = (0.0, 0.03, 0.06)
#: The least number of points with non-vertical normals.
FEWEST = 50
#: The least share of the points behind a mirror that have a counterpart, and the least share of
#: all points that are behind it.
MATCHED, SHARE = 0.85, 0.005


def without_mirror_images(scene: Scene) -> Scene:
    """Leave out the points behind mirrors, with a note; return the same scene if none."""
    points, normals = scene.points.astype(np.float64), scene.normals_or_estimate
    area = scene.pitch.astype(np.float64) ** 2
    near = max(NEAR, SPACINGS * float(np.median(scene.pitch)))
    if near > SPARSE:
        return scene
    kept = np.ones(len(points), dtype=bool)
    for normal, offset in _planes(points, normals, area):
        away = points @ normal - offset
        behind = kept & (away > BEHIND)
        count = np.count_nonzero(behind)
        if (not SHARE * len(points) <= count < 0.5 * len(points)
                or np.median(away[behind]) < DEEP):
            continue
        # A real passage has about as much floor and wall near the plane on both sides.
        across = kept & (np.abs(normals @ normal) < ALONG)
        sides = [np.count_nonzero(across & (side > BEHIND) & (side < BESIDE))
                 for side in (away, -away)]
        if sides[0] > LESS * sides[1]:
            continue
        # Floors and ceilings match their mirror images everywhere, so they are excluded.
        some = np.flatnonzero(behind & (np.abs(normals[:, 2]) < LEVEL))
        some = some[np.random.default_rng(0).permutation(len(some))[:TRIED]]
        if len(some) < FEWEST:
            continue
        before = cKDTree(points[kept & (away <= BEHIND)])
        for hung in HUNG:
            mirrored = points[some] - 2.0 * (away[some, None] + hung) * normal
            if (before.query(mirrored, distance_upper_bound=near)[0] <= near).mean() >= MATCHED:
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
    bins = np.round(angle / TURN).astype(int) % round(180.0 / TURN)
    turns = np.deg2rad(TURN * bins)
    offset = points[steep, 0] * np.cos(turns) + points[steep, 1] * np.sin(turns)
    cells, place = np.unique(np.stack([bins, np.floor(offset / APART).astype(int)], axis=1),
                             axis=0, return_inverse=True)
    areas = np.bincount(place, area[steep], len(cells))
    for cell in np.argsort(-areas, kind='stable')[:PLANES]:
        if areas[cell] < LEAST:
            return
        own = steep[place == cell]
        turn, flat = turns[place == cell][0], normals[own, :2]
        flat = flat * np.sign(flat @ [np.cos(turn), np.sin(turn)])[:, None]
        way = np.append(np.average(flat, axis=0, weights=area[own]), 0.0)
        way /= np.linalg.norm(way)
        middle = float(np.median(points[own] @ way))
        yield way, middle
        yield -way, -middle
