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

"""An agent of a user, trained in the environment, is compared with planners."""

from dataclasses import replace

from conftest import refused_in_one_sentence
import gymnasium as gym
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.compare.protocol import BenchmarkTask, placement_settings, Protocol, run_task
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.search.registry import PLANNERS
from ocp_ros.simulation.environment import environment_of
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.training.saved_agents import OWN_POLICY, register_policy
import pytest

SMALL = Protocol(rooms=('3',), planners=('random',), budgets=(4,), seeds=1, points=3000,
                 judged_points=4000, simulation=replace(
                     placement_settings(), episode=EpisodeConfig(turns=3),
                     engine=EngineConfig(error_rows=32, coverage_cell=0.5, error_folds=2)))


@pytest.fixture(autouse=True)
def known_planners(monkeypatch):
    """Forget the planners that a test adds."""
    monkeypatch.setattr('ocp_ros.training.saved_agents.PLANNERS', PLANNERS)
    yield
    PLANNERS.pop(OWN_POLICY, None)


def along_x():
    """Return an agent that moves all cameras along x."""
    class Along:
        def predict(self, observation, deterministic):
            assert observation['cloud'].shape == (1024, 3) and deterministic
            return [[1.0, 0.0]] * len(observation['present']), None
    return Along()


def played(policy, observation='dict'):
    """Return the result of an agent in a room."""
    register_policy(policy, observation)
    protocol = replace(SMALL, planners=(OWN_POLICY,), policy=policy, observation=observation)
    row, = run_task(protocol, BenchmarkTask('3', 0.0, OWN_POLICY))
    return row


def test_any_object_with_predict_moves_the_cameras():
    row = played(f'{__name__}:along_x')
    moves = np.diff(np.array(row['trajectory']), axis=0)
    # The first move is not limited by walls; the farthest a camera moves is 0.5 m.
    np.testing.assert_allclose(moves[0, :, :2], [[0.5, 0.0]] * 4, atol=1e-6)
    assert row['depth_error'] > 0.0 and row['planner'] == OWN_POLICY


@pytest.mark.parametrize('observation', ['dict', 'flat'])
def test_a_file_of_stable_baselines3_acts_as_in_its_environment(observation, tmp_path):
    from stable_baselines3 import PPO
    config = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16))
    env = environment_of([11], points=1000, cameras=4, config=config, observation_points=64)
    if observation == 'flat':
        env = gym.wrappers.FlattenObservation(env)
    network = 'MultiInputPolicy' if observation == 'dict' else 'MlpPolicy'
    agent = PPO(network, env, n_steps=2, batch_size=2, policy_kwargs={'net_arch': [8]}, seed=0)
    agent.save(tmp_path / 'mine.zip')
    asked = []
    predict = PPO.predict

    def recorded(self, values, **options):
        asked.append((values, predict(self, values, **options)))
        return asked[-1][1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PPO, 'predict', recorded)
        row = played(str(tmp_path / 'mine.zip'), observation)
    assert len(asked) == 3 and env.observation_space.contains(asked[0][0])
    action = np.clip(asked[0][1][0].reshape(4, 2), -1.0, 1.0)
    length = np.maximum(np.linalg.norm(action, axis=1, keepdims=True), 1.0)
    moves = np.diff(np.array(row['trajectory']), axis=0)[0, :, :2]
    np.testing.assert_allclose(moves, 0.5 * action / length, atol=1e-5)


@pytest.mark.filterwarnings('default')
def test_the_command_warns_that_an_agent_is_code(tmp_path, monkeypatch, capsys):
    protocols = []
    monkeypatch.chdir(tmp_path)

    def compare(protocol, *_):
        protocols.append(protocol)
        raise KeyboardInterrupt
    monkeypatch.setattr('ocp_ros.compare.comparison.compare', compare)
    command = ['benchmark', '--planners', 'random', '--policy', f'{__name__}:along_x']
    main(command)
    assert 'can run any code' in capsys.readouterr().err
    assert protocols[0].planners == (OWN_POLICY, 'random')
    assert main(['benchmark', '--observation', 'flat']) == 2


@pytest.mark.parametrize(('policy', 'words'), [
    ('none.zip', 'expected ALGORITHM:FILE.zip'), ('PPP:none.zip', 'expected ALGORITHM'),
    ('no_module', 'it has no colon'), ('json:loads_', 'cannot be imported'),
    ('builtins:dict', 'expected an object with predict')])
def test_what_is_no_agent_is_refused_in_one_sentence(policy, words):
    with refused_in_one_sentence('--policy: found') as refused:
        register_policy(policy)
    assert refused is None or words in str(refused.value)


def test_a_file_that_is_no_agent_is_refused(tmp_path):
    (tmp_path / 'mine.zip').write_bytes(b'no zip')
    with refused_in_one_sentence(f'--policy: found {tmp_path}/mine.zip, which PPO cannot load'):
        register_policy(str(tmp_path / 'mine.zip'))
