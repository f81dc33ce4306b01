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

"""Soft actor-critic from stable-baselines3 on the agent's networks."""

from collections.abc import Callable
from contextlib import suppress
import ctypes
from typing import Any

import numpy as np
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.checkpoint import Checkpoint, CheckpointError
from ocp_ros.training.augmentation import CloudReplayBuffer, MapReplayBuffer
from ocp_ros.training.encoded_environment import action_space, cameras_of, encoded_space
from ocp_ros.training.sac_networks import ImitationLoss, policy_of
from ocp_ros.training.training_config import SacConfig
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
import torch


class AgentSac(SAC):
    """
    stable-baselines3's SAC, which may start from a trained actor.

    The critics are untrained at first, so only they learn for the first ``burn_in`` gradient
    steps. Then an imitation loss, whose weight falls to 0, keeps the policy near the first one.

    :param config: settings of SAC, with the number of steps of both phases.
    :param agent: inputs and sizes of the networks.
    :param warm: whether the actor is trained already, and chooses the actions from the first turn.
    :ivar own_updates: number of gradient steps of SAC itself so far, without the steps on the
        imitation loss.
    """

    def __init__(self, *args, config: SacConfig, agent: AgentConfig, warm: bool = False,
                 **kwargs) -> None:
        self.config = config
        self.agent = agent
        self.warm = warm
        self.own_updates = 0
        #: Returns the imitation loss of a batch of a given size; None for no imitation loss.
        self.imitation_loss: Callable[[int], torch.Tensor] | None = None
        #: Returns the actions of the first interactions; None for no demonstrations.
        self.demonstrator: Callable[[], np.ndarray] | None = None
        super().__init__(*args, **kwargs)

    def _sample_action(self, learning_starts, action_noise=None, n_envs=1):
        """Draw actions: first a demonstrator's, then random ones if the actor is untrained."""
        if self.demonstrator is not None and self.num_timesteps < self.config.demonstrations:
            actions = self.demonstrator()
            # stable-baselines3 expects the actions to play, and those to store in the buffer.
            return actions, actions
        return super()._sample_action(0 if self.warm else learning_starts, action_noise, n_envs)

    def _update_learning_rate(self, optimizers) -> None:
        """Set the step sizes of actor and entropy to 0 during ``burn_in``."""
        super()._update_learning_rate(optimizers)
        if self.own_updates < self.config.burn_in:
            for optimizer in (self.actor.optimizer, self.ent_coef_optimizer):
                for group in optimizer.param_groups:
                    group['lr'] = 0.0

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Take gradient steps of SAC, then one on the imitation loss if it still has a weight."""
        super().train(gradient_steps, batch_size)
        self.own_updates += gradient_steps
        # The factor is 1 at the end of ``burn_in``, and 0 after ``imitation_fades`` further steps.
        fade = 1.0 - (self.own_updates - self.config.burn_in) / self.config.imitation_fades
        if self.imitation_loss is None or self.own_updates < self.config.burn_in or fade <= 0.0:
            return
        loss = self.imitation_loss(batch_size)
        self.actor.optimizer.zero_grad()
        (self.config.imitation * fade * loss).backward()
        self.actor.optimizer.step()
        self.logger.record('train/imitation_loss', loss.item())


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
    buffer_class = MapReplayBuffer if agent.map else DictReplayBuffer
    buffer_kwargs: dict[str, Any] = {}
    if agent.one_by_one and not agent.map:
        buffer_class = CloudReplayBuffer
        buffer_kwargs = {name: getattr(sac, name) for name in (
            'n_steps', 'gamma', 'augmentation', 'demonstrations')}
    # ``auto_`` means that the entropy coefficient is learned from this first value on. The target
    # entropy is given for each of the two components of each camera's action. The first gradient
    # step comes after the demonstrations.
    model = AgentSac(
        policy_class, env, config=sac, agent=agent, learning_rate=sac.learning_rate,
        buffer_size=sac.buffer_size,
        learning_starts=max(sac.learning_starts, sac.demonstrations),
        batch_size=sac.batch_size, tau=sac.tau, gamma=sac.gamma, ent_coef=f'auto_{sac.entropy}',
        target_entropy=sac.target_entropy * 2 * cameras, tensorboard_log=tensorboard, seed=seed,
        device=sac.device, _init_setup_model=False, policy_kwargs=policy_kwargs,
        replay_buffer_class=buffer_class, replay_buffer_kwargs=buffer_kwargs, **kwargs)
    # Without an environment, the spaces must be set before the networks are built.
    if env is None:
        model.observation_space, model.action_space = encoded_space(agent), action_space(cameras)
        model.n_envs = environments
    model._setup_model()
    return model


def _modules_of(actor: Any, agent: AgentConfig) -> dict[str, torch.nn.Module]:
    """Return the modules of SAC's actor, by the prefix of their weights in a checkpoint."""
    if agent.map:
        return {'': actor.network}
    return {'extractor.': actor.features_extractor.extractor, 'latent_pi.': actor.latent_pi,
            'mu.': actor.mu, 'log_std.': actor.log_std}


def select_by_prefix(tensors: dict[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Return the tensors whose names begin with a prefix, by their names without the prefix."""
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items()
            if name.startswith(prefix)}


def actor_checkpoint(model: AgentSac, run: str, provenance: dict[str, Any]) -> Checkpoint:
    """
    Return the actor of SAC as a checkpoint.

    :param model: from :func:`make_sac`.
    :param run: name of the training run.
    :param provenance: how the actor was trained.
    """
    weights = {f'{prefix}{name}': value.detach().cpu().clone()
               for prefix, module in _modules_of(model.actor, model.agent).items()
               for name, value in module.state_dict().items()}
    return Checkpoint(model.agent, weights, int(model._n_updates), run, provenance)


def load_actor(model: AgentSac, checkpoint: Checkpoint) -> None:
    """
    Start SAC's actor from given weights.

    The critics of the map actor start from the same value map, and the imitation loss keeps the
    actor's policy near that of the value map. Other critics start untrained.

    :raises CheckpointError: if the weights are of another network.
    """
    if checkpoint.config != model.agent:
        raise CheckpointError(
            f"weights: found {checkpoint.config}; expected the trainer's own agent settings, "
            f'{model.agent}')
    if model.agent.map:
        model.policy.load_value_map(checkpoint.weights)
        imitation = ImitationLoss(model.agent, checkpoint.weights, model.device)
        model.imitation_loss = lambda size: imitation.loss_of(
            model.actor, model.replay_buffer.sample(size).observations)
        return
    for prefix, module in _modules_of(model.actor, model.agent).items():
        module.load_state_dict(select_by_prefix(checkpoint.weights, prefix))
