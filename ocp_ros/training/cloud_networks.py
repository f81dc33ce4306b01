# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The networks that read the cloud, as stable-baselines3's soft actor-critic trains them."""

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import Actor, MultiInputPolicy
import torch

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.networks import Extractor


class CloudFeatures(BaseFeaturesExtractor):
    """The agent's extractor as stable-baselines3 wants it."""

    def __init__(self, observation_space: spaces.Dict, agent: AgentConfig) -> None:
        extractor = Extractor(agent)
        super().__init__(observation_space, extractor.width)
        self.extractor = extractor

    def forward(self, observation: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return (B, F)."""
        return self.extractor(observation)


class FollowingActor(Actor):
    """An actor that reads features as they are: its loss does not train them."""

    def extract_features(self, obs, features_extractor) -> torch.Tensor:
        """Return (B, F) without gradients."""
        with torch.no_grad():
            return super().extract_features(obs, features_extractor)


class LeadingCritic(ContinuousCritic):
    """Critics whose loss trains the features that they share with the actor."""

    def forward(self, obs, actions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return (B, 1) of each critic."""
        # What the actor does for more reward shall not change what is read.
        with torch.set_grad_enabled(torch.is_grad_enabled() and not actions.requires_grad):
            features = self.extract_features(obs, self.features_extractor)
        read = torch.cat([features, actions], dim=1)
        return tuple(network(read) for network in self.q_networks)


class CloudPolicy(MultiInputPolicy):
    """
    SAC's policy with one extractor, which the critics train.

    In stable-baselines3 the actor trains an extractor that is shared: nearly nothing of what is
    seen reaches it that way (Yarats et al., 2021).
    """

    def _build(self, lr_schedule) -> None:
        """Build the networks and their optimizers."""
        super()._build(lr_schedule)
        self.critic.optimizer.param_groups[0]['params'] = list(self.critic.parameters())

    def make_actor(self, features_extractor=None) -> FollowingActor:
        """Build the actor."""
        arguments = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return FollowingActor(**arguments).to(self.device)

    def make_critic(self, features_extractor=None) -> LeadingCritic:
        """Build the critics."""
        arguments = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return LeadingCritic(**arguments).to(self.device)


def policy_of(agent: AgentConfig) -> tuple[type[MultiInputPolicy], dict[str, Any]]:
    """Return SAC's policy and its arguments: for ``paper`` those of stable-baselines3 itself."""
    arguments = {'features_extractor_class': CloudFeatures,
                 'features_extractor_kwargs': {'agent': agent},
                 'net_arch': [agent.hidden, agent.hidden],
                 'share_features_extractor': agent.one_by_one}
    return CloudPolicy if agent.one_by_one else MultiInputPolicy, arguments
