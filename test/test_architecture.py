# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The shape of the tree: who may import whom, and files that must agree."""

import ast
import re
import sys
import xml.etree.ElementTree as ElementTree

from conftest import ROOT

import ocp_ros

PACKAGE = ROOT / 'ocp_ros'
#: Each layer may import itself, those before it and the modules that stand beside the layers.
LAYERS = ['util', 'geometry', 'scenes', 'rooms', 'rig', 'simulation', 'registration', 'online',
          'policy', 'search', 'planning', 'report', 'training', 'compare', 'ros', 'demo', 'cli']
BESIDE = {'__version__', 'api'}
#: Packages that only some layers may import at all.
ONLY = {
    'rclpy': {'ros', 'demo'}, 'tf2_ros': {'ros'}, 'sensor_msgs': {'ros', 'demo'},
    'geometry_msgs': {'ros', 'demo'}, 'rosbags': {'ros'},
    'stable_baselines3': {'training'}, 'torch': {'policy', 'training', 'ros'},
    'gymnasium': {'simulation', 'training'}, 'matplotlib': {'report'}, 'open3d': {'scenes'},
    'benchmarks': set()}


def imports(path):
    """Return the full names of all modules that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            found |= {node.module, *(f'{node.module}.{alias.name}' for alias in node.names)}
    return found


def modules():
    """Yield (layer, path, names of all imports) for every module that belongs to a layer."""
    for path in sorted(PACKAGE.rglob('*.py')):
        if path.parent != PACKAGE:
            yield path.relative_to(PACKAGE).parts[0], path, imports(path)


def test_the_data_flows_one_way():
    for layer, path, names in modules():
        allowed = set(LAYERS[:LAYERS.index(layer) + 1]) | BESIDE
        for top, *rest in (name.split('.') for name in names):
            wrong = f'{path}: {layer} must not import {".".join([top, *rest])}'
            assert top != 'ocp_ros' or not rest or rest[0] in allowed, wrong
            assert layer in ONLY.get(top, {layer}), wrong


def test_geometry_needs_numpy_and_numba_alone():
    for layer, path, names in modules():
        if layer == 'geometry':
            tops = {name.split('.')[0] for name in names}
            assert tops <= sys.stdlib_module_names | {'numpy', 'numba', 'ocp_ros'}, path


def test_the_version_is_the_same_everywhere():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    setup = (ROOT / 'setup.py').read_text()
    version = package.findtext('version')
    assert version == ocp_ros.__version__
    assert f"version='{version}'" in setup
    assert re.search(rf'^{re.escape(version)} \(', (ROOT / 'CHANGELOG.rst').read_text(), re.M)


def test_package_xml_lists_every_ros_package_that_nodes_import():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    listed = {item.text for item in package.iter('exec_depend')}
    ros = {'rclpy', 'launch', 'launch_ros', 'ament_index_python'}
    used = {name.split('.')[0] for path in [*PACKAGE.rglob('*.py'), *ROOT.glob('launch/*.py')]
            for name in imports(path)}
    assert {name for name in used if name in ros or name.endswith(('_msgs', '_interfaces'))
            or name == 'std_srvs'} <= listed
    assert package.find('export/build_type').text == 'ament_python'


def test_every_entry_point_exists():
    setup = (ROOT / 'setup.py').read_text()
    for module, function in re.findall(r"= (ocp_ros[\w.]+):(\w+)'", setup):
        path = ROOT / (module.replace('.', '/') + '.py')
        names = {node.name for node in ast.parse(path.read_text()).body
                 if isinstance(node, ast.FunctionDef)}
        assert function in names, module


def test_every_source_file_names_its_license():
    for path in [*PACKAGE.rglob('*.py'), *ROOT.glob('benchmarks/**/*.py'),
                 *ROOT.glob('test/*.py'), *ROOT.glob('launch/*.py')]:
        lines = path.read_text().splitlines()[:2]
        assert lines[0].startswith('# Copyright '), path
        assert lines[1] == '# SPDX-License-Identifier: Apache-2.0', path
