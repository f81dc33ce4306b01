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

"""Where cameras look: within limits, for what all of them see; and what moves shall bring."""

import re

from conftest import box_room, flat_clouds, for_any, made_room
from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import angle_between, CameraModel, heading_of, rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.online.heading_planner import HeadingPlanner
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import directions, RigState
from ocp_ros.online.step import ExpectedGain
from ocp_ros.rig.motion import turned_towards, way_between
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
import pytest
from scipy.spatial.transform import Rotation

MODEL = SENSORS['realsense_d455'].model
ALL_AROUND = CameraModel(max_range=6.0)
PITCH, MAX_TURN, MARGIN = (0.0, 1.0), 0.4, 0.1
angles = st.floats(-10.0, 10.0)
headings = st.tuples(angles, st.floats(-1.57, 1.57), st.floats(-3.0, 3.0)).map(np.array)


@given(headings)
@example(np.array([0.7, -np.pi / 2, 0.0]))
@example(np.array([0.7, np.pi / 2, 0.0]))
def test_a_heading_is_what_its_rotation_was_made_of(heading):
    rotation = rotation_matrix(*heading)
    found = heading_of(rotation)
    np.testing.assert_allclose(rotation_matrix(*found), rotation, atol=1e-6)
    np.testing.assert_allclose(found[1:], heading[1:], atol=1e-5)


@given(headings, headings)
def test_an_angle_between_rotations_is_that_of_the_rotation_between_them(one, other):
    first, second = rotation_matrix(*one), rotation_matrix(*other)
    expected = Rotation.from_matrix(first.T @ second).magnitude()
    assert angle_between(first, second) == pytest.approx(expected, abs=1e-6)


@given(headings, headings, st.floats(0.0, 4.0))
def test_no_camera_is_turned_farther_than_it_may_be(now, goal, reach):
    goal = goal * [1.0, 1.0, 0.0] + [0.0, 0.0, now[2]]
    found = turned_towards(now[None], goal[None], reach)[0]
    assert angle_between(rotation_matrix(*now), rotation_matrix(*found)) <= reach + 1e-6
    assert found[2] == now[2]
    assert min(now[1], goal[1]) - 1e-9 <= found[1] <= max(now[1], goal[1]) + 1e-9
    before, after = way_between(now, goal), way_between(found, goal)
    assert np.linalg.norm(after) == pytest.approx(
        max(np.linalg.norm(before) - reach, 0.0), abs=1e-6)


@pytest.mark.parametrize('model', [
    MODEL, ALL_AROUND, CameraModel(0.5, 5.0, np.deg2rad(200.0), np.deg2rad(60.0)),
    CameraModel(0.0, 9.0, 2.0 * np.pi, 0.5)])
def test_many_directions_at_once_see_what_each_would_see(room, model):
    position = np.append(room.bounds.mean(axis=0)[:2], 1.9)
    known = PartialMap(room.points, position[None], 4.0, 6000, 32, air_radius=2.0)
    ways = np.concatenate([directions((-0.3, 1.2), 7, 2), [[0.3, 0.2, 0.5]]])
    counts = []
    for heading, view in zip(ways, known.look_many(position, ways, model.lens), strict=True):
        alone = known.look(np.concatenate([position, heading]), model.lens)
        np.testing.assert_array_equal(view.seen, alone.seen)
        np.testing.assert_array_equal(view.covered, alone.covered)
        counts.append(int(count_bits(view.seen)))
    assert min(counts) > 0
    assert model.omnidirectional == (len(set(counts)) == 1)


def test_air_around_a_camera_counts_though_nothing_is_known_of_it():
    room = box_room()
    half = room.points[room.points[:, 0] > 3.0]
    position = np.array([[2.5, 2.0, 1.9]])
    without, around = (PartialMap(half, position, 4.0, 6000, 32, air_radius=radius)
                       for radius in (0.0, 2.0))
    assert set(without.cells) < set(around.cells)
    behind = CameraModel(0.0, 4.0, 1.5, 1.0).lens
    back = np.append(position[0], [np.pi, 0.0, 0.0])
    assert len(around.covered_cells(back[None], [behind])) > 4 + len(
        without.covered_cells(back[None], [behind]))


def played(room, aim, models, positions, headings, turns):
    """Turn cameras that stay: their simulator, and headings, the first ones included."""
    config = SimulationConfig(RigConfig(cameras=len(models)), EngineConfig('fast', 32, 0.5))
    simulator = Simulator(room, config, models)
    seen, trail = simulator.nothing(), [headings]
    for turn in range(turns):
        placement = np.hstack([positions, trail[-1]])
        seen |= simulator.evaluate(placement).seen
        rig_state = RigState(placement, models, 2, PITCH)
        trail.append(aim(simulator.scene.points[seen.mask], rig_state, positions, MAX_TURN, turn,
                         turns).copy())
    return simulator, np.array(trail)


def test_a_rig_that_faces_a_wall_looks_around_first(room):
    """Two cameras look at the same wall, and there is more to be seen behind them."""
    middle, models = np.append(room.bounds.mean(axis=0)[:2], 1.9), (MODEL, MODEL)
    positions = middle + [[0.0, 0.0, 0.0], [0.2, 0.2, 0.0]]
    simulator, trail = played(room, HeadingPlanner(models, 2, PITCH, MARGIN), models, positions,
                              np.zeros((2, 3)), 12)
    before, after = (simulator.evaluate(np.hstack([positions, trail[at]])).depth_error
                     for at in (0, -1))
    # Nearly as good as the best of all pairs of directions, with the whole room known.
    one, other = ([simulator.look(np.append(at, way), camera).seen
                   for way in directions(PITCH, 16, 3)] for camera, at in enumerate(positions))
    best = min(simulator.depth_error(first | second) for first in one for second in other)
    assert after < min(1.25 * best, 0.9 * before)
    assert np.abs(way_between(trail[:-1], trail[1:])).max() <= MAX_TURN + 1e-9
    assert (trail[..., 1] >= PITCH[0] - 1e-9).all() and (trail[..., 1] <= PITCH[1] + 1e-9).all()
    # Some camera has looked away from the wall.
    assert np.abs(trail[..., 0]).max() > np.deg2rad(45.0)


def test_who_sees_all_around_stays_as_it_is_and_the_roll_of_all_stays(room):
    middle = np.append(room.bounds.mean(axis=0)[:2], 1.9)
    begun, models = np.array([[0.3, 0.2, 0.1], [0.5, 0.1, -0.4]]), (ALL_AROUND, MODEL)
    aim = HeadingPlanner(models, 2, PITCH, MARGIN)
    _, trail = played(room, aim, models, middle + [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]], begun, 4)
    assert aim.aimed == [1]
    np.testing.assert_array_equal(trail[:, 0], np.tile(begun[0], (5, 1)))
    np.testing.assert_array_equal(trail[:, 1, 2], np.full(5, -0.4))
    assert np.abs(np.diff(trail[:, 1, :2], axis=0)).max() > 0.0


def test_a_goal_is_nearly_the_best_beside_what_a_camera_in_place_sees():
    """With no turns left to look around, against all directions of a grid."""
    room = box_room()
    at = np.array([[3.0, 2.0, 1.9], [1.0, 1.0, 1.9]])
    fixed = np.array([0.0, 0.3, 0.0])
    models = MODEL, MODEL
    model = PartialMap(room.points, at, 6.0, 12000, 64)
    known = model.look(np.append(at[1], fixed), MODEL.lens)
    grid = np.array([(yaw, pitch, 0.0) for yaw in np.arange(0.0, 2.0 * np.pi, np.pi / 12)
                     for pitch in np.linspace(*PITCH, 6)])
    errors = [model.error([known, view]) for view in model.look_many(at[0], grid, MODEL.lens)]
    found = {}
    for movable in (1, 2):
        aim = HeadingPlanner(models[:movable], 1, PITCH, MARGIN)
        placement = np.hstack([at, [np.zeros(3), fixed]])[:movable]
        rig_state = RigState(placement, models[:movable], 1, PITCH)
        (yaw, *rest), *_ = aim(room.points, rig_state, at[:movable], 3.2, 11, 12)
        found[movable] = model.error([
            known, model.look(np.array([*at[0], yaw, *rest]), MODEL.lens)])
    assert found[2] <= min(errors) + 0.1 * np.ptp(errors)
    assert found[2] < np.median(errors)
    # Who does not know of the camera in place looks elsewhere.
    assert found[2] <= found[1]


@for_any(6, turn=st.integers(0, 10), max_turn=st.floats(0.0, 1.0), now=headings)
def test_goals_are_within_reach_before_the_turns_are_used_up(turn, max_turn, now):
    now = np.array([now[0], np.clip(now[1], *PITCH), now[2]])
    aim, at = HeadingPlanner((MODEL,), 1, PITCH, MARGIN), np.array([[3.0, 2.0, 1.9]])
    rig_state = RigState(np.hstack([at, now[None]]), (MODEL,), 1, PITCH)
    found = aim(box_room().points, rig_state, at, max_turn, turn, 11)
    assert np.linalg.norm(way_between(now, found[0])) <= max_turn + 1e-9
    assert PITCH[0] - 1e-9 <= found[0, 1] <= PITCH[1] + 1e-9
    assert np.linalg.norm(way_between(now, aim._goal_headings[0])) <= (11 - turn) * max_turn + 1e-9


@pytest.mark.parametrize('cloud', ['one wall', 'one wall askew', 'one point'])
def test_where_there_is_no_room_to_judge_cameras_sweep_to_the_left(cloud):
    points, models = flat_clouds()[cloud].astype(np.float32), (MODEL, ALL_AROUND)
    at = np.array([[1.0, 1.0, 1.9]] * 2)
    now = np.array([[3.0, -0.1, 0.0], [1.0, 0.0, 0.0]])
    state = RigState(np.hstack([at, now]), models, 2, PITCH)
    found = HeadingPlanner(models, 2, PITCH, MARGIN)(points, state, at, 0.4, 0, 9)
    assert 0.3 < way_between(now[0], found[0])[0] <= 0.4 and found[0, 1] > -0.1
    np.testing.assert_array_equal(found[1], now[1])


def test_a_gain_is_there_and_back_again_and_nothing_for_cameras_that_stay():
    seen = made_room(3, 8000).points
    low, high = seen.min(axis=0)[:2] + 0.4, seen.max(axis=0)[:2] - 0.4

    def state_at(*shares):
        rows = np.zeros((len(shares), 6))
        rows[:, :2], rows[:, 2] = low + np.array(shares)[:, None] * (high - low), 1.5
        return RigState(rows, (CameraModel(0.0, 4.0),) * len(shares), len(shares))

    crowded, spread = state_at(0.01, 0.03), state_at(0.2, 0.8)
    there = ExpectedGain.of(seen, crowded, spread.placement, 4.0)
    back, stay = (ExpectedGain.of(seen, spread, goal.placement, 4.0) for goal in (crowded, spread))
    assert there.after < there.before and stay.after == stay.before
    with pytest.raises(SceneError):
        ExpectedGain.of(seen[:3], spread, spread.placement, 4.0)
    # The rectangle of what was seen is closed by where the cameras look from.
    assert (back.before, back.after) == pytest.approx((there.after, there.before), rel=0.05)


def test_a_gain_in_words_has_its_numbers_where_it_is_one():
    assert re.findall(r'\d+(?:\.\d+)?', str(ExpectedGain(2.0, 1.5))) == ['25']
    for after in (3.0, 3.5):
        assert re.findall(r'\d+(?:\.\d+)?', str(ExpectedGain(3.0, after))) == []
