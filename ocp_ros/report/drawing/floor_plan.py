# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The plan beside the installer's page: walls with their letters, cameras and where they look."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from ocp_ros.report.assessment import Assessment
from ocp_ros.report.drawing.figures import save_figure
from ocp_ros.report.drawing.plan_marks import (
    draw_headings,
    draw_inner_letters,
    draw_letters,
    draw_numbers,
    draw_scale_bar,
    draw_zones,
    zone_legend,
)
from ocp_ros.report.drawing.room_drawing import INK, PALE_INK

#: Metres above the floor and below the ceiling that a plan leaves out, and points that it shows.
LOW, HIGH, SHOWN = 0.15, 0.4, 12000
#: Points: size of the cameras' numbers, of the letters of sides, and of walls inside the room.
NUMBERS, LETTERS, INNER = 12.0, 20.0, 13.0
#: How long the line of a distance is at least that is written beside it, in margins of the plan.
MEASURED = 3.0
#: Inches: the longer edge of the plan, and the least of the shorter one.
LONG, SHORT = 10.0, 4.5


def draw_plan(path: Path, judged: Assessment) -> None:
    """Write the plan as PNG."""
    save_figure(figure_of(judged), path, dpi=100)


def figure_of(judged: Assessment) -> Figure:
    """Draw the room from above, wall A at the top, its cameras and what they are measured from."""
    scene, placement, walls = judged.scene, judged.placement, judged.walls
    frame = np.stack([walls[1].outward, walls[0].outward])
    low, high = scene.bounds[:, 2]
    points = scene.points[(scene.points[:, 2] > low + LOW) & (scene.points[:, 2] < high - HIGH)]
    flat = points[::max(len(points) // SHOWN, 1), :2] @ frame.T
    sides = [wall.offset for wall in walls]
    x, y = (sides[1], -sides[3]), (sides[0], -sides[2])
    figure = Figure(figsize=_inches(x[0] - x[1], y[0] - y[1]), dpi=100, facecolor='white')
    axes = figure.add_axes((0.05, 0.05, 0.9, 0.9), aspect='equal')
    axes.set_axis_off()
    axes.scatter(*flat.T, s=2.0, color=PALE_INK, alpha=0.4, linewidths=0.0)
    axes.plot([x[0], x[0], x[1], x[1], x[0]], [y[0], y[1], y[1], y[0], y[0]], color=INK, lw=1.0)
    margin = 0.05 * max(wall.length for wall in walls)
    letters = np.array([(np.mean(x), y[0] + margin), (x[0] + margin, np.mean(y)),
                        (np.mean(x), y[1] - margin), (x[1] - margin, np.mean(y))])
    draw_letters(axes, walls, letters, LETTERS)
    places = np.array([frame @ placed.position[:2] for placed in placement.cameras])
    letters = np.concatenate([letters, _draw_distances(axes, judged, places, frame, margin)])
    corners = np.concatenate([places, np.column_stack([x, y])])
    low, high = corners.min(axis=0) - 2.0 * margin, corners.max(axis=0) + 2.0 * margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    draw_zones(axes, judged.objective.rig, frame, 1.5)
    explained = zone_legend(judged.objective.rig)
    if explained:
        figure.legend(explained.values(), explained.keys(), loc='lower center', frameon=False,
                      ncols=len(explained), fontsize=10, labelcolor=INK)
    draw_headings(axes, placement, places, 2.0 * margin * frame, 2.0)
    draw_numbers(axes, places, NUMBERS, (x[0] - x[1]) * (y[0] - y[1]), letters, always=True)
    draw_scale_bar(axes, 10.0)
    return figure


def _inches(width: float, depth: float) -> tuple[float, float]:
    """Return width and height of a picture that a room of so many metres fills."""
    scale = LONG / max(width, depth)
    return max(scale * width, SHORT), max(scale * depth, SHORT)


def _write_distance(axes: Axes, middle: np.ndarray, way: np.ndarray, away: float) -> None:
    """Write a distance along its line."""
    turn = np.rad2deg(np.arctan2(way[1], way[0]))
    axes.text(middle[0], middle[1], f'{100.0 * away:.0f} cm', fontsize=8, color=INK,
              ha='center', va='center', rotation=(turn + 90.0) % 180.0 - 90.0,
              bbox={'facecolor': 'white', 'edgecolor': 'none', 'pad': 1.0}, zorder=3.0)


def _draw_distances(axes: Axes, judged: Assessment, places: np.ndarray, frame: np.ndarray,
                    margin: float) -> np.ndarray:
    """Draw what is measured, and the letters of walls inside the room; return where: (M, 2)."""
    # Where cameras stand and distances are written: nothing is written over these.
    taken = places
    for place, distances in zip(places, judged.references.distances):
        for distance in distances:
            at = frame @ distance.at
            axes.plot(*np.stack([place, at]).T, color=INK, lw=0.8, ls=(0, (2, 2)))
            middle = 0.4 * place + 0.6 * at
            free = np.linalg.norm(taken - middle, axis=1).min() > 1.5 * margin
            if free and np.linalg.norm(at - place) > MEASURED * margin:
                _write_distance(axes, middle, at - place, distance.away)
                taken = np.vstack([taken, middle])
    return draw_inner_letters(axes, judged.references.inner, frame, 0.4 * margin, 0.6 * margin,
                              places, INNER)
