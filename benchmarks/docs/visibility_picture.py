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

"""A picture of what one camera sees in a room: ray casting, and what the engine and others say."""

import argparse
from pathlib import Path
import sys

from benchmarks.engine import cases, confusion, f1_of, mask_of, METHODS, RADII, RANGE
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
import numpy as np
from ocp_ros.report.drawing.room_drawing import (
    draw_discs,
    heights_of,
    INK,
    open_view,
    PALE_INK,
    room_of,
)
from ocp_ros.report.drawing.saved_pictures import save_figure

SEEN, HIDDEN, WRONG, MISSED = '#3f8fb5', '#d5d5d0', '#c8352b', '#efa11a'
MEANINGS = {SEEN: 'seen', HIDDEN: 'hidden, or out of range', WRONG: 'said to be seen, but hidden',
            MISSED: 'said to be hidden, but seen'}


def draw_panel(axes: Axes, points: np.ndarray, camera: np.ndarray, truth: np.ndarray,
               said: np.ndarray, title: str) -> None:
    """
    Draw a room cut open, coloured by what a camera sees and what is said of it.

    :param axes: where.
    :param points: (N, 3) metres.
    :param camera: (3,) metres.
    :param truth: (N,) bool, what the camera sees.
    :param said: (N,) bool, what it is said to see.
    :param title: headline.
    """
    names = np.select([truth & said, ~truth & ~said, said], [SEEN, HIDDEN, WRONG], MISSED)
    colours = np.array([to_rgb(name) for name in names])
    colours *= 1.08 - 0.35 * heights_of(points)[:, None]
    view, part = open_view(room_of(points, np.clip(colours, 0.0, 1.0)))
    outline = draw_discs(axes, part, view)
    at = camera @ view[:2].T
    foot = np.array([*camera[:2], part.points[:, 2].min()]) @ view[:2].T
    axes.plot(*np.stack([at, foot]).T, color=INK, linewidth=1.0, linestyle=(0, (2, 2)))
    axes.plot(*at, 'o', color=INK, markersize=16, zorder=6)
    (left, low), (right, high) = outline.get_xy().min(axis=0), outline.get_xy().max(axis=0)
    axes.set(xlim=(left, right), ylim=(low, high), aspect='equal')
    axes.set_axis_off()
    axes.set_title(title, fontsize=15, color=INK)


def draw(path: Path, points: int, room: int) -> None:
    """
    Write a PNG of four panels: the truth, ``fine``, ``paper`` and hidden point removal.

    :param path: file to write.
    :param points: points of the room.
    :param room: which of the benchmark's rooms, from 0.
    """
    case = list(cases(points, room + 1, 1))[-1]
    said = {name: mask_of(METHODS[name](case)) for name in (
        'fine', 'paper', *(f'hidden_point_removal {radius}' for radius in RADII))}
    scores = {name: f1_of(confusion(mask, case.truth)) for name, mask in said.items()}
    best = max((name for name in said if name.startswith('hidden')), key=scores.get)
    figure = Figure(figsize=(15.0, 11.5), dpi=100, facecolor='white')
    panels = [('ray casting of the mesh: the truth', case.truth)] + [
        (f'{title}: F1 {scores[name]:.3f}', said[name]) for name, title in (
            ('fine', 'preset fine'), ('paper', 'preset paper'),
            (best, f'Open3D hidden point removal, radius {best.split()[1]} m'))]
    for k, (title, mask) in enumerate(panels):
        axes = figure.add_axes((0.01 + 0.5 * (k % 2), 0.48 - 0.43 * (k // 2), 0.48, 0.4))
        draw_panel(axes, case.scene.points, case.position, case.truth, mask, title)
    figure.text(0.03, 0.96, f'What one camera sees of {case.scene.name}', fontsize=20,
                fontweight='bold', color=INK, va='center')
    figure.text(0.03, 0.93, f'{len(case.scene):,} points, range {RANGE:g} m, without the ceiling '
                'and the walls in front', fontsize=13, color=PALE_INK, va='center')
    figure.legend([Patch(facecolor=colour) for colour in MEANINGS], list(MEANINGS.values()),
                  loc='lower center', ncols=4, frameon=False, fontsize=13)
    save_figure(figure, path, dpi=100)


def main(args: list[str] | None = None) -> int:
    """Draw the picture of the documentation."""
    parser = argparse.ArgumentParser(prog='visibility', description=__doc__)
    parser.add_argument('--out', type=Path, default=Path('out/visibility.png'))
    parser.add_argument('--points', type=int, default=40000)
    parser.add_argument('--room', type=int, default=3, help="which of the benchmark's rooms")
    options = parser.parse_args(args)
    draw(options.out, options.points, options.room)
    print(f'wrote {options.out}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
