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

"""Cameras that share enough of what they see to be calibrated to each other."""

from itertools import combinations

from conftest import box_room
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from ocp_ros.api import plan, score
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import no_bits, pack
from ocp_ros.report.findings import evaluate_placement
from ocp_ros.rig.rig_file import Calibratable, rig_of
from ocp_ros.search.budget import Budget
from ocp_ros.search.rig_plan import RigPlanner
from ocp_ros.simulation.covisibility import air_share, covisibility
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import View
from ocp_ros.util.settings import ConfigurationError
import pytest

#: Points along a line two metres in front of cameras that stand on another line.
POINTS = np.column_stack([np.linspace(0.0, 9.9, 100), np.full(100, 2.0), np.zeros(100)])
FAST = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16))


def view(x: float, first: int, last: int) -> View:
    """Return what a camera at x sees: the points from one to before another."""
    seen = np.zeros(100, dtype=bool)
    seen[first:last] = True
    return View(pack(seen), pack(np.zeros(1, dtype=bool)), np.array([x, 0.0, 0.0]))


def test_what_is_seen_under_a_wide_angle_is_not_shared():
    """Two cameras opposite each other see one strip between them, from two sides."""
    views = [view(0.0, 0, 100), view(9.9, 0, 100)]
    wide, narrow = (covisibility(POINTS, views, Calibratable(0.2, np.deg2rad(angle)))
                    for angle in (180.0, 60.0))
    assert wide.shares[0, 1] == 1.0 and narrow.shares[0, 1] == 0.0
    lines = POINTS[:, None] - np.array([views[0].position, views[1].position])
    lines /= np.linalg.norm(lines, axis=2, keepdims=True)
    some = covisibility(POINTS, views, Calibratable(0.2, np.deg2rad(120.0)))
    expected = np.mean((lines[:, 0] * lines[:, 1]).sum(axis=1) >= np.cos(np.deg2rad(120.0)))
    assert 0.0 < expected < 1.0 and some.shares[0, 1] == pytest.approx(expected)


def test_a_chain_connects_and_a_gap_says_how_much_is_missing():
    chain = [view(1.0, 0, 40), view(3.0, 30, 70), view(5.0, 60, 100)]
    asked = Calibratable(0.25, np.pi)
    found = covisibility(POINTS, chain, asked)
    assert found.missing == 0.0 and not found.linked(0, 2) and len(found.groups) == 1
    apart = covisibility(POINTS, [*chain[:2], view(5.0, 65, 100)], asked)
    assert apart.missing == pytest.approx(0.5 * (1.0 - 5 / 35 / 0.25))
    assert apart.groups == [[0, 1], [2]]
    # The share is that of the camera that sees fewer points.
    found = covisibility(POINTS, [view(2.0, 0, 50), view(3.0, 40, 60)], asked)
    assert found.shares[0, 1] == pytest.approx(10 / 20) and found.linked(0, 1)
    # Two cameras in place are linked, and a single camera needs no other.
    views = [view(1.0, 0, 40), view(2.0, 20, 40), view(5.0, 60, 100)]
    assert covisibility(POINTS, views, asked).groups == [[0, 1], [2]]
    assert covisibility(POINTS, views, asked, fixed_count=2).missing == 0.0
    assert covisibility(POINTS, views[:1], asked).missing == 0.0


def test_a_plan_connects_its_cameras_and_says_so(room):
    """Three narrow cameras in a room: without the key they spread, with it they are linked."""
    free, linked = (rig_of(3, 'd455', pitch=[20, 40], **more)
                    for more in ({}, {'calibratable': {'overlap': 0.5, 'angle': 45}}))

    def planned(rig):
        planner = RigPlanner(room, rig, FAST.engine, Budget(evaluations=400))
        found = planner.plan(rig)
        return planner, found, evaluate_placement(Problem.of(room, linked, FAST),
                                                  found.answer.poses)

    (_, spread, spread_findings), (planner, near, findings) = planned(free), planned(linked)
    assert len(spread_findings['scores']['calibratable']['groups']) > 1
    assert [line.partition(':')[0] for line in spread_findings['broken']] == ['calibratable']
    assert findings['broken'] == [] and near.evaluation.connected
    assert spread.evaluation.depth_error <= near.evaluation.depth_error + 1e-3
    links = findings['scores']['calibratable']
    assert len(links['groups']) == 1 and sum(pair['linked'] for pair in links['pairs']) >= 2
    assert all(pair['overlap'] >= 0.5 for pair in links['pairs'] if pair['linked'])
    # Nothing is proved of plans that have to be calibratable.
    certified = planner.certified(near, Budget(1.0))
    assert certified.certificate is None and 'calibratable' in certified.uncertain


def test_the_loss_counts_what_is_missing(room):
    rig = rig_of(2, 'd455', calibratable={'overlap': 0.2})
    problem, free = (Problem.of(room, asked, FAST) for asked in (rig, rig_of(2, 'd455')))
    poses = problem.region.candidates(rig.cameras[0].model, 400)
    rng, missing = np.random.default_rng(0), []
    for _ in range(20):
        views = problem.objective.look(poses[rng.choice(len(poses), 2, replace=False)])
        lacking = problem.objective.covisibility(views).missing
        judged = problem.objective.judge(views)
        assert judged.loss == pytest.approx(free.objective.judge(views).loss + 10.0 * lacking)
        assert problem.objective.loss(views) == pytest.approx(judged.loss)
        assert judged.connected == (lacking == 0.0)
        missing.append(lacking)
    assert min(missing) < 1.0 and max(missing) > 0.0


@pytest.mark.parametrize(('more', 'words'), [
    ({'calibratable': {'overlap': 0}}, 'overlap'), ({'calibratable': {'overlap': 1.5}}, 'overlap'),
    ({'calibratable': {'angle': 200}}, 'angle'), ({'calibratable': {'share': 0.3}}, 'share'),
    ({'calibratable': True}, 'calibratable'), ({'air': {'angle': 150}}, 'air.angle'),
    ({'air': {'seen_by': 3}}, r'regions\[0\].air.seen_by'),
    ({'air': {}, 'box': [[1, 1, 1], [1.01, 1.01, 1.01]]}, 'no air')])
def test_what_cannot_be_calibrated_or_watched_is_refused(more, words):
    rig = {'cameras': [{'sensor': 'kinect_v2', 'count': 2}]}
    if 'air' in more:
        more = {'regions': [{'name': 'stage', 'box': [[1, 1, 1], [2, 2, 2]], **more}]}
    with pytest.raises(ConfigurationError, match=words):
        plan(box_room(), {**rig, **more}, evaluations=10)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 9999), cameras=st.integers(1, 5), seen_by=st.integers(1, 4),
       angle=st.floats(0.0, 100.0))
def test_air_counts_where_enough_cameras_look_from_enough_directions(
        seed, cameras, seen_by, angle):
    rng = np.random.default_rng(seed)
    cells, positions = rng.uniform(0, 4, (100, 3)), rng.uniform(0, 4, (cameras, 3))
    seen = rng.random((cameras, 100)) < 0.7
    numbers = np.flatnonzero(rng.random(100) < 0.5)
    views = [View(no_bits(0), pack(some), position) for some, position in zip(seen, positions)]
    ways = cells[None] - positions[:, None]
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    between = np.rad2deg(np.arccos(np.clip(np.einsum('ank,bnk->abn', ways, ways), -1, 1)))
    found = [any(all(between[one, other, n] >= angle for one, other in combinations(some, 2))
                 for some in combinations(np.flatnonzero(seen[:, n]), seen_by)) for n in numbers]
    assert air_share(cells, numbers, views, seen_by, np.deg2rad(angle)) == np.mean(found)
    # Cameras that are everywhere at once see from all directions.
    everywhere = [view._replace(position=None) for view in views]
    enough = (seen[:, numbers].sum(axis=0) >= seen_by).mean()
    assert air_share(cells, numbers, everywhere, seen_by, np.deg2rad(angle)) == enough


def test_a_volume_that_two_cameras_watch_from_two_sides_is_planned_for():
    region = {'name': 'stage', 'box': [[1.5, 1.0, 0.3], [4.0, 3.0, 1.8]], 'must_see': 0.9,
              'air': {'seen_by': 2, 'angle': 45}}
    rig = rig_of(3, 'd455', mount={'on': 'walls', 'height': [1.6, 2.4]}, regions=[region])
    found = plan(box_room(), rig, evaluations=500)
    assert found.broken == () and found.gap is None
    (part,) = found.found['scores']['regions']
    assert part['of'] == 'air' and part['seen'] >= 0.9
    # Side by side they do not do.
    beside = found.poses[[0, 0, 0]]
    beside[:, 0] += 0.01 * np.arange(3)
    assert score(box_room(), beside, rig).found['scores']['regions'][0]['seen'] == 0.0
