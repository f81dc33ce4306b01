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
from dataclasses import replace
import subprocess
import sys

from conftest import counted, header_at, l_shaped, random_checkpoint, SMALL, status, warnings_of
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.cli import main as cli
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.online.step import play
from ocp_ros.policy.checkpoint import CheckpointError
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    bytes_to_msg,
    cloud_to_msg,
    fields_to_msg,
    msg_to_positions,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.policy.decider import make_planner
from ocp_ros.ros.policy.policy_config import PLANNERS
from ocp_ros.ros.policy.simulated_turns import MAX_STORED
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.util.settings import ConfigurationError
import pytest
from sensor_msgs.msg import PointField
from std_msgs.msg import Float64MultiArray, Header, UInt8MultiArray
import torch

POSITIONS = np.array([[4.0, 4.0, 1.9], [5.0, 4.0, 1.9], [4.0, 5.0, 1.9]])
HEADINGS = np.deg2rad([[30.0, 10.0, 0.0], [-100.0, 20.0, 90.0], [40.0, 0.0, 0.0]])


@pytest.fixture
def robot(probe, model, room):
    """Return the probe as a rig: it sends turns and rewards, and hears commands."""
    probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)

    def start(**parameters):
        probe.policy = probe.start_policy(model=model, **parameters)
        probe.rewards = probe.publisher(Float64MultiArray, topics.REWARD, qos.LOOP)
        return probe.policy

    def play(*stamps, cloud=room.points, positions=POSITIONS, headings=None):
        for stamp in stamps:
            probe.send_turn(stamp, cloud, positions_to_msg(positions, Header(), headings))
            answer = probe.command(stamp)
        return msg_to_positions(answer)

    def say(stamp, **fields):
        probe.rewards.publish(reward(stamp, **fields))
        probe.graph.until(lambda: stamp in probe.policy.source.rewards)

    probe.start, probe.play_turns, probe.say = start, play, say
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
        positions = robot.play_turns(stamp, cloud=l_shaped().points, positions=positions)
    # At the walls of both arms, and straight ahead where there is room.
    assert positions[0, 0] < 3.0 and positions[1, 1] < 2.0
    assert (positions[2, :2] > 2.5).all()


def test_a_turn_is_answered_whose_parts_are_never_the_latest_together(robot, room):
    """Somebody else publishes as well, and this node takes one message of each kind at a time."""
    policy = robot.start()
    turns = policy.source
    for other in range(10, 40, 2):
        turns.on_poses(positions_to_msg(POSITIONS, header_at(5)))
        turns.on_cloud(cloud_to_msg(room.points, header_at(other)))
        for stamp in (other, other + 1):
            turns.on_poses(positions_to_msg(POSITIONS + 1e6, header_at(stamp)))
        turns.on_cloud(cloud_to_msg(room.points, header_at(5)))
    robot.command(5)
    # Parts of different turns are no turn.
    assert counted(policy, 'turns_answered') == 1
    assert len(turns.poses) <= MAX_STORED
    # What was not answered is older than what was, and forgotten.
    robot.play_turns(50)
    assert list(turns.poses) == [50]


def test_a_turn_sent_again_gets_the_same_answer(robot):
    policy = robot.start(explore=True)
    robot.play_turns(7, 7)
    heard = robot.received[topics.CAMERA_COMMANDS]
    robot.graph.until(lambda: len(heard) >= 2)
    assert heard[0] == heard[1] and counted(policy, 'turns_answered') == 1


def test_commands_stay_inside_the_observed_bounds(robot, room):
    robot.start(wall_margin=0.3)
    low, high = room.bounds
    corners = np.array([[low[0], low[1], 1.9], [high[0], high[1], 1.9], [50.0, -50.0, 1.9]])
    for stamp in range(1, 4):
        found = robot.play_turns(stamp, positions=corners)
        # A camera that is far outside comes nearer, but no faster than it may.
        assert (found[:2, :2] >= low[:2] + 0.3 - 1e-6).all()
        assert (found[:2, :2] <= high[:2] - 0.3 + 1e-6).all()
        assert np.linalg.norm(found[2] - corners[2]) == pytest.approx(0.5)
        assert found[2, 0] < corners[2, 0] and found[2, 1] > corners[2, 1]


def test_a_planner_that_fails_holds_the_cameras_and_the_node_lives(robot, monkeypatch, capfd):
    policy = robot.start(explore=True)

    def fail(*turn):
        raise MemoryError('none left')

    with monkeypatch.context() as patched:
        patched.setattr(policy.planner, 'move', fail)
        np.testing.assert_allclose(robot.play_turns(1), POSITIONS)
    assert 'MemoryError' in capfd.readouterr().err
    assert not np.allclose(robot.play_turns(2), POSITIONS)
    # So does what the network cannot say.
    with torch.no_grad():
        policy.policy.actor.mu.bias.fill_(float('nan'))
    np.testing.assert_allclose(robot.play_turns(3), POSITIONS)


def far_point(cloud, poses):
    """Show a single point so far away that a camera inside its box would be nowhere."""
    cloud.width, cloud.row_step = 1, 12
    cloud.data = array('B', np.float32([1e20, 1e20, 1e20]).tobytes())


def without_points(cloud, poses):
    """Show nothing at all."""
    cloud.width, cloud.row_step, cloud.data = 0, 0, []


def test_turns_that_cannot_be_used_are_refused_and_the_next_ones_are_answered(robot, room):
    policy = robot.start()
    warnings = warnings_of(policy)
    for stamp, (spoil, word) in enumerate((
            (lambda cloud, poses: setattr(cloud, 'data', cloud.data[:-5]), 'cloud: '),
            (lambda cloud, poses: setattr(cloud.fields[0], 'datatype', PointField.INT32), 'cloud'),
            (lambda cloud, poses: setattr(cloud.header, 'frame_id', 'camera_0'), 'camera_0'),
            (far_point, 'apart'), (without_points, 'no finite point'),
            (lambda cloud, poses: setattr(poses.poses[1].position, 'x', np.nan), 'poses: ')),
            start=1):
        cloud = cloud_to_msg(room.points, header_at(10 * stamp))
        poses = positions_to_msg(POSITIONS, header_at(10 * stamp))
        spoil(cloud, poses)
        refused = counted(policy, 'refused_messages')
        robot.poses.publish(poses)
        robot.clouds.publish(cloud)
        robot.graph.until(lambda: counted(policy, 'refused_messages') > refused)
        assert 'message refused' in warnings[-1] and word in warnings[-1]
        robot.play_turns(10 * stamp + 1)
    assert {stamp_to_ns(command.header.stamp) % 10
            for command in robot.received[topics.CAMERA_COMMANDS]} == {1}


def test_the_placement_is_final_and_held_when_the_turns_are_used_up(robot):
    robot.start(turns=1)
    outside = POSITIONS + [50.0, 0.0, 0.0]
    for stamp in (1, 2, 3):
        away = robot.play_turns(stamp, positions=outside) - outside
        np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.5 if stamp == 1 else 0.0,
                                   atol=1e-6)
    placement = robot.last(topics.PLACEMENT)
    assert stamp_to_ns(placement.header.stamp) == 2
    np.testing.assert_allclose(msg_to_positions(placement), outside)
    # A subscriber that comes late gets it too.
    robot.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
    assert robot.last(topics.PLACEMENT) == placement


def test_the_final_placement_is_a_file_that_can_be_judged(robot, room, tmp_path):
    path = tmp_path / 'new' / 'placement.json'
    robot.start(planner='lookahead', turns=1, placement_file=str(path), max_range=3.0)
    robot.play_turns(1, 2)
    placement = load_placement(path)
    np.testing.assert_allclose(placement.poses[:, :3], POSITIONS)
    assert {placed.camera.model for placed in placement.cameras} == {CameraModel(max_range=3.0)}
    assert 'turns' in placement.created['final']
    save_scene(room, tmp_path / 'room.ply')
    assert cli.main(['score', str(tmp_path / 'room.ply'), str(path)]) == 0


def test_the_final_placement_has_the_rig_and_how_its_cameras_are_turned(robot, tmp_path):
    (tmp_path / 'rig.yaml').write_text("""
        cameras: [{sensor: realsense_d455}, {sensor: omnidirectional}]
        fixed: [{sensor: realsense_d455, position: [4.0, 5.0, 1.9], yaw: 40}]""")
    robot.start(planner='lookahead', turns=1, rig_file=str(tmp_path / 'rig.yaml'),
                placement_file=str(tmp_path / 'placement.yaml'))
    robot.play_turns(1, 2, headings=HEADINGS)
    placement = load_placement(tmp_path / 'placement.yaml')
    assert [placed.mount for placed in placement.cameras] == ['plane', 'plane', 'fixed']
    np.testing.assert_allclose(placement.poses[0], [*POSITIONS[0], *HEADINGS[0]], atol=1e-4)
    assert placement.cameras[0].camera.model == SENSORS['realsense_d455'].model
    assert placement.rig.fixed_poses.shape == (1, 6)


def test_a_placement_that_cannot_be_written_is_published_all_the_same(robot, tmp_path, capfd):
    (tmp_path / 'file').write_text('')
    robot.start(planner='lookahead', turns=1,
                placement_file=str(tmp_path / 'file' / 'placement.yaml'))
    robot.play_turns(1, 2)
    assert len(robot.last(topics.PLACEMENT).poses) == 3
    assert 'file/placement.yaml' in capfd.readouterr().err


def test_cameras_of_a_policy_that_stands_still_are_placed_by_a_search(robot, monkeypatch):
    policy = robot.start(turns=6)
    monkeypatch.setattr(policy.policy, 'act', lambda *turn: np.zeros((3, 2)))
    positions = POSITIONS
    for stamp in range(1, 7):
        positions = robot.play_turns(stamp, positions=positions)
    assert np.abs(positions - POSITIONS).max() > 0.1
    assert not robot.received[topics.PLACEMENT]
    robot.play_turns(7, positions=positions)
    assert stamp_to_ns(robot.last(topics.PLACEMENT).header.stamp) == 7


@pytest.mark.parametrize('episode', [2, 0], ids=['the next', 'that of a restarted simulation'])
def test_a_new_episode_starts_the_turns_anew(robot, episode):
    robot.start(turns=1)
    np.testing.assert_allclose(robot.play_turns(1, 2), POSITIONS)
    robot.say(3, episode=episode, step=0)
    assert not np.allclose(robot.play_turns(3), POSITIONS)


def test_a_turn_waits_for_its_reward_but_not_for_ever(robot, room):
    policy = robot.start(turns=9)

    def send(stamp):
        policy.source.on_poses(positions_to_msg(POSITIONS, header_at(stamp)))
        policy.source.on_cloud(cloud_to_msg(room.points, header_at(stamp)))
        return counted(policy, 'turns_answered')

    robot.say(1)
    # The second turn's never comes, and the next one is answered at once.
    robot.play_turns(1, 2)
    assert send(3) == 3
    # That of the first turn of an episode was overtaken: it is not one more of the last episode.
    robot.say(4, step=9, truncated=True)
    np.testing.assert_allclose(robot.play_turns(4), POSITIONS)
    assert send(5) == 4
    policy.source.on_reward(reward(5, episode=2, step=0))
    assert counted(policy, 'turns_answered') == 5
    assert not np.allclose(msg_to_positions(robot.command(5)), POSITIONS)


def test_an_episode_goes_on_when_its_first_turn_is_sent_again(robot, monkeypatch):
    policy, resets = robot.start(), []
    monkeypatch.setattr(policy.planner, 'reset',
                        lambda: resets.append(counted(policy, 'step')))
    for stamp, step in ((1, 0), (1, 0), (2, 1), (2, 1)):
        robot.say(stamp, step=step)
        robot.play_turns(stamp)
    robot.say(3, episode=2, step=0)
    robot.play_turns(3)
    assert resets == [0, 2]


@pytest.mark.parametrize('late', [False, True])
def test_the_planner_is_told_which_turn_it_is(robot, monkeypatch, late):
    policy, told = robot.start(turns=30), []
    monkeypatch.setattr(policy.planner, 'move', lambda cloud, positions, turn, turns: (
        told.append((turn, turns)), np.zeros((3, 2)))[1])
    for stamp, step in ((1, 7), (2, 8), (3, 9)):
        if not late:
            robot.say(stamp, step=step)
        robot.play_turns(stamp)
        if late:
            robot.say(stamp, step=step)
    # If the reward of the first turn comes too late, the node counts from 0.
    assert told == [(0 if late else 7, 30), (8, 30), (9, 30)]


@pytest.mark.parametrize('late', [False, True])
def test_the_placement_is_final_when_the_simulation_says_that_it_was_the_last_turn(robot, late):
    policy = robot.start(turns=30)
    if not late:
        robot.say(1, step=5, truncated=True)
    robot.play_turns(1)
    if late:
        # Poses of another publisher are not those of the turn.
        policy.source.on_poses(positions_to_msg(POSITIONS + 1e6, header_at(9)))
        robot.say(1, step=5, truncated=True)
    placement = robot.last(topics.PLACEMENT)
    assert stamp_to_ns(placement.header.stamp) == 1
    np.testing.assert_allclose(msg_to_positions(placement), POSITIONS)


@pytest.mark.parametrize('lie', [{'truncated': True}, {'step': 10 ** 9}])
def test_rewards_of_no_turn_end_no_episode(robot, lie):
    policy = robot.start(turns=30)
    robot.say(10 ** 9, **lie)
    assert not np.allclose(robot.play_turns(1), POSITIONS)
    assert not policy.convergence.is_final and counted(policy, 'step') == 1


def test_weights_are_swapped_in_whole_and_refused_if_they_cannot_be_used(
        robot, small_agent, room):
    policy = robot.start(follow_trainer=True)
    encoder = policy.policy.encoder
    good, older, broken = (random_checkpoint(small_agent, seed=1, updates=updates, run='a')
                           for updates in (10, 9, 20))
    stranger = random_checkpoint(small_agent, seed=1, updates=30, run='b')
    other = random_checkpoint(replace(small_agent, hidden=8), updates=20, run='a')
    broken.weights['mu.bias'][0] = float('nan')
    blobs = [one.to_bytes() for one in (good, other, broken, older, stranger)]
    weights = robot.publisher(UInt8MultiArray, topics.POLICY_WEIGHTS, qos.LATCHED)
    for number, blob in enumerate([*blobs, blobs[0][:-7], b'', b'\xff' * 64]):
        weights.publish(bytes_to_msg(blob))
        robot.graph.until(lambda: counted(policy, 'weights_swapped')
                          + counted(policy, 'weights_refused') == number + 1)
    assert counted(policy, 'weights_swapped') == 1
    assert (policy.policy.checkpoint.run, policy.policy.checkpoint.updates) == ('a', 10)
    expected = POSITIONS.copy()
    expected[:, :2] += bounded_moves(Policy(good).act(room.points, POSITIONS), 0.5)
    np.testing.assert_allclose(robot.play_turns(1), expected, atol=1e-6)
    assert policy.policy.encoder is encoder


@pytest.mark.parametrize('planner', PLANNERS)
def test_an_episode_over_ros_is_the_episode_of_the_engine(graph, probe, model, checkpoint,
                                                          planner):
    turns, needs_weights = 5, planner != 'lookahead'
    sim = graph.add(SimNode, seed=3, resend_period=0.05, episode__turns=turns, **SMALL)
    probe.listen(PoseArray, topics.PLACEMENT, qos.LATCHED)
    policy = graph.add(PolicyNode, planner=planner, turns=turns,
                       model=model if needs_weights else 'nowhere')
    placement = msg_to_positions(probe.last(topics.PLACEMENT))
    assert sim.episode.turn.truncated and counted(policy, 'turns_answered') == turns + 1
    np.testing.assert_allclose(placement, sim.episode.turn.positions)
    online, _ = make_planner(policy.config, checkpoint if needs_weights else None)
    outcome = play(online, Episode(PlaneProblem(sim.simulator), np.random.default_rng(3)))
    np.testing.assert_allclose(placement, outcome.trajectory[-1], atol=1e-5)
    assert sim.episode.turn.depth_error == pytest.approx(outcome.depth_error[-1], abs=1e-3)


def test_a_policy_that_follows_no_trainer_takes_no_weights(robot):
    policy = robot.start()
    assert policy.policy is not None and policy.count_subscribers(topics.POLICY_WEIGHTS) == 0


def test_lookahead_has_no_weights(robot):
    policy = robot.start(planner='lookahead')
    assert policy.policy is None
    robot.play_turns(1)
    assert [counted(policy, name) for name in ('planner', 'weights_run', 'weights_updates')] == [
        'lookahead', '-', 0]


def test_exploring_draws_from_the_distribution_of_the_policy(robot, checkpoint, room):
    robot.start(explore=True, seed=5, planner='lookahead')
    policy, rng = Policy(checkpoint, Encoder(checkpoint.config)), np.random.default_rng(5)
    for turn in range(2):
        actions = policy.act(room.points, POSITIONS, turn, 30, rng)
        expected = POSITIONS.copy()
        expected[:, :2] += bounded_moves(actions, 0.5)
        np.testing.assert_allclose(robot.play_turns(turn + 1), expected, atol=1e-6)


def test_an_exploring_policy_ends_an_episode_without_a_placement(robot):
    policy, said = robot.start(explore=True), []
    policy.get_logger().info = said.append
    robot.play_turns(1)
    robot.say(1, step=5, truncated=True)
    assert status(policy)[1] == 'answering turns'
    robot.say(2, episode=2, step=0)
    robot.play_turns(2)
    assert not robot.received[topics.PLACEMENT] and not any('final' in text for text in said)


@pytest.mark.parametrize(('parameters', 'error', 'words'), [
    ({'planner': 'greedy'}, ConfigurationError, "planner: found 'greedy'"),
    # The message lists the models that are there.
    ({'planner': 'learned', 'model': 'nowhere'}, FileNotFoundError, "'nowhere' .*'actor'"),
    ({'planner': 'learned', 'model': 'pickle.safetensors'}, CheckpointError, 'pickle.safe')])
def test_a_planner_or_model_that_does_not_exist_is_refused(graph, tmp_path, monkeypatch,
                                                           parameters, error, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'pickle.safetensors').write_bytes(b'\x80\x04K\x01.')
    with pytest.raises(error, match=words):
        graph.add(PolicyNode, **parameters)


def test_what_runs_on_a_robot_starts_without_the_heavy_packages():
    """PyTorch comes with weights, and lookahead has none."""
    code = """import sys
heavy = {'open3d', 'stable_baselines3', 'matplotlib', 'gymnasium', 'cma'}
import ocp_ros.ros.policy_node
print(heavy & set(sys.modules), 'torch' in sys.modules)
import ocp_ros.policy.policy
print(heavy & set(sys.modules), 'torch' in sys.modules)"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.stdout == 'set() False\nset() True\n', done.stdout + done.stderr
