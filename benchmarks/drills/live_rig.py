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

"""Cameras in a simulated room that behave as real ones do, for tests of live turns."""

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

S = 1_000_000_000
CAMERAS = 3
HEADINGS = np.array([[0.4, 0.1, 0.0], [-2.0, -0.2, 0.1], [3.0, 0.0, -0.3]])
#: Frames that clouds come in.
BODY, OPTICAL, MAP = 'camera_{}', 'camera_{}_optical', 'map'
#: What a driver has to say where it sees nothing.
NO_RETURN = np.array([[0.0, 0.0, 0.0], [np.nan, 1.0, 1.0], [9.0, 0.0, 0.0]])


class Rig(Node):
    """
    Cameras in a simulated room: they send what they see and where they are, and go where told.

    :param episode: its cameras are turned as ``HEADINGS`` have it.
    :param frames: of the cameras' clouds.
    :param period: seconds between two messages of each kind.
    """

    def __init__(self, episode, frames, period=0.02, **kwargs):
        super().__init__('rig', **kwargs)
        self.episode, self.frames = episode, [f.format(k) for k, f in enumerate(frames)]
        self.stamp, self.obeys, self.silent, self.tells = 1000 * S, True, set(), True
        self.headings = HEADINGS
        self._period = period
        #: Metres: standard deviation of what is said of where the cameras are.
        self.noise, self.rng = 0.0, np.random.default_rng(3)
        #: (3,) metres: constant error of what is said of where the cameras are.
        self.offset = np.zeros(3)
        self.spoil = {}
        self.commands, self.target = [], None
        self._poses = self.create_publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
        # Drivers come with any profile.
        self._clouds = [self.create_publisher(
            PointCloud2, f'points_{k}', (qos.LOOP, qos.SENSOR, qos.LATCHED)[k])
            for k in range(len(frames))]
        self.create_subscription(PoseArray, topics.CAMERA_COMMANDS, self._on_command, qos.LOOP)
        self.create_timer(period, self.send)

    @property
    def positions(self):
        """Return where the cameras are."""
        return self.episode.turn.positions

    @property
    def turns(self):
        """Return how many turns have been commanded; a command may come again."""
        return len({stamp_to_ns(message.header.stamp) for message in self.commands})

    def _on_command(self, message):
        """Go where the cameras shall go, unless somebody else moves them."""
        self.commands.append(message)
        self.target = msg_to_positions(message)
        if self.obeys:
            self.go()

    def go(self):
        """Carry out the latest command."""
        self.episode.move((self.target - self.positions)[:, :2])
        self.send()

    def send(self):
        """Send where the cameras are and what they see."""
        self.stamp += int(self._period * S)
        header = Header(stamp=ns_to_stamp(self.stamp), frame_id='map')
        measured = self.positions + self.offset + self.rng.normal(
            0.0, self.noise, self.positions.shape)
        headings = self.headings + self.rng.normal(0.0, 0.3 * self.noise, self.headings.shape)
        if self.tells:
            self._poses.publish(positions_to_msg(measured, header, headings))
        for camera in set(range(len(self.frames))) - self.silent:
            message = self.cloud(camera)
            self.spoil.get(camera, lambda message: None)(message)
            self._clouds[camera].publish(message)

    def cloud(self, camera):
        """Return what a camera sees, in its frame."""
        simulator = self.episode.simulator
        pose = np.append(self.positions[camera], self.headings[camera])
        seen = simulator.look(pose, camera).seen
        points = simulator.scene.points[Subset(seen, simulator.visibility.order).mask]
        header = Header(stamp=ns_to_stamp(self.stamp), frame_id=self.frames[camera])
        if self.frames[camera] == MAP:
            return cloud_to_msg(points, header)
        points = (points - pose[:3]) @ rotation_matrix(*pose[3:])
        points = np.concatenate([points, NO_RETURN])
        if self.frames[camera].endswith('optical'):
            points = np.stack([-points[:, 1], -points[:, 2], points[:, 0]], axis=1)
        return cloud_to_msg(points, header)


def episode_in(room):
    """Return where the cameras of a rig are in a room."""
    config = SimulationConfig(rig=RigConfig(cameras=CAMERAS), engine=EngineConfig(
        preset='fast', error_rows=32, coverage_cell=0.5))
    return Episode(PlaneProblem(Simulator(room, config)), np.random.default_rng(0))
