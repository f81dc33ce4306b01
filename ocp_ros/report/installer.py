# SPDX-License-Identifier: Apache-2.0
"""
A placement in words that an installer can follow without knowing the map frame.

Walls are the sides of the rectangle around the room, lettered clockwise as in the plan beside the
table; cameras hang so far from two of them and so high, and are turned from facing one of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ocp_ros.report.markdown_text import in_markdown
from ocp_ros.rig.placement_file import Placed, Placement
from ocp_ros.rig.structure import floor_height, STEEP
from ocp_ros.scenes.scene import Scene

#: Per cent of the points that may lie outside the room, seen through doors and windows; metres
#: that a wall's points are thick, and that a wall may be inside of what the scan shows.
STRAY, SHEET, INSIDE = 0.3, 0.1, 1.5
#: Parts of a quarter turn that directions are counted in, and degrees that a wall's points may be
#: turned from each other.
BINS, TURNED = 90, 5.0
#: Metres: parts of a side that are looked at, and the share of them that makes it a wall.
PART, STANDS = 0.25, 0.3
#: Degrees: what is less is straight, level or upright; from where on a camera looks straight down.
STRAIGHT, DOWN = 0.5, 85.0
#: What stands above the rows of an installer's table, but for the camera's number.
COLUMNS = ('camera', 'sensor', 'place', 'height', 'pan', 'tilt')


class ReferenceWall(NamedTuple):
    """
    A side of the rectangle around a room.

    :ivar letter: A to D, clockwise seen from above; A looks most along y of the map.
    :ivar outward: (2,) unit vector out of the room.
    :ivar offset: metres: where outward . (x, y) is this, there is the wall.
    :ivar length: metres.
    :ivar stands: whether there is a wall; else the scan ends there.
    """

    letter: str
    outward: np.ndarray
    offset: float
    length: float
    stands: bool

    def away(self, position: Sequence[float]) -> float:
        """Return how far a position is from the wall, metres, at right angles."""
        return float(self.offset - self.outward @ np.asarray(position[:2]))


def walls_around(scene: Scene) -> list[ReferenceWall]:
    """
    Lay a rectangle around a room, along its walls.

    :returns: its four sides, A to D.
    """
    upright = np.abs(scene.normals_or_estimate[:, 2]) <= STEEP
    normals, areas = scene.normals_or_estimate[upright], scene.pitch[upright] ** 2
    turn = np.deg2rad(_direction(normals, areas))
    ahead, right = (np.array([-np.sin(turn), np.cos(turn)]),
                    np.array([np.cos(turn), np.sin(turn)]))
    flat = scene.points[:, :2].astype(np.float64)
    outwards = [ahead, right, -ahead, -right]
    edges = [np.percentile(flat @ outward, 100.0 - STRAY) for outward in outwards]
    spans = [edges[1] + edges[3], edges[0] + edges[2]] * 2
    sides = [_side(flat[upright], outward, edge, span)
             for outward, edge, span in zip(outwards, edges, spans)]
    offsets = [offset for offset, _ in sides]
    lengths = [offsets[1] + offsets[3], offsets[0] + offsets[2]] * 2
    return [ReferenceWall(letter, outward, offset, length, stands) for letter, outward, length,
            (offset, stands) in zip('ABCD', outwards, lengths, sides)]


def _direction(normals: np.ndarray, areas: np.ndarray) -> float:
    """Return how far walls with normals (M, 3) are turned: degrees from -45 to 45."""
    angles = np.rad2deg(np.arctan2(normals[:, 1], normals[:, 0])) % 90.0
    counts, _ = np.histogram(angles, BINS, (0.0, 90.0), weights=areas)
    found = (np.argmax(counts + np.roll(counts, 1) + np.roll(counts, -1)) + 0.5) * 90.0 / BINS
    off = (angles - found + 45.0) % 90.0 - 45.0
    near = np.abs(off) <= TURNED
    if near.any():
        found += np.average(off[near], weights=areas[near])
    return float((found + 45.0) % 90.0 - 45.0)


def _side(upright: np.ndarray, outward: np.ndarray, edge: float, span: float
          ) -> tuple[float, bool]:
    """
    Find the outermost wall of a side.

    :param upright: (M, 2) metres, points of walls and furniture.
    :param edge: how far out the scan goes, metres.
    :param span: how long the side is, metres.
    :returns: where the wall is, metres outwards, and whether there is one; else the edge.
    """
    out = upright @ outward
    parts = np.floor(upright @ [-outward[1], outward[0]] / PART)
    for offset in np.arange(edge + SHEET, edge - INSIDE, -0.5 * SHEET):
        near = np.abs(out - offset) <= 0.5 * SHEET
        if len(np.unique(parts[near])) >= STANDS * span / PART:
            # The sheet may reach further in than the step in which it was met.
            return float(np.median(out[np.abs(out - np.median(out[near])) <= 0.5 * SHEET])), True
    return float(edge), False


class Words(NamedTuple):
    """How to hang up one camera."""

    name: str
    sensor: str
    place: str
    height: str
    pan: str
    tilt: str


def words_for(placed: Placed, walls: Sequence[ReferenceWall], floor: float) -> Words:
    """
    Say how to hang up a camera.

    :param floor: its height, metres, map frame.
    """
    # One of each pair that faces each other: two opposite walls do not say where a camera is.
    near = sorted((min(pair, key=lambda wall: wall.away(placed.position))
                   for pair in (walls[0::2], walls[1::2])),
                  key=lambda wall: wall.away(placed.position))
    place = ', '.join(_from(wall, wall.away(placed.position)) for wall in near)
    return Words(placed.camera.name, placed.camera.sensor or 'own', place,
                 f'{100.0 * (placed.position[2] - floor):.0f} cm above the floor',
                 _pan(placed, walls), _tilt(placed))


def _from(wall: ReferenceWall, away: float) -> str:
    """Say how far a camera is from a wall."""
    side = 'from' if away >= 0.0 else 'beyond'
    return f'{abs(100.0 * away):.0f} cm {side} wall {wall.letter}'


def _pan(placed: Placed, walls: Sequence[ReferenceWall]) -> str:
    """Say where a camera faces, seen from above."""
    if placed.camera.model.horizontal_fov >= 2.0 * np.pi - 1e-9:
        return 'any way round'
    yaw, pitch, _ = placed.angles
    # Of a camera that looks straight down, the top of the picture shows where it faces.
    turn = np.deg2rad(yaw + (180.0 if pitch < -DOWN else 0.0))
    ahead = np.array([np.cos(turn), np.sin(turn)])
    wall = max(walls, key=lambda wall: wall.outward @ ahead)
    left = np.rad2deg(np.arctan2(wall.outward[0] * ahead[1] - wall.outward[1] * ahead[0],
                                 wall.outward @ ahead))
    facing = f'top of the picture to wall {wall.letter}' if abs(pitch) > DOWN else (
        f'face wall {wall.letter} squarely')
    if abs(left) < STRAIGHT:
        return facing
    return f'{facing}, then turn {_degrees(left)} to the {"left" if left > 0 else "right"}'


def _degrees(angle: float) -> str:
    """Say how large an angle is, degrees."""
    return f'{abs(angle):.0f} degree{"" if round(abs(angle)) == 1 else "s"}'


def _tilt(placed: Placed) -> str:
    """Say how far a camera looks down and how far it is rolled."""
    _, pitch, roll = placed.angles
    if placed.camera.model.omnidirectional:
        return 'upright'
    tilt = 'level' if abs(pitch) < STRAIGHT else (
        f'{_degrees(pitch)} {"down" if pitch > 0 else "up"}')
    if abs(roll) >= STRAIGHT:
        side = 'clockwise' if roll > 0 else 'anticlockwise'
        tilt += f', rolled {_degrees(roll)} {side} seen from behind'
    return tilt


def rows_of(placement: Placement, walls: Sequence[ReferenceWall], floor: float) -> list[list[str]]:
    """Return what an installer is told of each camera, the names of :data:`COLUMNS` above it."""
    rows = []
    for number, placed in enumerate(placement.cameras, start=1):
        words = words_for(placed, walls, floor)
        name = f'{words.name} (in place)' if placed.mount == 'fixed' else words.name
        rows.append([str(number), name, *words[1:]])
    return rows


def instructions(scene: Scene, placement: Placement, plan: str) -> str:
    """
    Write the installer's page as Markdown.

    :param plan: file name of the plan beside it.
    """
    walls, floor = walls_around(scene), floor_height(scene)
    sizes = ', '.join(f'{wall.letter} {wall.length:.2f} m' + (
        '' if wall.stands else ' (no wall stands there: measure from the line in the plan)')
        for wall in walls)
    lines = [f'# How to hang up the cameras: {in_markdown(scene.name)}', '',
             f'![Plan]({plan})', '',
             f'Walls are lettered as in the plan, clockwise seen from above: {sizes}. Where the '
             'room is not', 'a rectangle they are the sides of the rectangle around it. Distances '
             'are at right angles to the wall, to', "the middle of the camera's front. Left and "
             'right are those of somebody who stands behind the camera.', '',
             f'| | {" | ".join(COLUMNS)} |', '|---' * (len(COLUMNS) + 1) + '|']
    lines += ['| ' + ' | '.join(map(in_markdown, row)) + ' |'
              for row in rows_of(placement, walls, floor)]
    if 'planner' in placement.created:
        planner = in_markdown(placement.created['planner'])
        lines += ['', f'The placement was found by the planner {planner}.']
    return '\n'.join([*lines, ''])
