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

"""Drawing of a room: discs on its surfaces, without the ceiling and the front walls."""

from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Polygon
import numpy as np
from ocp_ros.geometry.normals import edge_aware_normals
from ocp_ros.scenes.scene import PLANE_NEIGHBOURS
from scipy.spatial import cKDTree, ConvexHull

#: Colours of lines and texts.
INK = '#1c2530'
PALE_INK = '#66707c'
#: Colour of points that need no attention, such as points that are seen.
PLAIN_COLOUR = '#dcdcd6'
#: Lightness decreases evenly with height, so that walls are dark in the plan.
HEIGHT_COLOURS = LinearSegmentedColormap.from_list(
    'heights', ['#e6e4dc', '#c9cfd1', '#a3aeb6', '#748593', '#4a5b6b', '#2a3644'])
#: Elevation of the viewer, radians.
ELEVATION = np.radians(42.0)
#: A level surface higher above the floor than this may be a ceiling, metres.
HEADROOM_M = 1.8


class Room(NamedTuple):
    """
    The points of a room for drawing.

    :ivar points: (N, 3) metres.
    :ivar normals: (N, 3) unit normals of either sign, at the N points.
    :ivar inward: (N, 3) vectors of length 0 to 1 from the walls around the room into the room; 0
        for all other points. A longer vector is more certain.
    :ivar radius: (N,) metres, radius of each point's disc.
    :ivar colours: (N, 3) RGB.
    """

    points: np.ndarray
    normals: np.ndarray
    inward: np.ndarray
    radius: np.ndarray
    colours: np.ndarray

    def select(self, keep: np.ndarray) -> 'Room':
        """Return the room with the points where ``keep`` (N,) is true."""
        return Room(*(values[keep] for values in self))


def room_of(points: np.ndarray, colours: np.ndarray) -> Room:
    """
    Return a room for drawing, without its ceiling.

    :param points: (N, 3) metres, z up.
    :param colours: (N, 3) RGB of the N points; or any other array with N rows, such as the numbers
        of the points, to see which points are left.
    """
    normals, radii = _fit_discs(points)
    # The radius of a disc is about the distance of neighbouring points. The search for walls and
    # the ceiling needs areas with several points.
    pitch = float(np.median(radii))
    inward = _inward_vectors(points, normals, max(0.25, 3.0 * pitch))
    room = Room(points, normals, inward, radii, colours)
    return room.select(~_find_ceiling(points, normals, 2.5 * pitch))


def choose_indices(count: int, max_count: int) -> np.ndarray:
    """Return at most ``max_count`` of ``count`` indices, drawn at random with a fixed seed."""
    if count <= max_count:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, max_count, replace=False))


def fit_axes(axes: Axes, positions: np.ndarray, margin: float = 0.0) -> None:
    """Fit axes to M positions (M, 2), to scale, with a margin as a share of the longer edge."""
    low, high = np.nanmin(positions, axis=0), np.nanmax(positions, axis=0)
    border = margin * (high - low).max()
    axes.set(xlim=(low[0] - border, high[0] + border), ylim=(low[1] - border, high[1] + border),
             aspect='equal')


def heights_of(points: np.ndarray) -> np.ndarray:
    """Return the height of each point as a share of the room's height: (N,) from 0 to 1."""
    low, high = np.percentile(points[:, 2], [2.0, 98.0])
    return np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)


def _fit_discs(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Fit a disc to the surface at each of N points.

    :returns: (N, 3) unit normals of either sign and (N,) radii in metres, smaller for points that
        are not on a surface.
    """
    distances, neighbours = cKDTree(points).query(points, k=min(PLANE_NEIGHBOURS, len(points)))
    normals = edge_aware_normals(points, neighbours)
    offsets = points[neighbours[:, :10]] - points[:, None]
    # The spread of neighbours off the plane of the point.
    misfits = np.einsum('nki,ni->nk', offsets, normals).std(axis=1)
    # Column 0 is the distance of a point from itself.
    pitches = distances[:, 1:5].mean(axis=1)
    median_pitch = max(float(np.median(pitches)), 1e-3)
    pitches = np.clip(pitches, 0.8 * median_pitch, 1.5 * median_pitch)
    # The factor is 1 on a surface and falls with the misfit to 0.6.
    return normals, pitches * np.clip(1.35 - 1.4 * misfits / pitches, 0.6, 1.0)


def _group_columns(points: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Group points in columns over square cells of the plan.

    :param points: (N, 3) metres.
    :param width: width of the cells, metres.
    :returns: column number of each point (N,), and height of the highest point of each of M
        columns (M,).
    """
    cells = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / width).astype(np.int64)
    numbers = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    keys, columns = np.unique(numbers, return_inverse=True)
    tops = np.full(len(keys), -np.inf)
    np.maximum.at(tops, columns, points[:, 2])
    return columns, tops


def _find_ceiling(points: np.ndarray, normals: np.ndarray, width: float) -> np.ndarray:
    """
    Return whether each point hides the room from above: (N,) bool, all False without a ceiling.

    A lid is a point on a level surface above head height, near the top of its column. A few lids
    are the tops of cupboards; a ceiling covers a large part of the room.

    :param width: width of the columns, metres.
    """
    z = points[:, 2]
    floor, highest = np.percentile(z, [2.0, 99.5])
    columns, tops = _group_columns(points, width)
    lids = (np.abs(normals[:, 2]) > 0.8) & (z > tops[columns] - 0.2)
    lids &= z > floor + max(HEADROOM_M, 0.6 * (highest - floor))
    # Lids in fewer columns than this are no ceiling.
    if len(np.unique(columns[lids])) < 0.12 * len(tops):
        return np.zeros(len(points), dtype=bool)
    # Everything above the lower side of the ceiling counts too: lamps and the upper ends of walls.
    return lids | (z > np.percentile(z[lids], 5.0) - 0.1)


def _inward_vectors(points: np.ndarray, normals: np.ndarray, radius: float) -> np.ndarray:
    """
    Find the walls around the room: the walls with floor or ceiling on one side only.

    Each point of a wall gets a vector towards the side with more floor and ceiling; the vectors of
    neighbours (at most 60) are averaged.

    :param radius: distance in which floor and ceiling are counted, metres.
    :returns: (N, 3), see :attr:`Room.inward`; all 0 without level or without upright points.
    """
    inward = np.zeros_like(points)
    is_level = np.abs(normals[:, 2]) > 0.9
    upright = np.flatnonzero(np.abs(normals[:, 2]) < 0.5)
    if not is_level.any() or len(upright) == 0:
        return inward
    level_tree = cKDTree(points[is_level, :2])
    positions, wall_normals = points[upright], normals[upright]
    # Seen from above, two circles touch the wall at each point, one on each side. Count the points
    # of floor and ceiling in them.
    front_counts, back_counts = (
        level_tree.query_ball_point((positions + sign * radius * wall_normals)[:, :2], radius,
                                    return_length=True) for sign in (1.0, -1.0))
    balance = (front_counts - back_counts) / np.maximum(front_counts + back_counts, 1)
    # Where no side has a clear majority, the vector is 0.
    vectors = wall_normals * (balance * (np.abs(balance) > 0.4))[:, None]
    _, neighbours = cKDTree(positions).query(positions, k=min(60, len(positions)))
    inward[upright] = vectors[neighbours].mean(axis=1)
    return inward


def _view_rotation(azimuth: float, elevation: float) -> np.ndarray:
    """Return the rotation (3, 3) to the viewer's axes: right, up, towards the viewer."""
    # Cosine and sine of the azimuth and of the elevation of the viewer, seen from the room.
    (c, s), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in (azimuth, elevation))
    return np.array([[-s, c, 0.0], [-se * c, -se * s, ce], [ce * c, ce * s, se]])


def cut_open(room: Room, view: np.ndarray) -> Room:
    """
    Return a room without its front walls, whose inner sides face away from the viewer.

    :param view: (3, 3) rotation to the viewer's axes: right, up, towards the viewer.
    """
    z, normal_z = room.points[:, 2], np.abs(room.normals[:, 2])
    columns, tops = _group_columns(room.points, width=0.3)
    floor, highest = np.percentile(z, [2.0, 99.5])
    # Keep or remove whole columns, since a decision by point would leave isolated points.
    # For each column, how much the inner sides of walls face away from the viewer, as a sum over
    # the points, and the number of points of walls.
    facing_away = np.bincount(columns, -(room.inward @ view[2]))
    wall_points = np.bincount(columns, normal_z < 0.5)
    # Columns are removed if the mean over their points of walls is above 0.15, and if they reach
    # into the upper quarter of the room: lower ones are no walls.
    removed = (facing_away > 0.15 * wall_points) & (tops > floor + 0.75 * (highest - floor))
    # Level surfaces below head height, such as the floor, stay.
    return room.select(~(removed[columns] & ((normal_z < 0.8) | (z > floor + HEADROOM_M))))


def open_view(room: Room) -> tuple[np.ndarray, Room]:
    """
    Return that of two views with more visible level surfaces, and the room without front walls.

    :returns: (3, 3) rotation to the viewer's axes, of a viewer in the south, and the cut room.
    """
    candidates = []
    for azimuth in np.radians([-60.0, -120.0]):
        view = _view_rotation(azimuth, ELEVATION)
        shown_room = cut_open(room, view)
        positions = shown_room.points @ view.T
        # A pixel is as wide as a disc. In some versions of NumPy, the numbers have a second axis.
        pixels = np.floor(positions[:, :2] / (2.0 * np.median(shown_room.radius))).astype(np.int64)
        _, numbers = np.unique(pixels, axis=0, return_inverse=True)
        # The coordinate towards the viewer of the nearest point in each pixel; points up to 0.3 m
        # behind it are visible.
        nearest = np.full(numbers.max() + 1, -np.inf)
        np.maximum.at(nearest, numbers.ravel(), positions[:, 2])
        visible = positions[:, 2] > nearest[numbers.ravel()] - 0.3
        is_level = np.abs(shown_room.normals[:, 2]) > 0.8
        candidates.append((np.count_nonzero(visible & is_level), view, shown_room))
    _, view, shown_room = max(candidates, key=lambda candidate: candidate[0])
    return view, shown_room


class Eye(NamedTuple):
    """
    A viewer of a room; calling the viewer projects points in perspective.

    :ivar view: (3, 3) rotation to the viewer's axes: right, up, towards the viewer.
    :ivar target: (3,) metres, centre of the picture.
    :ivar distance: metres from the viewer to the target.
    """

    view: np.ndarray
    target: np.ndarray
    distance: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Project points (..., 3), metres, to the picture: (..., 2) metres."""
        in_view = (points - self.target) @ self.view.T
        # The limit 0.2 avoids a division by 0 for points beside or behind the viewer.
        return in_view[..., :2] / np.maximum(1.0 - in_view[..., 2:] / self.distance, 0.2)


def eye_at(points: np.ndarray, azimuth: float) -> Eye:
    """
    Return the viewer for whom a room fills the picture.

    :param points: (N, 3) metres.
    :param azimuth: radians, direction from the centre of the room to the viewer.
    """
    low, high = np.percentile(points, [1.0, 99.0], axis=0)
    size = float(np.linalg.norm(high - low))
    return Eye(_view_rotation(azimuth, ELEVATION), 0.5 * (low + high), 1.6 * size)


def draw_discs(axes: Axes, room: Room, view: np.ndarray, eye: Eye | None = None,
               contrast: float = 1.0) -> Polygon:
    """
    Draw each point as a disc on its surface, from back to front.

    :param view: (3, 3) rotation to the viewer's axes: right, up, towards the viewer.
    :param eye: viewer whose ``view`` this is; None for parallel projection.
    :param contrast: darkening of surfaces that face away from the light; 0 for none.
    :returns: the outline of the room, to clip the drawn ranges.
    """
    project = eye or (lambda points: points @ view[:2].T)
    # Turn the normals towards the viewer.
    normals = room.normals * np.where(room.normals @ view[2] < 0.0, -1.0, 1.0)[:, None]
    # The direction of the light in the viewer's axes: right, up and towards the viewer.
    to_light = np.array([-0.35, 0.6, 0.72])
    shade = 1.05 - contrast * 0.33 * (1.0 - np.clip(normals @ view.T @ to_light, 0.0, 1.0))
    # Two directions in the plane of each disc; the first is perpendicular to z or x, whichever is
    # not nearly parallel to the normal.
    tangents = np.cross(normals, np.where(np.abs(normals[:, 2:]) < 0.7, (0, 0, 1.0), (1.0, 0, 0)))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    bitangents = np.cross(normals, tangents)
    # Each disc is drawn as an octagon.
    angles = np.arange(8)[:, None] * (np.pi / 4.0)
    rims = np.cos(angles) * tangents[:, None] + np.sin(angles) * bitangents[:, None]
    discs = project(room.points[:, None] + room.radius[:, None, None] * rims)
    order = np.argsort(room.points @ view[2])
    colours = np.clip(room.colours * shade[:, None], 0.0, 1.0)[order]
    # A wall seen edge-on is drawn by the lines of its discs, so these are thicker.
    widths = np.where(np.abs(normals @ view[2]) < 0.2, 4.5, 0.8)[order]
    centres = project(room.points)
    # With the option QJ, centres on one line are no error.
    corners = centres[ConvexHull(centres, qhull_options='QJ').vertices]
    outline = Polygon(corners, fill=False, linewidth=0)
    axes.add_patch(outline)
    axes.add_collection(PolyCollection(discs[order], facecolors=colours, edgecolors=colours,
                                       linewidths=widths)).set_clip_path(outline)
    return outline
