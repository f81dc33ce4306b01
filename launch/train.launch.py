# SPDX-License-Identifier: Apache-2.0
"""Train over ROS: ros2 launch ocp_ros train.launch.py [folder:=out/trainer] [seed:=1]."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Start a simulated rig, a policy that explores, and a trainer that publishes weights."""
    config = str(Path(get_package_share_directory('ocp_ros')) / 'config' / 'trainer.yaml')
    seed = ParameterValue(LaunchConfiguration('seed'), value_type=int)
    folder = ParameterValue(LaunchConfiguration('folder'), value_type=str)
    return LaunchDescription([
        DeclareLaunchArgument('seed', default_value='1', description='seed of the room'),
        DeclareLaunchArgument('folder', default_value='out/trainer', description='checkpoints'),
        Node(package='ocp_ros', executable='sim_node', output='screen',
             parameters=[config, {'scene.seed': seed}]),
        Node(package='ocp_ros', executable='policy_node', output='screen', parameters=[config]),
        Node(package='ocp_ros', executable='trainer_node', output='screen',
             parameters=[config, {'folder': folder}]),
    ])
