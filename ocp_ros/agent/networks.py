# SPDX-License-Identifier: Apache-2.0
"""
The networks: three extraction units, features of each camera, and heads that all cameras share.

Every weight is shared among the cameras, so one set of weights serves any number of them.
"""

import torch
from torch import nn, Tensor

from ocp_ros.agent.config import AgentConfig

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0
CAMERA_CHANNELS = 32
OWN_FEATURES = 2 + 3 + 4 + 3


def perceptron(*widths: int) -> nn.Sequential:
    """Stack linear layers, each with a ReLU behind it."""
    layers = []
    for width_in, width_out in zip(widths[:-1], widths[1:]):
        layers += [nn.Linear(width_in, width_out), nn.ReLU()]
    return nn.Sequential(*layers)


def gather(values: Tensor, indices: Tensor) -> Tensor:
    """Pick rows per batch entry: values (B, N, C), indices (B, ...) -> (B, ..., C)."""
    batch = torch.arange(len(values), device=values.device)
    return values[batch.view(-1, *[1] * (indices.dim() - 1)), indices.long()]


class ExtractionUnit(nn.Module):
    """
    Features of groups of points around key points: section III-C of arXiv 2110.11106.

    :param features: channels of each input point besides its position.
    :param channels: channels C' of the three layers.
    """

    def __init__(self, features: int, channels: int) -> None:
        super().__init__()
        self.layers = perceptron(3 + features, channels, channels, channels)

    def forward(self, points: Tensor, features: Tensor | None, centres: Tensor,
                groups: Tensor) -> Tensor:
        """
        Extract one feature vector per key point.

        :param points: (B, N, 3).
        :param features: (B, N, C) or None.
        :param centres: (B, K, 3), the key points.
        :param groups: (B, K, G), indices into the points.
        :returns: (B, K, C').
        """
        grouped = gather(points, groups) - centres[:, :, None]
        if features is not None:
            grouped = torch.cat([grouped, gather(features, groups)], dim=-1)
        # The last ReLU and the maximum commute; in this order it has G times less to do.
        return self.layers[-1](self.layers[:-1](grouped).amax(dim=2))


class PointFeatures(nn.Module):
    """Features of a whole cloud: three extraction units, the last with one key point."""

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        channels = config.channels
        self.unit_1 = ExtractionUnit(0, channels)
        self.unit_2 = ExtractionUnit(channels, channels)
        self.unit_3 = ExtractionUnit(channels, channels)
        self.width = channels + 3

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return (B, C' + 3) from an encoded observation."""
        points = observation['points']
        centres_1 = gather(points, observation['keys_1'])
        features_1 = self.unit_1(points, None, centres_1, observation['groups_1'])
        centres_2 = gather(centres_1, observation['keys_2'])
        features_2 = self.unit_2(centres_1, features_1, centres_2, observation['groups_2'])
        centre = centres_2.mean(dim=1, keepdim=True)
        everything = torch.arange(centres_2.shape[1], device=points.device)
        features = self.unit_3(centres_2, features_2, centre,
                               everything.expand(len(points), 1, -1))
        return torch.cat([features, centre], dim=-1)[:, 0]


class RigExtractor(nn.Module):
    """
    Features of each camera: the cloud's, its own place in the room, and the other cameras' places.

    :param config: sizes.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.cloud = PointFeatures(config)
        self.others = perceptron(4, CAMERA_CHANNELS, CAMERA_CHANNELS)
        self.width = self.cloud.width + OWN_FEATURES + 2 * CAMERA_CHANNELS

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return (B, K, F) from an encoded observation with K cameras."""
        cameras, half = observation['cameras'], observation['half_size'][:, None]
        own = torch.cat([
            cameras[..., :2] / half[..., :2].clamp(min=1e-3), cameras,
            half[..., :2] - cameras[..., :2], half[..., :2] + cameras[..., :2],
            half.expand_as(cameras)], dim=-1)
        cloud = self.cloud(observation)[:, None].expand(-1, cameras.shape[1], -1)
        return torch.cat([cloud, own, self._from_others(cameras)], dim=-1)

    def _from_others(self, cameras: Tensor) -> Tensor:
        """Pool the other cameras' offsets, by mean and maximum: (B, K, 2 x channels)."""
        count = cameras.shape[1]
        offsets = cameras[:, None, :, :] - cameras[:, :, None, :]
        offsets = torch.cat([offsets, offsets.norm(dim=-1, keepdim=True)], dim=-1)
        other = 1.0 - torch.eye(count, device=cameras.device)[None, :, :, None]
        features = self.others(offsets) * other
        return torch.cat([features.sum(dim=2) / max(count - 1, 1), features.amax(dim=2)], dim=-1)


class ActorHead(nn.Module):
    """Mean and log standard deviation of each camera's move before the hyperbolic tangent."""

    def __init__(self, features: int, hidden: int) -> None:
        super().__init__()
        self.layers = perceptron(features, hidden, hidden)
        self.out = nn.Linear(hidden, 4)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, K, F) to two tensors (B, K, 2)."""
        mean, log_std = self.out(self.layers(features)).chunk(2, dim=-1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


class CriticHead(nn.Module):
    """Value of all cameras' moves together: shared layers, mean over cameras, more layers."""

    def __init__(self, features: int, hidden: int) -> None:
        super().__init__()
        self.each = perceptron(features + 2, hidden, hidden)
        self.all = perceptron(hidden, hidden)
        self.out = nn.Linear(hidden, 1)

    def forward(self, features: Tensor, actions: Tensor) -> Tensor:
        """Map (B, K, F) and (B, K, 2) to (B, 1)."""
        each = self.each(torch.cat([features, actions], dim=-1))
        return self.out(self.all(each.mean(dim=1)))


class Actor(nn.Module):
    """The whole actor: what a robot runs."""

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.extractor = RigExtractor(config)
        self.head = ActorHead(self.extractor.width, config.hidden)

    def forward(self, observation: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return mean and log standard deviation, each (B, K, 2)."""
        return self.head(self.extractor(observation))
