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

"""What a scan shows through a door or in a mirror is left out; parts of one room are not."""

from itertools import pairwise

from conftest import around_z, box_sides
import numpy as np
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene_files import scene_of, SceneWarning
import pytest

STEP = 0.06


def side(corner, along, up):
    """Return points on a rectangle, metres."""
    along, up = np.array(along, dtype=float), np.array(up, dtype=float)
    across = [np.arange(STEP / 2, np.linalg.norm(way), STEP) / np.linalg.norm(way)
              for way in (along, up)]
    first, second = (part.reshape(-1, 1) for part in np.meshgrid(*across))
    return corner + first * along + second * up


def rooms(*spans, door=(1.5, 2.4), lintel=2.05, depth=4.5):
    """Return rooms (low x, high x, height) beside each other, with doors (low y, high y)."""
    parts = []
    for low, high, top in spans:
        width = high - low
        parts += [side((low, 0, z), (width, 0, 0), (0, depth, 0)) for z in (0, top)]
        parts += [side((low, y, 0), (width, 0, 0), (0, 0, top)) for y in (0, depth)]
        parts += [side((x, 0, 0), (0, depth, 0), (0, 0, top)) for x in (low, high)]
    points = np.concatenate(parts)
    for (_, wall, _), (behind, *_) in pairwise(spans):
        points = points[~((points[:, 0] > wall - 0.03) & (points[:, 0] < behind + 0.03)
                          & (points[:, 1] > door[0]) & (points[:, 1] < door[1])
                          & (points[:, 2] < lintel) & (points[:, 2] > 0.01))]
        parts = [side((wall, door[0], lintel), (behind - wall, 0, 0), (0, door[1] - door[0], 0)),
                 side((wall, door[0], 0), (behind - wall, 0, 0), (0, door[1] - door[0], 0))]
        points = np.concatenate([points, *parts])
    return points + np.random.default_rng(0).normal(0.0, 0.004, points.shape)


def turned(points, degrees):
    """Return points turned about the vertical."""
    return np.hstack([points[:, :2] @ around_z(degrees).T, points[:, 2:]])


@pytest.mark.parametrize('wall, degrees', [(0.1, 0.0), (0.15, 30.0), (0.3, 77.0)])
def test_the_room_behind_a_door_is_left_out_and_named(wall, degrees):
    points = rooms((0.0, 6.0, 2.7), (6.0 + wall, 9.5, 2.5))
    with pytest.warns(SceneWarning, match='another room.*--all-rooms'):
        scene = scene_of(turned(points, degrees))
    found = turned(scene.points.astype(float), -degrees)
    own = points[points[:, 0] < 6.0 + 0.5 * wall]
    assert len(found) > 0.99 * len(own)
    # Of the other room the floor of the doorway, and a part of the wall between.
    assert found[:, 0].max() < 6.6 + wall
    assert np.mean(found[:, 0] > 6.05 + wall) < 0.01
    whole = scene_of(turned(points, degrees), all_rooms=True)
    assert len(whole) > 0.99 * len(points)


@pytest.mark.parametrize('degrees', [0.0, 33.0])
def test_what_a_scanner_sees_of_a_corridor_through_a_door_is_left_out(degrees):
    points, scanner = rooms((0.0, 6.0, 2.7), (6.15, 8.0, 2.7)), np.array([3.0, 2.2, 1.5])
    ways = points - scanner
    ahead = (6.0 - scanner[0]) / np.where(ways[:, 0] > 0.0, ways[:, 0], 1.0)
    crossing = scanner + ways * ahead[:, None]
    beyond = points[:, 0] > 6.08
    seen = (crossing[:, 1] > 1.5) & (crossing[:, 1] < 2.4) & (crossing[:, 2] < 2.05)
    points, own = points[~beyond | seen], len(points[~beyond])
    assert len(points) > 1.03 * own
    with pytest.warns(SceneWarning, match='another room'):
        scene = scene_of(turned(points, degrees))
    assert 0.99 * own < len(scene) < 1.01 * own


def test_a_gate_and_a_door_in_a_thick_wall_lead_to_two_rooms():
    hall = rooms((0.0, 7.0, 2.7), (7.5, 12.5, 2.7), door=(2.1, 4.1), depth=8.1)
    doorway = (abs(hall[:, 0] - 7.25) < 0.28) & (abs(hall[:, 1] - 5.15) < 0.45) & (
        abs(hall[:, 2] - 1.03) < 1.0)
    wall = np.concatenate([side((7.5, y, 0), (5.0, 0, 0), (0, 0, 2.7)) for y in (4.4, 4.5)])
    jambs = [side((7.0, 4.7, 2.05), (0.5, 0, 0), (0, 0.9, 0)),
             side((7.0, 4.7, 0), (0.5, 0, 0), (0, 0.9, 0))]
    points = np.concatenate([hall[~doorway], wall, *jambs])
    with pytest.warns(SceneWarning, match='another room'):
        scene = scene_of(points)
    assert scene.bounds[1, 0] < 7.6


@pytest.mark.parametrize('points', [
    # A wide passage, a low beam across a corridor, and a building of equal rooms.
    rooms((0.0, 6.0, 2.7), (6.2, 9.5, 2.7), door=(0.7, 3.8), lintel=2.2),
    rooms((0.0, 5.0, 2.7), (5.3, 12.0, 2.7), door=(0.0, 1.9), lintel=2.2, depth=1.9),
    rooms((0.0, 4.0, 2.7), (4.1, 8.1, 2.7), (8.2, 12.2, 2.7))])
def test_passages_beams_and_buildings_stay_whole(points):
    assert len(scene_of(points)) > 0.99 * len(points)


@pytest.mark.parametrize('seed', [3, 27, 89, 199])
def test_a_generated_room_is_one(seed):
    room = generate_room(seed, 20_000)
    assert len(scene_of(room.points)) > 0.99 * len(room)


#: Where a scanner stands before a mirror.
SCANNER = np.array([2.0, 1.8, 1.5])


def in_mirror(places):
    """Return which places at the wall x = 0 are those of the mirror."""
    return (np.abs(places[:, 1] - 1.8) < 0.8) & (np.abs(places[:, 2] - 1.3) < 0.9)


def with_mirror(seed, hung):
    """Return a scan of a room with a mirror so far before a wall, and how many points are real."""
    room = generate_room(seed, 15_000).points.astype(np.float64)
    ghosts = room * [-1.0, 1.0, 1.0] + [2.0 * hung, 0.0, 0.0]
    ways = ghosts - SCANNER
    crossing = SCANNER + ways * ((hung - SCANNER[0]) / ways[:, 0])[:, None]
    ghosts = ghosts[in_mirror(crossing) & (ghosts[:, 0] < -0.05)]
    room = room[~(in_mirror(room) & (room[:, 0] < 0.1))]
    points = np.concatenate([room, ghosts])
    return points + np.random.default_rng(seed).normal(0.0, 0.005, points.shape), len(room)


@pytest.mark.parametrize('seed, hung, degrees', [(1, 0.0, 0.0), (8, 0.04, 35.0), (12, 0.02, 80.0)])
def test_what_a_mirror_shows_is_left_out_and_named(seed, hung, degrees):
    points, real = with_mirror(seed, hung)
    assert len(points) - real > 300
    with pytest.warns(SceneWarning, match='mirror the room'):
        scene = scene_of(turned(points, degrees))
    assert abs(len(scene) - real) < 0.02 * real


def test_a_second_room_is_kept_even_where_it_is_the_same_the_other_way_round():
    room = generate_room(8, 12_000).points.astype(np.float64)
    other = room * [-1.0, 1.0, 1.0] - [0.15, 0.0, 0.0]
    assert len(scene_of(np.concatenate([room, other]), all_rooms=True)) > 23_500
    # Halls of two parts, and a floor that a door shows.
    hall = [box_sides(np.array(size), np.array(middle), 0.2) for size, middle in (
        ([20.0, 12.0, 2.8], [10.0, 6.0, 1.4]), ([10.0, 10.0, 2.8], [25.0, 5.0, 1.4]))]
    between = [(abs(part[:, 0] - 20.0) < 0.05) & (part[:, 1] < 10.0) for part in hall]
    floor = np.random.default_rng(0).uniform((-2.5, 1.5, 0.0), (0.0, 2.4, 0.01), (600, 3))
    for points in (np.concatenate([part[~wall] for part, wall in zip(hall, between)]),
                   np.concatenate([box_sides(np.array([6.0, 5.0, 2.6]),
                                             np.array([3.0, 2.5, 1.3]), 0.08), floor])):
        # The floor behind the door is another room's; the hall is one without being asked.
        whole = scene_of(points, all_rooms=points[:, 0].min() < -1.0)
        assert len(whole) > 0.99 * len(np.unique(points.astype('f4'), axis=0))
    for seed in (2, 5, 1026):
        alone = generate_room(seed, 8000)
        assert len(scene_of(alone.points)) > 0.999 * len(alone)
