# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One page that says at a glance what a placement is worth and how to hang it up."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch, Patch
import numpy as np

from ocp_ros.report.assessment import Assessment
from ocp_ros.report.drawing import assessment_pictures
from ocp_ros.report.drawing.camera_labels import camera_colour, dark
from ocp_ros.report.drawing.figure_files import save_figure
from ocp_ros.report.drawing.figure_table import draw_table, shortened
from ocp_ros.report.drawing.fonts import all_letters
from ocp_ros.report.drawing.room_drawing import INK, PALE_INK
from ocp_ros.report.drawing.zone_drawing import zone_legend
from ocp_ros.report.key_figures import Figures, figures_of

#: Inches: A4 on its side, its margins, and dots of each.
WIDTH, HEIGHT, MARGIN, DOTS = 11.69, 8.27, 0.4, 150
#: Cameras that the table has room for, and inches of a row; more cameras have lower rows.
MOST, ROW, LOW_ROW, FEW = 20, 0.175, 0.135, 9
#: Inches: left edge of the maps.
MAPS = 4.42
GOOD, BAD = '#00664d', '#b04a00'
#: Doubts about the room that there is space for.
DOUBTS = 2
#: Where the viewer stands: before the corners C and D, B and C, A and B, D and A.
CORNERS = {'C and D': -125.0, 'B and C': -55.0, 'A and B': 55.0, 'D and A': 125.0}


def draw(path: str | Path, judged: Assessment) -> None:
    """
    Write the page as PNG, A4 on its side.

    :param path: file to write; its folder is made.
    :param judged: the placement and what was found of it.
    """
    with all_letters():
        save_figure(_figure(judged), path, dpi=DOTS)


def figure_of(judged: Assessment) -> Figure:
    """Draw the page."""
    with all_letters():
        return _figure(judged)


def _figure(judged: Assessment) -> Figure:
    """Draw the page in the fonts that are set."""
    figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DOTS, facecolor='white')
    stage = assessment_pictures.stage_of(judged)
    _draw_head(figure, judged)
    bottom = _draw_cameras(figure, judged) + 0.42
    high = 6.52 - bottom
    plan = _axes(figure, MARGIN + 0.15, bottom + 0.1, 3.7, high - 0.1)
    assessment_pictures.draw_room_plan(plan, stage, judged)
    _title(figure, MARGIN, 'Plan: what each camera could reach (m along the walls)')
    half = 0.5 * (high - 0.32)
    counts = _axes(figure, MAPS, bottom + half + 0.32, 2.1, half)
    assessment_pictures.draw_count_map(counts, stage, judged)
    _title(figure, MAPS, 'Seen by how many cameras')
    errors = _axes(figure, MAPS, bottom, 2.1, half)
    image = assessment_pictures.draw_error_map(errors, stage, judged)
    _title(figure, MAPS, 'Where the depth error is', bottom + half + 0.14)
    bar = figure.colorbar(image, cax=_axes(figure, MAPS + 2.14, bottom + 0.1, 0.07, half - 0.2))
    bar.set_label('depth error per floor area (mm/m²)', fontsize=6, color=PALE_INK, labelpad=2.0)
    bar.set_ticks(_few_ticks(image.norm.vmax))
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=5.5, colors=PALE_INK, length=1.5, pad=1.0)
    bar.outline.set_visible(False)
    _draw_looks(figure, stage, judged, bottom, half)
    _draw_legend(figure, bottom - 0.16, judged)
    return figure


def _axes(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Add axes, inches."""
    return figure.add_axes((left / WIDTH, bottom / HEIGHT, width / WIDTH, height / HEIGHT))


def _title(figure: Figure, left: float, text: str, y: float = 6.66) -> None:
    """Write what a picture shows above it, inches."""
    figure.text(left / WIDTH, y / HEIGHT, text, fontsize=8, fontweight='bold', color=INK,
                va='center')


def _few_ticks(most: float) -> np.ndarray:
    """Return 0 and a few round values up to the most of a colour bar, spread by their roots."""
    unit = 10.0 ** np.floor(np.log10(most))
    top = np.floor(most / unit) * unit
    return np.array([0.0, 0.1 * top, 0.4 * top, top])


def _draw_head(figure: Figure, judged: Assessment) -> None:
    """Write the room's name, what stands in it, and the key figures."""
    found: Figures = figures_of(judged)
    figure.text(MARGIN / WIDTH, 7.92 / HEIGHT, shortened(found.title, 7.0, 15, True), fontsize=15,
                fontweight='bold', color=INK, va='center')
    figure.text(MARGIN / WIDTH, 7.66 / HEIGHT,
                shortened(found.subtitle, 4.6 if found.doubts else 10.8, 8), fontsize=8,
                color=PALE_INK, va='center')
    figure.text((WIDTH - MARGIN) / WIDTH, 7.92 / HEIGHT, shortened(found.verdict, 3.6, 9.5, True),
                fontsize=9.5, fontweight='bold', va='center', ha='right',
                color=GOOD if found.kept else BAD)
    for number, doubt in enumerate(found.doubts[:DOUBTS]):
        more = len(found.doubts) - DOUBTS
        text = f'{doubt} (and {more} more)' if more > 0 and number == DOUBTS - 1 else doubt
        figure.text((WIDTH - MARGIN) / WIDTH, (7.72 - 0.13 * number) / HEIGHT,
                    shortened(text, 6.0, 6.2), fontsize=6.2, va='center', ha='right', color=BAD)
    gap = 0.12
    wide = (WIDTH - 2.0 * MARGIN - gap * (len(found.cards) - 1)) / len(found.cards)
    for number, (label, value, more) in enumerate(found.cards):
        left = MARGIN + number * (wide + gap)
        figure.add_artist(FancyBboxPatch(
            (left / WIDTH, 6.84 / HEIGHT), wide / WIDTH, 0.62 / HEIGHT, linewidth=0,
            facecolor='#f1f3f5', boxstyle='round,pad=0,rounding_size=0.004',
            transform=figure.transFigure))
        for text, size, y, colour, bold in (
                (label, 6.5, 7.36, PALE_INK, False), (value, 12.5, 7.16, INK, True),
                (more, 6.5, 6.94, PALE_INK, False)):
            figure.text((left + 0.09) / WIDTH, y / HEIGHT,
                        shortened(text, wide - 0.18, size, bold), fontsize=size, color=colour,
                        va='center', fontweight='bold' if bold else 'normal')


def _draw_looks(figure: Figure, stage: assessment_pictures.Stage, judged: Assessment,
                bottom: float, half: float) -> None:
    """Draw four looks into the room."""
    left, wide = 7.15, 2.02
    for number, (corner, azimuth) in enumerate(CORNERS.items()):
        x = left + (number % 2) * (wide + 0.1)
        y = bottom + (1 - number // 2) * (half + 0.32)
        assessment_pictures.draw_look(_axes(figure, x, y, wide, half), stage, judged,
                                      np.deg2rad(azimuth))
        _title(figure, x, f'From the corner of {corner}',
               6.66 if number < 2 else bottom + half + 0.14)


def _draw_legend(figure: Figure, y: float, judged: Assessment) -> None:
    """Explain the marks of all pictures in one line, inches from the bottom."""
    entries = {'camera': Line2D([], [], color=camera_colour(0), marker='o', markersize=6,
                                linestyle='none'),
               'field of view and range': Patch(facecolor='#cfe3f0', edgecolor='#0072b2'),
               'no wall stands': Line2D([], [], color=INK, linewidth=0.9, linestyle=(0, (3, 3)))}
    if all(wall.stands for wall in judged.walls):
        del entries['no wall stands']
    entries |= {name: Patch(facecolor=colour)
                for name, colour in zip(assessment_pictures.COUNT_NAMES,
                                        assessment_pictures.COUNT_COLOURS)}
    entries |= zone_legend(judged.objective.rig)
    figure.legend(entries.values(), entries.keys(), loc='center', ncols=len(entries),
                  frameon=False, labelcolor=INK,
                  fontsize=7 if len(entries) < 8 else 6.2, columnspacing=1.6, handlelength=1.4,
                  bbox_to_anchor=(0.5, y / HEIGHT), borderpad=0.0, borderaxespad=0.0)


def _draw_cameras(figure: Figure, judged: Assessment) -> float:
    """Draw the installer's table; return how high it reaches, inches."""
    placed, left_out = judged.placement.cameras, len(judged.placement.cameras) - MOST
    rows = [['', 'camera', 'sensor', 'place', 'height', 'pan', 'tilt', 'x, y, z',
             'error reduction']]
    for number, (one, words, added) in enumerate(zip(
            placed[:MOST], judged.words, judged.found['scores']['cameras']), start=1):
        name = f'{words.name} (fixed)' if one.mount == 'fixed' else words.name
        sensor = '' if words.name.startswith(words.sensor) else words.sensor
        rows.append([str(number), name, sensor, words.place,
                     words.height.replace(' above the floor', ''), words.pan, words.tilt,
                     words.coordinates, f'{added["depth_error"]:.3f} m'])
    if not any(row[2] for row in rows[1:]):
        rows = [[*row[:2], *row[3:]] for row in rows]
    step = ROW if len(rows) - 1 <= FEW else LOW_ROW
    high = step * len(rows)
    draw_table(figure, (MARGIN, 0.42, WIDTH - 2.0 * MARGIN, high), rows,
               7.2 if step == ROW else 6.2,
               [dark(camera_colour(number)) for number in range(len(rows) - 1)])
    found = figures_of(judged)
    foot = found.foot if left_out <= 0 else f'{left_out} more cameras: installer.md. {found.foot}'
    figure.text(MARGIN / WIDTH, 0.22 / HEIGHT, shortened(foot, WIDTH - 2.0 * MARGIN, 6.2),
                fontsize=6.2, color=PALE_INK, va='center')
    return 0.42 + high
