# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cameras of a picture: dots with numbers that do not hide each other."""

from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
import numpy as np

from ocp_ros.report.drawing.placement_picture import CAMERA_COLOURS

#: Inches for each point of size that the middles of two numbers are apart.
APART = 0.032
NONE = np.empty((0, 2))


def camera_colour(number: int) -> str:
    """Return the colour of a camera, counted from 0."""
    return CAMERA_COLOURS[number % len(CAMERA_COLOURS)]


def apart(places: np.ndarray, least: float, taken: np.ndarray, rounds: int = 200) -> np.ndarray:
    """
    Push places (K, 2) away from each other until all are so far apart, or nearly so.

    :param least: distance, in the same unit.
    :param taken: (M, 2) places that are taken already and stay.
    """
    moved = places + 1e-3 * least * np.random.default_rng(0).standard_normal(places.shape)
    for _ in range(rounds):
        way = moved[:, None] - np.concatenate([moved, taken])[None]
        distance = np.linalg.norm(way, axis=2)
        np.fill_diagonal(distance, 2.0 * least)
        close = np.maximum(least - distance, 0.0) / np.maximum(distance, 1e-9)
        if not close.any():
            break
        moved = moved + 0.5 * (way * close[..., None]).sum(axis=1)
    return moved


def draw_numbers(axes: Axes, places: np.ndarray, size: float, taken: np.ndarray = NONE) -> None:
    """
    Draw cameras (K, 2) as dots with numbers; those on top of each other get them beside.

    :param size: of the letters, points.
    :param taken: (M, 2) where other letters are.
    """
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    box = axes.get_position(original=True)
    width, height = axes.get_figure(root=True).get_size_inches()
    unit = max((right - left) / (box.width * width), (top - bottom) / (box.height * height))
    least = APART * size * unit
    for number, (place, label) in enumerate(zip(places, apart(places, least, taken))):
        colour = camera_colour(number)
        if np.linalg.norm(label - place) > 0.2 * least:
            axes.plot(*np.stack([place, label]).T, color=colour, linewidth=1.0, zorder=6)
        axes.plot(*place, 'o', color=colour, markersize=3.5, markeredgecolor='white',
                  markeredgewidth=0.6, zorder=6)
        axes.text(label[0], label[1], str(number + 1), fontsize=size, fontweight='bold',
                  color='white', ha='center', va='center', zorder=7, clip_on=False,
                  bbox={'boxstyle': 'circle,pad=0.22', 'facecolor': dark(colour),
                        'edgecolor': 'white', 'linewidth': 0.8})


def dark(colour: str) -> tuple[float, float, float]:
    """Return a colour as dark as white letters on it need."""
    rgb = np.array(to_rgb(colour))
    light = float(rgb @ [0.2126, 0.7152, 0.0722])
    return tuple(rgb * min(1.0, 0.5 / max(light, 1e-6)))
