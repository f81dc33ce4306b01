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

"""ocp calibrate: cameras are found where they hang, or refused with the reason."""

import json

from benchmarks.calibration_bench import cast, off
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.geometry.cameras import angle_between, CameraModel, heading_of, OPTICAL_TO_BODY, Pose
from ocp_ros.registration.alignment import Matches, matches_of, Patches, Poses, Surfaces
from ocp_ros.registration.calibration import as_built, calibrate
from ocp_ros.registration.camera_registration import (
    _behind_shares,
    _best_shift,
    LIMITS,
    register,
    registered_nearby,
)
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.pose_certainty import estimate_certainty
from ocp_ros.registration.scan_surfaces import inward_sign, ScanSurfaces
from ocp_ros.rig.placement_file import load_placement, placement_of
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import generate_room, mesh_of, plan_of
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_files import save_scene
import pytest
import yaml

SEED, SENSOR = 501, 'realsense_d455'
MODEL = SENSORS[SENSOR].model
TRUE = np.array([0.4, 0.5, 2.2, 0.7, 0.4, 0.0])


@pytest.fixture(scope='module')
def room():
    """Return a scanned room."""
    return generate_room(SEED, 60_000)


@pytest.fixture(scope='module')
def scan(room):
    """Return it for registration."""
    return ScanSurfaces(room)


def seen_by(pose, seed=0):
    """Return what a camera sees of the room's mesh, with noise, in its body frame."""
    return cast(MeshRays(mesh_of(plan_of(SEED))), pose, SENSOR, np.random.default_rng(seed))


def errors(found, pose):
    """Return how far off a pose is: metres and degrees."""
    return (np.linalg.norm(found.position - pose.position),
            np.rad2deg(angle_between(found.rotation, pose.rotation)))


@pytest.mark.parametrize(('metres', 'degrees'), [(0.3, 10.0), (0.9, 25.0)])
def test_a_camera_is_found_from_far_off(scan, metres, degrees):
    true = Pose.of(TRUE)
    start = off(true, metres, degrees, np.random.default_rng(1))
    found = register(scan, LiveView(seen_by(true), MODEL), start, MODEL)
    assert found.refused == ''
    away, turn = errors(found.pose, true)
    assert away < 0.01 and turn < 0.5
    assert found.overlap > 0.8 and found.residual < 0.03
    assert found.certainty.metres[0] > 0.3 * away and found.certainty.loose_motions == []


@pytest.mark.parametrize('roll, axes, words', [
    (np.pi, np.eye(3), 'upside down'), (0.5 * np.pi, np.eye(3), 'on its side'),
    (0.0, OPTICAL_TO_BODY, '--cloud-frame optical')])
def test_a_camera_that_is_mounted_otherwise_than_said_is_found_and_that_is_named(
        scan, roll, axes, words):
    said = np.array(TRUE)
    true = Pose.of(said + [0.0, 0.0, 0.0, 0.0, 0.0, roll])
    placement = placement_of(rig_of(1, SENSOR), said[None])
    name = placement.cameras[0].camera.name
    found, broken = calibrate(scan, placement, {name: seen_by(true) @ axes})
    assert not broken and not found[name].refused and words in found[name].actual_setup
    away, turn = errors(found[name].pose, true)
    assert away < 0.01 and turn < 0.5
    # What is as it was said is found as ever.
    found, _ = calibrate(scan, placement, {name: seen_by(Pose.of(said))})
    assert found[name].actual_setup == ''


def test_who_hardly_moved_is_checked_cheaply(scan):
    true = Pose.of(TRUE)
    start = off(true, 0.05, 1.0, np.random.default_rng(1))
    found = registered_nearby(scan, LiveView(seen_by(true), MODEL), start, MODEL)
    away, turn = errors(found.pose, true)
    assert away < 0.01 and turn < 0.5


def plane(across, size=8.0, count=160):
    """Return points of a level x z wall at some y, evenly, with the faintest noise."""
    grid = np.linspace(-0.5 * size, 0.5 * size, count)
    x, z = (axis.ravel() for axis in np.meshgrid(grid, grid))
    rng = np.random.default_rng(0)
    return np.column_stack([x, across + rng.normal(0.0, 1e-3, x.size), z])


def cloud_of(depth, top=0.6):
    """Return the points of a depth image that reaches to slopes of 0.8 aside and some up."""
    rows, columns = depth.shape
    y, z = np.meshgrid(np.linspace(-0.8, 0.8, columns), np.linspace(-top, top, rows))
    return np.stack([depth, y * depth, z * depth], axis=-1).reshape(-1, 3)


def test_a_bare_wall_holds_three_directions_and_says_which_not():
    # A far corner makes a room of it; the camera does not see that.
    corner = np.random.default_rng(0).normal([9.0, -6.0, 0.0], 0.2, (300, 3))
    surfaces = ScanSurfaces(Scene(np.concatenate([plane(3.0), corner]).astype(np.float32)))
    pose = Pose.of(np.array([0.0, 0.0, 0.0, 0.5 * np.pi, 0.0, 0.0]))
    depth = 3.0 + np.random.default_rng(1).normal(0.0, 2e-3, (60, 80))
    found = registered_nearby(surfaces, LiveView(cloud_of(depth, 0.5), MODEL), pose, MODEL)
    for loose in ('slide along the x', 'slide along the vertical', 'turn about the y'):
        assert loose in found.refused
    assert len(found.certainty.loose_motions) == 3
    assert found.pose.position[1] == pytest.approx(0.0, abs=0.01)


def test_noise_along_the_rays_is_averaged():
    noise = 0.017
    depth = 3.0 + np.random.default_rng(1).normal(0.0, noise, (240, 320))
    patches = LiveView(cloud_of(depth), MODEL).patches
    # Voxels of 7 cm leave 10 mm: they part the slab into layers.
    assert patches.points[:, 0].std() < 0.4 * noise
    assert patches.points[:, 0].mean() == pytest.approx(3.0, abs=1e-3)
    assert np.abs(patches.normals[:, 0]).mean() > 0.98


def test_what_stands_behind_each_other_is_not_averaged():
    y, z = np.meshgrid(np.linspace(-0.8, 0.8, 320), np.linspace(-0.6, 0.6, 240))
    depth = np.where(np.abs(y + 0.1 * z) < 0.2, 1.5, 3.0)
    patches = LiveView(cloud_of(depth), MODEL).patches
    assert np.isin(patches.points[:, 0].round(6), (1.5, 3.0)).all()


@pytest.mark.parametrize(('nearer', 'named'), [(1.0, False), (0.97, True)])
def test_a_near_pose_that_fits_as_well_is_named(nearer, named):
    # Two boards hold the camera along the wall, unless it sees both nearer than they were scanned.
    right = np.random.default_rng(0).uniform([1.0, 2.0, -1.0], [1.0, 3.0, 1.0], (4000, 3))
    wall, floor = plane(3.0), plane(-1.5)[:, [0, 2, 1]]
    room = np.concatenate([wall, floor, right, right * [-1.0, 1.0, 1.0]])
    surfaces = ScanSurfaces(Scene(room.astype(np.float32)))
    seen = np.concatenate([wall, floor, right * [nearer, 1.0, 1.0], right * [-nearer, 1.0, 1.0]])
    pose, model = Pose.of(np.array([0.0, 0.0, 0.0, 0.5 * np.pi, 0.0, 0.0])), CameraModel(0.1, 6.0)
    view = LiveView((seen - pose.position) @ pose.rotation, model)
    assert ('another pose' in registered_nearby(surfaces, view, pose, model).refused) == named


def test_a_pose_beside_the_best_one_is_left(scan):
    true = Pose.of(TRUE)
    view = LiveView(seen_by(true), MODEL)
    beside = Pose(true.position + [0.05, 0.0, 0.0], true.rotation)
    away, turn = errors(_best_shift(scan.in_view(true, MODEL), view.patches, beside)[0], true)
    assert away < 0.005 and turn < 0.3


@pytest.mark.parametrize('find', [register, registered_nearby])
def test_a_cloud_of_another_room_and_a_camera_outside_of_the_scan_are_refused(scan, find):
    pose = Pose.of(TRUE)
    other = cast(MeshRays(mesh_of(plan_of(505))), pose, SENSOR, np.random.default_rng(0))
    assert find(scan, LiveView(other, MODEL), pose, MODEL).refused
    outside = Pose.of(TRUE + [100.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = find(scan, LiveView(seen_by(pose), MODEL), outside, MODEL)
    assert found.refused and found.overlap == 0.0 and len(found.certainty.loose_motions) == 6


def test_points_behind_a_scanned_surface_are_held_against_a_pose(scan):
    true = Pose.of(TRUE)
    view = LiveView(seen_by(true), MODEL)
    forward = Pose(true.position + 0.08 * true.rotation[:, 0], true.rotation)
    back = Pose(true.position - 0.08 * true.rotation[:, 0], true.rotation)
    shares = _behind_shares(scan.fine, view.patches, Poses(
        *(np.stack([getattr(pose, part) for pose in (true, back, forward)])
          for part in ('rotation', 'position'))))
    assert shares[0] < shares[1] < LIMITS.max_behind < shares[2]


def test_a_scan_that_is_bent_makes_a_pose_less_certain():
    rng = np.random.default_rng(0)
    points, normals = [], []
    for axis, across in ((0, 5.0), (1, 4.0), (2, -2.0)):
        wall = rng.uniform(-2.0, 2.0, (3000, 3))
        wall[:, axis] = across
        points.append(wall)
        normals.append(np.tile(-np.eye(3)[axis], (3000, 1)))
    points, normals = np.concatenate(points), np.concatenate(normals)
    cells = np.unique(np.floor(points), axis=0, return_inverse=True)[1].ravel()
    deviation = np.full(len(points), 0.006)
    found = []
    for bent in (0.0, 0.015):
        residuals = (rng.normal(0.0, bent, cells.max() + 1)[cells]
                     + rng.normal(0.0, 1e-3, len(points)))
        matches = Matches(residuals[None], np.concatenate(
            [np.cross(points, normals), normals], axis=1)[None],
            np.ones((1, len(points)), bool), np.arange(len(points))[None])
        found.append(estimate_certainty(points, normals, matches,
                                        1.0 / deviation[None] ** 2).metres[0])
    assert found[1] > 3.0 * found[0]


def test_a_covered_camera_is_refused():
    with pytest.raises(SceneError, match='0 of 2 points'):
        LiveView(np.array([[0.0, 0.0, 0.0], [np.nan] * 3, [99.0, 0.0, 0.0]]), MODEL, 'door')


def test_the_back_of_a_scanned_surface_is_no_match():
    wall = plane(3.0)[::16]
    seen = Patches(wall, np.tile([0.0, -1.0, 0.0], (len(wall), 1)), np.full(len(wall), 0.01))
    here = Poses(np.eye(3)[None], np.zeros((1, 3)))
    for side, oriented, matches in ((-1.0, True, True), (1.0, True, False), (1.0, False, True)):
        normals = np.tile([0.0, side, 0.0], (len(wall), 1))
        found = matches_of(Surfaces.of(wall, normals, oriented), seen, here, 0.1).found
        assert found.all() == found.any() == matches


def test_normals_are_trusted_where_outer_surfaces_look_inside():
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 4.0, (6000, 3))
    axis, side = rng.integers(3, size=6000), rng.integers(2, size=6000)
    points[np.arange(6000), axis] = 4.0 * side
    normals = np.zeros((6000, 3))
    normals[np.arange(6000), axis] = 1.0 - 2.0 * side
    assert inward_sign(Scene(points, normals=normals)) == 1.0
    assert inward_sign(Scene(points, normals=-normals)) == -1.0
    assert inward_sign(Scene(points)) == 0.0
    mixed = normals * rng.choice([-1.0, 1.0], 6000)[:, None]
    assert inward_sign(Scene(points, normals=mixed)) == 0.0


@pytest.fixture
def files(room, tmp_path, monkeypatch):
    """Write the room, a placement that is off, and what two of three cameras see."""
    monkeypatch.chdir(tmp_path)
    save_scene(room, tmp_path / 'room.ply')
    entries = []
    for number, name in enumerate(('door', 'window', 'shelf')):
        true = Pose.of(TRUE)
        planned = off(true, 0.2, 5.0, np.random.default_rng(number))
        yaw, pitch, roll = np.rad2deg(heading_of(planned.rotation)).tolist()
        entries.append({'name': name, 'sensor': SENSOR, 'position': planned.position.tolist(),
                        'yaw': yaw, 'pitch': pitch, 'roll': roll})
    (tmp_path / 'placement.yaml').write_text(yaml.safe_dump({'cameras': entries}))
    np.save('door.npy', seen_by(Pose.of(TRUE)) @ OPTICAL_TO_BODY)
    np.save('other.npy', np.zeros((200, 3)))
    return tmp_path


def test_the_placement_as_built_is_written_and_scored(files, capsys):
    assert main(['score', 'room.ply', 'placement.yaml', '--out', 'planned']) == 0
    capsys.readouterr()
    assert main(['calibrate', 'room.ply', 'planned/placement.yaml', '--clouds', 'door.npy',
                 'window=other.npy', '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    door, window, shelf = found['cameras']
    assert door['refused'] == '' and len(door['deviations']) == 6
    assert np.linalg.norm(door['position'] - TRUE[:3]) < 0.01
    assert door['moved_metres'] == pytest.approx(0.2, abs=0.01)
    assert '0 of 200 points' in window['refused'] and 'no cloud' in shelf['refused']
    planned, built = (load_placement(name) for name in ('placement.yaml',
                                                        'out/built/placement.yaml'))
    assert built.cameras[0].position == tuple(door['position'])
    assert built.cameras[0].planned[0] == pytest.approx(planned.cameras[0].position, abs=1e-4)
    assert built.cameras[1][:4] == planned.cameras[1][:4] and built.cameras[1].planned is None
    launch = (files / 'out' / 'built' / 'cameras.launch.py').read_text()
    assert "'camera_0_optical'" in launch and "'camera_1'" not in launch
    assert main(['score', 'room.ply', 'out/built/placement.yaml', '--json']) == 0
    scores = json.loads(capsys.readouterr().out)
    assert scores['planned']['loss'] != scores['scores']['loss']
    assert main(['score', 'room.ply', 'out/built/placement.yaml']) == 0
    out = capsys.readouterr().out
    # The scores of the plan are not taken for those of what was built.
    assert 'as planned: depth error' in out and 'the file has' not in out


def test_where_no_camera_is_found_the_command_fails(files, capsys):
    assert main(['calibrate', 'room.ply', 'placement.yaml', '--clouds', 'door=other.npy']) == 2
    out, err = capsys.readouterr()
    assert 'shelf' in out and 'no camera' in err and err.count('\n') == 1


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--clouds', 'other.npy'], '--clouds'), (['--clouds', 'door.npy', 'door=other.npy'], 'door'),
    (['--clouds', 'door=none.ply'], 'none.ply'),
    (['--clouds', 'door.npy', '--topics', 'door=/a'], '--topics'),
    (['--bag', 'none.bag'], 'none.bag'), (['--bag', 'none.bag', '--topics', '/a'], '--topics')])
def test_what_cannot_be_read_is_refused_in_one_sentence(files, capsys, arguments, words):
    if '--bag' in arguments:
        pytest.importorskip('rclpy', reason='bags are read with ROS 2 (rclpy)')
    assert main(['calibrate', 'room.ply', 'placement.yaml', *arguments]) == 2
    err = capsys.readouterr().err
    assert words in err and 'expected' in err and err.count('\n') == 1, err


def test_cameras_in_place_are_moved_in_the_rig_as_well(files, scan):
    (files / 'rig.yaml').write_text(
        f'cameras: [{{sensor: {SENSOR}}}]\nmount: {{on: free}}\nfixed:\n'
        f'  - {{sensor: {SENSOR}, position: [0.5, 0.5, 2.2], yaw: 40, name: hung}}\n')
    (files / 'plan.yaml').write_text('cameras: [{position: [0.4, 0.5, 2.2], yaw: 40}]\n')
    from ocp_ros.rig.placement_file import save_placement
    from ocp_ros.rig.rig_file import load_rig
    placement = load_placement('plan.yaml', load_rig('rig.yaml'))
    pose = Pose.of(TRUE)
    found = registered_nearby(scan, LiveView(seen_by(pose), MODEL), pose, MODEL)
    save_placement('built.yaml', as_built(placement, {'hung': found}, 'a test'))
    again = load_placement('built.yaml')
    assert again.cameras[1].position == pytest.approx(found.pose.position, abs=1e-4)
    assert again.rig.fixed_poses[0, :3] == pytest.approx(found.pose.position, abs=1e-4)
