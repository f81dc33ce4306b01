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

An action of the map actor is a cell of the map, so means over actions are not sampled but summed
over all cells (Christodoulou, 2019). stable-baselines3 gets an action in two forms: a chosen
action is the position of a cell, (B, 2); the action of ``action_log_prob`` is the probability of
every cell, (B, 64 * 64). In this module B is the size of a batch.
"""

from collections.abc import Callable
from functools import partial
import math
from typing import Any

from gymnasium import spaces
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.networks import Extractor, head
from ocp_ros.policy.observation_map import CELLS
from ocp_ros.policy.value_network import cell_of, CellChoices, valued, ValueMapNetwork
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import Actor, MultiInputPolicy
import torch

#: Factor from the network's values, logarithms of the depth error, to the reward: see
#: ``potential`` in :mod:`ocp_ros.simulation.reward`. The critics begin with it.
REWARD_PER_VALUE = 2.0


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


class ImitationLoss:
    """
    The divergence of a policy from its first policy, that of a given value map.

    Critics learn only the values of cells that were chosen; their values of other cells are
    arbitrary. Without this loss the policy would follow these values, and lose what the value map
    had learned.

    :param agent: settings of the network.
    :param weights: the weights of the value map.
    :param device: the device of the policy.
    """

    def __init__(self, agent: AgentConfig, weights: dict[str, torch.Tensor],
                 device: torch.device) -> None:
        self.network = ValueMapNetwork(agent).to(device)
        self.network.load_state_dict(weights)

    def loss_of(self, actor: 'MapSacActor', observation: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the mean Kullback-Leibler divergence D(first policy || actor), nats."""
        with torch.no_grad():
            first = CellChoices(valued(self.network, observation), observation['choices'])
        return first.divergence(actor.choices_of(observation)).mean()


class RawMaps(BaseFeaturesExtractor):
    """Return observations unchanged: the networks read maps, not features."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        super().__init__(observation_space, CELLS * CELLS)

    def forward(self, observation: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the observation unchanged."""
        return observation


class MapSacActor(Actor):
    """SAC's actor, whose policy is the softmax of the value map."""

    def __init__(self, *args, agent: AgentConfig, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        del self.latent_pi, self.mu, self.log_std
        self.network = ValueMapNetwork(agent)

    def choices_of(self, observation: dict[str, torch.Tensor]) -> CellChoices:
        """Return the distribution over the cells of the maps of a batch."""
        maps: dict[str, torch.Tensor] = self.extract_features(
            observation, self.features_extractor)  # type: ignore[assignment]
        return CellChoices(valued(self.network, maps), maps['choices'])

    def forward(self, obs, deterministic: bool = False) -> torch.Tensor:
        """Return chosen positions (B, 2): the best ones if ``deterministic``, else drawn ones."""
        choices = self.choices_of(obs)
        return choices.best() if deterministic else choices.sample()

    def action_log_prob(self, obs) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the probabilities of cells (B, 64 * 64), and the mean log-density (B,)."""
        choices = self.choices_of(obs)
        # Positions are in [-1, 1]: a cell has the area (2 / CELLS) ** 2. The log-density in a cell
        # is log(probability) - log(area); the mean of log(probability) is -entropy.
        minus_log_area = 2.0 * math.log(0.5 * CELLS)
        return choices.shares, minus_log_area - choices.entropy


class _CellValues(torch.nn.Module):
    """A critic: the expected future reward if a camera goes to a cell."""

    def __init__(self, agent: AgentConfig) -> None:
        super().__init__()
        self.network = ValueMapNetwork(agent)

    def forward(self, maps: dict[str, torch.Tensor], actions: torch.Tensor) -> torch.Tensor:
        """
        Return expected rewards (B, 1): at positions, or averaged over all cells.

        The number of columns of ``actions`` decides which.

        :param actions: (B, 2) positions, or (B, 64 * 64) probabilities.
        """
        are_positions = actions.shape[1] == 2
        # Only the rewards at positions train this network; the averages train the actor.
        with torch.set_grad_enabled(are_positions and torch.is_grad_enabled()):
            # Cells outside the used part are inf, and inf * 0 would make the mean NaN.
            network_values = valued(self.network, maps).nan_to_num(posinf=0.0)
            values = -REWARD_PER_VALUE * network_values.flatten(1)
        if are_positions:
            return values.gather(1, cell_of(actions)[:, None])
        return (values * actions).sum(dim=1, keepdim=True)


class MapCritic(ContinuousCritic):
    """SAC's critics on maps."""

    def __init__(self, *args, agent: AgentConfig, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.q_networks = [_CellValues(agent) for _ in self.q_networks]
        for index, network in enumerate(self.q_networks):
            self.add_module(f'qf{index}', network)

    def forward(self, obs, actions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return values (B, 1), one array from each critic; see :class:`_CellValues`."""
        maps = self.extract_features(obs, self.features_extractor)
        return tuple(network(maps, actions) for network in self.q_networks)


class MapPolicy(CustomPolicy):
    """stable-baselines3's SAC policy on maps."""

    def __init__(self, *args, agent: AgentConfig, **kwargs) -> None:
        self.build_actor = partial(MapSacActor, agent=agent)
        self.build_critic = partial(MapCritic, agent=agent)
        # The network divides the maps by 255 itself.
        super().__init__(*args, features_extractor_class=RawMaps, normalize_images=False, **kwargs)

    def load_value_map(self, weights: dict[str, torch.Tensor]) -> None:
        """Start the actor and the critics from the weights of a value map."""
        self.actor.load_state_dict({f'network.{name}': value for name, value in weights.items()})
        for number, critic in enumerate(self.critic.q_networks):
            # Equal critics would stay equal, as they learn from the same batches. So the second
            # one gets 1 % of noise.
            critic.load_state_dict({
                f'network.{name}': value * (1.0 + number * 0.01 * torch.randn_like(value))
                for name, value in weights.items()})
        self.critic_target.load_state_dict(self.critic.state_dict())


def policy_of(agent: AgentConfig, bfloat16: bool) -> tuple[type[MultiInputPolicy], dict[str, Any]]:
    """
    Return SAC's policy class and its arguments.

    :param agent: inputs and sizes of the networks.
    :param bfloat16: whether features are computed with 16 bits; only for the inputs ``cloud``.
    """
    if agent.map:
        return MapPolicy, {'agent': agent}
    arguments = {'features_extractor_class': CloudFeatures,
                 'features_extractor_kwargs': {
                     'agent': agent, 'bfloat16': bfloat16 and agent.one_by_one},
                 'net_arch': [agent.hidden, agent.hidden],
                 'optimizer_kwargs': {'fused': True},
                 'share_features_extractor': agent.one_by_one}
    if agent.one_by_one:
        return CloudPolicy, arguments | {'agent': agent}
    return PaperPolicy, arguments
