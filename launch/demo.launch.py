# Copyright 2026 The ocp_ros authors
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
        DeclareLaunchArgument('planner', default_value='learned_lookahead',
                              description='learned, lookahead or learned_lookahead'),
        DeclareLaunchArgument('model', default_value='map',
                              description='weights; lookahead reads none'),
        Node(package='ocp_ros', executable='sim_node', output='screen', parameters=[
            str(config / 'sim.yaml'),
            {'scene.file': ParameterValue(LaunchConfiguration('room'), value_type=str),
             'rig.cameras': ParameterValue(LaunchConfiguration('cameras'), value_type=int)}]),
        Node(package='ocp_ros', executable='policy_node', output='screen', parameters=[
            str(config / 'policy.yaml'),
            {name: ParameterValue(LaunchConfiguration(name), value_type=str)
             for name in ('planner', 'model')}]),
    ])
