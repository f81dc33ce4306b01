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

INK = '#1c2530'
PALE_INK = '#66707c'
#: Lightness decreases evenly with height, so that walls are dark in the plan.
HEIGHTS = LinearSegmentedColormap.from_list(
    'heights', ['#e6e4dc', '#c9cfd1', '#a3aeb6', '#748593', '#4a5b6b', '#2a3644'])
#: Direction to the light: right, up and towards the viewer.
LIGHT = np.array([-0.35, 0.6, 0.72])
ELEVATION = np.radians(42.0)
#: Azimuths of the viewer, in the south: x points right and y points away from the viewer, as in
#: the plan.
AZIMUTHS = np.radians([-60.0, -120.0])
#: A level surface higher above the floor than this may be a ceiling, metres.
HEADROOM = 1.8
#: Width of the columns that are kept or removed as a whole with the front walls, metres.
COLUMN = 0.3
#: Number of neighbours whose votes for the inside of a wall are averaged.
VOTERS = 60


class Room(NamedTuple):
    """
    The points of a room for drawing.

    :ivar points: (N, 3) metres.
    :ivar normals: (N, 3) unit vectors of either sign.
    :ivar inward: (N, 3) from the walls around the room into it; zero for all other points.
    :ivar radius: (N,) metres, of the disc of a point.
    :ivar colours: (N, 3) RGB.
    """

    points: np.ndarray
    normals: np.ndarray
    inward: np.ndarray
    radius: np.ndarray
    colours: np.ndarray

    def only(self, keep: np.ndarray) -> 'Room':
        """Return the part of the room that a mask selects."""
        return Room(*(values[keep] for values in self))


def room_of(points: np.ndarray, colours: np.ndarray) -> Room:
    """
    Prepare a room without its ceiling.

    :param points: (N, 3) metres, z up.
    :param colours: (N, 3) RGB.
    """
    normals, radius = _surface(points)
    pitch = float(np.median(radius))
    room = Room(points, normals, _inward(points, normals, max(0.25, 3.0 * pitch)), radius, colours)
    return room.only(~_ceiling(points, normals, 2.5 * pitch))


def some_of(count: int, most: int) -> np.ndarray:
    """Return at most ``most`` of ``count`` indices, drawn at random with a fixed seed."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def fit(axes: Axes, shown: np.ndarray, margin: float = 0.0) -> None:
    """Fit axes to places (M, 2), to scale, with a margin as a share of the longer edge."""
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    room = margin * (high - low).max()
    axes.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room),
             aspect='equal')


def heights_of(points: np.ndarray) -> np.ndarray:
    """Return the height of each point as a share of the room's height: (N,) from 0 to 1."""
    low, high = np.percentile(points[:, 2], [2.0, 98.0])
    return np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)


def _surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Fit discs to the surfaces behind the points.

    :returns: (N, 3) unit normals of either sign and (N,) radii in metres, smaller for points that
        are not on a surface.
    """
    distance, near = cKDTree(points).query(points, k=min(PLANE_NEIGHBOURS, len(points)))
    normals = edge_aware_normals(points, near)
    offsets = points[near[:, :10]] - points[:, None]
    misfit = np.einsum('nki,ni->nk', offsets, normals).std(axis=1)
    pitch = distance[:, 1:5].mean(axis=1)
    usual = max(float(np.median(pitch)), 1e-3)
    pitch = np.clip(pitch, 0.8 * usual, 1.5 * usual)
    return normals, pitch * np.clip(1.35 - 1.4 * misfit / pitch, 0.6, 1.0)


def _columns(points: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the column number of each point in the plan, (N,), and the columns' tops, (M,)."""
    cell = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / width).astype(np.int64)
    keys, column = np.unique(cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1], return_inverse=True)
    top = np.full(len(keys), -np.inf)
    np.maximum.at(top, column, points[:, 2])
    return column, top


def _ceiling(points: np.ndarray, normals: np.ndarray, width: float) -> np.ndarray:
    """
    Find the points that hide the room from above: (N,) bool.

    A lid is a level surface above head height and the highest surface in its column. A few lids
    are the tops of cupboards; a ceiling covers a large part of the room.
    """
    z = points[:, 2]
    low, high = np.percentile(z, [2.0, 99.5])
    column, top = _columns(points, width)
    lid = (np.abs(normals[:, 2]) > 0.8) & (z > top[column] - 0.2)
    lid &= z > low + max(HEADROOM, 0.6 * (high - low))
    if len(np.unique(column[lid])) < 0.12 * len(top):
        return np.zeros(len(points), dtype=bool)
    # Lamps and the upper ends of walls are removed with the ceiling.
    return lid | (z > np.percentile(z[lid], 5.0) - 0.1)


def _inward(points: np.ndarray, normals: np.ndarray, reach: float) -> np.ndarray:
    """
    Find the walls around the room: those with floor or ceiling on one side only.

    :returns: (N, 3) unit vectors from these walls into the room, zero for all other points.
    """
    inward = np.zeros_like(points)
    level = np.abs(normals[:, 2]) > 0.9
    upright = np.flatnonzero(np.abs(normals[:, 2]) < 0.5)
    if not level.any() or len(upright) == 0:
        return inward
    floor, at, sideways = cKDTree(points[level, :2]), points[upright], normals[upright]
    front, back = (floor.query_ball_point((at + s * reach * sideways)[:, :2], reach,
                                          return_length=True) for s in (1.0, -1.0))
    balance = (front - back) / np.maximum(front + back, 1)
    votes = sideways * (balance * (np.abs(balance) > 0.4))[:, None]
    _, near = cKDTree(at).query(at, k=min(VOTERS, len(at)))
    inward[upright] = votes[near].mean(axis=1)
    return inward


def _view(azimuth: float, elevation: float) -> np.ndarray:
    """Return the rotation to the viewer's axes (right, up, towards the viewer): (3, 3)."""
    (c, s), (ce, se) = ((np.cos(a), np.sin(a)) for a in (azimuth, elevation))
    return np.array([[-s, c, 0.0], [-se * c, -se * s, ce], [ce * c, ce * s, se]])


def cut_open(room: Room, view: np.ndarray) -> Room:
    """Remove the front walls, whose inner sides face away from the viewer."""
    z, level = room.points[:, 2], np.abs(room.normals[:, 2])
    column, top = _columns(room.points, COLUMN)
    low, high = np.percentile(z, [2.0, 99.5])
    # Keep or remove whole columns: a decision by point would leave isolated points.
    away = np.bincount(column, -(room.inward @ view[2]))
    upright = np.bincount(column, level < 0.5)
    cut = (away > 0.15 * upright) & (top > low + 0.75 * (high - low))
    return room.only(~(cut[column] & ((level < 0.8) | (z > low + HEADROOM))))


def open_view(room: Room) -> tuple[np.ndarray, Room]:
    """Choose the view with more visible level surfaces; return it and the room cut open for it."""
    candidates = []
    for azimuth in AZIMUTHS:
        view = _view(azimuth, ELEVATION)
        part = cut_open(room, view)
        at = part.points @ view.T
        pixel = np.floor(at[:, :2] / (2.0 * np.median(part.radius))).astype(np.int64)
        _, pixel = np.unique(pixel, axis=0, return_inverse=True)
        nearest = np.full(pixel.max() + 1, -np.inf)
        np.maximum.at(nearest, pixel.ravel(), at[:, 2])
        seen = at[:, 2] > nearest[pixel.ravel()] - 0.3
        level = np.abs(part.normals[:, 2]) > 0.8
        candidates.append((np.count_nonzero(seen & level), view, part))
    _, view, part = max(candidates, key=lambda candidate: candidate[0])
    return view, part


class Eye(NamedTuple):
    """
    A viewer of a room, for perspective projection.

    :ivar view: (3, 3) rotation to the viewer's axes: right, up, towards the viewer.
    :ivar target: (3,) metres, centre of the picture.
    :ivar distance: metres from the viewer to the target.
    """

    view: np.ndarray
    target: np.ndarray
    distance: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Project points (..., 3), metres, to the picture: (..., 2) metres."""
        seen = (points - self.target) @ self.view.T
        # The limit avoids a division by 0 for points beside or behind the viewer.
        return seen[..., :2] / np.maximum(1.0 - seen[..., 2:] / self.distance, 0.2)


def eye_at(points: np.ndarray, azimuth: float) -> Eye:
    """
    Return the viewer for whom a room fills the picture.

    :param points: (N, 3) metres.
    :param azimuth: radians, direction from the centre of the room to the viewer.
    """
    low, high = np.percentile(points, [1.0, 99.0], axis=0)
    size = float(np.linalg.norm(high - low))
    return Eye(_view(azimuth, ELEVATION), 0.5 * (low + high), 1.6 * size)


def draw_discs(axes: Axes, room: Room, view: np.ndarray, eye: Eye | None = None,
               contrast: float = 1.0) -> Polygon:
    """
    Draw each point as a disc on its surface, from back to front.

    :param eye: viewer of the same view; None for parallel projection.
    :param contrast: darkening of surfaces that face away from the light; 0 for none.
    :returns: the outline of the room, to clip the drawn ranges.
    """
    flatten = eye or (lambda points: points @ view[:2].T)
    normals = room.normals * np.where(room.normals @ view[2] < 0.0, -1.0, 1.0)[:, None]
    shade = 1.05 - contrast * 0.33 * (1.0 - np.clip(normals @ view.T @ LIGHT, 0.0, 1.0))
    first = np.cross(normals, np.where(np.abs(normals[:, 2:]) < 0.7, (0, 0, 1.0), (1.0, 0, 0)))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angle = np.arange(8)[:, None] * (np.pi / 4.0)
    rim = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    discs = flatten(room.points[:, None] + room.radius[:, None, None] * rim)
    order = np.argsort(room.points @ view[2])
    colours = np.clip(room.colours * shade[:, None], 0.0, 1.0)[order]
    # A wall seen edge-on is drawn by the lines of its discs, so these are thicker.
    widths = np.where(np.abs(normals @ view[2]) < 0.2, 4.5, 0.8)[order]
    flat = flatten(room.points)
    outline = Polygon(flat[ConvexHull(flat, qhull_options='QJ').vertices], fill=False, linewidth=0)
    axes.add_patch(outline)
    axes.add_collection(PolyCollection(discs[order], facecolors=colours, edgecolors=colours,
                                       linewidths=widths)).set_clip_path(outline)
    return outline
