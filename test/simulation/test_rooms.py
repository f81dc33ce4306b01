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

"""Rooms of a floor: each has viewpoints and a row of the table, whatever is found in it."""

from io import StringIO
from itertools import combinations

from benchmarks.floors import along_corridor, scan_of
import numpy as np
import ocp_ros
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import assess
from ocp_ros.report.facts import count_sentence, facts_of, ROOM_COLUMNS
from ocp_ros.report.terminal import print_table
from ocp_ros.report.viewer import tables_of
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms import scene_source
from ocp_ros.scenes.scene import turned
from ocp_ros.search.candidate_pool import CandidatePool
from ocp_ros.search.floor_counts import FloorCounts, views_of
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.room_gains import RoomGoal, shares_of, VIEWPOINT_TOLERANCE
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.viewpoints import viewpoints_of
from ocp_ros.studio.model import Studio
from ocp_ros.studio.texts import summary
from ocp_ros.util.settings import ConfigurationError
import pytest
from rich.console import Console

#: A corridor, rooms of 27, 20 and 10 m2, and a closet of 2 m2. The last door is closed.
FLOOR = along_corridor([[6.0, 1.4], [4.5, 2.2]], furniture=0)
CLOSED = FLOOR._replace(doors=FLOOR.doors[:-1])


@pytest.fixture(scope='module')
def floor():
    """Return a scan of a floor."""
    return scan_of(CLOSED, 40_000, all_rooms=True)


@pytest.mark.parametrize('degrees', [0.0, 33.0])
def test_each_room_and_closet_is_found_and_has_viewpoints_by_its_air(floor, degrees):
    scene = turned(floor, degrees)
    back = turned(scene, -degrees).points.astype(float)
    is_inside = np.abs(back[:, 2] - 1.3) < 1.2
    own, found = CLOSED.room_at(back[is_inside]), scene.rooms.at(scene.points[is_inside])
    assert scene.rooms.count == len(CLOSED.rooms)
    # Numbers go by area; points of walls may count for the room on the other side.
    areas = (CLOSED.rooms[:, 1] - CLOSED.rooms[:, 0]).prod(axis=1)
    number_of = np.argsort(np.argsort(-areas)) + 1
    assert np.mean(number_of[own] == found) > 0.93
    np.testing.assert_allclose(scene.rooms.areas, np.sort(areas)[::-1], rtol=0.35)
    assert np.array_equal(scene.rooms.at(scene.rooms.middles), np.arange(len(areas)) + 1)
    for kind, least in (('air', 16), ('validation', 64)):
        counts = np.bincount(scene.rooms.at(viewpoints_of(scene, kind)), minlength=6)[1:]
        assert counts.min() >= 1 and least <= counts.sum() <= least + len(areas)
        assert (np.abs(counts - least * areas[np.argsort(-areas)] / areas.sum()) < 1.8).all()


def test_a_scan_of_one_room_has_no_rooms_and_one_with_many_is_kept_in_the_cache(
        floor, tmp_path, monkeypatch):
    room = CLOSED._replace(rooms=FLOOR.rooms[1:2], doors=FLOOR.doors[:0])
    assert scan_of(room, 20_000, all_rooms=True).rooms is None
    monkeypatch.setattr(scene_source, 'MIN_CACHED_BYTES', 0)
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    np.save(tmp_path / 'floor.npy', floor.points)
    first, again = (scene_source.load_cached(tmp_path / 'floor.npy', all_rooms=True).rooms
                    for _ in range(2))
    assert again.count == len(CLOSED.rooms) and np.array_equal(first.numbers, again.numbers)
    assert np.array_equal(first.corner, again.corner) and first.edge == again.edge


def test_a_room_that_is_not_seen_is_red_and_named_everywhere(floor):
    poses = np.zeros((2, 6))
    # Both cameras are in the largest room, and look away from its door.
    poses[:, :3] = [*CLOSED.rooms[1].mean(axis=0) + [0.0, 0.5], 1.9]
    poses[:, 3] = np.deg2rad([90.0, 120.0])
    rig = rig_of(2, 'd455')
    room = {'file': 'floor.npy', 'sha256': scene_source.sha256_of(floor)}
    judged = assess(floor, placement_of(rig, poses, engine=EngineConfig('fast', 32, 0.5)), room,
                    'ocp score')
    rows = judged.found['scores']['rooms']
    assert [row['cameras'] for row in rows] == [2, 0, 0, 0, 0]
    assert 0.1 < rows[0]['seen'] < 0.9 and max(row['seen'] for row in rows[1:]) < 0.02
    facts = facts_of(judged.found)
    assert any('4 of 5 rooms' in doubt and 'room 5' in doubt for doubt in facts.doubts)
    out = StringIO()
    print_table(Console(file=out, force_terminal=True, width=80), None, ROOM_COLUMNS,
                *zip(*facts.rooms))
    assert out.getvalue().count('\x1b[31m') >= 4
    page = ''.join(tables_of(judged))
    assert page.count('<tr class=bad>') == 4 and 'room 5' in page
    studio = Studio(floor, room, rig, poses)
    assert summary(studio.evaluation()).count('<tr style=') == 4


@pytest.fixture(scope='module')
def small_floor():
    """Return a scan of a corridor and three rooms."""
    return scan_of(along_corridor([[3.4] * 2, [3.4]]), 20_000, all_rooms=True, max_points=4000)


@pytest.mark.parametrize('by', ['error', 'seen', 'coverage'])
def test_greedy_numbers_for_each_room_are_between_the_bound_and_the_fewest(small_floor, by):
    target, rig = 0.8, rig_of(12, 'omnidirectional')
    problem = Problem.of(small_floor, rig, SimulationConfig(engine=EngineConfig('fast', 32, 0.5)))
    pool = CandidatePool(problem, 14)
    views = pool.candidates_of(rig.cameras[0].model).views
    goal = RoomGoal(by, np.full(4, target), pool.union_views(rig))
    objective = problem.with_rig(rig, problem.simulator.config, goal).objective
    counts = FloorCounts(objective, pool, [1.0])
    placed = counts.greedy(12, np.inf, lambda _: None, lambda: False)
    own, possible = (counts._objective.room_gains(some, by) for some in (views_of(placed), views))
    assert (shares_of(own, possible) >= target).all() and counts.without_one(placed)
    # All sets of candidates, the smallest first.
    fewest = next(count for count in range(1, 15) for some in combinations(views, count)
                  if (counts._objective.room_gains(some, by)
                      >= (target - VIEWPOINT_TOLERANCE) * possible).all())
    least = counts.least_price(placed, target)
    assert 1.0 < least <= fewest <= len(placed) <= fewest + 2
    # The parts of the rooms sum up to all, and only one room needs its share.
    if by == 'error':
        error = objective.simulator.depth_error
        assert objective.room_gains(views, by).sum() == pytest.approx(
            error.worst - objective.depth_error(views))
    assert objective.searched.loss([]) > objective.loss([]) + 10.0
    # A judge who doubts one room gets more cameras there.
    doubted = counts.greedy(12, np.inf, lambda some: np.array([0.0, 0.0, 0.0, 0.1]) if (
        len(some) <= len(placed)) else None, lambda: False)
    assert len(doubted) > len(placed) and counts.goal.targets[3] > target


def test_cameras_are_counted_so_that_each_room_has_its_share(small_floor):
    plan = ocp_ros.plan(small_floor, cameras='auto', by='coverage', target=0.6, evaluations=20,
                        mount='plane')
    count, rooms = plan.found['count'], plan.found['scores']['rooms']
    assert plan.reached and count['cameras'] == len(plan.poses)
    assert sum(room['cameras'] for room in rooms) == count['cameras']
    assert all(room['reached'] and room['share'] >= 0.59 for room in count['rooms'])
    curve = plan.found['curve']
    assert [row['cameras'] for row in curve] == [count['fewer'], count['fewer'] + 1]
    text = count_sentence(count)
    assert f'in each of 4 rooms; {count["fewer"]} did not' in text
    assert count['at_least'] is None or f'at least {count["at_least"]} candidate' in text
    page = ''.join(tables_of(plan.assessment))
    assert text in page and page.count('<th>of reachable space') == 1
    assert text in ' '.join(str(plan).split())
    few = ocp_ros.plan(small_floor, cameras='auto', most=1, by='seen', target=1.0, evaluations=10)
    assert not few.reached and len(few.poses) == 4
    assert 'but in' in count_sentence(few.found['count'])


def test_groups_of_cameras_are_mixed_for_each_room_by_price(small_floor):
    rig = {'cameras': [{'sensor': 'realsense_d455'}, {'sensor': 'omnidirectional', 'price': 300}],
           'mount': {'on': 'plane', 'height': 1.9}}
    plan = ocp_ros.plan(small_floor, rig, cameras='auto', by='coverage', target=0.5,
                        evaluations=10)
    count, bill = plan.found['count'], plan.found['bill']
    # What sees all around is cheaper here, and no mix of D455 needs fewer or costs less.
    assert plan.reached and count['mix'] == f'{len(plan.poses)} x omnidirectional'
    assert (count['at_least'] or 0.0) <= bill['total'] == 300.0 * len(plan.poses)
    assert 'omnidirectional reach 50.0 % of the space' in count_sentence(count)
    with pytest.raises(ConfigurationError, match='--budget: found 200; expected at least 300'):
        ocp_ros.plan(small_floor, rig, cameras='auto', budget=200, evaluations=10)
