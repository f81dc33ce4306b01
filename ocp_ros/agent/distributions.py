# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Distributions of each camera's move, in units of the longest step: what the head means."""

from abc import ABC, abstractmethod
import math

import torch
from torch import Tensor
from torch.nn.functional import gumbel_softmax, one_hot

#: Keeps the logarithm of 1 - tanh(x)^2 finite.
SMALL = 1e-6
#: Choices within about so much of a move, in units of the longest step, stand for it.
NEAR = 0.06


class Moves(ABC):
    """A distribution of moves (B, K, 2), each camera's on its own."""

    @abstractmethod
    def best(self) -> Tensor:
        """Return the moves that are executed when nothing is left to chance."""

    @abstractmethod
    def sample(self) -> Tensor:
        """Draw moves; gradients flow through them."""

    @abstractmethod
    def log_prob(self, moves: Tensor) -> Tensor:
        """Return the logarithm of the density of each camera's move: (B, K)."""

    @abstractmethod
    def imitation(self, moves: Tensor) -> Tensor:
        """Return how far this is from making some moves (B, K, 2): a loss (B, K)."""


class SquashedGaussian(Moves):
    """
    Soft actor-critic's own: a Gaussian behind a hyperbolic tangent.

    :param mean: (B, K, 2).
    :param log_std: (B, K, 2).
    """

    def __init__(self, mean: Tensor, log_std: Tensor) -> None:
        self.mean, self.log_std = mean, log_std

    def best(self) -> Tensor:
        """Return the tangent of the mean."""
        return torch.tanh(self.mean)

    def sample(self) -> Tensor:
        """Draw moves."""
        return torch.tanh(self.mean + self.log_std.exp() * torch.randn_like(self.mean))

    def log_prob(self, moves: Tensor) -> Tensor:
        """Return the logarithm of the density, that of the tangent included."""
        before = torch.atanh(moves.clamp(SMALL - 1.0, 1.0 - SMALL))
        gaussian = _log_gaussian(before, self.mean, self.log_std)
        return (gaussian - torch.log(1.0 - moves ** 2 + SMALL)).sum(dim=-1)

    def imitation(self, moves: Tensor) -> Tensor:
        """Return the squared distance of the best move."""
        return ((self.best() - moves) ** 2).sum(dim=-1)


class Choices(Moves):
    """
    A mixture of narrow Gaussians around a few moves.

    The mean of two good moves can be a bad one; the best of some choices cannot. A drawn choice
    passes its gradient on as if it were the weighted mean (Jang et al., 2017).

    :param logits: (B, K, C).
    :param log_std: of all Gaussians alike, broadcastable to (B, K, 1).
    :param centres: (C, 2) the moves.
    """

    def __init__(self, logits: Tensor, log_std: Tensor, centres: Tensor) -> None:
        self.logits, self.log_std, self.centres = logits, log_std, centres

    def best(self) -> Tensor:
        """Return the likeliest choice."""
        return one_hot(self.logits.argmax(dim=-1), len(self.centres)).float() @ self.centres

    def sample(self) -> Tensor:
        """Draw a choice, then a move around it."""
        centre = gumbel_softmax(self.logits, hard=True) @ self.centres
        return centre + self.log_std.exp() * torch.randn_like(centre)

    def log_prob(self, moves: Tensor) -> Tensor:
        """Return the logarithm of the mixture's density."""
        gaussians = _log_gaussian(moves[..., None, :], self.centres, self.log_std[..., None])
        return torch.logsumexp(self.logits.log_softmax(dim=-1) + gaussians.sum(dim=-1), dim=-1)

    def imitation(self, moves: Tensor) -> Tensor:
        """Return the cross entropy with choices that count the more the nearer they are."""
        away = ((moves[..., None, :] - self.centres) ** 2).sum(dim=-1)
        wanted = torch.softmax(-0.5 * away / NEAR ** 2, dim=-1)
        return -(wanted * self.logits.log_softmax(dim=-1)).sum(dim=-1)


def _log_gaussian(values: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the logarithm of a Gaussian's density, component by component."""
    return (-0.5 * ((values - mean) / log_std.exp()) ** 2 - log_std
            - 0.5 * math.log(2.0 * math.pi))
