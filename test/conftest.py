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

"""Fixtures for real nodes on real DDS in one process, without launch files."""

from contextlib import contextmanager, ExitStack, suppress
from dataclasses import replace
import faulthandler
from functools import cache
from importlib.util import find_spec
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import time

ROOT = Path(__file__).resolve().parent.parent
# The laboratory, benchmarks/, is not installed.
sys.path.insert(0, str(ROOT))

# Tests run side by side and in processes that they start. Threads of all of them that wait for
# each other would spin on the same few cores, so each process has one, whatever NumPy and torch
# would like: they look here when they are imported.
os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np  # noqa: E402

# Nothing here that takes long to import: the process that hands out the tests reads this too, and
# the others begin when it has done so.
from ocp_ros.policy.agent_config import AgentConfig, CLOUD, PAPER  # noqa: E402
from ocp_ros.util.settings import ConfigurationError, UserError  # noqa: E402
import pytest  # noqa: E402

#: Seconds after which what a test waits for has hung. No test waits as long, on whatever machine:
#: a limit is never a speed.
HUNG = 600.0
#: Seconds after which a process is ended that hangs where no Python code can end it: in a test,
#: and while the nodes of a test are taken down, which takes less than one.
STUCK, STUCK_LEAVING = 1000.0, 60.0
#: Parameters of a simulation that plays a turn in milliseconds.
SMALL = {'scene__points': 2000, 'engine__preset': 'fast', 'engine__error_rows': 32,
         'engine__coverage_cell': 0.5}
#: A training that takes seconds.
TINY = {'interactions': 48, 'environments': 2, 'updates_per_turn': 1.0, 'evaluate_every': 24,
        'workers': 1, 'fewest_cameras': 2,
        'rooms': {'training': 1, 'validation': 1, 'test': 1, 'points': 1500, 'rotations': '0,30'},
        'simulation': {'rig': {'cameras': 3},
                       'engine': {'preset': 'fast', 'error_rows': 16, 'coverage_cell': 1.0},
                       'episode': {'turns': 6}},
        'agent': {'inputs': 'cloud', 'points': 64, 'keys_1': 8, 'group_1': 4, 'keys_2': 4,
                  'group_2': 4, 'channels': 8, 'hidden': 16},
        'sac': {'learning_starts': 12, 'batch_size': 8, 'buffer_size': 400, 'device': 'cpu'}}
#: Mounts of a rig in a room about as high as those that people live in.
MOUNTS = {'plane': {'on': 'plane', 'height': 1.9}, 'ceiling': {'on': 'ceiling'},
          'rods': {'on': 'ceiling', 'height': 2.0},
          'walls': {'on': 'walls', 'height': [1.7, 2.3]},
          'free': {'on': 'free', 'height': [1.2, 2.2]}}


#: What tests import that can only run where a package is there.
NEEDED = {'rclpy': r'^(from|import) (rclpy|[a-z]+_msgs|std_srvs|ocp_ros\.(demo|ros\.runtime))',
          'rosbags': r'^from rosbags'}
LACKING = [name for name in NEEDED if not find_spec(name)]


def pytest_ignore_collect(collection_path):
    """Leave out the tests of what is not there."""
    if collection_path.suffix == '.py' and any(
            re.search(NEEDED[name], collection_path.read_text(), re.M) for name in LACKING):
        return True
    return None


def pytest_report_header():
    """Say which tests are left out."""
    return [f'found no {name}: the tests that need it are left out' for name in LACKING]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """End a process that hangs in native code; another one goes on with the other tests."""
    with ended_after(STUCK):
        return (yield)


@contextmanager
def ended_after(seconds):
    """End this process if a block takes longer."""
    faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


@cache
def made_room(seed, points):
    """Return a generated room, generated once for all tests of a process: do not change it."""
    from ocp_ros.rooms.generator import generate_room
    return generate_room(seed, points)


@pytest.fixture(scope='session')
def room():
    """Return a generated room of about 2,000 points."""
    return made_room(8, 2000)


@pytest.fixture(scope='session')
def furnished():
    """Return a box of 6 x 4 x 2.8 m with a closed cabinet of 1 x 1 x 2 m in it."""
    from ocp_ros.scenes.scene import Scene
    cabinet = box_sides(np.array([1.0, 1.0, 2.0]), np.array([4.0, 2.0, 1.0]))
    return Scene(np.concatenate([box_room().points, cabinet]).astype(np.float32), 'furnished')


@pytest.fixture(scope='session')
def small_agent():
    """Return sizes of a network that trains in milliseconds."""
    return AgentConfig(CLOUD, points=64, keys_1=8, group_1=4, radius_1=1.5, keys_2=4, group_2=4,
                       radius_2=3.0, channels=8, pooled=12, hidden=16)


@pytest.fixture(scope='session', params=(CLOUD, PAPER))
def agent(request, small_agent):
    """Return such sizes for each network that reads a cloud."""
    return replace(small_agent, inputs=request.param)


@pytest.fixture
def checkpoint(small_agent):
    """Return random weights."""
    return random_checkpoint(small_agent)


@pytest.fixture
def model(checkpoint, tmp_path):
    """Return the path of random weights."""
    checkpoint.save(tmp_path / 'random.safetensors')
    return str(tmp_path / 'random.safetensors')


@pytest.fixture(scope='session', autouse=True)
def logs(tmp_path_factory):
    """Let stable-baselines3 leave its logs where they are cleared away."""
    os.environ['SB3_LOGDIR'] = str(tmp_path_factory.mktemp('sb3'))


def random_checkpoint(agent, seed=0, **known):
    """Return a checkpoint with random weights."""
    from ocp_ros.policy.checkpoint import Checkpoint
    from ocp_ros.policy.networks import Actor
    import torch
    torch.manual_seed(seed)
    return Checkpoint(agent, Actor(agent).state_dict(), **known)


def observation(agent, seed=0):
    """Return an encoded observation of random points in a room around the origin."""
    from ocp_ros.policy.cloud_encoder import encode, Encoder
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([-3, -2, 0], [3, 2, 3], (300, 3)).astype(np.float32)
    positions = rng.uniform([-1, -1, 1.9], [1, 1, 1.9], (4, 3))
    if agent.one_by_one:
        return Encoder(agent).turn(cloud, positions, 3, 30).inputs(0)
    return encode(cloud, positions, agent)


def batch(*encoded):
    """Put encoded observations into one batch."""
    import torch
    return {name: torch.from_numpy(np.stack([one[name] for one in encoded]))
            for name in encoded[0]}


def store(model, before, after, action, reward, done=False, info=None):
    """Put a move of one environment into the replay of soft actor-critic."""
    seen = ({name: value[None] for name, value in one.items()} for one in (before, after))
    model.replay_buffer.add(*seen, np.asarray(action, np.float32)[None],
                            np.array([float(reward)]), np.array([done]), [info or {}])


@pytest.fixture(scope='session')
def domain(tmp_path_factory):
    """Hold a ROS domain that no other test process uses."""
    pytest.importorskip('rclpy', reason='node tests need ROS 2 (rclpy)')
    from ocp_ros.demo.watched_nodes import free_domain
    from ocp_ros.ros.runtime.node_main import local_transport
    os.environ.update(local_transport())
    os.environ['ROS_LOG_DIR'] = str(tmp_path_factory.mktemp('ros'))
    number, holder = free_domain()
    with holder:
        yield number


class Graph:
    """Nodes of one test in one context, spun by hand."""

    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.nodes = []

    def add(self, kind, **parameters):
        """Start a node; ``a__b`` in a keyword is the parameter ``a.b``."""
        from rclpy.parameter import Parameter
        overrides = [Parameter(name.replace('__', '.'), value=value)
                     for name, value in parameters.items()]
        node = kind(context=self.context, parameter_overrides=overrides)
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def remove(self, node) -> None:
        """Stop a node as if its process had ended."""
        self.executor.remove_node(node)
        self.nodes.remove(node)
        node.destroy_node()

    def until(self, predicate, timeout=HUNG) -> None:
        """Spin until something has happened; fail if it does not."""
        deadline = time.monotonic() + timeout
        while not predicate():
            assert time.monotonic() < deadline, 'nothing happened within the time limit'
            self.executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        """
        Take everything down; another order can crash in the DDS layer.

        Where another process comes or leaves at that moment Fast DDS may wait for ever (see
        ``node_main.shut_down_node``). This process is ended then, and the test is run once more.
        """
        import rclpy
        with ended_after(STUCK_LEAVING):
            self.executor.shutdown()
            for node in self.nodes:
                node.destroy_node()
            rclpy.shutdown(context=self.context)


def status(node):
    """Return what a node publishes on ``/diagnostics``: its level, message and values."""
    return node._status()


def counted(node, name):
    """Return a value that a node publishes on ``/diagnostics``."""
    return status(node)[2][name]


@pytest.fixture
def graph(domain, monkeypatch):
    """Return a graph of nodes of its own, which know each other at once."""
    from ocp_ros.ros.policy import turn_source
    monkeypatch.setattr(turn_source, 'DISCOVERY_S', 0.0)
    monkeypatch.setattr(turn_source, 'PUBLISHER_AGE_S', 0.0)
    with ExitStack() as stack:
        made = Graph(domain)
        stack.callback(made.close)
        yield made


class Probe:
    """A node that publishes and records, for tests."""

    def __init__(self, graph: Graph) -> None:
        import rclpy.node
        self.graph = graph
        self.node = graph.add(lambda **kwargs: rclpy.node.Node('probe', **kwargs))
        self.received = {}
        #: Number of requests without an answer.
        self.lost_answers = 0

    def listen(self, kind, topic, qos):
        """Record what arrives on a topic."""
        self.received[topic] = []
        self.node.create_subscription(kind, topic, self.received[topic].append, qos)

    def publisher(self, kind, topic, qos, subscribers=1):
        """Return a publisher that is connected already."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.graph.until(lambda: publisher.get_subscription_count() >= subscribers)
        return publisher

    def last(self, topic):
        """Return the latest message of a topic, waiting for the first."""
        self.graph.until(lambda: self.received[topic])
        return self.received[topic][-1]

    def call(self, kind, name, **fields):
        """Call a service and return its answer; if that gets lost, ask again."""
        client = self.node.create_client(kind, name)
        self.graph.until(client.service_is_ready)
        for _ in range(int(HUNG / 15.0)):
            answer = client.call_async(kind.Request(**fields))
            with suppress(AssertionError):
                self.graph.until(answer.done, timeout=15.0)
                return answer.result()
            self.lost_answers += 1
        raise AssertionError(f'{name} has not answered')

    def start_policy(self, **parameters):
        """Start a policy_node whose turns this node sends, and whose commands it hears."""
        from geometry_msgs.msg import PoseArray
        from ocp_ros.ros.interface import qos, topics
        from ocp_ros.ros.policy_node import PolicyNode
        from sensor_msgs.msg import PointCloud2
        self.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
        policy = self.graph.add(PolicyNode, **parameters)
        self.clouds = self.publisher(PointCloud2, topics.OBSERVATION, qos.LOOP)
        self.poses = self.publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
        return policy

    def send_turn(self, stamp, points, poses):
        """Publish a turn: points (N, 3) and a PoseArray, which gets the stamp in nanoseconds."""
        from ocp_ros.ros.interface.conversions import cloud_to_msg
        poses.header = header_at(stamp)
        self.poses.publish(poses)
        self.clouds.publish(cloud_to_msg(points, poses.header))

    def command(self, stamp):
        """Return the latest command that answers a turn, waiting for the first."""
        from ocp_ros.ros.interface import topics
        from ocp_ros.ros.interface.conversions import stamp_to_ns

        def found():
            return [message for message in self.received[topics.CAMERA_COMMANDS]
                    if stamp_to_ns(message.header.stamp) == stamp]
        self.graph.until(found)
        return found()[-1]


def header_at(stamp, frame='map'):
    """Return the header of a message with a stamp in nanoseconds."""
    from ocp_ros.ros.interface.conversions import ns_to_stamp
    from std_msgs.msg import Header
    return Header(stamp=ns_to_stamp(stamp), frame_id=frame)


def warnings_of(node):
    """Return the list of all that a node warns of from now on; a log leaves out repetitions."""
    heard = []
    node.get_logger().warning = lambda text, **throttled: heard.append(text)
    return heard


def status_of(node):
    """Return the values that a node publishes with its diagnostics."""
    return node._status()[2]


@pytest.fixture
def probe(graph):
    """Return a node that publishes and records."""
    return Probe(graph)


class Here:
    """A worker pool of this process alone."""

    def __init__(self, workers=0, ray_address=None):
        self.played = []

    def map(self, function, tasks):  # noqa: A003
        """Run all tasks, in their order."""
        self.played += tasks
        return map(function, tasks)

    def unordered(self, function, tasks):
        """Run all tasks and number them."""
        return enumerate(self.map(function, tasks))

    def __enter__(self):
        """Return the pool itself."""
        return self

    def __exit__(self, *_):
        """There is nothing to end."""


@pytest.fixture
def here(monkeypatch):
    """Let a run play in this process: others take longer to start than all there is to do."""
    from ocp_ros.training import train
    monkeypatch.setattr(train, 'WorkerPool', Here)


@pytest.fixture(scope='module')
def quick_lookahead():
    """Let lookahead compare few candidates on few points."""
    from ocp_ros.online import lookahead
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lookahead, 'TUNING', replace(
            lookahead.TUNING, max_positions=100, candidate_model=(2000, 16),
            refining_model=(4000, 32), proposals=64, pipelined_proposals=32))
        yield


def wait_until(holds):
    """Wait for a condition that another thread fulfils."""
    end = time.monotonic() + HUNG
    while not holds():
        assert time.monotonic() < end, 'nothing happened within the time limit'
        time.sleep(0.02)


def run_python(code, *arguments, **variables):
    """Run code in a process of its own that imports this checkout; return how it ended."""
    return subprocess.run(
        [sys.executable, '-c', code, *map(str, arguments)], text=True, capture_output=True,
        timeout=HUNG, env={**os.environ, 'PYTHONPATH': str(ROOT), **variables})


def for_any(examples=10, **strategies):
    """Try a test with some examples of what strategies of hypothesis draw."""
    from hypothesis import given, settings
    return lambda test: settings(max_examples=examples, deadline=None)(given(**strategies)(test))


def rows_for(protocol, task):
    """Return made-up rows of a task of a comparison, as if it had been run."""
    return [{'room': task.room, 'rotation': task.rotation, 'planner': task.planner,
             'budget': budget, 'seed': seed, 'exact': 2.0, 'space_coverage': 50.0,
             'depth_error': 2.1, 'promised': 2.0, 'lower_bound': 1.0, 'evaluations': budget,
             'seconds': 0.5, 'placement': [[1.0, 2.0, 1.9, 0.0, 0.0, 0.0]] * 4}
            for budget, seed in protocol.runs(task.planner)]


def assert_same(one, other):
    """Assert that two encoded observations are equal bit for bit."""
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert np.array_equal(value, other[name]), name


def around_z(degrees):
    """Return the matrix (2, 2) of a turn about the vertical axis."""
    angle = np.deg2rad(degrees)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def box_sides(size, centre, pitch=0.1):
    """Return points (N, 3) on the six sides of a box."""
    counts = [max(round(edge / pitch), 1) + 1 for edge in size]
    shares = np.stack(np.meshgrid(*(np.linspace(-0.5, 0.5, count) for count in counts),
                                  indexing='ij'), axis=-1).reshape(-1, 3)
    return shares[(np.abs(shares) == 0.5).any(axis=1)] * size + centre


def box_room(width=6.0, depth=4.0, height=2.8):
    """Return the floor, ceiling and walls of an empty room, one corner in the origin."""
    from ocp_ros.scenes.scene import Scene
    size = np.array([width, depth, height])
    return Scene(box_sides(size, size / 2.0).astype(np.float32), 'box')


def panel(x, across, upwards):
    """Return points (N, 3) of a panel at x without thickness: its lowest and highest y and z."""
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(*across, 0.05),
                                                 np.arange(*upwards, 0.05)))
    return np.column_stack([np.full(y.size, x), y, z]).astype(np.float32)


def l_shaped(pitch=0.1):
    """Return the floor, ceiling and walls of 6 x 4 m without the corner beyond 3 and 2 m."""
    from ocp_ros.scenes.scene import Scene
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 6, pitch), np.arange(0, 4, pitch)))
    inside = (x < 3.0) | (y < 2.0)
    level = [np.stack([x[inside], y[inside], np.full(inside.sum(), z)], axis=1) for z in (0, 2.8)]
    corners = np.array([[0, 0], [6, 0], [6, 2], [3, 2], [3, 4], [0, 4]], dtype=float)
    walls = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0)):
        share = np.arange(0.0, 1.0, pitch / np.linalg.norm(end - start))
        along = start + share[:, None] * (end - start)
        for z in np.arange(0.0, 2.8, pitch):
            walls.append(np.column_stack([along, np.full(len(along), z)]))
    return Scene(np.concatenate([*level, *walls]).astype(np.float32), 'L')


def flat_clouds():
    """Return clouds that are no room, by what they are."""
    wall = np.random.default_rng(0).uniform(0.0, 3.0, (500, 3))
    wall[:, 0] = 2.0
    askew = wall.copy()
    askew[:, 0] = askew[:, 1]
    return {'empty': np.empty((0, 3)), 'one point': np.ones((1, 3)),
            'all alike': np.ones((300, 3)), 'one wall': wall, 'one wall askew': askew}


def blank_report(folder, judged):
    """Write no picture as the only page of a report: drawing takes longer than most plans."""
    (folder / 'report.png').write_text('drawn')
    yield folder / 'report.png'


@pytest.fixture
def undrawn(monkeypatch):
    """Leave the pictures of a report blank."""
    monkeypatch.setattr('ocp_ros.report.drawing.report_page.draw_pages', blank_report)


@pytest.fixture
def room_folder(tmp_path, monkeypatch):
    """Work in a folder with the scan of a room of about 8 x 8 m, ``room.ply``."""
    from ocp_ros.scenes.scene_files import save_scene
    save_scene(made_room(8, 2000), tmp_path / 'room.ply')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope='session')
def studio_room():
    """Return a small room with a mesh, and its description."""
    from ocp_ros.rooms.scene_source import room_named
    return room_named('3', 2000)


@pytest.fixture(scope='session')
def spread_cameras(studio_room):
    """Return the state of a studio that has spread three cameras over a room: that takes long."""
    from ocp_ros.rig.rig_file import rig_of
    from ocp_ros.studio.model import Studio
    mount = {'on': 'free', 'height': [1.5, 2.2]}
    return Studio(*studio_room, rig_of(3, 'realsense_d455', mount=mount)).state


@pytest.fixture
def studio(studio_room, spread_cameras):
    """Return a studio with three cameras."""
    from ocp_ros.studio.model import Studio
    return Studio(*studio_room, spread_cameras.rig, spread_cameras.poses)


@pytest.fixture
def page(studio, tmp_path):
    """Yield the page of a studio and its URL."""
    from ocp_ros.studio.folder import Folder
    from ocp_ros.studio.page import Page
    from ocp_ros.studio.server import start_server
    server, url = start_server(port=0)
    page = Page(server, studio, Folder(tmp_path))
    yield page, url
    page.close()


@contextmanager
def refused_in_one_sentence(place, remedy=''):
    """Expect an error of a single sentence that begins with a place and has a remedy."""
    with pytest.raises(ConfigurationError) as caught:
        yield
    message = str(caught.value)
    assert '\n' not in message and message.startswith(place), message
    assert remedy in message and 'found' in message and 'expected' in message, message


def refusal(path, read=None, **options):
    """Return the one sentence with which a file is refused, as a room if nothing else is said."""
    from ocp_ros.scenes.scene_files import load_scene
    with pytest.raises(UserError) as caught:
        (read or load_scene)(path, **options)
    message = str(caught.value)
    assert path.name in message and 'found' in message and 'expected' in message, message
    assert '\n' not in message and len(message) < 2500, message
    return message


def refused(capsys, *arguments):
    """Return the only line that a command of ``ocp`` is refused with: it prints nothing else."""
    from ocp_ros.cli.main import main
    assert main([*map(str, arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == '' and err.startswith('ocp: ') and err.count('\n') == 1, err
    assert 'Traceback' not in err and 'found' in err and 'expected' in err, err
    return err


def printed(capsys, *arguments):
    """Return what a command of ``ocp`` prints as JSON, and nothing else."""
    from ocp_ros.cli.main import main
    assert main([*map(str, arguments), '--json']) == 0
    out, err = capsys.readouterr()
    assert err == ''
    return json.loads(out)


def farthest_distance(points, others):
    """Return how far the farthest of some points is from its nearest among others, metres."""
    from scipy.spatial import cKDTree
    return cKDTree(others).query(points)[0].max()


def write_half(path):
    """Write a scan whose end is missing."""
    from ocp_ros.scenes.scene_files import save_scene
    save_scene(made_room(8, 2500), path)
    content = path.read_bytes()
    path.write_bytes(content[:len(content) // 2])


def yaml_example(page, first):
    """Return the YAML of a page that begins with a line."""
    lines = (ROOT / page).read_text().split(f'    {first}', 1)[1].splitlines()
    count = next(k for k, line in enumerate(lines[1:], start=1) if not line.startswith('    '))
    return '\n'.join([first, *(line[4:] for line in lines[1:count])])
