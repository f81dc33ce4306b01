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

"""
Soft actor-critic from stable-baselines3 on the agent's networks.

In this module B is the size of a batch.
"""

from collections.abc import Callable
from contextlib import suppress
import ctypes
import math
from typing import Any

from gymnasium import spaces
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.checkpoint import Checkpoint, CheckpointError
from ocp_ros.policy.networks import Extractor, head
from ocp_ros.training.encoded_environment import action_space, cameras_of, encoded_space
from ocp_ros.training.sac_state import CloudReplayBuffer, select_by_prefix
from ocp_ros.training.training_config import SacConfig
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import Actor, MultiInputPolicy
import torch


class CloudFeatures(BaseFeaturesExtractor):
    """
    The agent's feature extractor with the interface of stable-baselines3.

    :param agent: sizes of the network.
    :param bfloat16: whether to compute with 16 bits.
    """

    def __init__(self, observation_space: spaces.Dict, agent: AgentConfig, bfloat16: bool) -> None:
        extractor = Extractor(agent)
        super().__init__(observation_space, extractor.width)
        self.extractor = extractor
        self.bfloat16 = bfloat16
        #: The batch whose features were computed last with gradients.
        self._batch: Any = None
        #: Its features.
        self._features: torch.Tensor | None = None

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return F features of each observation: (B, F)."""
        device = observation['points'].device.type
        with torch.autocast(device, torch.bfloat16, enabled=self.bfloat16):
            return self.extractor(observation).float()

    def cached_features(self, batch: Any, extract: Callable[[], torch.Tensor]
                        ) -> torch.Tensor:
        """
        Return the features (B, F) of a batch, computed once for all losses of a gradient step.

        :param batch: the same object in all calls of a gradient step.
        :param extract: computes and returns the features.
        """
        # Without gradients, as for the next observations, no later loss needs the features.
        if not torch.is_grad_enabled():
            return extract()
        if self._batch is not batch:
            self._features = extract()
            self._batch = batch
        return self._features

    def drop_batch(self) -> None:
        """Drop the stored batch at the end of a gradient step."""
        self._batch = self._features = None


class DetachedActor(Actor):
    """An actor whose loss does not train the features."""

    def __init__(self, *args, agent: AgentConfig, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.latent_pi = head(self.features_dim, agent.hidden, agent.blocks)

    def extract_features(self, obs, features_extractor) -> torch.Tensor:
        """Return the features (B, F) without gradients."""
        return features_extractor.cached_features(
            obs, lambda: super(DetachedActor, self).extract_features(obs, features_extractor)
        ).detach()


class FeatureCritic(ContinuousCritic):
    """Critics whose loss trains the features, which the actor shares."""

    def __init__(self, *args, agent: AgentConfig, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        width = self.features_extractor.features_dim + math.prod(self.action_space.shape)
        for number in range(len(self.q_networks)):
            network = torch.nn.Sequential(*head(width, agent.hidden, agent.blocks),
                                          torch.nn.Linear(agent.hidden, 1))
            self.q_networks[number] = network
            # The list is no module: stable-baselines3 registers each network as an attribute.
            setattr(self, f'qf{number}', network)

    def forward(self, obs, actions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return values (B, 1), one array from each critic, of observations and actions (B, A)."""
        features = self.features_extractor.cached_features(
            obs, lambda: self.extract_features(obs, self.features_extractor))
        # Only the actions in the actor's loss need gradients, which shows that the call is for it.
        # This loss does not train the features, and is the last one of a gradient step.
        if actions.requires_grad:
            features = features.detach()
            self.features_extractor.drop_batch()
        inputs = torch.cat([features, actions], dim=1)
        return tuple(network(inputs) for network in self.q_networks)


class CloudPolicy(MultiInputPolicy):
    """
    SAC's policy with one feature extractor, which only the critics train.

    In stable-baselines3 the actor trains a shared extractor, and the extractor then learns hardly
    any features of the observation (Yarats et al., 2021).
    """

    def __init__(self, *args, agent: AgentConfig, **kwargs) -> None:
        self.agent = agent
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor=None) -> Actor:
        """Build the actor."""
        arguments = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return DetachedActor(**arguments, agent=self.agent).to(self.device)

    def make_critic(self, features_extractor=None) -> ContinuousCritic:
        """Build the critics."""
        arguments = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return FeatureCritic(**arguments, agent=self.agent).to(self.device)

    def _build(self, lr_schedule) -> None:
        """Build the networks and their optimizers."""
        super()._build(lr_schedule)
        # stable-baselines3 leaves a shared extractor out of the critics' optimizer.
        self.critic.optimizer.param_groups[0]['params'] = list(self.critic.parameters())


def policy_of(agent: AgentConfig, bfloat16: bool) -> tuple[type[MultiInputPolicy], dict[str, Any]]:
    """
    Return SAC's policy class and its arguments.

    :param agent: inputs and sizes of the networks.
    :param bfloat16: whether features are computed with 16 bits; only for the inputs ``cloud``.
    """
    arguments = {'features_extractor_class': CloudFeatures,
                 'features_extractor_kwargs': {
                     'agent': agent, 'bfloat16': bfloat16 and agent.one_by_one},
                 'net_arch': [agent.hidden, agent.hidden],
                 'optimizer_kwargs': {'fused': True},
                 'share_features_extractor': agent.one_by_one}
    if agent.one_by_one:
        return CloudPolicy, arguments | {'agent': agent}
    # In the network of the paper, actor and critics have extractors of their own.
    return MultiInputPolicy, arguments


class AgentSac(SAC):
    """
    stable-baselines3's SAC, which may start from a trained actor.

    The critics are untrained at first, so only they learn for the first ``burn_in`` gradient
    steps. During these steps the actor does not change, the extractor that both share included.

    :param config: settings of SAC.
    :param agent: inputs and sizes of the networks.
    :param warm: whether the actor is trained already, and chooses the actions from the first turn.
    :ivar averaged: the averaged weights of the actor by name; None if the last ones are used.
    """

    def __init__(self, *args, config: SacConfig, agent: AgentConfig, warm: bool = False,
                 **kwargs) -> None:
        self.config = config
        self.agent = agent
        self.warm = warm
        self.averaged: dict[str, torch.Tensor] | None = None
        super().__init__(*args, **kwargs)

    def _sample_action(self, learning_starts, action_noise=None, n_envs=1):
        """Draw actions: the first ones at random if the actor is untrained."""
        return super()._sample_action(0 if self.warm else learning_starts, action_noise, n_envs)

    def _update_learning_rate(self, optimizers) -> None:
        """Set the step sizes of actor and entropy to 0 during ``burn_in``."""
        super()._update_learning_rate(optimizers)
        if self._n_updates < self.config.burn_in:
            for optimizer in (self.actor.optimizer, self.ent_coef_optimizer):
                for group in optimizer.param_groups:
                    group['lr'] = 0.0

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Take gradient steps, and average the weights of the actor."""
        if self.policy.share_features_extractor:
            # Otherwise the critics' steps would change what the actor reads.
            self.critic.features_extractor.requires_grad_(
                self._n_updates >= self.config.burn_in)
        super().train(gradient_steps, batch_size)
        if self.averaged is not None:
            self._average(gradient_steps)

    def _average(self, steps: int) -> None:
        """Let the averaged weights follow the last ones by some gradient steps."""
        # At first the mean is over a tenth of all steps so far, without the random first weights.
        share = min(steps / min(self.config.averaging, 1.0 + 0.1 * self._n_updates), 1.0)
        with torch.no_grad():
            for name, value in actor_weights(self).items():
                self.averaged[name].lerp_(value, share)


def falling(first: float, constant_share: float) -> Callable[[float], float]:
    """
    Return the step size as a function of the share of the training that is left, from 1 to 0.

    :param first: step size at the start.
    :param constant_share: share of the training after which the step size falls to a tenth.
    """
    def step_size(left: float) -> float:
        falls = 1.0 - constant_share
        return first * (0.1 + 0.9 * min(left / falls, 1.0)) if falls else first

    return step_size


def keep_freed_memory() -> None:
    """
    Set up the C library to keep freed memory for the next gradient step.

    Otherwise the system clears the memory that each step returns and requests again; this takes a
    quarter of the time of a step. The setting applies to the whole process.
    """
    with suppress(AttributeError, OSError):
        # glibc's M_TRIM_THRESHOLD (return no memory), M_TOP_PAD (request 256 MiB in advance) and
        # M_MMAP_MAX (no memory maps for large blocks, which the system would take back).
        for option, value in ((-1, (1 << 31) - 1), (-2, 1 << 28), (-4, 0)):
            ctypes.CDLL(None).mallopt(option, value)


def make_sac(sac: SacConfig, agent: AgentConfig, env=None, seed: int = 0,
             tensorboard: str | None = None, environments: int = 1, **kwargs: Any) -> AgentSac:
    """
    Build SAC for a network.

    :param sac: settings of SAC.
    :param agent: inputs and sizes of the network.
    :param env: encoded environment to play in; None if it is set later, or never, because others
        add the transitions.
    :param seed: random seed of networks and exploration.
    :param tensorboard: folder for TensorBoard, or None.
    :param environments: number of environments, used if ``env`` is None.
    :param kwargs: passed on to ``stable_baselines3.SAC``.
    """
    keep_freed_memory()
    cameras = cameras_of(agent)
    policy_class, policy_kwargs = policy_of(agent, sac.bfloat16)
    buffer_class, buffer_kwargs = DictReplayBuffer, {}
    if agent.one_by_one:
        buffer_class = CloudReplayBuffer
        buffer_kwargs = {name: getattr(sac, name) for name in ('n_steps', 'gamma')}
    # The entropy coefficient is learned, from 0.1 on. The target entropy is -1 for each of the two
    # components of each camera's action.
    model = AgentSac(
        policy_class, env, config=sac, agent=agent,
        learning_rate=falling(sac.learning_rate, sac.constant_share),
        buffer_size=sac.buffer_size, learning_starts=sac.learning_starts,
        batch_size=sac.batch_size, tau=sac.tau, gamma=sac.gamma, ent_coef='auto_0.1',
        target_entropy=-2.0 * cameras, tensorboard_log=tensorboard, seed=seed,
        device=sac.device, _init_setup_model=False, policy_kwargs=policy_kwargs,
        replay_buffer_class=buffer_class, replay_buffer_kwargs=buffer_kwargs, **kwargs)
    # Without an environment, the spaces must be set before the networks are built.
    if env is None:
        model.observation_space, model.action_space = encoded_space(agent), action_space(cameras)
        model.n_envs = environments
    model._setup_model()
    if sac.averaging:
        model.averaged = {name: value.detach().clone()
                          for name, value in actor_weights(model).items()}
    return model


def _modules_of(actor: Any) -> dict[str, torch.nn.Module]:
    """Return the modules of SAC's actor, by the prefix of their weights in a checkpoint."""
    return {'extractor.': actor.features_extractor.extractor, 'latent_pi.': actor.latent_pi,
            'mu.': actor.mu, 'log_std.': actor.log_std}


def actor_weights(model: AgentSac) -> dict[str, torch.Tensor]:
    """Return the last weights of SAC's actor, by their names in a checkpoint."""
    return {f'{prefix}{name}': value
            for prefix, module in _modules_of(model.actor).items()
            for name, value in module.state_dict().items()}


def actor_checkpoint(model: AgentSac, run: str, provenance: dict[str, Any]) -> Checkpoint:
    """
    Return the actor of SAC as a checkpoint.

    :param model: from :func:`make_sac`.
    :param run: name of the training run.
    :param provenance: how the actor was trained.
    """
    weights = {name: value.detach().cpu().clone()
               for name, value in (model.averaged or actor_weights(model)).items()}
    return Checkpoint(model.agent, weights, int(model._n_updates), run, provenance)


def load_actor(model: AgentSac, checkpoint: Checkpoint) -> None:
    """
    Start SAC's actor from given weights.

    The critics start untrained.

    :raises CheckpointError: if the weights are of another network.
    """
    if checkpoint.config != model.agent:
        raise CheckpointError(
            f"weights: found {checkpoint.config}; expected the trainer's own agent settings, "
            f'{model.agent}')
    for prefix, module in _modules_of(model.actor).items():
        module.load_state_dict(select_by_prefix(checkpoint.weights, prefix))
    for name, value in (model.averaged or {}).items():
        value.copy_(checkpoint.weights[name])
