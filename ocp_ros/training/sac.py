# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Soft actor-critic from stable-baselines3 on the agent's networks."""

from typing import Any

from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import Actor as SacActor
from stable_baselines3.sac.policies import MultiInputPolicy
import torch

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.checkpoint import Checkpoint, CheckpointError
from ocp_ros.agent.networks import CriticHead, Extractor, head_of, present_of
from ocp_ros.training.augmentation import MapReplayBuffer, SymmetricReplayBuffer
from ocp_ros.training.encoded_environment import action_space, encoded_space
from ocp_ros.training.map_networks import MapPolicy
from ocp_ros.training.training_config import SacConfig


class SharedExtractor(BaseFeaturesExtractor):
    """
    The agent's extractor as stable-baselines3 wants it: flat features of all cameras.

    Which cameras there are comes last.
    """

    def __init__(self, observation_space: spaces.Dict, agent: AgentConfig) -> None:
        extractor = Extractor(agent)
        self.cameras = observation_space['present'].shape[0]
        super().__init__(observation_space, self.cameras * (extractor.width + 1))
        self.extractor, self.agent = extractor, agent

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return (B, K * F + K)."""
        return torch.cat([self.extractor(observation).flatten(1), present_of(observation)], dim=1)

    def split(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return features (B, K, F) and which cameras there are (B, K)."""
        features, present = features.tensor_split([features.shape[1] - self.cameras], dim=1)
        return features.unflatten(1, (self.cameras, -1)), present


class SharedHeadActor(SacActor):
    """SAC's actor with one head that all cameras share."""

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        del self.latent_pi, self.mu, self.log_std
        self.head = head_of(self.features_extractor.agent, self.features_extractor.extractor)
        #: Whether soft actor-critic trains the features by the actor's loss.
        self.trains = True

    def moves(self, observation: dict[str, torch.Tensor], trains: bool = True):
        """Return the distribution of moves and which cameras there are."""
        with torch.set_grad_enabled(trains and torch.is_grad_enabled()):
            features = self.extract_features(observation, self.features_extractor)
        features, present = self.features_extractor.split(features)
        return self.head(features), present

    def forward(self, obs, deterministic: bool = False) -> torch.Tensor:
        """Return actions (B, 2 K)."""
        moves, _ = self.moves(obs)
        return (moves.best() if deterministic else moves.sample()).flatten(1)

    def action_log_prob(self, obs) -> tuple[torch.Tensor, torch.Tensor]:
        """
        Draw actions (B, 2 K) and return the logarithm of their density.

        It is scaled to that of all cameras, so that one target of the entropy serves any number.
        """
        moves, present = self.moves(obs, self.trains)
        drawn = moves.sample()
        count = present.sum(dim=1).clamp(min=1.0)
        density = (moves.log_prob(drawn) * present).sum(dim=1) * present.shape[1] / count
        return drawn.flatten(1), density


class _QNetwork(torch.nn.Module):
    """A critic head behind the flat input that stable-baselines3 gives."""

    def __init__(self, extractor: SharedExtractor, hidden: int) -> None:
        super().__init__()
        # Not a part of this network: a list hides it from PyTorch.
        self._extractor = [extractor]
        self.head = CriticHead(extractor.extractor.width, hidden, extractor.agent.joint)

    def forward(self, features_and_actions: torch.Tensor) -> torch.Tensor:
        """Return (B, 1)."""
        (extractor,) = self._extractor
        features, actions = features_and_actions.tensor_split([extractor.features_dim], dim=1)
        features, present = extractor.split(features)
        return self.head(features, actions.unflatten(1, (-1, 2)), present)


class SharedHeadCritic(ContinuousCritic):
    """SAC's critics with layers that all cameras share."""

    def __init__(self, *args, hidden: int, trains: bool, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        #: Whether their loss trains the features.
        self.trains = trains
        self.q_networks = [_QNetwork(self.features_extractor, hidden) for _ in self.q_networks]
        for index, network in enumerate(self.q_networks):
            self.add_module(f'qf{index}', network)

    def forward(self, obs, actions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return (B, 1) of each critic."""
        # What the actor does for more reward shall not change what is read.
        with torch.set_grad_enabled(self.trains and torch.is_grad_enabled()
                                    and not actions.requires_grad):
            features = self.extract_features(obs, self.features_extractor)
        read = torch.cat([features, actions], dim=1)
        return tuple(network(read) for network in self.q_networks)


class RigPolicy(MultiInputPolicy):
    """
    stable-baselines3's SAC policy on the agent's extractor and shared heads.

    :param hidden: width of the heads.
    :param critics_train: whether the critics' loss, not the actor's, trains shared features.
    """

    def __init__(self, *args, hidden: int, critics_train: bool = False, **kwargs) -> None:
        self.hidden, self.critics_train = hidden, critics_train
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule) -> None:
        """Build the networks and their optimizers."""
        super()._build(lr_schedule)
        if self.share_features_extractor and self.critics_train:
            self.actor.trains = False
            self.critic.optimizer.param_groups[0]['params'] = list(self.critic.parameters())

    def make_actor(self, features_extractor=None) -> SharedHeadActor:
        """Build the actor."""
        arguments = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return SharedHeadActor(**arguments).to(self.device)

    def make_critic(self, features_extractor=None) -> SharedHeadCritic:
        """Build the critics."""
        arguments = self._update_features_extractor(self.critic_kwargs, features_extractor)
        trains = self.critics_train or not self.share_features_extractor
        return SharedHeadCritic(**arguments, hidden=self.hidden, trains=trains).to(self.device)


class RigSac(SAC):
    """
    stable-baselines3's SAC, which may start from an actor that has learned to imitate.

    Its critics know nothing at first, so for some gradient steps they alone may learn; and a loss
    that fades keeps the actor near what it imitates.

    :param config: how long either takes.
    :param agent: inputs and sizes of the networks.
    :param warm: whether the actor has learned already; it then plays from the first turn on.
    """

    def __init__(self, *args, config: SacConfig, agent: AgentConfig, warm: bool = False,
                 **kwargs) -> None:
        self.config, self.agent, self.warm = config, agent, warm
        #: Gradient steps of SAC itself so far, and the loss of imitation of a random batch.
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
        """Take gradient steps, and one towards what is imitated."""
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


def make_sac(sac: SacConfig, agent: AgentConfig, cameras: int, env=None, seed: int = 0,
             tensorboard: str | None = None, environments: int = 1, **kwargs: Any) -> RigSac:
    """
    Build SAC for a rig.

    :param sac: its settings.
    :param agent: sizes of the networks.
    :param cameras: most cameras in a transition.
    :param env: encoded environment to play in, or None to be given one later, or transitions.
    :param seed: of networks and exploration.
    :param tensorboard: folder for TensorBoard, or None.
    :param environments: how many there will be where ``env`` is None.
    :param kwargs: passed on to ``stable_baselines3.SAC``.
    """
    agent.check_cameras(cameras)
    policy, arguments, replay = (
        (MapPolicy, {'agent': agent}, MapReplayBuffer) if agent.map else
        (RigPolicy, {'features_extractor_class': SharedExtractor,
                     'features_extractor_kwargs': {'agent': agent}, 'hidden': agent.hidden,
                     'share_features_extractor': sac.shared_extractor,
                     'critics_train': sac.critics_train}, SymmetricReplayBuffer))
    model = RigSac(
        policy, env, config=sac, agent=agent, learning_rate=sac.learning_rate,
        buffer_size=sac.buffer_size, learning_starts=sac.learning_starts,
        batch_size=sac.batch_size, tau=sac.tau, gamma=sac.gamma, ent_coef=f'auto_{sac.entropy}',
        target_entropy=sac.target_entropy * 2 * cameras, tensorboard_log=tensorboard, seed=seed,
        device=sac.device, _init_setup_model=False, policy_kwargs=arguments,
        **{'replay_buffer_class': replay, **kwargs})
    if env is None:
        model.observation_space = encoded_space(agent, cameras)
        model.action_space, model.n_envs = action_space(cameras), environments
    model._setup_model()
    return model


def start_critics(model: RigSac) -> None:
    """Let the critics begin with the features that the actor has learned."""
    if not model.agent.map:
        learned = model.actor.features_extractor.state_dict()
        for critic in (model.critic, model.critic_target):
            critic.features_extractor.load_state_dict(learned)


def _actor_parts(model: RigSac) -> dict[str, torch.nn.Module]:
    """Return the parts of SAC's actor by how names of what a robot runs begin."""
    actor = model.policy.actor
    if model.agent.map:
        return {'': actor.network}
    return {'extractor.': actor.features_extractor.extractor, 'head.': actor.head}


def actor_checkpoint(model: RigSac, run: str, provenance: dict[str, Any]) -> Checkpoint:
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


def load_actor(model: RigSac, checkpoint: Checkpoint) -> None:
    """
    Start SAC's actor from given weights; the critics start afresh, or as the same value map.

    :raises CheckpointError: if they are those of another network.
    """
    if checkpoint.config != model.agent:
        raise CheckpointError(
            f"weights: found {checkpoint.config}; expected the trainer's own agent settings, "
            f'{model.agent}')
    if model.agent.map:
        model.policy.begin_with(checkpoint.weights)
        return
    for part, module in _actor_parts(model).items():
        module.load_state_dict({name.removeprefix(part): value
                                for name, value in checkpoint.weights.items()
                                if name.startswith(part)})
