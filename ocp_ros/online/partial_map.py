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
Partial map: visibility and depth error on the observed cloud, and the space not covered yet.

It is the only model of the room that online planners and policies use.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Frustum, OMNIDIRECTIONAL, Pose
from ocp_ros.geometry.clouds import cell_numbers, cells_numbered, fixed_size
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.packed_bits import count_bits, no_bits, pack, unpack
from ocp_ros.geometry.surfels import SurfelSettings
from ocp_ros.geometry.visibility import FAST, SurfelVisibility
from ocp_ros.geometry.voxels import thinned_to
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.simulator import clipped, View
from ocp_ros.simulation.viewpoints import observed_viewpoints
from scipy.spatial import ConvexHull, QhullError

#: Edge of the cells of the air, metres. The grid is anchored to the origin of the map frame, so
#: the cells stay the same while the observed bounding box grows.
CELL_M = 0.5
#: Largest number of cells of the air: if there are more, their edge is doubled.
MAX_CELLS = 20_000
#: Number of a place that is not a cell.
NO_CELL = -1
#: Input points per output point: of a denser cloud, points are dropped before the slow voxel
#: thinning.
DENSE_POINTS = 4
#: Growth of the cloud, as a share, after which a cached model is replaced.
GROWTH = 0.01
#: Largest number of cached views of a model: planners try the same poses again in later steps.
MAX_VIEWS = 4096
#: Bonus for covering all unseen cells at the start, in multiples of the depth error without any
#: visible point.
CURIOSITY = 2.0
#: Share of the episode after which the bonus is 0.
EXPLORING_SHARE = 0.55
#: Range of the test whether a corner of the room is visible, metres.
TEST_RANGE_M = 100.0
#: Number of cameras that test each corner.
TEST_CAMERAS = 2
#: Distance of the test place from a corner of the room, metres.
INSET_M = 0.3
#: A side of the box that the corners move by at most this is not changed, metres.
SAME_M = 0.05


class PartialMap:
    """
    Visibility and depth error on the observed cloud, and the cells of the air in its bounding box.

    The viewpoints of the depth error are spread over the observed floor, see
    :func:`~ocp_ros.simulation.viewpoints.observed_viewpoints`. The bounding box includes a corner
    of the :func:`smallest_rectangle` around the points if one of the two nearest cameras sees into
    it without occlusion by observed points. So unseen corners of the room count as air, but not
    the corner outside an L-shaped room, which is behind walls.

    :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
    :param positions: (K, 3) metres: current positions of the cameras.
    :param max_range: of the cameras, metres.
    :param most: a larger cloud is thinned to at most this number of points.
    :param rows: of the depth maps of the error.
    :param settings: rules of visibility.
    :param around: cells within this horizontal distance from a camera count too, metres: a camera
        with a frustum does not observe the air behind it.
    :ivar points: (N, 3) float32, metres, in the order of the bits of a view.
    :ivar cells: (C,) int64, the number of each cell, in the order of the bits of a view.
    :ivar edge: of the cells, metres.
    :raises SceneError: if the points are too few or too flat to be a room.
    """

    def __init__(self, cloud: np.ndarray, positions: np.ndarray, max_range: float, most: int,
                 rows: int, settings: SurfelSettings = FAST, around: float = 0.0) -> None:
        scene = Scene(thinned(cloud, most), 'observed cloud')
        corners = smallest_rectangle(scene.points[:, :2])
        box = with_corners(scene.bounds, corners)
        if around:
            box = with_corners(box, positions[:, :2] - around)
            box = with_corners(box, positions[:, :2] + around)
        centres, numbers, self.edge = cells_of_the_air(box)
        self._lens = CameraModel(max_range=max_range).lens
        tests = np.column_stack([inset(corners), np.full(4, np.median(positions[:, 2]))])
        self.visibility = SurfelVisibility(
            scene.points, scene.normals_or_estimate, scene.pitch,
            np.concatenate([centres, tests.astype(np.float32)]), settings)
        bounds = with_corners(scene.bounds, corners[self._open(tests, positions)])
        self.bounds = bounds
        inside = ((centres >= bounds[0]) & (centres <= bounds[1])).all(axis=1)
        if around:
            away = np.linalg.norm(centres[:, None, :2] - positions[None, :, :2], axis=2)
            inside |= away.min(axis=1) <= around
        order, places = self.visibility.order, self.visibility.place_order
        self.points = scene.points[order]
        self.cells = np.append(np.where(inside, numbers, NO_CELL), [NO_CELL] * 4)[places]
        self._views: dict[tuple[bytes, Frustum | None], View] = {}
        self._scene, self._corners, self._rows = scene, corners, rows

    @cached_property
    def depth_error(self) -> DepthError:
        """Return the depth error; it is computed when it is first needed."""
        scene = self._scene
        return DepthError(self.points, scene.spacing[self.visibility.order], scene.diameter,
                          observed_viewpoints(scene.points, self._corners), self._rows)

    def _open(self, tests: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Return which of the four test places, listed last, a camera near each of them sees."""
        places = self.visibility.place_order
        lens, found = CameraModel(max_range=TEST_RANGE_M).lens, np.zeros(4, dtype=bool)
        away = np.linalg.norm(tests[:, None] - positions[None], axis=2)
        near = np.argsort(away, axis=1)[:, :TEST_CAMERAS]
        for camera in np.unique(near):
            view = self.together([])
            self.visibility.look(Pose.of(positions[camera]), lens, view.seen, view.covered)
            seen = np.empty(len(places), dtype=bool)
            seen[places] = unpack(view.covered, len(places))
            found |= seen[-4:] & (near == camera).any(axis=1)
        return found

    def look(self, camera: np.ndarray, lens: Frustum | None = None) -> View:
        """
        Compute the view of a camera in this model; it is cached, do not change it.

        :param camera: (3,) x, y, z in metres, or (6,) with yaw, pitch and roll in radians.
        :param lens: frustum of the camera; None for an omnidirectional camera.
        """
        key = np.asarray(camera, dtype=np.float64).tobytes(), lens
        if key in self._views:
            return self._views[key]
        view = self.together([])
        self.visibility.look(Pose.of(camera), self._lens if lens is None else lens,
                             view.seen, view.covered)
        if len(self._views) >= MAX_VIEWS:
            self._views = {}
        self._views[key] = view
        return view

    def look_many(self, position: np.ndarray, headings: np.ndarray, lens: Frustum | None
                  ) -> list[View]:
        """
        Compute the views of a camera at one position with many headings.

        :param position: (3,) metres.
        :param headings: (H, 3) yaw, pitch and roll in radians.
        :param lens: frustum of the camera; None for an omnidirectional camera.
        """
        around = self.look(position, lens and lens._replace(kind=OMNIDIRECTIONAL))
        if lens is None or lens.kind == OMNIDIRECTIONAL:
            return [around] * len(headings)
        poses = np.hstack([np.broadcast_to(position, headings.shape), headings])
        return clipped(self.visibility, around, poses, lens)

    def follow(self, settings: SurfelSettings) -> None:
        """Change the rules of visibility; views by other rules are removed from the cache."""
        if self.visibility.settings != settings:
            self.visibility, self._views = self.visibility.by(settings), {}

    def together(self, views: Sequence[View]) -> View:
        """Return the union of some views; an empty view if there are none."""
        places = self.visibility.place_order
        seen, covered = no_bits(len(self.visibility.order)), no_bits(len(places))
        for view in views:
            seen |= view.seen
            covered |= view.covered
        return View(seen, covered)

    def error(self, views: list[View], most: float = np.inf) -> float:
        """Return the depth error of some views together, metres; see :class:`DepthError`."""
        return self.depth_error(np.bitwise_or.reduce([view.seen for view in views]), most)

    def covered(self, cameras: np.ndarray, lenses: Sequence[Frustum | None] | None = None
                ) -> np.ndarray:
        """
        Return the numbers of the cells that cameras cover together; see :meth:`look`.

        :param cameras: (K, 3) or (K, 6), metres and radians.
        :param lenses: one for each camera; None for omnidirectional cameras.
        """
        lenses = [None] * len(cameras) if lenses is None else lenses
        bits = np.bitwise_or.reduce([
            self.look(camera, lens).covered for camera, lens in zip(cameras, lenses, strict=True)])
        return self.cells[unpack(bits, len(self.cells))]


class KeptModel:
    """
    Cache of the partial map and the feasible region, reused while the cloud hardly grows.

    To create both takes longer than to score some dozens of positions, and late in an episode the
    cloud hardly grows.

    :param max_range: of the cameras, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param most: see :class:`PartialMap`, as for ``rows`` and ``around``.
    :param rows: of the depth maps.
    :param around: metres.
    """

    def __init__(self, max_range: float, wall_margin: float, most: int, rows: int,
                 around: float = 0.0) -> None:
        self._max_range, self._wall_margin = max_range, wall_margin
        self._sizes, self._around = (most, rows), around
        #: The last partial map and feasible region, None before the first; then their numbers of
        #: points and cameras, and the height of the cameras.
        self.made: tuple[PartialMap, FreePlane] | None = None
        self._of = 0, 0, 0.0

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, settings: SurfelSettings,
                 clearance: float = CLEARANCE) -> tuple[PartialMap, FreePlane]:
        """Return the partial map with some rules and the feasible region; see :meth:`make`."""
        if self.made is None or not self.lasts(cloud, positions):
            self.make(cloud, positions, settings, clearance)
        self.made[0].follow(settings)
        return self.made

    def make(self, cloud: np.ndarray, positions: np.ndarray, settings: SurfelSettings,
             clearance: float = CLEARANCE) -> None:
        """
        Create the partial map and the feasible region.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param positions: (K, 3) metres: current positions of the cameras.
        :param settings: rules of visibility.
        :param clearance: cameras stay this far from all observed points, metres.
        :raises SceneError: if the points are too few or too flat to be a room.
        """
        height = float(np.median(positions[:, 2]))
        self.made = (PartialMap(cloud, positions, self._max_range, *self._sizes, settings,
                                self._around),
                     FreePlane.around(cloud, positions, self._wall_margin, clearance))
        self._of = len(cloud), len(positions), height

    def lasts(self, cloud: np.ndarray, positions: np.ndarray) -> bool:
        """Return whether the cached model is valid for a cloud and cameras; see :meth:`make`."""
        points, cameras, height = self._of
        return (points <= len(cloud) <= (1.0 + GROWTH) * points and cameras == len(positions)
                and height == float(np.median(positions[:, 2])))


class LookHistory:
    """The cells of the air that at least one camera has covered since the episode began."""

    def __init__(self) -> None:
        self._seen, self._edge = np.empty(0, dtype=np.int64), CELL_M
        self._visited: list[tuple[np.ndarray, Sequence[Frustum | None] | None]] = []

    def visit(self, cameras: np.ndarray, lenses: Sequence[Frustum | None] | None = None) -> None:
        """Record the poses of the cameras at a time step; see :meth:`PartialMap.covered`."""
        self._visited.append((cameras.copy(), lenses))

    def unseen(self, model: PartialMap) -> np.ndarray:
        """Return packed bits of the model's cells that no camera has covered so far."""
        self._follow(model.edge)
        covered = [model.covered(*visited) for visited in self._visited]
        self._seen = np.unique(np.concatenate([self._seen, *covered]))
        self._visited.clear()
        return pack(~np.isin(model.cells, self._seen) & (model.cells != NO_CELL))

    def _follow(self, edge: float) -> None:
        """Convert the covered cells to another edge: a larger cell counts if half of it does."""
        while self._edge < edge:
            cells = cells_numbered(self._seen) // 2
            numbers, parts = np.unique(cell_numbers(cells), return_counts=True)
            self._seen, self._edge = numbers[parts >= 4], 2.0 * self._edge
        if self._edge > edge:
            self._seen, self._edge = np.empty(0, dtype=np.int64), edge


def curiosity(time: float) -> float:
    """Return the bonus for all unseen cells, in multiples of the error without visible points."""
    return CURIOSITY * max(1.0 - time / EXPLORING_SHARE, 0.0)


def cell_weight(model: PartialMap, unseen: np.ndarray, turn: int, turns: int) -> float:
    """Return the bonus for covering one of a model's unseen cells, metres of depth error."""
    return curiosity(turn / turns) * model.depth_error.worst / max(int(count_bits(unseen)), 1)


def thinned(cloud: np.ndarray, most: int) -> np.ndarray:
    """Return at most ``most`` points of a cloud (M, 3), evenly spread if it has more."""
    if len(cloud) > DENSE_POINTS * most:
        cloud = fixed_size(cloud, DENSE_POINTS * most)
    return thinned_to(cloud, most)


def cells_of_the_air(bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """
    List the cells of a grid whose centres are inside a bounding box.

    :param bounds: (2, 3) metres.
    :returns: centres (C, 3) float32, metres; numbers (C,) int64 of the cells, the same in every
        bounding box with the same edge; and the edge, metres.
    """
    edge = CELL_M
    while np.prod(np.ptp(bounds, axis=0) / edge) > MAX_CELLS:
        edge *= 2.0
    first = np.ceil(bounds[0] / edge - 0.5).astype(np.int64)
    last = np.floor(bounds[1] / edge - 0.5).astype(np.int64)
    axes = [np.arange(first[k], last[k] + 1) for k in range(3)]
    index = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    return ((index + 0.5) * edge).astype(np.float32), cell_numbers(index), edge


def smallest_rectangle(points: np.ndarray) -> np.ndarray:
    """
    Find the rectangle of smallest area around points: most rooms have right angles.

    One of its sides lies on a side of the convex hull (Freeman and Shapira, 1975).

    :param points: (N, 2).
    :returns: (4, 2) corners of the rectangle.
    :raises SceneError: if the points are on a line.
    """
    try:
        hull = points[ConvexHull(points).vertices].astype(np.float64)
    except QhullError as error:
        raise SceneError('observed cloud: found all points on a line, seen from above; expected '
                         'a room with volume') from error
    sides = np.roll(hull, -1, axis=0) - hull
    along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)
    spans = axes @ hull.T
    low, high = spans.min(axis=2), spans.max(axis=2)
    best = int(np.argmin(np.prod(high - low, axis=1)))
    ends = np.array([[x, y] for x in (low[best, 0], high[best, 0])
                     for y in (low[best, 1], high[best, 1])])
    return ends @ axes[best]


def inset(corners: np.ndarray) -> np.ndarray:
    """Return places ``INSET_M`` metres from the corners of a rectangle inwards: (4, 2) metres."""
    way = corners.mean(axis=0) - corners
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return corners + way * np.minimum(INSET_M / length, 1.0)


def with_corners(bounds: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return a box (2, 3), enlarged to contain some corners (C, 2), metres."""
    larger = bounds.copy()
    larger[0, :2] = np.minimum(bounds[0, :2], corners.min(axis=0, initial=np.inf))
    larger[1, :2] = np.maximum(bounds[1, :2], corners.max(axis=0, initial=-np.inf))
    return np.where(np.abs(larger - bounds) > SAME_M, larger, bounds)
