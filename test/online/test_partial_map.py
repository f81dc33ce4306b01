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

"""What is known of a room: the engine on what was seen, and what is tried in it."""

from conftest import around_z, box_room, flat_clouds, for_any, l_shaped, made_room
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.geometry.visibility import FAST, FINE
from ocp_ros.online import partial_map
from ocp_ros.online.observed_turn import ObservedTurns
from ocp_ros.online.partial_map import KeptModel, LookHistory, PartialMap, smallest_rectangle
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.scenes.scene import SceneError, turned
import pytest

MAX_RANGE, MARGIN = 4.0, 0.1
#: Points and depth-map rows of the models of these tests.
POINTS, ROWS = 12000, 64


@pytest.fixture(scope='module')
def room():
    """Return a generated room that is small and densely scanned."""
    return made_room(8, 5000)


def placed(room, cameras=3):
    """Return places near the middle of a room: (K, 3) metres."""
    middle = np.append(room.bounds.mean(axis=0)[:2], 1.9)
    return middle + np.array([[0.0, 0.0, 0.0], [1.0, 0.3, 0.0], [-0.8, 0.5, 0.0]])[:cameras]


def test_a_model_is_kept_while_little_is_added(room):
    kept, positions, cloud = KeptModel(MAX_RANGE, MARGIN, 2000, 16), placed(room), room.points
    count = int(len(cloud) / 1.02)
    model, space = kept(cloud[:count], positions, FAST)
    assert len(model.visibility.order) <= 2000
    assert space.area == FreePlane.of(cloud[:count], 1.9, 3, MARGIN).area
    assert kept(cloud[:count + count // 200], positions, FAST)[0] is model
    assert kept(cloud[:count], positions + [0.3, -0.2, 0.0], FAST)[0] is model
    # It is made anew for more and for fewer points, other cameras and another height.
    for others, where in [(cloud, positions), (cloud[:-1], positions), (cloud[:-1], positions[:2]),
                          (cloud[:-1], positions[:2] - [0.0, 0.0, 0.1])]:
        fresh = kept(others, where, FAST)[0]
        assert fresh is not model
        assert kept(others, where, FAST)[0] is fresh
        model = fresh


def test_a_kept_model_follows_other_rules_and_sees_as_one_made_by_them(room, monkeypatch):
    kept, positions = KeptModel(MAX_RANGE, MARGIN, 2000, 16), placed(room)
    model, _ = kept(room.points, positions, FAST)
    fast = model.look(positions[0])
    # It looks from a pose once.
    assert model.look(positions[0]) is fast
    lens = CameraModel(max_range=1.0).lens
    assert (model.look(positions[0], lens).seen != fast.seen).any()
    assert kept(room.points, positions, FINE)[0] is model
    fine = model.look(positions[0])
    made = PartialMap(room.points, positions, MAX_RANGE, 2000, 16, FINE)
    np.testing.assert_array_equal(fine.seen, made.look(positions[0]).seen)
    np.testing.assert_array_equal(fine.covered, made.look(positions[0]).covered)
    assert (fine.seen != fast.seen).any()
    kept(room.points, positions, FAST)
    again = model.look(positions[0])
    np.testing.assert_array_equal(again.seen, fast.seen)
    # It does not keep what it saw without end.
    monkeypatch.setattr(partial_map, 'MAX_VIEWS', 2)
    for step in range(1, 5):
        model.look(positions[0] + 0.01 * step)
    assert model.look(positions[0]) is not again


def new_turns():
    """Return turns that have observed nothing yet."""
    return ObservedTurns(MAX_RANGE, MARGIN, points=POINTS, rows=ROWS)


def observed(cloud, positions, turn=0):
    """Return what is known at a turn of somebody who has observed nothing before."""
    return new_turns()(cloud, positions, turn, 30)


def unseen_share(known):
    """Return the share of the air that no camera has covered."""
    _, is_unseen = known.air
    return is_unseen.mean()


def test_a_camera_that_has_chosen_is_where_it_will_be_for_the_others(room):
    positions = placed(room)
    known, place = observed(room.points, positions), positions[1] + [0.6, 0.9, 0.0]
    count = len(known.model.points)
    known.place(1, place)
    np.testing.assert_array_equal(known.positions, [positions[0], place, positions[2]])
    looks = [known.model.look(at) for at in (positions[0], place, positions[2])]
    own, others = known.seen_now(0)
    np.testing.assert_array_equal(own, unpack(looks[0].seen, count))
    np.testing.assert_array_equal(others, sum(
        unpack(look.seen, count).astype(int) for look in looks[1:]))


def test_where_cameras_have_been_is_remembered_until_the_episode_ends(room):
    turns, first = new_turns(), placed(room, 1)
    last = first + [[1.0, 0.8, 0.0]]
    shares = [unseen_share(turns(room.points, place, turn, 30))
              for turn, place in enumerate((first, last, first))]
    alone = unseen_share(observed(room.points, first, 2))
    assert shares[1] < shares[0] and shares[2] <= shares[1] < alone == shares[0]
    turns.reset()
    assert unseen_share(turns(room.points, first, 0, 30)) == alone


@pytest.mark.parametrize('kind', flat_clouds())
def test_what_is_no_room_is_refused_and_where_cameras_were_counts(kind, room):
    turns, positions = new_turns(), placed(room, 1)
    away = positions + [[1.0, 0.8, 0.0]]
    with pytest.raises(SceneError):
        turns(flat_clouds()[kind].astype(np.float32), positions, 0, 30)
    assert unseen_share(turns(room.points, away, 1, 30)) < unseen_share(
        observed(room.points, away, 1))


@for_any(15, seed=st.integers(0, 10000))
def test_the_smallest_rectangle_holds_all_points_and_none_is_smaller(seed):
    points = np.random.default_rng(seed).normal(size=(30, 2)) @ [[2.0, 0.3], [0.0, 1.0]]
    corners = smallest_rectangle(points)
    sides = corners[[1, 2]] - corners[0]
    lengths = np.linalg.norm(sides, axis=1)
    assert abs(sides[0] @ sides[1]) < 1e-9 * lengths.prod()
    shares = (points - corners[0]) @ sides.T / lengths ** 2
    assert shares.min() > -1e-9 and shares.max() < 1.0 + 1e-9
    for degrees in np.arange(0.0, 90.0, 0.5):
        assert np.prod(np.ptp(points @ around_z(degrees), axis=0)) > lengths.prod() - 1e-9


def model_of(cloud, places, degrees=0.0):
    """Return the engine on some points, with cameras at places in a room that was turned."""
    level = np.array(places) @ around_z(degrees).T
    positions = np.column_stack([level, np.full(len(level), 1.9)])
    return PartialMap(cloud, positions, MAX_RANGE, POINTS, ROWS)


@pytest.mark.parametrize(('degrees', 'corner'), [
    (30.0, (6.0, 4.0)), (60.0, (0.0, 0.0)), (30.0, (6.0, 0.0)), (60.0, (0.0, 4.0))])
def test_a_corner_that_nobody_has_seen_belongs_to_the_room(degrees, corner):
    scene = turned(box_room(), degrees)
    away = np.linalg.norm(scene.points[:, :2] - around_z(degrees) @ corner, axis=1)
    cloud = scene.points[away > 1.2]
    seen = np.stack([cloud.min(axis=0), cloud.max(axis=0)])
    assert np.abs(seen - scene.bounds).max() > 0.5
    model, whole = (model_of(points, [[2.5, 2.0], [3.5, 2.2]], degrees)
                    for points in (cloud, scene.points))
    np.testing.assert_allclose(model.bounds, scene.bounds, atol=0.15)
    # Cells are those of the whole box: as many as when all was seen.
    assert np.count_nonzero(model.cells >= 0) == pytest.approx(
        np.count_nonzero(whole.cells >= 0), rel=0.1)


@pytest.mark.parametrize('degrees', [30.0, 60.0])
def test_the_corner_that_an_l_shaped_room_lacks_does_not(degrees):
    scene = turned(l_shaped(), degrees)
    model = model_of(scene.points, [[1.5, 3.0], [4.5, 1.0]], degrees)
    np.testing.assert_allclose(model.bounds, scene.bounds, atol=0.1)
    # The rectangle alone would reach beyond.
    corners = smallest_rectangle(scene.points[:, :2])
    assert (corners.max(axis=0) - scene.bounds[1, :2]).max() > 0.5


def test_a_room_that_was_seen_whole_keeps_its_box(room):
    model, other = (model_of(room.points, placed(room, cameras)[:, :2]) for cameras in (3, 1))
    np.testing.assert_allclose(model.bounds, room.bounds, atol=0.1)
    assert set(other.cells) == set(model.cells)


def test_cells_keep_their_numbers_while_the_bounds_grow():
    small = np.array([[-1.2, 0.3, 0.0], [2.1, 3.0, 2.5]])
    large = small + [[-1.7, -0.4, -0.1], [3.3, 0.2, 0.6]]
    centres, numbers, edge = partial_map.cells_of_the_air(small)
    more, more_numbers, _ = partial_map.cells_of_the_air(large)
    assert edge == 0.5
    assert len(set(more_numbers)) == len(more_numbers) > len(numbers)
    place = {number: tuple(centre) for number, centre in zip(more_numbers, more)}
    assert all(place[number] == tuple(centre) for number, centre in zip(numbers, centres))
    assert (centres >= small[0]).all() and (centres <= small[1]).all()


def test_a_huge_cloud_has_no_more_cells_than_it_may():
    bounds = np.array([[0.0, 0.0, 0.0], [200.0, 150.0, 4.0]])
    centres, numbers, edge = partial_map.cells_of_the_air(bounds)
    assert edge > 0.5 and 1000 < len(numbers) <= 20_000 and len(centres) == len(numbers)


def test_what_was_covered_stays_covered_when_cells_grow():
    hall = box_room(40.0, 30.0, 4.0).points
    corner = hall[(hall[:, 0] < 20.0) & (hall[:, 1] < 20.0)]
    here, memory, fresh = np.array([[10.0, 10.0, 2.0]]), LookHistory(), LookHistory()
    small, large = (PartialMap(cloud, here, 8.0, 6000, 32) for cloud in (corner, hall))
    assert (small.edge, large.edge) == (0.5, 1.0)
    memory.visit(here)
    memory.unseen(small)
    fresh.visit(here)
    # Whoever saw the whole hall from the beginning remembers nearly the same.
    one, other = (unpack(found.unseen(large), len(large.cells)) for found in (memory, fresh))
    seen = ~other & (large.cells != partial_map.NO_CELL)
    assert seen.sum() > 300 and (one != other).sum() < 0.25 * seen.sum()


def test_thinned_clouds_stay_where_they_were():
    cloud = np.random.default_rng(0).uniform(0.0, 5.0, (9000, 3)).astype(np.float32)
    few = partial_map.thinned(cloud, 500)
    assert 250 < len(few) <= 500
    # No corner of the cube is left without points.
    for corner in np.stack(np.meshgrid([0, 5], [0, 5], [0, 5]), axis=-1).reshape(-1, 3):
        assert np.linalg.norm(few - corner, axis=1).min() < 1.5
    assert partial_map.thinned(few, 500) is few
