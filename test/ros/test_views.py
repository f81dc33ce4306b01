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

"""What RViz and Foxglove are shown, and frames on /tf; nothing is made without a subscriber."""

from functools import partial
import json

from benchmarks.drills.live_rig import BODY, episode_in, Rig
from conftest import ROOT, SMALL
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, in_view, OPTICAL_TO_BODY, Pose, rotation_matrix
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    msg_to_cloud,
    ns_to_stamp,
    positions_to_msg,
    rotation_of,
)
from ocp_ros.ros.interface.frames import transform_to_msg
from ocp_ros.ros.interface.views import camera_info, frustum_edges, observed_maps, rig_markers
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.ros.trainer_node import TrainerNode
import pytest
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray
import yaml

POSITIONS = np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9], [4.0, 5.0, 1.9]])
CLOUDS = (topics.COVERAGE_CLOUD, topics.ERROR_CLOUD)
TRUE_CLOUDS = (topics.TRUE_COVERAGE_CLOUD, topics.TRUE_ERROR_CLOUD)


def values_of(cloud):
    """Return the fourth field of a cloud."""
    field = cloud.fields[3]
    kind = {PointField.UINT32: '<u4', PointField.FLOAT32: '<f4'}[field.datatype]
    return np.ndarray(cloud.width, kind, bytes(cloud.data), field.offset, (cloud.point_step,))


@pytest.fixture
def rig_file(tmp_path):
    """Return a rig file of six cameras that look one way."""
    (tmp_path / 'rig.yaml').write_text('cameras: [{sensor: realsense_d455, count: 6}]')
    return str(tmp_path / 'rig.yaml')


def test_the_simulation_shows_what_the_cameras_truly_see_and_miss(graph, probe, rig_file):
    sim = graph.add(SimNode, rig_file=rig_file, **SMALL)
    for topic in TRUE_CLOUDS:
        probe.listen(PointCloud2, topic, qos.LATCHED)
    probe.listen(CameraInfo, topics.camera_info_topic(1), qos.LATCHED)
    coverage, error, info = map(probe.last, (*TRUE_CLOUDS, topics.camera_info_topic(1)))
    turn, counts, lost = sim.episode.turn, values_of(coverage), values_of(error)
    assert (coverage.fields[3].name, error.fields[3].name) == ('count', 'error')
    np.testing.assert_array_equal(msg_to_cloud(coverage), sim.simulator.scene.points)
    expected = sum(
        sim.simulator.evaluate_views([sim.simulator.look(row, k)]).visible.astype(int)
        for k, row in enumerate(np.hstack([turn.positions, turn.headings])))
    np.testing.assert_array_equal(counts, expected)
    assert counts.max() > 1 and (lost > 0.0).all()
    assert lost.sum() == pytest.approx(turn.depth_error, rel=1e-4)
    assert coverage.header == error.header and coverage.header.frame_id == 'map'
    assert info.header == Header(stamp=coverage.header.stamp, frame_id='camera_1_optical')
    assert (info.width, info.height) == (1280, 720)


@pytest.mark.parametrize(('given', 'prefix'), [({}, 'rig_a/'), ({'frame_prefix': 'b_'}, 'b_')])
def test_frames_of_two_rigs_have_different_names(graph, probe, rig_file, given, prefix):
    graph.add(partial(SimNode, namespace='rig_a'), rig_file=rig_file, **SMALL, **given)
    topic = f'rig_a/{topics.camera_info_topic(1)}'
    probe.listen(CameraInfo, topic, qos.LATCHED)
    assert probe.last(topic).header.frame_id == f'{prefix}camera_1_optical'


def test_nothing_is_made_that_nobody_sees(graph, probe):
    sim = graph.add(SimNode, resend_period=0.05, **SMALL)
    policy = graph.add(PolicyNode)
    views = (sim._cloud_view, sim._rig_view, policy._cloud_view)
    graph.until(lambda: sim.episode.turn.step >= 2)
    assert not any(publisher.messages_made for view in views for publisher in view._publishers)
    for topic in (*CLOUDS, *TRUE_CLOUDS):
        probe.listen(PointCloud2, topic, qos.LATCHED)
    probe.listen(MarkerArray, topics.MARKERS, qos.LATCHED)
    for topic in probe.received:
        probe.last(topic)
    # And again when there is something new.
    step = sim.episode.turn.step
    graph.until(lambda: sim.episode.turn.step > step + 1 or sim.episode.turn.truncated)
    graph.until(lambda: all(len(heard) >= 2 for heard in probe.received.values()))


def test_the_policy_shows_what_it_knows(probe, room):
    probe.start_policy(max_range=3.0)
    for topic in CLOUDS:
        probe.listen(PointCloud2, topic, qos.LATCHED)
    probe.send_turn(7, room.points, positions_to_msg(POSITIONS, Header()))
    coverage, error = map(probe.last, CLOUDS)
    expected = observed_maps(room.points, [Pose.of(p) for p in POSITIONS],
                             (CameraModel(max_range=3.0),))
    assert coverage.header == error.header == Header(stamp=ns_to_stamp(7), frame_id='map')
    np.testing.assert_array_equal(values_of(coverage), expected.count)
    assert values_of(error).sum() == pytest.approx(expected.error.sum(), rel=1e-4)
    # No camera sees farther than its range.
    away = np.linalg.norm(msg_to_cloud(coverage)[:, None] - POSITIONS, axis=2)
    assert (away[values_of(coverage) > 0].min(axis=1) <= 3.0 + 1e-4).all()


@pytest.mark.parametrize('sensor', ['realsense_d455', 'azure_kinect_wfov'])
def test_a_camera_info_projects_as_the_camera_sees(sensor):
    model, rng = SENSORS[sensor].model, np.random.default_rng(0)
    info = camera_info(model, Header(frame_id='camera_0_optical'))
    assert (info.width, info.height) == model.resolution
    matrix = np.array(info.k).reshape(3, 3)
    assert np.array_equal(np.array(info.p).reshape(3, 4)[:, :3], matrix)
    inside = 0
    for x, y, z in rng.normal(size=(500, 3)):
        pixel = matrix @ [-y, -z, x]
        u, v = pixel[:2] / pixel[2] + 0.5
        shown = x > 0 and 0 <= u <= info.width and 0 <= v <= info.height
        assert shown == in_view(x, y, z, model.lens)
        inside += shown
    assert inside > 10


def test_cameras_without_an_image_have_no_camera_info():
    for model in (CameraModel(), SENSORS['velodyne_vlp16'].model,
                  CameraModel(horizontal_fov=1.0, vertical_fov=1.0)):
        assert camera_info(model, Header()) is None, model


def test_a_frustum_is_as_far_and_as_wide_as_the_camera_sees():
    model = SENSORS['realsense_d435'].model
    pose = Pose(np.array([1.0, 2.0, 1.9]), rotation_matrix(0.7, 0.4, 0.2))
    away = frustum_edges(pose, model) - pose.position
    far = away[np.linalg.norm(away, axis=1) > 1e-9]
    np.testing.assert_allclose(np.linalg.norm(far, axis=1), model.max_range)
    body = far @ pose.rotation
    assert all(in_view(*(corner * [1, 0.999, 0.999]), model.lens) for corner in body)
    assert not any(in_view(*(corner * [1, 1.001, 1]), model.lens) for corner in body)
    assert not any(in_view(*(corner * [1, 1, 1.001]), model.lens) for corner in body)


def test_markers_show_frusta_or_ranges_and_ways():
    models = (SENSORS['realsense_d455'].model, CameraModel(), SENSORS['velodyne_vlp16'].model)
    poses = [Pose.of(position) for position in POSITIONS]
    drawn = rig_markers(np.array([POSITIONS - 0.3, POSITIONS]), poses, models, Header()).markers
    kinds = {(marker.ns, marker.id): marker for marker in drawn}
    assert set(kinds) == {(ns, k) for ns in ('cameras', 'trajectories') for k in range(3)} | {
        ('frusta', 0), ('ranges', 1), ('ranges', 2)}
    assert kinds['frusta', 0].type == Marker.LINE_LIST and len(kinds['frusta', 0].points) == 16
    assert kinds['ranges', 2].scale.x == 200.0
    assert [len(kinds['trajectories', k].points) for k in range(3)] == [2, 2, 2]


SHOWN = {'sensor_msgs/msg/PointCloud2', 'visualization_msgs/msg/MarkerArray',
         'geometry_msgs/msg/PoseArray'}


def test_rviz_shows_every_topic_that_can_be_shown():
    manager = yaml.safe_load((ROOT / 'config' / 'ocp.rviz').read_text())['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == 'map'
    latched = {topics.SCENE, topics.MARKERS, topics.RIG_MARKERS, topics.PLACEMENT, *CLOUDS,
               *TRUE_CLOUDS}
    # Relative names, so that RViz in a namespace shows the topics of this namespace.
    found = {display['Topic']['Value']: (
        display['Class'].split('/')[1], display['Topic']['Durability Policy'],
        display['Topic']['Reliability Policy'])
        for display in manager['Displays'] if 'Topic' in display}
    assert found == {
        topic: (kind.split('/')[2], 'Transient Local' if topic in latched else 'Volatile',
                'Reliable') for topic, kind in topics.TYPES.items() if kind in SHOWN}


def test_foxglove_shows_every_topic_that_can_be_shown():
    layout = json.loads((ROOT / 'config' / 'ocp_foxglove.json').read_text())
    shown = {'3D': SHOWN, 'Plot': {'std_msgs/msg/Float64'}, 'RawMessages': {'std_msgs/msg/String'}}

    def names(tree):
        return [tree] if isinstance(tree, str) else names(tree['first']) + names(tree['second'])

    assert sorted(names(layout['layout'])) == sorted(layout['configById'])
    seen = set()
    for name, panel in layout['configById'].items():
        kind = name.split('!')[0]
        assert kind != '3D' or panel['followTf'] == 'map'
        paths = panel.get('topics') or [path['value'] for path in panel.get('paths', [])] or [
            panel['topicPath']]
        found = {path.removesuffix('.data').lstrip('/') for path in paths}
        assert {topics.TYPES[topic] for topic in found} <= shown[kind]
        seen |= found
    assert seen == {topic for topic, kind in topics.TYPES.items()
                    if kind in set().union(*shown.values())}


def test_the_types_of_topics_are_those_that_nodes_publish(graph, tmp_path):
    graph.add(SimNode, **SMALL)
    graph.add(PolicyNode, cloud_topics='points', manual=True)
    policy = graph.add(PolicyNode, planner='learned', explore=True)
    graph.add(TrainerNode, folder=str(tmp_path))

    def found():
        kinds = {name.lstrip('/'): kinds for name, kinds in policy.get_topic_names_and_types()}
        return {topic: kinds.get(topic) for topic in topics.TYPES}

    expected = {topic: [kind] for topic, kind in topics.TYPES.items()}
    graph.until(lambda: found() == expected)


@pytest.fixture
def tf(probe):
    """Return a probe that listens to frames."""
    message = pytest.importorskip('tf2_msgs.msg', reason='ROS without tf2_msgs').TFMessage
    probe.listen(message, '/tf', qos.LOOP)
    probe.listen(message, '/tf_static', qos.LATCHED)
    return probe


def frames(message):
    """Return where each child is: (parent, position, rotation)."""
    return {one.child_frame_id: (
        one.header.frame_id, np.array([getattr(one.transform.translation, axis)
                                       for axis in 'xyz']),
        rotation_of(one.transform.rotation, 'a frame')) for one in message.transforms}


def test_a_frame_is_where_its_camera_is():
    pose = Pose(np.array([1.0, -2.0, 0.5]), rotation_matrix(0.7, -0.3, 0.2) @ OPTICAL_TO_BODY)
    made = transform_to_msg(Header(frame_id='/map'), 'camera_3', pose)
    assert (made.header.frame_id, made.child_frame_id) == ('map', 'camera_3')
    np.testing.assert_allclose(rotation_of(made.transform.rotation, ''), pose.rotation, atol=1e-9)
    assert made.transform.translation.y == -2.0


def test_a_simulation_publishes_the_frames_of_its_cameras(tf, graph):
    sim = graph.add(SimNode, **SMALL, rig__cameras=2, resend_period=0.05)
    found, fixed = frames(tf.last('/tf')), frames(tf.last('/tf_static'))
    assert set(found) == {'camera_0', 'camera_1'}
    for camera, row in enumerate(sim.episode.placement):
        parent, position, rotation = found[f'camera_{camera}']
        assert parent == 'map'
        np.testing.assert_allclose(position, row[:3], atol=1e-9)
        np.testing.assert_allclose(rotation, Pose.of(row).rotation, atol=1e-9)
        np.testing.assert_array_equal(fixed[f'camera_{camera}_link'][2], np.eye(3))
        np.testing.assert_allclose(fixed[f'camera_{camera}_optical'][2], OPTICAL_TO_BODY,
                                   atol=1e-12)
    # Between turns time goes on, and a stamp comes once.
    graph.until(lambda: len(tf.received['/tf']) > 3)
    stamps = [Time.from_msg(one.transforms[0].header.stamp).nanoseconds
              for one in tf.received['/tf']]
    assert (np.diff(stamps) > 0).all()


def test_who_wants_none_gets_none(tf, graph):
    graph.add(SimNode, **SMALL, publish_tf=False)
    graph.until(lambda: tf.node.get_publishers_info_by_topic('/markers'))
    assert not tf.node.get_publishers_info_by_topic('/tf')


@pytest.mark.parametrize('known', [False, True])
def test_live_cameras_have_frames_unless_somebody_else_publishes_them(tf, graph, room, known):
    if known:
        tf2_ros = pytest.importorskip('tf2_ros', reason='ROS without tf2')
        tf2_ros.StaticTransformBroadcaster(tf.node).sendTransform(
            transform_to_msg(Header(frame_id='map'), 'camera_1', Pose(np.zeros(3), np.eye(3))))
        tf.last('/tf_static')
    tf.listen(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    policy = graph.add(PolicyNode, planner='lookahead', cloud_topics='points_0,points_1,points_2')
    if known:
        listener = policy.source._transforms
        graph.until(lambda: listener.has_transform('camera_1', 'map'))
    rig = graph.add(lambda **kwargs: Rig(episode_in(room), (BODY,) * 3, **{
        **kwargs, 'parameter_overrides': []}))
    tf.received['/tf'].clear()
    start = rig.positions.copy()
    tf.last(topics.CAMERA_COMMANDS)
    own = [0, 2] if known else [0, 1, 2]
    found = frames(tf.last('/tf'))
    assert sorted(found) == [f'camera_{camera}' for camera in own]
    # They follow the poses, not the turns.
    graph.until(lambda: not np.allclose(rig.positions, start, atol=0.01) and all(
        np.allclose(frames(tf.received['/tf'][-1])[f'camera_{k}'][1], rig.positions[k], atol=1e-6)
        for k in own))
