# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The networks: three extraction units, features of each camera, and heads that all cameras share.

Every weight is shared among the cameras, so one set of weights serves any number of them. A batch
of rigs of different sizes is padded, and ``present`` (B, K) tells the cameras that there are.
"""

import torch
from torch import nn, Tensor

from ocp_ros.agent import move_effects
from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.distributions import Choices, Moves, SquashedGaussian
from ocp_ros.agent.observation import MARKS, OF_OTHERS, OF_TURN
from ocp_ros.agent.value_network import ValueMapNetwork

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0
#: The largest mean: far beyond it the density of a drawn move cannot be told from its tangent, and
#: soft actor-critic goes astray.
MEAN_MAX = 4.0
#: The same for the width of a choice, in units of the longest step.
WIDTH_MIN, WIDTH_MAX, WIDTH_FIRST = -4.0, -1.0, -2.5
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
    :param normed: whether the maximum over a group is normalised.
    """

    def __init__(self, features: int, channels: int, normed: bool = False) -> None:
        super().__init__()
        self.layers = perceptron(3 + features, channels, channels, channels)
        self.norm = nn.LayerNorm(channels) if normed else nn.Identity()

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
        return self.layers[-1](self.norm(self.layers[:-1](grouped).amax(dim=2)))


class PointFeatures(nn.Module):
    """
    Features of a whole cloud: three extraction units.

    The last has a single key point: the mean of those before, or, centred, each camera.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        channels, normed = config.channels, config.normed
        last = config.pooled or channels
        self.unit_1 = ExtractionUnit(MARKS if config.marks else 0, channels, normed)
        self.unit_2 = ExtractionUnit(channels, channels, normed)
        self.unit_3 = ExtractionUnit(channels, last, normed)
        self.centred, self.width = config.centred, last + 3

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return (B, 1, C' + 3) from an encoded observation; centred, (B, K, C' + 3)."""
        points = observation['points']
        marks = observation['marks'].to(points.dtype) if 'marks' in observation else None
        centres_1 = gather(points, observation['keys_1'])
        features_1 = self.unit_1(points, marks, centres_1, observation['groups_1'])
        centres_2 = gather(centres_1, observation['keys_2'])
        features_2 = self.unit_2(centres_1, features_1, centres_2, observation['groups_2'])
        centre = observation['cameras'] if self.centred else centres_2.mean(dim=1, keepdim=True)
        everything = torch.arange(centres_2.shape[1], device=points.device)
        features = self.unit_3(centres_2, features_2, centre,
                               everything.expand(*centre.shape[:2], -1))
        return torch.cat([features, centre], dim=-1)


class RigExtractor(nn.Module):
    """
    Features of each camera: the cloud's, its own place in the room, and the other cameras' places.

    :param config: sizes.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.cloud, self.one_by_one = PointFeatures(config), config.others > 0
        told = OF_OTHERS if self.one_by_one else 4
        self.others = perceptron(told, CAMERA_CHANNELS, CAMERA_CHANNELS)
        self.width = (self.cloud.width + OWN_FEATURES + 2 * CAMERA_CHANNELS
                      + (OF_TURN if self.one_by_one else 0))

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return (B, K, F) from an encoded observation with K cameras."""
        cameras, half = observation['cameras'], observation['half_size'][:, None]
        own = torch.cat([
            cameras[..., :2] / half[..., :2].clamp(min=1e-3), cameras,
            half[..., :2] - cameras[..., :2], half[..., :2] + cameras[..., :2],
            half.expand_as(cameras)], dim=-1)
        cloud = self.cloud(observation).expand(-1, cameras.shape[1], -1)
        if self.one_by_one:
            told = observation['others']
            others = pooled(self.others(told), told[..., 3])[:, None]
            return torch.cat([cloud, own, others, observation['turn'][:, None]], dim=-1)
        others = self._from_others(cameras, present_of(observation))
        return torch.cat([cloud, own, others], dim=-1)

    def _from_others(self, cameras: Tensor, present: Tensor) -> Tensor:
        """Pool the other cameras' offsets, by mean and maximum: (B, K, 2 x channels)."""
        offsets = cameras[:, None, :, :] - cameras[:, :, None, :]
        offsets = torch.cat([offsets, offsets.norm(dim=-1, keepdim=True)], dim=-1)
        other = 1.0 - torch.eye(cameras.shape[1], device=cameras.device)[None]
        return pooled(self.others(offsets), other * present[:, None])


def pooled(features: Tensor, present: Tensor) -> Tensor:
    """Pool features (..., N, C), not below 0, of what there is (..., N): (..., 2 C)."""
    features = features * present[..., None]
    count = present.sum(dim=-1, keepdim=True).clamp(min=1.0)
    return torch.cat([features.sum(dim=-2) / count, features.amax(dim=-2)], dim=-1)


def present_of(observation: dict[str, Tensor]) -> Tensor:
    """Return (B, K): 1 for each camera that there is."""
    if 'present' in observation:
        return observation['present']
    cameras = observation['own' if 'own' in observation else 'cameras']
    return torch.ones(cameras.shape[:2], device=cameras.device)


class Extractor(nn.Module):
    """
    Features of each camera, by what the network reads.

    :param config: inputs and sizes.
    """

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.rig = RigExtractor(config) if config.cloud else None
        self.world = config.world
        self.rig_width = self.rig.width if config.cloud else 0
        self.width = self.rig_width + (move_effects.DIRECTIONS * move_effects.WIDTH
                                       + move_effects.OF_CAMERAS
                                       if config.world else 0)

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return (B, K, F): the cloud's features, each direction's, and the camera's own."""
        parts = [] if self.rig is None else [self.rig(observation)]
        if self.world:
            parts += [observation['directions'].flatten(2), observation['own']]
        return torch.cat(parts, dim=-1)


class GaussianHead(nn.Module):
    """
    Mean and log standard deviation of each camera's move before the hyperbolic tangent.

    :param features: F, of each camera.
    :param hidden: width of the layers.
    :param joint: number of cameras K that one perceptron answers for together, as that of
        stable-baselines3 does; 0: each camera asks the same perceptron.
    """

    def __init__(self, features: int, hidden: int, joint: int = 0) -> None:
        super().__init__()
        self.joint = joint
        self.layers = perceptron(max(joint, 1) * features, hidden, hidden)
        self.out = nn.Linear(hidden, 4 * max(joint, 1))

    def forward(self, features: Tensor) -> Moves:
        """Map (B, K, F) to a distribution of moves."""
        answers = self.out(self.layers(features.flatten(1) if self.joint else features))
        if self.joint:
            answers = answers.unflatten(1, (self.joint, 4))
        mean, log_std = answers.chunk(2, dim=-1)
        mean = MEAN_MAX * torch.tanh(mean / MEAN_MAX)
        return SquashedGaussian(mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX))


class CloudChoiceHead(nn.Module):
    """How good each of a few moves is, in units of the longest step, from the features alone."""

    def __init__(self, features: int, hidden: int) -> None:
        super().__init__()
        self.layers = perceptron(features, hidden, hidden)
        self.out = nn.Linear(hidden, len(move_effects.CHOICES))
        self.log_std = nn.Parameter(torch.full((1,), WIDTH_FIRST))
        self.register_buffer('centres', move_centres(), persistent=False)

    def forward(self, features: Tensor) -> Moves:
        """Map (B, K, F) to a distribution of moves."""
        return Choices(self.out(self.layers(features)),
                       self.log_std.clamp(WIDTH_MIN, WIDTH_MAX), self.centres)


def move_centres() -> Tensor:
    """Return the moves that are chosen among, (C, 2), in units of the longest."""
    return torch.tensor(move_effects.CHOICES / move_effects.LONGEST, dtype=torch.float32)


class ChoiceHead(nn.Module):
    """
    How good each of a few moves is, by one perceptron that all directions share.

    It is asked once for each direction, with all that is known by direction shifted so that this
    one comes first: a room turned by the angle between two directions gets turned answers. Where
    there are features of the cloud, which do not turn, the direction itself is told as well.

    :param config: inputs and sizes.
    :param extractor: what comes before.
    """

    def __init__(self, config: AgentConfig, extractor: Extractor) -> None:
        super().__init__()
        self.rig_width = extractor.rig_width
        compass = 2 if config.cloud else 0
        self.layers = perceptron(extractor.width + compass, config.hidden, config.hidden)
        #: The moves of a direction, and what speaks for staying.
        self.out = nn.Linear(config.hidden, move_effects.MOVES + 1)
        self.log_std = nn.Parameter(torch.full((1,), WIDTH_FIRST))
        number = torch.arange(move_effects.DIRECTIONS)
        self.register_buffer('shifts', (number[:, None] + number) % move_effects.DIRECTIONS,
                             persistent=False)
        self.register_buffer('ways', torch.tensor(move_effects.WAYS, dtype=torch.float32),
                             persistent=False)
        self.register_buffer('centres', move_centres(), persistent=False)

    def forward(self, features: Tensor) -> Moves:
        """Map (B, K, F) to a distribution of moves."""
        split = [self.rig_width, move_effects.DIRECTIONS * move_effects.WIDTH,
                 move_effects.OF_CAMERAS]
        rig, directions, own = features.split(split, dim=-1)
        directions = directions.unflatten(-1, (move_effects.DIRECTIONS, move_effects.WIDTH))
        rows = [directions[:, :, self.shifts].flatten(3)]
        for each in (own, rig):
            rows.append(each[:, :, None].expand(-1, -1, move_effects.DIRECTIONS, -1))
        if self.rig_width:
            rows.append(self.ways.expand(*features.shape[:2], -1, -1))
        scores = self.out(self.layers(torch.cat(rows, dim=-1)))
        stay = scores[..., -1].mean(dim=-1, keepdim=True)
        logits = torch.cat([stay, scores[..., :-1].flatten(2)], dim=-1)
        return Choices(logits, self.log_std.clamp(WIDTH_MIN, WIDTH_MAX), self.centres)


class CriticHead(nn.Module):
    """
    Value of all cameras' moves together: shared layers, mean over cameras, more layers.

    :param joint: as in :class:`GaussianHead`; not 0: one perceptron for all cameras together.
    """

    def __init__(self, features: int, hidden: int, joint: int = 0) -> None:
        super().__init__()
        self.joint = joint
        self.each = perceptron(max(joint, 1) * (features + 2), hidden, hidden)
        self.all = nn.Identity() if joint else perceptron(hidden, hidden)
        self.out = nn.Linear(hidden, 1)

    def forward(self, features: Tensor, actions: Tensor, present: Tensor) -> Tensor:
        """Map (B, K, F), (B, K, 2) and (B, K) to (B, 1)."""
        read = torch.cat([features, actions], dim=-1)
        if self.joint:
            return self.out(self.each(read.flatten(1)))
        each = self.each(read) * present[..., None]
        count = present.sum(dim=1, keepdim=True).clamp(min=1.0)
        return self.out(self.all(each.sum(dim=1) / count))


class Actor(nn.Module):
    """The whole actor: what a robot runs."""

    def __init__(self, config: AgentConfig) -> None:
        super().__init__()
        self.extractor = Extractor(config)
        self.head = head_of(config, self.extractor)

    def forward(self, observation: dict[str, Tensor]) -> Moves:
        """Return a distribution of moves from an encoded observation."""
        return self.head(self.extractor(observation))


def actor_of(config: AgentConfig) -> nn.Module:
    """Return what a robot runs, with random weights."""
    return ValueMapNetwork(config) if config.map else Actor(config)


def head_of(config: AgentConfig, extractor: Extractor) -> nn.Module:
    """Return the actor's head: choices where moves are tried on the world model."""
    if config.world:
        return ChoiceHead(config, extractor)
    if config.choices:
        return CloudChoiceHead(extractor.width, config.hidden)
    return GaussianHead(extractor.width, config.hidden, config.joint)
