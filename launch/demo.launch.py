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

"""Place cameras in a room: ros2 launch ocp_ros demo.launch.py [room:=scan.ply] [cameras:=4]."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

#: Launch argument, node, parameter, type, and description (empty for an argument's second node).
#: An argument that is not given keeps the value of the parameter files.
ARGUMENTS = (
    ('room', 'sim_node', 'scene.file', str, 'scan or mesh; empty: generated room'),
    ('cameras', 'sim_node', 'rig.cameras', int, 'number of cameras'),
    ('rig_file', 'sim_node', 'rig_file', str, 'YAML of docs/reference/rig.md'),
    ('rig_file', 'policy_node', 'rig_file', str, ''),
    ('planner', 'policy_node', 'planner', str, 'learned or lookahead'),
    ('model', 'policy_node', 'model', str, 'weights; lookahead reads none'),
    ('use_sim_time', 'sim_node', 'use_sim_time', bool, 'true: time comes from /clock'),
    ('use_sim_time', 'policy_node', 'use_sim_time', bool, ''),
)
#: Transforms of a namespace stay in it: /tf and /tf_static of its nodes, and of RViz.
TF_IN_NAMESPACE = [('/tf', 'tf'), ('/tf_static', 'tf_static')]


def make_nodes(context: LaunchContext) -> list[Node]:
    """Return a simulated rig and a policy; launch arguments override their parameter files."""
    config = Path(get_package_share_directory('ocp_ros')) / 'config'
    return [Node(package='ocp_ros', executable=executable, output='screen',
                 namespace=LaunchConfiguration('namespace'), remappings=TF_IN_NAMESPACE,
                 parameters=[str(config / file), {
                     parameter: ParameterValue(LaunchConfiguration(name), value_type=value_type)
                     for name, node, parameter, value_type, _ in ARGUMENTS
                     if node == executable and LaunchConfiguration(name).perform(context)}])
            for executable, file in (('sim_node', 'sim.yaml'), ('policy_node', 'policy.yaml'))]


def generate_launch_description() -> LaunchDescription:
    """Return the launch of a simulated rig, a policy and, if ``rviz`` is true, RViz."""
    config = Path(get_package_share_directory('ocp_ros')) / 'config'
    return LaunchDescription([
        DeclareLaunchArgument('namespace', default_value='', description='of the nodes'),
        *(DeclareLaunchArgument(
            name, default_value='', description=f'{description}; empty: as in the files in config')
          for name, _, _, _, description in ARGUMENTS if description),
        DeclareLaunchArgument('rviz', default_value='false', description='start RViz as well'),
        # RViz comes first: if it is not installed, nothing has been started that would go on.
        Node(package='rviz2', executable='rviz2', arguments=['-d', str(config / 'ocp.rviz')],
             namespace=LaunchConfiguration('namespace'), remappings=TF_IN_NAMESPACE,
             condition=IfCondition(LaunchConfiguration('rviz'))),
        OpaqueFunction(function=make_nodes),
    ])
