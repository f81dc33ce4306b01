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

"""The live view of a camera: patches of surfaces, and the space measured as free."""

from functools import cached_property

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.clouds import thinned_to
from ocp_ros.geometry.normals import edge_aware_normals
from ocp_ros.registration.alignment import Patches, Poses, Surfaces
from ocp_ros.scenes.neighbours import nearest
from ocp_ros.scenes.scene import MIN_POINTS, PLANE_NEIGHBOURS, SceneError
from scipy.ndimage import maximum_filter, minimum_filter

#: Metres: the largest median distance of points; those of clouds in millimetres have larger ones.
MAX_MIDDLE_M = 100.0
#: The number of rows of the map of free space, 1.5 degrees each.
FREE_SPACE_ROWS = 120


class LiveView:
    """
    A live cloud of one camera.

    :param points: (N, 3), N points, metres, body frame (x forward, y left, z up); NaN and the
        origin stand for pixels without a measurement.
    :param model: the camera model; points out of its range are left out, since they are
        inaccurate.
    :param name: the name of the cloud in errors.
    :raises SceneError: if too few points or patches are left.
    :ivar points: (K, 3) the K points in range, metres, body frame.
    :ivar patches: the points as patches, averaged and thinned evenly in space.
    """

    def __init__(self, points: np.ndarray, model: CameraModel, name: str = 'cloud') -> None:
        points = np.asarray(points, dtype=np.float64)
        points = points[np.isfinite(points).all(axis=1)]
        distance = np.linalg.norm(points, axis=1)
        kept = (distance > max(model.min_range, 1e-6)) & (distance <= model.max_range)
        middle = float(np.median(distance[distance > 0.0])) if distance.any() else 0.0
        if np.count_nonzero(kept) < MIN_POINTS or middle > MAX_MIDDLE_M:
            remedy = ('if they are in millimetres, say so (--cloud-scale 0.001)'
                      if middle > MAX_MIDDLE_M else
                      'check the frame of the points, and that the camera is not covered')
            raise SceneError(
                f'{name}: found {np.count_nonzero(kept)} of {len(points)} points between '
                f'{model.min_range:g} and {model.max_range:g} m from the camera, with a median '
                f'distance of {middle:.3g} m; expected at least {MIN_POINTS}, nearer than '
                f'{MAX_MIDDLE_M:g} m; {remedy}')
        self.points, self._distance = points[kept], distance[kept]
        self.patches = patches_of(self.points, name)

    @cached_property
    def surfaces(self) -> Surfaces:
        """Return the patches as surfaces for other cameras, body frame."""
        return Surfaces.of(self.patches.points, self.patches.normals, True)

    @cached_property
    def _cell_ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the largest distance measured in each cell of directions."""
        # Cells without a measurement have inf as least and -inf as largest distance.
        low, high = np.full((2, FREE_SPACE_ROWS, 2 * FREE_SPACE_ROWS), np.inf)
        high[:] = -np.inf
        cells = direction_cells(self.points, self._distance)
        np.minimum.at(low, cells, self._distance)
        np.maximum.at(high, cells, self._distance)
        return low, high

    @cached_property
    def _ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the largest distance measured around each cell of directions."""
        low, high = self._cell_ranges
        empty = np.isinf(low)
        # Include the eight cells around each cell. Columns, the azimuths, continue on the other
        # side of the map; rows do not.
        mode = ('nearest', 'wrap')
        low, high = minimum_filter(low, 3, mode=mode), maximum_filter(high, 3, mode=mode)
        # A cell without its own measurement stays empty.
        low[empty], high[empty] = np.inf, -np.inf
        return low, high

    def compared(self, points: np.ndarray, normals: np.ndarray) -> tuple[int, int]:
        """
        Compare the points of another camera with what this one has measured in their directions.

        :param points: (N, 3) metres, body frame of this camera.
        :param normals: (N, 3) unit vectors towards the other camera.
        :returns: the number of points that lie where this camera has measured a surface and face
            it, and of points in space that it has measured as free.
        """
        is_free, is_behind = self.beside(points)
        is_seen = ~is_free & ~is_behind & faces_origin(points, normals)
        return int(np.count_nonzero(is_seen)), int(np.count_nonzero(is_free))

    def beside(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return which points are in space that is measured as free, and which behind all surfaces.

        :param points: (N, 3) metres, body frame.
        :returns: (N,) bool each; a direction without a measurement is behind.
        """
        distance = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
        cells = direction_cells(points, distance)
        low, high = (values[cells] for values in self._cell_ranges)
        margin = 0.04 + 2.0 * standard_deviation(distance)
        # Without a measurement, the least distance is inf and the largest -inf.
        return np.isfinite(low) & (distance < low - margin), ~(distance <= high + margin)

    def violated_shares(self, points: np.ndarray, poses: Poses) -> np.ndarray:
        """
        Return, for poses, the share of the surfaces in view that are in space measured as free.

        :param points: (N, 3) N points of the scan, metres, map frame.
        :param poses: S candidate poses of the camera.
        :returns: (S,) from 0 to 1.
        """
        return np.array([self._violated_share((points - position) @ rotation)
                         for rotation, position in zip(*poses)])

    def _violated_share(self, points: np.ndarray) -> float:
        """
        Return the share of the scan points in view that are in space measured as free.

        :param points: (N, 3) metres, body frame.
        :returns: from 0 to 1; 0 if no point is in view.
        """
        distance = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
        cells = direction_cells(points, distance)
        low, high = (values[cells] for values in self._ranges)
        # A difference of distances is certain if it is larger than 5 cm plus three standard
        # deviations. A point certainly behind the farthest measured point is hidden, so it is not
        # in view. A point certainly in front of the nearest measured point is in free space.
        margin = 0.05 + 3.0 * standard_deviation(distance)
        in_view = np.isfinite(low) & (distance < high + margin)
        in_free_space = in_view & (distance < low - margin)
        return float(in_free_space.sum() / max(in_view.sum(), 1))


def patches_of(points: np.ndarray, name: str, most: int = 5000) -> Patches:
    """
    Return points as patches, averaged and thinned evenly in space.

    :param points: (N, 3) metres, body frame.
    :param name: the name of the cloud in errors.
    :param most: the largest number of patches.
    :raises SceneError: if there are fewer than a plane is fitted to.
    """
    places = thinned_to(averaged(points, np.linalg.norm(points, axis=1)), most).astype(np.float64)
    if len(places) < PLANE_NEIGHBOURS:
        raise SceneError(
            f'{name}: found {len(points)} points in {len(places)} places; expected at '
            f'least {PLANE_NEIGHBOURS} places; restart the driver if it repeats one point')
    neighbours = nearest(places, PLANE_NEIGHBOURS)[1]
    normals = edge_aware_normals(places, neighbours).astype(np.float64)
    # The camera is at the origin of the points, so its rays have the directions of the points.
    facing_away = np.einsum('ij,ij->i', normals, places) > 0.0
    normals[facing_away] *= -1.0
    return Patches(places, normals, standard_deviation(np.linalg.norm(places, axis=1)))


def faces_origin(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return which points (N, 3) with normals (N, 3) face the origin by 12 degrees or more."""
    distance = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
    return -np.einsum('ij,ij->i', normals, points) > 0.2 * distance


def standard_deviation(distance: np.ndarray) -> np.ndarray:
    """Return the standard deviation of points (N,), metres, at distances (N,), metres."""
    # Between the noise of a stereo camera and that of a better one: 5 mm, and 1.5 mm times the
    # square of the distance in metres.
    return np.hypot(0.005, 0.0015 * distance * distance)


def averaged(points: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """
    Average the points of each narrow beam, since their noise is along the beam.

    Noise spreads the points of a surface over a thick slab, which voxels would cut into layers.

    :param points: (N, 3) N points, metres, body frame.
    :param distance: (N,) the distance of each point from the camera, metres.
    :returns: (M, 3) one mean for each of the M surfaces in beams, metres, body frame.
    """
    # Beams are 0.6 degrees wide.
    beam_rows = 300
    row, column = direction_cells(points, distance, beam_rows)
    # The number of each point's beam: a row has twice as many columns as there are rows.
    beam = row * 2 * beam_rows + column
    # By beam, and by distance within a beam: ``lexsort`` takes the last key first.
    order = np.lexsort((distance, beam))
    beam, distance = beam[order], distance[order]
    # Within a beam, a gap in distance separates surfaces behind each other.
    gaps = np.diff(distance) > 0.03 + 3.0 * standard_deviation(distance[1:])
    group = np.concatenate([[0], np.cumsum((np.diff(beam) != 0) | gaps)])
    count = np.bincount(group)
    sums = np.stack([np.bincount(group, axis) for axis in points[order].T], axis=1)
    return sums / count[:, None]


def direction_cells(points: np.ndarray, distance: np.ndarray, rows: int = FREE_SPACE_ROWS
                    ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return row (N,) and column (N,) of the directions of points (N, 3) in the body frame.

    Row 0 is straight down. Column 0 begins at the direction -x; there are ``2 * rows`` columns.
    """
    elevation = np.arcsin(np.clip(points[:, 2] / distance, -1.0, 1.0))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    row = (elevation / np.pi + 0.5) * rows
    column = (azimuth / (2.0 * np.pi) + 0.5) * 2 * rows
    return (np.minimum(row.astype(np.int64), rows - 1),
            np.minimum(column.astype(np.int64), 2 * rows - 1))
