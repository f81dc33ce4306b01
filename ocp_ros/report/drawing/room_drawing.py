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

"""A room as it is drawn: discs on its surfaces, without the ceiling, cut open for the viewer."""

from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Polygon
import numpy as np
from ocp_ros.geometry.normals import edge_aware_normals
from ocp_ros.scenes.scene import NEIGHBOURS
from scipy.spatial import cKDTree, ConvexHull

INK, PALE_INK = '#1c2530', '#66707c'
#: Lightness falls evenly with height, so that walls are dark in the plan.
HEIGHTS = LinearSegmentedColormap.from_list(
    'heights', ['#e6e4dc', '#c9cfd1', '#a3aeb6', '#748593', '#4a5b6b', '#2a3644'])
#: Directions to the right, up and towards the viewer.
LIGHT = np.array([-0.35, 0.6, 0.72])
ELEVATION = np.radians(42.0)
#: The viewer stands in the south, so that x runs right and y runs away as in the plan.
AZIMUTHS = np.radians([-60.0, -120.0])
#: What is level and higher above the floor than this may be a ceiling, metres.
HEADROOM = 1.8
#: Width of the columns that stay or go together when walls are taken away, metres.
COLUMN = 0.3
#: How many neighbours agree on where the inside of a wall is.
VOTERS = 60


class Room(NamedTuple):
    """
    What is drawn of a room.

    :ivar points: (N, 3) metres.
    :ivar normals: (N, 3) unit vectors of either sign.
    :ivar inward: (N, 3) from the walls around the room into it; zero for all other points.
    :ivar radius: (N,) metres, of the disc that stands for a point.
    :ivar colours: (N, 3) RGB by height, or by not being observed.
    """

    points: np.ndarray
    normals: np.ndarray
    inward: np.ndarray
    radius: np.ndarray
    colours: np.ndarray

    def only(self, keep: np.ndarray) -> 'Room':
        """Return the part of the room that a mask keeps."""
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
    """Return the indices of at most so many of some points: drawn at random, always the same."""
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
    """Return the height of each point as a share of the room's: (N,) from 0 to 1."""
    low, high = np.percentile(points[:, 2], [2.0, 98.0])
    return np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)


def _surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Fit discs to the surfaces behind the points.

    :returns: (N, 3) unit normals of either sign and (N,) radii in metres, smaller where points lie
        on no surface.
    """
    distance, near = cKDTree(points).query(points, k=min(NEIGHBOURS, len(points)))
    normals = edge_aware_normals(points, near)
    offsets = points[near[:, :10]] - points[:, None]
    misfit = np.einsum('nki,ni->nk', offsets, normals).std(axis=1)
    pitch = distance[:, 1:5].mean(axis=1)
    usual = max(float(np.median(pitch)), 1e-3)
    pitch = np.clip(pitch, 0.8 * usual, 1.5 * usual)
    return normals, pitch * np.clip(1.35 - 1.4 * misfit / pitch, 0.6, 1.0)


def _columns(points: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of each point's column in the plan, (N,), and the columns' tops, (M,)."""
    cell = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / width).astype(np.int64)
    keys, column = np.unique(cell[:, 0] * (cell[:, 1].max() + 1) + cell[:, 1], return_inverse=True)
    top = np.full(len(keys), -np.inf)
    np.maximum.at(top, column, points[:, 2])
    return column, top


def _ceiling(points: np.ndarray, normals: np.ndarray, width: float) -> np.ndarray:
    """
    Find what hides the room from above: (N,) bool.

    A lid is level, above head height and the topmost thing in its column. A few lids are the tops
    of cupboards; a ceiling covers a good part of the room.
    """
    z = points[:, 2]
    low, high = np.percentile(z, [2.0, 99.5])
    column, top = _columns(points, width)
    lid = (np.abs(normals[:, 2]) > 0.8) & (z > top[column] - 0.2)
    lid &= z > low + max(HEADROOM, 0.6 * (high - low))
    if len(np.unique(column[lid])) < 0.12 * len(top):
        return np.zeros(len(points), dtype=bool)
    # Lamps and the upper ends of walls go with the ceiling.
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
    """Return the rotation to the viewer's axes, right, up and towards: (3, 3)."""
    (c, s), (ce, se) = ((np.cos(a), np.sin(a)) for a in (azimuth, elevation))
    return np.array([[-s, c, 0.0], [-se * c, -se * s, ce], [ce * c, ce * s, se]])


def cut_open(room: Room, view: np.ndarray) -> Room:
    """Take away the walls that turn their backs on the viewer."""
    z, level = room.points[:, 2], np.abs(room.normals[:, 2])
    column, top = _columns(room.points, COLUMN)
    low, high = np.percentile(z, [2.0, 99.5])
    # A column decides as a whole: single points would leave tatters.
    away = np.bincount(column, -(room.inward @ view[2]))
    upright = np.bincount(column, level < 0.5)
    cut = (away > 0.15 * upright) & (top > low + 0.75 * (high - low))
    return room.only(~(cut[column] & ((level < 0.8) | (z > low + HEADROOM))))


def open_view(room: Room) -> tuple[np.ndarray, Room]:
    """Choose the side from which more of the room's level surfaces is seen."""
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
    Somebody who looks at a room from a distance, so that what is near is larger.

    :ivar view: (3, 3) rotation to the viewer's axes, right, up and towards.
    :ivar target: (3,) metres, what is looked at.
    :ivar distance: metres from the viewer to it.
    """

    view: np.ndarray
    target: np.ndarray
    distance: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 3), metres, are in the picture: (..., 2) metres."""
        seen = (points - self.target) @ self.view.T
        # What is beside or behind the viewer is not of this picture.
        return seen[..., :2] / np.maximum(1.0 - seen[..., 2:] / self.distance, 0.2)


def eye_at(points: np.ndarray, azimuth: float) -> Eye:
    """
    Stand so that a room fills the picture.

    :param points: (N, 3) metres.
    :param azimuth: radians, where the viewer stands, seen from the room's middle.
    """
    low, high = np.percentile(points, [1.0, 99.0], axis=0)
    size = float(np.linalg.norm(high - low))
    return Eye(_view(azimuth, ELEVATION), 0.5 * (low + high), 1.6 * size)


def draw_discs(axes: Axes, room: Room, view: np.ndarray, eye: Eye | None = None,
               contrast: float = 1.0) -> Polygon:
    """
    Draw each point as a disc on its surface, from back to front.

    :param eye: of the same view; in parallel projection where there is none.
    :param contrast: how much darker what faces away from the light is; 0 for not at all.
    :returns: the outline of the room, where also ranges end.
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
    # Seen edge-on, a wall is its line alone.
    widths = np.where(np.abs(normals @ view[2]) < 0.2, 4.5, 0.8)[order]
    flat = flatten(room.points)
    outline = Polygon(flat[ConvexHull(flat, qhull_options='QJ').vertices], fill=False, linewidth=0)
    axes.add_patch(outline)
    axes.add_collection(PolyCollection(discs[order], facecolors=colours, edgecolors=colours,
                                       linewidths=widths)).set_clip_path(outline)
    return outline
