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

"""``policy_node`` on real DDS."""

from array import array
from copy import deepcopy
from dataclasses import replace
import subprocess
import sys

from conftest import l_shaped, random_checkpoint, SMALL
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.online.rollout import play
from ocp_ros.policy.checkpoint import CheckpointError
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    bytes_to_msg,
    cloud_to_msg,
    fields_to_msg,
    msg_to_positions,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy.policy_config import PLANNERS, PolicyNodeConfig
from ocp_ros.ros.policy.policy_planners import make_planner
from ocp_ros.ros.policy.simulated_turns import MAX_STORED_POSES
from ocp_ros.ros.policy_node import has_news, PolicyNode
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.util.settings import ConfigurationError
import pytest
from rclpy.node import Node
from sensor_msgs.msg import PointField
from std_msgs.msg import Float64MultiArray, Header, UInt8MultiArray
import torch

POSITIONS = np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9], [4.0, 5.0, 1.9]])


@pytest.fixture
def model(checkpoint, tmp_path):
    """Return the path of random weights."""
    checkpoint.save(tmp_path / 'random.safetensors')
    return str(tmp_path / 'random.safetensors')


@pytest.fixture
def robot(probe, model, room):
    """Return the probe as a rig: it sends turns and hears commands."""
    probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)

    def start(**parameters):
        return probe.start_policy(
            model=model, **{'planner': 'learned_lookahead', **parameters})

    def send(stamp, cloud=room.points, positions=POSITIONS):
        probe.send_turn(stamp, cloud, positions_to_msg(positions, Header()))

    probe.start, probe.send = start, send
    return probe


def reward(stamp, episode=1, step=1, truncated=False):
    """Return the reward message of a turn."""
    return fields_to_msg({'stamp_sec': 0, 'stamp_nanosec': stamp, 'episode': episode,
                          'step': step, 'truncated': truncated})


def test_no_camera_is_sent_through_a_wall(robot, monkeypatch):
    """A camera beyond the wall of an L-shaped room would look through its back."""
    node = robot.start()
    monkeypatch.setattr(node.planner, 'move', lambda *turn: np.full((3, 2), 0.5))
    positions = np.array([[2.8, 3.0, 1.9], [4.0, 1.8, 1.9], [1.0, 1.0, 1.9]])
    for stamp in range(1, 6):
        robot.send(stamp, l_shaped().points, positions)
        positions = msg_to_positions(robot.command(stamp))
    # At the walls of both arms, and straight ahead where there is room.
    assert positions[0, 0] < 3.0 and positions[1, 1] < 2.0
    assert (positions[2, :2] > 2.5).all()


def test_a_command_answers_the_turn_it_belongs_to(robot, checkpoint, room):
    robot.start(planner='learned')
    robot.send(5)
    answer = robot.command(5)
    assert answer.header.frame_id == 'map'
    expected = POSITIONS.copy()
    expected[:, :2] += bounded_moves(Policy(checkpoint).act(room.points, POSITIONS), 0.5)
    np.testing.assert_allclose(msg_to_positions(answer), expected, atol=1e-6)


def test_the_parts_of_different_turns_are_not_mixed(robot, room):
    policy = robot.start()
    header = Header(stamp=ns_to_stamp(1), frame_id='map')
    robot.poses.publish(positions_to_msg(POSITIONS, header))
    robot.graph.until(lambda: policy._turns.poses)
    header.stamp = ns_to_stamp(2)
    robot.clouds.publish(cloud_to_msg(room.points, header))
    robot.graph.until(lambda: policy._turns.cloud is not None)
    assert policy._counts['turns_answered'] == 0
    robot.send(3)
    robot.command(3)
    assert policy._counts['turns_answered'] == 1


def test_a_turn_is_answered_whose_parts_are_never_the_latest_together(robot, room):
    """Somebody else publishes as well, and this node takes one message of each kind at a time."""
    turns = robot.start()._turns
    header = [Header(stamp=ns_to_stamp(stamp), frame_id='map') for stamp in range(100)]
    for other in range(10, 40, 2):
        turns.on_poses(positions_to_msg(POSITIONS, header[5]))
        turns.on_cloud(cloud_to_msg(room.points, header[other]))
        for stamp in (other, other + 1):
            turns.on_poses(positions_to_msg(POSITIONS + 1e6, header[stamp]))
        turns.on_cloud(cloud_to_msg(room.points, header[5]))
    robot.command(5)
    assert len(turns.poses) <= MAX_STORED_POSES
    # What was not answered is older than what was, and forgotten.
    robot.send(50)
    robot.command(50)
    assert list(turns.poses) == [50]


def test_the_placement_is_that_of_the_turn_whoever_else_publishes(robot):
    policy = robot.start()
    robot.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
    robot.send(8)
    robot.command(8)
    header = Header(stamp=ns_to_stamp(9), frame_id='map')
    policy._turns.on_poses(positions_to_msg(POSITIONS + 1e6, header))
    policy._turns.on_reward(reward(8, truncated=True))
    robot.graph.until(lambda: robot.received[topics.PLACEMENT])
    np.testing.assert_allclose(msg_to_positions(robot.received[topics.PLACEMENT][0]), POSITIONS)


def test_a_turn_sent_again_gets_the_same_answer(robot):
    policy = robot.start(explore=True)
    robot.send(7)
    first = robot.command(7)
    robot.send(7)
    robot.graph.until(lambda: len(robot.received[topics.CAMERA_COMMANDS]) >= 2)
    assert robot.received[topics.CAMERA_COMMANDS][-1] == first
    assert policy._counts['turns_answered'] == 1


def test_commands_stay_inside_the_observed_bounds(robot, room):
    robot.start(wall_margin=0.3)
    low, high = room.bounds
    corners = np.array([[low[0], low[1], 1.9], [high[0], high[1], 1.9], [50.0, -50.0, 1.9]])
    for stamp in range(1, 6):
        robot.send(stamp, positions=corners)
        found = msg_to_positions(robot.command(stamp))
        # Who is far outside comes nearer, but no faster than it may.
        assert (found[:2, :2] >= low[:2] + 0.3 - 1e-6).all()
        assert (found[:2, :2] <= high[:2] - 0.3 + 1e-6).all()
        assert np.linalg.norm(found[2] - corners[2]) == pytest.approx(0.5)
        assert found[2, 0] < corners[2, 0] and found[2, 1] > corners[2, 1]


def test_nan_from_the_network_holds_the_cameras(robot):
    policy = robot.start(explore=True)
    with torch.no_grad():
        policy.policy.actor.mu.bias.fill_(float('nan'))
    robot.send(1)
    np.testing.assert_allclose(msg_to_positions(robot.command(1)), POSITIONS)


@pytest.mark.parametrize('failure', [ZeroDivisionError('by 0'), MemoryError('none left')])
def test_a_planner_that_fails_holds_the_cameras_and_the_node_lives(robot, monkeypatch, capfd,
                                                                   failure):
    policy = robot.start()

    def fail(*turn):
        raise failure

    with monkeypatch.context() as patched:
        patched.setattr(policy.planner, 'move', fail)
        robot.send(1)
        np.testing.assert_allclose(msg_to_positions(robot.command(1)), POSITIONS)
    assert f'found {type(failure).__name__}: {failure}; cameras stay' in capfd.readouterr().err
    robot.send(2)
    assert not np.allclose(msg_to_positions(robot.command(2)), POSITIONS)


def _without_x(cloud):
    cloud.fields = cloud.fields[1:]


def _short(cloud):
    cloud.data = cloud.data[:-5]


def _of_integers(cloud):
    cloud.fields[0].datatype = PointField.INT32


def _beyond_the_point(cloud):
    cloud.fields[2].offset = 4000


def _overflowing(cloud):
    cloud.width = cloud.height = 2 ** 31


def _wrong_row_step(cloud):
    cloud.width, cloud.row_step = cloud.width - 1, 3


def _of_a_whole_town(cloud):
    cloud.data[:4] = array('B', np.float32(1e6).tobytes())


def _elsewhere(cloud):
    """Show a single point so far away that a camera inside its box would be nowhere."""
    cloud.width, cloud.row_step = 1, 12
    cloud.data = array('B', np.float32([1e20, 1e20, 1e20]).tobytes())


def _without_points(cloud):
    cloud.width, cloud.row_step, cloud.data = 0, 0, []


@pytest.mark.parametrize('spoil', [
    _without_x, _short, _of_integers, _beyond_the_point, _overflowing, _wrong_row_step,
    _of_a_whole_town, _elsewhere, _without_points])
def test_a_malformed_cloud_is_refused_and_the_node_lives(robot, room, spoil, capfd):
    policy = robot.start()
    header = Header(stamp=ns_to_stamp(1), frame_id='map')
    cloud = cloud_to_msg(room.points, header)
    spoil(cloud)
    robot.poses.publish(positions_to_msg(POSITIONS, header))
    robot.clouds.publish(cloud)
    robot.graph.until(lambda: policy._counts['refused_messages'] >= 1)
    assert 'message refused: cloud: found' in capfd.readouterr().err
    assert not robot.received[topics.CAMERA_COMMANDS]
    robot.send(2)
    robot.command(2)


def test_poses_with_nan_are_refused(robot):
    policy = robot.start()
    robot.send(1, positions=np.where(POSITIONS == 5.0, np.nan, POSITIONS))
    robot.graph.until(lambda: policy._counts['refused_messages'] >= 1)
    assert not robot.received[topics.CAMERA_COMMANDS]


def test_a_thousand_poses_are_refused_and_the_next_turn_is_answered(robot):
    policy = robot.start()
    robot.send(1, positions=np.tile(POSITIONS, (334, 1)))
    robot.graph.until(lambda: policy._counts['refused_messages'] >= 1)
    robot.send(2)
    assert len(robot.command(2).poses) == len(POSITIONS)


def test_a_message_that_waits_is_noticed_and_not_taken(graph, probe):
    heard = []
    listener = Node('listener', context=graph.context)
    listener.create_subscription(PoseArray, 'news', heard.append, qos.LOOP)
    publisher = probe.publisher(PoseArray, 'news', qos.LOOP)
    assert not has_news(listener)
    publisher.publish(PoseArray())
    graph.until(lambda: has_news(listener))
    assert has_news(listener) and not heard
    graph.executor.add_node(listener)
    graph.until(lambda: heard)
    assert not has_news(listener)
    listener.destroy_node()


def test_the_placement_is_final_when_the_turns_are_used_up(robot):
    robot.start(turns=2, convergence_distance=0.0)
    for stamp in (1, 2, 3):
        robot.send(stamp)
        robot.command(stamp)
    placement = robot.last(topics.PLACEMENT)
    assert stamp_to_ns(placement.header.stamp) == 3
    np.testing.assert_allclose(msg_to_positions(placement), POSITIONS)
    robot.send(4)
    np.testing.assert_allclose(msg_to_positions(robot.command(4)), POSITIONS)


def test_the_placement_is_final_when_the_cameras_of_a_policy_stand_still(robot):
    robot.start(planner='learned', convergence_distance=1.0, convergence_turns=2)
    for stamp in (1, 2, 3):
        robot.send(stamp)
        robot.command(stamp)
    assert stamp_to_ns(robot.last(topics.PLACEMENT).header.stamp) == 3


def test_cameras_of_a_policy_that_stands_still_are_placed_by_lookahead(robot, monkeypatch):
    policy = robot.start(turns=21, convergence_distance=0.02)
    monkeypatch.setattr(policy.policy, 'act', lambda *turn: np.zeros((3, 2)))
    positions = [POSITIONS]
    for stamp in range(1, 22):
        robot.send(stamp, positions=positions[-1])
        positions.append(msg_to_positions(robot.command(stamp)))
    assert np.abs(positions[-1] - positions[0]).max() > 0.1
    assert not policy._is_final
    robot.send(22, positions=positions[-1])
    assert stamp_to_ns(robot.last(topics.PLACEMENT).header.stamp) == 22


def test_who_comes_late_gets_the_placement(robot):
    robot.start(turns=1)
    for stamp in (1, 2):
        robot.send(stamp)
        robot.command(stamp)
    late = []
    robot.node.create_subscription(PoseArray, topics.PLACEMENT, late.append, qos.LATCHED)
    robot.graph.until(lambda: late)
    np.testing.assert_allclose(msg_to_positions(late[0]), POSITIONS)


def test_a_new_episode_starts_the_turns_anew(robot):
    policy = robot.start(turns=1)
    for stamp in (1, 2):
        robot.send(stamp)
        robot.command(stamp)
    assert policy._is_final
    rewards = robot.publisher(Float64MultiArray, topics.REWARD, qos.LOOP)
    rewards.publish(reward(3, episode=2, step=0))
    robot.graph.until(lambda: not policy._is_final)
    robot.send(3)
    assert not np.allclose(msg_to_positions(robot.command(3)), POSITIONS)


def test_a_turn_waits_for_its_reward_that_was_overtaken(robot, room):
    policy, truncated = robot.start(turns=5), reward(1, step=5, truncated=True)
    policy._turns.on_reward(truncated)
    robot.send(1)
    assert robot.command(1) and policy._is_final
    header = Header(stamp=ns_to_stamp(2), frame_id='map')
    policy._turns.on_poses(positions_to_msg(POSITIONS, header))
    policy._turns.on_cloud(cloud_to_msg(room.points, header))
    assert policy._counts['turns_answered'] == 1
    policy._turns.on_reward(reward(2, episode=2, step=0))
    # At once: it is the first turn of an episode, and not one more of what is over.
    assert policy._counts['turns_answered'] == 2 and not policy._is_final
    assert not np.allclose(msg_to_positions(robot.command(2)), POSITIONS)


def test_a_turn_whose_reward_never_comes_is_answered_and_the_next_ones_at_once(robot):
    policy = robot.start()
    policy._turns.on_reward(reward(1))
    for stamp in (1, 2):
        robot.send(stamp)
        assert robot.command(stamp)
    assert policy._turns._late.is_canceled()
    header = Header(stamp=ns_to_stamp(3), frame_id='map')
    policy._turns.on_poses(positions_to_msg(POSITIONS, header))
    cloud = policy._turns.cloud
    cloud.header = header
    policy._turns.on_cloud(cloud)
    assert policy._counts['turns_answered'] == 3


def test_a_restarted_simulation_is_a_new_episode_whatever_its_number(robot):
    policy = robot.start(turns=1)
    for stamp in (1, 2):
        robot.send(stamp)
        robot.command(stamp)
    assert policy._is_final
    rewards = robot.publisher(Float64MultiArray, topics.REWARD, qos.LOOP)
    rewards.publish(reward(3, episode=policy._episode, step=0))
    robot.graph.until(lambda: not policy._is_final)


def test_an_episode_goes_on_when_its_first_turn_is_sent_again(robot, monkeypatch):
    policy, resets = robot.start(), []
    monkeypatch.setattr(policy.planner, 'reset', lambda: resets.append(policy._step))
    rewards = robot.publisher(Float64MultiArray, topics.REWARD, qos.LOOP)
    for stamp, step in ((1, 0), (1, 0), (2, 1), (2, 1)):
        rewards.publish(reward(stamp, step=step))
        robot.graph.until(lambda: policy._turns.reward_stamp == stamp)
        robot.send(stamp)
        robot.command(stamp)
    rewards.publish(reward(3, episode=2, step=0))
    robot.graph.until(lambda: policy._episode == 2)
    assert resets == [0, 2]


@pytest.mark.parametrize('late', [False, True])
def test_the_planner_is_told_which_turn_it_is(robot, monkeypatch, late):
    policy, told = robot.start(turns=30), []
    monkeypatch.setattr(policy.planner, 'move', lambda cloud, positions, turn, turns: (
        told.append((turn, turns)), np.zeros((3, 2)))[1])
    rewards = robot.publisher(Float64MultiArray, topics.REWARD, qos.LOOP)
    for stamp, step in ((1, 7), (2, 8), (3, 9)):
        if not late:
            rewards.publish(reward(stamp, step=step))
            robot.graph.until(lambda: policy._turns.reward_stamp == stamp)
        robot.send(stamp)
        robot.command(stamp)
        if late:
            rewards.publish(reward(stamp, step=step))
            robot.graph.until(lambda: policy._turns.reward_stamp == stamp)
    # Who hears of the first turn too late counts from 0.
    assert told == [(0 if late else 7, 30), (8, 30), (9, 30)]


@pytest.mark.parametrize('late', [False, True])
def test_the_placement_is_final_when_the_simulation_says_that_it_was_the_last_turn(robot, late):
    policy = robot.start(turns=30, convergence_distance=0.0)
    rewards = robot.publisher(Float64MultiArray, topics.REWARD, qos.LOOP)
    if not late:
        rewards.publish(reward(1, step=5, truncated=True))
        robot.graph.until(lambda: policy._is_last_turn)
    robot.send(1)
    robot.command(1)
    if late:
        rewards.publish(reward(1, step=5, truncated=True))
    assert stamp_to_ns(robot.last(topics.PLACEMENT).header.stamp) == 1


def test_a_settled_policy_holds_the_cameras_wherever_they_are(robot, room):
    robot.start(turns=1)
    outside = POSITIONS + [50.0, 0.0, 0.0]
    for stamp in (1, 2, 3):
        robot.send(stamp, positions=outside)
        away = msg_to_positions(robot.command(stamp)) - outside
        np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.5 if stamp == 1 else 0.0,
                                   atol=1e-6)


def test_a_cloud_in_another_frame_than_the_poses_is_refused(robot, room):
    policy = robot.start()
    stamp = ns_to_stamp(1)
    robot.poses.publish(positions_to_msg(POSITIONS, Header(stamp=stamp, frame_id='map')))
    robot.clouds.publish(cloud_to_msg(room.points, Header(stamp=stamp, frame_id='camera_0')))
    robot.graph.until(lambda: policy._counts['refused_messages'] >= 1)
    assert not robot.received[topics.CAMERA_COMMANDS]


def test_weights_are_swapped_in_whole(robot, small_agent, room):
    policy = robot.start(planner='learned')
    encoder = policy.policy.encoder
    new = random_checkpoint(small_agent, seed=1, updates=10, run='a')
    weights = robot.publisher(UInt8MultiArray, topics.POLICY_WEIGHTS, qos.LATCHED)
    weights.publish(bytes_to_msg(new.to_bytes()))
    robot.graph.until(lambda: policy._counts['weights_swapped'] == 1)
    robot.send(1)
    expected = POSITIONS.copy()
    expected[:, :2] += bounded_moves(Policy(new).act(room.points, POSITIONS), 0.5)
    np.testing.assert_allclose(msg_to_positions(robot.command(1)), expected, atol=1e-6)
    assert policy.policy.encoder is encoder


def test_weights_that_cannot_be_used_are_refused(robot, small_agent):
    policy = robot.start()
    weights = robot.publisher(UInt8MultiArray, topics.POLICY_WEIGHTS, qos.LATCHED)
    good = random_checkpoint(small_agent, updates=10, run='a')
    other = random_checkpoint(replace(small_agent, hidden=8), updates=20, run='a')
    broken = deepcopy(good)
    broken.weights['mu.bias'][0] = float('nan')
    blobs = [good.to_bytes(), good.to_bytes()[:-7], b'', b'\xff' * 64, other.to_bytes(),
             broken.to_bytes(),
             random_checkpoint(small_agent, updates=9, run='a').to_bytes()]
    for number, blob in enumerate(blobs):
        weights.publish(bytes_to_msg(blob))
        robot.graph.until(lambda: sum(policy._counts[k] for k in (
            'weights_swapped', 'weights_refused')) == number + 1)
    assert policy._counts['weights_swapped'] == 1
    assert policy.policy.checkpoint.updates == 10


def test_a_killed_and_restarted_policy_continues_the_episode(graph, model):
    sim = graph.add(SimNode, resend_period=0.05, **SMALL)
    policy = graph.add(PolicyNode, planner='learned_lookahead', model=model,
                       convergence_distance=0.0)
    graph.until(lambda: sim.episode.turn.step >= 3)
    graph.remove(policy)
    step, observed = sim.episode.turn.step, sim.episode.observed
    policy = graph.add(PolicyNode, planner='learned_lookahead', model=model,
                       convergence_distance=0.0)
    graph.until(lambda: sim.episode.turn.step >= step + 3)
    assert sim._episodes == 1
    assert sim.episode.observed >= observed
    graph.until(lambda: policy._step >= step)


def test_an_episode_over_ros_is_the_episode_of_the_engine(graph, probe, model, checkpoint):
    sim = graph.add(SimNode, seed=3, **SMALL)
    probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
    graph.add(PolicyNode, planner='learned', model=model, convergence_distance=0.0)
    online, _ = make_planner(PolicyNodeConfig(planner='learned'), checkpoint)
    outcome = play(online, Episode(PlaneProblem(sim.simulator), np.random.default_rng(3)))
    placement = msg_to_positions(probe.last(topics.PLACEMENT))
    np.testing.assert_allclose(placement, outcome.trajectory[-1], atol=1e-6)
    assert sim.episode.turn.depth_error == pytest.approx(outcome.depth_error[-1], abs=1e-3)


@pytest.mark.parametrize('planner', PLANNERS)
def test_every_planner_answers_turns_until_the_placement_is_final(graph, probe, model, checkpoint,
                                                                  planner):
    needs_weights = planner != 'lookahead'
    turns = 8
    sim = graph.add(SimNode, seed=3, resend_period=0.05, episode__turns=turns, **SMALL)
    for topic, profile in ((topics.CAMERA_COMMANDS, qos.LOOP), (topics.PLACEMENT, qos.LATCHED)):
        probe.listen(PoseArray, topic, profile)
    first, cloud = sim.episode.turn, sim.episode.observed_cloud
    policy = graph.add(PolicyNode, planner=planner, turns=turns, convergence_distance=0.0,
                       model=model if needs_weights else 'nowhere')
    placement = msg_to_positions(probe.last(topics.PLACEMENT))
    assert sim.episode.turn.truncated and policy._counts['turns_answered'] == turns + 1
    np.testing.assert_allclose(placement, sim.episode.turn.positions)
    if planner != 'learned':
        assert sim.episode.turn.depth_error < 0.8 * first.depth_error
    # The first command is what the planner says on its own.
    online, _ = make_planner(policy.config, checkpoint if needs_weights else None)
    expected = first.positions[:, :2] + online.move(cloud, first.positions, 0, turns)
    found = msg_to_positions(probe.received[topics.CAMERA_COMMANDS][0])
    np.testing.assert_allclose(found[:, :2], expected, atol=1e-5)


def test_lookahead_takes_no_weights(robot, small_agent):
    policy = robot.start(planner='lookahead')
    assert policy.policy is None
    assert policy.count_subscribers(topics.POLICY_WEIGHTS) == 0
    robot.send(1)
    robot.command(1)
    values = policy._status()[2]
    assert (values['planner'], values['weights_run'], values['weights_updates']) == (
        'lookahead', '-', 0)


def test_exploring_asks_the_policy_whoever_is_the_planner(graph, model):
    policy = graph.add(PolicyNode, planner='lookahead', explore=True, model=model)
    assert policy.policy is not None and policy.planner.policy is policy.policy


def test_a_planner_that_does_not_exist_is_refused(graph):
    with pytest.raises(ConfigurationError, match="planner: found 'greedy'; expected one of"):
        graph.add(PolicyNode, planner='greedy')


def test_exploring_draws_from_the_distribution_of_the_policy(robot, checkpoint, room):
    robot.start(explore=True, seed=5)
    policy, rng = Policy(checkpoint, Encoder(checkpoint.config)), np.random.default_rng(5)
    for turn in range(2):
        robot.send(turn + 1)
        actions = policy.act(room.points, POSITIONS, turn, 30, rng)
        expected = POSITIONS.copy()
        expected[:, :2] += bounded_moves(actions, 0.5)
        np.testing.assert_allclose(
            msg_to_positions(robot.command(turn + 1)), expected, atol=1e-6)


def test_a_model_that_is_not_there_is_an_error_that_lists_those_that_are(graph):
    with pytest.raises(FileNotFoundError, match="no file 'nowhere' .*'map'"):
        graph.add(PolicyNode, planner='learned', model='nowhere')


def test_a_model_that_is_no_model_is_refused(graph, tmp_path):
    (tmp_path / 'pickle.safetensors').write_bytes(b'\x80\x04K\x01.')
    with pytest.raises(CheckpointError, match='pickle.safetensors: found no readable checkpoint'):
        graph.add(PolicyNode, planner='learned', model=str(tmp_path / 'pickle.safetensors'))


def test_it_starts_without_the_heavy_packages():
    # PyTorch comes with weights, and lookahead has none.
    heavy = "{'open3d', 'stable_baselines3', 'matplotlib', 'gymnasium', 'cma', 'torch'}"
    code = ('import sys, ocp_ros.ros.policy_node; '
            f'found = {heavy} & set(sys.modules); sys.exit(str(found) if found else 0)')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stderr
