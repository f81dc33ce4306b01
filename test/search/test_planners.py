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

"""Planners keep their budget and space and do what their names promise; the end is finished."""

from itertools import combinations
import time

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import mounted
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.search import finishing
from ocp_ros.search.annealing import TransDimensionalAnnealing
from ocp_ros.search.planner import Planner, Scores
from ocp_ros.search.population import BinaryParticleSwarm, match_positions
from ocp_ros.search.registry import planner_names, PLANNERS, SCORES
from ocp_ros.search.scorer import Scorer
from ocp_ros.search.solve import Archive, ARCHIVE_SIZE, solve
from ocp_ros.simulation.problem import space_of
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
    assert np.array_equal(result.placement, again.placement)
    assert np.array_equal(result.trace[:, [0, 2]], again.trace[:, [0, 2]])
    for placement in asked:
        assert placement.shape[1] == 3 and len(placement) <= 3
        assert (placement[:, 2] == 1.9).all()
        assert (placement[:, :2] >= SPACE.low - 1e-9).all()
        assert (placement[:, :2] <= SPACE.high + 1e-9).all()
    # The answer is the best of all that was judged, and the trace tells how it came about.
    assert result.depth_error == pytest.approx(toy(asked).error.min())
    assert toy([result.placement]).error[0] == pytest.approx(result.depth_error)
    assert (np.diff(result.trace[:, 2]) <= 0).all() and (np.diff(result.trace[:, 0]) > 0).all()


@pytest.mark.parametrize('name', sorted(set(planner_names(SCORES)) - {'random', 'regular_grid'}))
def test_every_search_beats_chance_and_most_find_a_known_answer(name):
    found = np.mean([run(name, 400, seed).depth_error for seed in range(4)])
    assert found < np.mean([run('random', 400, seed).depth_error for seed in range(4)])
    if name in CONTINUOUS:
        result = run(name, 4000)
        assert result.depth_error < 0.05
        nearest = match_positions(TARGETS, result.placement[:, :2])
        assert np.abs(nearest - TARGETS).max() < 0.25


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
    assert len(result.placement) == 3 and result.space_coverage >= (1.0 - 1.0 / np.e) * best


@pytest.mark.parametrize('name', ['greedy_error', 'greedy_coverage', 'greedy_swap'])
def test_no_camera_is_left_out_where_fewer_would_do(name):
    def flat(placements):
        return Scores(np.zeros(len(placements)), np.zeros(len(placements)))

    assert len(run(name, 300, score=flat).placement) == 3


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
    """The number of cameras follows Poisson(lambda), cut off at K; their places are uniform."""
    class Free(TransDimensionalAnnealing):
        birth_probability = 0.3

    Free.expected_cameras = rate
    planner = Free(FreePlane(SPACE.low, SPACE.high, 1.9, cameras), np.random.default_rng(5), 100)
    placed, counts, places = np.empty((0, 2)), [], []
    for number in range(60000):
        step = planner.take_step(placed, 0.0, 1.0, 1.0)
        next(step)
        with pytest.raises(StopIteration) as end:
            step.send(Scores(np.zeros(1), np.zeros(1)))
        placed, _ = end.value.value
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


@pytest.mark.parametrize(('name', 'asked'), [
    ('Outside', [[np.array([[100.0, 0.0]])]]), ('Silent', [])])
def test_a_planner_that_breaks_the_rules_is_found_out(name, asked):
    planner = type(name, (Planner,), {'search': lambda _: (one for one in asked)})
    with pytest.raises(ValueError, match=f'{name}: found'):
        solve(planner(SPACE, np.random.default_rng(0), 5), toy, 5)


@pytest.fixture(scope='module')
def engine(room):
    """Return the engine in a small room."""
    return Simulator(room, SimulationConfig(engine=EngineConfig(
        preset='fine', error_rows=24, coverage_cell=0.5, error_folds=2)))


def test_scores_are_those_of_the_engine(engine, room):
    rng = np.random.default_rng(0)
    places = rng.uniform(*room.bounds, (6, 3))
    placements = [places[rng.permutation(6)[:count]] for count in (0, 1, 3, 3, 2)]
    for placement, error, coverage in zip(placements, *Scorer(engine)(placements), strict=True):
        if len(placement):
            assert [*engine.evaluate(placement)][1:] == [coverage, error]
        else:
            assert (error, coverage) == (engine.depth_error.worst, 0.0)
    # Each camera of a mixed rig is scored with its own model.
    mixed = Simulator(room, SimulationConfig(
        RigConfig(cameras=2, sensors='omnidirectional,realsense_d435'), EngineConfig('fast', 24)))
    for placement in (places[:2], places[[1, 0]]):
        assert Scorer(mixed)([placement]).error == [mixed.evaluate(placement).depth_error]


def planner(engine, name, budget):
    """Return a planner of four cameras in the room."""
    return PLANNERS[name].make(space_of(engine), np.random.default_rng(0), budget)


def test_no_place_is_looked_from_twice(engine, monkeypatch, room):
    looks, look = [], engine.look
    monkeypatch.setattr(engine, 'look', lambda pose, camera=0: (
        looks.append(pose.tobytes()), look(pose, camera))[1])
    score, space = Scorer(engine), space_of(engine)
    places = np.random.default_rng(0).uniform(*room.bounds, (5, 3))
    score([places[:4]])
    score([places[[0, 1, 2, 4]], places[[4, 3, 2, 1]]])
    assert len(looks) == 5
    looks.clear()
    lattice = finishing.LatticeScorer(Scorer(engine), space)
    solve(planner(engine, 'annealing', 300), lattice, 300)
    assert 0 < len(looks) == len(set(looks)) <= 2.0 * space.area / finishing.LATTICE_M ** 2


@pytest.mark.parametrize('name', ['annealing', 'tdsa', 'cma_es'])
def test_the_end_is_no_worse_than_the_best_of_the_lattice(engine, name):
    score, space = Scorer(engine), space_of(engine)
    found, again = (finishing.search_and_finish(planner(engine, name, 200), score, 200)
                    for _ in range(2))
    np.testing.assert_array_equal(found.placement, again.placement)
    assert found.evaluations <= 200
    assert found.depth_error == engine.evaluate(found.placement).depth_error
    lattice = finishing.LatticeScorer(score, space)
    before = solve(planner(engine, name, 200), lattice, 170)
    # What is chosen last is steadier, and so may be worse by a little as it stands.
    assert found.depth_error <= 1.1 * before.depth_error
    assert found.trace[-1, 2] <= found.depth_error
    assert (np.diff(found.trace[:, 0]) > 0).all()


def test_a_lattice_moves_cameras_by_less_than_its_edge_and_nowhere_they_may_not_be(engine):
    space = space_of(engine)
    lattice = finishing.LatticeScorer(Scorer(engine), space)
    positions = np.array([space.random(np.random.default_rng(k), 1)[0] for k in range(100)])
    snapped = lattice.snapped_positions(positions)
    assert space.contains(snapped).all()
    np.testing.assert_array_equal(lattice.snapped_positions(positions), snapped)
    assert np.median(np.linalg.norm(snapped - positions, axis=1)) <= finishing.LATTICE_M * 0.71


def test_of_the_best_the_steadiest_is_chosen(engine):
    fine, space = Scorer(engine), space_of(engine)
    found = solve(planner(engine, 'annealing', 100), fine, 100)
    steady = finishing.choose_robust(found, space, fine, 10, time.perf_counter)

    def off(placement):
        return np.mean(fine(list(mounted(placement, finishing.MOUNTING_ERRORS))).error)

    choices = finishing.distinct_placements(found.best, 10, finishing.CHOICE_DISTANCE_M)
    assert off(steady.placement) == min(off(space.placement(choice)) for choice in choices)
    assert steady.evaluations == found.evaluations + finishing.MOUNTING_ERRORS.count * len(choices)
    assert finishing.choose_robust(found, space, fine, 1, time.perf_counter) is found


def test_a_yardstick_is_judged_anew_and_not_improved(engine):
    score, space = Scorer(engine), space_of(engine)
    found = finishing.search_and_finish(planner(engine, 'random', 60), score, 60)
    lattice = finishing.LatticeScorer(score, space)
    drawn = solve(planner(engine, 'random', 60), lattice, 51).best
    assert any(np.array_equal(found.placement, space.placement(lattice.snapped_positions(one)))
               for one in drawn)
    # One evaluation is enough.
    only = finishing.search_and_finish(planner(engine, 'random', 1), score, 1)
    assert only.placement.shape == (4, 3)


def test_the_archive_keeps_the_best_and_the_first_of_equals_and_elites_differ():
    archive, rng = Archive(), np.random.default_rng(0)
    errors = rng.integers(0, 300, 3 * ARCHIVE_SIZE).astype(float)
    for number, error in enumerate(errors):
        archive.add((error,), np.array([[number, 0.0]]))
    numbers = [int(one[0, 0]) for one in archive.best]
    assert numbers == np.argsort(errors, kind='stable')[:ARCHIVE_SIZE].tolist()
    placements = [rng.uniform(0.0, 1.0, (3, 2)) for _ in range(60)]
    chosen = finishing.distinct_placements(placements, 10, 0.25)
    assert np.array_equal(chosen[0], placements[0]) and len(chosen) == 10
    assert min(finishing.max_distance(one, other) for k, one in enumerate(chosen)
               for other in chosen[:k]) >= 0.25
    # Which camera has which number means nothing.
    assert len(finishing.distinct_placements([placements[0], placements[0][::-1]], 10, 0.1)) == 1
