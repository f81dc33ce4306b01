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

"""Place live cameras: ros2 launch ocp_ros live.launch.py clouds:=cam0/points,cam1/points."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

#: Launch argument, parameter, type and description. An argument that is not given keeps the value
#: of the parameter file.
ARGUMENTS = (
    ('clouds', 'cloud_topics', str, 'topics of the clouds, with commas between'),
    ('camera_frames', 'camera_frames', str, 'frames of the cameras whose poses are in tf'),
    ('rig_file', 'rig_file', str, 'YAML of docs/reference/rig.md'),
    ('manual', 'manual', bool, 'true: a person moves the cameras'),
    ('turns', 'turns', int, 'turns until the placement is final'),
    ('max_step', 'max_step', float, 'farthest a camera moves in one turn, metres'),
    ('max_range', 'max_range', float, 'effective range of the cameras without a rig file, metres'),
    ('use_sim_time', 'use_sim_time', bool, 'true: time comes from /clock, such as that of a bag'),
)
#: Transforms of a namespace stay in it: /tf and /tf_static of its nodes, and of RViz.
TF_IN_NAMESPACE = [('/tf', 'tf'), ('/tf_static', 'tf_static')]


def make_policy_node(context: LaunchContext) -> list[Node]:
    """Return a policy; launch arguments override its parameter file."""
    parameters = {parameter: ParameterValue(LaunchConfiguration(name), value_type=value_type)
                  for name, parameter, value_type, _ in ARGUMENTS
                  if LaunchConfiguration(name).perform(context)}
    return [Node(package='ocp_ros', executable='policy_node', output='screen',
                 namespace=LaunchConfiguration('namespace'), remappings=TF_IN_NAMESPACE,
                 parameters=[LaunchConfiguration('params_file'), parameters])]


def generate_launch_description() -> LaunchDescription:
    """Return the launch of a policy for live cameras and, if ``rviz`` is true, RViz."""
    config = Path(get_package_share_directory('ocp_ros')) / 'config'
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value=str(config / 'live.yaml'),
                              description='YAML of parameters'),
        DeclareLaunchArgument('namespace', default_value='', description='of the node'),
        *(DeclareLaunchArgument(
            name, default_value='', description=f'{description}; empty: as in params_file')
          for name, _, _, description in ARGUMENTS),
        DeclareLaunchArgument('rviz', default_value='false', description='start RViz as well'),
        # RViz comes first: if it is not installed, nothing has been started that would go on.
        Node(package='rviz2', executable='rviz2', arguments=['-d', str(config / 'ocp.rviz')],
             namespace=LaunchConfiguration('namespace'), remappings=TF_IN_NAMESPACE,
             condition=IfCondition(LaunchConfiguration('rviz'))),
        OpaqueFunction(function=make_policy_node),
    ])
