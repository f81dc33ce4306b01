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

"""Every planner keeps its budget and its space, and does what its name promises."""

from itertools import combinations

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.search.annealing import TransDimensionalAnnealing
from ocp_ros.search.planner import Planner, Scores
from ocp_ros.search.population import BinaryParticleSwarm, match_positions
from ocp_ros.search.registry import planner_names, PLANNERS, SCORES
from ocp_ros.search.scorer import Scorer
from ocp_ros.search.solve import solve
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
import pytest
from scipy import stats

SPACE = FreePlane(np.array([-1.0, 2.0]), np.array([5.0, 6.0]), 1.9, 3)
TARGETS = np.array([[0.1, 2.4], [4.3, 5.1], [2.2, 3.3]])
#: Those that can go anywhere and have nothing to do but go on.
CONTINUOUS = ['greedy_swap', 'tdsa', 'annealing', 'bee_colony', 'differential_evolution',
              'cma_es']


def toy(placements):
    """Score by how far targets are from their nearest cameras; one without costs 36."""
    errors = []
    for placement in placements:
        distance = np.linalg.norm(TARGETS[:, None] - placement[None, :, :2], axis=2)
        errors.append((np.append(distance, np.full((3, 1), 6.0), axis=1).min(axis=1) ** 2).sum())
    return Scores(np.array(errors), -np.array(errors))


def run(name, budget, seed=0, score=toy, space=SPACE):
    """Run a planner by its name."""
    return solve(PLANNERS[name].make(space, np.random.default_rng(seed), budget), score, budget)


@pytest.mark.parametrize('budget', [1, 2, 9, 100, 733])
@pytest.mark.parametrize('name', planner_names(SCORES))
def test_no_planner_exceeds_its_budget_or_leaves_its_space(name, budget):
    asked = []

    def score(placements):
        asked.extend(placements)
        return toy(placements)

    result = run(name, budget, score=score)
    assert result.evaluations == len(asked) <= budget
    for placement in asked:
        assert placement.shape[1] == 3 and len(placement) <= 3
        assert (placement[:, 2] == 1.9).all()
        assert (placement[:, :2] >= SPACE.low - 1e-9).all()
        assert (placement[:, :2] <= SPACE.high + 1e-9).all()
    # The answer is the best of all that was judged, and the trace tells how it came about.
    assert result.depth_error == pytest.approx(toy(asked).error.min())
    assert toy([result.placement]).error[0] == pytest.approx(result.depth_error)
    assert (np.diff(result.trace[:, 2]) <= 0).all() and (np.diff(result.trace[:, 0]) > 0).all()


@pytest.mark.parametrize('name', planner_names(SCORES))
def test_the_same_seed_leaves_the_same_trace(name):
    one, other = (run(name, 300, seed=7) for _ in range(2))
    assert np.array_equal(one.placement, other.placement)
    assert np.array_equal(one.trace[:, [0, 2]], other.trace[:, [0, 2]])


@pytest.mark.parametrize('name', CONTINUOUS)
def test_a_problem_with_a_known_answer_is_solved(name):
    result = run(name, 4000)
    assert result.depth_error < 0.05
    assert np.abs(match_positions(TARGETS, result.placement[:, :2]) - TARGETS).max() < 0.25


@pytest.mark.parametrize('name', sorted(set(planner_names(SCORES)) - {'random', 'regular_grid'}))
def test_every_search_beats_chance(name):
    space = FreePlane(SPACE.low, SPACE.high, 1.9, 3)
    found = np.mean([run(name, 400, seed, space=space).depth_error for seed in range(4)])
    assert found < np.mean([run('random', 400, seed).depth_error for seed in range(4)])


def cover_problem(seed, candidates):
    """Return sets that candidates cover, (M, 40) bool, and a score by candidate positions."""
    sets = np.random.default_rng(seed).random((len(candidates), 40)) < 0.18

    def score(placements):
        covered = []
        for placement in placements:
            chosen = [int(np.linalg.norm(candidates - place[:2], axis=1).argmin())
                      for place in placement]
            covered.append(sets[chosen].any(axis=0).sum() if chosen else 0)
        return Scores(40.0 - np.array(covered), np.array(covered, dtype=float))

    best = max(sets[list(chosen)].any(axis=0).sum()
               for chosen in combinations(range(len(candidates)), 3))
    return score, best


@pytest.mark.parametrize('seed', range(3))
def test_bpso_solves_a_small_maximum_cover_exactly(seed):
    score, best = cover_problem(seed, SPACE.grid(16))

    class Small(BinaryParticleSwarm):
        max_candidates = 16

    planner = Small(SPACE, np.random.default_rng(seed), 3000)
    assert solve(planner, score, 3000).space_coverage == best


@pytest.mark.parametrize('seed', range(5))
def test_greedy_coverage_answers_with_what_it_covers_and_keeps_its_bound(seed):
    score, best = cover_problem(seed, SPACE.grid(16))

    def backwards(placements):
        """Score so that what covers most has the largest error."""
        covered = score(placements).space_coverage
        return Scores(covered, covered)

    planner = PLANNERS['greedy_coverage'].make(SPACE, np.random.default_rng(0), 48)
    result = solve(planner, backwards, 48)
    assert len(result.placement) == 3 and result.space_coverage >= (1.0 - 1.0 / np.e) * best


@pytest.mark.parametrize('name', ['greedy_error', 'greedy_coverage', 'greedy_swap'])
def test_no_camera_is_left_out_where_fewer_would_do(name):
    def flat(placements):
        return Scores(np.zeros(len(placements)), np.zeros(len(placements)))

    assert len(run(name, 300, score=flat).placement) == 3


@pytest.mark.system
def test_differential_evolution_begins_anew_when_all_are_alike():
    asked = []

    def score(placements):
        asked.append(np.array(placements))
        return toy(placements)

    run('differential_evolution', 20000, score=score)
    # Long after the answer was found, far places are tried again.
    late = np.concatenate(asked[len(asked) // 2:])[:, :, :2]
    assert min(toy([placement]).error[0] for placement in late) < 0.01
    assert max(toy([placement]).error[0] for placement in late) > 1.0


@pytest.mark.system
@pytest.mark.parametrize(('cameras', 'rate'), [(30, 3.0), (4, 4.0)])
def test_tdsa_without_energy_is_a_poisson_process(cameras, rate):
    """The number of cameras follows Poisson(lambda), cut off at K; their places are uniform."""
    class Free(TransDimensionalAnnealing):
        birth_probability = 0.3

    Free.expected_cameras = rate
    planner = Free(FreePlane(SPACE.low, SPACE.high, 1.9, cameras), np.random.default_rng(5), 100)
    placed, counts, places = np.empty((0, 2)), [], []
    for number in range(60000):
        step = planner.take_step(placed, 0.0, 1.0, 1.0)
        next(step)
        try:
            step.send(Scores(np.zeros(1), np.zeros(1)))
        except StopIteration as end:
            placed, _ = end.value
        # Far enough apart to be as good as independent.
        if number % 40 == 0:
            counts.append(len(placed))
            places.extend(placed[:1])
    last = min(cameras, 8)
    observed = np.bincount(np.minimum(counts, last), minlength=last + 1)
    chance = stats.poisson.pmf(np.arange(cameras + 1), rate)
    chance = np.append(chance[:last], chance[last:].sum()) / chance.sum()
    assert stats.chisquare(observed, chance * len(counts)).pvalue > 0.001
    for axis in (0, 1):
        share = (np.array(places)[::5, axis] - SPACE.low[axis]) / SPACE.size[axis]
        assert stats.kstest(share, 'uniform').pvalue > 0.001


def test_folding_keeps_a_step_symmetric_and_inside():
    space = FreePlane(np.zeros(2), np.array([2.0, 1.0]), 1.0, 1)
    np.testing.assert_allclose(space.reflected(np.array([[2.5, -0.25], [-4.5, 3.25]])),
                               [[1.5, 0.25], [0.5, 0.75]])


class Outside(Planner):
    """A planner that does not know its space."""

    def search(self):
        """Place a camera far away."""
        yield [np.array([[100.0, 0.0]])]


class Silent(Planner):
    """A planner that asks nothing."""

    def search(self):
        """Ask nothing."""
        yield from ()


@pytest.mark.parametrize('kind', [Outside, Silent])
def test_a_planner_that_breaks_the_rules_is_found_out(kind):
    with pytest.raises(ValueError, match=f'{kind.__name__}: found'):
        solve(kind(SPACE, np.random.default_rng(0), 5), toy, 5)


def engine_of(room, **rig):
    """Return a small engine."""
    return Simulator(room, SimulationConfig(RigConfig(**rig), EngineConfig(
        preset='fast', error_rows=32, coverage_cell=0.5)))


def test_scores_are_those_of_the_engine(room):
    simulator = engine_of(room)
    rng, score = np.random.default_rng(0), Scorer(simulator)
    places = rng.uniform(*room.bounds, (6, 3))
    placements = [places[rng.permutation(6)[:count]] for count in (0, 1, 3, 3, 2)]
    scores = score(placements)
    for placement, error, coverage in zip(placements, *scores, strict=True):
        if len(placement):
            assert [*simulator.evaluate(placement)][1:] == [coverage, error]
        else:
            assert (error, coverage) == (simulator.depth_error.worst, 0.0)
    # Each camera of a mixed rig is scored with its own model.
    mixed = engine_of(room, cameras=2, sensors='omnidirectional,realsense_d435')
    for placement in (places[:2], places[[1, 0]]):
        assert Scorer(mixed)([placement]).error == [mixed.evaluate(placement).depth_error]


def test_a_camera_that_stands_where_one_stood_costs_no_look(room, monkeypatch):
    simulator = engine_of(room)
    looks, look = [], simulator.look
    monkeypatch.setattr(simulator, 'look',
                        lambda pose, camera: looks.append(pose) or look(pose, camera))
    score, places = Scorer(simulator), np.random.default_rng(0).uniform(*room.bounds, (5, 3))
    score([places[:4]])
    score([places[[0, 1, 2, 4]], places[[4, 3, 2, 1]]])
    assert len(looks) == 5
