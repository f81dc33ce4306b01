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

"""What a laser sees in a mirror is no room; a second room is one."""

from conftest import box_sides
import numpy as np
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene_files import scene_of, SceneWarning
import pytest

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
    angle = np.deg2rad(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points[:, :2] = points[:, :2] @ turn.T
    with pytest.warns(SceneWarning, match='mirror the room'):
        scene = scene_of(points)
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
