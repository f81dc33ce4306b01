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

"""ocp plan --planner: whoever proposes a placement, every constraint of the rig holds in it."""

from dataclasses import replace
from functools import cache
import itertools

from conftest import for_any, made_room, MOUNTS
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.placement_file import load_placement, placement_of, save_placement
from ocp_ros.rig.rig_file import load_rig, MOVING, rig_of
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import CandidatePool
from ocp_ros.search.plan import plan
from ocp_ros.search.planner import Scorer
from ocp_ros.search.pose_decoder import Decoder
from ocp_ros.search.registry import OBSERVED, planner_names, PLANNERS, SCORES
from ocp_ros.search.rig_plan import RigPlanner
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
import pytest

pytestmark = pytest.mark.usefixtures('quick_lookahead')
FAST = EngineConfig(preset='fast', error_rows=16)
EVALUATIONS, TURNS = 30, 3
#: Room 8 is about 8 x 8 m; the zone is where its cameras begin.
RIG = """\
cameras:
  - {sensor: realsense_d455, count: 2}
  - {sensor: omnidirectional, max_range: 3.0, name: ball}
fixed:
  - {sensor: realsense_d455, position: [6.0, 6.0, 2.0], yaw: 225, pitch: 25, name: door}
mount: {on: plane, height: 1.9}
pitch: [10, 40]
keep_clear: 0.35
spacing: 1.2
keep_out:
  - {polygon: [[2.5, 2.5], [4.5, 2.5], [4.5, 4.5], [2.5, 4.5]]}
regions:
  - {name: table, box: [[2, 2, 0], [5, 5, 1.5]], weight: 2.0}
"""


@pytest.fixture(scope='module')
def planned(tmp_path_factory):
    """Return a function that plans by name, each planner and seed once."""
    path = tmp_path_factory.mktemp('planners') / 'rig.yaml'
    path.write_text(RIG)
    scene, rig = made_room(8, 2000), load_rig(path)

    @cache
    def plan(name, seed=0, again=0):
        online = PLANNERS[name].input_kind == OBSERVED
        budget = Budget(evaluations=TURNS if online else EVALUATIONS)
        return RigPlanner(scene, rig, FAST, budget, seed, planner=name).plan(rig)

    plan.problem = Problem.of(scene, rig, SimulationConfig(engine=FAST))
    return plan


@pytest.fixture
def few_candidates(monkeypatch):
    """Lay out few candidates where the clock is all that limits a search."""
    monkeypatch.setattr('ocp_ros.search.candidate_pool.CANDIDATES', 200)


def decoder_of(scene, rig, candidates=120):
    """Return a decoder with few candidates."""
    problem = Problem.of(scene, rig, SimulationConfig(engine=FAST))
    return Decoder(problem, CandidatePool(problem, candidates, 600))


@pytest.mark.parametrize('name', planner_names())
def test_every_constraint_holds_and_a_file_scores_the_same(planned, tmp_path, name):
    plan, problem = planned(name), planned.problem
    poses = plan.answer.poses
    assert poses.shape == (3, 6) and problem.region.broken(poses) == []
    x, y, z = poses[:, :3].T
    assert not ((x > 2.5) & (x < 4.5) & (y > 2.5) & (y < 4.5)).any() and np.ptp(z) < 0.02
    places = np.vstack([poses[:, :3], [6.0, 6.0, 2.0]])
    away = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert away[np.triu_indices(4, 1)].min() >= 1.2 - 0.0011
    assert (np.rad2deg(poses[:2, 4]) >= 9.4).all() and (np.rad2deg(poses[:2, 4]) <= 40.6).all()
    save_placement(tmp_path / 'a.yaml', placement_of(problem.rig, poses, engine=FAST))
    again = problem.objective.evaluate(load_placement(tmp_path / 'a.yaml').poses)
    for key in ('loss', 'depth_error', 'space_coverage'):
        assert getattr(again, key) == pytest.approx(getattr(plan.evaluation, key), abs=1e-6)
    assert plan.planner == name and plan.evaluation.loss == plan.answer.loss


@pytest.mark.system
@pytest.mark.parametrize('name', planner_names())
def test_the_same_seed_gives_the_same_answer_within_the_budget(planned, name):
    one, again = planned(name), planned(name, again=1)
    assert np.array_equal(one.answer.poses, again.answer.poses)
    assert one.answer.evaluations == again.answer.evaluations
    if PLANNERS[name].input_kind == SCORES:
        assert 1 <= one.answer.evaluations <= EVALUATIONS
    if PLANNERS[name].input_kind == OBSERVED:
        assert one.answer.evaluations == TURNS


@pytest.mark.parametrize('name', ['cma_es', 'lookahead'])
def test_another_seed_gives_another_answer(planned, name):
    assert not np.array_equal(planned(name).answer.poses, planned(name, seed=1).answer.poses)


@for_any(10, mount=st.sampled_from(sorted(MOUNTS)), spacing=st.floats(0.0, 3.0),
         side=st.floats(0.5, 5.0), in_place=st.booleans(),
         cameras=st.lists(st.sampled_from(['realsense_d455', 'omnidirectional', 'vlp16']),
                          min_size=1, max_size=3),
         places=st.lists(st.tuples(st.floats(-3.0, 9.0), st.floats(-3.0, 7.0)), max_size=3))
def test_whatever_is_proposed_is_hung_where_it_may(
        furnished, mount, spacing, side, in_place, cameras, places):
    fixed = [{'sensor': 'kinect_v2', 'position': [1.0, 1.0, 2.0], 'name': 'door'}] * in_place
    zone = {'polygon': [[side, 0.0], [side + 0.8, 0.0], [side + 0.8, 4.0], [side, 4.0]]}
    rig = rig_of(1, mount=MOUNTS[mount], pitch=[10, 40], spacing=spacing, keep_out=[zone],
                 fixed=fixed)
    rig = replace(rig, cameras=tuple(rig_of(1, name).cameras[0]._replace(name=f'{name}_{k}')
                                     for k, name in enumerate(cameras)))
    decode = decoder_of(furnished, rig, 60)
    places = np.array(places).reshape(-1, 2)[:len(cameras)]
    sites = decode(places)
    full = decode.completed_sites(sites)
    assert len(sites) == min(len(places), len(full))
    judge = FeasibleRegion(furnished, rig)
    for hung in (sites, full):
        assert judge.broken(np.array([site.pose for site in hung]).reshape(-1, 6)) == []
    for camera, site in enumerate(full):
        assert np.array_equal(decode.objective.simulator.look(site.pose, camera).seen,
                              site.view.seen)


def test_a_place_that_is_allowed_is_kept_and_another_is_the_nearest(furnished):
    rig = rig_of(2, 'omnidirectional', keep_out=[{'box': [[0, 0, 0], [2, 4, 3]]}], spacing=0.5)
    decode = decoder_of(furnished, rig)
    free, inside = np.array([2.7132, 3.1457]), np.array([1.0, 2.0])
    first, second = decode(np.array([free, inside]))
    assert np.allclose(first.pose[:3], [*free, 1.9], atol=1e-4)
    poses = decode.pool.candidates_of(rig.models[0]).poses
    away = np.linalg.norm(poses[:, :2] - inside, axis=1)
    assert np.array_equal(second.pose, poses[np.argmin(away)])
    # Where another camera hangs nobody else may.
    first, second = decode(np.array([free, free]))
    assert np.linalg.norm(first.pose[:3] - second.pose[:3]) >= 0.5


def test_cameras_with_a_view_are_turned_to_where_they_help(furnished):
    rig = rig_of(1, 'd455', pitch=[10, 40])
    decode = decoder_of(furnished, rig, 600)
    (site,) = decode(np.array([[0.7, 0.7]]))
    assert np.allclose(site.pose[:2], 0.7, atol=1e-4)
    turned = np.tile(site.pose, (8, 1, 1))
    turned[:, 0, 3] = np.linspace(-np.pi, np.pi, 8, endpoint=False)
    losses = [decode.objective.evaluate(poses).loss for poses in turned]
    assert decode.objective.evaluate(site.pose[None]).loss < np.median(losses)


def test_a_height_that_is_asked_for_and_allowed_is_kept(furnished):
    rig = rig_of(1, 'd455', mount=MOUNTS['free'], pitch=[10, 40])
    decode = decoder_of(furnished, rig)
    heading = np.array([[0.5, 0.3, 0.0]])
    for height in (1.3, 2.1):
        (site,) = decode(np.array([[1.0, 1.5, height]]), heading)
        assert np.allclose(site.pose, [1.0, 1.5, height, *heading[0]], atol=1e-3)
    # The mount goes up to 2.2 m.
    (site,) = decode(np.array([[1.0, 1.5, 2.6]]), heading)
    assert site.pose[2] <= 2.2 + 1e-3


def test_who_leaves_cameras_out_gets_them_hung_where_they_help(furnished):
    rig = rig_of(3, 'omnidirectional')
    decode = decoder_of(furnished, rig)
    assert decode(np.empty((0, 2))) == ()
    views = [site.view for site in decode.completed_sites(decode(np.array([[1.0, 1.0]])))]
    losses = [decode.objective.loss(views[:count]) for count in (1, 2, 3)]
    assert losses == sorted(losses, reverse=True) and losses[2] < losses[0]


@pytest.mark.parametrize('name', ['rig_search', 'cma_es'])
def test_cameras_that_hardly_find_room_hang_packed(furnished, name):
    # Four of them fit only near the corners of what the walls leave.
    rig = rig_of(4, mount=MOUNTS['plane'], spacing=2.6)
    planner = RigPlanner(furnished, rig, FAST, Budget(evaluations=20), planner=name)
    assert len(planner.pool.packed_sites(rig)) == 4
    poses = planner.plan(rig).answer.poses
    assert len(poses) == 4 and FeasibleRegion(furnished, rig).broken(poses) == []


def test_cameras_that_see_alike_share_what_was_seen_from_a_place(furnished, monkeypatch):
    rig = rig_of(2, 'omnidirectional', spacing=0.0)
    rig = replace(rig, cameras=(*rig.cameras, *rig_of(1, 'vlp16').cameras))
    decode, looks = decoder_of(furnished, rig), []
    simulator = decode.objective.simulator
    look = simulator.look
    monkeypatch.setattr(simulator, 'look', lambda pose, camera: looks.append(camera) or look(
        pose, camera))
    places = np.array([[1.0, 1.5], [2.7, 3.1], [5.0, 2.0]])
    losses = [decode.score(places[order])[0] for order in ([0, 1, 2], [1, 0, 2])]
    assert losses[0] == losses[1] and looks == [0, 0, 2]


def test_planners_are_told_the_loss_and_the_coverage(furnished):
    rig = rig_of(2, 'd455', regions=[{'name': 'corner', 'box': [[0, 0, -0.1], [2, 2, 1]]}])
    decode = decoder_of(furnished, rig)
    placements = [np.array([[1.0, 1.0], [5.0, 3.0]]), np.array([[1.0, 1.0]]), np.empty((0, 2))]
    scores = Scorer(decode.score, Budget(evaluations=3))(placements)
    worth = decode.objective.evaluate(np.array([site.pose for site in decode(placements[0])]))
    assert scores.error[0] == worth.loss
    assert scores.error[0] < scores.error[1] < scores.error[2] == 2.0
    assert scores.space_coverage[0] == worth.space_coverage


@pytest.mark.parametrize('name', ['rig_search', 'greedy_error', 'lookahead'])
def test_who_has_had_enough_gets_the_best_so_far(furnished, few_candidates, name):
    rig, calls = rig_of(2, 'omnidirectional'), []
    budget = Budget(seconds=3600.0)

    def progress(share, loss):
        calls.append((share, loss))
        # Planners without a scan report no loss.
        if len(calls) >= 3 and (np.isfinite(loss) or PLANNERS[name].input_kind == OBSERVED):
            budget.stop()

    plan = RigPlanner(furnished, rig, FAST, budget, progress=progress, planner=name).plan(rig)
    assert budget.stopped
    assert FeasibleRegion(furnished, rig).broken(plan.answer.poses) == []
    if PLANNERS[name].input_kind == SCORES:
        assert plan.answer.evaluations == 3
        # What it had before all cameras hung is completed.
        assert plan.answer.loss <= calls[-1][1]


def test_seconds_end_a_search_that_counts_nothing(furnished, few_candidates):
    ticks, rig = itertools.count(), rig_of(2, 'omnidirectional')
    budget = Budget(seconds=20.0, clock=lambda: 0.05 * next(ticks))
    plan = RigPlanner(furnished, rig, FAST, budget, planner='random').plan(rig)
    assert 20.0 <= budget.elapsed < 30.0 and plan.answer.evaluations > 5


def test_the_time_of_a_search_begins_when_the_kernels_are_loaded(furnished, few_candidates,
                                                                 monkeypatch):
    now, rig = [0.0], rig_of(2, 'omnidirectional')

    def load(online):
        now[0] += 3600.0

    monkeypatch.setattr('ocp_ros.search.rig_plan.prepare_search', load)
    budget = Budget(seconds=60.0, evaluations=5, clock=lambda: now[0])
    plan = RigPlanner(furnished, rig, FAST, budget, planner='random').plan(rig)
    assert plan.answer.evaluations == 5 and plan.seconds == 0.0


def test_the_clock_cuts_no_episode_short(furnished, few_candidates):
    # Reading kernels and laying out candidates may have taken all the time.
    hours, rig = itertools.count(), rig_of(2, 'omnidirectional')
    budget = Budget(seconds=60.0, clock=lambda: 3600.0 * next(hours))
    plan = RigPlanner(furnished, rig, FAST, budget, planner='lookahead').plan(rig)
    assert plan.answer.evaluations == MOVING['turns']


@pytest.mark.parametrize('more, turns', [
    ({}, MOVING['turns']), ({'motion': {'turns': 4, 'max_step': 0.2}}, 4),
    ({'mount': {'on': 'plane', 'height': 1.9, 'footprint': 0}}, 30)])
def test_on_tripods_an_online_planner_has_the_limits_of_live_cameras_or_of_the_rig(more, turns):
    rig = rig_of(2, 'd455', **{'mount': {'on': 'plane', 'height': 1.9}, **more})
    problem = Problem.of(made_room(8, 2000), rig, SimulationConfig(engine=FAST))
    result = plan(problem, Budget(evaluations=50), 'lookahead')
    assert result.evaluations == turns
    few = replace(problem.simulator.config, episode=EpisodeConfig(turns=TURNS))
    given = Problem.of(made_room(8, 2000), rig, few)
    assert plan(given, Budget(evaluations=50), 'lookahead').evaluations == TURNS
