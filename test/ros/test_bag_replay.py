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

"""``ocp replay``: recorded clouds reach a real ``policy_node`` on real DDS."""

from contextlib import ExitStack
from io import BytesIO
import os
import re
import shlex
import signal
import struct
import subprocess
import sys

from benchmarks.calibration_bench import cast, off
from conftest import (
    counted,
    farthest_distance,
    header_at,
    HUNG,
    printed,
    refused,
    refused_in_one_sentence,
    ROOT,
    yaml_example,
)
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.cli.main import build_parser, main
from ocp_ros.geometry.cameras import CameraModel, Pose, rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.registration.steady_cloud import steady_cloud
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rooms.generator import generate_room, mesh_of, plan_of
from ocp_ros.ros.bags.bag_files import Bag, Recorded
from ocp_ros.ros.bags.bag_process import CLOUD, POSES, TRANSFORMS
from ocp_ros.ros.bags.bag_replay import Replay, ReplayOptions
from ocp_ros.ros.bags.recorded_clouds import recorded_frames
from ocp_ros.ros.bags.replay_run import options_of, pose_of
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    msg_to_cloud,
    msg_to_poses,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError
from PIL import Image as PngImage
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Header, String

S = 1_000_000_000
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
#: As bags of old have transforms.
OLD_TRANSFORMS = 'tf/msg/tfMessage'
ROS1.register(get_types_from_msg('geometry_msgs/TransformStamped[] transforms', OLD_TRANSFORMS))
#: Where two cameras hang, and how they are turned: yaw, pitch, roll.
PLACES = np.array([[2.6, 2.2, 1.9], [3.4, 2.9, 1.7]])
HEADINGS = np.array([[0.4, 0.3, 0.1], [-2.0, 0.2, 0.0]])
#: From an optical frame (z forward, x right, y down) to that of the body.
OPTICAL_AXES = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
#: A recorded depth camera, from moveit_tutorials, where it is at hand.
REAL = ROOT.parent / 'shared' / 'data' / 'bags' / 'perception_tutorial.bag'


class Recording:
    """Messages of a bag that is written: ``add`` them, then ``write`` it."""

    def __init__(self):
        self.messages = []

    def add(self, topic, message, time=1000 * S):
        """Take a message of rclpy."""
        kind = type(message)
        self.add_bytes(topic, f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}', time,
                       serialize_message(message))

    def add_bytes(self, topic, kind, time, cdr):
        """Take a message, as ROS 2 serialises it."""
        self.messages.append((topic, kind, time, bytes(cdr)))

    def add_turn(self, clouds, frames=('map', 'map'), poses=True, time=1000 * S):
        """Take what all cameras see at a time, and where they are; return the recording."""
        if poses:
            message = positions_to_msg(PLACES, header_at(time), HEADINGS)
            self.add('/rig/poses', message, time)
        for k, (cloud, frame) in enumerate(zip(clouds, frames)):
            message = cloud_to_msg(cloud, header_at(time, frame))
            self.add(f'/cam{k}/points', message, time + 1 + k)
        return self

    def add_transform(self, parent, child, position, rotation, topic='/tf_static'):
        """Take a transform."""
        def made(kind, *fields):
            return ROS2.types[kind](*fields)

        header = made('std_msgs/msg/Header', made('builtin_interfaces/msg/Time', 1000, 0), parent)
        transform = made('geometry_msgs/msg/Transform',
                         made('geometry_msgs/msg/Vector3', *position),
                         made('geometry_msgs/msg/Quaternion',
                              *Rotation.from_matrix(rotation).as_quat()))
        message = made(TRANSFORMS, [
            made('geometry_msgs/msg/TransformStamped', header, child, transform)])
        self.add_bytes(topic, TRANSFORMS, 1000 * S, ROS2.serialize_cdr(message, TRANSFORMS))

    def write(self, folder, form):
        """Write the bag and return its path."""
        path = folder / ('recorded.bag' if form == 'ros1' else 'recorded')
        store = ROS1 if form == 'ros1' else ROS2
        writer = Writer1(path) if form == 'ros1' else Writer2(
            path, version=9, storage_plugin=StoragePlugin[form.upper()])
        with writer:
            known = {}
            for topic, kind, time, cdr in sorted(self.messages, key=lambda message: message[2]):
                old = form == 'ros1' and kind == TRANSFORMS
                known[topic] = known.get(topic) or writer.add_connection(
                    topic, OLD_TRANSFORMS if old else kind, typestore=store)
                raw = ROS2.cdr_to_ros1(cdr, kind) if form == 'ros1' else cdr
                writer.write(known[topic], time, raw)
        return path


def turns_of(clouds, count=1):
    """Return a recording of some turns, one each second, in the frame of the map."""
    recording = Recording()
    for turn in range(count):
        recording.add_turn(clouds, time=(1000 + turn) * S)
    return recording


@pytest.fixture(scope='module')
def clouds(room):
    """Return what each of the two cameras sees: (N, 3) metres, map frame."""
    engine = EngineConfig(preset='fast', error_rows=32, coverage_cell=0.5)
    simulator = Simulator(room, SimulationConfig(engine=engine), [CameraModel()])
    return [room.points[simulator.evaluate(place[None]).visible] for place in PLACES]


@pytest.fixture
def in_map(clouds):
    """Return a recording of a turn in the frame of the map, and of a text."""
    recording = turns_of(clouds)
    recording.add('/chatter', String(data='x'))
    return recording


def optical(clouds):
    """Return clouds of the map frame in the optical frames of their cameras."""
    return [(cloud - place) @ rotation_matrix(*heading) @ OPTICAL_AXES
            for cloud, place, heading in zip(clouds, PLACES, HEADINGS)]


def check_same(found, expected):
    """Assert that a fused cloud shows what was recorded."""
    assert farthest_distance(found, expected) < 1e-3 and farthest_distance(expected, found) < 2e-3


@pytest.fixture
def stage(graph, probe):
    """Return what replays a bag to a policy; ``play`` waits for the fused cloud."""
    probe.listen(PointCloud2, topics.OBSERVATION, qos.LOOP)
    for topic in (topics.CAMERA_POSES, topics.CAMERA_COMMANDS):
        probe.listen(PoseArray, topic, qos.LOOP)

    def start(path, clouds='cam0/points,cam1/points', **options):
        probe.policy = graph.add(PolicyNode, cloud_topics=clouds, voxel_size=0.001,
                                 max_range=5.0, cloud_timeout=HUNG)
        bag = bags.enter_context(Bag(path))
        probe.replay = graph.add(lambda **kwargs: Replay(
            bag, ReplayOptions(rate=100.0, **options), **kwargs))

    def play(path, **options):
        start(path, **options)
        graph.until(probe.replay.done.done)
        probe.replay.done.result()
        return msg_to_cloud(probe.last(topics.OBSERVATION))

    probe.start, probe.play = start, play
    with ExitStack() as bags:
        yield probe


def recorded_clouds(*arguments):
    """Return what stays in the frames of each camera of a bag, by its name."""
    return {name: steady_cloud([*frames.values()]) for name, frames in recorded_frames(*arguments)}


def test_each_camera_is_given_what_it_recorded_in_its_body_frame(clouds, tmp_path):
    recording = Recording().add_turn(optical(clouds), ('left_optical', 'right_optical'))
    path = recording.write(tmp_path, 'mcap')
    found = recorded_clouds(path, ['left', 'right'], {})
    for cloud, camera in zip(optical(clouds), ('left', 'right')):
        np.testing.assert_allclose(found[camera], cloud @ OPTICAL_AXES.T, atol=1e-4)
    chosen = recorded_clouds(path, ['left', 'right'], {'left': '/cam1/points'}, 'body')
    np.testing.assert_allclose(chosen['left'], optical(clouds)[1], atol=1e-4)
    with pytest.raises(ConfigurationError, match='/cam2'):
        recorded_clouds(path, ['left'], {'left': '/cam2/points'})


@pytest.mark.system
def test_the_tutorial_of_two_cameras_can_be_followed_from_the_scan_to_putting_one_back(
        tmp_path, monkeypatch, capsys):
    page = (ROOT / 'docs' / 'tutorials' / 'two_cameras.md').read_text()
    info, plan, find, score, compare = [shlex.split(line, comments=True) for line
                                        in re.findall(r'^    ocp (.*)', page, re.M)]
    monkeypatch.chdir(tmp_path)
    save_scene(generate_room(532, 20_000), tmp_path / 'room.ply')
    (tmp_path / 'rig.yaml').write_text(yaml_example('docs/tutorials/two_cameras.md', 'cameras:'))
    printed(capsys, *info)
    printed(capsys, *plan, '--evaluations', '60')
    rng, bags = np.random.default_rng(0), tmp_path / 'bags'
    bags.mkdir()
    # The cameras hang a little beside their planned poses; later, the second one was touched.
    hung = [off(Pose.of(placed.pose), 0.08, 3.0, rng)
            for placed in load_placement('out/plan/placement.yaml').cameras]
    touched = [hung[0], off(hung[1], 0.03, 4.0, rng)]
    for name, poses in (('recorded', hung), ('recorded_again', touched)):
        recording, frames = Recording(), [
            cast(MeshRays(mesh_of(plan_of(532))), pose, 'realsense_d455', 3, 1, rng, number)
            for number, pose in enumerate(poses)]
        for time, seen in enumerate(zip(*frames)):
            recording.add_turn([cloud @ OPTICAL_AXES for cloud in seen],
                               ('cam0_optical', 'cam1_optical'), False, (1000 + time) * S)
        recording.write(bags, 'mcap').rename(tmp_path / name)
    built = printed(capsys, *find)['cameras']
    for row, pose in zip(built, hung):
        assert not row['refused'] and np.linalg.norm(row['position'] - pose.position) < 0.01
    assert 'planned' in printed(capsys, *score)
    now = printed(capsys, *compare)['cameras']
    assert [row['moved'] for row in now] == [False, True] and 'turn it' in now[1]['put_back']
    compile((tmp_path / 'out' / 'built' / 'cameras.launch.py').read_text(), 'launch', 'exec')


def add_depth(recording, cameras=2, compressed=False):
    """Take depth images of walls, 2 and 3 m away, with the CameraInfo of their cameras."""
    for k in range(cameras):
        header, name = header_at(1000 * S, f'lens_{k}'), f'/cam{k}/depth/image'
        depth = np.full((30, 40), 2000 + 1000 * k, dtype='<u2')
        if compressed:
            png = BytesIO()
            PngImage.fromarray(depth).save(png, 'PNG')
            recording.add(f'{name}/compressedDepth', CompressedImage(
                header=header, format='16UC1; compressedDepth png',
                data=bytes(12) + png.getvalue()))
        else:
            recording.add(name, Image(header=header, width=40, height=30, step=80,
                                      encoding='16UC1', data=depth.tobytes()))
        recording.add(f'/cam{k}/depth/camera_info', CameraInfo(
            header=header, width=40, height=30,
            p=[20.0, 0.0, 19.5, 0.0, 0.0, 20.0, 14.5, 0.0, 0.0, 0.0, 1.0, 0.0]))
    return recording


@pytest.mark.parametrize('form', ['ros1', 'mcap'])
@pytest.mark.parametrize('compressed', [False, True])
def test_depth_images_in_a_bag_are_clouds_of_cameras(tmp_path, form, compressed):
    path = add_depth(Recording(), compressed=compressed).write(tmp_path, form)
    found = recorded_clouds(path, ['cam0', 'cam1'], {})
    for k, cloud in enumerate(found.values()):
        assert cloud.shape == (1200, 3)
        np.testing.assert_allclose(cloud[:, 0], 2.0 + k, atol=1e-6)
        np.testing.assert_allclose(np.abs(cloud[:, 1:]).max(axis=0),
                                   (2.0 + k) * np.array([19.5, 14.5]) / 20.0, atol=1e-6)


def test_depth_images_are_replayed_with_what_is_known_of_their_camera(stage, tmp_path):
    recording = add_depth(Recording(), cameras=1)
    found = stage.play(recording.write(tmp_path, 'mcap'), clouds='cam0/depth/image',
                       poses=(pose_of('1,1,1.2,90'),))
    # The wall is two metres ahead, along y.
    np.testing.assert_allclose(found[:, 1], 3.0, atol=1e-5)
    assert stage.replay.counts == {'/cam0/depth/image': 1, '/cam0/depth/camera_info': 1}


@pytest.mark.parametrize(('form', 'frames', 'options'), [
    ('ros1', ('camera_0_optical', 'camera_1_optical'), {}),
    # The recorded poses are of other cameras.
    ('mcap', ('kinect_depth_optical', 'lidar_optical'), {'poses': [
        pose_of(','.join(map(str, [*place, *np.rad2deg(heading)])))
        for place, heading in zip(PLACES, HEADINGS)]}),
    ('sqlite3', ('world', 'nonsense'), {
        'frames': (('/cam1/points', 'camera_1_optical'), ('', 'camera_0_optical'))})])
def test_a_policy_fuses_what_was_recorded(stage, clouds, tmp_path, form, frames, options):
    recording = Recording().add_turn(optical(clouds), frames)
    recording.add('/chatter', String(data='x'))
    check_same(stage.play(recording.write(tmp_path, form), **options), np.concatenate(clouds))
    # The stamps are the recorded ones, and the command answers them.
    assert stamp_to_ns(stage.last(topics.CAMERA_COMMANDS).header.stamp) == 1000 * S
    poses = {} if 'poses' in options else {'/rig/poses': 1}
    assert stage.replay.counts == {'/cam0/points': 1, '/cam1/points': 1, **poses}
    assert stage.replay.left_out_count == 0


@pytest.mark.parametrize('form', ['ros1', 'sqlite3'])
def test_recorded_transforms_say_where_the_cameras_are(stage, clouds, tmp_path, form):
    """The frames are a driver's, as nobody with tf2 is there to place them."""
    recording, mount = Recording(), rotation_matrix(1.0, 0.2, 0.0)
    for k, (place, heading) in enumerate(zip(PLACES, HEADINGS)):
        recording.add_transform('map', f'mount_{k}', place - [0.0, 0.0, 0.5], mount, '/tf')
        recording.add_transform(f'mount_{k}', f'lens_{k}_optical_frame',
                                mount.T @ [0.0, 0.0, 0.5],
                                mount.T @ rotation_matrix(*heading) @ OPTICAL_AXES)
    recording.add_turn(optical(clouds), ('lens_0_optical_frame', 'lens_1_optical_frame'),
                       poses=False)
    check_same(stage.play(recording.write(tmp_path, form)), np.concatenate(clouds))
    poses = stage.last(topics.CAMERA_POSES)
    assert poses.header.frame_id == 'map'
    for pose, place, heading in zip(msg_to_poses(poses), PLACES, HEADINGS, strict=True):
        np.testing.assert_allclose(pose.position, place, atol=1e-6)
        np.testing.assert_allclose(pose.rotation, rotation_matrix(*heading), atol=1e-6)


def test_a_loop_goes_on_with_stamps_that_rise(stage, clouds, tmp_path):
    stage.listen(PointCloud2, '/cam0/points', qos.LOOP)
    stage.start(turns_of(clouds, 3).write(tmp_path, 'mcap'), loop=True)
    stage.graph.until(lambda: len(stage.received['/cam0/points']) >= 8)
    stamps = [stamp_to_ns(message.header.stamp) for message in stage.received['/cam0/points']]
    assert (np.diff(stamps) > 0).all() and stamps[:3] == [1000 * S, 1001 * S, 1002 * S]
    assert not stage.replay.done.done()
    assert counted(stage.policy, 'clock_jumps') == 0


def test_a_part_is_replayed_under_another_name(stage, clouds, tmp_path):
    stage.listen(PointCloud2, '/cam1/points', qos.LOOP)
    stage.start(turns_of(clouds[:1], 4).write(tmp_path, 'sqlite3'), clouds='/cam1/points',
                start=0.5, duration=2.0, topics=('/cam0/points:=/cam1/points',))
    stage.graph.until(stage.replay.done.done)
    stage.graph.until(lambda: len(stage.received['/cam1/points']) == 2)
    assert [stamp_to_ns(message.header.stamp) for message in stage.received['/cam1/points']] == [
        1001 * S, 1002 * S]


def test_messages_that_are_none_are_left_out(stage, in_map, clouds, tmp_path, capfd):
    broken = serialize_message(cloud_to_msg(clouds[0], Header(frame_id='map')))
    for k, cut in enumerate((3, 10, 40, 200, len(broken) // 2)):
        in_map.add_bytes('/cam0/points', CLOUD, 1001 * S + k, broken[:cut])
    assert len(stage.play(in_map.write(tmp_path, 'mcap')))
    assert stage.replay.left_out_count == 5
    assert '/cam0/points: found a message that is no' in capfd.readouterr().err


def test_lists_that_are_longer_than_their_message_are_left_out(tmp_path):
    """The library would count to four billion."""
    cloud = ROS2.cdr_to_ros1(serialize_message(cloud_to_msg(
        np.zeros((3, 3), dtype=np.float32), Header(frame_id='map'))), CLOUD)
    poses = ROS2.cdr_to_ros1(serialize_message(positions_to_msg(PLACES, Header())), POSES)
    path = tmp_path / 'long.bag'
    with Writer1(path) as writer:
        for topic, kind, raw, at in (('/cloud', CLOUD, cloud, 12 + 4 + 3 + 8),
                                     ('/poses', POSES, poses, 12 + 4),
                                     ('/tf', OLD_TRANSFORMS, bytes(84), 0)):
            spoilt = bytearray(raw)
            struct.pack_into('<I', spoilt, at, 0xFFFFFFF0)
            writer.write(writer.add_connection(topic, kind, typestore=ROS1), S, bytes(spoilt))
    with Bag(path) as bag:
        left_out = [str(one) for one in bag.messages(['/cloud', '/poses', '/tf'])]
    assert ['4,294,967,280 parts in' in one for one in left_out] == [True] * 3


def read_all(path):
    """Return the messages of a bag that can be read."""
    with Bag(path) as bag:
        for topic in bag.topics:
            bag.frames(topic)
        return [item for item in bag.messages([topic.name for topic in bag.topics])
                if isinstance(item, Recorded)]


@pytest.mark.parametrize('form', ['ros1', 'sqlite3', 'mcap'])
def test_a_bag_that_was_cut_or_overwritten_is_an_error_of_one_sentence(clouds, tmp_path, form):
    path = turns_of([cloud[:50] for cloud in clouds], 2).write(tmp_path, form)
    assert len(read_all(path)) == 6
    file = max([path] if path.is_file() else path.iterdir(), key=lambda file: file.stat().st_size)
    whole, rng, refused_count = file.read_bytes(), np.random.default_rng(0), 0
    for cut in rng.integers(0, len(whole), 2):
        spoilt = bytearray(whole)
        spoilt[cut:cut + 20] = rng.bytes(20)
        for content in (whole[:cut], bytes(spoilt)):
            file.write_bytes(content)
            try:
                read_all(path)
            except ConfigurationError as error:
                refused_count += 1
                assert '\n' not in str(error) and 'found' in str(error)
    assert refused_count > 1


def test_the_list_shows_what_is_there(clouds, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '150')
    assert main(['replay', str(turns_of(clouds, 2).write(tmp_path, 'ros1')), '--list']) == 0
    rows = [[cell.strip() for cell in line.split('│')[1:-1]]
            for line in capsys.readouterr().out.splitlines() if '│' in line]
    assert rows == [
        ['/cam0/points', 'sensor_msgs/PointCloud2', '2', 'map', '/cam0/points'],
        ['/cam1/points', 'sensor_msgs/PointCloud2', '2', 'map', '/cam1/points'],
        ['/rig/poses', 'geometry_msgs/PoseArray', '2', 'map', 'camera_poses']]


@pytest.mark.parametrize(('name', 'words'), [
    ('folder', 'folder'), ('empty.bag', 'empty.bag'), ('nothing', 'nothing'),
    ('lone/a.mcap', 'without metadata.yaml')])
def test_what_is_no_bag_is_refused(tmp_path, capsys, name, words):
    for folder in ('folder', 'lone'):
        (tmp_path / folder).mkdir()
    for file in ('empty.bag', 'lone/a.mcap'):
        (tmp_path / file).touch()
    assert words in refused(capsys, 'replay', tmp_path / name)


@pytest.mark.parametrize(('form', 'topic', 'message', 'remedy'), [
    ('ros1', '/chatter', String(data='hello'), '/chatter (std_msgs/msg/String)'),
    ('mcap', '/cam/depth', Image(height=1, width=1, step=2, encoding='16UC1', data=[0, 0]),
     'camera_info')])
def test_a_bag_without_clouds_is_refused(tmp_path, capsys, form, topic, message, remedy):
    """A depth image without its CameraInfo is no cloud."""
    recording = Recording()
    recording.add(topic, message)
    path = recording.write(tmp_path, form)
    with pytest.raises(ConfigurationError, match=re.escape(remedy)):
        recorded_clouds(path, ['cam'], {})
    assert remedy in refused(capsys, 'replay', path)


@pytest.mark.parametrize(('options', 'words'), [
    ({'topics': ('/cam0/pints',)}, "'/cam0/points'"), ({'topics': ('/chatter',)}, '/chatter'),
    ({'frames': (('/cam7/points', 'map'),)}, '--frame'),
    ({'topics': ('/cam0/points', '/rig/poses'), 'poses': (np.zeros(6),)}, '--pose'),
    ({'poses': (np.zeros(6),)}, '--pose')])
def test_options_that_cannot_be_are_refused(graph, in_map, tmp_path, options, words):
    with Bag(in_map.write(tmp_path, 'mcap')) as bag, \
            pytest.raises(ConfigurationError, match=words):
        graph.add(lambda **kwargs: Replay(bag, ReplayOptions(**options), **kwargs))


@pytest.mark.parametrize(('frame', 'options', 'words'), [
    ('lens', {}, 'published'), ('map', {'start': 5.0}, 'from 5 s on')])
def test_a_replay_without_any_cloud_is_an_error(stage, clouds, tmp_path, capfd, frame, options,
                                                words):
    """None can be placed, or none is in the part that is replayed."""
    recording = Recording()
    recording.add_transform('odom', 'base', np.zeros(3), np.eye(3))
    recording.add_turn(clouds, (frame, frame), poses=frame == 'map')
    stage.start(recording.write(tmp_path, 'mcap'), **options)
    stage.graph.until(stage.replay.done.done)
    assert words in str(stage.replay.done.exception())
    assert ("'lens' to 'map'" in capfd.readouterr().err) == (frame == 'lens')


def test_options_of_the_command_line():
    options = options_of(build_parser().parse_args([
        'replay', 'a.bag', '--pose=-1,2,1.5,90', '--frame', '/a=b', '--frame', 'c', '--rate', '2',
        '--topics', '/a:=/b']))
    np.testing.assert_allclose(options.poses[0], [-1, 2, 1.5, np.pi / 2, 0, 0])
    assert options.frames == (('/a', 'b'), ('', 'c'))
    assert (options.rate, options.topics, options.loop) == (2.0, ('/a:=/b',), False)
    for pose in ('1,2', '1,2,3,4,5,6,7', '1,nan,2', 'a,b,c'):
        with refused_in_one_sentence('--pose: found'):
            pose_of(pose)


def test_a_signal_ends_a_loop(domain, in_map, tmp_path):
    command = [sys.executable, '-m', 'ocp_ros.cli.main', 'replay',
               str(in_map.write(tmp_path, 'mcap')), '--loop', '--wait', '0.1']
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True,
                          env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}) as process:
        # It begins when it has waited in vain.
        assert 'found no subscriber of' in process.stderr.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=HUNG) == 130
        assert 'Traceback' not in process.stderr.read()


@pytest.mark.skipif(not REAL.is_file(), reason=f'{REAL} is not at hand')
def test_a_real_bag_of_a_depth_camera(stage):
    """An organised cloud of 640 x 480 with NaN, in the optical frame of its camera."""
    found = stage.play(REAL, clouds='/camera/depth_registered/points',
                       poses=(pose_of('1,1,1.2,30,10,0'),))
    with Bag(REAL) as bag:
        item, = bag.messages(['/camera/depth_registered/points'])
    recorded = msg_to_cloud(deserialize_message(item.cdr, PointCloud2))
    body = np.stack([recorded[:, 2], -recorded[:, 0], -recorded[:, 1]], axis=1)
    body = body[np.linalg.norm(body, axis=1) <= 5.0]
    expected = body @ rotation_matrix(*np.deg2rad([30, 10, 0])).T + [1.0, 1.0, 1.2]
    assert len(found) > 20000
    assert farthest_distance(found, expected) < 1e-4
