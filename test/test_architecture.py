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

"""The shape of the tree: who may import whom, and files that must agree."""

import ast
from functools import cache
import re
import sys
import xml.etree.ElementTree as ElementTree

from conftest import ROOT
import ocp_ros
from ocp_ros.util.settings import ConfigurationError, EXTRAS, need
import pytest
import yaml

PACKAGE = ROOT / 'ocp_ros'
#: Each layer may import itself, those before it and the modules that stand beside the layers.
LAYERS = ['util', 'geometry', 'scenes', 'rooms', 'rig', 'simulation', 'registration', 'online',
          'policy', 'search', 'report', 'formats', 'studio', 'training', 'compare', 'ros', 'demo',
          'cli']
BESIDE = {'__version__', 'api'}
#: Packages that only some layers may import at all.
ONLY = {
    'rclpy': {'ros', 'demo'}, 'tf2_ros': {'ros'},
    'sensor_msgs': {'ros', 'demo'}, 'geometry_msgs': {'ros', 'demo'}, 'rosbags': {'ros'},
    'stable_baselines3': {'training'}, 'torch': {'policy', 'training', 'ros'},
    'gymnasium': {'simulation', 'training'}, 'matplotlib': {'report'}, 'open3d': {'scenes'},
    'viser': {'studio'}, 'websockets': {'studio'}, 'benchmarks': set()}


@cache
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


def test_the_data_flows_one_way_and_geometry_needs_numpy_and_numba_alone():
    for layer, path, names in modules():
        allowed = set(LAYERS[:LAYERS.index(layer) + 1]) | BESIDE
        for top, *rest in (name.split('.') for name in names):
            wrong = f'{path}: {layer} must not import {".".join([top, *rest])}'
            assert top != 'ocp_ros' or not rest or rest[0] in allowed, wrong
            assert layer in ONLY.get(top, {layer}), wrong
            known = sys.stdlib_module_names | {'numpy', 'numba', 'ocp_ros'}
            assert layer != 'geometry' or top in known, wrong


def test_every_source_file_names_its_license_as_ament_copyright_reads_it():
    year, license_text = (ROOT / 'setup.py').read_text().split('\n#\n', 1)
    header = license_text.split('\n\n')[0]
    assert re.fullmatch(r'# Copyright \d{4} The ocp_ros authors', year)
    assert header.startswith('# Licensed under the Apache License, Version 2.0')
    for folder in ('ocp_ros', 'test', 'launch', 'benchmarks'):
        for path in (ROOT / folder).rglob('*.py'):
            assert path.read_text().startswith(f'{year}\n#\n{header}\n\n'), path


def test_the_version_is_the_same_everywhere():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    setup = (ROOT / 'setup.py').read_text()
    version = package.findtext('version')
    assert version == ocp_ros.__version__
    assert f"version='{version}'" in setup
    assert yaml.safe_load((ROOT / 'CITATION.cff').read_text())['version'] == version
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


def setup_arguments():
    """Return the keyword arguments of ``setup`` that are plain data."""
    (call,) = (node for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text()))
               if isinstance(node, ast.Call) and getattr(node.func, 'id', '') == 'setup')
    return {item.arg: ast.literal_eval(item.value) for item in call.keywords
            if item.arg in ('install_requires', 'extras_require')}


def test_all_that_nodes_need_are_packages_of_ubuntu():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    listed = {item.text for kind in ('exec_depend', 'test_depend') for item in package.iter(kind)}
    known = yaml.safe_load((ROOT / 'requirements' / 'rosdep.yaml').read_text())
    # Whoever adds a key looks it up, see the head of that file.
    assert listed == known.keys()
    assert {key for key in listed if key.endswith('-pip')} == set()
    needed = {re.split('[<>=]', name)[0] for name in setup_arguments()['install_requires']}
    names = {'pillow': 'pil', 'pyyaml': 'yaml'}
    assert {f'python3-{names.get(name, name)}' for name in needed - {'setuptools'}} <= listed


def test_an_extra_is_named_for_every_package_that_is_missing(monkeypatch):
    extras = setup_arguments()['extras_require']
    for extra, packages in EXTRAS.items():
        # The package of usd-core is pxr.
        installed = ' '.join(extras[extra]).replace('-', '_').replace('usd_core', 'pxr')
        for package in packages:
            assert re.search(rf'\b{package}\b', installed), package
            monkeypatch.setitem(sys.modules, package, None)
            with pytest.raises(ConfigurationError, match=rf'no package {package}.*\[{extra}]'):
                need('ocp plan', package)
    need('ocp plan', 'numpy')


def test_every_entry_point_exists():
    setup = (ROOT / 'setup.py').read_text()
    for module, function in re.findall(r"= (ocp_ros[\w.]+):(\w+)'", setup):
        path = ROOT / (module.replace('.', '/') + '.py')
        names = {node.name for node in ast.parse(path.read_text()).body
                 if isinstance(node, ast.FunctionDef)}
        assert function in names, module
