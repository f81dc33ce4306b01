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

"""Figures saved as files, with fonts for all letters, and texts and tables that fit a width."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
import io
from pathlib import Path
from typing import Any
import warnings

from matplotlib import font_manager, rc_context, rcParams
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import text_to_path
import numpy as np
from ocp_ros.report.drawing.room_drawing import INK, PALE_INK
from ocp_ros.util.files import write_atomically
from scipy.optimize import brentq

#: Fonts with Chinese, Japanese or Korean letters on Linux, macOS and Windows.
FALLBACK_FONTS = (
    'Noto Sans CJK JP', 'Noto Sans CJK SC', 'Noto Sans CJK KR', 'Source Han Sans',
    'WenQuanYi Micro Hei', 'WenQuanYi Zen Hei', 'Droid Sans Fallback', 'IPAGothic', 'NanumGothic',
    'Hiragino Sans', 'PingFang SC', 'Apple SD Gothic Neo', 'Microsoft YaHei', 'Yu Gothic',
    'Malgun Gothic', 'Arial Unicode MS')
#: Gap between two columns, inches.
COLUMN_GAP = 0.14
#: Smallest readable font size, points.
MIN_FONT_SIZE = 5.2


def save_figure(figure: Figure, path: str | Path, **options: Any) -> None:
    """
    Write a figure atomically, by default as PNG.

    :param path: file to write; its folder is created.
    :param options: of ``Figure.savefig``.
    :raises OSError: if it cannot be written; then an existing file does not change.
    """
    picture = io.BytesIO()
    figure.savefig(picture, **{'format': 'png', **options})
    write_atomically(path, picture.getvalue())


def font_families() -> list[str]:
    """Return the names of the fonts in which matplotlib searches a letter, in this order."""
    installed = set(font_manager.fontManager.get_font_names())
    defaults = list(rcParams['font.family'])
    return [*defaults, *(name for name in FALLBACK_FONTS
                         if name in installed and name not in defaults)]


@contextmanager
def fonts_for_all_letters() -> Iterator[None]:
    """Set fonts that together have most letters, in a context; other letters become boxes."""
    with rc_context({'font.family': font_families()}), warnings.catch_warnings():
        # The boxes are visible on the page; docs/tasks/troubleshooting.md describes the remedy.
        warnings.filterwarnings('ignore', 'Glyph .* missing from font', UserWarning)
        yield


@lru_cache(maxsize=10000)
def width_of(text: str, size: float, bold: bool = False) -> float:
    """Return the width of a text in inches at a font size in points (1/72 inch)."""
    font = FontProperties(weight='bold' if bold else 'normal', size=size)
    return text_to_path.get_text_width_height_descent(text, font, False)[0] / 72.0


def in_one_line(text: str) -> str:
    """Return a text as one line for a figure; $ is escaped, as it would begin a formula."""
    text = ''.join(letter if letter.isprintable() else ' ' for letter in text)
    return ' '.join(text.split()).replace('$', r'\$')


def shortened(text: str, width: float, size: float, bold: bool = False) -> str:
    """
    Return a text as one line, which ends in three dots if it had to be shortened.

    :param width: largest width, inches.
    :param size: font size, points.
    """
    text = in_one_line(text)
    if width_of(text, size, bold) <= width:
        return text
    # The largest number of letters that fits together with the dots; 0 if not even one fits.
    letters = bisect_right(range(1, len(text)), width,
                           key=lambda count: width_of(text[:count] + '...', size, bold))
    # A backslash at the end would be left of an escaped $.
    return text[:letters].rstrip('\\ ') + '...'


def write(figure: Figure, place: tuple[float, float], text: str, width: float, size: float,
          colour: Any, bold: bool = False, align: str = 'left') -> None:
    """
    Write a line of text in a figure; a text that is too wide gets smaller, then shorter.

    :param place: x and y of the text's left end, right end or centre, by ``align``, inches.
    :param width: largest width, inches.
    :param size: largest font size, points.
    :param colour: colour of the text, as in matplotlib.
    :param align: ``left``, ``right`` or ``center``.
    """
    x, y = place / figure.get_size_inches()
    line = in_one_line(text)
    while size > MIN_FONT_SIZE and width_of(line, size, bold) > width:
        size = max(size - 0.2, MIN_FONT_SIZE)
    figure.text(x, y, shortened(text, width, size, bold), fontsize=size, color=colour,
                fontweight='bold' if bold else 'normal', va='center', ha=align)


def draw_table(figure: Figure, box: tuple[float, float, float, float], rows: Sequence[
        Sequence[str]], size: float, colours: Sequence[Any]) -> None:
    """
    Draw a table; columns are at least as wide as their contents, if there is enough space.

    :param box: left edge, lower edge, width and height of the table, inches.
    :param rows: cells of each row; the first row is the head.
    :param size: font size, points; it is reduced if the table is too wide.
    :param colours: colour of the first cell of each row except the head.
    """
    left, bottom, width, height = box
    available = width - COLUMN_GAP * (len(rows[0]) - 1)

    def text_widths(size: float) -> list[float]:
        return [max(width_of(row[k], size, bold=i == 0 or k == 0) for i, row in enumerate(rows))
                for k in range(len(rows[0]))]
    while sum(text_widths(size)) > available and size > MIN_FONT_SIZE:
        size = max(size - 0.2, MIN_FONT_SIZE)
    widths = text_widths(size)
    if sum(widths) > available:
        # Limit the columns to a common largest width at which all fit.
        limit = brentq(lambda limit: np.minimum(widths, limit).sum() - available, 0.0, max(widths))
        widths = [min(text_width, limit) for text_width in widths]
    else:
        # Distribute the remaining width among the columns.
        extra = (available - sum(widths)) / len(widths)
        widths = [text_width + extra for text_width in widths]
    row_height = height / len(rows)
    for i, row in enumerate(rows):
        x, y = left, bottom + height - (i + 0.5) * row_height
        for k, (cell, cell_width) in enumerate(zip(row, widths)):
            colour = PALE_INK if i == 0 else colours[i - 1] if k == 0 else INK
            write(figure, (x, y), cell, cell_width, size, colour, bold=i == 0 or k == 0)
            x += cell_width + COLUMN_GAP
        figure.add_artist(Line2D([left, left + width], [y - 0.5 * row_height] * 2, color='#c9ced3',
                                 linewidth=0.3 if i else 0.8, transform=figure.dpi_scale_trans))
