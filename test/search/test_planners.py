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

"""Planners keep their budget and space and do what their names promise."""

from itertools import combinations

import numpy as np
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.search.annealing import TransDimensionalAnnealing
from ocp_ros.search.budget import Budget
from ocp_ros.search.planner import Planner, Scorer, Scores, solve
from ocp_ros.search.population import BinaryParticleSwarm, match_positions
from ocp_ros.search.registry import planner_names, PLANNERS, SCORES
from ocp_ros.util.settings import ConfigurationError
import pytest
from scipy import stats

SPACE = FreePlane(np.array([-1.0, 2.0]), np.array([5.0, 6.0]), 1.9, 3)
TARGETS = np.array([[0.1, 2.4], [4.3, 5.1], [2.2, 3.3]])
#: Those that can go anywhere and have nothing to do but go on.
CONTINUOUS = ['greedy_swap', 'tdsa', 'bee_colony', 'differential_evolution', 'cma_es']


def toy(placements):
    """Score by how far targets are from their nearest cameras; one without costs 36."""
    errors = []
    for placement in placements:
        distance = np.linalg.norm(TARGETS[:, None] - placement[None], axis=2)
        errors.append((np.append(distance, np.full((3, 1), 6.0), axis=1).min(axis=1) ** 2).sum())
    return Scores(np.array(errors), -np.array(errors))


def run(name, budget, seed=0, score=toy):
    """Run a planner by its name."""
    return solve(PLANNERS[name].make(SPACE, np.random.default_rng(seed), budget), score, budget)


@pytest.mark.parametrize('budget', [1, 2, 9, 733])
@pytest.mark.parametrize('name', planner_names(SCORES))
def test_every_planner_keeps_to_its_budget_its_space_and_its_seed(name, budget):
    asked = []

    def score(placements):
        asked.extend(placements)
        return toy(placements)

    result, again = run(name, budget, score=score), run(name, budget)
    assert result.evaluations == len(asked) <= budget
    assert np.array_equal(result.positions, again.positions)
    for positions in asked:
        assert positions.shape[1] == 2 and len(positions) <= 3
        assert (positions >= SPACE.low - 1e-9).all() and (positions <= SPACE.high + 1e-9).all()
    # The answer is the best of all that was judged.
    assert result.error == pytest.approx(toy(asked).error.min())
    assert toy([result.positions]).error[0] == pytest.approx(result.error)


@pytest.mark.parametrize('name', sorted(set(planner_names(SCORES)) - {'random', 'regular_grid'}))
def test_every_search_beats_chance_and_most_find_a_known_answer(name):
    found = np.mean([run(name, 400, seed).error for seed in range(4)])
    assert found < np.mean([run('random', 400, seed).error for seed in range(4)])
    if name in CONTINUOUS:
        result = run(name, 4000)
        assert result.error < 0.05
        nearest = match_positions(TARGETS, result.positions)
        assert np.abs(nearest - TARGETS).max() < 0.25


def cover_problem(seed, candidates):
    """Return sets that candidates cover, (M, 40) bool, and a score by candidate positions."""
    sets = np.random.default_rng(seed).random((len(candidates), 40)) < 0.18

    def score(placements):
        covered = []
        for placement in placements:
            chosen = [int(np.linalg.norm(candidates - place, axis=1).argmin())
                      for place in placement]
            covered.append(sets[chosen].any(axis=0).sum() if chosen else 0)
        return Scores(40.0 - np.array(covered), np.array(covered, dtype=float))

    best = max(sets[list(chosen)].any(axis=0).sum()
               for chosen in combinations(range(len(candidates)), 3))
    return score, best


@pytest.mark.parametrize('seed', range(4))
def test_bpso_covers_most_exactly_and_greedy_coverage_keeps_its_bound(seed):
    score, best = cover_problem(seed, SPACE.grid(16))

    class Small(BinaryParticleSwarm):
        max_candidates = 16

    planner = Small(SPACE, np.random.default_rng(seed), 3000)
    assert solve(planner, score, 3000).space_coverage == best

    def backwards(placements):
        """Score so that what covers most has the largest error."""
        covered = score(placements).space_coverage
        return Scores(covered, covered)

    result = run('greedy_coverage', 48, score=backwards)
    assert len(result.positions) == 3 and result.space_coverage >= (1.0 - 1.0 / np.e) * best


@pytest.mark.parametrize('name', ['greedy_error', 'greedy_coverage', 'greedy_swap'])
def test_no_camera_is_left_out_where_fewer_would_do(name):
    def flat(placements):
        return Scores(np.zeros(len(placements)), np.zeros(len(placements)))

    assert len(run(name, 300, score=flat).positions) == 3


@pytest.mark.system
def test_differential_evolution_begins_anew_when_all_are_alike():
    errors = []

    def score(placements):
        scores = toy(placements)
        errors.extend(scores.error)
        return scores

    run('differential_evolution', 20000, score=score)
    # Long after the answer was found, far places are tried again.
    late = errors[len(errors) // 2:]
    assert min(late) < 0.01 and max(late) > 1.0


@pytest.mark.system
@pytest.mark.parametrize(('cameras', 'rate'), [(30, 3.0), (4, 4.0)])
def test_tdsa_without_energy_is_a_poisson_process(cameras, rate):
    """The number of cameras follows Poisson(lambda), cut off at K."""
    class Free(TransDimensionalAnnealing):
        birth_probability = 0.3

    Free.expected_cameras = rate
    planner = Free(FreePlane(SPACE.low, SPACE.high, 1.9, cameras), np.random.default_rng(5), 100)
    placed, counts = np.empty((0, 2)), []
    for number in range(60000):
        step = planner.take_step(placed, 0.0, 1.0, 1.0)
        next(step)
        with pytest.raises(StopIteration) as end:
            step.send(Scores(np.zeros(1), np.zeros(1)))
        placed, _ = end.value.value
        # Far enough apart to be as good as independent.
        if number % 40 == 0:
            counts.append(len(placed))
    last = min(cameras, 8)
    observed = np.bincount(np.minimum(counts, last), minlength=last + 1)
    chance = stats.poisson.pmf(np.arange(cameras + 1), rate)
    chance = np.append(chance[:last], chance[last:].sum()) / chance.sum()
    assert stats.chisquare(observed, chance * len(counts)).pvalue > 0.001


def test_folding_keeps_a_step_symmetric_and_inside():
    space = FreePlane(np.zeros(2), np.array([2.0, 1.0]), 1.0, 1)
    np.testing.assert_allclose(space.reflected(np.array([[2.5, -0.25], [-4.5, 3.25]])),
                               [[1.5, 0.25], [0.5, 0.75]])


@pytest.mark.parametrize(('name', 'asked'), [
    ('Outside', [[np.array([[100.0, 0.0]])]]), ('Silent', [])])
def test_a_planner_that_breaks_the_rules_is_found_out(name, asked):
    planner = type(name, (Planner,), {'search': lambda _: (one for one in asked)})
    with pytest.raises(ConfigurationError, match=f'{name}: found'):
        solve(planner(SPACE, np.random.default_rng(0), 5), toy, 5)


def test_scores_end_with_the_budget_but_the_first_placement_is_always_scored():
    shares, ticks = [], iter(range(0, 100, 4))

    def evaluate(positions):
        return float(len(positions)), 2.0

    placements = [np.zeros((count, 2)) for count in (3, 1, 2)]
    score = Scorer(evaluate, Budget(evaluations=2), lambda *known: shares.append(known))
    scores = score(placements)
    assert scores.error.tolist() == [3.0, 1.0] and scores.space_coverage.tolist() == [2.0, 2.0]
    assert shares == [(0.5, 3.0), (1.0, 1.0)] and len(score(placements).error) == 0
    late = Scorer(evaluate, Budget(seconds=1.0, clock=lambda: next(ticks)))
    assert late(placements).error.tolist() == [3.0]
