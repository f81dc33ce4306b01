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

"""A box that is set down where two cameras see it holds one that sees a bare wall."""

from pathlib import Path

from benchmarks.calibration_bench import cast, row_of
from benchmarks.calibration_conditions import hall, hung_in_hall, with_box
from conftest import printed, refused
import numpy as np
from ocp_ros.geometry.cameras import OPTICAL_TO_BODY, Pose
from ocp_ros.registration.alignment import Certainty
from ocp_ros.registration.camera_registration import register_together, Registration
from ocp_ros.registration.carried import carried_by, moments_of, set_down
from ocp_ros.registration.joint_alignment import relative_pose
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.mutual_registration import register_mutually
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.registration.steady_cloud import steady_cloud
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import mesh_of, sample_surfaces
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Scene
import pytest

SENSOR = 'realsense_d455'
MODEL, NAMES = SENSORS[SENSOR].model, ('corner', 'wall')
#: The camera ``wall`` sees the floor and one wall of a hall, along x.
RNG = np.random.default_rng(9500)
TRUE = hung_in_hall(RNG)


@pytest.fixture(scope='module')
def frames():
    """Return frames of both cameras: four without a box, then two at each of six places."""
    return with_box(TRUE, SENSOR, 6, RNG)


@pytest.fixture(scope='module')
def views(frames):
    """Return the still scene of both cameras."""
    return {name: LiveView(steady_cloud(one), MODEL) for name, one in zip(NAMES, frames)}


def carried_in(frames, views):
    """Return what the cameras have seen set down."""
    return carried_by({name: set_down(one, views[name].points) for name, one
                       in zip(NAMES, frames)}, dict.fromkeys(NAMES, MODEL))


def registered(views, carried, measured=None, others=()):
    """Register both cameras to a scan; the second one begins 30 cm aside along its wall."""
    scan = ScanSurfaces(Scene(sample_surfaces(hall(), 9000, np.random.default_rng(0))))
    unknown = Certainty(np.eye(3), np.ones(3), np.eye(3), np.ones(3))
    starts = TRUE[0], Pose(TRUE[1].position + [0.3, 0.0, 0.0], TRUE[1].rotation)
    alone = {name: Registration(pose, 0.0, 0.9, 0.0, unknown, 0.0, 0.0, '', others=others)
             for name, pose in zip(NAMES, starts)}
    return register_together(scan, {name: (view, MODEL) for name, view in views.items()}, alone,
                             measured, carried)['wall']


def test_a_box_holds_a_camera_along_a_bare_wall(frames, views):
    without = registered(views, {})
    assert '--box' in without.refused and abs(without.pose.position[0] - TRUE[1].position[0]) > 0.1
    found = registered(views, carried_in(frames, views))
    row = row_of(found, TRUE[1])
    along = int(np.abs(found.certainty.slide_axes[:, 0]).argmax())
    assert not found.refused and not found.note and abs(row['normalised'][along]) < 2.6
    assert abs(found.pose.position[0] - TRUE[1].position[0]) < 0.015
    assert found.certainty.held_by[along]['corner'] > 0.5
    # A doubt that the scan alone leaves is not forgotten.
    doubted = registered(views, carried_in(frames, views), others=(TRUE[1],))
    assert not doubted.refused and 'another pose fits as well' in doubted.note
    # The same without a scan.
    assert any(one.refused for one in register_mutually(views)[0].values()) or len(
        register_mutually(views)[0]) < 2
    both, reasons = register_mutually(views, carried=carried_in(frames, views))
    assert not reasons and not any(one.refused for one in both.values())
    away, turn = relative_pose(both['wall'].pose, both['corner'].pose).away_from(
        relative_pose(TRUE[1], TRUE[0]))
    assert away < 0.02 and turn < np.deg2rad(0.7)


@pytest.mark.parametrize('wrong', [0.0, 0.1])
def test_a_distance_holds_a_camera_along_a_bare_wall_and_is_not_asked_for_again(views, wrong):
    true = float(np.linalg.norm(TRUE[0].position - TRUE[1].position))
    found = registered(views, {}, {NAMES: true + wrong})
    assert '--distance' not in found.refused
    assert abs(found.pose.position[0] - TRUE[1].position[0] - wrong) < 0.02


def test_frames_of_different_moments_and_what_moves_hold_nothing(frames, views):
    first, second = frames
    # The second camera saw the box where it stood one place later.
    found = registered(views, carried_in([first, [*second[:4], *second[6:], *second[4:6]]], views))
    assert found.refused
    # A person walks about, and the second camera is late.
    rays, rng = MeshRays(mesh_of(hall())), np.random.default_rng(1)
    walking = [cast(rays, pose, SENSOR, 8, 1, rng) for pose in TRUE]
    assert not any(set_down(one, views[name].points) for name, one in zip(NAMES, walking))
    assert carried_in(walking, views) == {}


def test_frames_at_nearly_the_same_time_are_of_one_moment():
    known = [1_000_000_000, 2_000_000_000]
    assert moments_of([1_200_000_000, 5_000_000_000], known) == [1_000_000_000, 5_000_000_000]


def test_the_command_takes_a_box_and_says_if_there_is_none(frames, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, one in zip(NAMES, frames):
        Path(name).mkdir()
        for number, frame in enumerate(one):
            np.save(f'{name}/{number:02}.npy', (frame @ OPTICAL_TO_BODY).astype(np.float32))
    calibrate = 'calibrate', '--clouds', *NAMES, '--sensor', 'd455', '--box'
    assert [row['refused'] for row in printed(capsys, *calibrate)['cameras']] == ['', '']
    np.save('alone.npy', frames[0][0] @ OPTICAL_TO_BODY)
    assert 'two clouds' in refused(capsys, 'calibrate', '--clouds', 'alone.npy', '--box')
