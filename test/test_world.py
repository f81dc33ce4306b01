# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the agent knows of a room: the engine on what was seen, and the world-model inputs."""

from conftest import around_z, box_room, flat_clouds, l_shaped, made_room
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from ocp_ros.agent import partial_map
from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.encoder import Encoder
from ocp_ros.agent.move_effects import (
    DIRECTIONS,
    FLOOR,
    LONGEST,
    nothing_known,
    OF_CAMERAS,
    OF_DIRECTIONS,
    OF_PLACES,
    POINTS,
    ROWS,
    TRIED,
    WAYS,
    WIDTH,
    WorldInputs,
)
from ocp_ros.agent.partial_map import KeptModel, LookHistory, PartialMap, smallest_rectangle
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.geometry.visibility import FAST, FINE
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.scenes.scene import turned

MAX_RANGE, MARGIN = 4.0, 0.1
#: Where the numbers of a direction are: those of its places, then its own.
OTHERS, EDGE, MOVED = slice(-4, -2), -2, -1


@pytest.fixture(scope='module')
def room():
    """Return a generated room that is small and densely scanned."""
    return made_room(8, 5000)


def inputs():
    """Return the encoder of a new episode."""
    return WorldInputs(MAX_RANGE, MARGIN)


def placed(room, cameras=3):
    """Return places near the middle of a room: (K, 3) metres."""
    middle = np.append(room.bounds.mean(axis=0)[:2], 1.9)
    offsets = [[0, 0], [1.0, 0.3], [-0.8, 0.5], [0.3, -0.9], [-0.5, -0.6], [1.2, 1.1]]
    return middle + np.pad(np.array(offsets[:cameras], dtype=float), ((0, 0), (0, 1)))


def two_turns(cloud, positions, degrees=0.0):
    """Encode the second of two turns, everything turned about the vertical axis."""
    whole = np.eye(3)
    whole[:2, :2] = around_z(degrees)
    world, step = inputs(), np.array([[0.1, 0.2, 0.0], [-0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    cloud = (cloud @ whole.T).astype(np.float32)
    world(cloud, positions @ whole.T, 0, 30)
    return world(cloud, (positions + step) @ whole.T, 1, 30)


@pytest.mark.parametrize('cameras', range(1, 7))
def test_each_camera_has_its_numbers(room, cameras):
    told = inputs()(room.points, placed(room, cameras), 0, 30)
    assert told['directions'].shape == (cameras, DIRECTIONS, WIDTH)
    assert told['own'].shape == (cameras, OF_CAMERAS)
    for value in told.values():
        assert value.dtype == np.float32 and np.isfinite(value).all() and value.any()
    alone = cameras == 1
    assert (told['directions'][..., OTHERS] == 0.0).all() == alone
    assert np.allclose(told['own'][:, -1], cameras / 4.0)


@pytest.mark.parametrize('shift', range(1, DIRECTIONS))
def test_what_the_cameras_do_turns_with_the_room(room, shift):
    straight = two_turns(room.points, placed(room))['directions']
    found = two_turns(room.points, placed(room), 360.0 * shift / DIRECTIONS)['directions']
    expected = np.roll(straight, shift, axis=1)
    assert (straight[..., [-4, -3, -1]].std(axis=1) > 0.0).any(axis=0).all()
    for part in (OTHERS, MOVED):
        np.testing.assert_allclose(found[..., part], expected[..., part], atol=1e-5)


@pytest.mark.parametrize('quarters', [1, 2, 3])
def test_what_moves_would_change_turns_with_the_room(room, quarters):
    straight = two_turns(room.points, placed(room))
    found = two_turns(room.points, placed(room), 90.0 * quarters)
    expected = np.roll(straight['directions'], 2 * quarters, axis=1)
    for number in range(OF_PLACES):
        one, other = (values[..., number:-OF_DIRECTIONS:OF_PLACES].ravel()
                      for values in (found['directions'], expected))
        assert np.corrcoef(one, other)[0, 1] > 0.9
    np.testing.assert_allclose(found['directions'][..., EDGE], expected[..., EDGE], atol=0.1)
    np.testing.assert_allclose(found['own'], straight['own'], atol=0.05)
    # Told by another direction they would not be the same.
    wrong = straight['directions'][..., 0:-OF_DIRECTIONS:OF_PLACES]
    right = found['directions'][..., 0:-OF_DIRECTIONS:OF_PLACES]
    assert np.corrcoef(wrong.ravel(), right.ravel())[0, 1] < 0.8


def test_nothing_but_what_was_seen_enters(room):
    cloud, positions = room.points[::2].copy(), placed(room)
    one, other = inputs()(cloud, positions, 3, 30), inputs()(cloud.copy(), positions, 3, 30)
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name])
    # Other points give other numbers: they do come from the cloud.
    half = cloud[cloud[:, 0] < np.median(cloud[:, 0])]
    assert not np.allclose(one['directions'], inputs()(half, positions, 3, 30)['directions'])
    # Neither the cloud nor the positions are changed.
    np.testing.assert_array_equal(cloud, room.points[::2])
    np.testing.assert_array_equal(positions, placed(room))


@pytest.mark.parametrize('camera', range(3))
def test_a_place_is_worth_what_looking_from_there_gives(room, camera):
    positions = placed(room)
    told = inputs()(room.points, positions, 0, 30)
    model = PartialMap(room.points, positions, MAX_RANGE, POINTS, ROWS)
    memory = LookHistory()
    memory.visit(positions)
    unseen, space = memory.unseen(model), FreePlane.of(room.points, 1.9, 3, MARGIN)
    worst = model.depth_error.worst
    others = [model.look(place) for index, place in enumerate(positions) if index != camera]
    error = model.error([model.look(place) for place in positions])
    near = np.bitwise_or.reduce([view.covered for view in others])
    changes = []
    for direction, number in [(0, 0), (1, 2), (3, 3), (6, 4), (7, 2)]:
        place = positions[camera, :2] + TRIED[number] * WAYS[direction]
        inside = space.inside(place)
        look = model.look(np.append(inside, 1.9))
        after = model.error([*others, look])
        fresh = int(count_bits(look.covered & unseen & ~near)) / int(count_bits(unseen))
        off = np.linalg.norm(inside - place)
        found = told['directions'][camera, direction, OF_PLACES * number:][:OF_PLACES]
        np.testing.assert_allclose(found, [
            np.log((after + FLOOR * worst) / (error + FLOOR * worst)), fresh, off < 0.15,
            min(off, 4.0) / 4.0], rtol=1e-5, atol=1e-6)
        changes.append(found[0])
    assert np.ptp(changes) > 0.01
    alone = model.look(positions[camera]).covered & ~near
    assert told['own'][camera, 4] == pytest.approx(int(count_bits(alone)) / len(model.cells))
    assert told['own'][camera, 4] > 0.0
    # Without the camera, and what the whole is worth.
    np.testing.assert_allclose(told['own'][camera, :2], [
        np.log((model.error(others) + FLOOR * worst) / (error + FLOOR * worst)),
        np.log((error + FLOOR * worst) / (worst + FLOOR * worst))], rtol=1e-5, atol=1e-6)


def test_a_model_is_kept_while_little_is_added(room):
    kept, positions, cloud = KeptModel(MAX_RANGE, MARGIN, 2000, 16), placed(room), room.points
    count = int(len(cloud) / 1.02)
    model, space = kept(cloud[:count], positions, FAST)
    assert len(model.visibility.order) <= 2000
    assert space.area == FreePlane.of(cloud[:count], 1.9, 3, MARGIN).area
    assert kept(cloud[:count + count // 200], positions, FAST)[0] is model
    assert kept(cloud[:count], positions + [0.3, -0.2, 0.0], FAST)[0] is model
    larger = kept(cloud, positions, FAST)[0]
    assert larger is not model
    # It is made anew for fewer points, other cameras and another height.
    for others, where in [(cloud[:-1], positions), (cloud[:-1], positions[:2]),
                          (cloud[:-1], positions[:2] - [0.0, 0.0, 0.1])]:
        fresh = kept(others, where, FAST)[0]
        assert fresh is not larger
        assert kept(others, where, FAST)[0] is fresh
        larger = fresh


def test_a_model_looks_from_a_pose_once_and_forgets_what_it_saw_by_other_rules(room, monkeypatch):
    positions = room.bounds.mean(axis=0)[None]
    model = PartialMap(room.points, positions, MAX_RANGE, 2000, 16)
    views = [model.look(positions[0]) for _ in range(2)]
    assert views[0] is views[1]
    lens = CameraModel(max_range=1.0).lens
    assert (model.look(positions[0], lens).seen != views[0].seen).any()
    model.follow(FINE)
    fresh = PartialMap(room.points, positions, MAX_RANGE, 2000, 16, FINE).look(positions[0])
    np.testing.assert_array_equal(model.look(positions[0]).seen, fresh.seen)
    monkeypatch.setattr(partial_map, 'MOST_VIEWS', 2)
    for step in range(5):
        model.look(positions[0] + 0.01 * step)
    assert len(model._views) <= 2


def test_a_kept_model_follows_other_rules_and_sees_as_one_made_by_them(room):
    kept, positions = KeptModel(MAX_RANGE, MARGIN, 2000, 16), placed(room)
    model, _ = kept(room.points, positions, FAST)
    fast = model.look(positions[0])
    assert kept(room.points, positions, FINE)[0] is model
    fine = model.look(positions[0])
    made = PartialMap(room.points, positions, MAX_RANGE, 2000, 16, FINE)
    np.testing.assert_array_equal(fine.seen, made.look(positions[0]).seen)
    np.testing.assert_array_equal(fine.covered, made.look(positions[0]).covered)
    assert (fine.seen != fast.seen).any()
    kept(room.points, positions, FAST)
    np.testing.assert_array_equal(model.look(positions[0]).seen, fast.seen)


def test_a_camera_is_told_where_those_before_it_will_be(room):
    positions = placed(room)
    before, turn = (inputs().turn(room.points, positions, 0, 30) for _ in range(2))
    place = positions[1] + [0.6, 0.9, 0.0]
    turn.place(1, place)
    np.testing.assert_array_equal(turn.positions, [positions[0], place, positions[2]])
    directions, own = turn.inputs(0)
    assert not np.allclose(directions[:, OTHERS], before.inputs(0)[0][:, OTHERS])
    # What the other will see is no gain any more, and the error is that of being there.
    model, looks = turn.model, [turn.model.look(at) for at in (positions[0], place, positions[2])]
    worst = model.depth_error.worst
    error = np.log((model.error(looks) + FLOOR * worst) / (worst + FLOOR * worst))
    assert own[1] == pytest.approx(error, abs=1e-5)
    assert not np.isclose(own[1], before.inputs(0)[1][1])
    gains = directions[:, 1:-OF_DIRECTIONS:OF_PLACES]
    assert (gains <= before.inputs(0)[0][:, 1:-OF_DIRECTIONS:OF_PLACES] + 1e-6).all()
    fresh = turn.unseen & ~looks[1].covered
    target = turn.space.inside(positions[0, :2] + TRIED[3] * WAYS[2])
    covered = model.look(np.append(target, 1.9)).covered
    assert gains[2, 3] == pytest.approx(
        int(count_bits(covered & fresh)) / int(count_bits(turn.unseen)), abs=1e-6)
    assert int(count_bits(turn.unseen & looks[1].covered)) > 0


def test_every_number_tells_something(room):
    """No input is the same whatever happens."""
    told = []
    for cameras in (2, 3):
        world, positions = inputs(), placed(room, cameras)
        outside = np.append(room.bounds[1, :2] + 0.4, 1.9)
        for step in range(4):
            positions = positions + 0.7 * (outside - positions) * (step > 0)
            turn = world.turn(room.points, positions, step, 30)
            for camera in range(cameras):
                told.append(turn.inputs(camera))
                turn.place(camera, turn.positions[camera] + [-0.3, -0.2, 0.0])
    directions, own = (np.array(values) for values in zip(*told))
    assert not np.flatnonzero(directions.reshape(-1, WIDTH).std(axis=0) == 0.0).tolist()
    assert not np.flatnonzero(own.std(axis=0) == 0.0).tolist()


def test_where_cameras_have_been_is_remembered_until_the_episode_ends(room):
    world, first = inputs(), placed(room, 1)
    last = first + [[1.0, 0.8, 0.0]]
    shares = [float(world(room.points, place, turn, 30)['own'][0, 3])
              for turn, place in enumerate((first, last, first))]
    alone = float(inputs()(room.points, first, 2, 30)['own'][0, 3])
    assert shares[1] < shares[0] and shares[2] <= shares[1] < alone == shares[0]
    world.reset()
    again = world(room.points, first, 0, 30)
    assert float(again['own'][0, 3]) == alone and not again['directions'][..., MOVED].any()


def test_the_last_move_is_told_in_steps_and_by_direction(room):
    world, positions = inputs(), placed(room)
    assert not world(room.points, positions, 0, 30)['directions'][..., MOVED].any()
    moves = LONGEST * np.array([[1.0, 0.0, 0.0], [0.0, -0.4, 0.0], [0.0, 0.0, 0.0]])
    told = world(room.points, positions + moves, 1, 30)['directions'][..., MOVED]
    np.testing.assert_allclose(told, moves[:, :2] / LONGEST @ WAYS.T, atol=1e-6)
    assert told[0, 0] == 1.0 and told[1, 6] == pytest.approx(0.4)
    # Another number of cameras is another rig.
    assert not world(room.points, positions[:2], 2, 30)['directions'][..., MOVED].any()


@pytest.mark.parametrize('kind', flat_clouds())
def test_where_there_is_no_room_nothing_is_known(kind, room):
    encoder, cloud = Encoder(AgentConfig()), flat_clouds()[kind].astype(np.float32)
    positions = placed(room)
    told = encoder(cloud, positions, 2, 30)
    for name, value in nothing_known(3).items():
        np.testing.assert_array_equal(told[name], value)
    # The next turn is told as ever, and where the cameras were then counts.
    after = encoder(room.points, positions + [[0.2, 0.0, 0.0]], 3, 30)
    assert after['directions'][0, 0, MOVED] == pytest.approx(0.4)


@settings(max_examples=40, deadline=None)
@given(width=st.floats(0.5, 20.0), share=st.floats(0.1, 1.0), degrees=st.floats(0.0, 360.0),
       seed=st.integers(0, 1000))
def test_the_smallest_rectangle_is_that_of_a_turned_one(width, share, degrees, seed):
    size = np.array([width, share * width])
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size
    inner = np.random.default_rng(seed).uniform(0.0, 1.0, (50, 2)) * size
    matrix, shift = around_z(degrees), np.array([3.0, -7.0])
    found = smallest_rectangle(np.concatenate([inner, corners]) @ matrix.T + shift)
    expected = corners @ matrix.T + shift
    away = np.linalg.norm(found[:, None] - expected[None], axis=2)
    assert away.min(axis=0).max() < 1e-6 * width and away.min(axis=1).max() < 1e-6 * width


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10000))
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


def looking(room_positions, degrees):
    """Return where cameras are in a room that was turned: (K, 3) metres."""
    return np.column_stack([np.array(room_positions) @ around_z(degrees).T,
                            np.full(len(room_positions), 1.9)])


def model_of(cloud, positions):
    """Return the engine on some points."""
    return PartialMap(cloud, positions, MAX_RANGE, POINTS, ROWS)


@pytest.mark.parametrize('corner', [(6.0, 4.0), (0.0, 0.0), (6.0, 0.0), (0.0, 4.0)])
@pytest.mark.parametrize('degrees', [30.0, 60.0])
def test_a_corner_that_nobody_has_seen_belongs_to_the_room(degrees, corner):
    scene = turned(box_room(), degrees)
    away = np.linalg.norm(scene.points[:, :2] - around_z(degrees) @ corner, axis=1)
    cloud = scene.points[away > 1.2]
    seen = np.stack([cloud.min(axis=0), cloud.max(axis=0)])
    assert np.abs(seen - scene.bounds).max() > 0.5
    model = model_of(cloud, looking([[2.5, 2.0], [3.5, 2.2]], degrees))
    np.testing.assert_allclose(model.bounds, scene.bounds, atol=0.15)
    # Cells are those of the whole box: as many as when all was seen.
    whole = model_of(scene.points, looking([[2.5, 2.0], [3.5, 2.2]], degrees))
    assert np.count_nonzero(model.cells >= 0) == pytest.approx(
        np.count_nonzero(whole.cells >= 0), rel=0.1)


@pytest.mark.parametrize('degrees', [0.0, 30.0, 60.0])
def test_the_corner_that_an_l_shaped_room_lacks_does_not(degrees):
    scene = turned(l_shaped(), degrees)
    model = model_of(scene.points, looking([[1.5, 3.0], [4.5, 1.0]], degrees))
    np.testing.assert_allclose(model.bounds, scene.bounds, atol=0.1)
    corners = smallest_rectangle(scene.points[:, :2])
    if degrees:
        # The rectangle alone would reach beyond.
        assert (corners.max(axis=0) - scene.bounds[1, :2]).max() > 0.5


def test_a_room_that_was_seen_whole_keeps_its_box(room):
    model = model_of(room.points, placed(room))
    np.testing.assert_allclose(model.bounds, room.bounds, atol=0.1)
    assert set(model_of(room.points, placed(room, 1)).cells) == set(model.cells)
