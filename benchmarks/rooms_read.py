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

"""
Rooms as people have them: what is read of generated files of the kinds that go wrong.

A kind is a function that draws a member (its size, angle, density and noise), writes the file,
reads it and judges what was read: right, a clear refusal, or wrong. ``--as before`` keeps the
verdicts of an older package beside those of today.

    python -m benchmarks.rooms_read --record
"""

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
import json
import logging
from pathlib import Path
import re
import struct
from tempfile import TemporaryDirectory
import time
from typing import NamedTuple
import warnings

from benchmarks import results
import laspy
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.report.room_facts import facts_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Mesh, Scene, SceneError
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.util.settings import UserError
from scipy.spatial import cKDTree

RIGHT, REFUSED, WRONG = 'right', 'clear refusal', 'wrong'
#: The corners of the six sides of a box. The number of a corner is x + 2 y + 4 z, 1 if far.
BOX_SIDES = np.array([[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4],
                      [1, 3, 7, 5]])


class Verdict(NamedTuple):
    """The verdict on what was read of a member, and what was found if it is not right."""

    outcome: str
    found: str = ''


class Answer(NamedTuple):
    """A room that was read, and what ``ocp info`` says of it."""

    scene: Scene
    facts: dict

    def says(self, pattern: str) -> bool:
        """Return whether a note or remark matches a pattern."""
        return any(re.search(pattern, said)
                   for said in (*self.facts['notes'], *self.facts['remarks']))


#: The functions of the kinds by name: from a generator of chance and a folder to a verdict.
KINDS: dict[str, Callable[[np.random.Generator, Path], Verdict]] = {}


def kind(judge: Callable[[np.random.Generator, Path], Verdict]) -> Callable:
    """Add a kind."""
    KINDS[judge.__name__] = judge
    return judge


def verdict(**wrong: bool) -> Verdict:
    """Return the verdict given what may be wrong, by name."""
    found = [name.replace('_', ' ') for name, is_wrong in wrong.items() if is_wrong]
    return Verdict(WRONG if found else RIGHT, ', '.join(found))


def read(path: Path, **options) -> Answer:
    """Read a room and measure it."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        scene = load_scene(path, **{'max_points': 60_000, **options})
    return Answer(scene, facts_of(scene))


def saved(folder: Path, points: np.ndarray) -> Path:
    """Write points (N, 3), metres, in a random order, as a file."""
    path = folder / 'room.npy'
    np.save(path, np.random.default_rng(0).permutation(points).astype(np.float32))
    return path


def quad(corner: Sequence[float], along: Sequence[float], up: Sequence[float],
         *holes: Sequence[float]) -> np.ndarray:
    """
    Return the triangles (T, 3, 3) of a rectangle with holes.

    :param holes: where each begins and ends along and up: four shares of the edges.
    """
    corner, along, up = (np.array(vector, dtype=np.float64) for vector in (corner, along, up))
    edges_along = np.unique([0.0, 1.0, *(edge for hole in holes for edge in hole[:2])])
    edges_up = np.unique([0.0, 1.0, *(edge for hole in holes for edge in hole[2:])])
    corners = [corner + np.outer((a, b, b, a), along) + np.outer((c, c, d, d), up)
               for a, b in zip(edges_along, edges_along[1:])
               for c, d in zip(edges_up, edges_up[1:])
               if not any(hole[0] <= a and b <= hole[1] and hole[2] <= c and d <= hole[3]
                          for hole in holes)]
    return _triangles(np.array(corners).reshape(-1, 4, 3))


def box(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Return the triangles (12, 3, 3) of a box."""
    is_far = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return _triangles(np.where(is_far, high, low).astype(np.float64)[BOX_SIDES])


def _triangles(quads: np.ndarray) -> np.ndarray:
    """Return the two triangles of each of Q quads (Q, 4, 3)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def shell(size: Sequence[float], **holes: Sequence[Sequence[float]]) -> list[np.ndarray]:
    """Return the sides of a room from its corner: floor, ceiling, south, north, west, east."""
    x, y, z = size
    return [quad((0, 0, 0), (x, 0, 0), (0, y, 0), *holes.get('floor', ())),
            quad((0, 0, z), (x, 0, 0), (0, y, 0), *holes.get('ceiling', ())),
            quad((0, 0, 0), (x, 0, 0), (0, 0, z), *holes.get('south', ())),
            quad((0, y, 0), (x, 0, 0), (0, 0, z), *holes.get('north', ())),
            quad((0, 0, 0), (0, y, 0), (0, 0, z), *holes.get('west', ())),
            quad((x, 0, 0), (0, y, 0), (0, 0, z), *holes.get('east', ()))]


def furniture(rng: np.random.Generator, size: Sequence[float], count: int = 4) -> list[np.ndarray]:
    """Draw boxes that stand in a room, lower than a scanner."""
    boxes = []
    for _ in range(count):
        edges = rng.uniform((0.4, 0.4, 0.4), (1.4, 0.9, min(1.25, 0.75 * size[2])))
        low = rng.uniform((0.1, 0.1), np.maximum(np.array(size[:2]) - edges[:2] - 0.1, 0.11))
        boxes.append(box((*low, 0.0), (*(low + edges[:2]), edges[2])))
    return boxes


def scan(rng: np.random.Generator, parts: list[np.ndarray], stations: np.ndarray, rays: int,
         noise: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Scan triangles with rays that leave each station evenly in all directions.

    :returns: the hit points (N, 3) with noise along the ray, metres, and their stations (N, 3).
    """
    corners = np.concatenate(parts).astype(np.float32)
    mesh = MeshRays(Mesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)))
    points, origins = [], []
    for station in stations:
        # A spiral on the sphere; each station begins at a random angle.
        z = 1.0 - 2.0 * (np.arange(rays) + 0.5) / rays
        azimuth = np.arange(rays) * np.pi * (3.0 - np.sqrt(5.0)) + rng.uniform(0.0, 2.0 * np.pi)
        level = np.sqrt(1.0 - z * z)
        directions = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), z])
        lengths = mesh.lengths(station, directions)
        is_hit = lengths < 120.0
        lengths = lengths[is_hit] + rng.normal(0.0, noise, is_hit.sum())
        points.append(station + lengths[:, None] * directions[is_hit])
        origins.append(np.broadcast_to(station, points[-1].shape))
    return np.concatenate(points), np.concatenate(origins)


def stations_in(rng: np.random.Generator, low: Sequence[float], high: Sequence[float], count: int
                ) -> np.ndarray:
    """Draw places of a scanner between two corners of a plan: (count, 3) metres."""
    return np.column_stack([rng.uniform(low[:2], high[:2], (count, 2)),
                            rng.uniform(1.3, 1.7, count)])


def even_points(rng: np.random.Generator, parts: list[np.ndarray], spacing: float, noise: float
                ) -> np.ndarray:
    """Draw points (N, 3) evenly on triangles, metres."""
    corners = np.concatenate(parts)
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.linalg.norm(crosses, axis=1)
    faces = rng.choice(len(corners), int(areas.sum() / spacing ** 2), p=areas / areas.sum())
    shares = rng.uniform(size=(len(faces), 2))
    shares = np.where(shares.sum(axis=1, keepdims=True) > 1.0, 1.0 - shares, shares)
    chosen = corners[faces]
    points = (chosen[:, 0] + shares[:, :1] * (chosen[:, 1] - chosen[:, 0])
              + shares[:, 1:] * (chosen[:, 2] - chosen[:, 0]))
    return points + rng.normal(0.0, noise, points.shape)


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    """Return points that are turned about the vertical axis."""
    return points @ rotation_matrix(np.deg2rad(degrees)).T


def kept_share(scene: Scene, points: np.ndarray) -> float:
    """Return the share of points that have a point of a room nearby."""
    some = points[::max(len(points) // 5000, 1)]
    tree = cKDTree(scene.points)
    reach = 0.1 + 3.0 * float(np.median(scene.pitch))
    return float(np.isfinite(tree.query(some, distance_upper_bound=reach)[0]).mean())


def room_verdict(answer: Answer, own: np.ndarray, size: Sequence[float], degrees: float,
                 is_noted: bool) -> Verdict:
    """Return the verdict on a room of a size, given its own points (N, 3) in the file."""
    found = turned(answer.scene.points.astype(np.float64), -degrees)
    reach = 0.6
    outside = ((found < -reach) | (found > np.array(size) + reach)).any(axis=1).mean()
    share = kept_share(answer.scene, own)
    return verdict(**{f'{100 * outside:.1f} % of the points outside': outside > 0.002,
                      f'{100 * share:.0f} % of the room kept': share < 0.97,
                      f'floor at {answer.facts["floor"]:.2f}': abs(answer.facts['floor']) > 0.06,
                      'no note': not is_noted})


@kind
def view_through_a_window(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a room from whose window the scanner saw ground, lower or level, and a house."""
    x, y, z = size = rng.uniform((4, 3.5, 2.4), (8, 6, 3.2))
    width, left = rng.uniform(0.35, 0.8), rng.uniform(0.05, 0.2)
    sill, top = rng.choice([0.0, 0.3, 0.9]), rng.uniform(2.0, z - 0.2)
    hole = (left, min(left + width, 0.95), sill / z, top / z)
    depth, away = rng.choice([0.1, 2.0, 3.5, 6.5]), rng.uniform(10.0, 40.0)
    parts = [*shell(size, south=[hole]), *furniture(rng, size)]
    outside = [quad((-60, -80, -depth), (120, 0, 0), (0, 79.7, 0)),
               box((-15, -away - 10, -depth), (rng.uniform(8, 20), -away, 9))]
    count = int(rng.integers(1, 4))
    stations = stations_in(rng, (0.8, 0.8), size - 0.8, count)
    points, _ = scan(rng, parts + outside, stations, int(rng.uniform(40_000, 120_000) / count),
                     rng.uniform(0.002, 0.008))
    degrees = rng.uniform(0.0, 360.0)
    own = turned(points[points[:, 1] > -0.05], degrees)
    answer = read(saved(folder, turned(points, degrees)))
    return room_verdict(answer, own, size, degrees, answer.says('window|outside|opening'))


@kind
def glass_partition(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a room with a glass wall, which a scan hardly shows, and another room behind it."""
    x, y, z = size = rng.uniform((4.5, 4, 2.5), (8, 6, 3))
    style = rng.choice(['bare', 'frame', 'dirt', 'parapet', 'corridor'])
    behind = rng.uniform(1.4, 2.2) if style == 'corridor' else rng.uniform(3, 5)
    parapet = rng.uniform(0.8, 1.1) / z if style == 'parapet' else 0.0
    parts = [*shell(size, west=[(0, 1, parapet, 1)]), *furniture(rng, size)]
    beyond = [part - np.array([behind, 0, 0])
              for part in [*shell((behind, y, z), east=[(0, 1, 0, 1)]),
                           *(furniture(rng, (behind - 0.3, y, z), 3) if behind > 2.5 else [])]]
    if style == 'frame':
        posts = np.linspace(0.0, y - 0.06, 2 + int(y / rng.uniform(0.9, 1.6)))
        parts += [box((-0.03, post, 0), (0.03, post + 0.06, z)) for post in posts]
        parts += [box((-0.03, 0, low), (0.03, y, low + 0.08)) for low in (0.0, z - 0.08)]
    stations = stations_in(rng, (0.8, 0.8), size - 0.8, int(rng.integers(1, 4)))
    points, origins = scan(rng, parts + beyond, stations,
                           int(rng.uniform(30_000, 100_000) / len(stations)),
                           rng.uniform(0.002, 0.006))
    # Glass lets a part of the light through, and a dirty one returns a little of it.
    is_beyond = points[:, 0] < -0.035
    is_returned = rng.uniform(size=len(points)) < rng.uniform(0.3, 0.6)
    at = origins + (points - origins) * (origins[:, :1] / np.where(
        is_beyond, origins[:, 0] - points[:, 0], 1.0)[:, None])
    dirt = at[is_beyond & ~is_returned]
    dirt = dirt[rng.uniform(size=len(dirt)) < (0.05 if style == 'dirt' else 0.0)]
    points = np.concatenate([points[~is_beyond | is_returned],
                             dirt + rng.normal(0.0, 0.004, dirt.shape)])
    degrees = rng.uniform(0.0, 360.0)
    own = turned(points[points[:, 0] > -0.035], degrees)
    answer = read(saved(folder, turned(points, degrees)))
    return room_verdict(answer, own, size, degrees, answer.says('glass|opening|mirror'))


@kind
def drifted_scan(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge two scans of one room that do not fit: moved, turned, or only partly the same."""
    size = rng.uniform((4, 3.5, 2.4), (8, 6, 3))
    parts = [*shell(size), *furniture(rng, size)]
    stations = stations_in(rng, (0.8, 0.8), size - 0.8, 2)
    rays, noise = int(rng.uniform(20_000, 50_000)), rng.uniform(0.002, 0.008)
    first, second = (scan(rng, parts, stations, rays, noise)[0] for _ in range(2))
    style = rng.choice(['height', 'level', 'yaw', 'overlap'])
    shift = np.append(rng.uniform(0.15, 0.4, 2) * rng.choice([-1, 1], 2), 0.0)
    if style == 'height':
        shift = np.array([0.0, 0.0, rng.uniform(0.2, 0.5)])
    if style == 'yaw':
        second = turned(second - 0.5 * size, rng.choice([-1, 1]) * rng.uniform(3.0, 8.0))
        shift = 0.5 * size
    if style == 'overlap':
        first, second = first[first[:, 0] < 0.7 * size[0]], second[second[:, 0] > 0.3 * size[0]]
    answer = read(saved(folder, turned(np.concatenate([first, second + shift]),
                                       rng.uniform(0.0, 360.0))))
    return verdict(**{f'{style}: no note': not answer.says('drift'), f'{style}: a solid model':
                      any('solid model' in remark for remark in answer.facts['remarks'])})


@kind
def thinned_scan(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge whether what is said of a hall with racks depends on how far it is thinned."""
    size = rng.uniform((14, 10, 5), (24, 16, 8))
    x, y, z = size
    parts = shell(size)
    for low in np.arange(2.0, y - 2.0, 3.5):
        parts += [box((2.0, low, level), (x - 2.0, low + 1.0, level + 0.05))
                  for level in np.arange(0.2, 0.7 * z, rng.uniform(1.2, 2.0))]
    stations = stations_in(rng, (1.0, 1.0), size - 1.0, 6)
    points, _ = scan(rng, parts, stations, int(rng.uniform(40_000, 80_000)), 0.004)
    path = saved(folder, turned(points, rng.uniform(0.0, 360.0)))
    answers = [read(path, max_points=count) for count in (0, 60_000, 15_000, 5000)]
    notes = {tuple(re.sub(r'[\d.,]+', '#', note) for note in answer.facts['notes'])
             for answer in answers}
    kept = [kept_share(answer.scene, answers[0].scene.points) for answer in answers]
    floors = np.ptp([answer.facts['floor'] for answer in answers])
    return verdict(**{f'{len(notes)} sets of notes': len(notes) > 1,
                      f'{100 * min(kept):.0f} % of the room kept': min(kept) < 0.98,
                      f'floors that differ by {floors:.2f} m': floors > 0.05})


@kind
def attic(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a room under a gable roof on knee walls."""
    x, y, knee = rng.uniform((4, 4, 0.3), (8, 6, 1.1))
    ridge = rng.uniform(2.4, 3.6)
    gables = [np.array([[(at, 0, 0), (at, y, 0), (at, y, knee)],
                        [(at, 0, 0), (at, y, knee), (at, 0, knee)],
                        [(at, 0, knee), (at, y, knee), (at, y / 2, ridge)]]) for at in (0, x)]
    parts = [shell((x, y, knee))[0], *shell((x, y, knee))[2:4], *gables, *(
        quad((0, side, knee), (x, 0, 0), (0, y / 2 - side, ridge - knee)) for side in (0.0, y))]
    parts += furniture(rng, (x - 1.5, y - 1.5, 0.7), 3)
    points = even_points(rng, parts, rng.uniform(0.05, 0.1), rng.uniform(0.0, 0.008))
    answer = read(saved(folder, turned(points, rng.uniform(0.0, 360.0))))
    notes = [note for note in answer.facts['notes'] if 'low' not in note]
    return verdict(**{'; '.join(notes)[:90]: bool(notes),
                      'no ceiling found': answer.facts['ceiling'] is None})


@kind
def low_ceiling(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a room that is lower than 2 m."""
    size = rng.uniform((3, 2.5, 1.6), (6, 4, 1.97))
    parts = [*shell(size), *furniture(rng, size, 2)]
    points = even_points(rng, parts, rng.uniform(0.04, 0.08), rng.uniform(0.0, 0.008))
    answer = read(saved(folder, turned(points, rng.uniform(0.0, 360.0))))
    return verdict(no_note=not answer.says('low'), wrong_note=answer.says('no ceiling|upside'))


@kind
def stray_points(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a furnished room with points in its air."""
    room = generate_room(int(rng.integers(5000, 9000)), int(rng.uniform(20_000, 60_000)))
    low, high = room.bounds
    strays = rng.uniform(low, high, (int(rng.uniform(0.02, 0.08) * len(room)), 3))
    answer = read(saved(folder, np.concatenate([room.points, strays])), max_points=40_000)
    share = kept_share(answer.scene, room.points)
    return verdict(**{f'{100 * share:.1f} % of the room kept': share < 0.99,
                      '; '.join(answer.facts['notes'])[:90]: bool(answer.facts['notes'])})


@kind
def plain_room(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a room without anything odd: long or square, scanned from one end or from all over."""
    size = rng.uniform((6, 3.5, 2.4), (14, 6, 3.2))
    parts = [*shell(size), *furniture(rng, size, 6)]
    style = rng.choice(['from one end', 'from all over', 'half a ceiling'])
    if style == 'half a ceiling':
        parts[1] = quad((0, 0, size[2]), (0.5 * size[0], 0, 0), (0, size[1], 0))
    reach = np.where(style == 'from one end', size * [0.3, 0.8, 1], size * 0.85)
    stations = stations_in(rng, (0.8, 0.8), reach, int(rng.integers(2, 4)))
    points, _ = scan(rng, parts, stations, int(rng.uniform(15_000, 60_000)),
                     rng.uniform(0.002, 0.008))
    degrees = rng.uniform(0.0, 360.0)
    answer = read(saved(folder, turned(points, degrees)))
    notes = [note for note in answer.facts['notes'] if 'ceiling' not in note]
    share = kept_share(answer.scene, turned(points, degrees))
    return verdict(**{f'{style}: {100 * share:.0f} % kept': share < 0.97,
                      f'{style}: {"; ".join(notes)[:90]}': bool(notes)})


def drawn_points(rng: np.random.Generator) -> np.ndarray:
    """Draw points (N, 3) of a furnished room that is turned, metres, in a random order."""
    size = rng.uniform((3.5, 3, 2.3), (9, 7, 3.4))
    points = even_points(rng, [*shell(size), *furniture(rng, size)], rng.uniform(0.11, 0.16),
                         rng.uniform(0.0, 0.006))
    return turned(rng.permutation(points), rng.uniform(0.0, 360.0))


def file_verdict(path: Path, points: np.ndarray, cause: str, note: str = '') -> Verdict:
    """
    Return the verdict on a file of a room: read in metres, or refused by its cause.

    :param points: (N, 3) metres, those of the file.
    :param cause: a pattern of what a clear refusal says.
    :param note: a pattern of what a note or remark has to say if the room is read.
    """
    try:
        answer = read(path)
    except (SceneError, UserError) as error:
        message = str(error)
        # A line that the message proposes has to help.
        if line := re.search(r"sed -i '1i ([^']*)'", message):
            path.write_text(f'{line[1]}\n{path.read_text()}')
            return Verdict(REFUSED if re.search(cause, message) and file_verdict(
                path, points, '--scale 0.001', note).outcome != WRONG else WRONG, message)
        return Verdict(REFUSED if re.search(cause, message) else WRONG, message)
    found = ' x '.join(f'{edge:.2f}' for edge in answer.scene.size)
    return verdict(**{f'{found} m': not np.allclose(
        answer.scene.size, np.ptp(points, axis=0), rtol=0.03, atol=0.06),
        'no note': not (answer.says(note) if note else True)})


def write_lines(path: Path, rows: Sequence[Sequence[str]], separator: str, head: str = ''
                ) -> Path:
    """Write rows of cells as lines, perhaps below a first line."""
    path.write_text('\n'.join([*([head] if head else []), *map(separator.join, rows)]) + '\n',
                    encoding='utf-8')
    return path


def cells_of(points: np.ndarray, digits: int, mark: str = '.') -> list[list[str]]:
    """Return coordinates (N, 3) as cells with a number of decimals."""
    return [[f'{value:.{digits}f}'.replace('.', mark) for value in row] for row in points.tolist()]


@kind
def las_units(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a LAS file with units in plan and in height, as text or as keys."""
    points = drawn_points(rng)
    units = [('metre', 1.0, 9001), ('foot', 0.3048, 9002),
             ('US survey foot', 1200.0 / 3937.0, 9003)]
    (plan, plan_m, plan_code), (height, height_m, height_code) = (
        units[k] for k in rng.choice(3, 2, replace=rng.uniform() < 0.2))
    geographic = 'GEOGCS["g",DATUM["d",SPHEROID["s",6378137,298.257]],UNIT["degree",0.01745]]'
    style = rng.choice(['keys', 'systems', 'old text', 'new text'])
    if style == 'systems':
        # Systems in metres or in feet by their codes.
        (plan, plan_m), (height, height_m) = (('metre', 1.0) if is_metric else ('foot', 0.3048)
                                              for is_metric in rng.permutation([True, False]))
    keys = ([(3072, 26918 if plan == 'metre' else 2263), (4096, 5703 if height == 'metre' else
                                                          6360)]
            if style == 'systems' else [(3072, 32767), (3076, plan_code), (4099, height_code)])
    body = np.array([(1, 1, 0, len(keys)), *((key, 0, 1, value) for key, value in keys)], '<u2')
    record = (34735, body.tobytes())
    if style == 'old text':
        record = 2112, (f'COMPD_CS["c",PROJCS["p",{geographic},UNIT["{plan}",{plan_m:.12f}]],'
                        f'VERT_CS["v",VERT_DATUM["d",2005],UNIT["{height}",{height_m:.12f}]]]'
                        ).encode()
    if style == 'new text':
        record = 2112, (f'COMPOUNDCRS["c",PROJCRS["p",CS[Cartesian,2],LENGTHUNIT["{plan}",'
                        f'{plan_m:.12f}]],VERTCRS["v",CS[vertical,1],LENGTHUNIT["{height}",'
                        f'{height_m:.12f}]]]').encode()
    header = laspy.LasHeader(point_format=int(rng.choice([0, 3])), version='1.2')
    header.scales, header.offsets = [1e-3] * 3, rng.uniform(1e3, 9e5, 3).round()
    header.vlrs.append(laspy.VLR('LASF_Projection', record[0], '', record[1]))
    content = laspy.LasData(header)
    content.x, content.y, content.z = (points / [plan_m, plan_m, height_m] + header.offsets).T
    content.write(folder / 'room.las')
    names = plan if plan == height else f'{plan} in plan, {height} in height'
    return file_verdict(folder / 'room.las', points, '^$', names if names != 'metre' else '')


@kind
def colours_first(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a text file with colours before the coordinates."""
    points = drawn_points(rng)
    colours = rng.integers(0, 256, points.shape)
    style = rng.choice(['bytes', 'decimals', 'shares', 'alpha', 'commas', 'millimetres'])
    separator = str(rng.choice([' ', '\t', ';'] if style == 'commas' else [' ', ',', '\t', ';']))
    front = cells_of(colours / 255.0 if style == 'shares' else colours,
                     {'shares': 4, 'decimals': 1}.get(style, 0), ',' if style == 'commas' else '.')
    if style == 'alpha':
        front = [[*row, '255'] for row in front]
    back = (cells_of(1000.0 * points, 0) if style == 'millimetres' else
            cells_of(points, int(rng.integers(2, 6)), ',' if style == 'commas' else '.'))
    path = write_lines(folder / 'room.txt', [first + rest for first, rest in zip(front, back)],
                       separator)
    return file_verdict(path, points, 'colours')


@kind
def decimal_commas(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a text file with decimal commas between blanks, tabs, semicolons, quotes or commas."""
    points = drawn_points(rng)
    separator = str(rng.choice([' ', '\t', ';', ',', '","']))
    rows = cells_of(points, int(rng.integers(2, 6)), ',')
    if separator == '","':
        rows = [['"' + row[0], row[1], row[2] + '"'] for row in rows]
    path = write_lines(folder / 'room.csv', rows, separator,
                       'x;y;z' if separator == ';' and rng.uniform() < 0.5 else '')
    return file_verdict(path, points, 'commas between numbers')


@kind
def counting_column(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a text file whose first column counts, names, or is a time."""
    points = drawn_points(rng)
    style = rng.choice(['from one', 'by ten', 'backwards', 'decimals', 'names', 'time'])
    numbers = np.arange(1, len(points) + 1)
    first = {'from one': map(str, numbers), 'by ten': map(str, 10 * numbers),
             'backwards': map(str, numbers[::-1]), 'decimals': (f'{k}.000' for k in numbers),
             'names': (f'P{k:05d}' for k in numbers),
             'time': (f'{k * 1e-4 + 5.0:.6f}' for k in numbers)}[str(style)]
    rows = [[name, *row] for name, row in zip(first, cells_of(points, 3))]
    path = write_lines(folder / 'room.txt', rows, str(rng.choice([' ', ',', '\t', ';'])))
    return file_verdict(path, points, 'number of the point|words|times')


@kind
def survey_table(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a table of a surveyor: point, northing, easting, height and code, with names."""
    points = drawn_points(rng)
    metres, unit = [(1.0, ''), (1.0, ' (m)'), (0.3048, ' (ft)')][rng.integers(3)]
    names = [['P', 'N', 'E', 'Z', 'D'], ['Point', 'Northing', 'Easting', 'Elevation', 'Code'],
             ['Pkt', 'Hoch', 'Rechts', 'H', 'Code']][rng.integers(3)]
    names[1:4] = [name + unit for name in names[1:4]]
    far = (points / metres + rng.uniform(1e4, 9e5, 3).round())[:, [1, 0, 2]]
    separator = str(rng.choice([',', ';', '\t']))
    mark = ',' if separator == ';' and rng.uniform() < 0.5 else '.'
    rows = [[str(k), *row, 'WALL TOP'] for k, row in enumerate(cells_of(far, 3, mark), start=1)]
    path = write_lines(folder / 'room.csv', rows, separator, separator.join(names))
    return file_verdict(path, points, '^$', 'foot' if metres < 1.0 else '')


@kind
def thousands(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a text file of millimetres with separators of thousands."""
    points = drawn_points(rng)
    mark, decimal, separators = [
        (',', '.', [' ', ';', '\t', ',', '","']), ('.', ',', [' ', ';', '\t']),
        ("'", '.', [' ', ';', ',']), ('\u2019', '.', [' ', ';']), (' ', ',', [';', '\t']),
        ('\u202f', ',', [';', '\t', ' '])][rng.integers(6)]
    digits, separator = int(rng.integers(0, 3)), str(rng.choice(separators))
    swap = str.maketrans({',': mark, '.': decimal})
    rows = [[f'{value:,.{digits}f}'.translate(swap) for value in row]
            for row in (1000.0 * (points - points.min(axis=0)) + 2.0).tolist()]
    if separator == '","':
        rows = [['"' + row[0], row[1], row[2] + '"'] for row in rows]
    return file_verdict(write_lines(folder / 'room.csv', rows, separator), points, 'thousands')


@kind
def ragged_lines(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a text file whose lines have different numbers of cells."""
    points = drawn_points(rng)
    separator, step = str(rng.choice([',', ';', '\t'])), int(rng.integers(2, 40))
    style = rng.choice(['first', 'last', 'empty', 'short', 'half'])
    rows = cells_of(points, 3)
    for k in range(0, len(rows), step):
        rows[k] = {'first': [str(k % 4), *rows[k]], 'last': [*rows[k], '7', '8'],
                   'empty': [rows[k][0], '', rows[k][2]], 'short': rows[k][:2],
                   'half': [*rows[k][:2], '']}[str(style)]
    path = write_lines(folder / 'room.csv', rows, separator)
    return file_verdict(path, points, 'lines of 3 and of 4|of the next lines|other lines')


@kind
def gltf_extensions(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a glTF file that needs an extension: quantized, compressed or others."""
    size = rng.uniform((3.5, 3, 2.3), (9, 7, 3.4))
    corners = np.concatenate([*shell(size), *furniture(rng, size)]).reshape(-1, 3)
    corners = np.column_stack([corners[:, 0], corners[:, 2], -corners[:, 1]])
    name = str(rng.choice(['KHR_mesh_quantization', 'KHR_mesh_quantization',
                           'KHR_draco_mesh_compression', 'EXT_meshopt_compression']))
    low, edge = corners.min(axis=0), np.ptp(corners, axis=0).max()
    code, number_type = [(5123, '<u2'), (5121, 'u1')][rng.integers(2)]
    full = np.iinfo(number_type).max
    values = np.round((corners - low) / edge * full).astype(number_type)
    # Rows are padded to four bytes.
    width = 3 * values.itemsize + -3 * values.itemsize % 4
    rows = np.zeros((len(values), width // values.itemsize), number_type)
    rows[:, :3] = values
    document = json.dumps({
        'asset': {'version': '2.0'}, 'scenes': [{'nodes': [0]}], 'scene': 0,
        'extensionsUsed': [name], 'extensionsRequired': [name],
        'nodes': [{'mesh': 0, 'scale': [edge] * 3, 'translation': low.tolist()}],
        'meshes': [{'primitives': [{'attributes': {'POSITION': 0}}]}],
        'accessors': [{'bufferView': 0, 'componentType': code, 'normalized': True,
                       'count': len(rows), 'type': 'VEC3'}],
        'bufferViews': [{'buffer': 0, 'byteLength': rows.nbytes, 'byteStride': width}],
        'buffers': [{'byteLength': rows.nbytes}]}).encode()
    document += b' ' * (-len(document) % 4)
    (folder / 'room.glb').write_bytes(
        b'glTF' + struct.pack('<IIII', 2, 28 + len(document) + rows.nbytes, len(document),
                              0x4E4F534A)
        + document + struct.pack('<II', rows.nbytes, 0x004E4942) + rows.tobytes())
    upright = corners[:, [0, 2, 1]]
    return file_verdict(folder / 'room.glb', upright, '^$' if 'quant' in name else name)


@kind
def unit_in_comment(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge an OBJ file that names its unit in a comment."""
    size = rng.uniform((3.5, 3, 2.3), (9, 7, 3.4))
    corners = turned(np.concatenate([*shell(size), *furniture(rng, size)]).reshape(-1, 3),
                     rng.uniform(0.0, 360.0))
    unit, metres = [('mm', 0.001), ('centimeters', 0.01), ('inches', 0.0254), ('feet', 0.3048),
                    ('Meters', 1.0)][rng.integers(5)]
    comment = ['# File units = {}', '# Units: {}', '# unit {}', '# 1 unit = 1 {}',
               '# all measurements in {}', '# Exported by Program 2.1, units are {}',
               '# This file uses {} as units'][rng.integers(7)].format(unit)
    lines = [f'v {x:.6f} {y:.6f} {z:.6f}' for x, y, z in (corners / metres).tolist()]
    lines += [f'f {k} {k + 1} {k + 2}' for k in range(1, len(corners), 3)]
    (folder / 'room.obj').write_text('\n'.join(['# a room', comment, *lines]) + '\n')
    return file_verdict(folder / 'room.obj', corners, '^$', 'unit' if metres != 1.0 else '')


@kind
def splats(rng: np.random.Generator, folder: Path) -> Verdict:
    """Judge a file of Gaussian splats, which has no scale."""
    points = drawn_points(rng) * rng.uniform(0.5, 1.5)
    names = ['x', 'y', 'z', *(['nx', 'ny', 'nz'] if rng.uniform() < 0.5 else []),
             *(f'f_dc_{k}' for k in range(3)),
             *(f'f_rest_{k}' for k in range(rng.choice([0, 9, 45]))), 'opacity',
             *(f'scale_{k}' for k in range(rng.choice([2, 3]))), *(f'rot_{k}' for k in range(4))]
    rows = rng.normal(0.0, 1.0, (len(points), len(names))).astype('<f4')
    rows[:, :3] = points
    head = '\n'.join(['ply', 'format binary_little_endian 1.0', f'element vertex {len(rows)}',
                      *(f'property float {name}' for name in names), 'end_header', ''])
    (folder / 'room.ply').write_bytes(head.encode() + rows.tobytes())
    return file_verdict(folder / 'room.ply', points, 'splats', 'splats.*--scale')


def judged(name: str, seed: int) -> dict:
    """Return the verdict on a member of a kind, as plain data."""
    rng = np.random.default_rng([seed, *name.encode()])
    began = time.process_time()
    with TemporaryDirectory() as folder:
        try:
            outcome, found = KINDS[name](rng, Path(folder))
        except (SceneError, UserError) as error:
            outcome, found = REFUSED, str(error)
    return {'seed': seed, 'verdict': outcome, 'found': found,
            'seconds': round(time.process_time() - began, 1)}


def main(argv: list[str] | None = None) -> None:
    """Run."""
    parser = argparse.ArgumentParser(prog='rooms_read', description=__doc__)
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=[*KINDS])
    parser.add_argument('--members', type=int, default=6, help='members of each kind')
    parser.add_argument('--first', type=int, default=0, help='seed of the first member')
    parser.add_argument('--as', dest='state', choices=('before', 'after'), default='after')
    results.add_record(parser, 'rooms_read')
    arguments = parser.parse_args(argv)
    logging.disable(logging.WARNING)
    path = results.FOLDER / 'rooms_read.json'
    kinds = json.loads(path.read_text())['kinds'] if path.exists() else {}
    for name in arguments.kinds:
        rows = []
        for seed in range(arguments.first, arguments.first + arguments.members):
            rows.append(judged(name, seed))
            print(f'{name} {seed}: {rows[-1]["verdict"]} {rows[-1]["found"][:150]} '
                  f'({rows[-1]["seconds"]} s)', flush=True)
        counts = Counter(row['verdict'] for row in rows)
        kinds.setdefault(name, {})[arguments.state] = {
            **{outcome: counts[outcome] for outcome in (RIGHT, REFUSED, WRONG)},
            'first': arguments.first,
            'not right': [row for row in rows if row['verdict'] != RIGHT]}
    if arguments.record:
        results.write('rooms_read', {'kinds': kinds}, results.command_of('rooms_read', argv))


if __name__ == '__main__':
    main()
