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

"""Models and configuration are found wherever the package is installed."""

import importlib.util
from pathlib import Path
import shutil

from conftest import refused, ROOT
from ocp_ros.util import resources
from ocp_ros.util.resources import find_config, find_model, share_folder
import pytest

#: Where installers put the package, and its other files, below some prefix.
LAYOUTS = {
    'the source tree': ('', ''),
    'a virtual environment': ('lib/python3.12/site-packages', 'share/ocp_ros'),
    'pip --target': ('vendor', 'vendor/share/ocp_ros'),
    'Windows': ('Lib/site-packages', 'share/ocp_ros'),
    'colcon': ('install/ocp_ros/lib/python3.12/site-packages', 'install/ocp_ros/share/ocp_ros')}


@pytest.fixture(autouse=True)
def no_index(monkeypatch):
    """Find nothing through the index of ROS."""
    monkeypatch.delenv('AMENT_PREFIX_PATH', raising=False)


def installed(prefix, code, share):
    """Put the module, and what marks the files, where an installer does; return both."""
    module = prefix / code / 'ocp_ros' / 'util' / 'resources.py'
    module.parent.mkdir(parents=True)
    shutil.copy(resources.__file__, module)
    for name in ('config/fastdds_local.xml', 'models/actor.safetensors'):
        path = prefix / share / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return loaded(module), prefix / share


def loaded(module):
    """Import the module as it lies there."""
    spec = importlib.util.spec_from_file_location('moved_resources', module)
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


@pytest.mark.parametrize('layout', LAYOUTS)
def test_files_are_found_in_every_layout(tmp_path, layout):
    module, share = installed(tmp_path, *LAYOUTS[layout])
    assert module.share_folder() == share


def test_links_to_files_elsewhere_are_those_of_the_prefix(tmp_path):
    _, share = installed(tmp_path, *LAYOUTS['a virtual environment'])
    package, cache = tmp_path / LAYOUTS['a virtual environment'][0] / 'ocp_ros', tmp_path / 'cache'
    package.rename(cache)
    package.symlink_to(cache)
    assert loaded(package / 'util' / 'resources.py').share_folder() == share


def test_a_link_to_the_source_tree_has_the_files_of_that_tree(tmp_path):
    # As colcon build --symlink-install has it.
    (tmp_path / 'ocp_ros').symlink_to(ROOT / 'ocp_ros')
    assert loaded(tmp_path / 'ocp_ros' / 'util' / 'resources.py').share_folder() == ROOT


def test_the_index_of_ros_is_asked_last(tmp_path, monkeypatch):
    pytest.importorskip('ament_index_python', reason='the index needs ROS 2')
    module, share = installed(tmp_path / 'here', 'code', 'elsewhere/share/ocp_ros')
    prefix = tmp_path / 'here' / 'elsewhere'
    marker = prefix / 'share/ament_index/resource_index/packages/ocp_ros'
    marker.parent.mkdir(parents=True)
    marker.touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(prefix))
    assert module.share_folder() == share
    # What runs from a source tree takes the files of that tree.
    assert share_folder() == ROOT


def test_a_package_that_is_not_whole_says_so(tmp_path):
    module, share = installed(tmp_path, *LAYOUTS['pip --target'])
    shutil.rmtree(share)
    with pytest.raises(FileNotFoundError, match='share/ocp_ros'):
        module.share_folder()


def test_shipped_files_are_found_from_every_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shipped = Path('config', 'rig', 'four_d455.yaml')
    assert find_config(shipped) == ROOT / shipped
    assert find_config('none.yaml') == Path('none.yaml')
    assert find_model('actor') == ROOT / 'models' / 'actor.safetensors'
    # The rig file is read, and then the room is missed.
    assert 'none.ply' in refused(capsys, 'plan', 'none.ply', '--rig', shipped)
    # One's own comes first.
    shipped.parent.mkdir(parents=True)
    shipped.write_text('cameras: none')
    assert find_config(shipped) == shipped
