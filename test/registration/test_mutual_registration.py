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

"""ocp calibrate without a scan: cameras find each other, and one that moved is named."""

from pathlib import Path

from benchmarks.calibration_bench import cast, off
from conftest import printed, refused, ROOT
import numpy as np
from ocp_ros.geometry.cameras import (
    heading_of,
    OPTICAL_TO_BODY,
    Pose,
    rotation_matrix,
    TO_BODY,
)
from ocp_ros.registration import mutual_registration
from ocp_ros.registration.alignment import AlignmentStage, Certainty, Patches
from ocp_ros.registration.calibration import (
    calibrate_mutually,
    model_of_cloud,
    since_reference,
    without_scan,
)
from ocp_ros.registration.joint_alignment import (
    advice,
    all_constraints,
    certainties,
    Distance,
    HERE,
    joint_poses,
    relative_pose,
    RigCamera,
    with_distances,
)
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.movement import (
    Movement,
    movement_since,
    movement_within,
    way_back,
)
from ocp_ros.registration.mutual_registration import (
    LevelView,
    MutualRegistration,
    register_mutually,
)
from ocp_ros.registration.steady_cloud import Frames, steady_cloud
from ocp_ros.rig.placement_file import load_placement, placement_of
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import mesh_of, plan_of
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene_files import load_cloud, load_scene
import pytest

#: A frame of an office.
REAL = ROOT.parent / 'shared' / 'data' / 'clouds' / 'primesense_office1.pcd'
SEED, SENSOR = 532, 'realsense_d455'
MODEL = SENSORS[SENSOR].model
SIZE = plan_of(SEED).size
#: Three corners, each looking at the middle and down.
TRUE = [Pose.of(np.array([x, y, 2.2, np.arctan2(0.5 * SIZE[1] - y, 0.5 * SIZE[0] - x), 0.5, 0.0]))
        for x, y in ((0.3, 0.3), (SIZE[0] - 0.3, 0.4), (0.4, SIZE[1] - 0.3))]


def seen_from(pose, seed=0):
    """Return what a camera measures in ten frames, in its body frame."""
    rays = MeshRays(mesh_of(plan_of(SEED)))
    return steady_cloud(cast(rays, pose, SENSOR, 10, 1, np.random.default_rng(seed)))


@pytest.fixture(scope='module')
def clouds():
    """Return what three cameras see, by name."""
    return {f'cam_{k}': seen_from(pose, k) for k, pose in enumerate(TRUE)}


def assert_near(pose, true, metres, degrees):
    """Assert that a pose is near another one."""
    away, turn = pose.away_from(true)
    assert away < metres and turn < np.deg2rad(degrees)


def test_the_floor_says_how_a_camera_is_tilted_and_how_high_it_hangs(clouds):
    level = LevelView.of(LiveView(clouds['cam_0'], MODEL))
    _, pitch, roll = heading_of(level.pose.rotation)
    assert level.pose.position[2] == pytest.approx(2.2, abs=0.01)
    assert np.rad2deg([pitch, roll]) == pytest.approx(np.rad2deg([0.5, 0.0]), abs=0.3)
    above = clouds['cam_0'][clouds['cam_0'] @ TRUE[0].rotation[2] > -1.0]
    assert LevelView.of(LiveView(above[above[:, 0] > 2.5], MODEL)) is None


def test_cameras_find_each_other_and_one_of_another_room_is_refused(clouds):
    elsewhere = cast(MeshRays(mesh_of(plan_of(501))), TRUE[0], SENSOR)[0]
    views = {name: LiveView(cloud, MODEL) for name, cloud in (
        *clouds.items(), ('other', elsewhere))}
    found, reasons = register_mutually(views)
    assert 'other' in reasons or found['other'].refused
    for k in (1, 2):
        one, base = found[f'cam_{k}'], found['cam_0']
        assert not one.refused and not base.refused
        assert_near(relative_pose(one.pose, base.pose), relative_pose(TRUE[k], TRUE[0]), 0.02, 0.7)
    heights = [found[f'cam_{k}'].pose.position[2] for k in range(3)]
    assert heights == pytest.approx([2.2] * 3, abs=0.02)


def test_cameras_upside_down_are_placed_upside_down_and_named(clouds):
    upside_down = np.diag([1.0, -1.0, -1.0])
    turned = {name: cloud @ upside_down for name, cloud in clouds.items()}
    found = without_scan({**turned, 'cam_0': clouds['cam_0']}, SENSOR, '')
    poses = [Pose.of(placed.pose) for placed in found.placement.cameras]
    assert ['upside down' in row['note'] for row in found.rows] == [False, True, True]
    for k in (1, 2):
        true = Pose(TRUE[k].position, TRUE[k].rotation @ upside_down)
        assert_near(relative_pose(poses[k], poses[0]), relative_pose(true, TRUE[0]), 0.02, 0.7)
    assert [pose.position[2] for pose in poses] == pytest.approx([2.2] * 3, abs=0.02)


def test_a_ceiling_that_may_be_the_floor_is_no_certain_floor():
    # A camera upside down sees the ceiling, and shelves and the floor above that.
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(1.0, 4.0, 90),
                                                 np.linspace(-1.5, 1.5, 90)))
    for turn in (np.eye(3), np.diag([1.0, -1.0, -1.0])):
        shelf = (np.abs(x - 2.5) < 0.3) & (np.abs(y) < 0.7)
        z = np.where(shelf, -1.0, -1.9)
        ceiling = np.column_stack([x, y, np.full(len(x), 0.6)])[::2]
        cloud = np.vstack([np.column_stack([x, y, z]), ceiling]) @ turn
        level = LevelView.of(LiveView(cloud, model_of_cloud(cloud)))
        assert level.pose.position[2] == pytest.approx(1.9, abs=0.02)
        assert level.is_turned == (turn[2, 2] < 0.0) and not level.may_be_turned
        # The same with the ceiling as floor.
        other = Pose(np.array([0.0, 0.0, 0.6]), np.diag([1.0, -1.0, -1.0]) @ turn)
        assert level._replace(pose=other).may_be_turned


def test_a_camera_at_a_wrong_pose_is_named_and_does_not_move_the_others(clouds, monkeypatch):
    assembled = mutual_registration._assembled

    def turned(*arguments):
        """Put the last camera where it would be if the room were turned about its middle."""
        poses = assembled(*arguments)
        middle, half = 0.5 * SIZE * [1.0, 1.0, 0.0], np.diag([-1.0, -1.0, 1.0])
        wrong = Pose(middle + half @ (TRUE[2].position - middle), half @ TRUE[2].rotation)
        return {**poses, 'cam_2': relative_pose(wrong, TRUE[0]).within(poses['cam_0'])}

    monkeypatch.setattr(mutual_registration, '_assembled', turned)
    found, reasons = register_mutually({name: LiveView(cloud, MODEL)
                                        for name, cloud in clouds.items()})
    assert reasons.keys() == {'cam_2'} and 'in space that is free' in reasons['cam_2']
    assert_near(relative_pose(found['cam_1'].pose, found['cam_0'].pose),
                relative_pose(TRUE[1], TRUE[0]), 0.02, 0.7)


def test_two_cameras_that_contradict_each_other_are_both_refused(clouds, monkeypatch):
    views = {name: LiveView(clouds[name], MODEL) for name in ('cam_0', 'cam_1')}
    monkeypatch.setattr(mutual_registration, '_assembled', lambda *_: {
        'cam_0': HERE, 'cam_1': Pose(np.array([1.5, 0.0, 0.0]), np.eye(3))})
    found, reasons = register_mutually(views)
    assert found == {} and reasons.keys() == views.keys()
    # Nothing holds a camera that matches nothing.
    assert len(certainties([], ['alone'])[0].loose_motions) == 6


@pytest.mark.parametrize('camera, number', [(0, 0), (1, 0), (1, 1), (0, 2), (1, 3), (0, 4)])
def test_errors_of_depths_change_residuals_as_derived(camera, number):
    walls = np.random.default_rng(0).uniform(0.0, 3.0, (3, 1500, 3))
    walls[range(3), :, range(3)] = 0.0
    points, normals = walls.reshape(-1, 3), np.repeat(np.eye(3), 1500, axis=0)
    poses = [Pose.of(np.array([2.5, 2.0 - k, 1.5, 3.0 + 0.5 * k, 0.1, 0.0])) for k in range(2)]
    size, residuals = 1e-5, []
    for error in (0.0, size):
        rig = []
        for k, pose in enumerate(poses):
            body = (points - pose.position) @ pose.rotation
            share = np.column_stack([1.0 / np.linalg.norm(body, axis=1), np.ones(len(body)), body])
            rig.append(RigCamera.of(Patches(
                body * (1.0 + (k == camera) * error * share[:, number])[:, None],
                normals @ pose.rotation, np.full(len(body), 0.006))))
        found = all_constraints(rig, poses, [(0, 1), (1, 0)], 0.1, 3.0)
        residuals.append(np.concatenate([one.residuals for one in found]))
    derived = np.concatenate([one.by_depths(poses) for one in found])[:, 5 * camera + number]
    np.testing.assert_allclose(residuals[1] - residuals[0], size * derived, atol=1e-3 * size)


@pytest.mark.parametrize('metres, degrees', [(0.0, 0.0), (0.02, 0.0), (0.0, 1.0), (0.15, 6.0)])
def test_a_camera_that_moved_is_named_and_one_that_did_not_is_not(clouds, metres, degrees):
    now = off(TRUE[0], metres, degrees, np.random.default_rng(3))
    found = movement_since(LiveView(clouds['cam_0'], MODEL), LiveView(seen_from(now), MODEL))
    assert found.has_moved == (metres + degrees > 0.0) and not found.is_lost
    assert_near(found.pose_now(TRUE[0]), now, 0.01, 0.4)


def test_a_person_is_told_how_to_put_a_camera_back():
    reference = Pose.of(np.array([1.0, 2.0, 2.2, 0.5 * np.pi, 0.4, 0.0]))
    # It hangs 3 cm lower and 2 cm nearer to what it looks at; it looks 4 degrees to the right and
    # 2 degrees up.
    now = Pose.of(np.array([1.0, 2.02, 2.17, 0.5 * np.pi - np.deg2rad(4.0),
                            0.4 - np.deg2rad(2.0), 0.0]))
    movement = Movement(relative_pose(now, reference), 0.04, 4.5, 0.9)
    assert way_back(movement, reference) == (
        'turn it 4.0 degrees to the left, 2.0 degrees down; raise it by 3.0 cm; '
        'move it back by 2.0 cm')
    assert way_back(movement._replace(pose=HERE), reference) == ''
    # One that looks nearly straight down is turned about its own axes.
    steep = Pose.of(np.array([1.0, 2.0, 2.2, 0.3, np.deg2rad(85.0), 0.0]))
    turned = Pose(np.zeros(3), rotation_matrix(yaw=np.deg2rad(-2.0)))
    assert way_back(movement._replace(pose=turned), steep) == 'turn it 2.0 degrees to the left'


def test_files_alone_give_a_placement_a_room_and_references(clouds, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, cloud in clouds.items():
        Path(name).mkdir()
        for number in range(2):
            np.save(f'{name}/{number}.npy', cloud @ OPTICAL_TO_BODY)
    found = printed(capsys, 'calibrate', '--clouds', *clouds, '--sensor', 'd455')
    assert [row['refused'] for row in found['cameras']] == ['', '', '']
    assert refused(capsys, 'calibrate', '--clouds', *clouds, '--sensor', 'd455', '--cloud-frame',
                   'opengl', '--out', 'out/wrong').count('points behind the camera') == 3
    built = load_placement('out/built/placement.yaml')
    poses = [Pose.of(one.pose) for one in built.cameras]
    assert_near(relative_pose(poses[1], poses[0]), relative_pose(TRUE[1], TRUE[0]), 0.02, 0.7)
    assert load_scene('out/built/room.ply').bounds[0, 2] == pytest.approx(0.0, abs=0.1)
    assert printed(capsys, 'info', 'out/built/room.ply')['points'] > 10_000
    # A camera was turned since.
    moved = off(TRUE[1], 0.0, 3.0, np.random.default_rng(1))
    np.save('cam_1/0.npy', seen_from(moved) @ OPTICAL_TO_BODY)
    Path('cam_1/1.npy').unlink()
    rows = printed(capsys, 'calibrate', '--against', 'out/built/placement.yaml', '--clouds',
                   *clouds, '--out', 'out/now')['cameras']
    assert [row['moved'] for row in rows] == [False, True, False]
    assert 'turn it' in rows[1]['put_back'] and rows[1]['moved_degrees'] > 2.0
    now = load_placement('out/now/placement.yaml')
    assert now.cameras[0].position == built.cameras[0].position
    assert_near(relative_pose(Pose.of(now.cameras[1].pose), poses[0]),
                relative_pose(moved, TRUE[0]), 0.025, 0.7)


def test_a_camera_that_was_moved_between_its_frames_is_named(capsys, tmp_path, monkeypatch):
    rays, rng = MeshRays(mesh_of(plan_of(SEED))), np.random.default_rng(5)
    before = cast(rays, TRUE[0], SENSOR, 7, 2, rng, 3)
    after = cast(rays, off(TRUE[0], 0.03, 2.0, rng), SENSOR, 5, 2, rng, 3)
    others, movement = movement_within(Frames.of([*before, *after]))
    assert others.tolist() == [False] * 7 + [True] * 5 and not movement.is_lost
    assert movement.degrees == pytest.approx(2.0, abs=0.4)
    # People who walk about are no movement, nor is a camera covered in few frames.
    assert movement_within(Frames.of(before)) is None
    assert movement_within(Frames.of([*before, *(0.1 * frame for frame in after[:1])])) is None
    # Frames of another camera are mixed with its own.
    mixed = [frame for pair in zip(before, cast(rays, TRUE[1], SENSOR, 7, 0, rng, 4))
             for frame in pair]
    others, movement = movement_within(Frames.of(mixed))
    assert others.tolist() == [False, True] * 7 and movement.is_lost
    monkeypatch.chdir(tmp_path)
    Path('door').mkdir()
    for number, frame in enumerate([*before, *after]):
        np.save(f'door/{number:02}.npy', frame @ OPTICAL_TO_BODY)
    np.save('window.npy', seen_from(TRUE[1]) @ OPTICAL_TO_BODY)
    message = refused(capsys, 'calibrate', '--clouds', 'door', 'window.npy', '--sensor', 'd455')
    assert 'door: ' in message and 'from cloud 07.npy on' in message


def test_clouds_in_millimetres_are_named_and_read(clouds, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, cloud in clouds.items():
        np.save(f'{name}.npy', 1000.0 * cloud @ OPTICAL_TO_BODY)
    names = [f'{name}.npy' for name in clouds]
    for sensor in ([], ['--sensor', 'd455']):
        message = refused(capsys, 'calibrate', '--clouds', *names, *sensor)
        assert message.count('--cloud-scale 0.001') == 3
    rows = printed(capsys, 'calibrate', '--clouds', *names, '--cloud-scale', 0.001)['cameras']
    assert [row['refused'] for row in rows] == ['', '', '']


def test_no_overlap_is_more_than_all(clouds):
    # Two cameras see the same.
    rows = without_scan({**clouds, 'twin': clouds['cam_0'][::2] + 1e-4}, SENSOR, '').rows
    assert all(0.0 < row['overlap'] <= 1.0 for row in rows)


def test_a_camera_that_lost_its_reference_is_found_by_the_others(clouds):
    # It hangs in another corner.
    now = Pose.of(np.array([SIZE[0] - 0.3, SIZE[1] - 0.4, 2.1, np.arctan2(
        0.4 - 0.5 * SIZE[1], 0.3 - 0.5 * SIZE[0]), 0.5, 0.0]))
    rows = np.array([[*pose.position, *heading_of(pose.rotation)] for pose in TRUE])
    placement = placement_of(rig_of(3, SENSOR), rows)
    names = [placed.camera.name for placed in placement.cameras]
    before = dict(zip(names, clouds.values()))
    found = since_reference(placement, before, {**before, names[1]: seen_from(now)}, '')
    assert [row.get('moved') for row in found.rows] == [False, True, False]
    moved = found.placement.cameras[1]
    assert_near(Pose.of(moved.pose), now, 0.02, 0.7)
    assert moved.planned == (placement.cameras[1].position, placement.cameras[1].angles)
    assert 'other cameras' in found.rows[1]['note'] and 'turn it' in found.rows[1]['put_back']
    # Alone, it is lost.
    alone = since_reference(placement, before, {names[1]: seen_from(now)}, '').rows[1]
    assert 'other cameras do not show' in alone['refused']


def test_the_floor_tilts_a_rig_that_is_said_to_be_tilted_otherwise(clouds):
    # All cameras are said to look down by 3 degrees more than they do.
    said = np.array([[*pose.position, *heading_of(pose.rotation)] for pose in TRUE])
    said[:, 4] += np.deg2rad(3.0)
    placement = placement_of(rig_of(3, SENSOR), said)
    names = [placed.camera.name for placed in placement.cameras]
    found, _ = calibrate_mutually(placement, dict(zip(names, clouds.values())))
    for name, true in zip(names, TRUE):
        assert_near(found[name].pose, true, 0.03, 0.7)


def test_a_measured_distance_holds_a_camera_along_it():
    # Both cameras see one level surface alone.
    floor = np.random.default_rng(0).uniform(-2.0, 2.0, (1500, 3)) * [1.0, 1.0, 0.0]
    normals = np.tile([0.0, 0.0, 1.0], (len(floor), 1))
    true = [Pose.of(np.array([x, 0.0, 2.0, 0.0, 1.2, 0.0])) for x in (0.0, 1.0)]
    rig = [RigCamera.of(Patches((floor - pose.position) @ pose.rotation, normals @ pose.rotation,
                                np.full(len(floor), 0.006))) for pose in true]
    start = [true[0], Pose(true[1].position + [0.03, 0.0, 0.02], true[1].rotation)]
    stage, loose = AlignmentStage((0.1, 0.1), (3.0, 3.0), 20), {}
    for distances in ((), (Distance(0, 1, 1.0),)):
        poses = joint_poses(rig, start, stage, [0], distances)
        found = certainties(all_constraints(rig, poses, [(0, 1), (1, 0)], 0.1, 3.0, distances),
                            ['a', 'b'], [0])[1]
        loose[len(distances)] = len(found.loose_motions)
        if distances:
            assert poses[1].position[0] == pytest.approx(1.0, abs=0.002)
        else:
            assert poses[1].position[0] == pytest.approx(1.03, abs=0.01)
    assert loose[1] == loose[0] - 1
    places = {'a': np.zeros(3), 'b': np.array([1.0, 0.0, 0.0]), 'c': np.array([0.0, 1.0, 0.0])}
    assert '--distance a:b=METRES' in advice('a', np.array([1.0, 0.0, 0.0]), places)
    assert advice('a', np.array([0.0, 0.0, 1.0]), places) == ''
    assert advice('a', np.array([0.0, 0.0, 1.0]), places, ['c']).endswith('c sees it too (--box)')


@pytest.mark.parametrize('wrong', [0.0, 0.02])
def test_a_wrong_distance_between_cameras_that_the_clouds_hold_moves_none(clouds, wrong):
    free = without_scan(clouds, SENSOR, '').rows
    true = np.linalg.norm(TRUE[0].position - TRUE[1].position)
    rows = without_scan(clouds, SENSOR, '', {('cam_0', 'cam_1'): true + wrong}).rows
    assert [row['refused'] for row in rows] == ['', '', '']
    assert [row['position'] for row in rows] == [row['position'] for row in free]
    by_clouds = np.linalg.norm(np.subtract(free[0]['position'], free[1]['position']))
    for row, named in zip(rows, [wrong > 0.0, wrong > 0.0, False]):
        assert bool(row['note']) == named
        assert not named or all(f'{metres:.3f} m' in row['note']
                                for metres in (true + wrong, by_clouds))


@pytest.mark.parametrize('wrong, accepted', [(0.0, True), (0.3, True), (0.0, False), (0.3, False)])
def test_a_distance_that_holds_a_camera_is_used_and_is_not_asked_for_again(wrong, accepted):
    # The clouds hold the camera b to 3 cm along x alone.
    loose = Certainty(np.eye(3), np.array([0.03, 0.0, 0.0]), np.eye(3), np.zeros(3),
                      covariance=np.diag([0.0, 0.0, 0.0, 9e-4, 0.0, 0.0]))
    held = loose._replace(covariance=np.zeros((6, 6)))

    def register(left_out):
        """Return both cameras as without the distance, or as with it."""
        x, why = (1.0, 'it may slide') if left_out else (
            1.0 + wrong, '' if accepted else 'it may slide')
        return {name: MutualRegistration(Pose(np.array([at, 0.0, 0.0]), np.eye(3)), 1.0, 1.0,
                                         certainty, refused)
                for name, at, certainty, refused in (
                    ('a', 0.0, held, ''), ('b', x, loose if left_out else held, why))}, {}

    found, _ = with_distances(register, {('a', 'b'): 1.0 + wrong})
    assert found['b'].pose.position[0] == 1.0 + wrong and bool(found['b'].refused) != accepted
    said = found['b'].note if accepted else found['b'].refused
    assert ('1.300 m' in said and '1.000 m' in said) == (wrong > 0.0)
    # Nor is it asked for where it was measured already.
    places = {'a': np.zeros(3), 'b': np.array([1.0, 0.0, 0.0]), 'c': np.array([2.0, 0.2, 0.0])}
    assert 'b:a=' in advice('b', np.eye(3)[0], places)
    assert 'b:c=' in advice('b', np.eye(3)[0], places, (), [('a', 'b')])
    assert advice('b', np.eye(3)[0], places, (), [('a', 'b'), ('b', 'c')]) == ''


@pytest.mark.parametrize('arguments, words', [
    (['room.ply', '--clouds', 'a.npy'], 'ROOM'), (['--clouds', 'empty'], 'no file'),
    (['--against', 'a.yaml', '--sensor', 'd455', '--clouds', 'a.npy'], '--against and --sensor'),
    (['--clouds', 'b.npy', '--distance', 'b:c=1'], 'c'),
    (['--clouds', 'b.npy', '--near', '1'], '--near'),
    (['--against', 'a.yaml', '--clouds', 'b.npy', '--distance', 'b:c=1'], '--distance'),
    (['--against', 'a.yaml', '--clouds', 'b.npy', '--box'], '--box'),
    (['--clouds', 'b.npy', 'c.npy', '--distance', 'b:c=0'], 'metres above 0'),
    (['--clouds', 'b.npy', 'c.npy', '--distance', 'b:b=1'], 'of two cameras'),
    (['--clouds', 'b.npy', 'c.npy', '--distance', 'b:c'], 'CAMERA:OTHER=METRES'),
    (['--clouds', 'b.npy', 'c=b.npy'], 'same points for b and c'),
    (['--clouds', 'b.npy', 'mixed'], 'mixed: x.ply')])
def test_what_does_not_go_together_is_refused(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    Path('empty').mkdir()
    Path('mixed').mkdir()
    Path('mixed/x.ply').touch()
    for name, value in (('b', 1.0), ('c', 2.0)):
        np.save(f'{name}.npy', np.full((200, 3), value))
    assert words in refused(capsys, 'calibrate', *arguments)


def test_a_model_without_a_sensor_contains_what_was_seen(clouds):
    model = model_of_cloud(clouds['cam_0'])
    assert np.rad2deg(model.horizontal_fov) == pytest.approx(87.0, abs=8.0)
    assert len(LiveView(clouds['cam_0'], model).points) > 0.98 * len(clouds['cam_0'])


@pytest.mark.skipif(not REAL.is_file(), reason='needs the real clouds')
def test_the_floor_and_a_movement_are_found_in_a_real_frame():
    cloud = load_cloud(REAL) @ TO_BODY['opengl'].T
    model, rng = model_of_cloud(cloud), np.random.default_rng(0)
    view = LiveView(cloud, model)
    level = LevelView.of(view)
    assert 1.2 < level.pose.position[2] < 1.5 and abs(heading_of(level.pose.rotation)[1]) < 0.1
    for metres in (0.0, 0.02):
        moved = (cloud - [0.0, metres, 0.0]) * (1.0 + rng.normal(0.0, 0.003, (len(cloud), 1)))
        found = movement_since(view, LiveView(moved[rng.random(len(moved)) < 0.6], model))
        assert found.has_moved == (metres > 0.0)
        assert found.pose.position[1] == pytest.approx(metres, abs=0.003)
