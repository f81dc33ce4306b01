# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The sheet of generated rooms: pictures of twelve, their figures beside those of real ones."""

import argparse
from collections.abc import Sequence
from datetime import date
import json
from pathlib import Path
import sys
from typing import Any

from matplotlib.figure import Figure
import numpy as np

from ocp_ros.evaluation.benchmark_rooms import rooms_in, rooms_of_s3dis
from ocp_ros.evaluation.room_likeness import (
    CELL,
    generated,
    likeness,
    S3DIS_FLOOR,
    S3DIS_POINTS,
    S3DIS_ROOMS,
    shares_of_kinds,
    summary,
)
from ocp_ros.report.drawing.figure_files import save_figure
from ocp_ros.report.drawing.room_drawing import (
    draw_discs,
    HEIGHTS,
    heights_of,
    INK,
    open_view,
    room_of,
)
from ocp_ros.report.markdown_text import in_markdown
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_cache import load_cached
from ocp_ros.scenes.synthetic.furniture import KINDS
from ocp_ros.scenes.synthetic.generator import generate_room, plan_of
from ocp_ros.util.files import write_atomically
from ocp_ros.util.shown_text import printable

#: Two of each kind, as they come.
SHOWN = (3, 11, 8, 12, 1, 19, 0, 7, 21, 40, 5, 17)
#: Seeds that are measured, and points of each room.
MEASURED, POINTS = range(4000, 4200), 15000


def draw_sheet(path: Path, scenes: Sequence[tuple[str, Scene]], columns: int = 4) -> None:
    """
    Write a PNG of rooms cut open.

    :param path: file to write; its folder is made.
    :param scenes: titles and rooms.
    :param columns: how many beside each other.
    """
    columns = min(columns, len(scenes))
    rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(5.0 * columns, 4.2 * rows), dpi=75, facecolor='white')
    for k, (title, scene) in enumerate(scenes):
        axes = figure.add_axes(((k % columns + 0.02) / columns,
                                (rows - 1 - k // columns + 0.02) / rows,
                                0.96 / columns, 0.86 / rows))
        room = room_of(scene.points, HEIGHTS(heights_of(scene.points))[:, :3])
        view, part = open_view(room)
        outline = draw_discs(axes, part, view).get_xy()
        low, high = outline.min(axis=0), outline.max(axis=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect='equal')
        axes.set_axis_off()
        axes.set_title(title, fontsize=12, color=INK, parse_math=False)
    save_figure(figure, path, dpi=75)


def titled(seed: int, points: int) -> tuple[str, Scene]:
    """Return a generated room with its kind and size."""
    plan = plan_of(seed)
    width, depth, height = plan.size
    return (f'{seed}: {plan.kind.replace("_", " ")}, {width:.1f} x {depth:.1f} x {height:.1f} m',
            generate_room(seed, points))


def measured(scans: Sequence[str], command: str) -> dict[str, Any]:
    """
    Measure generated rooms beside real ones.

    :param scans: files of real ones.
    :param command: which measures them again.
    :returns: the 10th, 50th and 90th percentile of each figure of ``generated`` rooms, the figures
        of each ``real`` one, and the shares of ``kinds`` of surfaces in generated ones, per cent.
    """
    scenes = [load_cached(name, max_points=POINTS) for name in scans]
    real = {scene.name: summary([likeness(scene)]) for scene in scenes}
    shares = 100.0 * shares_of_kinds(MEASURED, POINTS)
    return {'command': command, 'date': date.today().isoformat(),
            'generated': summary(generated(MEASURED, POINTS)),
            'real': {name: {figure: values[1] for figure, values in figures.items()}
                     for name, figures in real.items()},
            'kinds': {kind: float(share) for kind, share in zip(KINDS, shares)}}


def page(rooms: dict[str, Any]) -> str:
    """
    Write the sheet as Markdown.

    :param rooms: of :func:`measured`.
    """
    real = rooms['real']
    lines = [
        '# Generated rooms', '', '`generate_room(seed)` makes offices, conference rooms, lounges, '
        'hallways, storage rooms and open offices, with', 'L-shapes, niches, columns, beams, '
        'partitions, doors, windows, furniture and clutter. Each room has a mesh and a simulated',
        'scan from tripods. The scan is denser at short distances and frontal angles. It has '
        'noise along the ray, shadows, and', 'holes at glass and dark surfaces. The same seed '
        'gives the same room.', '',
        '    ocp rooms list --count 20           # kinds and sizes',
        '    ocp rooms preview 5 17 scan.ply --out out/rooms.png',
        '    ocp rooms make 5 17 --out rooms     # scans and meshes as PLY', '',
        '![Twelve generated rooms](rooms.png)', '', '## Comparison with real rooms', '',
        f'The first table compares the generated rooms of the seeds {MEASURED[0]} to '
        f'{MEASURED[-1]} with real scans. Each room has', f'{POINTS:,} points. The column '
        '*generated* has the 10th percentile, the **median** and the 90th percentile. The other',
        f'columns are one scan each. This command measured the values on {rooms["date"]}:', '',
        f'    {printable(rooms["command"])}', '',
        '- *Floor* is the area above which a camera may be.',
        f'- *Occupied cells* is the share of the cells of {CELL} m in the bounding box that '
        'contain points.',
        '- *Directions that hit something* is the share of the directions from the centre of the '
        'room in which there are points.', '',
        '| figure | generated | ' + ' | '.join(map(in_markdown, real)) + ' |',
        '|---|---|' + '---|' * len(real)]
    for figure, (low, middle, high) in rooms['generated'].items():
        cells = [f'{figures[figure]:.1f}' for figures in real.values()]
        lines.append(f'| {figure} | {low:.1f}, **{middle:.1f}**, {high:.1f} | '
                     + ' | '.join(cells) + ' |')
    lines += ['', 'The second table compares generated rooms with S3DIS, a public data set of '
              f'scanned offices. S3DIS has {S3DIS_ROOMS} rooms with',
              f'over {S3DIS_FLOOR:,.0f} m² of floor, {S3DIS_FLOOR / S3DIS_ROOMS:.0f} m² per room. '
              'Most are small offices that one or two cameras cover. Generated rooms are',
              'larger, as are the rooms of the '
              'paper ([arXiv 2110.11106](https://arxiv.org/abs/2110.11106)). The shares of',
              'S3DIS come from the class weights of Open3D-ML.',
              '', '| class | S3DIS (% of points) | generated (% of points) |', '|---|---|---|']
    published = 100.0 * np.array(S3DIS_POINTS) / sum(S3DIS_POINTS)
    lines += [f'| {kind} | {theirs:.1f} | {ours:.1f} |'
              for (kind, ours), theirs in zip(rooms['kinds'].items(), published)]
    return '\n'.join([*lines, ''])


def main(args: list[str] | None = None) -> int:
    """Write the sheet of the documentation."""
    parser = argparse.ArgumentParser(prog='rooms', description=__doc__)
    parser.add_argument('--out', type=Path, default=Path('out/rooms'), help='folder to write')
    parser.add_argument('--scans', type=Path, help='folder of real scans to compare with')
    options = parser.parse_args(args)
    command = f'python -m ocp_ros.report.room_sheet --out {options.out}' + (
        ' --scans FOLDER' if options.scans else '')
    try:
        scans = rooms_in(options.scans) if options.scans else []
        rooms = measured([*scans, *rooms_of_s3dis()], command)
        draw_sheet(options.out / 'rooms.png', [titled(seed, 40000) for seed in SHOWN])
        write_atomically(options.out / 'rooms.json', json.dumps(
            rooms, indent=1, ensure_ascii=False) + '\n')
        write_atomically(options.out / 'rooms.md', page(rooms))
    except (SceneError, OSError) as error:
        print(f'rooms: {error}', file=sys.stderr)
        return 2
    print(f'wrote {options.out / "rooms.md"}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
