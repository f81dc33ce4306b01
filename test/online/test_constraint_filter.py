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

"""Commands are held to a rig file, whatever the planner and the turns are."""

from conftest import box_room, box_sides, panel
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.geometry.shadow_maps import in_reach
from ocp_ros.online.constraint_filter import ConstraintFilter, FREE_ABOVE_M
from ocp_ros.online.rig_state import RigState
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.structure import floor_height
from ocp_ros.scenes.scene import Scene
import pytest
from scipy.spatial import cKDTree

MARGIN = 0.1
FIXED = {'sensor': 'omnidirectional', 'position': [3.0, 2.0, 1.9]}
MOUNTS = ({'on': 'plane', 'height': 1.9}, {'on': 'free', 'height': [1.5, 2.2]},
          {'on': 'walls', 'height': [1.5, 2.3]}, {'on': 'ceiling'})


@st.composite
def turns(draw):
    """Draw a rig, what it has seen of a room, and some turns: targets of any kind."""
    mount = draw(st.sampled_from(MOUNTS))
    low = draw(st.tuples(st.floats(0.5, 4.0), st.floats(0.5, 2.5)))
    rig = rig_of(3, 'omnidirectional', mount=mount, keep_clear=draw(st.floats(0.0, 0.5)),
                 spacing=draw(st.floats(0.0, 1.0)), fixed=[FIXED] if draw(st.booleans()) else [],
                 keep_out=[{'box': [[*low, 0.0], [low[0] + 1.5, low[1] + 1.0, 3.0]]}])
    rng = np.random.default_rng(draw(st.integers(0, 2 ** 31)))
    points = box_sides(np.array([6.0, 4.0, 2.8]), np.array([3.0, 2.0, 1.4]), 0.15).astype('f4')
    # Some of a room: what lies on one side of a plane.
    way = rng.normal(size=2)
    seen = points[(points[:, :2] - [3.0, 2.0]) @ way > rng.uniform(-4.0, 0.5)
                  * np.linalg.norm(way)]
    positions = np.column_stack([rng.uniform(0.3, 5.7, 3), rng.uniform(0.3, 3.7, 3),
                                 np.full(3, draw(st.sampled_from([1.9, 2.7, 1.0])))])
    targets = positions + np.concatenate([rng.normal(0.0, 0.5, (4, 3, 2)), np.zeros((4, 3, 1))],
                                         axis=2)
    return rig, seen, positions, targets, draw(st.floats(0.1, 1.0))


@pytest.mark.parametrize('prepared', [False, True])
@budget(max_examples=15, deadline=None)
@given(drawn=turns(), share=st.floats(0.3, 1.0))
def test_every_command_holds_or_the_camera_stays(prepared, drawn, share):
    rig, seen, positions, moves, max_step = drawn
    guard, scene = ConstraintFilter(rig, MARGIN), Scene(seen, 'seen')
    for targets in moves:
        if prepared:
            # With what was known of what is seen now.
            guard.prepare(seen[np.random.default_rng(0).random(len(seen)) < share], positions)
        found, _ = guard(seen, positions, targets, max_step)
        check(rig, scene, positions, found, max_step)
        positions = found
    if prepared:
        return
    low, high = rig.mount.heights or (-np.inf, np.inf)
    above = drawn[2][:, 2] - floor_height(scene)
    as_asked = (above >= low).all() and (above <= high).all()
    if not np.array_equal(positions, drawn[2]) and not len(rig.fixed) and as_asked:
        # The judge of whole rooms agrees, where it can judge one of which a part is seen.
        moved = np.abs(positions - drawn[2]).max(axis=1) > 0.0
        top = float(max(drawn[2][:, 2].max(), positions[:, 2].max())) + FREE_ABOVE_M
        assert FeasibleRegion(scene, rig, top).allowed(positions[moved]).all()


def check(rig, scene, before, after, max_step):
    """Assert that cameras that moved are where they may be; each rule by other means."""
    assert np.linalg.norm(after - before, axis=1).max() <= max_step + 1e-6
    moved = np.flatnonzero(np.abs(after - before).max(axis=1) > 1e-9)
    if not len(moved):
        return
    places, (low, high) = after[moved], scene.bounds[:, :2]
    if rig.mount.on in ('plane', 'free'):
        assert cKDTree(scene.points).query(places)[0].min() >= rig.keep_clear - 0.0011
    assert (places[:, :2] >= low + MARGIN - 1e-6).all()
    assert (places[:, :2] <= high - MARGIN + 1e-6).all()
    for zone in rig.keep_out:
        assert not zone.contains(places, floor_height(scene)).any()
    if rig.mount.heights is not None:
        # What a part of a room shows as its floor moves no camera up or down.
        np.testing.assert_allclose(places[:, 2], before[moved, 2], atol=1e-9)
    for camera in moved:
        others = np.concatenate([np.delete(after, camera, axis=0), rig.fixed_poses[:, :3]])
        assert np.linalg.norm(others - after[camera], axis=1).min() >= rig.spacing - 1e-9


@pytest.mark.parametrize('mount', [MOUNTS[0], MOUNTS[2], MOUNTS[3]])
def test_what_was_prepared_is_as_good_as_what_is_known(mount, monkeypatch):
    """Nothing is worked out anew for the targets that follow; the answer is the same."""
    rig, room = rig_of(1, 'omnidirectional', mount=mount), box_room().points
    position = np.array([[0.05, 2.0, 1.9]]) if mount['on'] == 'walls' else np.array(
        [[2.0, 2.0, 1.9 if mount['on'] == 'plane' else 2.78]])
    target = position + [0.0, 0.3, 0.0]
    expected = ConstraintFilter(rig, MARGIN)(room, position, target, 0.5)
    guard = ConstraintFilter(rig, MARGIN)
    guard.prepare(room, position)
    with monkeypatch.context() as patch:
        patch.setattr(guard, '_update_region', None)
        found = guard(room, position, target, 0.5)
    np.testing.assert_array_equal(found.targets, expected.targets)
    assert found.held == expected.held
    # It is for one answer, and for one episode.
    guard.prepare(room, position)
    guard.reset()
    empty = guard(room[:3], position, target, 0.5)
    assert empty.held and 'all cameras stay' in empty.held[0]


def test_what_has_just_been_seen_is_in_the_way_or_allows_a_move():
    rig, room = rig_of(1, 'omnidirectional', mount=MOUNTS[0], keep_clear=0.3), box_room().points
    position, target = np.array([[2.0, 2.0, 1.9]]), np.array([[2.4, 2.0, 1.9]])
    guard = ConstraintFilter(rig, MARGIN)
    for known, seen, free in (
            (room, room, True), (room[room[:, 0] > 3.0], room, True),
            (room, np.concatenate([room, panel(2.6, (1.0, 3.0), (1.0, 2.4))]), False),
            # Low enough to see over, in the way of the feet of a tripod.
            (room, np.concatenate([room, panel(2.7, (1.0, 3.0), (0.0, 0.5))]), False)):
        guard.prepare(known, position)
        found, held = guard(seen, position, target, 0.5)
        assert np.array_equal(found, target) == free
        assert not held if free else seen[len(room):, 0].min() - found[0, 0] >= 0.299


@pytest.mark.parametrize(('keep_clear', 'expected'), [(0.0, 0.2), (0.6, 0.6)])
def test_a_target_too_near_to_a_wall_is_moved_to_the_nearest_place(keep_clear, expected):
    rig = rig_of(2, 'omnidirectional', keep_clear=keep_clear, spacing=0.5,
                 mount={**MOUNTS[0], 'footprint': 0})
    positions = np.array([[0.9, 2.0, 1.9], [3.0, 2.0, 1.9]])
    targets = np.array([[0.2, 2.0, 1.9], [2.9, 2.234, 1.9]])
    found, held = ConstraintFilter(rig, MARGIN)(box_room().points, positions, targets, 1.0)
    assert not held
    # The known floor ends a cell before the wall.
    assert expected - 1e-3 <= found[0, 0] <= expected + 0.1
    np.testing.assert_allclose(found[0, 1:], [2.0, 1.9], atol=0.03)
    # The other target is allowed.
    np.testing.assert_array_equal(found[1], targets[1])


def test_a_camera_with_nowhere_to_go_stays_and_says_so():
    rig = rig_of(1, 'omnidirectional', mount=MOUNTS[0],
                 keep_out=[{'box': [[0.0, 0.0, 0.0], [6.0, 4.0, 3.0]]}])
    position = np.array([[2.0, 2.0, 1.9]])
    found, held = ConstraintFilter(rig, MARGIN)(box_room().points, position, position + 0.1, 0.5)
    np.testing.assert_array_equal(found, position)
    assert len(held) == 1 and 'no feasible position within 0.5 m' in held[0]


@pytest.mark.parametrize(('sensor', 'mount', 'seen_below', 'moves'), [
    ('omnidirectional', {'on': 'ceiling'}, 9.0, True),
    ('omnidirectional', {'on': 'ceiling'}, 1.5, False),
    # It needs not to see above itself.
    ('realsense_d455', {'on': 'plane', 'height': 2.7}, 1.6, True)])
def test_cameras_stay_while_what_they_hang_on_was_not_seen(sensor, mount, seen_below, moves):
    points, position = box_room().points, np.array([[2.0, 2.0, 2.7]])
    found, held = ConstraintFilter(rig_of(1, sensor, mount=mount), MARGIN)(
        points[points[:, 2] < seen_below], position, position + [[0.3, 0.0, 0.0]], 0.5)
    assert found[0, 0] == pytest.approx(2.3 if moves else 2.0)
    assert not held if moves else 'all cameras stay' in held[0] and 'ceiling' in held[0]


def test_crowded_cameras_part():
    guard = ConstraintFilter(rig_of(4, 'omnidirectional', mount=MOUNTS[0], spacing=0.6), MARGIN)
    positions = np.array([[3.1, 2.0, 1.9], [2.9, 2.0, 1.9], [3.0, 2.1, 1.9], [3.0, 1.9, 1.9]])
    for _ in range(4):
        positions, _ = guard(box_room().points, positions, positions, 0.5)
    apart = np.linalg.norm(positions[:, None] - positions, axis=2)[np.triu_indices(4, 1)]
    assert apart.min() >= 0.6


@pytest.mark.parametrize('noise', [0.0, 0.03])
def test_a_table_that_looks_like_the_floor_lifts_no_camera(noise):
    """Heights are those of the cameras, whatever a cloud without a floor shows, and stay so."""
    rig = rig_of(3, 'realsense_d455', mount={'on': 'plane', 'height': 1.6})
    rng, room = np.random.default_rng(0), box_room().points
    table = panel(0.7, (1.5, 4.5), (1.0, 3.0))[:, [1, 2, 0]]
    cloud = np.concatenate([room[room[:, 2] > 0.6], table]).astype(np.float32)
    assert floor_height(Scene(cloud, 'seen')) == pytest.approx(0.7, abs=0.05)
    positions = np.array([[1.0, 0.6, 1.6], [3.0, 0.6, 1.6], [5.0, 0.6, 1.6]])
    positions[:, 2] += rng.normal(0.0, noise, 3)
    guard = ConstraintFilter(rig, MARGIN)
    for _ in range(3):
        found, held = guard(cloud, positions, positions + [0.2, 0.2, 0.0], 0.5)
        assert not held and np.abs(found - positions)[:, :2].max() > 0.1
        np.testing.assert_array_equal(found[:, 2], positions[:, 2])
        positions = found


def test_a_camera_that_sees_no_floor_below_goes_where_it_looks_through_free_space():
    """Rigs begin close together, level, and see the floor from three metres on."""
    rig = rig_of(1, 'realsense_d455', mount={'on': 'plane', 'height': 1.6})
    model, guard, room = rig.models[0], ConstraintFilter(rig, MARGIN), box_room().points
    placement = np.array([[1.5, 2.0, 1.6, 0.0, 0.0, 0.0]])
    cloud = room[in_reach(room, Pose.of(placement[0]), model.lens)]
    state, positions = RigState(placement, [model], 1, rig.pitch), placement[:, :3]
    ahead, _ = guard(cloud, positions, positions + [0.5, 0.1, 0.0], 0.5, state=state)
    assert ahead[0, 0] - 1.5 > 0.4
    # It does not see what is beside it, nor through a panel.
    aside, _ = guard(cloud, positions, positions + [-0.3, 0.4, 0.0], 0.5, state=state)
    assert abs(np.arctan2(*(aside - positions)[0, 1::-1])) < 0.5 * model.horizontal_fov
    unseen, held = guard(cloud, positions, positions + [-0.3, 0.4, 0.0], 0.5)
    assert held and np.array_equal(unseen, positions)
    before = np.concatenate([cloud[cloud[:, 0] < 2.2], panel(2.2, (1.0, 3.0), (0.5, 2.5))])
    near, _ = guard(before, positions, positions + [1.5, 0.0, 0.0], 1.5, state=state)
    assert near[0, 0] <= 2.2 - rig.keep_clear
