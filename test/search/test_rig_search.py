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

"""Pricing: the trees are the loss, the bound is below every choice, and the clock is obeyed."""

from dataclasses import replace
from itertools import combinations, count

from conftest import for_any, made_room, printed
from hypothesis import strategies
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import no_bits, pack, unpack
from ocp_ros.report.rig_planning import certificate_data
from ocp_ros.rig.rig_file import rig_from, rig_of
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import CandidatePool
from ocp_ros.search.pose_grid import PoseGrid
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.search.proof.column_generation import Column, ColumnGeneration
from ocp_ros.search.proof.cut_program import CutProgram
from ocp_ros.search.proof.loss_trees import LossTrees, poses_by_point
from ocp_ros.search.rig_plan import RigPlanner
from ocp_ros.search.rig_search import (
    ColumnGenerationSearch,
    GrowingProof,
    prove_gap,
    search,
)
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import View
from ocp_ros.util.yaml_files import Document
import pytest
from scipy.optimize import linprog
from scipy.spatial.distance import cdist
import yaml

FAST = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16))
TABLE = {'name': 'table', 'box': [[2, 2, 0], [5, 5, 1.5]], 'weight': 2.0}
MUST = {'name': 'door', 'box': [[0, 0, 0], [2, 2, 2]], 'weight': 0.5, 'must_see': 0.8}
REQUIRE = {'require': {'pixel_density': 'characterise', 'incidence': 70, 'share': 0.8}}
IN_PLACE = {'sensor': 'realsense_d455', 'position': [6.0, 6.0, 2.0], 'yaw': 225, 'pitch': 25}


def problem_of(count=3, sensor='d455', **more):
    """Return a rig in a small room."""
    return Problem.of(made_room(8, 2000), rig_of(count, sensor, **more), FAST)


def test_without_a_limit_of_time_progress_is_that_of_the_steps():
    problem = problem_of(1)
    shares = []

    class WatchedBudget(Budget):
        def used_share(self, *arguments):
            # Searches and proofs ask for it again and again.
            shares.append(runner.used_share())
            return super().used_share(*arguments)

    pool, budget = CandidatePool(problem, 60, max_grid_poses=200), WatchedBudget(evaluations=40)
    runner = ColumnGenerationSearch(problem, pool, budget, 0)
    assert runner.used_share() == 0.0
    pool.dense_grid(problem, problem.rig.models[0]).grow(8)
    grown = runner.used_share()
    runner.run()
    assert 0.0 < grown < runner.used_share() <= 1.0
    # The proof after the search is the last fifth, and moves too.
    assert shares == sorted(shares) and 0.8 < shares[-1] < 1.0


def few_of(problem, most):
    """Return the relaxed choice of about so many poses."""
    model = problem.rig.models[0]
    grid = PoseGrid.of(problem.region, problem.simulator, model, 0, most)
    grid.grow()
    relaxation = ColumnGeneration(LossTrees.of(problem.objective), [grid],
                                  [len(problem.rig.cameras)], problem.rig.spacing,
                                  problem.simulator.row_count)
    return relaxation, grid


def view_of(grid, place, heading, points):
    """Return what a pose of a grid sees, and what meets each requirement, without cells."""
    flags = np.zeros(grid._simulator.row_count, dtype=bool)
    flags[grid.visible_points(place, [heading])[0]] = True
    seen, *good = map(pack, flags.reshape(-1, points))
    return View(seen, no_bits(0), good=np.array(good))


@pytest.fixture(scope='module')
def asked():
    """Return a rig that asks for much, the poses of a few places, and what each of some sees."""
    problem = problem_of(2, regions=[TABLE | REQUIRE, MUST], fixed=[IN_PLACE])
    relaxation, grid = few_of(problem, 600)
    numbers = np.random.default_rng(0).choice(len(grid), 40, replace=False)
    turns = len(grid.headings[0])
    poses = [(int(k) // turns, int(k) % turns) for k in numbers]
    return problem, relaxation, grid, poses


@pytest.mark.parametrize('mount', ['walls', 'ceiling', 'plane'])
def test_one_look_around_is_a_look_by_each_heading(mount):
    problem = problem_of(1, mount={'on': mount})
    grid = PoseGrid.of(problem.region, problem.simulator, problem.rig.models[0], 0, 400)
    grid.grow()
    points = len(problem.simulator.scene)
    for place in range(len(grid.places)):
        for heading in range(0, len(grid.headings[place]), 7):
            pose = grid.pose(place, heading)
            assert problem.region.allowed(pose[None], problem.rig.models[0]).all()
            seen = np.flatnonzero(unpack(problem.simulator.look(pose).seen, points))
            assert np.array_equal(grid.visible_points(place, [heading])[0], seen)


@pytest.mark.parametrize('preset', ['fine', 'fast', 'paper'])
def test_many_looks_from_few_places_are_the_looks(preset):
    problem = Problem.of(made_room(8, 2000), rig_of(1, 'd455', mount={'on': 'walls'}),
                         SimulationConfig(engine=EngineConfig(preset)))
    simulator, model = problem.simulator, problem.rig.models[0]
    poses = np.random.default_rng(0).permutation(problem.region.candidates(model, 60))
    for pose, view in zip(poses, simulator.look_many(poses, threads=2), strict=True):
        alone = simulator.look(pose)
        assert np.array_equal(view.position, pose[:3])
        for found, bits in zip(view[:2], alone[:2]):
            assert int(np.bitwise_count(found ^ bits).sum()) <= (preset == 'fast')
    assert simulator.look_many(poses[:0]) == []


def test_candidates_that_are_few_for_want_of_time_are_spread_over_the_room():
    problem = problem_of(1)
    whole = CandidatePool(problem, 2000)
    few = CandidatePool(problem, 2000, should_stop=lambda: True)
    places = [len(np.unique(pool.candidates_of(problem.rig.models[0]).poses[:, :3], axis=0))
              for pool in (whole, few)]
    assert not few.complete and len(few) < len(whole) and places[1] > 0.8 * places[0]


@for_any(15, data=strategies.data())
def test_the_trees_are_the_loss_and_cuts_are_below(asked, data):
    problem, relaxation, grid, poses = asked
    trees, points = relaxation.trees, len(problem.simulator.scene)
    chosen = data.draw(strategies.lists(strategies.sampled_from(range(len(poses))), min_size=1,
                                        max_size=2, unique=True))
    share = np.array(data.draw(strategies.lists(strategies.floats(0.0, 1.0), min_size=len(poses),
                                                max_size=len(poses))))
    loss = problem.objective.loss([view_of(grid, *poses[k], points) for k in chosen])
    seen_by = poses_by_point([grid.visible_points(place, [heading])[0]
                              for place, heading in poses], problem.simulator.row_count)
    choice = np.zeros(len(poses))
    choice[chosen] = 1.0
    # The loss of these poses on all trees, and on those that are merged for them.
    merged, rows = trees.merged(seen_by)
    assert len(merged.weights) < len(trees.weights) == len(rows)
    for some in (trees, merged):
        missed, _ = some.loss_cuts(seen_by, len(poses),
                                   some.weights * some.unserved_nodes(seen_by, choice))
        assert np.maximum(missed, 0.0).sum() == pytest.approx(loss, abs=1e-6)
    constants, gains = merged.loss_cuts(seen_by, len(poses),
                                        merged.weights * merged.unserved_nodes(seen_by, share))
    assert np.maximum(constants - gains @ choice, 0.0).sum() <= loss + 1e-6


@pytest.mark.parametrize('more', [
    {}, {'spacing': 0.0}, {'spacing': 3.0}, {'regions': [TABLE, MUST]},
    {'fixed': [IN_PLACE], 'regions': [TABLE]}, {'require': {'incidence': 50}, 'regions': [TABLE]}])
def test_no_choice_of_all_poses_is_below_the_bound(more):
    problem = problem_of(2, 'omnidirectional', **more)
    relaxation, grid = few_of(problem, 40)
    relaxation.raise_bound(lambda: False)
    points, places = len(problem.simulator.scene), grid.places
    views = [view_of(grid, place, 0, points) for place in range(len(places))]
    losses = {(one, other): problem.objective.loss([views[one], views[other]])
              for one, other in combinations(range(len(places)), 2)
              if np.linalg.norm(places[one] - places[other]) >= problem.rig.spacing}
    least = min(losses.values())
    best = relaxation.find_choices(8, np.random.default_rng(0), lambda: False)[0]
    chosen = tuple(sorted(column.place for column in best.columns))
    assert losses[chosen] == pytest.approx(best.loss, abs=1e-6)
    assert relaxation.closed and 0.5 * least < relaxation.bound <= least + 1e-6
    assert best.loss <= 1.05 * least


@pytest.mark.parametrize('more', [
    {'seen_by': 2}, {'seen_by': 2, 'fixed': [IN_PLACE]}, {'seen_by': 3, 'regions': [TABLE, MUST]},
    {'calibratable': {'overlap': 0.6}}, {'regions': [{**MUST, 'air': {}}]}])
def test_bounds_of_goals_that_count_in_part_are_below_all_choices_too(more):
    problem = problem_of(3, 'omnidirectional', **more)
    relaxation, grid = few_of(problem, 16)
    relaxation.raise_bound(lambda: False)
    views = [problem.simulator.look(place) for place in grid.places]
    near = cdist(grid.places, grid.places) < problem.rig.spacing
    least = min(problem.objective.loss([views[k] for k in chosen])
                for chosen in combinations(range(len(views)), 3)
                if not any(near[pair] for pair in combinations(chosen, 2)))
    assert relaxation.closed and 0.0 < relaxation.bound <= least + 1e-6


@pytest.mark.parametrize('one_by_one', [False, True])
def test_many_cuts_are_solved_and_those_left_out_change_no_optimum(one_by_one):
    rng, parts, poses, chosen, numbers = np.random.default_rng(0), 16, 300, 16, 40
    constants = rng.uniform(0.5, 1.0, (numbers, parts))
    gains = 3.0 / chosen * rng.uniform(size=(numbers, parts, poses)) ** 3 * (
        rng.random((numbers, parts, poses)) < 0.3)
    program = CutProgram(np.zeros(poses, dtype=np.int64), [chosen], parts)
    for number in range(numbers):
        program.add_cuts(number, constants[number], gains[number])
        solution = program.solve(lambda: False) if one_by_one else None
    if one_by_one:
        # These have to return if they are binding.
        left_out = set(np.ndindex(numbers, parts)) - set(map(tuple, program.cuts))
        assert len(left_out) > numbers
        for number in range(numbers):
            program.add_cuts(number, constants[number], gains[number])
    solution = program.solve(lambda: False)
    expected = linprog(
        np.repeat([1.0, 0.0], [parts, poses]), bounds=[(0, None)] * parts + [(0, 1)] * poses,
        A_ub=-np.hstack([np.tile(np.eye(parts), (numbers, 1)), gains.reshape(-1, poses)]),
        b_ub=-constants.ravel(), A_eq=np.repeat([[0.0, 1.0]], [parts, poses], axis=1),
        b_eq=[chosen]).fun
    assert solution.optimal
    assert solution.losses.sum() == pytest.approx(expected)
    # The multipliers are those of the cuts that remain: they prove the optimum.
    number, part = program.cuts.T
    pose_gains = np.sort(solution.multipliers @ gains[number, part])[-chosen:]
    assert solution.multipliers @ constants[number, part] - pose_gains.sum() == pytest.approx(
        expected)


def test_poses_that_join_later_count():
    problem = problem_of(2, 'omnidirectional')
    relaxation, grid = few_of(problem, 10)
    relaxation.raise_bound(lambda: False)
    before = relaxation.find_choices(1, np.random.default_rng(0), lambda: False)[0]
    places = problem.region.candidates(problem.rig.models[0], 200)[:, :3]
    first = len(grid.places)
    grid.add_poses(places, [np.zeros((1, 3))] * len(places))
    relaxation.add_columns([Column(0, first, 0)])
    relaxation.raise_bound(lambda: False)
    after = relaxation.find_choices(4, np.random.default_rng(1), lambda: False)[0]
    assert relaxation.bound <= after.loss < before.loss and len(relaxation) == first + len(places)


def test_two_models_are_chosen_by_their_counts_and_nobody_too_near():
    rig = rig_from(Document('rig', {'cameras': [
        {'sensor': 'omnidirectional', 'count': 2},
        {'sensor': 'omnidirectional', 'max_range': 3.0, 'name': 'ball'}], 'spacing': 1.5}))
    problem = Problem.of(made_room(8, 2000), rig, FAST)
    pool = CandidatePool(problem, 60, max_grid_poses=200)
    answer = search(problem, pool, Budget(evaluations=20), 0)
    assert problem.region.broken(answer.poses) == []
    assert answer.certificate.bound <= answer.loss == problem.objective.evaluate(
        answer.poses).loss


@pytest.mark.parametrize('seconds', [0.5, 3.0, 700.0])
def test_a_busy_machine_gets_a_proof_and_some_evaluations_and_then_time_counts(seconds):
    problem, looks = problem_of(3, regions=[MUST]), count(1)
    pool = CandidatePool(problem, 60, max_grid_poses=600)
    budget = Budget(seconds, clock=lambda: float(next(looks)))
    answer = search(problem, pool, budget, 0)
    assert problem.region.broken(answer.poses) == []
    assert answer.evaluations >= 200 and np.isfinite(answer.certificate.moved)
    assert 0.0 < answer.certificate.bound <= answer.loss
    # After these, each place, program and move looks at the clock once more and ends.
    assert next(looks) < seconds + 500.0


def test_ctrl_c_ends_a_search_at_once():
    problem = problem_of(3)
    budget = Budget(3600.0)
    budget.stop()
    answer = search(problem, CandidatePool(problem, 60, max_grid_poses=600), budget, 0)
    assert problem.region.broken(answer.poses) == [] and answer.evaluations < 10


def test_a_grid_that_grows_says_what_was_proved_on_the_last_one():
    problem, looks = problem_of(3), count(1)
    pool = CandidatePool(problem, 60)
    budgets = [Budget(seconds, clock=lambda: float(next(looks))) for seconds in (1.0, 4000.0)]
    known = [search(problem, pool, budget.restarted(), 0).certificate for budget in budgets]
    assert known[0].candidates < known[1].candidates and known[0].step > known[1].step
    assert not known[0].final
    # More poses cannot have a larger bound, and the answer is one of those that are known.
    assert known[1].bound <= known[0].bound + 1e-9 and known[1].found <= known[0].found * 1.01


def test_many_cameras_and_few_evaluations_are_far_better_than_chance():
    scene, rig = made_room(11, 3000), rig_of(10, 'd455', mount={'on': 'ceiling'})
    plan = RigPlanner(scene, rig, FAST.engine, Budget(evaluations=60)).plan(rig)
    assert plan.answer.evaluations > 0 and plan.evaluation.loss < 0.7 * plan.random.min()
    # A planner that finds less than chance gives the best of what was drawn.
    drawn = RigPlanner(scene, rig, FAST.engine, Budget(evaluations=1), planner='random').plan(rig)
    assert drawn.evaluation.loss == drawn.answer.loss <= drawn.random.min()


def test_a_pool_that_a_search_has_grown_begins_anew_and_serves_more_cameras():
    scene, clocks = made_room(8, 2000), count(1)
    few, many = (Problem.of(scene, rig_of(cameras, 'd455'), FAST) for cameras in (1, 8))
    pool = CandidatePool(few, 60, max_grid_poses=500)
    search(few, pool, Budget(evaluations=20), 0)
    answer = search(many, pool, Budget(evaluations=20), 0)
    assert answer.evaluations > 0 and pool.dense_grid(many, many.models[0]).place_count >= 32
    # With hardly any time, the proof is that of the first places again.
    pool, late = CandidatePool(few, 60), Budget(1.0, clock=lambda: float(next(clocks)))
    known = [search(few, pool, budget, 0).certificate.candidates
             for budget in (Budget(evaluations=20), late)]
    assert known[1] == 64 * 120 < known[0]


def test_where_nothing_was_found_on_the_grid_the_certificate_says_so():
    problem = problem_of(2)
    pool, budget = CandidatePool(problem, 60, max_grid_poses=300), Budget(evaluations=20)
    proof = GrowingProof(problem, pool, budget, 0.5)
    known, _ = prove_gap(lambda: proof, 10.0, np.inf)
    data = certificate_data(known)
    assert data['on_grid'] is data['moved'] is None and 'gained' not in data['sentence']


def test_off_the_grid_it_is_better_than_on_it():
    problem = problem_of(2)
    pool = CandidatePool(problem, 60, max_grid_poses=1000)
    known = search(problem, pool, Budget(evaluations=400), 0).certificate
    assert known.found < known.on_grid and known.moved > 0.01
    # The bound is that of the grid.
    assert known.bound <= known.on_grid


def test_the_promise_is_made_on_viewpoints_that_the_search_has_not_used():
    problem = problem_of(2)
    searched, validation = problem.objective, problem.objective.validation
    own, others = (objective.simulator.depth_error.viewpoints for objective in (
        searched, validation))
    assert len(own) == 16 and len(others) == 64 and np.ptp(others[:, 2]) > 1.0
    pool = CandidatePool(problem, 200, max_grid_poses=1000)

    def ratio(poses):
        return validation.evaluate(poses).depth_error / searched.evaluate(poses).depth_error

    rng = np.random.default_rng(0)
    drawn = np.median([ratio(np.array([site.pose for site in pool.random_sites(
        problem.rig, rng)])) for _ in range(20)])
    # There only views count that the scan proves.
    assert 0.95 < drawn < 1.15
    # What was fitted to the viewpoints of the search is worth less elsewhere.
    assert ratio(search(problem, pool, Budget(evaluations=1000), 0).poses) > drawn + 0.02


@pytest.fixture
def plan(room_folder, undrawn, capsys):
    """Return a function that plans two cameras with a region, with more keys and options."""
    def printed_plan(more, *options):
        (room_folder / 'rig.yaml').write_text(yaml.safe_dump(
            {'cameras': [{'sensor': 'realsense_d455', 'count': 2}], 'spacing': 0.8,
             'regions': [TABLE], **more}))
        return printed(capsys, 'plan', 'room.ply', '--rig', 'rig.yaml', *options)

    return printed_plan


@pytest.mark.parametrize('planner', ['greedy_error', 'rig_search'])
def test_a_plan_names_its_planner_and_says_how_much_better_others_may_be(
        plan, room_folder, capsys, planner):
    found = plan({}, '--planner', planner, '--evaluations', 120, '--seconds', 60)
    search = found['search']
    known = search['certificate']
    assert found['broken'] == [] and search['planner'] == planner
    assert search['searches'][0] == search['loss'] == found['scores']['loss'] == known['found']
    assert known['candidates'] >= 1000 and known['rows'] == 64 and known['bound'] > 0.0
    assert known['gap'] == pytest.approx(max(1.0 - known['bound'] / known['found'], 0.0))
    assert f'{known["candidates"]:,}' in known['sentence']
    # A bound is no proof that nothing is better.
    assert ' 0.0 %' not in known['sentence'] and '15 degrees' in known['sentence']
    written = room_folder / 'out' / 'plan'
    placement = yaml.safe_load((written / 'placement.yaml').read_text())
    assert placement['created']['planner'] == planner
    for page in ('installer.md', 'report.html'):
        text = (written / page).read_text()
        assert known['sentence'] in text and planner in text
    scored = printed(capsys, 'score', 'room.ply', written / 'placement.yaml', '--out', 'scored')
    assert scored['scores'] == found['scores'] and scored['notes'] == []
    assert planner in (room_folder / 'scored' / 'report.html').read_text()


def test_a_bound_that_counts_a_goal_in_part_says_so(plan):
    known = plan({'seen_by': 2, 'calibratable': {}}, '--evaluations', 100)['search']['certificate']
    assert 0.0 < known['gap'] < 1.0
    assert 'even with seen_by and calibratable relaxed' in known['sentence']
    # Without a positive bound, the sentence is about all that the placement misses.
    proof = Certificate(100, 0.3, False, 15.0, 64, 0.004, 0.0, True, None, 1.0)
    assert 'all that it still misses, 0.4 %' in certificate_data(proof)['sentence']
    # Of a grid that had no time to become finer, the sentence says so.
    assert ['not final' in certificate_data(one)['sentence']
            for one in (proof, replace(proof, final=False))] == [False, True]
