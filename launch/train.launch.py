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

"""Train over ROS: ros2 launch ocp_ros train.launch.py [envs:=8] [folder:=DIR] [seed:=1]."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def make_pairs(context: LaunchContext) -> list[Node]:
    """Return simulated rigs, each with an exploring policy, in namespaces env_0, env_1, ..."""
    config = str(Path(get_package_share_directory('ocp_ros')) / 'config' / 'trainer.yaml')
    envs, seed = (int(LaunchConfiguration(name).perform(context)) for name in ('envs', 'seed'))
    nodes = []
    for number in range(envs):
        for name, parameters in (('sim_node', {'scene.seed': seed + number, 'seed': number}),
                                 ('policy_node', {'seed': number})):
            nodes.append(Node(package='ocp_ros', executable=name, namespace=f'env_{number}',
                              output='screen', parameters=[config, parameters],
                              remappings=[('/tf', 'tf'), ('/tf_static', 'tf_static')]))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Return the launch of a trainer and of ``envs`` pairs of a simulation and a policy."""
    config = str(Path(get_package_share_directory('ocp_ros')) / 'config' / 'trainer.yaml')
    folder = ParameterValue(LaunchConfiguration('folder'), value_type=str)
    return LaunchDescription([
        DeclareLaunchArgument('envs', default_value='1', description='pairs of sim and policy'),
        DeclareLaunchArgument('seed', default_value='1', description='seed of the first room'),
        DeclareLaunchArgument('folder', default_value='out/trainer', description='checkpoints'),
        Node(package='ocp_ros', executable='trainer_node', output='screen',
             parameters=[config, {'folder': folder}]),
        OpaqueFunction(function=make_pairs),
    ])
