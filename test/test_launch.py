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

"""Launch files describe what they say, where ROS's launch system is installed."""

import importlib.util
import re

from conftest import ROOT
import launch_stand_in
import pytest


def description_of(name):
    """Return the launch description of a launch file."""
    spec = importlib.util.spec_from_file_location(name, ROOT / 'launch' / f'{name}.launch.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


@pytest.mark.parametrize(('name', 'given', 'nodes'), [
    ('demo', {}, 3), ('train', {}, 3), ('train', {'envs': '8'}, 17), ('live', {}, 2)])
def test_a_launch_file_starts_its_nodes(name, given, nodes, monkeypatch):
    pytest.importorskip('launch_ros', reason='launch files need ROS 2 from apt (launch_ros)')
    from launch import LaunchContext
    from launch.actions import OpaqueFunction
    from launch_ros.actions import Node
    monkeypatch.setattr('ament_index_python.packages.get_package_share_directory',
                        lambda package: str(ROOT))
    context, started = LaunchContext(), []
    context.launch_configurations.update(given)
    for entity in description_of(name).entities:
        if isinstance(entity, Node):
            started.append(entity)
        elif isinstance(entity, OpaqueFunction):
            started += entity.execute(context)
        else:
            entity.visit(context)
    assert len(started) == nodes and all(isinstance(node, Node) for node in started)


@pytest.fixture
def launched(monkeypatch):
    """Return what executes a launch file by a stand-in for ROS's launch system."""
    launch_stand_in.install(monkeypatch)
    return lambda name, **given: launch_stand_in.started(description_of(name), **given)


def test_what_is_not_given_is_as_the_parameter_file_has_it(launched):
    assert launched('live') == [('policy_node', '', [str(ROOT / 'config' / 'live.yaml'), {}])]
    [(_, namespace, parameters)] = launched(
        'live', params_file='mine.yaml', namespace='rig_a', turns='12', max_range='6.0',
        manual='true', use_sim_time='true')
    assert namespace == 'rig_a' and parameters == [
        'mine.yaml', {'turns': 12, 'max_range': 6.0, 'manual': True, 'use_sim_time': True}]
    assert [node for node, _, _ in launched('live', rviz='true')] == ['rviz2', 'policy_node']
    nodes = launched('train', envs='3', seed='5')
    assert [node for node, _, _ in nodes].count('sim_node') == 3 and len(nodes) == 7
    assert {namespace for _, namespace, _ in nodes} == {None, 'env_0', 'env_1', 'env_2'}
    assert [entries[-1]['scene.seed'] for node, _, entries in nodes
            if node == 'sim_node'] == [5, 6, 7]


def test_the_demo_runs_the_planner_that_is_named(launched):
    (sim, _, of_sim), (policy, _, of_policy) = launched(
        'demo', planner='lookahead', model='map', cameras='3', room='scan.ply')
    assert (sim, policy) == ('sim_node', 'policy_node')
    assert of_sim[-1] == {'scene.file': 'scan.ply', 'rig.cameras': 3}
    assert of_policy[-1] == {'planner': 'lookahead', 'model': 'map'}
    for _, namespace, parameters in launched('demo', namespace='cell', rig_file='rig.yaml',
                                             use_sim_time='true'):
        assert namespace == 'cell'
        assert parameters[-1] == {'rig_file': 'rig.yaml', 'use_sim_time': True}
    assert [node for node, _, _ in launched('demo', rviz='true')] == [
        'rviz2', 'sim_node', 'policy_node']


def test_the_arguments_for_live_cameras_are_parameters():
    from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
    from ocp_ros.util.settings import leaves
    text = (ROOT / 'launch' / 'live.launch.py').read_text()
    found = dict(re.findall(r"^    \('\w+', '(\w+)', (\w+), ", text, re.M))
    # Which clock is read is a parameter of every node.
    assert found.pop('use_sim_time') == 'bool' and len(found) == 6
    for name, kind in found.items():
        assert leaves(PolicyNodeConfig)[name].type.__name__ == kind
