# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the heads of the network say of moves: densities, draws, imitation."""

from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
import pytest
import torch

from ocp_ros.agent.distributions import Choices, NEAR, SquashedGaussian
from ocp_ros.agent.move_effects import CHOICES, LONGEST

seeds = st.integers(0, 2 ** 32 - 1)
#: The moves that the network chooses among, in units of the longest step.
CENTRES = torch.tensor(CHOICES / LONGEST, dtype=torch.float32)


def choices(seed, batch_size=2, cameras=3, log_std=-2.0):
    """Return random choices among the moves that the network has."""
    torch.manual_seed(seed)
    logits = 2.0 * torch.randn(batch_size, cameras, len(CENTRES))
    return Choices(logits.requires_grad_(), torch.full((1,), log_std), CENTRES)


def test_the_density_of_choices_is_one_altogether():
    axis = torch.linspace(-2.0, 2.0, 321)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing='ij'), dim=-1).reshape(-1, 1, 2)
    moves = choices(0, 1, 1)
    density = moves.log_prob(grid).detach().exp().sum() * float(axis[1] - axis[0]) ** 2
    assert float(density) == pytest.approx(1.0, abs=1e-3)


@given(seed=seeds, log_std=st.floats(-4.0, -1.0))
@budget(max_examples=15, deadline=None)
def test_the_density_of_choices_agrees_with_its_twin(seed, log_std):
    moves = choices(seed % 1000, log_std=log_std)
    made = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, 3, 2))
    logits, width = moves.logits.detach().double().numpy(), np.exp(log_std)
    expected = np.empty((2, 3))
    for index in np.ndindex(2, 3):
        weights = np.exp(logits[index]) / np.exp(logits[index]).sum()
        away = ((made[index] - CENTRES.double().numpy()) ** 2).sum(axis=1)
        # Far from all choices the density itself would not be a number.
        terms = np.log(weights) - away / (2.0 * width ** 2) - np.log(2.0 * np.pi * width ** 2)
        expected[index] = terms.max() + np.log(np.exp(terms - terms.max()).sum())
    found = moves.log_prob(torch.tensor(made, dtype=torch.float32)).detach()
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_choices_are_drawn_as_often_as_their_logits_say():
    logits = torch.zeros(1, 1, len(CENTRES))
    logits[0, 0, [0, 3, 11]] = torch.tensor([4.0, 5.0, 4.5])
    torch.manual_seed(0)
    moves = Choices(logits.expand(20000, 1, -1), torch.full((1,), -5.0), CENTRES)
    nearest = torch.cdist(moves.sample()[:, 0], CENTRES).argmin(dim=1)
    shares = torch.bincount(nearest, minlength=len(CENTRES)) / len(nearest)
    np.testing.assert_allclose(shares, logits.softmax(-1)[0, 0], atol=0.012)
    assert torch.equal(moves.best()[0, 0], CENTRES[3])
    # Around a choice, moves have the width they are said to have.
    wide = Choices(20.0 * logits.expand(20000, 1, -1), torch.full((1,), -2.0), CENTRES)
    spread = (wide.sample()[:, 0] - CENTRES[3]).std(dim=0)
    np.testing.assert_allclose(spread, np.exp(-2.0), rtol=0.05)


def test_the_best_choice_is_the_likeliest():
    # Narrow ones: wide ones that overlap share what they are worth.
    moves = choices(3, 4, 5, log_std=-4.0)
    at_best = moves.log_prob(moves.best())
    for centre in CENTRES:
        assert (at_best >= moves.log_prob(centre.expand(4, 5, 2)) - 1e-3).all()


def test_gradients_flow_through_drawn_choices():
    moves = choices(5)
    moves.sample()[..., 0].sum().backward()
    assert moves.logits.grad.abs().sum() > 0.0
    # Making a choice with a larger x likelier makes the drawn x larger.
    likeliest, least = CENTRES[:, 0].argmax(), CENTRES[:, 0].argmin()
    mean = torch.zeros(len(CENTRES))
    torch.manual_seed(0)
    for _ in range(50):
        moves = choices(5)
        Choices(moves.logits, moves.log_std, CENTRES).sample()[..., 0].sum().backward()
        mean += moves.logits.grad.sum(dim=(0, 1))
    assert mean[likeliest] > 0.0 > mean[least]


@given(seed=seeds)
@budget(max_examples=10, deadline=None)
def test_the_squashed_gaussian_is_that_of_stable_baselines3(seed):
    from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
    torch.manual_seed(seed)
    mean, log_std = torch.randn(3, 2, 2), 0.5 * torch.randn(3, 2, 2) - 1.0
    ours = SquashedGaussian(mean, log_std)
    made = 0.95 * torch.tanh(torch.randn(3, 2, 2))
    # Theirs sums over the second axis: one row for each camera.
    theirs = SquashedDiagGaussianDistribution(2).proba_distribution(
        mean.flatten(0, 1), log_std.flatten(0, 1))
    torch.testing.assert_close(ours.log_prob(made).flatten(),
                               theirs.log_prob(made.flatten(0, 1)), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(ours.best().flatten(0, 1), theirs.mode())


@pytest.mark.parametrize('number', range(len(CENTRES)))
def test_imitation_costs_least_where_the_expert_goes(number):
    wanted = CENTRES[number].view(1, 1, 2)
    sure = 12.0 * torch.eye(len(CENTRES))
    losses = torch.cat([
        Choices(logits.view(1, 1, -1), torch.full((1,), -2.0), CENTRES).imitation(wanted)[0]
        for logits in sure])
    assert int(losses.argmin()) == number
    gaussian = torch.cat([SquashedGaussian(
        torch.atanh(0.99 * centre).view(1, 1, 2), torch.zeros(1, 1, 2)).imitation(wanted)[0]
        for centre in CENTRES])
    assert int(gaussian.argmin()) == number


def test_what_imitation_wants_is_nearest_to_the_move():
    """Minimising the loss over the logits gives choices that count the more the nearer."""
    move, logits = torch.tensor([[[0.5, 0.1]]]), torch.zeros(1, 1, len(CENTRES))
    logits.requires_grad_()
    optimizer = torch.optim.Adam([logits], 0.2)
    for _ in range(300):
        optimizer.zero_grad()
        Choices(logits, torch.full((1,), -2.0), CENTRES).imitation(move).sum().backward()
        optimizer.step()
    away = (CENTRES - move[0, 0]).norm(dim=1)
    order = away.argsort()[:6]
    shares = logits.softmax(-1)[0, 0].detach()
    assert (shares[order].diff() <= 1e-3).all() and shares[order[0]] > 0.2
    # Where all count as NEAR says, the loss is the entropy of it.
    expected = torch.softmax(-0.5 * (away / NEAR) ** 2, dim=0)
    np.testing.assert_allclose(shares, expected, atol=0.01)
