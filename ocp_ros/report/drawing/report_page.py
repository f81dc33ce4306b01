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

"""The report page of a placement: key figures, pictures and the installer's table."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch, Patch
import numpy as np
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.drawing import assessment_pictures
from ocp_ros.report.drawing.plan_marks import camera_colour, dark, zone_legend
from ocp_ros.report.drawing.room_drawing import INK, PALE_INK
from ocp_ros.report.drawing.saved_pictures import all_letters, draw_table, save_figure, write
from ocp_ros.report.facts import page_facts_of, PageFacts

#: Width, height and margin of A4 landscape, inches.
PAGE_WIDTH = 11.69
PAGE_HEIGHT = 8.27
MARGIN = 0.4
#: Inches between the margins.
INSIDE = PAGE_WIDTH - 2.0 * MARGIN
DOTS_PER_INCH = 150
#: Largest number of cameras in the table of the first page.
MOST_ROWS = 20
#: Height of a row of the table, and of a row with more cameras than :data:`FEW_ROWS`, inches.
ROW = 0.175
LOW_ROW = 0.135
FEW_ROWS = 9
#: Lower edge of the table, inches.
TABLE_BOTTOM = 0.42
#: Height of a picture's title, inches.
TITLE = 0.32
#: Smallest and largest width of the plan, inches.
PLAN_WIDTHS = (1.8, 3.7)
#: Width of a map, inches.
MAP_WIDTH = 2.1
#: Ratio of width to depth of a room above which the maps are below the plan.
WIDE_RATIO = 1.6
#: Widths of plan and map then, inches.
WIDE_PLAN = 6.0
WIDE_MAP = 2.85
#: Files of the pages; the second page has the table if it does not fit on the first one.
PAGES = ('report.png', 'report_2.png')
DEPTH_ERROR = ('Depth error: how much deeper the room looks when only the points that the cameras '
               'see are left; five times the mean over viewpoints and directions. '
               '0 m is perfect.')
GOOD = '#00664d'
BAD = '#b04a00'
#: Largest number of doubts about the room on the page.
MOST_DOUBTS = 2
#: Azimuth of the viewer at each corner of two walls, degrees.
CORNERS = {'C, D': -125.0, 'B, C': -55.0, 'A, B': 55.0, 'D, A': 125.0}
#: Left, bottom, width and height, inches.
Box: TypeAlias = tuple[float, float, float, float]


def draw(folder: Path, assessed: Assessment) -> Iterator[Path]:
    """
    Write the pages as PNG, A4 landscape, and yield each path: one, or two with many cameras.

    :param folder: it is created if it does not exist.
    """
    for name, figure in zip(PAGES, figures_of_pages(assessed)):
        with all_letters():
            save_figure(figure, folder / name, dpi=DOTS_PER_INCH)
        yield folder / name


def figures_of_pages(assessed: Assessment) -> Iterator[Figure]:
    """Draw the pages: pictures with the table; a long table has its own page."""
    with all_letters():
        facts = page_facts_of(assessed)
        pages = [_pictures(assessed, facts)]
        if len(assessed.placement.cameras) > MOST_ROWS:
            pages.append(_table_page(assessed, facts))
    yield from pages


def _pictures(assessed: Assessment, facts: PageFacts) -> Figure:
    """Draw the page with the pictures."""
    figure = _page(facts)
    room = assessment_pictures.room_for(assessed)
    _draw_head(figure, facts)
    many = len(assessed.placement.cameras) > MOST_ROWS
    top = TABLE_BOTTOM if many else _draw_cameras(figure, assessed, facts)
    bottom = top + 0.58
    slots = _slots(assessed, bottom, 6.52 - bottom)
    assessment_pictures.draw_room_plan(_titled(figure, slots.plan, 'Plan (m)'), room, assessed)
    assessment_pictures.draw_count_map(
        _titled(figure, slots.counts, 'Seen by how many cameras'), room, assessed)
    image = assessment_pictures.draw_error_map(
        _titled(figure, slots.errors, 'Where the depth error is'), room, assessed)
    left, low, width, high = slots.errors
    _draw_bar(figure, image, (left + width + 0.04, low + 0.1, 0.07, high - 0.2))
    for box, (corner, azimuth) in zip(slots.looks, CORNERS.items()):
        axes = _titled(figure, box, f'From corner {corner}')
        assessment_pictures.draw_look(axes, room, assessed, np.deg2rad(azimuth))
    _draw_legend(figure, bottom - 0.16, assessed)
    write(figure, (0.5 * PAGE_WIDTH, bottom - 0.36), DEPTH_ERROR, INSIDE, 6.8, PALE_INK,
          align='center')
    return figure


def _table_page(assessed: Assessment, facts: PageFacts) -> Figure:
    """Draw the page with the table of many cameras."""
    figure = _page(facts)
    rows = len(assessed.placement.cameras) + 1
    _draw_cameras(figure, assessed, facts, min(ROW, (7.4 - TABLE_BOTTOM) / rows))
    return figure


def _page(facts: PageFacts) -> Figure:
    """Return a page with its title, subtitle, verdict and foot."""
    figure = Figure(figsize=(PAGE_WIDTH, PAGE_HEIGHT), dpi=DOTS_PER_INCH, facecolor='white')
    write(figure, (MARGIN, 7.92), facts.title, 5.6, 15, INK, bold=True)
    write(figure, (MARGIN, 7.66), facts.subtitle, 4.6 if facts.doubts else 10.8, 8, PALE_INK)
    write(figure, (PAGE_WIDTH - MARGIN, 7.92), facts.verdict, 5.0, 9.5,
          GOOD if facts.satisfied else BAD, bold=True, align='right')
    for line, y in ((facts.origin, 0.27), (facts.meaning, 0.15)):
        write(figure, (MARGIN, y), line, INSIDE, 6.2, PALE_INK)
    return figure


class _Slots(NamedTuple):
    """Boxes of the pictures: left, bottom, width and height of each, inches."""

    plan: Box
    counts: Box
    errors: Box
    looks: list[Box]


def _slots(assessed: Assessment, bottom: float, high: float) -> _Slots:
    """
    Divide a page into boxes; the width of the plan depends on the shape of the room.

    :param bottom: lower edge of all pictures, inches.
    :param high: total height of all pictures, inches.
    """
    width, depth = assessed.size
    half = 0.5 * (high - TITLE)
    if width > WIDE_RATIO * depth:
        # The maps lie below the plan.
        low = float(np.clip(1.2 * depth / width * WIDE_MAP, 0.8, 0.4 * high))
        plan = (MARGIN + 0.15, bottom + low + TITLE + 0.1, WIDE_PLAN, high - low - TITLE - 0.1)
        counts = (MARGIN, bottom, WIDE_MAP, low)
        errors = (MARGIN + WIDE_MAP + 0.15, bottom, WIDE_MAP, low)
        looks = MARGIN + WIDE_PLAN + 0.45
    else:
        around = 0.2 * max(width, depth)
        wide = float(np.clip(high * (width + around) / (depth + around), *PLAN_WIDTHS))
        plan = (MARGIN + 0.15, bottom + 0.1, wide, high - 0.1)
        left = MARGIN + wide + 0.32
        counts = (left, bottom + half + TITLE, MAP_WIDTH, half)
        errors = (left, bottom, MAP_WIDTH, half)
        looks = left + MAP_WIDTH + 0.63
    wide = 0.5 * (PAGE_WIDTH - MARGIN - looks - 0.1)
    return _Slots(plan, counts, errors, [
        (looks + column * (wide + 0.1), bottom + row * (half + TITLE), wide, half)
        for row in (1, 0) for column in (0, 1)])


def _draw_bar(figure: Figure, image: AxesImage, box: Box) -> None:
    """Draw the colour bar of the depth error in a box, inches."""
    bar = figure.colorbar(image, cax=_axes(figure, box))
    size = 6.0 if box[3] > 1.6 else 5.0
    bar.set_label('depth error per floor area (mm/m²)' if box[3] > 1.4 else 'mm/m²', fontsize=size,
                  color=PALE_INK, labelpad=2.0)
    bar.set_ticks(_few_ticks(image.norm.vmax))
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=5.5, colors=PALE_INK, length=1.5, pad=1.0)
    bar.outline.set_visible(False)


def _axes(figure: Figure, box: Box) -> Axes:
    """Add axes in a box, inches."""
    return figure.add_axes(np.array(box) / np.tile(figure.get_size_inches(), 2))


def _titled(figure: Figure, box: Box, title: str) -> Axes:
    """Add axes in a box, inches, with a title above it."""
    left, bottom, _, height = box
    write(figure, (left, bottom + height + 0.14), title, PAGE_WIDTH, 8, INK, bold=True)
    return _axes(figure, box)


def _few_ticks(most: float) -> np.ndarray:
    """Return 0 and three round values up to the maximum of a colour bar with a root scale."""
    unit = 10.0 ** np.floor(np.log10(most))
    top = np.floor(most / unit) * unit
    return np.array([0.0, 0.1 * top, 0.4 * top, top])


def _draw_head(figure: Figure, facts: PageFacts) -> None:
    """Write the doubts about the room, and the key figures."""
    for number, doubt in enumerate(facts.doubts[:MOST_DOUBTS]):
        more = len(facts.doubts) - MOST_DOUBTS
        text = f'{doubt} (and {more} more)' if more > 0 and number == MOST_DOUBTS - 1 else doubt
        write(figure, (PAGE_WIDTH - MARGIN, 7.72 - 0.13 * number), text, 6.0, 6.2, BAD,
              align='right')
    gap = 0.12
    wide = (INSIDE - gap * (len(facts.figures) - 1)) / len(facts.figures)
    for number, (label, value, more) in enumerate(facts.figures):
        left = MARGIN + number * (wide + gap)
        figure.add_artist(FancyBboxPatch(
            (left, 6.84), wide, 0.62, linewidth=0, facecolor='#f1f3f5',
            boxstyle='round,pad=0,rounding_size=0.04', transform=figure.dpi_scale_trans))
        for text, size, y, colour, bold in (
                (label, 6.5, 7.36, PALE_INK, False), (value, 12.5, 7.16, INK, True),
                (more, 6.5, 6.94, PALE_INK, False)):
            write(figure, (left + 0.09, y), text, wide - 0.18, size, colour, bold)


def _draw_legend(figure: Figure, y: float, assessed: Assessment) -> None:
    """Draw the legend of all pictures in one line, ``y`` inches from the bottom."""
    entries = {'camera': Line2D([], [], color=camera_colour(0), marker='o', markersize=6,
                                linestyle='none'),
               'field of view and range': Patch(facecolor='#cfe3f0', edgecolor='#0072b2'),
               'mostly without wall': Line2D([], [], color=INK, linewidth=0.9,
                                             linestyle=(0, (3, 3)))}
    if all(wall.stands for wall in assessed.walls):
        del entries['mostly without wall']
    entries |= {name: Patch(facecolor=colour)
                for name, colour in zip(assessment_pictures.COUNT_NAMES,
                                        assessment_pictures.COUNT_COLOURS)}
    entries |= zone_legend(assessed.objective.rig)
    figure.legend(entries.values(), entries.keys(), loc='center', ncols=len(entries),
                  frameon=False, labelcolor=INK,
                  fontsize=7 if len(entries) < 8 else 6.2, columnspacing=1.6, handlelength=1.4,
                  bbox_to_anchor=(0.5, y / PAGE_HEIGHT), borderpad=0.0, borderaxespad=0.0)


def _draw_cameras(figure: Figure, assessed: Assessment, facts: PageFacts,
                  step: float | None = None) -> float:
    """
    Draw the installer's table at the foot of a page.

    :param step: height of a row, inches; None to choose it by the number of cameras.
    :returns: upper edge of the table, inches.
    """
    rows = [['', 'camera', 'sensor', 'place', 'above floor', 'pan', 'tilt', 'x, y, z (m)',
             'error reduction']]
    for row, camera in zip(assessed.rows, facts.cameras):
        number, name, sensor, place, height, *turns_and_coordinates = row
        rows.append([number, name, '' if name.startswith(sensor) else sensor, place,
                     height.replace(' above the floor', ''), *turns_and_coordinates,
                     camera.reduction])
    if not any(row[2] for row in rows[1:]):
        rows = [[*row[:2], *row[3:]] for row in rows]
    step = step or (ROW if len(rows) - 1 <= FEW_ROWS else LOW_ROW)
    high = step * len(rows)
    draw_table(figure, (MARGIN, TABLE_BOTTOM, INSIDE, high), rows,
               7.2 if step == ROW else 6.2 if step >= LOW_ROW else 5.4,
               [dark(camera_colour(number)) for number in range(len(rows) - 1)])
    return TABLE_BOTTOM + high
