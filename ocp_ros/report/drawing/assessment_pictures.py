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

"""The pictures of an assessment: plans, coverage, depth error and perspective views."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, PowerNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
import numpy as np
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.drawing.plan_drawing import (
    camera_colour,
    draw_axis,
    draw_headings,
    draw_letters,
    draw_numbers,
    draw_plan,
    draw_zones,
    edges,
    move_apart,
    reach,
    units_per_inch,
    zone_legend,
)
from ocp_ros.report.drawing.room_drawing import (
    choose_indices,
    cut_open,
    draw_discs,
    eye_at,
    fit_axes,
    HEIGHT_COLOURS,
    heights_of,
    INK,
    PALE_INK,
    Room,
    room_of,
)
from ocp_ros.report.drawing.saved_pictures import save_figure
from ocp_ros.report.facts import count_sentence, SHARE_LABELS
from ocp_ros.rig.sensors import CURRENCY

#: Colours of points seen by 0, 1, 2, and 3 or more cameras; they differ in hue and lightness.
COUNT_COLOURS = ('#d55e00', '#b7d4ea', '#5b9bd0', '#174f8f')
COUNT_NAMES = ('seen by no camera', 'by 1', 'by 2', 'by 3 or more')
#: Colours from small to large errors; without red and green.
ERROR_COLOURS = LinearSegmentedColormap.from_list(
    'errors', ['#f6e8d4', '#f2b96a', '#d55e00', '#7a2c02', '#2b0f00'])


def room_for(assessed: Assessment) -> Room:
    """
    Return the room of a placement for drawing: thinned, without ceiling, wall A at the top.

    :returns: a room of M points, whose ``colours`` (M, 1) are the points' numbers in the scene.
    """
    points = assessed.scene.points.astype(np.float64)
    indices = choose_indices(len(points), max_count=16_000)
    return room_of(points[indices] @ assessed.plan_rotation.T, indices[:, None])


def with_colours(room: Room, colours: np.ndarray) -> Room:
    """Return the room of :func:`room_for` with the colours (N, 3) of the scene's N points."""
    return room._replace(colours=colours[room.colours[:, 0]])


def shaded(room: Room, colours: np.ndarray) -> Room:
    """Return :func:`with_colours`, darker at larger height: walls differ from the floor."""
    room = with_colours(room, colours)
    shade = 1.0 - 0.12 * heights_of(room.points)[:, None]
    return room._replace(colours=np.clip(room.colours * shade, 0.0, 1.0))


def count_colours(assessed: Assessment) -> np.ndarray:
    """Return the colour of each point by the number of cameras that see the point: (N, 3) RGB."""
    palette = np.array([to_rgb(colour) for colour in COUNT_COLOURS])
    return palette[np.minimum(assessed.counts, len(palette) - 1)]


def draw_room_plan(axes: Axes, room: Room, assessed: Assessment, measured: bool = False) -> None:
    """
    Draw the room from above with the cameras and the letters of the walls.

    :param measured: whether to draw the distances to walls and the axes of the coordinates, with
        letters for a page of their own, in place of the ranges of the cameras.
    """
    rotation = assessed.plan_rotation[:2, :2]
    floor_and_ceiling = assessed.scene.bounds[:, 2].tolist()
    ranges = [] if measured else [
        reach(placed.camera.model, placed.pose, floor_and_ceiling) @ rotation.T
        for placed in assessed.placement.cameras]
    # Pale colours, so that marks are readable.
    colours = 0.35 + 0.65 * HEIGHT_COLOURS(heights_of(assessed.scene.points))[:, :3]
    # Beams under the ceiling are left out: they would look like walls. Half of the points stay.
    heights = heights_of(room.points)
    below_beams = room.select(heights <= max(0.85, float(np.median(heights))))
    draw_plan(axes, with_colours(below_beams, colours), ranges)
    # Marks are placed by the limits of the axes, so the axes are fitted first.
    _fit_axes(axes, assessed, 0.1, room.points[:, :2])
    if measured:
        draw_distances(axes, assessed)
        draw_axes(axes, assessed, 0.1 * max(assessed.size))
    draw_marks(axes, assessed, scale=1.7 if measured else 1.0)


def draw_marks(axes: Axes, assessed: Assessment, scale: float) -> None:
    """
    Draw walls with letters and ticks, zones and cameras on a plan.

    A side of the room that is mostly no wall is dashed. Letters of inner walls are moved away from
    cameras and other letters.

    :param scale: size of letters and lines, in multiples of those on the report page.
    """
    (left, bottom), (right, top) = corners = corners_of_plan(assessed)
    # For the sides A to D, clockwise from the top, the x and the y of both ends.
    sides = [((left, right), (top, top)), ((right, right), (top, bottom)),
             ((right, left), (bottom, bottom)), ((left, left), (bottom, top))]
    for wall, (x, y) in zip(assessed.walls, sides):
        axes.plot(x, y, color=INK, linewidth=0.9, linestyle='-' if wall.stands else (0, (3, 3)),
                  zorder=4)
    rotation, positions = assessed.plan_rotation[:2, :2], assessed.plan_positions
    longer = max(assessed.size)
    # Distance of the letters of sides from their walls; those of inner walls have half of it.
    gap = 0.055 * longer
    x, y = corners.mean(axis=0)
    letters = np.array([(x, top + gap), (right + gap, y), (x, bottom - gap), (left - gap, y)])
    style = {'zorder': 5, 'path_effects': [patheffects.withStroke(linewidth=2.5 * scale,
                                                                  foreground='white')]}
    draw_letters(axes, assessed.walls, letters, 10.0 * scale, **style)
    inner_walls = assessed.references.inner
    inner_letters = np.array([rotation @ (wall.position + 0.5 * gap * wall.outward)
                              for wall in inner_walls]).reshape(-1, 2)
    # Letters have 0.17 inches each on the report page.
    spacing = 0.17 * scale * units_per_inch(axes)
    inner_letters = move_apart(inner_letters, spacing, np.concatenate([letters, positions]))
    draw_letters(axes, inner_walls, inner_letters, 7.0 * scale, **style)
    # The zones are in front of the room and the ranges (up to 3.5) and behind the walls (4).
    draw_zones(axes, assessed.objective.rig, rotation, 3.8)
    draw_headings(axes, assessed.placement, positions, 0.07 * longer * rotation, 1.2 * scale)
    draw_numbers(axes, positions, 7.0 * scale, float(np.prod(assessed.size)), letters, always=True)
    # The ticks show distances from the lower left corner.
    for axis, start, length in zip((axes.xaxis, axes.yaxis), corners[0], assessed.size):
        ticks = _tick_distances(length)
        axis.set_ticks(start + ticks, [f'{tick:g}' for tick in ticks])
    axes.tick_params(colors=PALE_INK, labelsize=6.5 * scale, length=2.0, pad=1.5)


def _tick_distances(length: float) -> np.ndarray:
    """Return 0 and about five round distances up to a length, metres: (T,), T ticks."""
    steps = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0]
    step = steps[min(np.searchsorted(steps, length / 6.0), len(steps) - 1)]
    return np.arange(0.0, length + 1e-6, step)


def corners_of_plan(assessed: Assessment) -> np.ndarray:
    """Return the lower left and the upper right corner of the plan: (2, 2) metres."""
    top, right, bottom, left = (wall.offset for wall in assessed.walls)
    return np.array([[-left, -bottom], [right, top]])


def _fit_axes(axes: Axes, assessed: Assessment, margin: float, *shown: np.ndarray) -> None:
    """
    Fit the axes to walls, cameras and other places.

    :param margin: as a share of the longer edge.
    :param shown: other places, (M, 2) metres, plan frame.
    """
    places = [assessed.plan_positions, corners_of_plan(assessed), *shown]
    fit_axes(axes, np.concatenate(places), margin)
    axes.spines[:].set_visible(False)


def draw_count_map(axes: Axes, room: Room, assessed: Assessment) -> None:
    """Draw the room from above, coloured by the number of cameras that see each point."""
    draw_discs(axes, shaded(room, count_colours(assessed)), np.eye(3), contrast=0.25)
    _finish_map(axes, room, assessed)


def draw_error_map(axes: Axes, room: Room, assessed: Assessment) -> AxesImage:
    """
    Draw a map of the depth error in millimetres for each square metre of the plan.

    :returns: the image, for a colour bar.
    """
    # The room in grey, below the map.
    pale_colours = np.full((len(assessed.scene), 3), 0.88)
    draw_discs(axes, shaded(room, pale_colours), np.eye(3), contrast=0.5)
    flat = assessed.scene.points.astype(np.float64) @ assessed.plan_rotation[:2].T
    low, size = flat.min(axis=0), np.ptp(flat, axis=0)
    cells_along_room, min_edge_m, max_edge_m = 48, 0.1, 0.5
    edge = float(np.clip(size.max() / cells_along_room, min_edge_m, max_edge_m))
    shape = np.floor(size / edge).astype(int) + 1
    # The number of each point's cell, and the sum of the errors in each cell.
    cells = np.ravel_multi_index(tuple(np.floor((flat - low) / edge).astype(int).T), shape)
    sums = np.bincount(cells, assessed.error_by_point, minlength=shape.prod()).reshape(shape)
    density = 1000.0 * sums / edge ** 2
    # The scale of colours ends at this percentile of the cells with an error. The scale must not
    # be empty if there is hardly any error.
    percentile = float(np.percentile(density[density > 0.0], 99.0)) if density.any() else 0.0
    maximum = max(percentile, 1.0)
    # Cells below a hundredth of the maximum stay transparent, so that the room is visible.
    image = axes.imshow(np.ma.masked_less(density.T, 0.01 * maximum), cmap=ERROR_COLOURS,
                        norm=PowerNorm(0.5, 0.0, maximum), origin='lower', zorder=2,
                        extent=(low[0], low[0] + shape[0] * edge, low[1],
                                low[1] + shape[1] * edge))
    _finish_map(axes, room, assessed)
    return image


def _finish_map(axes: Axes, room: Room, assessed: Assessment) -> None:
    """Fit the axes of a map to the room, remove the ticks, and draw the cameras' numbers."""
    axes.set_xticks([])
    axes.set_yticks([])
    _fit_axes(axes, assessed, 0.02, room.points[:, :2])
    draw_numbers(axes, assessed.plan_positions, 5.0, float(np.prod(assessed.size)))


def draw_perspective(axes: Axes, room: Room, assessed: Assessment, azimuth: float) -> None:
    """
    Draw the room in perspective without the front walls, coloured by the number of cameras.

    :param azimuth: radians, direction of the viewer in the frame of the plan: 0 is to the right.
    """
    room = shaded(room, count_colours(assessed))
    eye = eye_at(room.points, azimuth)
    shown_room = cut_open(room, eye.view)
    outline = draw_discs(axes, shown_room, eye.view, eye, 0.5)
    floor = float(np.percentile(room.points[:, 2], 2.0))
    # Frusta are drawn with at most this length, metres, not with their full range.
    max_length = min(0.15 * float(np.ptp(room.points, axis=0).max()), 1.2)
    positions = assessed.positions @ assessed.plan_rotation.T
    drawn_points = [outline.get_xy(), eye(positions)]
    for number, (placed, position) in enumerate(zip(assessed.placement.cameras, positions)):
        model = placed.camera.model
        lines = edges(model, placed.pose, min(max_length, model.max_range))
        frustum = eye(lines @ assessed.plan_rotation.T)
        drawn_points.append(frustum)
        axes.plot(*frustum.T, color=camera_colour(number), linewidth=0.7, zorder=4)
        # A dashed line from the camera down to the floor.
        axes.plot(*eye(np.stack([position, [*position[:2], floor]])).T, color=INK, linewidth=0.6,
                  linestyle=(0, (2, 2)), zorder=3)
    fit_axes(axes, np.concatenate(drawn_points), 0.02)
    axes.set_axis_off()
    # The outline of a room in perspective fills about half of the rectangle around it.
    draw_numbers(axes, eye(positions), 5.0, 0.5 * float(np.prod(np.ptp(outline.get_xy(), axis=0))))


def draw_floor_plan(path: Path, assessed: Assessment) -> None:
    """Write the installer's plan as PNG."""
    save_figure(floor_plan_of(assessed), path, dpi=100)


def floor_plan_of(assessed: Assessment) -> Figure:
    """Return the installer's plan: the room, wall A at the top, cameras, measured distances."""
    longer_edge_inches, min_edge_inches = 10.0, 4.5
    inches_per_m = longer_edge_inches / max(assessed.size)
    edges_inches = [max(inches_per_m * edge, min_edge_inches) for edge in assessed.size]
    figure = Figure(figsize=edges_inches, dpi=100, facecolor='white')
    axes = figure.add_axes((0.05, 0.08, 0.9, 0.9))
    draw_room_plan(axes, room_for(assessed), assessed, measured=True)
    legend = zone_legend(assessed.objective.rig)
    if legend:
        figure.legend(legend.values(), legend.keys(), loc='lower center', frameon=False,
                      ncols=len(legend), fontsize=10, labelcolor=INK)
    return figure


def draw_curve(path: Path, findings: Mapping[str, Any]) -> None:
    """
    Write a PNG of shares and depth error by the number of cameras.

    :param path: file to write.
    :param findings: those of a plan that counted cameras, with ``curve`` and ``count``.
    """
    rows, count = findings['curve'], findings['count']
    figure = Figure(figsize=(7.0, 4.5), dpi=100, facecolor='white')
    axes = figure.add_subplot()
    cameras = [row['cameras'] for row in rows]
    for (name, (_, label)), style in zip(SHARE_LABELS.items(), ('o-', 's--', '^:')):
        axes.plot(cameras, [100.0 * row[f'share_{name}'] for row in rows], style,
                  color=INK if name == count['by'] else PALE_INK, label=label)
    axes.axhline(100.0 * count['target'], color=INK, lw=0.8, ls=':')
    axes.set(xlabel='cameras', ylabel='per cent', xticks=cameras, ylim=(0.0, 102.0))
    error = axes.twinx()
    error.plot(cameras, [row['depth_error'] for row in rows], 'x-', color='tab:red',
               label='depth error')
    error.set_ylim(bottom=0.0)
    error.set_ylabel('depth error (m)', color='tab:red')
    axes.legend(loc='center right', fontsize=8)
    axes.set_title(count_sentence(count), fontsize=9)
    figure.tight_layout()
    save_figure(figure, path, dpi=100)


def draw_front(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """
    Write a PNG of the Pareto front: depth error by price, with the cameras of each point.

    :param path: file to write.
    :param rows: ``front`` of the findings of a plan that counted cameras.
    """
    figure = Figure(figsize=(7.0, 4.5), dpi=100, facecolor='white')
    axes = figure.add_subplot()
    axes.step([row['price'] for row in rows], [row['depth_error'] for row in rows],
              where='post', color=PALE_INK, lw=0.8)
    for planned, style, label in ((True, 'o', 'plan'), (False, 'x', 'estimate, without a search')):
        some = [row for row in rows if row['planned'] == planned]
        axes.plot([row['price'] for row in some], [row['depth_error'] for row in some], style,
                  color=INK if planned else PALE_INK, label=label)
    for row in rows:
        axes.annotate(row['mix'], (row['price'], row['depth_error']), (2, 5),
                      textcoords='offset points', fontsize=6, color=INK, rotation=60)
    # Space for the names of the first and of the last cameras.
    axes.margins(x=0.15)
    axes.set(xlabel=f'price ({CURRENCY}, or that of the rig file)', ylabel='depth error (m)',
             ylim=(0.0, 1.4 * max(row['depth_error'] for row in rows)))
    axes.legend(fontsize=8)
    figure.tight_layout()
    save_figure(figure, path, dpi=100)


def draw_axes(axes: Axes, assessed: Assessment, length: float) -> None:
    """Draw the coordinate axes, ``length`` metres long, at the corner next to the origin."""
    rotation = assessed.plan_rotation[:2, :2]
    corner = rotation @ assessed.corner.position
    # Move the axes from the corner into the room.
    corner = corner + 0.15 * length * np.sign(corners_of_plan(assessed).mean(axis=0) - corner)
    for name, axis_vector in zip('xyz', np.eye(3)):
        direction = assessed.frame.to_map(axis_vector) - assessed.frame.to_map(np.zeros(3))
        direction = rotation @ direction[:2] / np.linalg.norm(direction)
        # Axes steeper than 60 degrees are left out. In the plan their unit vectors are shorter
        # than 0.5.
        if np.linalg.norm(direction) < 0.5:
            continue
        draw_axis(axes, name, corner, length * direction)


def draw_distances(axes: Axes, assessed: Assessment) -> None:
    """Draw the measured distances: dashed lines, with the numbers where there is space."""
    rotation = assessed.plan_rotation[:2, :2]
    # Smallest length of a line whose distance is written, metres. A text needs half of it as free
    # space around its centre.
    min_length = 0.15 * max(assessed.size)
    positions = assessed.plan_positions
    # Positions of cameras and written distances, which must not be covered.
    occupied = positions
    for position, distances in zip(positions, assessed.references.distances):
        for distance in distances:
            foot = rotation @ distance.foot
            axes.plot(*np.stack([position, foot]).T, color=INK, lw=0.8, ls=(0, (2, 2)), zorder=4)
            # The number is on the line, a little nearer to the wall than to the camera.
            label = 0.4 * position + 0.6 * foot
            has_space = np.linalg.norm(occupied - label, axis=1).min() > 0.5 * min_length
            if has_space and np.linalg.norm(foot - position) > min_length:
                # The text is parallel to the line and never upside down.
                angle = np.rad2deg(np.arctan2(*(foot - position)[::-1]))
                axes.text(label[0], label[1], f'{100.0 * distance.metres:.0f} cm', fontsize=8,
                          color=INK, ha='center', va='center', zorder=4.5,
                          rotation=(angle + 90.0) % 180.0 - 90.0,
                          bbox={'facecolor': 'white', 'edgecolor': 'none', 'pad': 1.0})
                occupied = np.vstack([occupied, label])
