# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of rooms that are cut open, without cameras."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from ocp_ros.report.drawing.figure_files import save_figure
from ocp_ros.report.drawing.room_drawing import (
    draw_discs,
    HEIGHTS,
    heights_of,
    INK,
    open_view,
    room_of,
)
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.synthetic.generator import generate_room, plan_of


def draw_rooms(path: Path, scenes: Sequence[tuple[str, Scene]], columns: int = 4) -> None:
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
