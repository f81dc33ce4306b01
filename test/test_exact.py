# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Certificates: the covering problem is the depth error, and what is proved is true."""

from itertools import combinations, product
import json

from conftest import blank_report, made_room
from hypothesis import given, settings, strategies
import numpy as np
import pytest

from ocp_ros.cli.main import main
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import no_bits
from ocp_ros.planners.benders import Benders
from ocp_ros.planners.budget import Budget
from ocp_ros.planners.candidate_pool import features_of, Pool
from ocp_ros.planners.candidate_proof import CandidatePoses, Question, size_for
from ocp_ros.planners.covering import covering_of
from ocp_ros.planners.exact import certify, exact_plane, RigQuestion, search_exact
from ocp_ros.planners.subproblem import ChoiceRules
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.simulation.problem import Problem, space_of
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError

FAST = EngineConfig(preset='fast', error_rows=16)
RIG = """\
cameras:
  - {sensor: realsense_d455, count: 2}
mount: {on: plane, height: 1.9}
spacing: 0.8
regions:
  - {name: table, box: [[2, 2, 0], [5, 5, 1.5]], weight: 2.0}
"""


@pytest.fixture(scope='module')
def plane():
    """Return the engine in a small room, and 14 candidates on its plane."""
    simulator = Simulator(made_room(8, 2000), SimulationConfig(
        rig=RigConfig(cameras=3, max_range=3.0), engine=FAST))
    space = space_of(simulator)
    poses = space.placement(space.grid(14))
    return simulator, space, CandidatePoses(
        poses, [simulator.look(pose).seen for pose in poses], np.zeros(len(poses), dtype=int))


def question_of(simulator, counts, **more):
    """Return the question of so many cameras in a room."""
    return Question(simulator.depth_error, len(simulator.scene), np.array(counts), **more)


def best_of(question, candidates, choices):
    """Return the least loss of choices of candidates, by trying all."""
    return min(question.loss([candidates.views[k] for k in chosen]) for chosen in choices)


@settings(max_examples=60, deadline=None)
@given(data=strategies.data())
def test_less_depth_error_is_monotone_and_submodular(plane, data):
    simulator, _, candidates = plane
    numbers = strategies.sets(strategies.integers(0, len(candidates.views) - 1))
    small = data.draw(numbers)
    large = small | data.draw(numbers)
    one = data.draw(strategies.integers(0, len(candidates.views) - 1))

    def error(chosen):
        views = [candidates.views[k] for k in chosen]
        return simulator.depth_error(np.bitwise_or.reduce([no_bits(len(simulator.scene)), *views]))

    assert error(large) <= error(small) + 1e-9
    assert error(small) - error(small | {one}) >= error(large) - error(large | {one}) - 1e-9


@settings(max_examples=30, deadline=None)
@given(chosen=strategies.sets(strategies.integers(0, 13), min_size=1),
       share=strategies.lists(strategies.floats(0.0, 1.0), min_size=14, max_size=14))
def test_the_covering_problem_is_the_depth_error_and_cuts_are_below(plane, chosen, share):
    simulator, _, candidates = plane
    error, views = simulator.depth_error, candidates.views
    covering = covering_of(error.trees, error.pixels, len(simulator.scene), views)
    chosen = [k for k in chosen if k < len(views)] or [0]
    loss = covering.loss(chosen)
    assert loss == pytest.approx(error(np.bitwise_or.reduce([views[k] for k in chosen])), abs=1e-6)
    cut = covering.cut(np.array(share[:len(views)]))
    assert (cut.consts - cut.gains @ covering.chosen(chosen)).sum() <= loss + 1e-9
    before, after = covering.exchanges(chosen)
    assert before == pytest.approx(loss)
    for k, other in product(range(len(chosen)), (0, 5)):
        swapped = [*chosen[:k], other, *chosen[k + 1:]]
        assert after[k, other] == pytest.approx(covering.loss(swapped))
    keep = ~np.isin(np.arange(len(views)), chosen)
    smaller = covering.shrunk(keep, chosen)
    rest = np.flatnonzero(keep)[:2]
    assert smaller.loss(range(len(rest))) == pytest.approx(covering.loss([*chosen, *rest]))


@pytest.mark.parametrize('spacing', [0.0, 4.2])
def test_what_is_proved_is_the_best_of_all_choices(plane, spacing):
    simulator, _, candidates = plane
    question = question_of(simulator, [3], spacing=spacing)
    proof = question.solve(candidates)
    away = np.linalg.norm(candidates.poses[:, None] - candidates.poses[None], axis=2)
    choices = [chosen for chosen in combinations(range(len(candidates.poses)), 3)
               if all(away[one, other] >= spacing for one, other in combinations(chosen, 2))]
    assert 0 < len(choices) <= 364
    assert proof.proved and proof.chosen in choices
    least = best_of(question, candidates, choices)
    assert proof.loss == pytest.approx(least, rel=1e-5)
    assert proof.bound == pytest.approx(least, rel=1e-5)
    assert (proof.loss - proof.bound) / proof.loss < 1e-5
    if spacing:
        assert proof.loss > question_of(simulator, [3]).solve(candidates).loss


def test_cameras_in_place_and_points_that_matter_count(plane):
    simulator, _, candidates = plane
    extra = np.zeros(len(simulator.scene))
    extra[::7] = 0.01
    question = question_of(simulator, [2], fixed=candidates.views[3], extra=extra)
    proof = question.solve(candidates)
    least = best_of(question, candidates, combinations(range(len(candidates.views)), 2))
    assert proof.proved and proof.loss == pytest.approx(least, rel=1e-5)
    # Another problem than without them.
    assert proof.loss != pytest.approx(question_of(simulator, [2]).solve(candidates).loss, rel=0.1)


def test_two_models_are_chosen_by_their_counts(plane):
    simulator, _, candidates = plane
    half = len(candidates.views) // 2
    group = np.repeat([0, 1], [half, len(candidates.views) - half])
    candidates = CandidatePoses(candidates.poses, candidates.views, group)
    question = question_of(simulator, [1, 2])
    proof = question.solve(candidates)
    choices = [(one, *two) for one in range(half)
               for two in combinations(range(half, len(group)), 2)]
    assert list(group[list(proof.chosen)]) == [0, 1, 1]
    assert proof.proved and proof.loss == pytest.approx(
        best_of(question, candidates, choices), rel=1e-5)


def test_without_candidates_that_fit_nothing_is_found(plane):
    simulator, _, candidates = plane
    proof = question_of(simulator, [3], spacing=99.0).solve(candidates)
    assert proof.chosen == () and proof.loss == np.inf


@pytest.mark.parametrize('calls', [0, 5, 15, 20, 30, 60])
def test_a_proof_that_is_stopped_has_a_valid_bound(plane, calls):
    simulator, space, _ = plane
    poses = space.placement(space.grid(60))
    candidates = CandidatePoses(poses, [simulator.look(pose).seen for pose in poses],
                                np.zeros(len(poses), dtype=int))
    question = question_of(simulator, [3])
    left = iter(range(calls))
    stopped = question.solve(candidates, lambda: next(left, None) is None)
    whole = question.solve(candidates)
    assert whole.proved and 0.0 <= stopped.bound <= whole.loss <= stopped.loss
    known = question.solve(candidates, known=0.9 * whole.loss)
    assert known.proved and 0.9 * whole.loss >= known.bound > 0.89 * whole.loss


def test_the_same_question_has_the_same_answer(plane):
    simulator, space, _ = plane
    one, again = (exact_plane(simulator, space, 60, 600.0, 16) for _ in range(2))
    assert np.array_equal(one.placement, again.placement)
    assert one.certificate.bound == again.certificate.bound


def test_on_a_plane_it_goes_on_near_the_best_candidates(plane):
    simulator, space, _ = plane
    grid = exact_plane(simulator, space, 40, 600.0, 16, near=False)
    near = exact_plane(simulator, space, 40, 600.0, 16)
    assert near.certificate.found < grid.certificate.found == pytest.approx(
        grid.certificate.bound, rel=1e-5)
    assert near.certificate.candidates > grid.certificate.candidates == len(space.grid(40))
    assert simulator.evaluate(near.placement).depth_error == pytest.approx(near.certificate.found)
    assert space.contains(near.placement[:, :2]).all()
    late = exact_plane(simulator, space, 40, 600.0, 16, over=lambda: True)
    assert late.placement.shape == (3, 3)
    assert late.certificate.bound <= late.certificate.found


def test_size_is_what_there_is_time_for(plane):
    simulator, _, candidates = plane
    error, points = simulator.depth_error, len(simulator.scene)
    assert size_for(error, 16, candidates.views, points, 1e9) == (16, len(candidates.views))
    views = candidates.views * 40
    rows, count = size_for(error, 128, views, points, 2e3)
    assert rows == 32 and 200 <= count < len(views)


def rig_problem(**more):
    """Return a rig in a small room, and candidates for it."""
    problem = Problem.of(made_room(8, 2000), rig_of(2, 'd455', **more),
                         SimulationConfig(engine=FAST))
    return problem, Pool(problem, 80)


def test_a_rig_is_planned_and_certified():
    region = {'name': 'table', 'box': [[2, 2, 0], [5, 5, 1.5]], 'weight': 2.0}
    problem, pool = rig_problem(regions=[region], spacing=0.8, fixed=[
        {'sensor': 'realsense_d455', 'position': [6.0, 6.0, 2.0], 'yaw': 225, 'pitch': 25}])
    answer = search_exact(problem, pool, Budget(evaluations=60), 0)
    assert problem.region.broken(answer.poses) == []
    asked, known = RigQuestion(problem, pool, None), answer.certificate
    # Without anything that must be seen it is the loss of the rig.
    assert known.found == pytest.approx(answer.loss, abs=1e-6)
    views = [asked.offered.views[k] for k in range(len(asked.offered.views))]
    least = min(asked.question.loss(pair) for pair in combinations(views[:40], 2)) / asked.unit
    assert known.bound <= least
    other = [pool.site(problem.rig.models[0], k) for k in (0, 9)]
    certificate, better = certify(problem, pool, other, Budget(evaluations=60))
    assert certificate.proved and certificate.gap < 1e-5
    assert problem.objective.loss([site.view for site in better]) < problem.objective.loss(
        [site.view for site in other])


def test_what_several_cameras_have_to_see_is_refused():
    problem, pool = rig_problem(seen_by=2)
    with pytest.raises(ConfigurationError, match='--planner: exact found seen_by: 2; expected 1'):
        search_exact(problem, pool, Budget(evaluations=60), 0)


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Write a room and a rig to the folder that is worked in."""
    save_scene(made_room(8, 2000), tmp_path / 'room.ply')
    (tmp_path / 'rig.yaml').write_text(RIG)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr('ocp_ros.report.drawing.sheet.draw', blank_report)
    return tmp_path


def planned(capsys, *arguments):
    """Return what ocp plan says."""
    assert main(['plan', 'room.ply', *arguments, '--json']) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize('planner', ['exact', 'rig_search'])
def test_a_plan_says_how_much_better_others_may_be(files, capsys, planner):
    found = planned(capsys, '--rig', 'rig.yaml', '--planner', planner, '--evaluations', '200')
    search = found['search']
    known = search['certificate']
    assert found['broken'] == [] and search['planner'] == planner
    assert search['searches'][0] == search['loss'] == found['scores']['loss']
    assert known['candidates'] >= 100 and known['rows'] == 64 and known['bound'] > 0.0
    assert known['gap'] == pytest.approx(max(1.0 - known['bound'] / known['found'], 0.0))
    assert known['sentence'].startswith(
        f'No placement on the {known["candidates"]:,} compared candidate poses is better')
    for page in ('installer.md', 'report.html'):
        assert known['sentence'] in (files / 'out/plan' / page).read_text()


def test_a_plan_without_a_bound_says_why(files, capsys):
    (files / 'rig.yaml').write_text(RIG + 'seen_by: 2\n')
    found = planned(capsys, '--rig', 'rig.yaml', '--evaluations', '100')
    known = found['search']['certificate']
    assert known['gap'] is None and 'found seen_by: 2' in known['sentence']


def test_choices_that_exclude_each_other_are_never_branched_into(plane):
    simulator, _, candidates = plane
    error = simulator.depth_error
    covering = covering_of(error.trees, error.pixels, len(simulator.scene), candidates.views)
    count = len(candidates.views)
    near = np.ones((count, count), dtype=bool)
    np.fill_diagonal(near, False)
    near[0, 5] = near[5, 0] = False
    choice = ChoiceRules(np.zeros(count, dtype=int), np.array([2]),
                         features_of(candidates.poses), near)
    proof = Benders(covering, choice).run()
    assert proof.proved and proof.chosen == (0, 5)
