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
The agent's networks for the soft actor-critic of stable-baselines3.

In this module B is the size of a batch.
"""

from collections.abc import Callable
from functools import partial
import math
from typing import Any

from gymnasium import spaces
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.networks import Extractor, head
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


class CloudCritic(ContinuousCritic):
    """Critics that compute no gradients of the features for the actor's loss."""

    def forward(self, obs, actions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return values (B, 1), one array from each critic, of observations and actions (B, A)."""
        # Only the actions in the actor's loss need gradients, which shows that the call is for it.
        inputs = torch.cat([self.features_of(obs, actions.requires_grad), actions], dim=1)
        return tuple(network(inputs) for network in self.q_networks)

    def features_of(self, obs, for_actor: bool) -> torch.Tensor:
        """Return features (B, F), without gradients if they are for the actor's loss."""
        with torch.set_grad_enabled(torch.is_grad_enabled() and not for_actor):
            return self.extract_features(obs, self.features_extractor)


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


class FeatureCritic(CloudCritic):
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

    def features_of(self, obs, for_actor: bool) -> torch.Tensor:
        """Return the stored features (B, F) of the batch."""
        features = self.features_extractor.cached_features(
            obs, lambda: self.extract_features(obs, self.features_extractor))
        if for_actor:
            # The actor's loss is the last one of a gradient step.
            features = features.detach()
            self.features_extractor.drop_batch()
        return features


class CustomPolicy(MultiInputPolicy):
    """
    SAC's policy with other classes of actor and critics.

    :ivar build_actor: returns the actor for stable-baselines3's arguments.
    :ivar build_critic: returns the critics for stable-baselines3's arguments.
    """

    build_actor: Callable[..., Actor]
    build_critic: Callable[..., ContinuousCritic]

    def make_actor(self, features_extractor=None) -> Actor:
        """Build the actor."""
        arguments = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return self.build_actor(**arguments).to(self.device)

    def make_critic(self, features_extractor=None) -> ContinuousCritic:
        """Build the critics."""
        arguments = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return self.build_critic(**arguments).to(self.device)


class PaperPolicy(CustomPolicy):
    """stable-baselines3's SAC policy, in which actor and critics have extractors of their own."""

    build_actor = Actor
    build_critic = CloudCritic


class CloudPolicy(CustomPolicy):
    """
    SAC's policy with one feature extractor, which only the critics train.

    In stable-baselines3 the actor trains a shared extractor, and the extractor then learns hardly
    any features of the observation (Yarats et al., 2021).
    """

    def __init__(self, *args, agent: AgentConfig, **kwargs) -> None:
        self.build_actor = partial(DetachedActor, agent=agent)
        self.build_critic = partial(FeatureCritic, agent=agent)
        super().__init__(*args, **kwargs)

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
    return PaperPolicy, arguments
