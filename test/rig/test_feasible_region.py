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

"""What a rig asks of its cameras: where they may hang, and what they have to share of the room."""

from dataclasses import replace
from itertools import combinations

from conftest import box_room, box_sides, for_any, l_shaped, made_room, MOUNTS, panel
from hypothesis import strategies as st
import numpy as np
from ocp_ros.api import plan, score
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import no_bits, pack
from ocp_ros.report.findings import evaluate_placement
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.rig_file import Calibratable, rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rig.structure import floor_height, floors_of
from ocp_ros.rooms.generator import plan_of
from ocp_ros.scenes.scene import Scene, turned
from ocp_ros.search.budget import Budget
from ocp_ros.search.rig_plan import RigPlanner
from ocp_ros.simulation.covisibility import covisibility, watched_share
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import View
from ocp_ros.util.settings import ConfigurationError
import pytest
from scipy.spatial import cKDTree

ALL_MOUNTS = {**MOUNTS, 'rail': {**MOUNTS['plane'], 'footprint': 0},
              'wall at a height': {'on': 'walls', 'height': 2.0},
              'free': {'on': 'free', 'height': [1, 2.2]}}
D455 = SENSORS['realsense_d455'].model
#: An empty box, an L, a scanned and a turned room; their floors at several heights.
ROOMS = 'box', 'L', 'office', 'turned', 'low'


@pytest.fixture(scope='module')
def rooms():
    """Return the scenes of ROOMS."""
    office = made_room(3, 8000)
    return dict(zip(ROOMS, (box_room(), l_shaped(), office, turned(office, 33.0),
                            Scene(office.points - np.array([3.0, 40.0, 5.0]), 'low'))))


def allowed_of(scene, mount='free', sensor='d455', cameras=1, **more):
    """Return the constraints of a rig."""
    return FeasibleRegion(scene, rig_of(cameras, sensor, mount=ALL_MOUNTS[mount], **more))


def level(*position, yaw=0.0, pitch=0.0):
    """Return one pose (1, 6), angles in degrees."""
    return np.array([[*position, *np.deg2rad([yaw, pitch, 0.0])]])


@pytest.mark.parametrize('mount', ALL_MOUNTS)
@pytest.mark.parametrize(('room', 'sensor'), [
    ('L', 'd455'), ('turned', 'omnidirectional'), ('low', 'vlp16')])
def test_every_candidate_is_allowed_and_breaks_nothing(rooms, room, mount, sensor):
    allowed = allowed_of(rooms[room], mount, sensor, pitch=[5, 50])
    model = allowed.rig.models[0]
    poses = allowed.candidates(model, 300)
    assert 20 < len(poses) <= 300 and poses.shape[1] == 6
    assert allowed.allowed(poses, model).all()
    assert [allowed.broken(pose[None]) for pose in poses[::7]] == [[]] * len(poses[::7])
    places = np.unique(poses[:, :3], axis=0)
    assert len(places) == len(poses) if sensor != 'd455' else 2 * len(places) < len(poses)
    above = places[:, 2] - (-5.0 if room == 'low' else 0.0)
    low, high = np.broadcast_to(ALL_MOUNTS[mount].get('height', [2.0, 3.0]), 2)
    assert (above > low - 0.02).all() and (above < high + 0.02).all()


@for_any(20, spacing=st.floats(0.0, 2.0), keep_clear=st.floats(0.0, 0.5),
         low=st.floats(-20.0, 60.0), most=st.integers(1, 200),
         mount=st.sampled_from(sorted(ALL_MOUNTS)), room=st.sampled_from(ROOMS))
def test_candidates_obey_whatever_is_asked(rooms, spacing, keep_clear, low, most, mount, room):
    middle = rooms[room].bounds.mean(axis=0)
    allowed = allowed_of(rooms[room], mount, spacing=spacing, keep_clear=keep_clear,
                         pitch=[low, low + 10.0], keep_out=[{'box': [
                             (middle - [1.0, 0.5, 9.0]).tolist(), (middle + 9.0).tolist()]}])
    poses = allowed.candidates(D455, most)
    assert 1 <= len(poses) <= most and allowed.allowed(poses, D455).all()
    assert allowed.broken(poses[:1]) == [] and allowed.broken(poses[-1:]) == []


def test_the_floor_is_a_layer_and_not_the_lowest_point(rooms):
    assert floor_height(rooms['box']) == 0.0
    stray = np.random.default_rng(0).uniform([0, 0, -0.9], [6, 4, 0.7], (400, 3))
    for name, floor in (('office', 0.0), ('low', -5.0)):
        points = rooms[name].points
        noisy = Scene(np.concatenate([points, stray + points.min(axis=0)]).astype('f4'), 'noisy')
        assert noisy.bounds[0, 2] < floor - 0.8
        assert floor_height(noisy) == pytest.approx(floor, abs=0.03)
        assert FeasibleRegion(noisy, rig_of(1)).candidates(D455, 5)[0, 2] == pytest.approx(
            floor + 1.9, abs=0.03)


def with_step(z, low=(3.0, 0.0), high=(6.0, 4.0), turn=0.0):
    """Return a room whose floor has another height between two corners, turned, degrees."""
    points = box_room().points.copy()
    inside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    points[inside & (points[:, 2] == 0.0), 2] = z
    points = [points[(points[:, 2] >= z) | ~inside],
              panel(low[0], (low[1], high[1]), sorted((0.0, z)))]
    return turned(Scene(np.concatenate(points), 'step'), turn)


@pytest.mark.parametrize(('room', 'levels'), [
    (with_step(0.9, turn=20.0), [0.0, 0.9]), (with_step(0.5, (3.5, 1.0)), [0.0, 0.5]),
    (with_step(-0.6, (1.5, 1.0), (5.0, 3.0)), [-0.6, 0.0]),
    # A long table, a bed and a level room.
    (with_step(0.7, (1.0, 1.0), (5.0, 2.4)), [0.0]),
    (with_step(0.5, (4.0, 0.0), (6.0, 1.9)), [0.0]), (turned(box_room(), 30.0), [0.0])])
def test_a_room_has_a_floor_at_each_height_and_furniture_is_none(room, levels):
    assert [level.z for level in floors_of(room).levels] == pytest.approx(levels, abs=0.02)


@pytest.mark.parametrize('mount', ['plane', 'walls', 'free', 'on rods'])
def test_heights_are_measured_from_the_floor_below_the_camera(mount):
    mounts = {**ALL_MOUNTS, 'on rods': {'on': 'ceiling', 'height': 1.6}}
    given = {**mounts[mount], 'height': 1.6 if mount in ('plane', 'on rods') else [1.4, 1.6]}
    region = FeasibleRegion(with_step(0.9), rig_of(1, 'd455', mount=given))
    places = np.unique(region.candidates(D455, 2000)[:, :3], axis=0)
    for side, z in ((places[places[:, 0] < 2.8], 1.6), (places[places[:, 0] > 3.2], 2.5)):
        assert len(side) > 5 and side[:, 2].max() == pytest.approx(z, abs=0.02)
        assert side[:, 2].min() > z - 0.22
        moved = region.onto_mount(side[:3] + [0.0, 0.0, 0.3])
        assert region.broken(np.column_stack([moved[:1], np.zeros((1, 3))])) == []


@pytest.mark.parametrize(('top', 'hidden'), [(2.2, True), (1.8, False)])
def test_cameras_stay_clear_of_the_part_of_a_wall_that_the_scan_does_not_show(top, hidden):
    points = [box_room().points, panel(3.0, (0.0, 4.0), (0.0, top))]
    allowed = allowed_of(Scene(np.concatenate(points), 'partition'), 'ceiling')
    assert bool(allowed.broken(level(2.95, 2.0, 2.7))) is hidden
    assert allowed.broken(level(2.75, 2.0, 2.7)) == []


def test_candidates_reach_all_over_the_room(rooms):
    for mount in ALL_MOUNTS:
        poses = allowed_of(rooms['L'], mount, 'omnidirectional').candidates(D455, 1000)
        places = np.unique(poses[:, :2], axis=0)
        corners = np.array([[0, 0], [6, 0], [6, 2], [3, 4], [0, 4]], dtype=float)
        assert cKDTree(places).query(corners)[0].max() < 0.8, mount
        assert not ((places > [3.05, 2.05]).all(axis=1)).any()


def test_cameras_on_walls_look_into_the_room(rooms):
    for name in ('box', 'turned'):
        poses = allowed_of(rooms[name], 'walls').candidates(D455, 400)
        ahead = poses[:, :3] + 0.5 * np.column_stack(
            [np.cos(poses[:, 3]), np.sin(poses[:, 3]), np.zeros(len(poses))])
        near = cKDTree(rooms[name].points)
        before, after = (near.query(places)[0] for places in (poses[:, :3], ahead))
        assert (before < 0.2).all() and np.mean(after > before) > 0.95


@pytest.mark.parametrize(('mount', 'pose', 'words'), [
    ('plane', level(3, 2, 1.9), []), ('plane', level(3, 2, 1.7), ['mount.height']),
    ('plane', level(0.1, 2, 1.9), ['keep_clear', 'mount.footprint']),
    ('plane', level(7, 2, 1.9), ['not above floor']),
    ('plane', level(3, 2, 1.9, pitch=80), ['(pitch)']),
    ('plane', level(3, 2, 1.9, pitch=-5), ['(pitch)']),
    ('ceiling', level(3, 2, 2.6), []), ('ceiling', level(3, 2, 2.3), ['mount.on']),
    ('ceiling', level(0.1, 2, 2.7), ['keep_clear']),
    ('rods', level(3, 2, 2.0), []), ('rods', level(3, 2, 2.2), ['mount.height']),
    ('walls', level(0.1, 2, 2.0), []), ('walls', level(3, 3.85, 2.0), []),
    ('walls', level(0.6, 2, 2.0), ['mount.on']),
    ('walls', level(-0.1, 2, 2.0), ['not above floor']),
    ('walls', level(0.1, 0.1, 2.0), ['keep_clear']),
    ('walls', level(0.1, 2, 2.5), ['mount.height']),
    ('free', level(3, 2, 0.1), ['keep_clear', 'mount.height']),
    ('free', level(3, 2, 3.5), ['not above floor', 'mount.height'])])
def test_each_broken_constraint_is_named(rooms, mount, pose, words):
    allowed = allowed_of(rooms['box'], mount, pitch=[0, 60])
    found = allowed.broken(pose)
    assert len(found) == len(words), found
    for sentence, part in zip(found, words):
        assert sentence.startswith('realsense_d455: ') and part in sentence, sentence
    assert allowed.allowed(pose, D455)[0] == (not words)


def test_the_surface_a_camera_hangs_on_may_be_near_and_no_other(rooms):
    walls, free = (allowed_of(rooms['box'], mount, keep_clear=0.5) for mount in ('walls', 'free'))
    assert walls.broken(level(3, 3.9, 2.0)) == []
    assert 'keep_clear' in free.broken(level(3, 3.9, 2.0))[0]
    # The neighbouring wall, 0.3 m away, is another surface.
    corner, = walls.broken(level(0.3, 3.9, 2.0))
    assert '0.30 m' in corner and 'keep_clear' in corner


def test_next_to_a_wall_a_camera_is_not_faulted_but_a_search_stays_away(rooms):
    allowed = allowed_of(rooms['box'], 'free', keep_clear=0.05)
    beside, far, behind = level(0.1, 2, 2.0), level(0.45, 2, 2.0), level(-0.1, 2, 2.0)
    assert allowed.broken(beside) == allowed.broken(far) == []
    assert 'not above floor' in allowed.broken(behind)[0]
    assert allowed.allowed(np.concatenate([beside, far, behind])).tolist() == [False, True, False]


def test_a_sloping_ceiling_is_one_surface():
    points = box_room().points.copy()
    slope = 2.2 + 0.2 * points[:, 0]
    points[:, 2] = np.where(points[:, 2] > 2.75, slope, points[:, 2])
    room = Scene(points[points[:, 2] <= slope + 1e-5], 'slope')
    poses = allowed_of(room, 'ceiling', keep_clear=0.4).candidates(D455, 200)
    np.testing.assert_allclose(poses[:, 2], 2.1 + 0.2 * poses[:, 0], atol=0.06)


def test_a_place_inside_a_cabinet_is_not_in_the_air():
    size, points = np.array([1.2, 0.8, 2.1]), box_room().points
    # One in a corner and one in the middle.
    lows = np.array([[0.0, 0.0, 0.0], [3.0, 1.6, 0.0]])
    for low in lows:
        # A scan does not show what is behind, nor the sides against the walls and the floor.
        cabinet = box_sides(size, low + 0.5 * size)
        hidden = ((points > low - 0.01) & (points < low + size - 0.01)).all(axis=1)
        points = np.concatenate([points[~hidden], cabinet[(cabinet > 0.01).all(axis=1)]])
    allowed = allowed_of(Scene(points.astype(np.float32), 'furnished'))
    assert 'not above floor' in allowed.broken(level(0.6, 0.4, 1.2))[0]
    assert 'furniture' in allowed.broken(level(3.6, 2.0, 1.2))[0]
    above, = allowed.broken(level(3.6, 2.0, 2.45))
    assert 'mount.height' in above and allowed.broken(level(2.0, 1.5, 1.2)) == []
    places = allowed.candidates(D455, 4000)[:, :3]
    for low in lows:
        assert not ((places > low) & (places < low + size)).all(axis=1).any()


def test_hardly_any_place_inside_the_solids_of_scanned_rooms_is_allowed():
    judged = []
    for seed in (3, 5, 12):
        room = made_room(seed, 15000)
        allowed, low, high = allowed_of(room), *room.bounds
        places = np.random.default_rng(0).uniform(
            low + [0.0, 0.0, 1.0], [*high[:2], low[2] + 2.2], (2000, 3))
        depth = np.max([(0.5 * solid.size - np.abs((places - solid.centre) @ rotation_matrix(
            solid.yaw))).min(axis=1) for solid in plan_of(seed).solids], axis=0)
        good = allowed.allowed(np.hstack([places, np.zeros_like(places)]), D455)
        judged.append(np.column_stack([depth, good, allowed.space.contains(places[:, :2])]))
    depth, good, over_floor = np.concatenate(judged).T
    assert good[depth > 0.02].mean() < 0.01
    assert good[(depth < -0.5) & (over_floor > 0)].mean() > 0.97


def test_zones_keep_cameras_out(rooms):
    allowed = allowed_of(rooms['low'], 'plane', keep_out=[
        {'box': [[-10, -50, -5], [-1.5, -34, 0]]},
        {'polygon': [[-10, -50], [10, -50], [10, -37]], 'height': [1.0, 2.5]}])
    places = allowed.candidates(D455, 500)[:, :3]
    assert (places[:, 0] > -1.5).all() and len(places) > 50
    inside = allowed.broken(level(-2.0, -36.0, allowed.floor + 1.9))
    assert 'keep-out zone 1' in ' '.join(inside)


# Tripods do not stand this near to a wall.
@pytest.mark.parametrize('mount', sorted(ALL_MOUNTS.keys() - {'plane'}))
def test_mounting_zones_hold_cameras(rooms, mount):
    rail = {'box': [[0.5, 0.09, 1.85], [5.5, 0.25, 2.75]]}
    allowed = allowed_of(rooms['box'], mount, keep_in=[rail], keep_clear=0.0)
    places = np.unique(allowed.candidates(D455, 3000)[:, :3], axis=0)
    assert len(places) > 10 and (np.clip(places, *rail['box']) == places).all()
    drawn = np.random.default_rng(0).uniform(0.0, (6.0, 4.0, 2.8), (50, 3))
    # Positions are moved to the nearest place in the zone, where there is floor.
    there = allowed.allowed(np.hstack([allowed.onto_mount(drawn), np.zeros_like(drawn)]))
    assert there.mean() > 0.9
    assert 'keep_in' in ' '.join(allowed.broken(level(3.0, 2.0, 2.0)))


def test_cameras_keep_apart_from_each_other_and_from_those_in_place(rooms):
    allowed = allowed_of(rooms['box'], 'plane', cameras=2, spacing=0.6, fixed=[
        {'sensor': 'kinect_v2', 'position': [3.0, 2.0, 1.9], 'name': 'door'}])
    poses = np.concatenate([level(3.5, 2.0, 1.9), level(3.5, 2.5, 1.9)])
    found = allowed.broken(poses)
    assert len(found) == 2 and all('0.50 m' in line and 'spacing' in line for line in found)
    assert 'realsense_d455_1: ' in found[0] and 'to door' in found[0]
    assert 'realsense_d455_2: ' in found[1] and 'to realsense_d455_1' in found[1]
    assert allowed.allowed(poses, D455).tolist() == [False, True]
    offsets = allowed.candidates(D455, 500)[:, :3] - [3.0, 2.0, 1.9]
    assert np.linalg.norm(offsets, axis=1).min() >= 0.6


@pytest.mark.parametrize('mount', ['walls', 'ceiling', 'plane'])
def test_a_camera_in_place_that_is_not_in_the_room_is_named(rooms, mount):
    points, box = rooms['box'].points, box_sides([1.2, 1.2, 1.0], [3.4, 1.9, 0.5])
    places = {'corner': [0.05, 0.05, 2.7], 'middle': [2.0, 2.0, 1.0], 'wall': [4.0, 3.96, 2.0],
              'outside': [-0.5, 2.0, 2.0], 'roof': [2.0, 2.0, 3.3], 'cellar': [2.0, 2.0, -0.4],
              'box': [3.4, 1.9, 0.5]}
    allowed = allowed_of(Scene(np.vstack([points, box]), 'box'), mount, fixed=[
        {'sensor': 'kinect_v2', 'position': place, 'name': name}
        for name, place in places.items()])
    named = [note.partition(':')[0] for note in allowed.fixed_notes()]
    assert named == ['outside', 'roof', 'cellar', 'box']


def test_an_omnidirectional_camera_may_have_any_orientation(rooms):
    allowed = allowed_of(rooms['box'], 'plane', 'omnidirectional', pitch=[20, 30])
    assert allowed.broken(level(3, 2, 1.9, pitch=80)) == []
    assert allowed.broken(level(3, 2, 1.9)[:, :3]) == []
    assert not allowed.allowed(level(3, 2, 1.9, pitch=80))[0]


@pytest.mark.parametrize(('highest', 'mount', 'more', 'words'), [
    (2.8, {'on': 'plane', 'height': 3.0}, {}, 'mount.height'),
    (2.8, {'on': 'plane'}, {'keep_clear': 5.0}, 'mount: .*box'),
    (2.8, {'on': 'plane'}, {'fixed': [{'sensor': 'kinect_v2', 'position': [30, 2, 2]}]},
     r'fixed\[0\]: .*30.00'),
    (1.0, {'on': 'ceiling'}, {}, 'ceiling'), (0.05, {'on': 'walls'}, {}, 'walls')])
def test_a_rig_that_does_not_go_with_the_room_is_refused(rooms, highest, mount, more, words):
    points = rooms['box'].points
    # One stray point makes each room equally high.
    kept = np.concatenate([points[points[:, 2] <= highest], [[3.0, 2.0, 2.8]]])
    with pytest.raises(ConfigurationError, match=words):
        FeasibleRegion(Scene(kept, 'box'), rig_of(1, 'd455', mount=mount, **more)).candidates(
            D455, 10)


@pytest.mark.parametrize('poses', [np.zeros((2, 4)), np.zeros(6), np.full((1, 6), np.nan)])
def test_poses_of_another_shape_are_refused(rooms, poses):
    with pytest.raises(ValueError, match='poses: found shape'):
        allowed_of(rooms['box'], 'plane').broken(poses)


def test_the_rolls_of_a_mount_are_candidates_and_no_others_are_allowed(rooms):
    for rolls in ([0, 90], [90]):
        allowed = allowed_of(rooms['box'], 'walls', roll=rolls)
        poses = allowed.candidates(D455, 600)
        assert allowed.allowed(poses).all()
        assert set(np.rad2deg(poses[:, 5]).round(6)) == set(rolls)
    tilted = poses[:1].copy()
    tilted[0, 5] = np.deg2rad(45.0)
    assert not allowed.allowed(tilted).any() and '(roll)' in allowed.broken(tilted)[0]
    # Brackets are turned by hand, and a rig file without a roll demands none.
    tilted[0, 5] = np.deg2rad(83.0)
    assert allowed.allowed(tilted).all()
    assert allowed_of(rooms['box'], 'walls').allowed(tilted).all()


def test_each_camera_of_a_mixed_rig_has_its_own_pitch(rooms):
    rig = rig_of(1, 'd455', mount=ALL_MOUNTS['plane'], pitch=[0, 30])
    allowed = FeasibleRegion(rooms['box'], replace(
        rig, cameras=(rig.cameras[0], rig_of(1).cameras[0])))
    poses = np.concatenate([level(2, 2, 1.9, pitch=20), level(4, 2, 1.9, pitch=70)])
    assert allowed.broken(poses) == []
    assert len(allowed.broken(poses[::-1])) == 1


def test_a_tripod_stands_on_the_floor_and_a_pole_may_be_over_a_table():
    table = np.stack(np.meshgrid(np.arange(2.0, 4.0, 0.05), np.arange(1.0, 3.0, 0.05), 0.74),
                     axis=-1).reshape(-1, 3)
    room = Scene(np.concatenate([box_room().points, table]).astype('f4'), 'office')
    poses = np.concatenate([level(x, 2.0, 1.6) for x in (3.0, 1.8, 1.2)])
    # The default is a tripod: 0.4 m.
    for mount, good in (({'footprint': 0.0}, [True, True, True]), ({}, [False, False, True])):
        rig = rig_of(3, 'd455', mount={'on': 'plane', 'height': 1.6, **mount})
        region = FeasibleRegion(room, rig)
        assert region.allowed(poses).tolist() == good
        assert ['mount.footprint' in said for said in region.broken(poses)] == [
            True] * good.count(False)
        assert region.allowed(region.candidates(rig.models[0], 100), rig.models[0]).all()
    # Too high for a tripod.
    assert rig_of(1, 'd455', mount={'on': 'plane', 'height': 2.2}).mount.footprint == 0.0
    with pytest.raises(ConfigurationError, match='mount.footprint'):
        rig_of(1, 'd455', mount={'on': 'walls', 'footprint': 0.3})


#: Points along a line two metres in front of cameras that stand on another line.
POINTS = np.column_stack([np.linspace(0.0, 9.9, 100), np.full(100, 2.0), np.zeros(100)])
FAST = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16))


def view(x: float, first: int, last: int) -> View:
    """Return what a camera at x sees: the points from one to before another."""
    seen = np.zeros(100, dtype=bool)
    seen[first:last] = True
    return View(pack(seen), pack(np.zeros(1, dtype=bool)), np.array([x, 0.0, 0.0]))


def test_what_is_seen_under_a_wide_angle_is_not_shared():
    """Two cameras opposite each other see one strip between them, from two sides."""
    views = [view(0.0, 0, 100), view(9.9, 0, 100)]
    lines = POINTS[:, None] - np.array([[0.0, 0.0, 0.0], [9.9, 0.0, 0.0]])
    lines /= np.linalg.norm(lines, axis=2, keepdims=True)
    angles = np.rad2deg(np.arccos((lines[:, 0] * lines[:, 1]).sum(axis=1)))
    assert 60.0 < angles.min() < 120.0 < angles.max() < 180.0
    for most in (60.0, 120.0, 180.0):
        found = covisibility(POINTS, views, Calibratable(0.2, np.deg2rad(most)))
        assert found.shares[0, 1] == pytest.approx(np.mean(angles <= most))


def test_a_chain_connects_and_a_gap_says_how_much_is_missing():
    chain = [view(1.0, 0, 40), view(3.0, 30, 70), view(5.0, 60, 100)]
    asked = Calibratable(0.25, np.pi)
    found = covisibility(POINTS, chain, asked)
    assert found.missing == 0.0 and not found.linked(0, 2) and len(found.groups) == 1
    apart = covisibility(POINTS, [*chain[:2], view(5.0, 65, 100)], asked)
    assert apart.missing == pytest.approx(0.5 * (1.0 - 5 / 35 / 0.25))
    assert apart.groups == [[0, 1], [2]]
    # The share is that of the camera that sees fewer points.
    found = covisibility(POINTS, [view(2.0, 0, 50), view(3.0, 40, 60)], asked)
    assert found.shares[0, 1] == pytest.approx(10 / 20)
    # Two cameras in place are linked, and a single camera needs no other.
    views = [view(1.0, 0, 40), view(2.0, 20, 40), view(5.0, 60, 100)]
    assert covisibility(POINTS, views, asked).groups == [[0, 1], [2]]
    assert covisibility(POINTS, views, asked, fixed_count=2).missing == 0.0
    assert covisibility(POINTS, views[:1], asked).missing == 0.0


def test_a_plan_connects_its_cameras_and_says_so(room):
    """Three narrow cameras in a room: without the key they spread, with it they are linked."""
    free, linked = (rig_of(3, 'd455', pitch=[20, 40], **more)
                    for more in ({}, {'calibratable': {'overlap': 0.5, 'angle': 45}}))
    plans, judged = [], []
    for rig in (free, linked):
        planner = RigPlanner(room, rig, FAST.engine, Budget(evaluations=250))
        plans.append(planner.plan(rig))
        judged.append(evaluate_placement(Problem.of(room, linked, FAST), plans[-1].answer.poses))
    (spread, near), (spread_findings, findings) = plans, judged
    assert len(spread_findings['scores']['calibratable']['groups']) > 1
    assert [line.partition(':')[0] for line in spread_findings['broken']] == ['calibratable']
    assert findings['broken'] == [] and near.evaluation.connected
    assert spread.evaluation.depth_error <= near.evaluation.depth_error + 1e-3
    links = findings['scores']['calibratable']
    overlaps = [pair['overlap'] for pair in links['pairs'] if pair['linked']]
    assert len(links['groups']) == 1 and len(overlaps) >= 2 and min(overlaps) >= 0.5
    # The bound leaves the links out.
    assert near.certificate.relaxed == ('calibratable',)
    assert 0.0 < near.certificate.bound <= near.evaluation.loss


def test_the_loss_counts_what_is_missing(room):
    problem, free = (Problem.of(room, rig_of(2, 'd455', **more), FAST)
                     for more in ({'calibratable': {'overlap': 0.2}}, {}))
    poses = problem.region.candidates(problem.region.rig.models[0], 400)
    rng, missing = np.random.default_rng(0), []
    for _ in range(20):
        views = problem.objective.look(poses[rng.choice(len(poses), 2, replace=False)])
        lacking = problem.objective.covisibility(views).missing
        judged = problem.objective.evaluate_views(views)
        alone = free.objective.evaluate_views(views)
        assert judged.loss == pytest.approx(alone.loss + 10.0 * lacking)
        assert problem.objective.loss(views) == pytest.approx(judged.loss)
        assert judged.connected == (lacking == 0.0)
        missing.append(lacking)
    assert min(missing) < 1.0 and max(missing) > 0.0


@pytest.mark.parametrize(('more', 'words'), [
    ({'calibratable': {'overlap': 0}}, 'overlap'), ({'calibratable': {'overlap': 1.5}}, 'overlap'),
    ({'calibratable': {'angle': 200}}, 'angle'), ({'air': {'angle': 150}}, 'air.angle'),
    ({'air': {'seen_by': 3}}, r'regions\[0\].air.seen_by'),
    ({'air': {'around': True}}, r'regions\[0\].air.around'),
    ({'air': {'around': True, 'seen_by': 2}}, 'at least 3'),
    ({'air': {}, 'box': [[9, 9, 1], [9.01, 9.01, 1.01]]}, 'no air')])
def test_what_cannot_be_calibrated_or_watched_is_refused(more, words):
    rig = {'cameras': [{'sensor': 'kinect_v2', 'count': 2}]}
    if 'air' in more:
        more = {'regions': [{'name': 'stage', 'box': [[1, 1, 1], [2, 2, 2]], **more}]}
    with pytest.raises(ConfigurationError, match=words):
        plan(box_room(), {**rig, **more}, evaluations=10)


@for_any(20, seed=st.integers(0, 9999), cameras=st.integers(1, 5), seen_by=st.integers(1, 4),
         angle=st.floats(0.0, 100.0), gap=st.sampled_from([120.0, 200.0, 360.0]))
def test_air_counts_where_enough_cameras_look_from_enough_directions(
        seed, cameras, seen_by, angle, gap):
    rng = np.random.default_rng(seed)
    cells, positions = rng.uniform(0, 4, (100, 3)), rng.uniform(0, 4, (cameras, 3))
    seen = rng.random((cameras, 100)) < 0.7
    numbers = np.flatnonzero(rng.random(100) < 0.5)
    views = [View(no_bits(0), pack(some), position) for some, position in zip(seen, positions)]
    ways = cells[None] - positions[:, None]
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    between = np.rad2deg(np.arccos(np.clip(np.einsum('ank,bnk->abn', ways, ways), -1, 1)))
    headings = np.rad2deg(np.arctan2(ways[..., 1], ways[..., 0]))

    def is_around(n):
        """Return whether each direction is at most a gap from the next one to its left."""
        own = headings[seen[:, n], n]
        left = np.where(np.eye(len(own), dtype=bool), 360.0, (own - own[:, None]) % 360.0)
        return gap == 360.0 or (len(own) > 0 and (left.min(axis=1) <= gap).all())

    found = [any(all(between[one, other, n] >= angle for one, other in combinations(some, 2))
                 for some in combinations(np.flatnonzero(seen[:, n]), seen_by)) and is_around(n)
             for n in numbers]
    bits = [view.covered for view in views]
    assert watched_share(cells, numbers, bits, views, seen_by, *np.deg2rad([angle, gap])
                         ) == np.mean(found)
    # Cameras that are everywhere at once see from all directions.
    everywhere = [view._replace(position=None) for view in views]
    enough = (seen[:, numbers].sum(axis=0) >= seen_by).mean()
    assert watched_share(cells, numbers, bits, everywhere, seen_by, np.deg2rad(angle)) == enough


def test_a_volume_that_two_cameras_watch_from_two_sides_is_planned_for():
    region = {'name': 'stage', 'box': [[1.5, 1.0, 0.3], [4.0, 3.0, 1.8]], 'must_see': 0.9,
              'air': {'seen_by': 2, 'angle': 45}}
    rig = rig_of(3, 'd455', mount={'on': 'walls', 'height': [1.6, 2.4]}, regions=[region])
    found = plan(box_room(), rig, evaluations=250)
    # The bound leaves the air out, and all else is easy.
    assert found.broken == () and found.gap is None
    (part,) = found.found['scores']['regions']
    assert part['of'] == 'air' and part['seen'] >= 0.9
    # Side by side they do not do, and two sides are not all sides.
    around = dict(region, air={'seen_by': 3, 'around': True})
    (part,) = score(box_room(), found.poses, rig_of(3, 'd455', mount=rig.document.data['mount'],
                    regions=[around])).found['scores']['regions']
    assert part['around'] and part['seen'] < 0.9
    beside = found.poses[[0, 0, 0]]
    beside[:, 0] += 0.01 * np.arange(3)
    assert score(box_room(), beside, rig).found['scores']['regions'][0]['seen'] == 0.0


def test_a_region_of_air_of_any_size_counts_as_rays_see_it():
    scene = Scene(np.concatenate([box_room().points, panel(3.0, (1.5, 2.5), (0.0, 1.0))]), 'panel')
    pose = np.array([[2.2, 2.0, 1.2]])
    for low, high in (([3.2, 1.0, 0.1], [3.7, 3.0, 0.6]), ([3.8, 1.8, 0.2], [3.9, 1.9, 0.3])):
        rig = rig_of(1, 'omnidirectional', regions=[
            {'name': 'low', 'air': {}, 'box': [low, high]}])
        problem, plain = (Problem.of(scene, some) for some in (rig, rig_of(1, 'omnidirectional')))
        found = problem.objective.evaluate(pose)
        # A position is hidden if the way to it crosses the panel.
        places = np.random.default_rng(0).uniform(low, high, (20_000, 3))
        share = (3.0 - pose[0, 0]) / (places[:, 0] - pose[0, 0])
        cross = pose + share[:, None] * (places - pose)
        is_hidden = (abs(cross[:, 1] - 1.975) < 0.5) & (cross[:, 2] < 0.975)
        assert is_hidden.mean() > 0.2
        assert found.regions[0] == pytest.approx(1.0 - is_hidden.mean(), abs=0.05)
        # Cells of regions are none of the space coverage.
        assert found.space_coverage == plain.objective.evaluate(pose).space_coverage
