# SPDX-License-Identifier: Apache-2.0
"""Launch files describe what they say, where ROS's launch system is installed."""

import importlib.util
import re

from conftest import ROOT
import pytest


@pytest.mark.parametrize(('name', 'given', 'nodes'), [
    ('demo', {}, 2), ('train', {}, 3), ('train', {'envs': '8'}, 17), ('live', {}, 2)])
def test_a_launch_file_starts_its_nodes(name, given, nodes, monkeypatch):
    pytest.importorskip('launch_ros', reason='launch files need ROS 2 from apt (launch_ros)')
    from launch import LaunchContext
    from launch.actions import OpaqueFunction
    from launch_ros.actions import Node
    monkeypatch.setattr('ament_index_python.packages.get_package_share_directory',
                        lambda package: str(ROOT))
    path = ROOT / 'launch' / f'{name}.launch.py'
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    context, started = LaunchContext(), []
    context.launch_configurations.update(given)
    for entity in module.generate_launch_description().entities:
        if isinstance(entity, Node):
            started.append(entity)
        elif isinstance(entity, OpaqueFunction):
            started += entity.execute(context)
        else:
            entity.visit(context)
    assert len(started) == nodes and all(isinstance(node, Node) for node in started)


def test_the_arguments_for_live_cameras_are_parameters():
    from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
    from ocp_ros.util.settings import leaves
    text = (ROOT / 'launch' / 'live.launch.py').read_text()
    found = re.findall(r"^    \('\w+', '(\w+)', (\w+), ", text, re.M)
    assert len(found) == 5
    for name, kind in found:
        assert leaves(PolicyNodeConfig)[name].type.__name__ == kind
