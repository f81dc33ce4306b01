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

"""Pictures of rooms cut open: alone, or with the cameras, paths and ranges of a placement."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np
from ocp_ros.report.drawing.plan_drawing import (
    camera_colour,
    draw_axis,
    draw_numbers,
    draw_plan,
)
from ocp_ros.report.drawing.room_drawing import (
    choose_indices,
    draw_discs,
    fit_axes,
    HEIGHT_COLOURS,
    heights_of,
    INK,
    open_view,
    PALE_INK,
    Room,
    room_of,
)
from ocp_ros.report.drawing.saved_pictures import save_figure
from ocp_ros.scenes.scene import Scene

#: Colour of points that no camera sees; no camera has this colour.
UNOBSERVED = '#c44e3b'


def draw_placement(path: Path, points: np.ndarray, observed: np.ndarray, paths: np.ndarray,
                   max_range: float, title: str, subtitle: str) -> None:
    """
    Write a PNG of 1800 x 950 pixels: a plan of the room and a view into it.

    :param path: file to write; its folder is created.
    :param points: (N, 3) the N points of the whole room, metres, map frame, z up.
    :param observed: (N,) bool, points that the final placement sees.
    :param paths: (T, K, 3) metres, positions of the K cameras after each of T turns; row 0 is the
        start.
    :param max_range: range of every camera, metres.
    :param title: headline.
    :param subtitle: line of numbers below the headline.
    """
    room = room_of(points.astype(np.float64), height_colours(points, observed))
    figure = Figure(figsize=(18.0, 9.5), dpi=100, facecolor='white')
    figure.text(0.03, 0.945, title, fontsize=21, fontweight='bold', color=INK, va='center',
                parse_math=False)
    figure.text(0.03, 0.9, subtitle, fontsize=14, color=PALE_INK, va='center', parse_math=False)
    draw_paths_on_plan(figure.add_axes((0.045, 0.13, 0.44, 0.73)), room, paths, max_range)
    _draw_cutaway(figure.add_axes((0.505, 0.1, 0.485, 0.77)), room, paths)
    draw_legend(figure, max_range, f' ({100.0 * np.mean(~observed):.1f} % of the points)')
    save_figure(figure, path, dpi=100)


def height_colours(points: np.ndarray, observed: np.ndarray | None) -> np.ndarray:
    """
    Return the colours of points by height, in red for unobserved points: (N, 3) RGB.

    :param points: (N, 3) metres, z up.
    :param observed: (N,) bool; None if all points are observed.
    """
    height = heights_of(points)
    colours = HEIGHT_COLOURS(height)[:, :3]
    if observed is not None:
        # The lightness still shows the height.
        red = 1.1 * np.array(to_rgb(UNOBSERVED)) * (1.0 - 0.5 * height[~observed, None])
        colours[~observed] = 0.45 * colours[~observed] + 0.55 * red
    return colours


def draw_paths_on_plan(axes: Axes, room: Room, paths: np.ndarray, max_range: float) -> None:
    """
    Draw the room from above, to scale, in metres, with the cameras' paths and ranges.

    :param paths: (T, K, 3) metres, see :func:`draw_placement`.
    :param max_range: range of every camera, metres.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, 100)
    circle = max_range * np.column_stack([np.cos(angles), np.sin(angles)])
    # Without a filling, so that points which no camera sees stay red.
    draw_plan(axes, room, paths[-1, :, None, :2] + circle, fill=0.0)
    _draw_paths(axes, paths[..., :2], room.points[:, :2])
    axes.set_xlabel('x (m)', fontsize=12, color=PALE_INK)
    axes.set_ylabel('y (m)', fontsize=12, color=PALE_INK)
    axes.tick_params(colors=PALE_INK, labelsize=11)
    axes.spines[:].set_visible(False)


def _draw_cutaway(axes: Axes, room: Room, paths: np.ndarray) -> None:
    """Draw the room in parallel projection without front walls, with the cameras' paths."""
    view, shown_room = open_view(room)
    draw_discs(axes, shown_room, view)
    floor = float(np.percentile(shown_room.points[:, 2], 2.0))
    # A dashed line from each camera down to the floor.
    for position in paths[-1]:
        vertical = np.array([position, [*position[:2], floor]]) @ view[:2].T
        axes.plot(*vertical.T, color=INK, linewidth=1.0, linestyle=(0, (2, 2)), zorder=3)
        axes.plot(*vertical[1], 'o', color=INK, markersize=3.5, zorder=3)
    _draw_paths(axes, paths @ view[:2].T, shown_room.points @ view[:2].T)
    axes.set_axis_off()
    _draw_triad(axes, view)


def _draw_paths(axes: Axes, paths: np.ndarray, points: np.ndarray) -> None:
    """
    Draw the paths of the cameras from their starts, with numbers at the ends, and fit the axes.

    :param paths: (T, K, 2) metres, positions in the picture of the K cameras in T turns.
    :param points: (N, 2) metres, the room in the picture.
    """
    fit_axes(axes, np.concatenate([points, *paths]), 0.03)
    effects = [patheffects.withStroke(linewidth=4.5, foreground='white')]
    for camera, path in enumerate(paths.swapaxes(0, 1)):
        colour = camera_colour(camera)
        axes.plot(*path.T, color=colour, linewidth=2.4, zorder=4, path_effects=effects)
        axes.plot(*path[0], 'o', markersize=7, markerfacecolor='white', markeredgewidth=2.0,
                  markeredgecolor=colour, zorder=5)
    draw_numbers(axes, paths[-1], 11.0, float(np.prod(np.ptp(points, axis=0))), always=True)


def _draw_triad(axes: Axes, view: np.ndarray) -> None:
    """Draw the axes x, y and z, each of a round length, in the lower left corner."""
    (left, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    # The largest round length up to 13 % of the width of the picture.
    lengths = np.array([0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0])
    length = lengths[max(np.searchsorted(lengths, 0.13 * (right - left)) - 1, 0)]
    axis_vectors = length * view[:2].T
    # The leftmost and the lowest end of the arrows are 0.2 lengths from the corner.
    origin = np.array([left, bottom]) + 0.2 * length - np.minimum(axis_vectors, 0.0).min(axis=0)
    for name, tip in zip('xyz', axis_vectors):
        draw_axis(axes, name, origin, tip)
    axes.annotate(f'{length:g} m each', (left, bottom + 0.2 * length), (0.0, -10.0),
                  textcoords='offset points', color=PALE_INK, fontsize=11, va='top')


def draw_legend(figure: Figure, max_range: float, unseen: str) -> None:
    """
    Draw a legend below the panels.

    :param unseen: text after "not observed".
    """
    # Four points at different heights, whose colours the legend shows.
    points = np.arange(4.0)[:, None] * (0.0, 0.0, 1.0)
    style = {'color': PALE_INK, 'linestyle': 'none', 'marker': 'o'}
    entries = {
        'start': Line2D([], [], markersize=8, markerfacecolor='white', markeredgewidth=2.0,
                        **style),
        'path': Line2D([], [], color=PALE_INK, linewidth=2.4),
        'final position': Line2D([], [], markersize=15, **style),
        f'range {max_range:g} m': Line2D([], [], markersize=17, markerfacecolor='none', **style),
        'darker is higher': tuple(Patch(color=colour) for colour in height_colours(points, None)),
        f'not observed{unseen}': tuple(Patch(color=colour) for colour in height_colours(
            points, np.zeros(4, dtype=bool)))}
    figure.legend(entries.values(), entries.keys(), loc='lower center', ncols=len(entries),
                  frameon=False, fontsize=13, labelcolor=INK, bbox_to_anchor=(0.5, 0.012),
                  columnspacing=2.4, handler_map={tuple: HandlerTuple(ndivide=None, pad=0.0)})


def draw_rooms(path: Path, scenes: Sequence[tuple[str, Scene]], columns: int = 4) -> None:
    """
    Write a PNG of rooms cut open.

    :param path: file to write; its folder is created.
    :param scenes: title and room of each part of the picture.
    :param columns: largest number of rooms in a row.
    """
    columns = min(columns, len(scenes))
    # The quotient is rounded up.
    rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(5.0 * columns, 4.2 * rows), dpi=75, facecolor='white')
    for number, (title, scene) in enumerate(scenes):
        axes = figure.add_axes(((number % columns + 0.02) / columns,
                                (rows - 1 - number // columns + 0.02) / rows,
                                0.96 / columns, 0.86 / rows))
        points = scene.points[choose_indices(len(scene), max_count=20_000)]
        view, shown_room = open_view(room_of(points, height_colours(points, None)))
        fit_axes(axes, draw_discs(axes, shown_room, view).get_xy())
        axes.set_axis_off()
        axes.set_title(title, fontsize=12, color=INK, parse_math=False)
    save_figure(figure, path, dpi=75)
