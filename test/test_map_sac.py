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

"""Soft actor-critic on the map actor's network: in one process, and over what nodes tell."""

from conftest import assert_same, batch, store
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.policy import value_network
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.observation_map import BOX, CELLS, NUMBERS, OF_OTHERS, OF_ROOM
from ocp_ros.policy.value_network import action_of, cell_of, CellChoices, valued, ValueMapNetwork
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.policy.policy_planners import ExploringMap, make_planner
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.training.augmentation import turned_batch
from ocp_ros.training.encoded_environment import encoded_space, playable
from ocp_ros.training.experience import Choice, Experience, ExperienceError, from_bytes, to_bytes
from ocp_ros.training.sac import actor_checkpoint, load_actor, make_sac
from ocp_ros.training.sac_networks import ImitationLoss, REWARD_PER_VALUE
from ocp_ros.training.training_config import SacConfig
import pytest
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.logger import configure
import torch

AGENT = AgentConfig(inputs='map')
SAC = SacConfig(learning_starts=1, batch_size=8, buffer_size=64, device='cpu',
                learning_rate=1e-2, gamma=0.5)
TURNS = 3


def made_up(seed, side=10):
    """Return what the map actor reads of a made-up room of some cells."""
    rng, first = np.random.default_rng(seed), (CELLS - side) // 2
    middle = slice(first, first + side)
    found = {'room': np.zeros((OF_ROOM, CELLS, CELLS), np.uint8),
             'others': np.zeros((OF_OTHERS, CELLS, CELLS), np.uint8),
             'numbers': rng.random(NUMBERS).astype(np.float32),
             'choices': np.zeros((CELLS, CELLS), np.uint8)}
    for name in ('room', 'others'):
        part = found[name][:, middle, middle]
        part[:] = rng.integers(256, size=part.shape)
    found['room'][BOX] = 0
    found['room'][BOX, middle, middle] = 255
    found['choices'][middle, middle] = 1
    return found


def network(seed=0):
    """Return a network that says of each cell something else."""
    torch.manual_seed(seed)
    made = ValueMapNetwork(AGENT)
    made.get_parameter('leave.weight').data *= 10.0
    return made


@pytest.fixture
def model():
    """Return soft actor-critic that begins with a value map."""
    made = make_sac(SAC, AGENT)
    load_actor(made, Checkpoint(AGENT, network().state_dict()))
    return made


def test_cells_are_actions_and_back():
    cells = torch.arange(CELLS * CELLS)
    actions = action_of(cells)
    assert torch.equal(cell_of(actions), cells) and actions.abs().max() < 1.0
    assert torch.equal(cell_of(torch.tensor([[-1.0, 1.0]])), torch.tensor([CELLS - 1]))


def test_a_camera_goes_where_the_map_is_low_among_what_is_free():
    values, free = torch.zeros(1, CELLS, CELLS), torch.zeros(1, CELLS, CELLS)
    free[0, 20:24, 30] = 1
    values[0, 20, 30], values[0, 5, 5] = -0.1, -9.0
    choices = CellChoices(values, free)
    assert cell_of(choices.best()).item() == 20 * CELLS + 30
    weights = np.exp([0.1 / value_network.TEMPERATURE, 0.0, 0.0, 0.0])
    likely = weights / weights.sum()
    shares = choices.shares[0].reshape(CELLS, CELLS)
    np.testing.assert_allclose(shares[20:24, 30], likely, rtol=1e-5)
    assert shares.sum().item() == pytest.approx(1.0)
    assert choices.entropy.item() == pytest.approx(-(likely * np.log(likely)).sum(), rel=1e-4)
    torch.manual_seed(0)
    drawn = {cell_of(choices.sample()).item() for _ in range(60)}
    assert drawn == {row * CELLS + 30 for row in range(20, 24)}


def test_the_critics_begin_as_the_value_map_and_the_policy_as_its_softmax(model):
    seen = batch(made_up(0), made_up(1))
    with torch.no_grad():
        values = valued(network(), seen)
        cells = torch.tensor([30 * CELLS + 31, 33 * CELLS + 29])
        first, second = model.critic(seen, action_of(cells))
        expected = -REWARD_PER_VALUE * values.flatten(1).gather(1, cells[:, None])
        torch.testing.assert_close(first, expected)
        assert not torch.equal(first, second) and torch.allclose(first, second, atol=0.5)
        shares, log_prob = model.actor.action_log_prob(seen)
        torch.testing.assert_close(shares, CellChoices(values, seen['choices']).shares)
        mean, _ = model.critic(seen, shares)
        whole = -REWARD_PER_VALUE * values.flatten(1).nan_to_num(posinf=0.0)
        torch.testing.assert_close(mean[:, 0], (shares * whole).sum(dim=1))
    assert (log_prob < 8.0).all()
    taken = actor_checkpoint(model, 'r', {})
    assert taken.config == AGENT
    assert_same(network().state_dict(), taken.weights)


def test_a_batch_of_maps_used_as_far_is_turned_whole_with_its_actions(model):
    """The one cell that is free stays the one that was chosen."""
    rng = np.random.default_rng(0)
    for seed in range(6):
        before, after = made_up(seed), made_up(seed + 50, 30 if seed % 2 else 10)
        cell = int(rng.choice(np.flatnonzero(before['choices'])))
        before['choices'][:] = 0
        before['choices'].flat[cell] = 1
        store(model, before, after, action_of(torch.tensor([cell])), seed)
    rewards = set()
    for _ in range(20):
        drawn = model.replay_buffer.sample(4)
        cells = cell_of(drawn.actions)
        free = drawn.observations['choices'].flatten(1)
        assert free.gather(1, cells[:, None]).all() and (free.sum(dim=1) == 1).all()
        rooms = drawn.next_observations['room'][:, BOX]
        assert len(set(rooms.amax(dim=2).gt(0).sum(dim=1).tolist())) == 1
        rewards |= set(drawn.rewards.flatten().tolist())
    assert rewards == set(range(6))
    assert (turned_batch(drawn).rewards == drawn.rewards).all()


def test_what_is_rewarded_is_learned(model):
    """Half of the cells pay: soft actor-critic goes there though the map said nothing of it."""
    rng, made = np.random.default_rng(0), made_up(3)
    pays = torch.from_numpy(made['room'][0].ravel() > 128)
    for cell in rng.choice(np.flatnonzero(made['choices']), 64):
        store(model, made, made, action_of(torch.tensor([cell])), pays[cell], done=True)

    def paid():
        with torch.no_grad():
            return float((model.actor.action_log_prob(batch(made))[0] * pays).sum())

    model.set_logger(configure(None, []))
    before = paid()
    model.train(20, 8)
    assert paid() > before + 0.2 and paid() > 0.75


def test_a_policy_is_drawn_back_to_the_value_map_it_began_with(model):
    first, seen = network(), batch(made_up(3))
    imitation = ImitationLoss(AGENT, first.state_dict(), torch.device('cpu'))
    assert imitation.loss_of(model.actor, seen).item() == pytest.approx(0.0, abs=1e-6)
    load_actor(model, Checkpoint(AGENT, network(1).state_dict()))
    before = imitation.loss_of(model.actor, seen)
    # The divergence by its definition.
    shares = [CellChoices(valued(one, seen), seen['choices']).shares.clamp(min=1e-30)
              for one in (first, model.actor.network)]
    expected = (shares[0] * (shares[0] / shares[1]).log()).sum()
    assert before.item() == pytest.approx(expected.item(), rel=1e-4) and before > 0.01
    for _ in range(10):
        model.actor.optimizer.zero_grad()
        imitation.loss_of(model.actor, seen).backward()
        model.actor.optimizer.step()
    assert imitation.loss_of(model.actor, seen) < 0.5 * before
    assert_same(first.state_dict(), imitation.network.state_dict())


def test_an_episode_pays_what_its_turns_pay(room):
    config = SimulationConfig(
        rig=RigConfig(cameras=3), episode=EpisodeConfig(turns=TURNS, max_step=1.0),
        engine=EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0))
    env = playable(CameraPlacementEnv([room], config, 64, fewest=2), AGENT)
    check_env(env, warn=False)
    found, _ = env.reset(seed=3)
    rewards, rng, truncated = [], np.random.default_rng(0), False
    while not truncated:
        assert env.observation_space.contains(found)
        cell = torch.tensor([int(rng.choice(np.flatnonzero(found['choices'])))])
        found, reward, terminated, truncated, info = env.step(action_of(cell).numpy())
        rewards.append(reward)
        assert not terminated
    assert info['step'] == TURNS and len(rewards) > TURNS
    assert np.count_nonzero(rewards) <= TURNS
    # A camera that is sent outside goes to the nearest place where it may be.
    env.reset(seed=3)
    env.step(np.full((1, 2), 5.0, np.float32))


def test_who_explores_tells_what_it_read_and_drew(room):
    config = PolicyNodeConfig(planner='learned', explore=True, max_step=1.0)
    planner, learned = make_planner(config, Checkpoint(AGENT, network().state_dict()))
    assert planner is learned and isinstance(planner, ExploringMap)
    middle = np.append(room.bounds.mean(axis=0)[:2], 1.9)
    positions = middle + np.array([[0.4, 0.1, 0.0], [-0.3, 0.5, 0.0], [0.1, -0.6, 0.0]])
    expected = {name: (space.shape, space.dtype)
                for name, space in encoded_space(AGENT).spaces.items()}
    for turn, count in ((0, 6), (1, 2)):
        moves = planner.move(room.points, positions, turn, 30)
        choices = planner.policy.take_choices()
        assert len(choices) == count
        made = Experience(5, turn, positions + np.pad(moves, ((0, 0), (0, 1))), choices)
        for one, other in zip(from_bytes(to_bytes(made), expected, None).choices, choices,
                              strict=True):
            assert_same(one.observation, other.observation)
            free = one.observation['choices'].ravel()
            assert free[cell_of(torch.from_numpy(one.actions))].all()
    newer = learned.policy.replaced(Checkpoint(AGENT, network(1).state_dict(), 1))
    assert newer.checkpoint.updates == 1 and newer.take_choices() == []
    # The largest rigs choose more often in a turn than they have cameras.
    many = made._replace(targets=np.zeros((64, 3)), choices=choices * 64)
    assert len(from_bytes(to_bytes(many), expected, None).choices) == 128
    with pytest.raises(ExperienceError, match='found actions'):
        from_bytes(to_bytes(made._replace(choices=[
            Choice(choices[0].observation, np.zeros((2, 2), np.float32))])), expected, None)
