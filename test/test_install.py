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

"""The installed wheel works from every folder, and launch files describe what they say."""

from collections import namedtuple
from functools import partial
import importlib.util
import os
from pathlib import Path
import re
import shutil
import signal
import site
import subprocess
import sys
import tarfile
from types import ModuleType, SimpleNamespace

from conftest import HUNG, ROOT, wait_until
import pytest

#: What stands beside the sources of somebody who works on them, and is no part of them.
LEFT_OUT = shutil.ignore_patterns(
    '.git', '.venv*', '.hypothesis', '.*_cache', '__pycache__', 'build', 'install', 'log', 'out',
    '*.egg-info')
#: What a node says once it is there and has found which interfaces are this machine's.
READY = 'nodes of this machine are heard, and no others'


def call(*command, **options):
    """Run a command that has to end well; return what it printed."""
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=HUNG,
                          check=False, **options)
    assert done.returncode == 0, f'{command}: {done.stdout}{done.stderr}'
    return done.stdout


@pytest.fixture(scope='module')
def built(tmp_path_factory):
    """Return a folder with the wheel and the archive of the sources."""
    place = tmp_path_factory.mktemp('built')
    shutil.copytree(ROOT, place / 'src', ignore=LEFT_OUT)
    call(sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '--no-build-isolation',
         '--no-index', '--wheel-dir', place, place / 'src')
    call(sys.executable, 'setup.py', '--quiet', 'sdist', '--dist-dir', place, cwd=place / 'src')
    return place


@pytest.fixture(scope='module')
def installed(built, tmp_path_factory):
    """Return the folder of a virtual environment with the wheel, and a way to run things there."""
    place = tmp_path_factory.mktemp('env')
    call(sys.executable, '-m', 'venv', '--without-pip', place)
    (packages,) = place.glob('lib/python3*/site-packages')
    # The libraries are those that are installed here: nothing is downloaded.
    lines = [f'import site; site.addsitedir({folder!r})' for folder in site.getsitepackages()]
    (packages / 'libraries.pth').write_text('\n'.join(lines) + '\n')
    (wheel,) = built.glob('*.whl')
    call(sys.executable, '-m', 'pip', '--python', place / 'bin' / 'python', 'install', '--quiet',
         '--no-deps', '--no-index', '--ignore-installed', wheel)
    return place


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Go to an empty folder, and let nothing lead to the source tree."""
    monkeypatch.chdir(tmp_path)
    for name in ('PYTHONPATH', 'AMENT_PREFIX_PATH', 'FASTRTPS_DEFAULT_PROFILES_FILE',
                 'ROS_AUTOMATIC_DISCOVERY_RANGE'):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.mark.system
def test_commands_of_the_wheel_find_what_comes_with_it(installed, elsewhere):
    code = call(installed / 'bin' / 'python', '-c', 'import ocp_ros; print(ocp_ros.__file__)')
    assert Path(code.strip()).is_relative_to(installed)
    ocp = installed / 'bin' / 'ocp'
    call(ocp, 'plan', '7', '--planner', 'learned', '--cameras', '2', '--seconds', '1',
         '--out', 'plan')
    assert (elsewhere / 'plan' / 'placement.yaml').is_file()
    call(ocp, 'plan', '7', '--rig', 'config/rig/four_d455.yaml', '--evaluations', '20')
    call(ocp, 'rooms', '1', '--out', 'rooms')
    room = elsewhere / 'rooms' / 'room-1.ply'
    call(ocp, 'benchmark', '--rooms', room, '--cameras', '2', '--planners', 'learned',
         '--workers', '1', '--seeds', '1')
    # The settings are found; what is wrong is the folder.
    done = subprocess.run([ocp, 'train', '--config', 'config/train/paper.yaml', '--out', room],
                          capture_output=True, text=True, timeout=HUNG, check=False)
    assert done.returncode == 2 and 'it is a file' in done.stderr


@pytest.mark.system
@pytest.mark.parametrize(('name', 'how'), [
    ('sim_node', signal.SIGINT), ('policy_node', signal.SIGTERM), ('trainer_node', signal.SIGHUP)])
def test_nodes_of_the_wheel_play_and_end(installed, elsewhere, domain, name, how):
    environment = {key: value for key, value in os.environ.items()
                   if not key.startswith(('FASTRTPS', 'ROS_AUTOMATIC'))}
    log = elsewhere / 'log'
    with open(log, 'wb') as file:
        # Tests that nohup has started ignore SIGHUP, and would pass that on.
        node = subprocess.Popen(
            [installed / 'bin' / name], stdout=file, stderr=subprocess.STDOUT,
            preexec_fn=partial(signal.signal, signal.SIGHUP, signal.SIG_DFL),
            env={**environment, 'ROS_DOMAIN_ID': str(domain), 'PYTHONUNBUFFERED': '1'})
    try:
        wait_until(lambda: READY in log.read_text() or node.poll() is not None)
        assert node.poll() is None, log.read_text()
        node.send_signal(how)
        assert node.wait(timeout=HUNG) == 0, log.read_text()
        assert 'Traceback' not in log.read_text()
    finally:
        node.kill()
        node.wait()


ALONE = """
import sys
from ocp_ros.util.settings import EXTRAS
sys.modules.update(dict.fromkeys([*sum(EXTRAS.values(), ()), 'safetensors']))
import rclpy
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
from rclpy.parameter import Parameter
rclpy.init()
nodes = [SimNode(parameter_overrides=[Parameter('scene.points', value=2000)]), PolicyNode()]
executor = rclpy.executors.SingleThreadedExecutor()
for node in nodes:
    executor.add_node(node)
while nodes[1].convergence.step < 2:
    executor.spin_once(timeout_sec=0.1)
from ocp_ros.ros import start
start.guide_node()
"""


def test_nodes_play_with_nothing_but_packages_of_ubuntu(elsewhere, domain):
    pytest.importorskip('rclpy', reason='nodes need ROS 2 (rclpy)')
    done = subprocess.run(
        [sys.executable, '-c', ALONE], capture_output=True, text=True, timeout=HUNG, check=False,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain), 'PYTHONPATH': str(ROOT)})
    # The guide needs more, and says what.
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1] == (
        'guide_node: found no package viser; expected it; install it by pip install '
        '"ocp_ros[studio]"')


@pytest.mark.system
def test_the_layout_is_that_of_ros(installed):
    share = installed / 'share'
    assert (share / 'ament_index' / 'resource_index' / 'packages' / 'ocp_ros').is_file()
    for folder in ('config', 'config/rig', 'config/train', 'launch', 'models'):
        names = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        assert names == {path.name for path in (share / 'ocp_ros' / folder).iterdir()
                         if path.is_file()}, folder
    assert (share / 'ocp_ros' / 'package.xml').is_file()


@pytest.mark.system
def test_the_archive_of_the_sources_is_whole(built):
    (path,) = built.glob('*.tar.gz')
    with tarfile.open(path) as archive:
        names = {name.partition('/')[2] for name in archive.getnames()}
    known = subprocess.run(['git', '-C', ROOT, 'ls-files'], capture_output=True, text=True,
                           check=False)
    if known.returncode:
        pytest.skip('there is no git, or the sources are no repository')
    missing = set(known.stdout.splitlines()) - names
    assert not {name for name in missing if not name.startswith(('.', 'docs/benchmark/'))}


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


# As much of ROS's launch system as executes the launch files of this package where launch_ros is
# not installed, as with ROS from PyPI: classes have the names and the arguments of the real ones.
DeclareLaunchArgument = namedtuple('DeclareLaunchArgument', 'name default_value description')
LaunchDescription = namedtuple('LaunchDescription', 'entities')
Node = namedtuple(
    'Node', 'package executable output namespace parameters arguments condition remappings',
    defaults=('log', None, (), (), None, ()))
OpaqueFunction = namedtuple('OpaqueFunction', 'function')
ParameterValue = namedtuple('ParameterValue', 'value value_type')


class LaunchConfiguration(namedtuple('LaunchConfiguration', 'name')):
    """An argument of a launch file."""

    def perform(self, context):
        """Return its text."""
        return context.launch_configurations[self.name]


STAND_IN = {
    'ament_index_python.packages': {'get_package_share_directory': lambda name: str(ROOT)},
    'launch': {'LaunchDescription': LaunchDescription, 'LaunchContext': SimpleNamespace},
    'launch.actions': {'DeclareLaunchArgument': DeclareLaunchArgument,
                       'OpaqueFunction': OpaqueFunction},
    'launch.conditions': {'IfCondition': partial(ParameterValue, value_type=bool)},
    'launch.substitutions': {'LaunchConfiguration': LaunchConfiguration},
    'launch_ros': {}, 'launch_ros.actions': {'Node': Node},
    'launch_ros.parameter_descriptions': {'ParameterValue': ParameterValue}}


@pytest.fixture
def launched(monkeypatch):
    """Return what executes a launch file: executable, namespace and parameters of each node."""
    for name, contents in STAND_IN.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)

    def start(file, **given):
        context, found = SimpleNamespace(launch_configurations=given), []

        def evaluated(value):
            if isinstance(value, dict):
                return {name: evaluated(one) for name, one in value.items()}
            if isinstance(value, ParameterValue):
                text = value.value.perform(context)
                return {'true': True, 'false': False}[text] if value.value_type is bool else (
                    value.value_type(text))
            return value.perform(context) if isinstance(value, LaunchConfiguration) else value

        for entity in description_of(file).entities:
            if isinstance(entity, DeclareLaunchArgument):
                assert isinstance(entity.default_value, str) and entity.description
                given.setdefault(entity.name, entity.default_value)
                continue
            nodes = entity.function(context) if isinstance(entity, OpaqueFunction) else [entity]
            # Transforms stay in a namespace, for what shows them too.
            assert all(dict(node.remappings) == {'/tf': 'tf', '/tf_static': 'tf_static'}
                       and node.namespace is not None
                       for node in nodes if node.executable != 'trainer_node')
            found += [(node.executable, evaluated(node.namespace),
                       [evaluated(entry) for entry in node.parameters])
                      for node in nodes if node.condition is None or evaluated(node.condition)]
        return found

    return start


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
        'demo', planner='lookahead', model='actor', cameras='3', room='scan.ply')
    assert (sim, policy) == ('sim_node', 'policy_node')
    assert of_sim[-1] == {'scene.file': 'scan.ply', 'rig.cameras': 3}
    assert of_policy[-1] == {'planner': 'lookahead', 'model': 'actor'}
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
    assert found.pop('use_sim_time') == 'bool' and len(found) == 7
    for name, kind in found.items():
        assert leaves(PolicyNodeConfig)[name].type.__name__ == kind
