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

"""What is written in the frame of the scan leads back to it, in every file."""

import csv
import json

from conftest import made_room
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.scenes.scene_files import load_scene
import pytest
from scipy.spatial.transform import Rotation

PLACEMENT = """\
cameras:
  - {sensor: kinect_v2, position: [1.0, 2.0, 2.0], yaw: 80, pitch: 30}
  - {sensor: realsense_d455, position: [6.0, 2.5, 1.9], yaw: 120, pitch: 20}
engine: {preset: fast, error_rows: 32}
"""
READING = ('--scale', '0.001', '--up', 'y')


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write a room in millimetres, y up and far from the origin, and a placement of the map."""
    monkeypatch.chdir(tmp_path)
    points = made_room(8, 2000).points.astype(np.float64)
    points = 1000.0 * points[:, [0, 2, 1]] * [1, 1, -1] + [512_300_000.0, 0.0, -5_400_000_000.0]
    np.save('utm.npy', points)
    # The map's origin is whole hundreds of metres from that of the scan.
    scene = load_scene('utm.npy', scale=0.001, up='y')
    corner = scene.bounds[0]
    text = PLACEMENT
    for here in ('[1.0, 2.0, 2.0]', '[6.0, 2.5, 1.9]'):
        moved = np.round(np.array(json.loads(here)) + corner, 3).tolist()
        text = text.replace(here, json.dumps(moved))
    (tmp_path / 'cameras.yaml').write_text(text)
    return tmp_path, scene


def rows_in(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_files_for_people_are_in_the_frame_of_the_scan_and_files_for_programs_in_the_map(
        files, capsys):
    folder, scene = files
    assert main(['score', 'utm.npy', 'cameras.yaml', '--out', 'out', *READING]) == 0
    placement = load_placement(folder / 'out' / 'placement.yaml')
    row = rows_in(folder / 'out' / 'cameras.csv')[0]
    there = placement.cameras[0].position
    assert row['frame'] == 'map' and [float(row[axis]) for axis in 'xyz'] == pytest.approx(there)
    told = ', '.join(f'{value:.0f}' for value in scene.source.to_source(there))
    page = (folder / 'out' / 'installer.md').read_text()
    assert told in page and '0.001 m each' in page
    assert told in (folder / 'out' / 'report.html').read_text()
    matrix = np.array(placement.room['source_from_map'])
    np.testing.assert_allclose((matrix @ [*there, 1.0])[:3], scene.source.to_source(there))
    launch = (folder / 'out' / 'cameras.launch.py').read_text()
    assert "('map', 'scan'," in launch and "('map', 'camera_0'," in launch
    assert 'name="scan"' in (folder / 'out' / 'cameras.urdf.xacro').read_text()


def test_everything_but_placements_can_be_in_the_frame_of_the_scan(files, capsys):
    folder, scene = files
    assert main(['score', 'utm.npy', 'cameras.yaml', '--out', 'out', '--frame', 'source',
                 *READING]) == 0
    placement = load_placement(folder / 'out' / 'placement.yaml')
    for row, placed in zip(rows_in(folder / 'out' / 'cameras.csv'), placement.cameras):
        assert row['frame'] == 'scan'
        there = [float(row[axis]) for axis in 'xyz']
        np.testing.assert_allclose(scene.source.to_map(there), placed.position, atol=1e-5)
        angles = np.deg2rad([float(row[name]) for name in ('yaw', 'pitch', 'roll')])
        turned = scene.source.rotation @ rotation_matrix(*angles)
        np.testing.assert_allclose(turned, rotation_matrix(*np.deg2rad(placed.angles)), atol=1e-6)
    content = {}
    launch = (folder / 'out' / 'cameras.launch.py').read_text()
    exec(launch[launch.index('FRAMES'):launch.index('OPTIONS')], content)
    frames = {frame[1]: frame for frame in content['FRAMES']}
    # Transforms are in metres: a camera on the map and by way of the scan is in one place.
    turn = Rotation.from_euler('xyz', frames['map'][5:]).as_matrix()
    on_map = turn.T @ (np.array(frames['camera_0'][2:5]) - frames['map'][2:5])
    assert frames['camera_0'][0] == 'scan' == frames['map'][0]
    np.testing.assert_allclose(on_map, placement.cameras[0].position, atol=1e-5)


def test_pages_can_be_in_the_frame_of_the_map(files, capsys):
    folder, _ = files
    assert main(['score', 'utm.npy', 'cameras.yaml', '--out', 'out', '--frame', 'map',
                 *READING]) == 0
    x, y, z = load_placement(folder / 'out' / 'placement.yaml').cameras[0].position
    page = (folder / 'out' / 'installer.md').read_text()
    assert f'{x:.3f}, {y:.3f}, {z:.3f}' in page and 'frame of the map' in page
