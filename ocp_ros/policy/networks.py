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
The networks that read the observed cloud: three extraction units and an actor's head.

The network ``paper`` reads the cloud, its bounding box and all cameras; one head chooses the moves
of all cameras, as in section III-C of arXiv 2110.11106 and in stable-baselines3. The network
``cloud`` chooses the move of one camera after the other; its weights serve any number of cameras.
"""

from ocp_ros.policy.agent_config import AgentConfig, PAPER
from ocp_ros.policy.cloud_encoder import MARKS, OF_OTHERS, OF_SECTOR, OF_TURN
import torch
from torch import nn, Tensor

#: (8, 2, 2): rotations by 0, 90, 180 and 270 degrees, then the same after a reflection.
SYMMETRIES = Tensor([
    [[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]],
    [[-1, 0], [0, 1]], [[0, -1], [-1, 0]], [[1, 0], [0, -1]], [[0, 1], [1, 0]]])


def perceptron(*widths: int) -> nn.Sequential:
    """Return linear layers from each width to the next, each followed by a ReLU."""
    layers = []
    for width_in, width_out in zip(widths[:-1], widths[1:]):
        layers += [nn.Linear(width_in, width_out), nn.ReLU()]
    return nn.Sequential(*layers)


class ResidualBlock(nn.Module):
    """
    A block of a head: its input, plus the output of two layers on the normalised input.

    After SimBa (Lee et al., arXiv 2410.09754).

    :param width: number of input and output features; the layer between has four times as many.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 4 * width), nn.ReLU(),
                                    nn.Linear(4 * width, width))

    def forward(self, features: Tensor) -> Tensor:
        """Return the output (B, width) for features (B, width) of B observations."""
        return features + self.layers(features)


def head(width: int, hidden: int, blocks: int) -> nn.Sequential:
    """
    Return the layers between the extracted features and the last layer.

    :param width: number of input features.
    :param hidden: number of output features.
    :param blocks: number of residual blocks; 0 for two plain layers.
    """
    if not blocks:
        return perceptron(width, hidden, hidden)
    return nn.Sequential(nn.Linear(width, hidden), *(ResidualBlock(hidden) for _ in range(blocks)),
                         nn.LayerNorm(hidden))


def gather(values: Tensor, indices: Tensor) -> Tensor:
    """
    Return the rows that indices select in each of B batch entries: (B, ..., C).

    :param values: (B, N, C), N rows of C values.
    :param indices: (B, ...) of rows, from 0 to N - 1.
    """
    # The numbers of the batch entries, shaped to be broadcast to the indices.
    batch = torch.arange(len(values), device=values.device)
    return values[batch.view(-1, *[1] * (indices.dim() - 1)), indices.long()]


def turned_vectors(vectors: Tensor, matrices: Tensor) -> Tensor:
    """
    Return vectors whose first two components are multiplied by one matrix per batch entry.

    :param vectors: (B, ..., 2 or more components).
    :param matrices: (B, 2, 2).
    """
    plane = vectors[..., :2].reshape(len(vectors), -1, 2) @ matrices.transpose(1, 2)
    return torch.cat([plane.reshape(*vectors.shape[:-1], 2), vectors[..., 2:]], dim=-1)


def turned_observation(observation: dict[str, Tensor], matrices: Tensor) -> dict[str, Tensor]:
    """
    Return an encoded observation, rotated or mirrored by one matrix per batch entry.

    :param observation: inputs of a network that reads clouds, batched.
    :param matrices: (B, 2, 2), each one of ``SYMMETRIES``.
    """
    turned = {name: turned_vectors(observation[name], matrices)
              for name in ('points', 'cameras', 'others', 'heading', 'air') if name in observation}
    # Sizes have no sign; a quarter turn exchanges those along x and y.
    half_size = turned_vectors(observation['half_size'], matrices.abs())
    return {**observation, **turned, 'half_size': half_size}


class ExtractionUnit(nn.Module):
    """
    Features of groups of points around key points: section III-C of arXiv 2110.11106.

    :param features: channels of each input point besides its position.
    :param channels: C', number of channels of the three layers.
    :param normed: whether the maximum over a group is normalised.
    """

    def __init__(self, features: int, channels: int, normed: bool) -> None:
        super().__init__()
        self.layers = perceptron(3 + features, channels, channels, channels)
        self.norm = nn.LayerNorm(channels) if normed else nn.Identity()

    def forward(self, points: Tensor, features: Tensor | None, centres: Tensor,
                groups: Tensor) -> Tensor:
        """
        Return one feature vector for each key point: (B, K, C').

        :param points: (B, N, 3), N points in each of B observations, unit ``LENGTH_SCALE``.
        :param features: (B, N, C), C features of each point; None for none.
        :param centres: (B, K, 3), the K key points.
        :param groups: (B, K, G), indices of the G points in the group of each key point.
        """
        grouped = gather(points, groups) - centres[:, :, None]
        if features is not None:
            grouped = torch.cat([grouped, gather(features, groups)], dim=-1)
        # The last ReLU and the maximum commute; in this order the ReLU has G times less work.
        return self.layers[-1](self.norm(self.layers[:-1](grouped).amax(dim=2)))


class Extractor(nn.Module):
    """
    Features of an encoded observation; see :mod:`ocp_ros.policy.cloud_encoder`.

    The single key point of the last unit is the mean of the second unit's key points in ``paper``,
    and the position of the choosing camera in ``cloud``.

    :param config: type and sizes of the network.
    :ivar width: F, number of features.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.paper = config.inputs == PAPER
        normed = not self.paper
        self.unit_1 = ExtractionUnit(0 if self.paper else MARKS, config.channels, normed=normed)
        self.unit_2 = ExtractionUnit(config.channels, config.channels, normed=normed)
        self.unit_3 = ExtractionUnit(config.channels, config.pooled, normed=normed)
        # Features of the cloud, and the key point of the last unit (3).
        self.width = config.pooled + 3
        if self.paper:
            # Half the size of the room (3), and the positions of the cameras.
            self.width += 3 + 3 * config.cameras
        else:
            hidden = 32
            self.others = perceptron(OF_OTHERS, hidden, hidden)
            self.air = perceptron(OF_SECTOR, hidden, hidden)
            # A camera's own position: relative to the walls (2) and in the cloud (3), the
            # distances to the four walls (4), half the size of the room (3), and its heading (3).
            own_features = 2 + 3 + 4 + 3 + 3
            self.width += own_features + 4 * hidden + OF_TURN

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return the F features (B, F) of B encoded observations."""
        cameras, half = observation['cameras'], observation['half_size']
        if self.paper:
            return torch.cat([self._cloud(observation, None), half, cameras.flatten(1)], dim=-1)
        camera = cameras[:, 0]
        # The value at index 3 says whether the other camera exists; see ``OF_OTHERS``.
        others = pooled(self.others(observation['others']), observation['others'][..., 3])
        # A sector counts where it has unseen air.
        air = pooled(self.air(observation['air']), (observation['air'][..., 3] > 0.0).float())
        return torch.cat([
            self._cloud(observation, cameras), camera[:, :2] / half[:, :2].clamp(min=1e-3), camera,
            half[:, :2] - camera[:, :2], half[:, :2] + camera[:, :2], half,
            observation['heading'][:, 0], others, air, observation['turn']], dim=-1)

    def _cloud(self, observation: dict[str, Tensor], centre: Tensor | None) -> Tensor:
        """
        Return features of the cloud around a centre, and this centre: (B, ``pooled`` + 3).

        :param observation: B encoded observations.
        :param centre: (B, 1, 3), unit ``LENGTH_SCALE``; None for the mean of the key points.
        """
        points = observation['points']
        marks = None if self.paper else observation['marks'].to(points.dtype)
        centres_1 = gather(points, observation['keys_1'])
        features_1 = self.unit_1(points, marks, centres_1, observation['groups_1'])
        centres_2 = gather(centres_1, observation['keys_2'])
        features_2 = self.unit_2(centres_1, features_1, centres_2, observation['groups_2'])
        centre = centres_2.mean(dim=1, keepdim=True) if centre is None else centre
        # The only group of the last unit has all key points.
        key_indices = torch.arange(centres_2.shape[1], device=points.device)
        features = self.unit_3(centres_2, features_2, centre,
                               key_indices.expand(*centre.shape[:2], -1))
        return torch.cat([features, centre], dim=-1)[:, 0]


def pooled(features: Tensor, present: Tensor) -> Tensor:
    """
    Return the mean and the maximum of features over the items that are present: (..., 2 C).

    :param features: (..., N, C), C values for each of N items; none is negative, so the zeros that
        replace padding do not change the maximum.
    :param present: (..., N), 1 for an item that is present, 0 for padding.
    """
    features = features * present[..., None]
    count = present.sum(dim=-1, keepdim=True).clamp(min=1.0)
    return torch.cat([features.sum(dim=-2) / count, features.amax(dim=-2)], dim=-1)


class Actor(nn.Module):
    """The policy network: the extractor and the layers of stable-baselines3's actor."""

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        cameras = config.cameras if config.inputs == PAPER else 1
        self.extractor = Extractor(config)
        # The heads of the paper's network are those of stable-baselines3.
        blocks = 0 if config.inputs == PAPER else config.blocks
        self.latent_pi = head(self.extractor.width, config.hidden, blocks)
        self.mu = nn.Linear(config.hidden, 2 * cameras)
        self.log_std = nn.Linear(config.hidden, 2 * cameras)

    def forward(self, observation: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """
        Return the distribution of the moves, before the hyperbolic tangent limits them.

        :param observation: B encoded observations; see :mod:`ocp_ros.policy.cloud_encoder`.
        :returns: mean and logarithm of the standard deviation, (B, 2 K) each, of the moves of K
            cameras.
        """
        latent = self.latent_pi(self.extractor(observation))
        # The bounds are those of stable-baselines3.
        return self.mu(latent), self.log_std(latent).clamp(-20.0, 2.0)
