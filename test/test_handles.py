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

"""Handles in RViz: nodes offer them where interactive_markers is there, and obey them."""

from functools import partial
import sys

from benchmarks.drills.live_rig import episode_in, MAP, Rig
from conftest import counted, HUNG, made_room, SMALL
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion
import numpy as np
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import msg_to_positions
from ocp_ros.ros.interface.handles import handle_of
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.ros.view_node import ViewNode
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
import pytest
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool
from visualization_msgs.msg import (
    InteractiveMarkerFeedback,
    InteractiveMarkerUpdate,
    MarkerArray,
)

MIDDLE = Pose(position=Point(x=2.0, y=1.5, z=1.9), orientation=Quaternion(w=1.0))


@pytest.fixture
def hand(probe):
    """Return a probe that moves handles as RViz does."""
    pytest.importorskip('interactive_markers', reason='it comes with ROS 2 from apt')
    probe.listen(InteractiveMarkerUpdate, f'{topics.HANDLES}/update', 100)
    feedback = probe.publisher(InteractiveMarkerFeedback, f'{topics.HANDLES}/feedback', 10, 0)

    def drag(camera, pose, done):
        def tried():
            # For a second, a new handle is refused to a client that it does not know.
            feedback.publish(InteractiveMarkerFeedback(
                client_id='rviz', marker_name=f'camera_{camera}', pose=pose,
                event_type=InteractiveMarkerFeedback.MOUSE_UP))
            return done()
        probe.graph.until(lambda: f'camera_{camera}' in handles(probe))
        probe.graph.until(tried)
    probe.drag = drag
    return probe


def handles(probe):
    """Return the latest pose of each handle."""
    found = {}
    for message in probe.received[f'{topics.HANDLES}/update']:
        found |= {one.name: one.pose for one in (*message.markers, *message.poses)}
    return found


def test_without_interactive_markers_nothing_changes(graph, monkeypatch):
    monkeypatch.setitem(sys.modules, 'interactive_markers', None)
    policy = graph.add(PolicyNode, planner='lookahead')
    assert not any(topics.HANDLES in name for name, _ in policy.get_topic_names_and_types())


def test_a_handle_has_an_arrow_and_a_ring_for_each_axis():
    handle = handle_of(2, MIDDLE, 'map')
    assert (handle.name, handle.header.frame_id, handle.header.stamp.sec) == ('camera_2', 'map', 0)
    axes = {(c.orientation.x, c.orientation.y, c.orientation.z, c.interaction_mode)
            for c in handle.controls}
    assert len(axes) == len({c.name for c in handle.controls}) == 6
    assert all(c.orientation.w ** 2 + max(c.orientation.x, c.orientation.y, c.orientation.z) ** 2
               == pytest.approx(1.0) for c in handle.controls)


def test_a_handle_moves_a_simulated_camera_while_the_policy_is_paused(graph, hand):
    sim = graph.add(SimNode, rig__cameras=2, episode__turns=30, **SMALL)
    policy = graph.add(PolicyNode, planner='lookahead')
    graph.until(lambda: counted(policy, 'turns_answered') >= 1)
    hand.call(SetBool, 'policy_node/pause', data=True)
    graph.until(lambda: sim._stamp in policy._turns.poses)
    before = sim.episode.turn.positions.copy()
    target = Pose(position=Point(x=before[1, 0] + 0.2, y=before[1, 1], z=before[1, 2]),
                  orientation=Quaternion(w=1.0))
    hand.drag(1, target, lambda: not np.allclose(sim.episode.turn.positions, before))
    np.testing.assert_allclose(sim.episode.turn.positions, before + [[0, 0, 0], [0.2, 0, 0]],
                               atol=1e-6)
    hand.call(SetBool, 'policy_node/pause', data=False)
    answered = counted(policy, 'turns_answered')
    graph.until(lambda: counted(policy, 'turns_answered') > answered)


def test_a_handle_gives_a_live_camera_another_target(graph, hand, room):
    rig = graph.add(partial(Rig, episode_in(room), (MAP,) * 3))
    rig.obeys = False
    policy = graph.add(PolicyNode, planner='lookahead', manual=True, turns=9,
                       cloud_topics='points_0,points_1,points_2', cloud_timeout=HUNG)
    graph.until(lambda: rig.target is not None)
    target = rig.target.copy()
    here = Point(**dict(zip('xyz', (rig.positions[2] + [0.4, 0.0, 0.0]).tolist())))
    hand.drag(2, Pose(position=here, orientation=Quaternion(w=float('nan'))),
              lambda: counted(policy, 'refused_messages'))
    assert np.array_equal(rig.target, target)
    target[2] = rig.positions[2] + [0.4, 0.0, 0.0]
    hand.drag(2, Pose(position=here, orientation=rig.commands[-1].poses[2].orientation),
              lambda: np.allclose(rig.target, target))
    assert counted(policy, 'turns_answered') == 1
    graph.until(lambda: rig.go() or counted(policy, 'turns_answered') >= 2)


def test_a_node_that_ends_removes_its_handles(graph, hand):
    graph.add(SimNode, rig__cameras=2, **SMALL)
    policy = graph.add(PolicyNode, planner='lookahead')
    graph.until(lambda: len(handles(hand)) == 2)
    graph.remove(policy)
    updates = hand.received[f'{topics.HANDLES}/update']
    graph.until(lambda: {name for message in updates for name in message.erases} == {
        'camera_0', 'camera_1'})


@pytest.fixture
def view(graph):
    """Return a view of two cameras."""
    rig = rig_of(2, 'realsense_d455', mount={'on': 'free'})
    problem = Problem.of(made_room(8, 2000), rig, SimulationConfig())
    poses = np.array([[2.0, 2.0, 1.8, 0.0, 0.1, 0.0], [3.0, 2.0, 1.8, 2.0, 0.1, 0.0]])
    return graph.add(partial(ViewNode, problem.objective, poses))


def test_a_view_of_a_placement_moves_its_cameras_as_commanded(graph, probe, view):
    for kind, topic in ((PoseArray, topics.CAMERA_POSES), (PointCloud2, topics.SCENE),
                        (MarkerArray, topics.MARKERS),
                        (PointCloud2, topics.TRUE_COVERAGE_CLOUD)):
        probe.listen(kind, topic, qos.LATCHED)
    command = probe.publisher(PoseArray, topics.CAMERA_COMMANDS, qos.LOOP)
    command.publish(PoseArray(poses=[MIDDLE]))
    command.publish(PoseArray(poses=[MIDDLE, MIDDLE]))
    graph.until(lambda: np.allclose(view.poses, [2.0, 1.5, 1.9, 0, 0, 0]))
    graph.until(lambda: np.allclose(msg_to_positions(probe.last(topics.CAMERA_POSES)),
                                    view.poses[:, :3]))
    assert probe.last(topics.SCENE).width == len(view.objective.simulator.scene)
    graph.until(lambda: probe.last(topics.MARKERS).markers[0].pose.position == MIDDLE.position)
    assert probe.last(topics.TRUE_COVERAGE_CLOUD).width == probe.last(topics.SCENE).width


def test_a_handle_moves_a_camera_of_a_view(hand, view):
    before = view.poses.copy()
    hand.drag(0, MIDDLE, lambda: not np.array_equal(view.poses, before))
    np.testing.assert_allclose(view.poses, [[2.0, 1.5, 1.9, 0, 0, 0], before[1]], atol=1e-9)
