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

"""``guide_node`` beside ``policy_node`` on real DDS: what it shows, and what its buttons do."""

from functools import partial
import re

from benchmarks.drills.live_rig import episode_in, MAP, Rig
from conftest import counted, HUNG, status
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import msg_to_positions
from ocp_ros.ros.policy_node import PolicyNode
import pytest

pytest.importorskip('viser', reason='viser is not installed: pip install "ocp_ros[studio]"')
from benchmarks.page_client import PageClient  # noqa: E402, I100
from ocp_ros.ros.guide_node import GuideNode  # noqa: E402
from ocp_ros.studio import guide_page  # noqa: E402


@pytest.fixture
def guided(graph, probe, room):
    """Return a probe with a rig that a person moves, a policy_node and a guide_node."""
    probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
    probe.rig = graph.add(partial(Rig, episode_in(room), (MAP,) * 3))
    probe.rig.obeys = False
    probe.guide = graph.add(GuideNode, port=0)
    probe.policy = graph.add(PolicyNode, planner='lookahead', manual=True, turns=3, max_step=0.5,
                             cloud_topics='points_0,points_1,points_2', cloud_timeout=HUNG)
    graph.until(lambda: probe.guide.page.targets and probe.guide.page.poses
                and len(probe.guide.page.points) and probe.rig.target is not None)
    probe.press = probe.guide._pressed.append
    return probe


def test_the_page_shows_the_cloud_the_cameras_and_where_they_shall_go(guided):
    page = guided.guide.page
    guided.graph.until(lambda: 'camera 0: ' in page.text.content
                       and 'expected' in page.text.content
                       and '<svg' in page.plan.content)
    assert len(page.points) > 100
    assert 'not final: turn 1 of 3' in page.text.content
    with PageClient(guided.guide.url) as client:
        client.look()
        client.until(lambda message: message['type'] == 'PointCloudMessage')
    # The loop goes on when the guide ends.
    guided.graph.remove(guided.guide)
    guided.rig.go()
    guided.graph.until(lambda: counted(guided.policy, 'turns_answered') >= 2)


def test_arrived_ends_the_turn_where_the_cameras_stand(guided):
    policy = guided.policy
    guided.rig.episode.move(0.5 * (guided.rig.target - guided.rig.positions)[:, :2])
    stamp = guided.rig.stamp
    guided.graph.until(lambda: guided.rig.stamp > stamp + 300_000_000)
    assert counted(policy, 'turns_answered') == 1
    before = policy.config
    guided.press(guide_page.ARRIVED)
    # The guide changes nothing that would stay if it ended now.
    guided.graph.until(lambda: counted(policy, 'turns_answered') >= 2)
    assert policy.config is before


def test_accept_hold_go_on_and_reset(guided):
    page = guided.guide.page
    # The placement is final where the cameras stand.
    guided.press(guide_page.ACCEPT)
    placement = guided.last(topics.PLACEMENT)
    np.testing.assert_allclose(msg_to_positions(placement), guided.rig.positions, atol=1e-6)
    guided.graph.until(lambda: 'final after' in page.text.content)
    guided.press(guide_page.HOLD)
    guided.graph.until(lambda: status(guided.policy)[1] == 'paused')
    guided.graph.until(lambda: 'paused' in page.answer.content)
    guided.press(guide_page.GO_ON)
    guided.graph.until(lambda: status(guided.policy)[1] != 'paused')
    guided.press(guide_page.RESET)
    guided.graph.until(lambda: 'a new placement begins' in page.answer.content)


def test_a_guide_without_a_policy_says_so(graph):
    guide = graph.add(GuideNode, port=0)
    guide._pressed += [guide_page.RESET]
    graph.until(lambda: 'policy_node/reset; expected the one of policy_node' in (
        guide.page.answer.content))


def test_the_plan_shows_each_camera_and_its_target():
    pose, target = (Pose(np.array(place), np.eye(3))
                    for place in ([1.0, 2.0, 1.2], [2.2, 1.5, 1.5]))
    plan = guide_page.plan_svg(np.zeros((5, 3)), [pose], [target])
    assert plan.startswith('<svg') and len(re.findall('<circle', plan)) == 2
