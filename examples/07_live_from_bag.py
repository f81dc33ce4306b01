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

"""Live from a bag: policy_node reads recorded clouds and publishes target poses of the cameras."""

import subprocess
import sys

from geometry_msgs.msg import PoseArray
import ocp_ros
from ocp_ros.ros.interface.conversions import cloud_to_msg, ns_to_stamp
import rclpy
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from std_msgs.msg import Header

# What two omnidirectional cameras see, for four seconds. You have a bag of your own.
PLACES = [[1.5, 2.0, 1.9], [3.5, 4.5, 1.9]]
room = ocp_ros.generate_room(11, 5000)
simulator = ocp_ros.Simulator(room, ocp_ros.SimulationConfig())
with Writer('recorded', version=9, storage_plugin=StoragePlugin.MCAP) as bag:
    for number, place in enumerate(PLACES):
        topic = bag.add_connection(f'/cam{number}/points', 'sensor_msgs/msg/PointCloud2',
                                   typestore=get_typestore(Stores.ROS2_JAZZY))
        cloud = room.points[simulator.evaluate([place]).visible]
        for time in range(10**12, 10**12 + 4 * 10**9, 10**9 // 2):
            message = cloud_to_msg(cloud, Header(frame_id='map', stamp=ns_to_stamp(time)))
            bag.write(topic, time, serialize_message(message))

rclpy.init()
listener = rclpy.create_node('listener')
listener.create_subscription(PoseArray, 'camera_commands', lambda commands: print(
    'targets:', [pose.position for pose in commands.poses]), 10)

# A recorded camera follows no command: after 0.5 s the next turn begins.
live = 'cloud_topics:=/cam0/points,/cam1/points planner:=lookahead turns:=3 arrival_timeout:=0.5'
node = subprocess.Popen([sys.executable, '-m', 'ocp_ros.ros.policy_node', '--ros-args', *[
    word for parameter in live.split() for word in ('-p', parameter)]])
replay = subprocess.Popen([sys.executable, '-m', 'ocp_ros.cli.main', 'replay', 'recorded', *[
    f'--pose={x},{y},{z}' for x, y, z in PLACES]])
while replay.poll() is None:
    rclpy.spin_once(listener, timeout_sec=0.1)
node.terminate()
node.wait()
