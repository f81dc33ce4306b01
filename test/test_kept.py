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

"""The final placement of ``policy_node`` as a file."""

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.cli import main as cli
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import positions_to_msg
from ocp_ros.scenes.scene_files import save_scene
import pytest
from std_msgs.msg import Header

POSITIONS = np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9], [4.0, 5.0, 1.9]])
HEADINGS = np.deg2rad([[30.0, 10.0, 0.0], [-100.0, 20.0, 90.0], [40.0, 0.0, 0.0]])
RIG = """
cameras: [{sensor: realsense_d455}, {sensor: omnidirectional}]
fixed: [{sensor: realsense_d455, position: [4.0, 5.0, 1.9], yaw: 40}]
"""


@pytest.fixture
def played(probe, room):
    """Return what plays the only turn of an episode, and asks once more: it is over."""
    def play(**parameters):
        probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
        probe.start_policy(turns=1, **parameters)
        for stamp in (1, 2):
            probe.send_turn(stamp, room.points, positions_to_msg(POSITIONS, Header(), HEADINGS))
            probe.command(stamp)
        return probe.last(topics.PLACEMENT)
    return play


@pytest.mark.parametrize('name', ['new/placement.yaml', 'placement.json'])
def test_the_final_placement_is_a_file_that_can_be_judged(played, room, tmp_path, name):
    path = tmp_path / name
    played(max_range=3.0, placement_file=str(path))
    placement = load_placement(path)
    np.testing.assert_allclose(placement.poses[:, :3], POSITIONS)
    assert {placed.camera.model for placed in placement.cameras} == {CameraModel(max_range=3.0)}
    assert 'turns' in placement.created['final']
    save_scene(room, tmp_path / 'room.ply')
    assert cli.main(['score', str(tmp_path / 'room.ply'), str(path)]) == 0


def test_the_file_has_the_rig_and_how_its_cameras_are_turned(played, tmp_path):
    (tmp_path / 'rig.yaml').write_text(RIG)
    played(rig_file=str(tmp_path / 'rig.yaml'), placement_file=str(tmp_path / 'placement.yaml'))
    placement = load_placement(tmp_path / 'placement.yaml')
    assert [placed.mount for placed in placement.cameras] == ['plane', 'plane', 'fixed']
    np.testing.assert_allclose(placement.poses[0], [*POSITIONS[0], *HEADINGS[0]], atol=1e-4)
    assert placement.cameras[0].camera.model == SENSORS['realsense_d455'].model
    assert placement.rig.fixed_poses.shape == (1, 6)


def test_a_placement_that_cannot_be_written_is_published_all_the_same(played, tmp_path, capfd):
    (tmp_path / 'file').write_text('')
    placement = played(placement_file=str(tmp_path / 'file' / 'placement.yaml'))
    assert len(placement.poses) == 3
    assert str(tmp_path / 'file' / 'placement.yaml') in capfd.readouterr().err
