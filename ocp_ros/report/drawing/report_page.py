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
from ocp_ros.report.drawing import assessment_pictures as pictures
from ocp_ros.report.drawing.plan_drawing import camera_colour, darkened, zone_legend
from ocp_ros.report.drawing.room_drawing import INK, PALE_INK
from ocp_ros.report.drawing.saved_pictures import (
    draw_table,
    fonts_for_all_letters,
    in_one_line,
    save_figure,
    width_of,
    write,
)
from ocp_ros.report.facts import page_facts_of, PageFacts

#: Width, height and margin of A4 landscape, inches.
PAGE_WIDTH = 11.69
PAGE_HEIGHT = 8.27
MARGIN = 0.4
#: Inches between the margins.
INNER_WIDTH = PAGE_WIDTH - 2.0 * MARGIN
DOTS_PER_INCH = 150
#: Largest number of cameras whose table fits on the first page.
MAX_ROWS = 20
#: Height of a row of a table of up to nine cameras, inches.
ROW_HEIGHT = 0.175
#: Lower edge of the table, inches.
TABLE_BOTTOM = 0.42
#: Names of the files of the pages; the second page has a table that does not fit on the first.
PAGE_FILES = ('report.png', 'report_2.png')
BAD_COLOUR = '#b04a00'
#: Left edge, lower edge, width and height of a rectangle on a page, inches.
Box: TypeAlias = tuple[float, float, float, float]


def draw_pages(folder: Path, assessed: Assessment) -> Iterator[Path]:
    """
    Write the pages as PNG, A4 landscape, and yield their paths: one, or two with many cameras.

    :param folder: folder to write to, which is created if it does not exist.
    :param assessed: the placement in its room.
    """
    for name, figure in zip(PAGE_FILES, figures_of_pages(assessed)):
        with fonts_for_all_letters():
            save_figure(figure, folder / name, dpi=DOTS_PER_INCH)
        yield folder / name


def figures_of_pages(assessed: Assessment) -> Iterator[Figure]:
    """Yield the pages: pictures with the table; a long table has its own page."""
    # All pages are drawn before the first is yielded, so that the context does not last until the
    # caller takes the last one.
    with fonts_for_all_letters():
        facts = page_facts_of(assessed)
        pages = [_picture_page(assessed, facts)]
        if len(assessed.placement.cameras) > MAX_ROWS:
            pages.append(_table_page(assessed, facts))
    yield from pages


def _picture_page(assessed: Assessment, facts: PageFacts) -> Figure:
    """Return the page with the pictures, and with the table if it is short."""
    figure = _empty_page(facts)
    room = pictures.room_for(assessed)
    _draw_head(figure, facts)
    has_table_page = len(assessed.placement.cameras) > MAX_ROWS
    table_top = TABLE_BOTTOM if has_table_page else _draw_table(figure, assessed, facts)
    # From the bottom: table, note, legend, and pictures up to 6.52 inches; above are the titles of
    # the pictures and the key figures.
    lower_edge = table_top + 0.58
    boxes = _picture_boxes(assessed, lower_edge, 6.52 - lower_edge)
    pictures.draw_room_plan(_titled_axes(figure, boxes.plan, 'Plan (m)'), room, assessed)
    pictures.draw_count_map(
        _titled_axes(figure, boxes.counts, 'Seen by how many cameras'), room, assessed)
    image = pictures.draw_error_map(
        _titled_axes(figure, boxes.errors, 'Where the depth error is'), room, assessed)
    left, bottom, width, height = boxes.errors
    _draw_bar(figure, image, (left + width + 0.04, bottom + 0.1, 0.07, height - 0.2))
    # Azimuth of the viewer at each corner of two walls, degrees, in the order of the boxes.
    azimuths = {'C, D': -125.0, 'B, C': -55.0, 'A, B': 55.0, 'D, A': 125.0}
    for box, (corner, azimuth) in zip(boxes.looks, azimuths.items()):
        axes = _titled_axes(figure, box, f'From corner {corner}')
        pictures.draw_perspective(axes, room, assessed, np.deg2rad(azimuth))
    _draw_legend(figure, lower_edge - 0.16, assessed)
    note = ('Depth error: how much deeper the room looks when only the points that the cameras '
            'see are left; five times the mean over viewpoints and directions. 0 m is perfect.')
    write(figure, (0.5 * PAGE_WIDTH, lower_edge - 0.36), note, INNER_WIDTH, 6.8, PALE_INK,
          align='center')
    return figure


def _table_page(assessed: Assessment, facts: PageFacts) -> Figure:
    """Return the page with the table of many cameras."""
    figure = _empty_page(facts)
    rows = len(assessed.placement.cameras) + 1
    # The table may reach up to 7.4 inches, below the subtitle.
    _draw_table(figure, assessed, facts, min(ROW_HEIGHT, (7.4 - TABLE_BOTTOM) / rows))
    return figure


def _empty_page(facts: PageFacts) -> Figure:
    """Return a page with its title, subtitle, verdict and foot."""
    figure = Figure(figsize=(PAGE_WIDTH, PAGE_HEIGHT), dpi=DOTS_PER_INCH, facecolor='white')
    write(figure, (MARGIN, 7.92), facts.title, 5.6, 15, INK, bold=True)
    # With doubts the subtitle is shorter, since :func:`_draw_head` writes them beside it.
    write(figure, (MARGIN, 7.66), facts.subtitle, 4.6 if facts.doubts else 10.8, 8, PALE_INK)
    write(figure, (PAGE_WIDTH - MARGIN, 7.92), facts.verdict, 5.0, 9.5,
          '#00664d' if facts.satisfied else BAD_COLOUR, bold=True, align='right')
    for line, y in ((facts.origin, 0.27), (facts.meaning, 0.15)):
        write(figure, (MARGIN, y), line, INNER_WIDTH, 6.2, PALE_INK)
    return figure


class _PictureBoxes(NamedTuple):
    """Boxes of the pictures on the page: plan, two maps, and four perspective views."""

    plan: Box
    counts: Box
    errors: Box
    looks: list[Box]


def _picture_boxes(assessed: Assessment, bottom: float, height: float) -> _PictureBoxes:
    """
    Return the boxes of the pictures; the width of the plan depends on the shape of the room.

    :param bottom: lower edge of all pictures, inches.
    :param height: total height of all pictures, inches.
    """
    max_ratio, title_height = 1.6, 0.32
    width, depth = assessed.size
    half_height = 0.5 * (height - title_height)
    if width > max_ratio * depth:
        # A wide room: the maps lie below the plan.
        plan_width, map_width = 6.0, 2.85
        map_height = float(np.clip(1.2 * depth / width * map_width, 0.8, 0.4 * height))
        plan = (MARGIN + 0.15, bottom + map_height + title_height + 0.1, plan_width,
                height - map_height - title_height - 0.1)
        counts = (MARGIN, bottom, map_width, map_height)
        errors = (MARGIN + map_width + 0.15, bottom, map_width, map_height)
        looks_left = MARGIN + plan_width + 0.45
    else:
        # The maps lie to the right of the plan, one above the other.
        min_plan_width, max_plan_width, map_width = 1.8, 3.7, 2.1
        # The plan has a margin of a tenth of the longer edge on each side.
        border = 0.2 * max(width, depth)
        plan_width = float(np.clip(height * (width + border) / (depth + border), min_plan_width,
                                   max_plan_width))
        plan = (MARGIN + 0.15, bottom + 0.1, plan_width, height - 0.1)
        left = MARGIN + plan_width + 0.32
        counts = (left, bottom + half_height + title_height, map_width, half_height)
        errors = (left, bottom, map_width, half_height)
        looks_left = left + map_width + 0.63
    # Two columns of perspective views, the upper row first.
    look_width = 0.5 * (PAGE_WIDTH - MARGIN - looks_left - 0.1)
    looks = [(looks_left + column * (look_width + 0.1),
              bottom + row * (half_height + title_height), look_width, half_height)
             for row in (1, 0) for column in (0, 1)]
    return _PictureBoxes(plan, counts, errors, looks)


def _draw_bar(figure: Figure, image: AxesImage, box: Box) -> None:
    """Draw the colour bar of the error map in a box."""
    bar = figure.colorbar(image, cax=_add_axes(figure, box))
    # The height of the box, inches, limits the size and the length of the label.
    size = 6.0 if box[3] > 1.6 else 5.0
    bar.set_label('depth error per floor area (mm/m²)' if box[3] > 1.4 else 'mm/m²', fontsize=size,
                  color=PALE_INK, labelpad=2.0)
    bar.set_ticks(_bar_ticks(image.norm.vmax))
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=5.5, colors=PALE_INK, length=1.5, pad=1.0)
    bar.outline.set_visible(False)


def _add_axes(figure: Figure, box: Box) -> Axes:
    """Add axes in a box to a figure, and return them."""
    return figure.add_axes(np.array(box) / np.tile(figure.get_size_inches(), 2))


def _titled_axes(figure: Figure, box: Box, title: str) -> Axes:
    """Add axes in a box with a title above it to a figure, and return the axes."""
    left, bottom, _, height = box
    write(figure, (left, bottom + height + 0.14), title, PAGE_WIDTH, 8, INK, bold=True)
    return _add_axes(figure, box)


def _bar_ticks(maximum: float) -> np.ndarray:
    """Return 0 and three round values (4,) up to the maximum of a colour bar."""
    unit = 10.0 ** np.floor(np.log10(maximum))
    rounded = np.floor(maximum / unit) * unit
    # The colours follow the square root, so these values are evenly spaced on the bar.
    return np.array([0.0, 0.1 * rounded, 0.4 * rounded, rounded])


def _draw_head(figure: Figure, facts: PageFacts) -> None:
    """Write the doubts about the room, and the key figures."""
    max_doubts = 2
    hidden = len(facts.doubts) - max_doubts
    for number, doubt in enumerate(facts.doubts[:max_doubts]):
        # The last doubt that fits ends with the number of the others.
        text = f'{doubt} (and {hidden} more)' if hidden > 0 and number == max_doubts - 1 else doubt
        write(figure, (PAGE_WIDTH - MARGIN, 7.72 - 0.13 * number), text, width=6.0, size=6.2,
              colour=BAD_COLOUR, align='right')
    gap, padding, small, large = 0.1, 0.16, 6.5, 12.5
    # Each figure has a width in proportion to its longest line, with its remark in two lines.
    tiles = [(one, _two_lines(one.remark)) for one in facts.figures]
    widths = np.array([max(width_of(in_one_line(one.value), large, True), *(
        width_of(in_one_line(text), small) for text in (one.label, *remark))) + padding
        for one, remark in tiles])
    widths *= (INNER_WIDTH - gap * (len(widths) - 1)) / widths.sum()
    lefts = MARGIN + np.cumsum(widths + gap) - widths - gap
    for (one, remark), left, width in zip(tiles, lefts, widths):
        figure.add_artist(FancyBboxPatch(
            (left, 6.76), width, 0.7, linewidth=0, facecolor='#f1f3f5',
            boxstyle='round,pad=0,rounding_size=0.04', transform=figure.dpi_scale_trans))
        for text, size, y, colour, bold in (
                (one.label, small, 7.37, PALE_INK, False), (one.value, large, 7.19, INK, True),
                (remark[0], small, 6.97, PALE_INK, False),
                (remark[1], small, 6.85, PALE_INK, False)):
            write(figure, (left + 0.5 * padding, y), text, width - padding, size, colour, bold)


def _two_lines(text: str) -> tuple[str, str]:
    """Return a text as two lines of about the same length."""
    words = text.split(' ')
    lines = [(' '.join(words[:count]), ' '.join(words[count:]))
             for count in range(1, len(words) + 1)]
    return min(lines, key=lambda pair: max(map(len, pair)))


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
                for name, colour in zip(pictures.COUNT_NAMES, pictures.COUNT_COLOURS)}
    entries |= zone_legend(assessed.objective.rig)
    figure.legend(entries.values(), entries.keys(), loc='center', ncols=len(entries),
                  frameon=False, labelcolor=INK,
                  fontsize=7 if len(entries) < 8 else 6.2, columnspacing=1.6, handlelength=1.4,
                  bbox_to_anchor=(0.5, y / PAGE_HEIGHT), borderpad=0.0, borderaxespad=0.0)


def _draw_table(figure: Figure, assessed: Assessment, facts: PageFacts,
                row_height: float | None = None) -> float:
    """
    Draw the installer's table at the foot of a page.

    :param row_height: inches; None to choose the height by the number of cameras.
    :returns: upper edge of the table, inches.
    """
    rows = [['', 'camera', 'sensor', 'place', 'above floor', 'pan', 'tilt', 'x, y, z (m)',
             'error reduction']]
    for row, camera in zip(assessed.rows, facts.cameras):
        number, name, sensor, place, height, *angles_and_coordinates = row
        rows.append([number, name, '' if name.startswith(sensor) else sensor, place,
                     height.replace(' above the floor', ''), *angles_and_coordinates,
                     camera.reduction])
    # The column of sensors is left out if each camera's name begins with its sensor.
    if not any(row[2] for row in rows[1:]):
        rows = [[*row[:2], *row[3:]] for row in rows]
    low_row_height = 0.135
    row_height = row_height or (ROW_HEIGHT if len(rows) - 1 <= 9 else low_row_height)
    height = row_height * len(rows)
    # Lower rows have smaller fonts.
    draw_table(figure, (MARGIN, TABLE_BOTTOM, INNER_WIDTH, height), rows,
               7.2 if row_height == ROW_HEIGHT else 6.2 if row_height >= low_row_height else 5.4,
               [darkened(camera_colour(number)) for number in range(len(rows) - 1)])
    return TABLE_BOTTOM + height
