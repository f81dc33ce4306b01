# SPDX-License-Identifier: Apache-2.0
"""Place cameras in a room: ros2 launch ocp_ros demo.launch.py [room:=scan.ply] [cameras:=4]."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Start a simulated rig and a policy."""
    config = Path(get_package_share_directory('ocp_ros')) / 'config'
    return LaunchDescription([
        DeclareLaunchArgument('room', default_value='', description='scan; empty: generated room'),
        DeclareLaunchArgument('cameras', default_value='4', description='number of cameras'),
        DeclareLaunchArgument('model', default_value='default', description='weights'),
        Node(package='ocp_ros', executable='sim_node', output='screen', parameters=[
            str(config / 'sim.yaml'),
            {'scene.file': ParameterValue(LaunchConfiguration('room'), value_type=str),
             'rig.cameras': ParameterValue(LaunchConfiguration('cameras'), value_type=int)}]),
        Node(package='ocp_ros', executable='policy_node', output='screen', parameters=[
            str(config / 'policy.yaml'),
            {'model': ParameterValue(LaunchConfiguration('model'), value_type=str)}]),
    ])
