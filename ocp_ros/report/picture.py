# SPDX-License-Identifier: Apache-2.0
"""A picture of a placement: the room from above and cut open, with cameras, paths and ranges."""

from pathlib import Path
from typing import NamedTuple

from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.offsetbox import AnnotationBbox, OffsetImage
from matplotlib.patches import Circle, Patch, Polygon
import numpy as np
from scipy.spatial import cKDTree, ConvexHull

from ocp_ros.scenes.scene import edge_aware_normals, NEIGHBOURS

#: Told apart with any kind of colour vision; red is left to what nobody sees.
CAMERA_COLOURS = ('#0072b2', '#e69f00', '#009e73', '#cc79a7', '#56b4e9', '#332288', '#f0e442',
                  '#8c6d31')
UNOBSERVED = '#c44e3b'
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


def draw_placement(path: str | Path, points: np.ndarray, observed: np.ndarray | None,
                   trajectories: np.ndarray, max_range: float, title: str,
                   subtitle: str = '') -> None:
    """
    Write a PNG of 1800 x 950 pixels: a plan of the room and a view into it.

    :param path: file to write; its folder is made.
    :param points: (N, 3) the whole room, metres, map frame, z up.
    :param observed: (N,) bool, points that the final placement sees, or None.
    :param trajectories: (T, K, 3) metres, the cameras after each turn; row 0 is the start.
    :param max_range: range of every camera, metres.
    :param title: headline.
    :param subtitle: line of numbers below it.
    :raises ValueError: for a wrong shape or range; the message says what came.
    """
    points, observed, paths = _checked(points, observed, trajectories, max_range)
    normals, radius = _surface(points)
    pitch = float(np.median(radius))
    room = Room(points, normals, _inward(points, normals, max(0.25, 3.0 * pitch)), radius,
                _colours(points, observed))
    room = room.only(~_ceiling(points, normals, 2.5 * pitch))
    figure = Figure(figsize=(18.0, 9.5), dpi=100, facecolor='white')
    figure.text(0.03, 0.945, title, fontsize=21, fontweight='bold', color=INK, va='center')
    figure.text(0.03, 0.9, subtitle, fontsize=14, color=PALE_INK, va='center')
    _draw_plan(figure.add_axes((0.045, 0.13, 0.44, 0.73)), room, paths, max_range)
    _draw_cutaway(figure.add_axes((0.505, 0.1, 0.485, 0.77)), room, paths, max_range)
    _draw_legend(figure, observed, max_range, len(paths) > 1)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format='png', dpi=100)


def _checked(points, observed, trajectories, max_range: float):
    """Return the arrays as float64 and bool; refuse what cannot be drawn."""
    points, paths = np.asarray(points, np.float64), np.asarray(trajectories, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4:
        raise ValueError(f'points: found shape {points.shape}; expected (N, 3), N of 4 or more')
    if paths.ndim != 3 or paths.shape[2] != 3 or 0 in paths.shape:
        raise ValueError(f'trajectories: found shape {paths.shape}; expected (T, K, 3): turns, '
                         'cameras, x y z')
    if observed is not None and np.shape(observed) != (len(points),):
        raise ValueError(f'observed: found shape {np.shape(observed)}; expected ({len(points)},), '
                         'one flag per point, or None')
    if not 0.0 < max_range < np.inf:
        raise ValueError(f'max_range: found {max_range}; expected metres above 0')
    return points, None if observed is None else np.asarray(observed, bool), paths


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


def _colours(points: np.ndarray, observed: np.ndarray | None) -> np.ndarray:
    """Colour points by height, those not observed in red: (N, 3)."""
    low, high = np.percentile(points[:, 2], [2.0, 98.0])
    height = np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)
    colours = HEIGHTS(height)[:, :3]
    if observed is not None:
        # The shade goes on telling the height.
        red = 1.1 * np.array(to_rgb(UNOBSERVED)) * (1.0 - 0.5 * height[~observed, None])
        colours[~observed] = 0.45 * colours[~observed] + 0.55 * red
    return colours


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


def _cut_open(room: Room, view: np.ndarray) -> Room:
    """Take away the walls that turn their backs on the viewer."""
    z, level = room.points[:, 2], np.abs(room.normals[:, 2])
    column, top = _columns(room.points, COLUMN)
    low, high = np.percentile(z, [2.0, 99.5])
    # A column decides as a whole: single points would leave tatters.
    away = np.bincount(column, -(room.inward @ view[2]))
    upright = np.bincount(column, level < 0.5)
    cut = (away > 0.15 * upright) & (top > low + 0.75 * (high - low))
    return room.only(~(cut[column] & ((level < 0.8) | (z > low + HEADROOM))))


def _open_view(room: Room) -> tuple[np.ndarray, Room]:
    """Choose the side from which more of the room's level surfaces is seen."""
    candidates = []
    for azimuth in AZIMUTHS:
        view = _view(azimuth, ELEVATION)
        part = _cut_open(room, view)
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


def _draw_discs(axes: Axes, room: Room, view: np.ndarray) -> Polygon:
    """
    Draw each point as a disc on its surface, from back to front.

    :returns: the outline of the room, where also ranges end.
    """
    normals = room.normals * np.where(room.normals @ view[2] < 0.0, -1.0, 1.0)[:, None]
    shade = 0.72 + 0.33 * np.clip(normals @ view.T @ LIGHT, 0.0, 1.0)
    first = np.cross(normals, np.where(np.abs(normals[:, 2:]) < 0.7, (0, 0, 1.0), (1.0, 0, 0)))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angle = np.arange(8)[:, None] * (np.pi / 4.0)
    rim = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    discs = (room.points[:, None] + room.radius[:, None, None] * rim) @ view[:2].T
    order = np.argsort(room.points @ view[2])
    colours = np.clip(room.colours * shade[:, None], 0.0, 1.0)[order]
    # Seen edge-on, a wall is its line alone.
    widths = np.where(np.abs(normals @ view[2]) < 0.2, 4.5, 0.8)[order]
    flat = room.points @ view[:2].T
    outline = Polygon(flat[ConvexHull(flat, qhull_options='QJ').vertices], fill=False, linewidth=0)
    axes.add_patch(outline)
    axes.add_collection(PolyCollection(discs[order], facecolors=colours, edgecolors=colours,
                                       linewidths=widths)).set_clip_path(outline)
    return outline


def _disc_grid(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y (up) and the distance from the centre on a square that holds the unit disc."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, size), np.linspace(1.0, -1.0, size))
    return x, y, np.hypot(x, y)


def _draw_range(axes: Axes, centre: np.ndarray, max_range: float, colour: str, strength: float,
                clip: Polygon) -> None:
    """Draw the ball that a camera measures as a bubble: clear inside, soft towards its rim."""
    r = _disc_grid(256)[2]
    image = np.full((*r.shape, 4), (*to_rgb(colour), 0.0))
    image[..., 3] = np.where(r < 1.0, 0.22 * strength * r ** 8, 0.0)
    (x, y), m = centre, max_range
    axes.imshow(image, extent=(x - m, x + m, y - m, y + m), zorder=2).set_clip_path(clip)
    rim = Circle((x, y), m, fill=False, edgecolor=colour, linewidth=1.2, zorder=2,
                 alpha=0.4 + 0.3 * strength)
    axes.add_patch(rim).set_clip_path(clip)


def _draw_ball(axes: Axes, at: np.ndarray, number: int, colour: str) -> None:
    """Draw a camera as a shiny ball with its number."""
    x, y, r = _disc_grid(64)
    light = np.clip(1.0 - np.hypot(x + 0.35, y - 0.4) / 1.5, 0.0, 1.0)[..., None]
    base = np.array(to_rgb(colour))
    shaded = base * (0.45 + 0.65 * light) + np.clip(light - 0.6, 0.0, 1.0) * 1.4 * (1.0 - base)
    alpha = np.clip((1.0 - r) * 16.0, 0.0, 1.0)[..., None]
    image = OffsetImage(np.concatenate([np.clip(shaded, 0.0, 1.0), alpha], 2), zoom=0.44)
    axes.add_artist(AnnotationBbox(image, at, frameon=False, pad=0.0, zorder=6))
    axes.text(*at, str(number), color='white', fontsize=11, fontweight='bold', ha='center',
              va='center_baseline', zorder=7,
              path_effects=[patheffects.withStroke(linewidth=2.2, foreground=INK)])


def _draw_cameras(axes: Axes, paths: np.ndarray, max_range: float, clip: Polygon) -> None:
    """Draw ranges, paths (T, K, 2), starts and final positions, and fit the axes to all of it."""
    # Many bubbles on top of each other would hide the room.
    strength = min(1.0, 2.0 / np.sqrt(paths.shape[1]))
    casing = [patheffects.withStroke(linewidth=4.5, foreground='white')]
    for k in range(paths.shape[1]):
        colour, path = CAMERA_COLOURS[k % len(CAMERA_COLOURS)], paths[:, k]
        _draw_range(axes, path[-1], max_range, colour, strength, clip)
        if len(path) > 1:
            axes.plot(*path.T, color=colour, linewidth=2.4, zorder=4, path_effects=casing)
            axes.plot(*path[0], 'o', markersize=7, markerfacecolor='white', markeredgewidth=2.0,
                      markeredgecolor=colour, zorder=5)
    for k, at in enumerate(paths[-1]):
        _draw_ball(axes, at, k + 1, CAMERA_COLOURS[k % len(CAMERA_COLOURS)])
    shown = np.concatenate([clip.get_xy(), *paths])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.03 * (high - low).max()
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin),
             aspect='equal')


def _draw_plan(axes: Axes, room: Room, paths: np.ndarray, max_range: float) -> None:
    """Draw the room from above, to scale, in metres."""
    outline = _draw_discs(axes, room, np.eye(3))
    _draw_cameras(axes, paths[..., :2], max_range, outline)
    axes.set_xlabel('x (m)', fontsize=12, color=PALE_INK)
    axes.set_ylabel('y (m)', fontsize=12, color=PALE_INK)
    axes.tick_params(colors=PALE_INK, labelsize=11)
    axes.spines[:].set_visible(False)


def _draw_cutaway(axes: Axes, room: Room, paths: np.ndarray, max_range: float) -> None:
    """Draw the room in parallel projection with the walls nearest to the viewer taken away."""
    view, part = _open_view(room)
    outline = _draw_discs(axes, part, view)
    floor = float(np.percentile(part.points[:, 2], 2.0))
    for final in paths[-1]:
        foot = np.array([final, [*final[:2], floor]]) @ view[:2].T
        axes.plot(*foot.T, color=INK, linewidth=1.0, linestyle=(0, (2, 2)), zorder=3)
        axes.plot(*foot[1], 'o', color=INK, markersize=3.5, zorder=3)
    _draw_cameras(axes, paths @ view[:2].T, max_range, outline)
    axes.set_axis_off()
    _draw_triad(axes, view)


def _draw_triad(axes: Axes, view: np.ndarray) -> None:
    """Draw the three axes, each of a round length, in the lower left corner."""
    (left, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    lengths = np.array([0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0])
    arm = lengths[max(np.searchsorted(lengths, 0.13 * (right - left)) - 1, 0)]
    arms = arm * view[:2].T
    origin = np.array([left, bottom]) + 0.2 * arm - np.minimum(arms, 0.0).min(axis=0)
    for name, tip in zip('xyz', arms):
        axes.annotate('', origin + tip, origin, zorder=8,
                      arrowprops={'arrowstyle': '-|>', 'color': INK, 'linewidth': 1.6,
                                  'shrinkA': 0.0, 'shrinkB': 0.0})
        axes.annotate(name, origin + tip, 9.0 * tip / np.hypot(*tip), color=INK, fontsize=12,
                      textcoords='offset points', ha='center', va='center', zorder=8)
    axes.annotate(f'{arm:g} m each', (left, bottom + 0.2 * arm), (0.0, -10.0),
                  textcoords='offset points', color=PALE_INK, fontsize=11, va='top')


def _draw_legend(figure: Figure, observed: np.ndarray | None, max_range: float,
                 moved: bool) -> None:
    """Explain the marks in one line below the panels."""
    ladder = np.arange(4.0)[:, None] * (0.0, 0.0, 1.0)
    dot = {'color': PALE_INK, 'linestyle': 'none', 'marker': 'o'}
    entries = {
        'start': Line2D([], [], markersize=8, markerfacecolor='white', markeredgewidth=2.0, **dot),
        'path': Line2D([], [], color=PALE_INK, linewidth=2.4)} if moved else {}
    entries |= {
        'final position': Line2D([], [], markersize=15, **dot),
        f'range {max_range:g} m': Line2D([], [], markersize=17, markerfacecolor='#eceef0', **dot),
        'darker is higher': tuple(Patch(color=c) for c in _colours(ladder, None))}
    if observed is not None:
        share = 100.0 * np.mean(~observed)
        entries[f'not observed ({share:.1f} % of the points)'] = tuple(
            Patch(color=c) for c in _colours(ladder, np.zeros(4, dtype=bool)))
    figure.legend(entries.values(), entries.keys(), loc='lower center', ncols=len(entries),
                  frameon=False, fontsize=13, labelcolor=INK, bbox_to_anchor=(0.5, 0.012),
                  columnspacing=2.4, handler_map={tuple: HandlerTuple(ndivide=None, pad=0.0)})
