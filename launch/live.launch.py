# SPDX-License-Identifier: Apache-2.0
"""Place live cameras: ros2 launch ocp_ros live.launch.py clouds:=cam0/points,cam1/points."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

#: Argument, parameter, type, default and description.
ARGUMENTS = (
    ('clouds', 'cloud_topics', str, 'cam0/points,cam1/points,cam2/points',
     'topics of the clouds, with commas between'),
    ('rig_file', 'rig_file', str, '', 'YAML of docs/rig.md; empty: no constraints'),
    ('manual', 'manual', bool, 'false', 'a person moves the cameras'),
    ('turns', 'turns', int, '30', 'turns until the placement is final'),
    ('max_step', 'max_step', float, '0.5', 'farthest a camera moves in one turn, metres'),
)


def generate_launch_description() -> LaunchDescription:
    """Start a policy for live cameras and, where it is wanted, RViz."""
    config = Path(get_package_share_directory('ocp_ros')) / 'config'
    parameters = {parameter: ParameterValue(LaunchConfiguration(name), value_type=kind)
                  for name, parameter, kind, _, _ in ARGUMENTS}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=description)
          for name, _, _, default, description in ARGUMENTS),
        DeclareLaunchArgument('rviz', default_value='false', description='start RViz as well'),
        Node(package='ocp_ros', executable='policy_node', output='screen',
             parameters=[str(config / 'live.yaml'), parameters]),
        Node(package='rviz2', executable='rviz2', arguments=['-d', str(config / 'ocp.rviz')],
             condition=IfCondition(LaunchConfiguration('rviz'))),
    ])
