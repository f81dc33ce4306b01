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

"""Episodes of rig files: the environment, ``sim_node``, training, and online planners in them."""

import json
import warnings

from conftest import MOUNTS, SMALL, status_of, TINY
from gymnasium.utils.env_checker import check_env
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.episode import Episode, PENALTY, potential
from ocp_ros.simulation.problem import make_problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.training.encoded_environment import playable
from ocp_ros.training.train import train
from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.util.settings import ConfigurationError, from_nested
import pytest

pytestmark = pytest.mark.usefixtures('quick_lookahead')
FAST = EngineConfig('fast', 32, 0.5)
TURNS = 5
#: In room 8, 7.0 x 7.5 m.
ANCHORED = """\
cameras: [{sensor: realsense_d455, count: 2}, {sensor: omnidirectional}]
fixed: [{sensor: realsense_d455, position: [6.0, 6.0, 1.9], yaw: 225, pitch: 25}]
pitch: [0, 60]
spacing: 0.6
keep_out: [{box: [[2.8, 2.8, 0], [4.0, 4.0, 3]]}]
regions: [{name: corner, box: [[0, 0, 0], [2, 2, 2]], weight: 2.0}]
"""


@pytest.fixture
def settings(tmp_path):
    """Return a function that makes settings of a rig file with a given text."""
    def write(text):
        (tmp_path / 'rig.yaml').write_text(text)
        return SimulationConfig(engine=FAST, episode=EpisodeConfig(TURNS),
                                rig_file=str(tmp_path / 'rig.yaml'))
    return write


def rig_text(sensor='realsense_d455', mount='plane', count=3):
    """Return a rig file of equal cameras."""
    return json.dumps({'cameras': [{'sensor': sensor, 'count': count}], 'mount': MOUNTS[mount],
                       'spacing': 0.5})


def poses_of(episode):
    """Return where the cameras to be placed are: (K, 6)."""
    return np.hstack([episode.turn.positions, episode.turn.headings])


@pytest.mark.parametrize(('sensor', 'mount', 'axes'), [
    ('omnidirectional', 'plane', ('x', 'y')), ('omnidirectional', 'free', ('x', 'y', 'z')),
    ('realsense_d455', 'plane', ('x', 'y', 'yaw', 'pitch')),
    ('realsense_d455', 'ceiling', ('x', 'y', 'yaw', 'pitch')),
    ('realsense_d455', 'walls', ('x', 'y', 'z', 'yaw', 'pitch'))])
def test_whatever_is_commanded_every_constraint_holds(room, settings, sensor, mount, axes):
    env = CameraPlacementEnv([room], settings(rig_text(sensor, mount)))
    assert env.axes == axes and env.action_space.shape == (3, len(axes))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        check_env(env, skip_render_check=True)
    observation, _ = env.reset(seed=3)
    assert ('camera_headings' in observation) == ('yaw' in axes)
    rng, region, poses = np.random.default_rng(0), env.episode.problem.region, []
    poses.append(poses_of(env.episode))
    for _ in range(TURNS):
        _, reward, _, truncated, info = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        poses.append(poses_of(env.episode))
        shares = sum(one.reward for one in env.episode.shares(range(3)))
        penalty = PENALTY * info['penalty']
        assert shares + penalty == pytest.approx(reward, abs=1e-9)
    assert truncated and all(region.broken(one) == [] for one in poses)
    steps = np.linalg.norm(np.diff(poses, axis=0)[..., :3], axis=2)
    assert steps.max() <= env.config.episode.max_step + 1e-9 and steps.sum() > 0.5
    assert ('yaw' in axes) == bool(np.abs(poses[-1] - poses[0])[:, 3:].max() > 0.05)


def test_cameras_in_place_see_and_stay_and_zones_are_kept_out_of(room, settings):
    env = CameraPlacementEnv([room], settings(ANCHORED))
    env.reset(seed=0)
    episode = env.episode
    alone = episode.simulator.look(episode.problem.fixed_poses[0], 3).seen
    assert alone.any() and (episode.observed.bits & alone == alone).all()
    # Straight towards the middle of the zone, turn after turn.
    penalties = 0.0
    for _ in range(TURNS):
        action = np.zeros((3, len(env.axes)))
        action[:, :2] = np.clip(3.4 - episode.turn.positions[:, :2], -1.0, 1.0)
        penalties += env.step(action)[4]['penalty']
        x, y = episode.turn.positions[:, :2].T
        assert (np.maximum(abs(x - 3.4), abs(y - 3.4)) >= 0.6).all()
        np.testing.assert_array_equal(episode.placement[3:], episode.problem.fixed_poses)
    assert penalties > 0.0


def test_rewards_count_what_regions_ask_for(room, settings):
    episode = Episode(make_problem(room, settings(ANCHORED)), np.random.default_rng(1))
    volume, worst = episode.simulator.volume, episode.simulator.depth_error.worst

    def worth():
        result = episode.problem.evaluate_views(episode.problem.look(poses_of(episode)))
        assert 1.5 * result.depth_error < result.loss * worst
        return potential(result.space_coverage, result.loss * worst, volume, worst)

    before = worth()
    for _ in range(2):
        terms, now = episode.move(np.full((3, 2), 0.2)).terms, worth()
        assert terms.reward == pytest.approx(now - before - terms.penalty, abs=1e-12)
        before = now


def test_a_rig_file_that_does_not_go_with_an_environment_is_refused(room, settings):
    with pytest.raises(ConfigurationError, match='fewest: found 2'):
        CameraPlacementEnv([room], settings(ANCHORED), fewest=2)
    with pytest.raises(ConfigurationError, match='rotations: .*rig.yaml'):
        CameraPlacementEnv([room], settings(ANCHORED), rotations=(0.0, 30.0))
    assert len(settings(rig_text(count=7)).placed_rig.cameras) == 7
    with pytest.raises(ConfigurationError, match='rig.yaml.*spacing: found 50 m'):
        CameraPlacementEnv([room], settings(rig_text().replace('0.5', '50.0'))).reset()


@pytest.mark.parametrize('inputs', ['cloud', 'paper'])
def test_a_policy_learns_where_cameras_are_and_a_planner_turns_them(room, settings, inputs):
    env = playable(
        CameraPlacementEnv([room], settings(rig_text('realsense_d455', 'free'))),
        AgentConfig(inputs, cameras=3, points=64, keys_1=8, group_1=4, keys_2=4, group_2=4))
    rng, steps, truncated = np.random.default_rng(0), 0, False
    observation, _ = env.reset(seed=0)
    first = poses_of(env.unwrapped.episode)
    while not truncated:
        assert env.observation_space.contains(observation)
        action = rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        observation, _, _, truncated, _ = env.step(action)
        steps += 1
    last = poses_of(env.unwrapped.episode)
    assert steps == TURNS * (3 if inputs == 'cloud' else 1)
    assert env.action_space.shape[1] == 2 and (first[:, 2] == last[:, 2]).all()
    assert np.abs(last[:, 3] - first[:, 3]).max() > 0.05


@pytest.mark.system
def test_ocp_train_takes_a_rig_file(tmp_path, here, settings):
    simulation = {**TINY['simulation'], 'rig_file': settings(rig_text(count=2)).rig_file}
    tiny = {**TINY, 'simulation': simulation, 'interactions': 24}
    config = from_nested(TrainingConfig, tiny)
    assert len(config.simulation.placed_rig.cameras) == config.fewest_cameras == 2
    trained = train(config, tmp_path / 'run')
    assert trained.provenance['test']['rooms'] == 1
    assert np.isfinite(trained.provenance['test']['policy']['depth_error_end'])
    # The same settings, read anew, are those of the same run.
    train(from_nested(TrainingConfig, tiny), tmp_path / 'run')
    # The rig file that ``tiny`` names is another one now.
    settings(ANCHORED)
    with pytest.raises(ConfigurationError, match='rotations'):
        from_nested(TrainingConfig, tiny)


def test_sim_node_plays_a_rig_file_with_policy_node(graph, probe, room, tmp_path, settings):
    from geometry_msgs.msg import PoseArray
    from ocp_ros.ros.interface import qos, topics
    from ocp_ros.ros.policy_node import PolicyNode
    from ocp_ros.ros.sim_node import SimNode
    rig_file = settings(ANCHORED).rig_file
    save_scene(room, tmp_path / 'room.ply')
    probe.listen(PoseArray, topics.CAMERA_POSES, qos.LOOP)
    sim = graph.add(SimNode, **SMALL, rig_file=rig_file, scene__file=str(tmp_path / 'room.ply'),
                    episode__turns=TURNS)
    policy = graph.add(PolicyNode, rig_file=rig_file, turns=TURNS)
    first = poses_of(sim.episode)
    graph.until(lambda: sim.episode.turn.truncated)
    *_, fixed = poses = probe.last(topics.CAMERA_POSES).poses
    last = poses_of(sim.episode)
    assert len(poses) == 4 and status_of(policy)['refused_messages'] == 0
    assert (fixed.position.x, fixed.position.y) == (6.0, 6.0)
    assert np.linalg.norm((last - first)[:, :3], axis=1).max() > 0.05
    assert np.abs(last[:2, 3] - first[:2, 3]).max() > 0.05
    assert sim.problem.region.broken(last) == [] and status_of(sim)['refused_commands'] == 0
