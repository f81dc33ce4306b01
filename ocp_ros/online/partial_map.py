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

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Frustum, OMNIDIRECTIONAL, Pose
from ocp_ros.geometry.clouds import cell_numbers, cells_numbered, fixed_size, thinned_to
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.packed_bits import count_bits, no_bits, pack, unpack
from ocp_ros.geometry.surfels import SurfelSettings
from ocp_ros.geometry.visibility import FAST, SurfelVisibility
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.simulator import clipped, View
from ocp_ros.simulation.viewpoints import observed_viewpoints
from scipy.spatial import ConvexHull, QhullError

#: Edge of the cells of the air, metres. The grid is anchored to the origin of the map frame, so
#: the cells stay the same while the observed bounding box grows.
CELL_M = 0.5
#: Number of a place that is not a cell.
NO_CELL = -1
#: Largest number of cached views of a model: planners try the same poses again in later steps.
MAX_VIEWS = 4096


class PartialMap:
    """
    Visibility and depth error on the observed cloud, and the cells of the air in its bounding box.

    The viewpoints of the depth error are spread over the observed floor, see
    :func:`~ocp_ros.simulation.viewpoints.observed_viewpoints`. The bounding box includes a corner
    of the :func:`smallest_rectangle` around the points if observed points do not hide this corner
    from one of the two nearest cameras. So unseen corners of the room count as air, but not the
    corner outside an L-shaped room, which is behind walls.

    :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
    :param positions: (K, 3) metres: current positions of the cameras.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param max_points: a larger cloud is thinned to at most this number of points.
    :param rows: number of rows of the error's depth maps.
    :param settings: rules of visibility.
    :param air_radius: cells within this horizontal distance from a camera count as air too,
        metres: a camera with a frustum does not observe the air behind it.
    :ivar visibility: computes which points and cells a camera sees.
    :ivar points: (N, 3) float32, metres, in the order of the bits of a view.
    :ivar cells: (C,) int64, the number of each cell, in the order of the bits of a view;
        ``NO_CELL`` for places outside the air.
    :ivar bounds: (2, 3) metres, the bounding box: lowest and highest x, y, z.
    :ivar edge: edge of the cells, metres.
    :raises SceneError: if the points are too few or too flat to be a room.
    """

    def __init__(self, cloud: np.ndarray, positions: np.ndarray, max_range: float,
                 max_points: int, rows: int, settings: SurfelSettings = FAST,
                 air_radius: float = 0.0) -> None:
        scene = Scene(thinned(cloud, max_points), 'observed cloud')
        corners = smallest_rectangle(scene.points[:, :2])
        # Cells in the largest possible box; those outside the final box become ``NO_CELL``.
        box = enlarged_box(scene.bounds, corners)
        if air_radius:
            box = enlarged_box(box, positions[:, :2] - air_radius)
            box = enlarged_box(box, positions[:, :2] + air_radius)
        centres, numbers, self.edge = cells_of_the_air(box)
        self._lens = CameraModel(max_range=max_range).lens
        # A corner counts as visible if a place inside of it is, at the height of the cameras.
        test_places = np.column_stack([
            moved_inwards(corners), np.full(4, np.median(positions[:, 2]))])
        self.visibility = SurfelVisibility(
            scene.points, scene.normals_or_estimate, scene.pitch,
            np.concatenate([centres, test_places.astype(np.float32)]), settings)
        visible_corners = corners[self._are_visible(test_places, positions)]
        self.bounds = bounds = enlarged_box(scene.bounds, visible_corners)
        is_air = ((centres >= bounds[0]) & (centres <= bounds[1])).all(axis=1)
        if air_radius:
            distances = np.linalg.norm(centres[:, None, :2] - positions[None, :, :2], axis=2)
            is_air |= distances.min(axis=1) <= air_radius
        self.points = scene.points[self.visibility.order]
        # The four test places follow the cells in the visibility, but are no cells.
        numbers = np.append(np.where(is_air, numbers, NO_CELL), [NO_CELL] * 4)
        self.cells = numbers[self.visibility.place_order]
        self._views: dict[tuple[bytes, Frustum | None], View] = {}
        self._scene = scene
        self._corners = corners
        self._rows = rows

    @cached_property
    def depth_error(self) -> DepthError:
        """Return the depth error; it is computed when it is first needed."""
        scene = self._scene
        return DepthError(self.points, scene.spacing[self.visibility.order], scene.diameter,
                          observed_viewpoints(scene.points, self._corners), self._rows)

    def _are_visible(self, test_places: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """
        Return whether one of the two nearest cameras sees each of four test places: (4,) bool.

        :param test_places: (4, 3) metres; in the visibility they follow the cells.
        :param positions: (K, 3) metres, of the cameras.
        """
        place_order = self.visibility.place_order
        # The range is larger than any room, so that it never hides a corner.
        lens = CameraModel(max_range=100.0).lens
        are_visible = np.zeros(4, dtype=bool)
        distances = np.linalg.norm(test_places[:, None] - positions[None], axis=2)
        nearest_cameras = np.argsort(distances, axis=1)[:, :2]
        for camera in np.unique(nearest_cameras):
            view = self.together([])
            self.visibility.look(Pose.of(positions[camera]), lens, view.seen, view.covered)
            # Back from the order of the bits to that of the places; the test places are last.
            covered = np.empty(len(place_order), dtype=bool)
            covered[place_order] = unpack(view.covered, len(place_order))
            are_visible |= covered[-4:] & (nearest_cameras == camera).any(axis=1)
        return are_visible

    def look(self, camera: np.ndarray, lens: Frustum | None = None) -> View:
        """
        Return the view of a camera in this model, computed once; do not change the result.

        :param camera: (3,) x, y, z in metres, or (6,) with yaw, pitch and roll in radians.
        :param lens: frustum of the camera; None for an omnidirectional camera.
        """
        key = np.asarray(camera, dtype=np.float64).tobytes(), lens
        if key in self._views:
            return self._views[key]
        view = self.together([])
        self.visibility.look(Pose.of(camera), lens or self._lens, view.seen, view.covered)
        if len(self._views) >= MAX_VIEWS:
            self._views = {}
        self._views[key] = view
        return view

    def look_many(self, position: np.ndarray, headings: np.ndarray, lens: Frustum | None
                  ) -> list[View]:
        """
        Return the views of a camera at one position with H headings, in their order.

        :param position: (3,) metres.
        :param headings: (H, 3) yaw, pitch and roll in radians.
        :param lens: frustum of the camera; None for an omnidirectional camera.
        """
        # Views of all headings are cut out of one omnidirectional view with the same range. A
        # ``lens`` of None stays None.
        full_view = self.look(position, lens and lens._replace(kind=OMNIDIRECTIONAL))
        if lens is None or lens.kind == OMNIDIRECTIONAL:
            return [full_view] * len(headings)
        poses = np.hstack([np.broadcast_to(position, headings.shape), headings])
        return clipped(self.visibility, full_view, poses, lens)

    def set_rules(self, settings: SurfelSettings) -> None:
        """Set the rules of visibility; views by other rules are removed from the cache."""
        if self.visibility.settings != settings:
            self.visibility = self.visibility.by(settings)
            self._views = {}

    def together(self, views: Sequence[View]) -> View:
        """Return the union of some views; an empty view if there are none."""
        seen = no_bits(len(self.visibility.order))
        covered = no_bits(len(self.visibility.place_order))
        for view in views:
            seen |= view.seen
            covered |= view.covered
        return View(seen, covered)

    def error(self, views: list[View]) -> float:
        """Return the depth error of some views together, metres; see :class:`DepthError`."""
        return self.depth_error(np.bitwise_or.reduce([view.seen for view in views]))

    def covered_cells(self, cameras: np.ndarray, lenses: Sequence[Frustum | None] | None = None
                      ) -> np.ndarray:
        """
        Return the numbers of the cells that K cameras cover together; see :meth:`look`.

        They include ``NO_CELL`` if the cameras cover a place outside the air.

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

    :param max_range: see :class:`PartialMap`, as for ``max_points``, ``rows``, ``air_radius``.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :ivar made: the last partial map and feasible region; None before the first ones.
    """

    def __init__(self, max_range: float, wall_margin: float, max_points: int, rows: int,
                 air_radius: float = 0.0) -> None:
        self._max_range, self._wall_margin = max_range, wall_margin
        self._max_points, self._rows = max_points, rows
        self._air_radius = air_radius
        self.made: tuple[PartialMap, FreePlane] | None = None
        #: For the last partial map: number of points, number of cameras, height of the cameras.
        self._made_for = 0, 0, 0.0

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, settings: SurfelSettings,
                 clearance: float = CLEARANCE) -> tuple[PartialMap, FreePlane]:
        """Return the partial map with given rules, and the feasible region; see :meth:`make`."""
        if self.made is None or not self.lasts(cloud, positions):
            self.make(cloud, positions, settings, clearance)
        self.made[0].set_rules(settings)
        return self.made

    def make(self, cloud: np.ndarray, positions: np.ndarray, settings: SurfelSettings,
             clearance: float = CLEARANCE,
             allowed: Callable[[np.ndarray], np.ndarray] | None = None) -> None:
        """
        Create the partial map and the feasible region, and store them in ``made``.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param positions: (K, 3) metres: current positions of the cameras.
        :param settings: rules of visibility.
        :param clearance: cameras stay this far from all observed points, metres.
        :param allowed: see :meth:`~ocp_ros.rig.free_plane.FreePlane.around`.
        :raises SceneError: if the points are too few or too flat to be a room.
        """
        height = float(np.median(positions[:, 2]))
        self.made = (PartialMap(cloud, positions, self._max_range, self._max_points, self._rows,
                                settings, self._air_radius),
                     FreePlane.around(cloud, positions, self._wall_margin, clearance, allowed))
        self._made_for = len(cloud), len(positions), height

    def lasts(self, cloud: np.ndarray, positions: np.ndarray) -> bool:
        """
        Return whether the cached model is valid for a cloud and cameras; see :meth:`make`.

        The cloud may have up to 1 % more points; number and height of the cameras must be equal.
        """
        points, cameras, height = self._made_for
        return (points <= len(cloud) <= 1.01 * points and cameras == len(positions)
                and height == float(np.median(positions[:, 2])))


class LookHistory:
    """The cells of the air that at least one camera has covered since the episode began."""

    def __init__(self) -> None:
        #: Numbers of the covered cells, ascending, for the last edge.
        self._covered = np.empty(0, dtype=np.int64)
        self._edge = CELL_M
        #: Poses and frusta of the cameras at turns whose views are not in ``_covered`` yet.
        self._visited: list[tuple[np.ndarray, Sequence[Frustum | None] | None]] = []

    def visit(self, cameras: np.ndarray, lenses: Sequence[Frustum | None] | None = None) -> None:
        """Record the cameras at a turn; parameters as in :meth:`PartialMap.covered_cells`."""
        self._visited.append((cameras.copy(), lenses))

    def unseen(self, model: PartialMap) -> np.ndarray:
        """Return packed bits of the model's cells that no camera has covered so far."""
        # The views since the last call are computed in this model.
        self._convert_to_edge(model.edge)
        covered = [model.covered_cells(*visited) for visited in self._visited]
        self._covered = np.unique(np.concatenate([self._covered, *covered]))
        self._visited.clear()
        return pack(~np.isin(model.cells, self._covered) & (model.cells != NO_CELL))

    def _convert_to_edge(self, edge: float) -> None:
        """Convert the covered cells to another edge; for a smaller edge discard them."""
        while self._edge < edge:
            cells = cells_numbered(self._covered) // 2
            numbers, counts = np.unique(cell_numbers(cells), return_counts=True)
            # A larger cell has eight smaller ones and counts as covered if half of them are.
            self._covered = numbers[counts >= 4]
            self._edge *= 2.0
        if self._edge > edge:
            self._covered = np.empty(0, dtype=np.int64)
            self._edge = edge


def exploration_bonus(elapsed_share: float) -> float:
    """
    Return the bonus for covering all unseen cells: 2 at the start, 0 after 55 % of the episode.

    :param elapsed_share: turns taken so far, divided by the turns of the episode.
    :returns: in multiples of the depth error without any visible point.
    """
    return 2.0 * max(1.0 - elapsed_share / 0.55, 0.0)


def cell_weight(model: PartialMap, unseen: np.ndarray, turn: int, turns: int) -> float:
    """
    Return the bonus for covering one of a model's unseen cells.

    :param unseen: packed bits of these cells.
    :param turn: turns taken so far, of ``turns`` turns.
    :returns: metres of depth error.
    """
    return (exploration_bonus(turn / turns) * model.depth_error.worst
            / max(int(count_bits(unseen)), 1))


def thinned(cloud: np.ndarray, max_points: int) -> np.ndarray:
    """Return at most ``max_points`` points of a cloud (M, 3), evenly spread if it has more."""
    # Voxel thinning is slow: drop points of a much larger cloud first.
    max_input_points = 4 * max_points
    if len(cloud) > max_input_points:
        cloud = fixed_size(cloud, max_input_points)
    return thinned_to(cloud, max_points)


def cells_of_the_air(bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """
    Return the cells of a grid whose centres are inside a bounding box.

    :param bounds: (2, 3) metres. The edge is doubled until there are about 20,000 cells at most.
    :returns: centres (C, 3) float32, metres; numbers (C,) int64 of the cells, the same in every
        bounding box with the same edge; and the edge, metres.
    """
    edge = CELL_M
    while np.prod(np.ptp(bounds, axis=0) / edge) > 20_000:
        edge *= 2.0
    # The centre of cell k is at (k + 0.5) * edge.
    first = np.ceil(bounds[0] / edge - 0.5).astype(np.int64)
    last = np.floor(bounds[1] / edge - 0.5).astype(np.int64)
    axes = [np.arange(first[k], last[k] + 1) for k in range(3)]
    cells = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    return ((cells + 0.5) * edge).astype(np.float32), cell_numbers(cells), edge


def smallest_rectangle(points: np.ndarray) -> np.ndarray:
    """
    Return the rectangle of smallest area around points: most rooms have right angles.

    One of its sides lies on a side of the convex hull (Freeman and Shapira, 1975).

    :param points: (N, 2) metres.
    :returns: (4, 2) metres, the corners of the rectangle.
    :raises SceneError: if the points are on a line.
    """
    try:
        hull = points[ConvexHull(points).vertices].astype(np.float64)
    except QhullError as error:
        raise SceneError('observed cloud: found all points on a line, seen from above; expected '
                         'a room with volume') from error
    sides = np.roll(hull, -1, axis=0) - hull
    directions = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    normals = np.stack([-directions[:, 1], directions[:, 0]], axis=1)
    # For each side of the hull, coordinates along the side and across it.
    axes = np.stack([directions, normals], axis=1)
    coordinates = axes @ hull.T
    low, high = coordinates.min(axis=2), coordinates.max(axis=2)
    best = int(np.argmin(np.prod(high - low, axis=1)))
    corners = np.array([[x, y] for x in (low[best, 0], high[best, 0])
                        for y in (low[best, 1], high[best, 1])])
    # Back from the directions of the best side to the map frame.
    return corners @ axes[best]


def moved_inwards(corners: np.ndarray) -> np.ndarray:
    """Return the corners (4, 2) of a rectangle moved 0.3 m towards its centre: (4, 2) metres."""
    to_centre = corners.mean(axis=0) - corners
    distances = np.linalg.norm(to_centre, axis=1, keepdims=True)
    return corners + to_centre * np.minimum(0.3 / distances, 1.0)


def enlarged_box(bounds: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """
    Return a box enlarged to contain x and y of positions; sides that would move <= 5 cm stay.

    :param bounds: (2, 3) metres, the box.
    :param positions: (P, 2) metres; P may be 0.
    :returns: (2, 3) metres.
    """
    larger = bounds.copy()
    larger[0, :2] = np.minimum(bounds[0, :2], positions.min(axis=0, initial=np.inf))
    larger[1, :2] = np.maximum(bounds[1, :2], positions.max(axis=0, initial=-np.inf))
    return np.where(np.abs(larger - bounds) > 0.05, larger, bounds)
