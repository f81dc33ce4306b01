# SPDX-License-Identifier: Apache-2.0
"""
A placement in words that an installer can follow without knowing the map frame.

Walls are the sides of the rectangle around the room, lettered clockwise as in the plan beside the
table; cameras hang so far from two of them and so high, and are turned from facing one of them.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
import numpy as np

from ocp_ros.report.picture import CAMERA_COLOURS
from ocp_ros.report.room import INK, PALE_INK
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.placement_file import Placed, Placement
from ocp_ros.simulation.surfaces import floor_height

#: Per cent of the points that may lie outside the room, seen through doors and windows, and metres
#: from there inwards whose points are the wall's own.
STRAY, SHEET = 0.3, 0.1
#: Degrees: steps of the search for the rectangle; what is less is straight, level or upright;
#: from where on a camera looks straight down or up.
COARSE, FINE, STRAIGHT, STEEP = 1.0, 0.05, 0.5, 85.0
#: Metres above the floor and below the ceiling that a plan leaves out, and points that it shows.
LOW, HIGH, SHOWN = 0.15, 0.4, 12000


class Wall(NamedTuple):
    """
    A side of the rectangle around a room.

    :ivar letter: A to D, clockwise seen from above; A looks most along y of the map.
    :ivar outward: (2,) unit vector out of the room.
    :ivar offset: metres: where outward . (x, y) is this, there is the wall.
    :ivar length: metres.
    """

    letter: str
    outward: np.ndarray
    offset: float
    length: float

    def away(self, position: Sequence[float]) -> float:
        """Return how far a position is from the wall, metres, at right angles."""
        return float(self.offset - self.outward @ np.asarray(position[:2]))


def walls_around(points: np.ndarray) -> list[Wall]:
    """
    Fit the smallest rectangle around a room.

    :param points: (N, 3) metres, map frame.
    :returns: its four sides, A to D.
    """
    flat = points[:, :2].astype(np.float64)
    angle = min(np.arange(-45.0, 45.0, COARSE), key=lambda angle: (_area(flat, angle), abs(angle)))
    angle = min(angle + np.arange(-COARSE, COARSE + FINE, FINE),
                key=lambda angle: (round(_area(flat, angle), 6), abs(angle)))
    turn = np.deg2rad(angle)
    along = [np.array([-np.sin(turn), np.cos(turn)]), np.array([np.cos(turn), np.sin(turn)])]
    outwards = [along[0], along[1], -along[0], -along[1]]
    offsets = [_side(flat @ outward) for outward in outwards]
    lengths = [offsets[1] + offsets[3], offsets[0] + offsets[2]] * 2
    return [Wall(*wall) for wall in zip('ABCD', outwards, offsets, lengths)]


def _area(flat: np.ndarray, angle: float) -> float:
    """Return the area of the rectangle turned by degrees, without what is stray."""
    turn = np.deg2rad(angle)
    turned = flat @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    low, high = np.percentile(turned, [STRAY, 100.0 - STRAY], axis=0)
    return float(np.prod(high - low))


def _side(out: np.ndarray) -> float:
    """Return where the wall is in the outermost sheet of points, given their (N,) offsets."""
    edge = np.percentile(out, 100.0 - STRAY)
    return float(np.median(out[np.abs(out - edge) <= SHEET]))


class Words(NamedTuple):
    """How to hang up one camera."""

    name: str
    sensor: str
    place: str
    height: str
    pan: str
    tilt: str


def words_for(placed: Placed, walls: Sequence[Wall], floor: float) -> Words:
    """
    Say how to hang up a camera.

    :param floor: its height, metres, map frame.
    """
    # One of each pair that faces each other: two opposite walls do not say where a camera is.
    near = sorted((min(pair, key=lambda wall: wall.away(placed.position))
                   for pair in (walls[0::2], walls[1::2])),
                  key=lambda wall: wall.away(placed.position))
    place = ', '.join(f'{100.0 * wall.away(placed.position):.0f} cm from wall {wall.letter}'
                      for wall in near)
    return Words(placed.camera.name, placed.camera.sensor or 'own', place,
                 f'{100.0 * (placed.position[2] - floor):.0f} cm above the floor',
                 _pan(placed, walls), _tilt(placed))


def _pan(placed: Placed, walls: Sequence[Wall]) -> str:
    """Say where a camera faces, seen from above."""
    if placed.camera.model.horizontal_fov >= 2.0 * np.pi - 1e-9:
        return 'any way round'
    yaw, pitch, _ = placed.angles
    # Of a camera that looks straight down, the top of the picture shows where it faces.
    turn = np.deg2rad(yaw + (180.0 if pitch < -STEEP else 0.0))
    ahead = np.array([np.cos(turn), np.sin(turn)])
    wall = max(walls, key=lambda wall: wall.outward @ ahead)
    left = np.rad2deg(np.arctan2(wall.outward[0] * ahead[1] - wall.outward[1] * ahead[0],
                                 wall.outward @ ahead))
    facing = f'top of the picture to wall {wall.letter}' if abs(pitch) > STEEP else (
        f'face wall {wall.letter} squarely')
    if abs(left) < STRAIGHT:
        return facing
    return f'{facing}, then turn {abs(left):.0f} degrees to the {"left" if left > 0 else "right"}'


def _tilt(placed: Placed) -> str:
    """Say how far a camera looks down and how far it is rolled."""
    _, pitch, roll = placed.angles
    if placed.camera.model.omnidirectional:
        return 'upright'
    tilt = 'level' if abs(pitch) < STRAIGHT else (
        f'{abs(pitch):.0f} degrees {"down" if pitch > 0 else "up"}')
    if abs(roll) >= STRAIGHT:
        side = 'clockwise' if roll > 0 else 'anticlockwise'
        tilt += f', rolled {abs(roll):.0f} degrees {side} seen from behind'
    return tilt


def instructions(scene: Scene, placement: Placement, plan: str) -> str:
    """
    Write the installer's page as Markdown.

    :param plan: file name of the plan beside it.
    """
    walls, floor = walls_around(scene.points), floor_height(scene)
    sizes = ', '.join(f'{wall.letter} {wall.length:.2f} m' for wall in walls)
    lines = [f'# How to hang up the cameras: {scene.name}', '', f'![Plan]({plan})', '',
             f'Walls are lettered as in the plan, clockwise seen from above: {sizes}. Where the '
             'room is not', 'a rectangle they are the sides of the rectangle around it. Distances '
             'are at right angles to the wall, to', "the middle of the camera's front. Left and "
             'right are those of somebody who stands behind the camera.', '',
             '| | camera | sensor | place | height | pan | tilt |',
             '|---|---|---|---|---|---|---|']
    for number, placed in enumerate(placement.cameras, start=1):
        words = words_for(placed, walls, floor)
        name = f'{words.name} (in place)' if placed.mount == 'fixed' else words.name
        lines.append(f'| {number} | ' + ' | '.join([name, *words[1:]]) + ' |')
    return '\n'.join([*lines, ''])


def draw_plan(path: Path, scene: Scene, placement: Placement) -> None:
    """Draw the room from above, wall A at the top, with its cameras and where they look."""
    walls = walls_around(scene.points)
    frame = np.stack([walls[1].outward, walls[0].outward])
    low, high = scene.bounds[:, 2]
    points = scene.points[(scene.points[:, 2] > low + LOW) & (scene.points[:, 2] < high - HIGH)]
    flat = points[::max(len(points) // SHOWN, 1), :2] @ frame.T
    figure = Figure(figsize=(10.0, 8.0), dpi=100, facecolor='white')
    axes = figure.add_axes((0.05, 0.05, 0.9, 0.9), aspect='equal')
    axes.set_axis_off()
    axes.scatter(*flat.T, s=2.0, color=PALE_INK, alpha=0.4, linewidths=0.0)
    sides = [wall.offset for wall in walls]
    x, y = (sides[1], -sides[3]), (sides[0], -sides[2])
    axes.plot([x[0], x[0], x[1], x[1], x[0]], [y[0], y[1], y[1], y[0], y[0]], color=INK, lw=1.0)
    for wall, at in zip(walls, [(np.mean(x), y[0] + 0.25), (x[0] + 0.25, np.mean(y)),
                                (np.mean(x), y[1] - 0.25), (x[1] - 0.25, np.mean(y))]):
        axes.text(*at, wall.letter, fontsize=20, fontweight='bold', color=INK, ha='center',
                  va='center')
    for number, placed in enumerate(placement.cameras):
        colour = CAMERA_COLOURS[number % len(CAMERA_COLOURS)]
        place = frame @ placed.position[:2]
        yaw = np.deg2rad(placed.angles[0])
        if placed.camera.model.horizontal_fov < 2.0 * np.pi - 1e-9:
            tip = place + 0.6 * frame @ [np.cos(yaw), np.sin(yaw)]
            axes.annotate('', tip, place, arrowprops={'arrowstyle': '-|>', 'color': colour,
                                                      'lw': 2.5})
        axes.text(*place, str(number + 1), fontsize=12, color='white', ha='center', va='center',
                  bbox={'boxstyle': 'circle', 'facecolor': colour, 'edgecolor': 'white'})
    figure.savefig(path, format='png', dpi=100)
