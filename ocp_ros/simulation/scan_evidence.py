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
What a scan proves: the scanned side of each surface, and the space that the scanner saw through.

Points block views and are visible from both sides, and nothing blocks a view where a back was not
scanned. So a camera behind a cabinet seems to see the inside of its front, and what is beyond. A
view counts as proved if it meets each surface from a scanned side, stays in space that rays of the
scanner have crossed, and passes the edges of surfaces on a finer map. Where the stations of the
scanner are not known, nothing is proved from a place around which much was not scanned, such as an
aisle that it did not look into. A search uses all views, and what a placement promises the proved
ones.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, LEVEL, Pose
from ocp_ros.geometry.depth_error import unscanned_share
from ocp_ros.geometry.packed_bits import no_bits, unpack
from ocp_ros.geometry.visibility import FINE, SurfelVisibility
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.structure import Air, floor_height
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.kernels import njit
from ocp_ros.util.threads import mapped
from scipy import ndimage
from scipy.spatial import cKDTree

#: Metres: the least edge of a cell of space. Cells are not narrower than the median pitch of the
#: points, since the rays to neighbouring points are as far apart.
CELL_M = 0.1
#: Metres: the way through unknown space that is still taken for free.
MAX_UNKNOWN_M = 0.4
#: Metres: the height of a scanner whose place is not known, and the distance of such places.
STATION_HEIGHT_M, STATION_SPACING_M = 1.5, 0.7
#: The least share of all points that a further station has to add, and the largest share that no
#: station sees if they are found.
MIN_ADDED_SHARE, MAX_UNSEEN_SHARE = 0.005, 0.05
#: Metres: less than the thickness of a board.
OTHER_SIDE_M = 0.015
#: Metres: the distance behind a surface at which there is air, or something that it stands at.
BEHIND_M = 0.3
#: By how much more of the directions from a camera may be without a scanned point than from a
#: station in the middle of all, and the rows of the maps for this.
MAX_UNSCANNED, UNSCANNED_ROWS = 0.2, 64
#: The rules of the finer maps.
FINER = FINE._replace(rows=320)


@dataclass(frozen=True, eq=False)
class ScanEvidence:
    """
    What a scan proves about views; arrays are in the engine's order of points.

    :ivar scene: the scan.
    :ivar visibility: that of the engine for the scene, by the rules of the finer maps.
    :ivar stations: (T, 3) metres, where the scanner stood, or may have stood.
    :ivar are_known: whether the file tells the stations, and which points each of them has.
    :ivar points: (N, 3) float32, metres.
    :ivar normals: (N, 3) float32 unit vectors.
    :ivar sides: (N,) int8, 1 or -1 for the side of the normal or the other one if the surface was
        seen from there only, else 0.
    :ivar low: (3,) metres, the corner of the first cell.
    :ivar edge: metres, that of a cell.
    :ivar is_crossed: (X, Y, Z) bool, the cells that rays of the scanner have crossed.
    """

    scene: Scene
    visibility: SurfelVisibility
    stations: np.ndarray
    are_known: bool
    points: np.ndarray
    normals: np.ndarray
    sides: np.ndarray
    low: np.ndarray
    edge: float
    is_crossed: np.ndarray

    @classmethod
    def of(cls, scene: Scene, visibility: object) -> 'ScanEvidence | None':
        """
        Find what a scan proves.

        :param visibility: that of the engine for the scene.
        :returns: None for rays at a mesh and for cubes, whose views are taken as they are. If a
            scan has no stations, and a few places at the height of a tripod do not explain it, as
            of one from hand, all space counts as crossed and all sides as scanned.
        """
        if not isinstance(visibility, SurfelVisibility):
            return None
        known = _known_stations(scene, visibility)
        stations, seen = known or _likely_stations(scene, visibility)
        order = visibility.order
        points, normals = scene.points[order], scene.normals_or_estimate[order]
        edge = max(CELL_M, float(np.median(scene.pitch)))
        low = scene.bounds[0] - edge
        is_crossed = np.full(np.ceil(scene.size / edge + 2.0).astype(int), len(stations) == 0)
        for station, own in zip(stations, seen):
            cross_cells(station, points[own].astype(np.float64), low, edge, is_crossed)
        return cls(scene, visibility.by(FINER), stations, known is not None, points, normals,
                   _sides_seen(points, normals, stations, seen), low, edge, is_crossed)

    def proved(self, seen: np.ndarray, position: np.ndarray | None, finer: bool = True
               ) -> np.ndarray:
        """
        Return the visible points whose views are proved, as packed bits: (W,) uint64.

        :param seen: (W,) uint64, packed bits of the points that a camera sees.
        :param position: (3,) metres, of the camera; None for several cameras, whose views are
            taken as they are.
        :param finer: whether to look at a finer map, which takes most of the time.
        """
        if position is None:
            return seen
        if finer:
            seen = seen & self._seen_well(np.asarray(position, dtype=np.float64).tobytes())
        return proved_bits(seen, np.asarray(position, dtype=np.float64), self.points,
                           self.normals, self.sides, self.low, self.edge, self.is_crossed,
                           MAX_UNKNOWN_M)

    def unscanned_share(self, chosen: np.ndarray, air: Air) -> float | None:
        """
        Return the share of a surface that was not scanned, about or more: the backs of its points.

        The back of a point that was scanned from one side counts if there is free space behind the
        point, and no surface that was scanned from there. Hidden parts without a scanned other
        side are left out.

        :param chosen: (N,) bool, the points of the surface.
        :param air: that of the room.
        :returns: the area of the backs as a share of that of points and backs; None if it is not
            known from where the scan was made.
        """
        if len(self.stations) == 0:
            return None
        # At most 256 points, spread evenly, are tried, so that the time is bounded.
        rows = np.flatnonzero(chosen)
        rows = rows[::-(-len(rows) // 256)]
        points, inward = self.points[rows], -self.sides[rows, None] * self.normals[rows]
        near = np.flatnonzero(((self.points > points.min(axis=0) - BEHIND_M)
                               & (self.points < points.max(axis=0) + BEHIND_M)).all(axis=1))
        radius = max(CELL_M, 2.0 * float(np.median(self.scene.pitch)))
        # Surfaces pass through crossed cells beside others.
        is_open = ndimage.binary_erosion(self.is_crossed)
        low, high = self.scene.bounds
        is_back = np.zeros(len(rows), dtype=bool)
        for k in np.flatnonzero(self.sides[rows]):
            # Behind the whole surface is air, unless it stands at a wall or on a floor.
            depth = float(((points - points[k]) @ inward[k]).max())
            ways = np.append(np.arange(2.0 * self.edge, depth, self.edge), depth + BEHIND_M)
            places = points[k] + ways[:, None] * inward[k]
            cells = np.floor((places[:-1] - self.low) / self.edge).astype(int)
            is_free = np.append(
                is_open[tuple(np.clip(cells, 0, np.array(is_open.shape) - 1).T)],
                ~air.closed(places[-1:]) & ((places[-1] > low) & (places[-1] < high)).all())
            offsets = self.points[near] - points[k]
            along, facing = offsets @ inward[k], self.normals[near] @ inward[k]
            # Scanned surfaces on the way that look along it.
            is_other = (along > -0.02) & (along < ways[is_free.argmax()]) & (
                (offsets ** 2).sum(axis=1) < along ** 2 + radius ** 2) & np.where(
                self.sides[near] == 0, (abs(facing) > 0.5) & (along > 0.05),
                self.sides[near] * facing > 0.5)
            is_back[k] = is_free.any() and not is_other.any()
        areas = self.scene.pitch[self.visibility.order][rows] ** 2
        hidden = areas[is_back].sum()
        return float(hidden / (areas.sum() + hidden))

    @cached_property
    def _seen_well(self) -> Callable[[bytes], np.ndarray]:
        """Return what finds the points that are visible from a position on a finer map."""
        # Known stations prove more about a view than what is around it.
        usual = 1.0 if self.are_known or not len(self.stations) else np.median(
            [self._unscanned(station) for station in self.stations])

        def seen_well(position: bytes) -> np.ndarray:
            seen, place = no_bits(len(self.points)), np.frombuffer(position)
            if usual == 1.0 or self._unscanned(place) <= usual + MAX_UNSCANNED:
                self.visibility.look(Pose(place, LEVEL),
                                     CameraModel(0.0, self.scene.diameter).lens, seen)
            return seen
        return lru_cache(maxsize=256)(seen_well)

    def _unscanned(self, place: np.ndarray) -> float:
        """Return the share of directions without a scanned point from a place (3,)."""
        return unscanned_share(self.points, self.scene.spacing[self.visibility.order], place,
                               self.scene.diameter, UNSCANNED_ROWS)


def only_sides(scene: Scene, visibility: SurfelVisibility) -> np.ndarray:
    """
    Return the only side that can have been scanned of each point.

    :param scene: the scan.
    :param visibility: that of its points.
    :returns: (N,) int8, in the order of the scan: 1 or -1 for the side of the normal or the other
        one if the scans at their stations, or all places where a scanner can stand, see the point
        from there only; else 0.
    """
    known = _known_stations(scene, visibility)
    if known is None:
        places = _places_of(scene)
        known = places, _seen_from_all(scene, visibility, places)
    order, sides = visibility.order, np.empty(len(scene), dtype=np.int8)
    sides[order] = _sides_seen(scene.points[order], scene.normals_or_estimate[order], *known)
    return sides


def _sides_seen(points: np.ndarray, normals: np.ndarray, places: np.ndarray, seen: np.ndarray
                ) -> np.ndarray:
    """
    Return the sides of points that are seen.

    :param places: (T, 3) metres.
    :param seen: (T, N) bool, which points are seen from each.
    :returns: (N,) int8, 1 for the side of the normal, -1 for the other one; 0 for both or none.
    """
    is_seen = np.zeros((2, len(points)), dtype=bool)
    for place, own in zip(places, seen):
        offsets = place - points
        cosine = (offsets * normals).sum(axis=1) / np.linalg.norm(offsets, axis=1)
        min_cosine = 0.05
        is_seen |= own & (np.stack([cosine, -cosine]) > min_cosine)
    return is_seen[0].astype(np.int8) - is_seen[1]


def _known_stations(scene: Scene, visibility: SurfelVisibility
                    ) -> tuple[np.ndarray, np.ndarray] | None:
    """
    Return the stations of a file, (T, 3) metres, and which points their scans have: (T, N) bool.

    They count if they see nearly all points; a file of merged scans has the origin as its only
    station.
    """
    if not scene.scans:
        return None
    stations = np.array([scan.station for scan in scene.scans])
    is_seen = _seen_from_all(scene, visibility, stations).any(axis=0)
    if np.mean(~is_seen) > MAX_UNSEEN_SHARE:
        return None
    return stations, _scanned_by(scene)[:, visibility.order]


def _likely_stations(scene: Scene, visibility: SurfelVisibility
                     ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return likely stations of a scan, (T, 3) metres, and which points each sees: (T, N) bool.

    They are chosen one after the other, each of a grid of places that sees most of the points that
    the others do not see; none if the places explain too few of the points.
    """
    places, none = _places_of(scene), (np.empty((0, 3)), np.empty((0, len(scene)), dtype=bool))
    if len(places) == 0:
        return none
    seen = _seen_from_all(scene, visibility, places)
    chosen, left = [], np.ones(len(scene), dtype=bool)
    while True:
        added = np.count_nonzero(seen[:, left], axis=1)
        best = int(np.argmax(added))
        if added[best] < MIN_ADDED_SHARE * len(scene):
            break
        chosen.append(best)
        left &= ~seen[best]
    return (places[chosen], seen[chosen]) if left.mean() <= MAX_UNSEEN_SHARE else none


def _scanned_by(scene: Scene) -> np.ndarray:
    """Return which points each scan has, (T, N) bool: about as near as those of any scan."""
    distances = np.stack([cKDTree(scan.points).query(scene.points)[0] for scan in scene.scans])
    return distances <= np.maximum(OTHER_SIDE_M, 1.5 * distances.min(axis=0))


def _places_of(scene: Scene) -> np.ndarray:
    """Return a grid of at most 400 places in free air where a scanner can stand, (T, 3) metres."""
    height = floor_height(scene) + STATION_HEIGHT_M
    cells = Air(scene, FreePlane.of(scene.points, height, 1, 0.0, clearance=0.3)).cells(height)
    spacing = max(STATION_SPACING_M, float(np.sqrt(np.prod(scene.size[:2]) / 400.0)))
    _, first = np.unique(np.floor(cells[:, :2] / spacing).astype(int), axis=0, return_index=True)
    return cells[first]


def _seen_from_all(scene: Scene, visibility: SurfelVisibility, places: np.ndarray) -> np.ndarray:
    """Return which points a scanner at each place sees: (T, N) bool, in the engine's order."""
    def seen_from(place: np.ndarray) -> np.ndarray:
        seen = no_bits(len(scene))
        visibility.look(Pose(np.asarray(place, dtype=np.float64), LEVEL),
                        CameraModel(0.0, scene.diameter).lens, seen)
        return unpack(seen, len(scene))
    return np.array(mapped(seen_from, list(places)), dtype=bool).reshape(len(places), len(scene))


@njit(cache=True, nogil=True)
def cross_cells(station, points, low, edge, is_crossed):
    """
    Mark the cells that the rays from a station to points cross.

    The last cell before a point is left out, since a surface and its back share it.

    :param station: (3,) metres.
    :param points: (N, 3) metres.
    :param low: (3,) metres, the corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param is_crossed: (X, Y, Z) bool, in and out.
    """
    for k in range(len(points)):
        offset = points[k] - station
        length = np.sqrt((offset ** 2).sum())
        # Two places in each cell.
        for step in range(int(2.0 * (length - edge) / edge)):
            share = 0.5 * edge * step / length
            x, y, z = _cell(station, offset, share, low, edge)
            if (0 <= x < is_crossed.shape[0] and 0 <= y < is_crossed.shape[1]
                    and 0 <= z < is_crossed.shape[2]):
                is_crossed[x, y, z] = True


@njit(cache=True, nogil=True, inline='always')
def _cell(start, offset, share, low, edge):
    """Return the cell of a share of the way from a start (3,) along an offset (3,), metres."""
    return (int(np.floor((start[0] + share * offset[0] - low[0]) / edge)),
            int(np.floor((start[1] + share * offset[1] - low[1]) / edge)),
            int(np.floor((start[2] + share * offset[2] - low[2]) / edge)))


@njit(cache=True, nogil=True)
def proved_bits(seen, position, points, normals, sides, low, edge, is_crossed, max_unknown):
    """
    Return those of the visible points whose view a scan proves.

    The view is from a side of the surface that the scanner has seen, and crosses little space that
    none of its rays has crossed.

    :param seen: (W,) uint64, packed bits of the visible points.
    :param position: (3,) metres, of the camera.
    :param points: (N, 3) metres, in the order of the bits, as ``normals`` and ``sides``.
    :param normals: (N, 3) unit vectors of either sign.
    :param sides: (N,) int8, 1 or -1 for a surface that was seen only from the side of its normal
        or from the other one, and 0 if that is not known, or from both.
    :param low: (3,) metres, the corner of the first cell.
    :param edge: the edge of a cell, metres.
    :param is_crossed: (X, Y, Z) bool, the cells that rays of the scanner have crossed.
    :param max_unknown: the largest length of the way through other cells, metres.
    :returns: (W,) uint64.
    """
    kept = seen.copy()
    # The least cosine between ray and surface for which its side is sure.
    min_cosine = 0.03
    for k in range(len(points)):
        word, bit = k >> 6, np.uint64(1) << np.uint64(k & 63)
        if not seen[word] & bit:
            continue
        offset = points[k].astype(np.float64) - position
        length = np.sqrt((offset ** 2).sum())
        cosine = -(offset * normals[k]).sum() / max(length, 1e-9)
        is_proved = sides[k] * cosine >= -min_cosine
        unknown = 0.0
        # The cells next to the surface are known by its point.
        for step in range(int(2.0 * (length - 1.5 * edge) / edge)):
            if not is_proved:
                break
            x, y, z = _cell(position, offset, 0.5 * edge * step / length, low, edge)
            if (0 <= x < is_crossed.shape[0] and 0 <= y < is_crossed.shape[1]
                    and 0 <= z < is_crossed.shape[2] and not is_crossed[x, y, z]):
                unknown += 0.5 * edge
                is_proved = unknown <= max_unknown
        if not is_proved:
            kept[word] &= ~bit
    return kept
