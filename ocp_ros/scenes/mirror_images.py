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
Mirror images in a scan: a room that a laser has seen in a mirror stands behind its wall.

Behind the plane of a wall with a mirror there are points, each of which has one at the mirrored
place before it. Next to the wall there are few: a mirror is smaller than its wall. A real second
room has its floor and walls there, even where it is the same room the other way round.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from ocp_ros.geometry.normals import LEVEL, STEEP
from ocp_ros.scenes.scene import MIN_POINTS, Scene
from scipy.spatial import cKDTree

#: Degrees and metres by which planes differ, how many are tried, and square metres that
#: one has at least.
TURN, APART, PLANES, LEAST = 2.0, 0.1, 24, 1.0
#: Metres behind a plane from which on points are behind it, up to which they are beside it, and
#: from which on half of them are; how many are beside it, as a share of those before it, but for
#: points with a normal like that of the plane.
BEHIND, BESIDE, DEEP, LESS, ALONG = 0.1, 0.4, 0.5, 0.6, 0.9
#: Points that are tried, and how near there is one before the plane: metres at least, and in
#: multiples of the spacing.
TRIED, NEAR, SPACINGS = 4000, 0.08, 1.5
#: Metres: where points are as far apart, mirror images look like a room.
SPARSE = 0.3
#: Metres that a mirror hangs before its wall.
HUNG = (0.0, 0.03, 0.06)
#: The fewest points that are not level.
FEWEST = 50
#: Share of the points behind a mirror that have one before it, and of all points that have to be
#: behind it.
MATCHED, SHARE = 0.85, 0.005


def without_mirror_images(scene: Scene) -> Scene:
    """Leave out what stands behind mirrors, with a note; the same scene where there is none."""
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
        # A passage to another half of the room begins with as much floor and wall on either side.
        across = kept & (np.abs(normals @ normal) < ALONG)
        sides = [np.count_nonzero(across & (side > BEHIND) & (side < BESIDE))
                 for side in (away, -away)]
        if sides[0] > LESS * sides[1]:
            continue
        # Floors and ceilings mirror themselves everywhere.
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
    """Yield the largest upright planes, each from both sides: unit normal (3,) and offset."""
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
