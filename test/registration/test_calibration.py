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

from pathlib import Path
import re

from benchmarks.calibration_bench import cast, off, shares
from benchmarks.calibration_conditions import hall, hung_in_hall
from conftest import blank_report, box_sides, printed, refused
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.geometry.cameras import CameraModel, heading_of, OPTICAL_TO_BODY, Pose, TO_BODY
from ocp_ros.registration import calibration
from ocp_ros.registration.alignment import (
    matches_of,
    Patches,
    Poses,
    Surfaces,
)
from ocp_ros.registration.calibration import _correct_depths, as_built, calibrate, drift
from ocp_ros.registration.camera_registration import (
    _behind_shares,
    _best_shift,
    FINEST_STAGE,
    LIMITS,
    register,
    registered_nearby,
)
from ocp_ros.registration.joint_alignment import (
    all_constraints,
    certainties,
    Constraints,
    joint_poses,
    RigCamera,
)
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.scan_surfaces import inward_sign, ScanSurfaces
from ocp_ros.registration.steady_cloud import steady_cloud
from ocp_ros.report.facts import details_of
from ocp_ros.rig.placement_file import load_placement, placement_of, save_placement
from ocp_ros.rig.rig_file import load_rig, rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import generate_room, mesh_of, plan_of, sample_surfaces
from ocp_ros.rooms.room_plan import RoomPlan
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Scan, Scene
from ocp_ros.scenes.scene_files import save_scene
import pytest
import yaml

SEED, SENSOR = 532, 'realsense_d455'
MODEL = SENSORS[SENSOR].model
ROW = np.array([0.4, 0.5, 2.2, 0.7, 0.4, 0.0])
TRUE = Pose.of(ROW)


@pytest.fixture(scope='module')
def scan():
    """Return the scan of a small room."""
    return ScanSurfaces(generate_room(SEED, 9000))


def seen_by(pose, seed=SEED):
    """Return what a camera sees of a room's mesh, with noise, in its body frame."""
    return cast(MeshRays(mesh_of(plan_of(seed))), pose, SENSOR)[0]


@pytest.fixture(scope='module')
def view():
    """Return what the camera sees where it truly hangs."""
    return LiveView(seen_by(TRUE), MODEL)


def assert_near(found, pose, metres=0.01, degrees=0.5):
    """Assert that a pose is nearly another one."""
    away, turn = found.away_from(pose)
    assert away < metres and turn < np.deg2rad(degrees)


def test_a_camera_is_found_from_far_off(scan, view):
    found = register(scan, view, off(TRUE, 0.9, 25.0, np.random.default_rng(1)), MODEL)
    assert found.refused == '' and found.certainty.loose_motions == []
    assert_near(found.pose, TRUE)
    assert found.overlap > 0.8 and found.residual < 0.03
    assert found.certainty.metres[0] > 0.3 * found.pose.away_from(TRUE)[0]


def test_a_camera_is_not_looked_for_farther_off_than_asked(scan, view):
    start = off(TRUE, 0.9, 25.0, np.random.default_rng(1))
    found = register(scan, view, start, MODEL, near=0.4)
    assert found.refused or found.pose.away_from(start)[0] <= 0.5


@pytest.mark.parametrize('roll, axes, words', [
    (np.pi, np.eye(3), 'upside down'), (0.5 * np.pi, np.eye(3), 'on its side'),
    (0.0, OPTICAL_TO_BODY, '--cloud-frame optical'), (0.0, TO_BODY['opengl'], 'opengl')])
def test_a_camera_that_is_mounted_otherwise_than_said_is_found_and_that_is_named(
        scan, roll, axes, words):
    true = Pose.of(ROW + [0.0, 0.0, 0.0, 0.0, 0.0, roll])
    placement = placement_of(rig_of(1, SENSOR), ROW[None])
    name = placement.cameras[0].camera.name
    found, broken = calibrate(scan, placement, {name: seen_by(true)[::4] @ axes})
    assert not broken and not found[name].refused and words in found[name].actual_setup
    assert_near(found[name].pose, true)


def test_exchanged_clouds_are_found_and_named(scan):
    rows = np.array([ROW, [3.2, 2.4, 2.2, -2.2, 0.4, 0.0]])
    placement = placement_of(rig_of(2, SENSOR), rows)
    first, second = (placed.camera.name for placed in placement.cameras)
    clouds = [seen_by(Pose.of(row))[::4] for row in rows]
    found, _ = calibrate(scan, placement, dict(zip((second, first), clouds)))
    for name, other, row in ((first, second, rows[0]), (second, first, rows[1])):
        assert not found[name].refused and other in found[name].actual_setup
        assert_near(found[name].pose, Pose.of(row))


def test_exchanged_clouds_of_neighbours_are_noted(scan):
    rows = np.array([ROW, [ROW[0] + 0.4, ROW[1], ROW[2], ROW[3] + 0.3, *ROW[4:]]])
    placement = placement_of(rig_of(2, SENSOR), rows)
    names = [placed.camera.name for placed in placement.cameras]
    clouds = [seen_by(Pose.of(row))[::4] for row in rows]
    for order, noted in ((clouds, False), (clouds[::-1], True)):
        found, _ = calibrate(scan, placement, dict(zip(names, order)))
        assert ['exchanged' in found[name].note for name in names] == [noted, noted]
        assert not any(found[name].refused for name in names)


def test_a_room_that_has_changed_since_the_scan_is_named_with_the_pose(view):
    points, rng = generate_room(SEED, 9000).points, np.random.default_rng(0)
    middle = TRUE.position + 1.6 * TRUE.rotation[:, 0]
    # A cupboard of the scan is gone.
    gone = box_sides([0.6, 0.6, 0.9], [*middle[:2], 0.45], 0.04)
    found = register(ScanSurfaces(Scene(np.vstack([points, gone]).astype(np.float32))), view,
                     off(TRUE, 0.3, 10.0, rng), MODEL)
    assert found.violated_share > LIMITS.max_violated
    assert 'changed since the scan' in found.note and not found.refused
    assert_near(found.pose, TRUE)


@pytest.mark.parametrize(('size', 'turns'), [
    ([4.0, 4.0, 2.6], '90, 180 and 270'), ([5.0, 4.0, 2.6], '180')])
def test_poses_in_an_empty_room_that_fit_as_well_are_counted(size, turns):
    walls = box_sides(size, np.divide(size, 2.0), 0.04)
    pose = Pose.of(np.array([0.15, 0.15, 2.0, np.pi / 4, 0.4, 0.0]))
    # Nothing hides anything in an empty room.
    cloud = (walls - pose.position) @ pose.rotation
    slopes = np.abs(cloud[:, 1:]) / np.maximum(cloud[:, :1], 1e-6)
    seen = cloud[(cloud[:, 0] > 0.0) & (slopes < [0.9, 0.6]).all(axis=1)]
    found = register(ScanSurfaces(Scene(walls.astype(np.float32))), LiveView(seen, MODEL),
                     pose, MODEL)
    assert not found.refused and f'turned by {turns} degrees' in found.note


def plane(across):
    """Return points of a level x z wall at some y, evenly, with the faintest noise."""
    x, z = np.meshgrid(*[np.linspace(-4.0, 4.0, 160)] * 2)
    y = across + np.random.default_rng(0).normal(0.0, 1e-3, x.size)
    return np.column_stack([x.ravel(), y, z.ravel()])


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
    assert len(found.certainty.loose_motions) == 3
    for loose in ('slide along the x', 'slide along the vertical', 'turn about the y'):
        assert loose in found.refused
    assert found.pose.position[1] == pytest.approx(0.0, abs=0.01)


def test_noise_along_the_rays_is_averaged_within_a_surface():
    noise = 0.017
    depth = 3.0 + np.random.default_rng(1).normal(0.0, noise, (240, 320))
    patches = LiveView(cloud_of(depth), MODEL).patches
    # Voxels of 7 cm leave 10 mm: they part the slab into layers.
    assert patches.points[:, 0].std() < 0.4 * noise
    assert patches.points[:, 0].mean() == pytest.approx(3.0, abs=1e-3)
    assert np.abs(patches.normals[:, 0]).mean() > 0.98
    # What stands behind each other is not averaged.
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
    found = registered_nearby(surfaces, view, pose, model)
    assert bool(found.others) == named and (not named or found.refused)


def test_a_camera_that_is_refused_for_its_deviation_is_told_what_would_hold_it():
    # Only a board holds it along the wall.
    board = np.random.default_rng(0).uniform([1.0, 2.6, -0.4], [1.0, 3.0, 0.4], (4000, 3))
    room = np.concatenate([plane(3.0), plane(-1.5)[:, [0, 2, 1]], board])
    pose, model = Pose.of(np.array([0.0, 0.0, 0.0, 0.5 * np.pi, 0.0, 0.0])), CameraModel(0.1, 6.0)
    view = LiveView((room - pose.position) @ pose.rotation, model)
    refused = registered_nearby(ScanSurfaces(Scene(room.astype(np.float32))), view, pose,
                                model).refused
    assert 'mm along the x direction' in refused and 'the floor and two walls that meet' in refused


def test_of_poses_that_fit_as_well_the_nearest_is_taken_as_the_message_says():
    # Boards at a wall repeat after 1.2 m.
    rng = np.random.default_rng(0)
    boards = [rng.uniform([x + along, 2.0, -1.2], [x + along, 3.0, 1.2], (2500, 3))
              for x in np.arange(-3.6, 3.7, 1.2) for along in (0.0, 0.35, 0.55)]
    room = np.concatenate([plane(3.0), plane(-1.5)[:, [0, 2, 1]], *boards])
    scan, model = ScanSurfaces(Scene(room.astype(np.float32))), CameraModel(0.1, 6.0)
    true = Pose.of(np.array([0.0, 0.0, 0.0, 0.5 * np.pi, 0.0, 0.0]))
    cloud = (room - true.position) @ true.rotation
    slopes = np.abs(cloud[:, 1:]) / np.maximum(cloud[:, :1], 1e-6)
    view = LiveView(cloud[(cloud[:, 0] > 0.0) & (slopes < 0.6).all(axis=1)], model)
    start = off(true, 0.1, 2.0, rng)
    refusal = register(scan, view, start, model).refused
    near = float(re.search(r'--near (\S+)\)', refusal)[1])
    found = register(scan, view, start, model, near)
    assert not found.refused
    assert_near(found.pose, true)


@pytest.mark.parametrize('known', [True, False])
def test_a_partition_that_was_scanned_from_its_other_side_does_not_hold_a_camera(known):
    # The wall behind the partition is out of reach, so that its thickness would displace the pose.
    plan = RoomPlan('hall', np.array([16.0, 5.0, 2.6]), np.random.default_rng(0))
    plan.add_box('wall', (5.0, 0.0, 0.0), (5.1, 4.0, 2.6))
    points = sample_surfaces(plan, 30_000, np.random.default_rng(0))
    points = points[np.abs(points[:, 0] - 5.1) > 0.02]
    scans = (Scan(np.array([2.5, 2.5, 1.2]), points[points[:, 0] < 5.05]),
             Scan(np.array([13.0, 2.5, 1.2]), points[points[:, 0] > 5.05])) if known else ()
    true = Pose.of(np.array([8.0, 0.5, 2.2, 2.9, 0.3, 0.0]))
    view = LiveView(cast(MeshRays(mesh_of(plan)), true, SENSOR)[0], MODEL)
    found = register(ScanSurfaces(Scene(points, scans=scans)), view, true, MODEL)
    assert found.refused


def test_a_pose_beside_the_best_one_is_left(scan, view):
    # Registered once more from there alone, it would stay 2 cm off.
    beside = Pose(TRUE.position - [0.0, 0.0, 0.1], TRUE.rotation)
    found, _ = _best_shift(scan.in_view(TRUE, MODEL), view.patches, beside)
    assert_near(found, TRUE, 0.005, 0.3)


def test_a_cloud_of_another_room_and_a_camera_outside_of_the_scan_are_refused(scan, view):
    assert register(scan, LiveView(seen_by(TRUE, 505), MODEL), TRUE, MODEL).refused
    outside = Pose(TRUE.position + [100.0, 0.0, 0.0], TRUE.rotation)
    found = register(scan, view, outside, MODEL)
    assert found.refused and found.overlap == 0.0 and len(found.certainty.loose_motions) == 6


def test_points_behind_a_scanned_surface_are_held_against_a_pose(scan, view):
    steps = np.array([0.0, -0.08, 0.08])[:, None] * TRUE.rotation[:, 0]
    there, back, forward = _behind_shares(scan.fine, view.patches, Poses(
        np.stack([TRUE.rotation] * 3), TRUE.position + steps))
    assert there < back < LIMITS.max_behind < forward


def test_a_scan_that_is_bent_makes_a_pose_less_certain():
    rng = np.random.default_rng(0)
    points = rng.uniform(-2.0, 2.0, (3, 3000, 3))
    # Three walls, one across each axis.
    points[range(3), :, range(3)] = np.array([5.0, 4.0, -2.0])[:, None]
    points, normals = points.reshape(-1, 3), -np.repeat(np.eye(3), 3000, axis=0)
    cells = np.unique(np.floor(points), axis=0, return_inverse=True)[1].ravel()
    jacobians = np.concatenate([np.cross(points, normals), normals], axis=1)
    weights, metres = np.full(len(points), 0.006 ** -2.0), []
    for bent in (0.0, 0.015):
        residuals = rng.normal(0.0, bent, cells.max() + 1)[cells]
        residuals += rng.normal(0.0, 1e-3, len(points))
        held = Constraints(0, -1, jacobians, residuals, weights, points, normals)
        metres.append(certainties([held], ['camera'])[0].metres[0])
    assert metres[1] > 3.0 * metres[0]


def test_the_back_of_a_scanned_surface_is_no_match():
    wall = plane(3.0)[::16]
    seen = Patches(wall, np.tile([0.0, -1.0, 0.0], (len(wall), 1)), np.full(len(wall), 0.01))
    here = Poses(np.eye(3)[None], np.zeros((1, 3)))
    for side, oriented, matches in ((-1.0, True, True), (1.0, True, False), (1.0, False, True)):
        normals = np.tile([0.0, side, 0.0], (len(wall), 1))
        found = matches_of(Surfaces.of(wall, normals, oriented), seen, here, 0.1).found
        assert found.all() == found.any() == matches


def test_normals_are_trusted_where_outer_surfaces_look_inside():
    points = box_sides(np.full(3, 4.0), 2.0, 0.4)
    points = points[np.count_nonzero(points % 4.0 == 0.0, axis=1) == 1]
    # Of each side of a box.
    normals = (points == 0.0) * 1.0 - (points == 4.0)
    mixed = normals * np.random.default_rng(0).choice([-1.0, 1.0], (len(points), 1))
    for given, sign in ((normals, 1.0), (-normals, -1.0), (None, 0.0), (mixed, 0.0)):
        assert inward_sign(Scene(points, normals=given)) == sign


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    """Work where the room, a placement that is off, and what one of three cameras sees are."""
    path = tmp_path_factory.mktemp('hung')
    save_scene(generate_room(SEED, 9000), path / 'room.ply')
    entries = []
    for number, name in enumerate(('door', 'window', 'shelf')):
        planned = off(TRUE, 0.2, 5.0, np.random.default_rng(number))
        angles = np.rad2deg(heading_of(planned.rotation)).tolist()
        entries.append({'name': name, 'sensor': SENSOR, 'position': planned.position.tolist(),
                        **dict(zip(('yaw', 'pitch', 'roll'), angles))})
    (path / 'placement.yaml').write_text(yaml.safe_dump({'cameras': entries}))
    np.save(path / 'door.npy', seen_by(TRUE) @ OPTICAL_TO_BODY)
    np.save(path / 'other.npy', np.repeat([[0.0] * 3, [99.0] * 3], 100, axis=0))
    np.save(path / 'shelf.npy', np.tile([0.0, 0.0, 2.0], (5000, 1)))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        yield


def test_the_placement_as_built_is_written_and_scored(files, capsys, monkeypatch):
    monkeypatch.setattr('ocp_ros.report.drawing.report_page.draw_pages', blank_report)
    printed(capsys, 'score', 'room.ply', 'placement.yaml', '--out', 'planned')
    door, window, shelf = printed(
        capsys, 'calibrate', 'room.ply', 'planned/placement.yaml', '--clouds', 'door.npy',
        'window=other.npy', 'shelf.npy')['cameras']
    assert door['refused'] == door['otherwise'] == '' and len(door['deviations']) == 6
    assert np.linalg.norm(door['position'] - TRUE.position) < 0.01
    assert door['from_plan_metres'] == pytest.approx(0.2, abs=0.01)
    assert '0 of 200 points' in window['refused'] and '5000 points in 1' in shelf['refused']
    planned, built = (load_placement(name) for name in ('placement.yaml',
                                                        'out/built/placement.yaml'))
    assert built.cameras[0].position == tuple(door['position'])
    assert built.cameras[0].planned[0] == pytest.approx(planned.cameras[0].position, abs=1e-4)
    assert built.cameras[1][:4] == planned.cameras[1][:4] and built.cameras[1].planned is None
    launch = Path('out/built/cameras.launch.py').read_text()
    assert "'camera_0_optical'" in launch and "'camera_1'" not in launch
    built = printed(capsys, 'score', 'room.ply', 'out/built/placement.yaml')
    # The scores of the plan are not taken for those of what was built.
    assert built['planned']['loss'] != built['scores']['loss']
    assert 'the file has' not in str(built['notes'])
    assert any('as planned: depth error' in line for line in details_of(built))


def test_where_no_camera_is_found_the_command_fails(files, capsys):
    assert main(['calibrate', 'room.ply', 'placement.yaml', '--clouds', 'door=other.npy']) == 2
    out, err = capsys.readouterr()
    assert 'shelf' in out and 'no camera' in err and err.count('\n') == 1


@pytest.mark.parametrize(('arguments', 'words'), [
    (['--clouds', 'other.npy'], '--clouds'), (['--clouds', 'door.npy', 'door=other.npy'], 'door'),
    (['--clouds', 'door.npy', '--topics', 'door=/a'], '--topics'),
    (['--bag', 'none.bag'], 'none.bag'), (['--bag', 'none.bag', '--topics', '/a'], '--topics')])
def test_what_cannot_be_read_is_refused_in_one_sentence(files, capsys, arguments, words):
    if '--bag' in arguments:
        pytest.importorskip('rclpy', reason='bags are read with ROS 2 (rclpy)')
    assert words in refused(capsys, 'calibrate', 'room.ply', 'placement.yaml', *arguments)


def test_an_error_of_one_camera_leaves_the_others_their_results(scan):
    placement = placement_of(rig_of(2, SENSOR), np.stack([ROW, ROW]))
    (good, bad) = (placed.camera.name for placed in placement.cameras)
    clouds = {bad: np.full((200, 2), 2.0), good: seen_by(TRUE)[::16]}
    found, reasons = calibrate(scan, placement, clouds)
    assert not found[good].refused and bad in reasons[bad]
    warned, = drift(scan, placement, clouds)
    assert bad in warned


def test_equal_points_of_a_scan_do_not_stop_a_registration():
    points = box_sides(np.full(3, 4.0), 2.0, 0.4)
    # No side looks against x, except the points in the middle.
    points = points[(np.count_nonzero(points % 4.0 == 0.0, axis=1) == 1) & (points[:, 0] != 4.0)]
    normals = np.concatenate([(points == 0.0) * 1.0 - (points == 4.0), [[-1.0, 0.0, 0.0]] * 20])
    points = np.concatenate([points, np.full((20, 3), 2.0)])
    scan = ScanSurfaces(Scene(points, normals=normals))
    assert scan.oriented and np.isfinite(scan.normals).all()


def test_a_camera_in_place_that_hardly_moved_is_moved_in_the_rig_as_well(
        scan, view, tmp_path, monkeypatch):
    start = off(TRUE, 0.05, 1.0, np.random.default_rng(1))
    found = registered_nearby(scan, view, start, MODEL)
    assert_near(found.pose, TRUE)
    monkeypatch.chdir(tmp_path)
    Path('rig.yaml').write_text(
        f'cameras: [{{sensor: {SENSOR}}}]\nmount: {{on: free}}\nfixed:\n'
        f'  - {{sensor: {SENSOR}, position: [0.5, 0.5, 2.2], yaw: 40, name: hung}}\n')
    Path('plan.yaml').write_text('cameras: [{position: [0.4, 0.5, 2.2], yaw: 40}]\n')
    placement = load_placement('plan.yaml', load_rig('rig.yaml'))
    save_placement('built.yaml', as_built(placement, {'hung': found}, 'a test'))
    built = load_placement('built.yaml')
    for position in (built.cameras[1].position, built.rig.fixed_poses[0, :3]):
        assert position == pytest.approx(found.pose.position, abs=1e-4)


def test_what_stays_in_most_frames_is_kept_and_its_noise_falls():
    rng = np.random.default_rng(0)
    y, z = np.meshgrid(np.linspace(-0.8, 0.8, 160), np.linspace(-0.6, 0.6, 120))
    frames = []
    for number in range(20):
        depth = 3.0 + rng.normal(0.0, 0.017, y.shape)
        # A person walks past a board that stays; pixels at its edges flicker.
        depth[np.abs(y - 0.1 * (number - 10)) < 0.1] = 1.5
        depth[np.abs(y - 0.3) < 0.1] = 2.0
        depth[np.abs(y - 0.42) < 0.015] = rng.uniform(2.0, 3.0)
        frames.append(cloud_of(depth))
    found = steady_cloud([*frames, np.full((3, 3), np.nan)])
    assert not (found[:, 0] < 1.9).any()
    board = np.abs(found[:, 0] - 2.0) < 0.1
    assert np.abs(found[board, 1] / found[board, 0] - 0.3).max() < 0.13
    assert found[~board, 0].std() < 0.005 and found[~board, 0].min() > 2.9
    assert steady_cloud(frames[:1]) is frames[0]


@pytest.mark.parametrize('factor', [1.0, 1.006, 1.02])
def test_a_camera_with_wrong_depths_is_named_and_placed_by_right_ones(scan, factor, monkeypatch):
    start = off(TRUE, 0.2, 5.0, np.random.default_rng(2))
    placement = placement_of(rig_of(1, SENSOR), np.array([
        [*start.position, *heading_of(start.rotation)]]))
    name = placement.cameras[0].camera.name
    carried, thing = [], np.ones((100, 3))
    monkeypatch.setattr(calibration, 'carried_by', lambda seen, _: carried.append(seen) or {})
    found = calibrate(scan, placement, {name: factor * seen_by(TRUE)},
                      seen={name: {0: [thing]}})[0][name]
    assert_near(found.pose, TRUE)
    named = re.match(r'its depths are (\S+) % too long', found.note)
    assert bool(named) == (factor > 1.0) == bool(found.note)
    assert not named or float(named[1]) == pytest.approx(100.0 * (factor - 1.0), abs=0.2)
    # What was set down is as far away as the rest of the cloud.
    assert carried[0][name][0][0] == pytest.approx(thing / factor, rel=0.002)


def test_depths_that_may_be_wrong_are_named_with_what_that_would_do(scan, view, monkeypatch):
    placement = placement_of(rig_of(1, SENSOR), ROW[None])
    name = placement.cameras[0].camera.name
    found = {name: registered_nearby(scan, view, TRUE, MODEL)}
    before, used = found[name].pose, {name: view.points}
    # Once corrected, nothing is left of the error, but it is uncertain by half of itself.
    shares = iter([(0.006, 0.003), (0.0, 0.003)])
    monkeypatch.setattr(calibration, 'depth_share', lambda *_: next(shares))
    assert _correct_depths(scan, placement, found, used, 1.6) == {name: 1.0}
    assert found[name].pose is before and used[name] is view.points
    metres = float(re.search(r'0\.6 % too long.* off by (\d+) mm', found[name].note)[1]) / 1000.0
    assert 0.005 < metres < 0.05


def test_depths_are_not_corrected_by_walls_that_look_alike_with_longer_ones():
    # From farther off along the edge of sight to a bare corner, longer depths show the same.
    plan, pose = hall(), hung_in_hall(np.random.default_rng(9501))[0]
    cloud = cast(MeshRays(mesh_of(plan)), pose, SENSOR)[0]
    bare = ScanSurfaces(Scene(sample_surfaces(plan, 9000, np.random.default_rng(0))))
    placement = placement_of(rig_of(1, SENSOR), np.array([
        [*pose.position, *heading_of(pose.rotation)]]))
    name = placement.cameras[0].camera.name
    found = {name: registered_nearby(bare, LiveView(cloud, MODEL), pose, MODEL)}
    _correct_depths(bare, placement, found, {name: cloud}, 1.6)
    assert not found[name].refused and not found[name].note
    assert_near(found[name].pose, pose, 0.015)


def test_a_neighbour_holds_a_camera_where_the_scan_does_not():
    walls = np.random.default_rng(0).uniform(0.0, 3.0, (3, 1500, 3))
    walls[range(3), :, range(3)] = 0.0
    points, normals = walls.reshape(-1, 3), np.repeat(np.eye(3), 1500, axis=0)
    true = [Pose.of(np.array([2.5, 2.0 - k, 1.5, 3.0 + 0.5 * k, 0.1, 0.0])) for k in range(2)]
    # The scan shows three walls to one camera, and one wall to the other.
    scans = (points, normals), (points[:1500], normals[:1500])
    rig = [RigCamera.of(Patches((points - pose.position) @ pose.rotation, normals @ pose.rotation,
                                np.full(len(points), 0.006)), Surfaces.of(*shown, True))
           for pose, shown in zip(true, scans)]
    start = [true[0], off(true[1], 0.03, 1.0, np.random.default_rng(0))]
    poses = joint_poses(rig, start, FINEST_STAGE)
    assert_near(poses[1], true[1], 0.002, 0.1)
    pairs = [(0, 1), (1, 0)]
    for used, loose in (([], 3), (pairs, 0)):
        certainty = certainties(all_constraints(rig, true, used, 0.03, 1.0), ['held', 'free'])[1]
        assert len(certainty.loose_motions) == loose
        assert {name for one in certainty.held_by for name in one} == (
            {'scan', 'held'} if used else {'scan'})


def test_a_share_that_was_not_measured_is_not_recorded():
    rows = [{'refused': '', 'right': True}, {'refused': 'it sees no floor', 'right': False}]
    assert 'within_stated_90' not in shares(rows) and shares(rows)['right'] == 0.5
    stated = shares([*rows, {'refused': '', 'right': True, 'normalised': [0.5, -2.0]}])
    assert stated['within_stated_90'] == 0.5
