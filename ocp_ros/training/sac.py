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

from contextlib import suppress
import ctypes
from typing import Any

from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.checkpoint import Checkpoint, CheckpointError
from ocp_ros.training.augmentation import CloudReplayBuffer, MapReplayBuffer
from ocp_ros.training.encoded_environment import action_space, cameras_of, encoded_space
from ocp_ros.training.sac_networks import NearValueMap, policy_of
from ocp_ros.training.training_config import SacConfig
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
import torch

#: Options of glibc's ``mallopt``: M_TRIM_THRESHOLD, M_TOP_PAD and M_MMAP_MAX; freed memory stays
#: with the process, however much it is.
KEEP_MEMORY = {-1: (1 << 31) - 1, -2: 1 << 28, -4: 0}


class AgentSac(SAC):
    """
    stable-baselines3's SAC, which may start from an actor that has learned.

    Its critics know nothing at first, so for some gradient steps they alone may learn; and a loss
    that fades may keep the actor near what it begins with.

    :param config: how long either takes.
    :param agent: inputs and sizes of the networks.
    :param warm: whether the actor has learned already; it then plays from the first turn on.
    """

    def __init__(self, *args, config: SacConfig, agent: AgentConfig, warm: bool = False,
                 **kwargs) -> None:
        self.config, self.agent, self.warm = config, agent, warm
        #: Gradient steps of SAC itself so far, and the loss that keeps the actor near, of a batch.
        self.own_updates, self.imitation_loss = 0, None
        super().__init__(*args, **kwargs)

    def _sample_action(self, learning_starts, action_noise=None, n_envs=1):
        """Draw actions: from the actor that has learned, at random from one that has not."""
        return super()._sample_action(0 if self.warm else learning_starts, action_noise, n_envs)

    def _update_learning_rate(self, optimizers) -> None:
        """Let the actor and the entropy rest while the critics burn in."""
        super()._update_learning_rate(optimizers)
        if self.own_updates < self.config.burn_in:
            for optimizer in (self.actor.optimizer, self.ent_coef_optimizer):
                for part in optimizer.param_groups:
                    part['lr'] = 0.0

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Take gradient steps, and one towards what the actor began with."""
        super().train(gradient_steps, batch_size)
        self.own_updates += gradient_steps
        share = 1.0 - (self.own_updates - self.config.burn_in) / self.config.imitation_fades
        if self.imitation_loss is None or self.own_updates < self.config.burn_in or share <= 0.0:
            return
        loss = self.imitation_loss(batch_size)
        self.actor.optimizer.zero_grad()
        (self.config.imitation * share * loss).backward()
        self.actor.optimizer.step()
        self.logger.record('train/imitation_loss', loss.item())


def keep_memory() -> None:
    """
    Keep freed memory for the next gradient step, which takes as much again.

    Memory that went back to the system is cleared before the process gets it again, which takes a
    quarter of a step's time. This holds for the whole process.
    """
    with suppress(AttributeError, OSError):
        for option, value in KEEP_MEMORY.items():
            ctypes.CDLL(None).mallopt(option, value)


def make_sac(sac: SacConfig, agent: AgentConfig, env=None, seed: int = 0,
             tensorboard: str | None = None, environments: int = 1, **kwargs: Any) -> AgentSac:
    """
    Build SAC for a network.

    :param sac: its settings.
    :param agent: which network, and its sizes.
    :param env: encoded environment to play in, or None to be given one later, or transitions.
    :param seed: of networks and exploration.
    :param tensorboard: folder for TensorBoard, or None.
    :param environments: how many there will be where ``env`` is None.
    :param kwargs: passed on to ``stable_baselines3.SAC``.
    """
    keep_memory()
    cameras = cameras_of(agent)
    policy, arguments = policy_of(agent, sac.bfloat16)
    buffer, settings = MapReplayBuffer if agent.map else DictReplayBuffer, {}
    if agent.one_by_one and not agent.map:
        buffer, settings = CloudReplayBuffer, {'n_steps': sac.n_steps, 'gamma': sac.gamma,
                                               'augmentation': sac.augmentation}
    model = AgentSac(
        policy, env, config=sac, agent=agent, learning_rate=sac.learning_rate,
        buffer_size=sac.buffer_size, learning_starts=sac.learning_starts,
        batch_size=sac.batch_size, tau=sac.tau, gamma=sac.gamma, ent_coef=f'auto_{sac.entropy}',
        target_entropy=sac.target_entropy * 2 * cameras, tensorboard_log=tensorboard, seed=seed,
        device=sac.device, _init_setup_model=False, policy_kwargs=arguments,
        replay_buffer_class=buffer, replay_buffer_kwargs=settings, **kwargs)
    if env is None:
        model.observation_space, model.action_space = encoded_space(agent), action_space(cameras)
        model.n_envs = environments
    model._setup_model()
    return model


def _actor_parts(model: AgentSac) -> dict[str, torch.nn.Module]:
    """Return the parts of SAC's actor by how names of what a robot runs begin."""
    actor = model.policy.actor
    if model.agent.map:
        return {'': actor.network}
    return {'extractor.': actor.features_extractor.extractor, 'latent_pi.': actor.latent_pi,
            'mu.': actor.mu, 'log_std.': actor.log_std}


def actor_checkpoint(model: AgentSac, run: str, provenance: dict[str, Any]) -> Checkpoint:
    """
    Take the actor out of SAC.

    :param model: from :func:`make_sac`.
    :param run: identity of the training run.
    :param provenance: how it was trained.
    """
    weights = {f'{part}{name}': value.detach().cpu().clone()
               for part, module in _actor_parts(model).items()
               for name, value in module.state_dict().items()}
    return Checkpoint(model.agent, weights, int(model._n_updates), run, provenance)


def load_actor(model: AgentSac, checkpoint: Checkpoint) -> None:
    """
    Start SAC's actor from given weights.

    The critics start afresh; those of a map start as the same value map, and the actor is kept
    near it.

    :raises CheckpointError: if they are those of another network.
    """
    if checkpoint.config != model.agent:
        raise CheckpointError(
            f"weights: found {checkpoint.config}; expected the trainer's own agent settings, "
            f'{model.agent}')
    if model.agent.map:
        model.policy.begin_with(checkpoint.weights)
        near = NearValueMap(model.agent, checkpoint.weights, model.device)
        model.imitation_loss = lambda size: near.loss_of(
            model.actor, model.replay_buffer.sample(size).observations)
        return
    for part, module in _actor_parts(model).items():
        module.load_state_dict({name.removeprefix(part): value
                                for name, value in checkpoint.weights.items()
                                if name.startswith(part)})
