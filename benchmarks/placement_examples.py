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

"""A picture of several placements: plans of rooms in rows and columns."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
import numpy as np
from ocp_ros.report.drawing.room_drawing import INK, room_of
from ocp_ros.report.drawing.room_pictures import draw_legend, draw_plan, height_colours
from ocp_ros.report.drawing.saved_pictures import save_figure


class Example(NamedTuple):
    """
    A placement in a room, for :func:`draw_examples`.

    :ivar title: what it is.
    :ivar points: (N, 3) the whole room, metres, map frame.
    :ivar observed: (N,) bool, points that the final placement sees.
    :ivar trajectories: (T, K, 3) metres; of a placement that was not reached by moving, T is 1.
    """

    title: str
    points: np.ndarray
    observed: np.ndarray
    trajectories: np.ndarray


def draw_examples(path: Path, examples: Sequence[Sequence[Example]], max_range: float,
                  title: str) -> None:
    """
    Write a PNG of plans in rows and columns.

    :param path: file to write.
    :param examples: rows of equally many.
    :param max_range: range of every camera, metres.
    :param title: headline.
    """
    rows, columns = len(examples), len(examples[0])
    high = 0.9 + 5.4 * rows + 0.6
    figure = Figure(figsize=(6.0 * columns, high), dpi=100, facecolor='white')
    figure.text(0.03, 1.0 - 0.45 / high, title, fontsize=19, fontweight='bold', color=INK,
                va='center')
    for k, row in enumerate(examples):
        for column, example in enumerate(row):
            bottom = 0.6 + 5.4 * (rows - 1 - k)
            axes = figure.add_axes(((column + 0.1) / columns, (bottom + 0.6) / high,
                                    0.87 / columns, 4.2 / high))
            room = room_of(example.points, height_colours(example.points, example.observed))
            draw_plan(axes, room, example.trajectories, max_range)
            axes.set_title(example.title, fontsize=13, color=INK, loc='left', parse_math=False)
    draw_legend(figure, max_range, True, '')
    save_figure(figure, path, dpi=75)
