# SPDX-License-Identifier: Apache-2.0
"""Soft actor-critic from stable-baselines3 on the agent's networks."""

from typing import Any

import gymnasium as gym
from gymnasium import spaces
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import Actor as SacActor
from stable_baselines3.sac.policies import MultiInputPolicy
import torch

from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError
from ocp_ros.agent.config import AgentConfig
from ocp_ros.agent.networks import ActorHead, CriticHead, RigExtractor
from ocp_ros.agent.observation import encode
from ocp_ros.training.augmentation import SymmetricReplayBuffer
from ocp_ros.training.config import SacConfig

LARGEST = 1000.0


def encoded_space(agent: AgentConfig, cameras: int) -> spaces.Dict:
    """Return the space of encoded observations (see ``ocp_ros.agent.observation.encode``)."""
    def real(*shape):
        return spaces.Box(-LARGEST, LARGEST, shape, np.float32)

    def index(*shape):
        return spaces.Box(0, np.iinfo(np.int16).max, shape, np.int16)

    return spaces.Dict({
        'points': real(agent.points, 3), 'cameras': real(cameras, 3), 'half_size': real(3),
        'keys_1': index(agent.keys_1), 'groups_1': index(agent.keys_1, agent.group_1),
        'keys_2': index(agent.keys_2), 'groups_2': index(agent.keys_2, agent.group_2)})


def action_space(cameras: int) -> spaces.Box:
    """Return the space of moves, as the environment has it."""
    return spaces.Box(-1.0, 1.0, (cameras, 2), np.float32)


class EncodedObservation(gym.ObservationWrapper):
    """Store with each observation what the network reads: the observation cache."""

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        self.agent = agent
        self.observation_space = encoded_space(agent, env.action_space.shape[0])

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Encode one observation."""
        return encode(observation['cloud'], observation['camera_positions'],
                      observation['bounds'], self.agent)


class SharedExtractor(BaseFeaturesExtractor):
    """The agent's extractor as stable-baselines3 wants it: flat features of all cameras."""

    def __init__(self, observation_space: spaces.Dict, agent: AgentConfig) -> None:
        extractor = RigExtractor(agent)
        self.cameras = observation_space['cameras'].shape[0]
        super().__init__(observation_space, self.cameras * extractor.width)
        self.extractor = extractor

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return (B, K * F)."""
        return self.extractor(observation).flatten(1)


class SharedHeadActor(SacActor):
    """SAC's actor with one head that all cameras share."""

    def __init__(self, *args, hidden: int, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        del self.latent_pi, self.mu, self.log_std
        self.cameras = self.features_extractor.cameras
        self.head = ActorHead(self.features_dim // self.cameras, hidden)

    def get_action_dist_params(self, obs):
        """Return mean and log standard deviation, each (B, 2 K)."""
        features = self.extract_features(obs, self.features_extractor)
        mean, log_std = self.head(features.unflatten(1, (self.cameras, -1)))
        return mean.flatten(1), log_std.flatten(1), {}


class _QNetwork(torch.nn.Module):
    """A critic head behind the flat input that stable-baselines3 gives."""

    def __init__(self, features_dim: int, cameras: int, hidden: int) -> None:
        super().__init__()
        self.features_dim, self.cameras = features_dim, cameras
        self.head = CriticHead(features_dim // cameras, hidden)

    def forward(self, features_and_actions: torch.Tensor) -> torch.Tensor:
        """Return (B, 1)."""
        features, actions = features_and_actions.tensor_split([self.features_dim], dim=1)
        return self.head(features.unflatten(1, (self.cameras, -1)),
                         actions.unflatten(1, (self.cameras, 2)))


class SharedHeadCritic(ContinuousCritic):
    """SAC's critics with layers that all cameras share."""

    def __init__(self, *args, hidden: int, features_dim: int, **kwargs) -> None:
        super().__init__(*args, features_dim=features_dim, **kwargs)
        cameras = self.features_extractor.cameras
        self.q_networks = [_QNetwork(features_dim, cameras, hidden) for _ in self.q_networks]
        for index, network in enumerate(self.q_networks):
            self.add_module(f'qf{index}', network)


class RigPolicy(MultiInputPolicy):
    """stable-baselines3's SAC policy on the agent's extractor and shared heads."""

    def __init__(self, *args, hidden: int, **kwargs) -> None:
        self.hidden = hidden
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor=None) -> SharedHeadActor:
        """Build the actor."""
        arguments = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return SharedHeadActor(**arguments, hidden=self.hidden).to(self.device)

    def make_critic(self, features_extractor=None) -> SharedHeadCritic:
        """Build the critics."""
        arguments = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return SharedHeadCritic(**arguments, hidden=self.hidden).to(self.device)


def make_sac(sac: SacConfig, agent: AgentConfig, cameras: int, env=None, seed: int = 0,
             tensorboard: str | None = None, **kwargs: Any) -> SAC:
    """
    Build SAC for a rig.

    :param sac: its settings.
    :param agent: sizes of the networks.
    :param cameras: number of cameras in the transitions.
    :param env: encoded environment to play in, or None to be fed with transitions.
    :param seed: of networks and exploration.
    :param tensorboard: folder for TensorBoard, or None.
    :param kwargs: passed on to ``stable_baselines3.SAC``.
    """
    model = SAC(
        RigPolicy, env, learning_rate=sac.learning_rate, buffer_size=sac.buffer_size,
        learning_starts=sac.learning_starts, batch_size=sac.batch_size, tau=sac.tau,
        gamma=sac.gamma, ent_coef=f'auto_{sac.entropy}',
        target_entropy=sac.target_entropy * 2 * cameras,
        replay_buffer_class=SymmetricReplayBuffer, tensorboard_log=tensorboard, seed=seed,
        device=sac.device, _init_setup_model=False, policy_kwargs={
            'features_extractor_class': SharedExtractor,
            'features_extractor_kwargs': {'agent': agent}, 'hidden': agent.hidden}, **kwargs)
    if env is None:
        model.observation_space = encoded_space(agent, cameras)
        model.action_space, model.n_envs = action_space(cameras), 1
    model._setup_model()
    return model


def _actor_parts(model: SAC) -> dict[str, torch.nn.Module]:
    """Return the parts of SAC's actor by their names in :class:`ocp_ros.agent.networks.Actor`."""
    actor = model.policy.actor
    return {'extractor': actor.features_extractor.extractor, 'head': actor.head}


def actor_checkpoint(model: SAC, agent: AgentConfig, run: str, provenance: dict[str, Any]
                     ) -> Checkpoint:
    """
    Take the actor out of SAC.

    :param model: from :func:`make_sac`.
    :param agent: the sizes it was built with.
    :param run: identity of the training run.
    :param provenance: how it was trained.
    """
    weights = {f'{part}.{name}': value.detach().cpu().clone()
               for part, module in _actor_parts(model).items()
               for name, value in module.state_dict().items()}
    return Checkpoint(agent, weights, int(model._n_updates), run, provenance)


def load_actor(model: SAC, checkpoint: Checkpoint) -> None:
    """
    Start SAC's actor from given weights; the critics start afresh.

    :raises CheckpointError: if they are those of another network.
    """
    if checkpoint.config != model.policy.features_extractor_kwargs['agent']:
        raise CheckpointError(
            f"weights: found {checkpoint.config}; expected the trainer's own agent settings, "
            f'{model.policy.features_extractor_kwargs["agent"]}')
    for part, module in _actor_parts(model).items():
        module.load_state_dict({name.removeprefix(f'{part}.'): value
                                for name, value in checkpoint.weights.items()
                                if name.startswith(f'{part}.')})
