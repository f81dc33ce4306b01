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

"""Clouds of any frame come to that of the poses, or are refused with what to do."""

from functools import partial
import sys
from types import ModuleType

from benchmarks.drills.live_rig import BODY, CAMERAS, episode_in, HEADINGS, Rig
from conftest import counted, farthest_distance, status
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
import numpy as np
from ocp_ros.geometry.cameras import OPTICAL_TO_BODY, Pose, rotation_matrix
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import MessageError, msg_to_cloud, ns_to_stamp
from ocp_ros.ros.interface.frames import LiveRig, points_in_range, transform_cloud, Transforms
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.util.settings import ConfigurationError
import pytest
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

POSES = [Pose(np.array([1.0, 2.0, 1.9]), rotation_matrix(0.5 * np.pi, 0.0, 0.0)),
         Pose(np.array([4.0, 2.0, 1.9]), rotation_matrix(0.0, 0.5 * np.pi, 0.0))]
RIG = LiveRig('map', POSES, standing_since_ns=10)


@pytest.fixture
def no_tf2(monkeypatch):
    """Return transforms where tf2 is not installed."""
    monkeypatch.setitem(sys.modules, 'tf2_ros', None)
    return Transforms(None)


def points(*rows):
    """Return a cloud."""
    return np.array(rows, dtype=np.float32)


@pytest.mark.parametrize('frame', ['map', '/map'])
def test_a_cloud_in_the_frame_of_the_poses_stays_as_it_is(no_tf2, frame):
    cloud = points([1, 2, 3], [0, 0, 0], [0, 0, 1])
    found, seen_from = transform_cloud(cloud, frame, RIG, no_tf2)
    # The origin is what sensors send where they see nothing.
    np.testing.assert_array_equal(found, cloud[[0, 2]])
    np.testing.assert_allclose(seen_from, [pose.position for pose in POSES])


@pytest.mark.parametrize(('frame', 'row', 'expected'), [
    # One metre ahead: camera 0 looks along y, camera 1 straight down.
    ('/camera_0', [1, 0, 0], [1, 3, 1.9]), ('camera_0', [0, 1, 0], [0, 2, 1.9]),
    ('camera_1', [1, 0, 0], [4, 2, 0.9]), ('camera_1_optical', [0, 0, 1], [4, 2, 0.9]),
    # To the right in the image, and down in it.
    ('camera_0_optical', [1, 0, 0], [2, 2, 1.9]), ('camera_0_optical', [0, 1, 0], [1, 2, 0.9])])
def test_a_cloud_of_a_camera_is_placed_by_its_pose(no_tf2, frame, row, expected):
    found, seen_from = transform_cloud(points([0, 0, 0], row), frame, RIG, no_tf2)
    np.testing.assert_allclose(found, [expected], atol=1e-6)
    assert found.dtype == np.float32
    np.testing.assert_allclose(seen_from, [POSES['1' in frame].position])


@pytest.mark.parametrize('frame', ['rig_a/camera_0', '/rig_a/camera_0', 'camera_0'])
def test_a_rig_knows_the_frames_of_its_cameras_among_those_of_other_rigs(no_tf2, frame):
    rig = RIG._replace(prefix='rig_a/')
    found, _ = transform_cloud(points([1, 0, 0]), frame, rig, no_tf2)
    np.testing.assert_allclose(found, [[1, 3, 1.9]], atol=1e-6)
    with pytest.raises(MessageError, match='rig_b/camera_0'):
        transform_cloud(points([1, 0, 0]), 'rig_b/camera_0', rig, no_tf2)


@pytest.mark.parametrize('frame', ['camera_2', 'camera_00002', 'camera_-1', 'camera_0_depth', '',
                                   'odom', 'camera_' + '9' * 5000])
def test_a_frame_that_nobody_knows_is_refused_with_what_to_do(no_tf2, frame):
    with pytest.raises(MessageError, match='map.*camera_<i>_optical.*0 to 1.*tf2_ros'):
        transform_cloud(points([1, 0, 0]), frame, RIG, no_tf2)


@pytest.fixture
def tf2(monkeypatch):
    """Return a dictionary of transforms by frame, and what looks them up."""
    known, module = {}, ModuleType('tf2_ros')

    class Buffer:

        def lookup_transform(self, target, source, time):
            if source not in known:
                raise LookupError(f'{source} does not exist')
            assert target == 'map' and time.nanoseconds == 0
            return known[source]

        def can_transform(self, target, source, time):
            return source in known

        def clear(self):
            known.clear()

    module.Buffer, module.TransformException = Buffer, LookupError
    module.TransformListener = lambda buffer, node: None
    monkeypatch.setitem(sys.modules, 'tf2_ros', module)
    return known, Transforms(None)


def transform(stamp=0, xyz=(5.0, 0.0, 1.0), xyzw=(0.0, 0.0, 1.0, 1.0)):
    """Return a transform, a quarter of a turn to the left unless told otherwise."""
    found = TransformStamped(header=Header(stamp=ns_to_stamp(stamp), frame_id='map'))
    found.transform.translation = Vector3(**dict(zip('xyz', xyz)))
    found.transform.rotation = Quaternion(**dict(zip('xyzw', xyzw)))
    return found


@pytest.mark.parametrize('stamp', [0, 10, 11])
def test_tf2_is_asked_for_other_frames(tf2, stamp):
    known, transforms = tf2
    known['lidar'] = transform(stamp)
    found, seen_from = transform_cloud(
        points([1, 0, 0], [0, 0, 0], [0, 2, 3]), 'lidar', RIG, transforms)
    np.testing.assert_allclose(found, [[5, 1, 1], [3, 0, 4]], atol=1e-6)
    # Which of the cameras it is, nobody knows.
    assert len(seen_from) == 2
    # Near a camera it is that camera's.
    known['lidar'] = transform(stamp, xyz=(4.0, 2.0, 1.7))
    _, seen_from = transform_cloud(points([1, 0, 0]), 'lidar', RIG, transforms)
    np.testing.assert_allclose(seen_from, [[4.0, 2.0, 1.7]])
    transforms.clear()
    with pytest.raises(MessageError, match="'lidar'"):
        transform_cloud(points([1, 0, 0]), 'lidar', RIG, transforms)


@pytest.mark.usefixtures('quick_lookahead')
@pytest.mark.parametrize('ending', ['_link', '_optical_frame'])
def test_a_policy_reads_the_poses_of_cameras_from_tf(tf2, graph, probe, room, ending):
    known, _ = tf2
    names = [f'lens_{k}{ending}' for k in range(CAMERAS)]
    rig = graph.add(partial(Rig, episode_in(room), (BODY,) * CAMERAS))
    rig.tells = False
    policy = graph.add(PolicyNode, planner='lookahead', cloud_timeout=0.5, voxel_size=0.001,
                       cloud_topics=[f'points_{k}' for k in range(CAMERAS)], camera_frames=names)
    graph.until(lambda: f"'{names[0]}'" in status(policy)[1])

    def publish():
        for name, position, heading in zip(names, rig.positions, HEADINGS):
            rotation = rotation_matrix(*heading) @ (np.eye(3) if ending == '_link'
                                                    else OPTICAL_TO_BODY)
            known[name] = transform(rig.stamp, position, Rotation.from_matrix(rotation).as_quat())

    probe.node.create_timer(0.02, publish)
    probe.listen(PointCloud2, topics.OBSERVATION, qos.LOOP)
    expected = rig.episode.observed_cloud
    found = msg_to_cloud(probe.last(topics.OBSERVATION))
    assert farthest_distance(found, expected) < 1e-4 and farthest_distance(expected, found) < 1e-4
    # The cameras were seen to arrive: another turn is answered.
    graph.until(lambda: counted(policy, 'turns_answered') >= 2)
    assert counted(policy, 'late_turns') == 0


def test_poses_from_tf_without_tf2_are_refused(no_tf2, graph):
    with pytest.raises(ConfigurationError, match='camera_frames: .*tf2_ros'):
        graph.add(PolicyNode, planner='lookahead', cloud_topics='points', camera_frames='lens')


@pytest.mark.parametrize(('spoilt', 'words'), [
    (transform(stamp=9), 'older'), (transform(xyz=(np.nan, 0.0, 0.0)), 'nan'),
    (transform(xyzw=(0.0, 0.0, 0.0, 0.0)), 'quaternion')])
def test_a_transform_that_is_of_no_use_is_refused(tf2, spoilt, words):
    known, transforms = tf2
    known['lidar'] = spoilt
    with pytest.raises(MessageError, match=f"'lidar'.*{words}"):
        transform_cloud(points([1, 0, 0]), 'lidar', RIG, transforms)


def test_points_out_of_range_of_their_nearest_camera_are_cut(no_tf2):
    cloud = points([0, 0, 0], [1, 0, 0], [2.1, 0, 0], [2.9, 0, 0], [4, 0, 0], [7, 0, 0])
    one, two = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    np.testing.assert_allclose(points_in_range(cloud, one, 0.5, 2.0), cloud[[1]])
    np.testing.assert_allclose(points_in_range(cloud, two, 0.5, 2.0), cloud[[1, 4, 5]])
    np.testing.assert_allclose(points_in_range(cloud, two, 0.0, 9.0), cloud)
    # So are those too far out for numbers.
    far = points([3e38, 3e38, 3e38], [-3e38, 3e38, 0], [1, 0, 0])
    turned = [Pose(np.array([1e300, 0.0, 0.0]), POSES[0].rotation),
              Pose(np.zeros(3), rotation_matrix(0.7, 0.7, 0.7))]
    for number, kept in ((0, 0), (1, 1)):
        found, seen_from = transform_cloud(far, f'camera_{number}', LiveRig('map', turned), no_tf2)
        assert len(points_in_range(found, seen_from, 0.0, 100.0)) == kept


@pytest.mark.parametrize('optical', [False, True])
def test_points_with_the_axes_of_the_other_convention_are_refused(no_tf2, optical):
    """Half a room behind the back of a camera would turn all commands by 90 degrees."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.6, 6.0, 500)
    aside, down = (rng.uniform(-slope, slope, 500) * depth for slope in (0.9, 0.5))
    clouds = {'camera_0': np.column_stack([depth, aside, down]),
              'camera_0_optical': np.column_stack([aside, down, depth])}
    frame, other = sorted(clouds, reverse=optical)
    with pytest.raises(MessageError, match=f"'{other}'"):
        transform_cloud(clouds[other].astype(np.float32), frame, RIG, no_tf2)
    # What sees all around has no side ahead.
    for cloud in (clouds[frame], rng.normal(size=(500, 3))):
        assert len(transform_cloud(cloud.astype(np.float32), frame, RIG, no_tf2)[0]) == 500
