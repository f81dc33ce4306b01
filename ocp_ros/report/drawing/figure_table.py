# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text that has to fit: shortened lines, and tables in a figure."""

from collections.abc import Sequence
from functools import lru_cache

from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import text_to_path

from ocp_ros.report.drawing.room_drawing import INK, PALE_INK

#: Points of an inch.
POINTS = 72.0
#: Inches between two columns, and the smallest letters that are read without a lens, points.
GAP, SMALLEST = 0.14, 5.2


@lru_cache(maxsize=10000)
def width_of(text: str, size: float, bold: bool = False) -> float:
    """Return how wide a text is, inches, in letters of so many points."""
    font = FontProperties(weight='bold' if bold else 'normal', size=size)
    return text_to_path.get_text_width_height_descent(text, font, False)[0] / POINTS


def shortened(text: str, width: float, size: float, bold: bool = False) -> str:
    """Return a text, or as much of it as so many inches hold with three dots behind."""
    text = ''.join(letter if letter.isprintable() else ' ' for letter in text)
    text = ' '.join(text.split()).replace('$', r'\$')
    if width_of(text, size, bold) <= width:
        return text
    low, high = 0, len(text)
    while low < high:
        middle = (low + high + 1) // 2
        if width_of(text[:middle] + '...', size, bold) <= width:
            low = middle
        else:
            high = middle - 1
    return text[:low].rstrip('\\ ') + '...'


def draw_table(figure: Figure, box: tuple[float, float, float, float], rows: Sequence[
        Sequence[str]], size: float, colours: Sequence[str]) -> None:
    """
    Draw a table; columns are as wide as what is in them, as far as there is room.

    :param box: left, bottom, width and height, inches.
    :param rows: the head first.
    :param size: of the letters, points; they become smaller where the table is too wide.
    :param colours: of the first cell of each row but the head.
    """
    left, bottom, width, height = box
    room = width - GAP * (len(rows[0]) - 1)

    def widths(size: float) -> list[float]:
        return [max(width_of(row[k], size, n == 0 or k == 0) for n, row in enumerate(rows))
                for k in range(len(rows[0]))]
    while sum(widths(size)) > room and size > SMALLEST:
        size = max(size - 0.2, SMALLEST)
    columns = widths(size)
    if sum(columns) > room:
        columns = _squeezed(columns, room)
    else:
        # What is left over goes between the columns.
        columns = [one + (room - sum(columns)) / len(columns) for one in columns]
    figure_width, figure_height = figure.get_size_inches()
    step = height / len(rows)
    for n, row in enumerate(rows):
        at, y = left, bottom + height - (n + 0.5) * step
        for k, (cell, wide) in enumerate(zip(row, columns)):
            bold = n == 0 or k == 0
            figure.text(at / figure_width, y / figure_height, shortened(cell, wide, size, bold),
                        fontsize=size, fontweight='bold' if bold else 'normal', va='center',
                        color=PALE_INK if n == 0 else colours[n - 1] if k == 0 else INK)
            at += wide + GAP
        line = _line(left, left + width, y - 0.5 * step, figure)
        line.set_linewidth(0.8 if n == 0 else 0.3)
        figure.add_artist(line)


def _squeezed(columns: Sequence[float], room: float) -> list[float]:
    """Make the widest columns as narrow as one another, until all fit."""
    low, high = 0.0, max(columns)
    for _ in range(40):
        middle = 0.5 * (low + high)
        if sum(min(one, middle) for one in columns) > room:
            high = middle
        else:
            low = middle
    return [min(one, low) for one in columns]


def _line(left: float, right: float, y: float, figure: Figure) -> Line2D:
    """Return a level line, inches."""
    width, height = figure.get_size_inches()
    return Line2D([left / width, right / width], [y / height, y / height], color='#c9ced3')
