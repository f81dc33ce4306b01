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

"""Cameras on a plane keep a distance from every surface, whoever plans and whatever was seen."""

from dataclasses import replace

from conftest import box_room, box_sides, panel
from hypothesis import given, settings, strategies
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.plane_cells import close_cells
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import Online, settings_of
from ocp_ros.online.rig_state import clearance_of, Limits, RigState
from ocp_ros.online.rollout import play
from ocp_ros.online.step import OnlineStep
from ocp_ros.rig.free_plane import (
    CELL_M,
    CLEARANCE,
    FINE_CELL_M,
    Floor,
    floor_of,
    FreePlane,
    SLACK_M,
)
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.rooms.splits import VALIDATION
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.planner import Scores
from ocp_ros.search.registry import planner_names, PLANNERS, SCORES
from ocp_ros.search.solve import solve
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
import pytest
from scipy.spatial import cKDTree

HEIGHT, MARGIN = 1.9, 0.1
#: Metres: bottom and top of panels.
HIGH = 0.0, 2.2
#: Metres: who keeps a clearance may be off by this where single precision rounds.
ROUNDING = 1e-6


def with_things(*things):
    """Return the points (N, 3) float32 of a box of 6 x 4 x 2.8 m with things in it."""
    return np.concatenate([box_room().points, *things]).astype(np.float32)


def distances(points, flat, height=HEIGHT):
    """Return how far positions (M, 2) at a height are from the nearest point, metres: (M,)."""
    flat = np.reshape(flat, (-1, 2))
    return cKDTree(points).query(np.column_stack([flat, np.full(len(flat), height)]))[0]


@pytest.fixture(scope='module')
def parted():
    """Return points of a room with a panel as high as cameras that has two ways past it."""
    return with_things(panel(3.0, (1.0, 3.0), HIGH))


@pytest.fixture(scope='module')
def validation():
    """Return the points of a generated room with a panel in it."""
    scene = generate_room(VALIDATION[0], 4000)
    low, high = scene.bounds
    middle = 0.5 * (low + high)
    across = panel(middle[0], (middle[1] - 1.5, middle[1] + 1.5), HIGH)
    return np.concatenate([scene.points, across]).astype(np.float32)


@strategies.composite
def clouds(draw):
    """Draw a room of any size with boxes, panels and stray points in it, or a part of one."""
    rng = np.random.default_rng(draw(strategies.integers(0, 2 ** 31)))
    size = np.array([*rng.uniform(0.6, 8.0, 2), rng.uniform(2.0, 4.0)])
    parts = [box_sides(size, size / 2.0, 0.2)]
    for _ in range(draw(strategies.integers(0, 5))):
        box = rng.uniform([0.02, 0.02, 0.5], [1.5, 1.5, 2.5])
        parts.append(box_sides(box, np.append(rng.uniform(0.0, size[:2]), box[2] / 2.0), 0.1))
    parts.append(rng.uniform(0.0, size, (draw(strategies.integers(0, 40)), 3)))
    points = np.concatenate(parts)
    if draw(strategies.booleans()):
        points = points[points[:, 2] > draw(strategies.floats(0.0, 1.9))]
    return (points + rng.uniform(-20.0, 20.0, 3) * [1.0, 1.0, 0.0]).astype(np.float32)


@settings(deadline=None, max_examples=40)
@given(clouds(), strategies.floats(0.01, 1.5), strategies.floats(0.0, 0.5),
       strategies.integers(0, 1000))
def test_every_place_of_a_plane_keeps_its_distance(points, clearance, margin, seed):
    plane, rng = FreePlane.of(points, HEIGHT, 3, margin, clearance), np.random.default_rng(seed)
    if not plane.clearance:
        # Nothing would be left open.
        old = FreePlane.of(points, HEIGHT, 3, margin, 0.0)
        np.testing.assert_array_equal(plane.low, old.low)
        assert plane.area == old.area
        grid = old.grid(400)
        near = distances(points, grid) < clearance + np.sqrt(2.0) * CELL_M + 2.0 * SLACK_M
        assert near.all() or plane.area > 100_000 * FINE_CELL_M ** 2
        return
    anywhere = rng.uniform(plane.low - 1.0, plane.high + 1.0, (40, 2))
    drawn = plane.random(rng, 20)
    moved = plane.moved(drawn, rng.normal(0.0, 0.7, (20, 2)), 0.5)
    assert np.linalg.norm(moved - drawn, axis=1).max() <= 0.5 + 1e-9
    inside = plane.inside(anywhere)
    places = np.concatenate([drawn, moved, plane.grid(60), inside,
                             plane.reflected(anywhere)])
    assert plane.contains(places).all()
    assert distances(points, places).min() >= clearance - ROUNDING
    np.testing.assert_array_equal(plane.inside(inside), inside)


@settings(deadline=None, max_examples=40)
@given(strategies.integers(0, 2 ** 31), strategies.floats(0.01, 0.8), strategies.floats(0.05, 0.4))
def test_exactly_the_cells_are_closed_that_a_ball_reaches(seed, clearance, edge):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.5, -0.5, 0.0], [2.5, 1.5, 3.0], (12, 3)).astype(np.float32)
    low, shape, heights = np.array([0.1, -0.2]), (9, 7), np.array([1.4, 1.6])
    cells = np.ones(shape, dtype=bool)
    close_cells(points, heights, clearance, low, edge, cells)
    for i, j in np.ndindex(shape):
        corner = low + edge * np.array([i, j])
        nearest = np.column_stack([np.clip(points[:, :2], corner, corner + edge),
                                   np.clip(points[:, 2], *heights)])
        away = np.linalg.norm(nearest - points, axis=1).min()
        assert abs(away - clearance) < 1e-6 or cells[i, j] == (away > clearance)


@settings(deadline=None, max_examples=40)
@given(strategies.integers(0, 2 ** 31), strategies.sampled_from([0.02, 0.1, 0.5]))
def test_a_place_moves_into_the_nearest_open_cell(seed, share):
    rng = np.random.default_rng(seed)
    cells = rng.random(rng.integers(1, 15, 2)) < share
    cells[tuple(rng.integers(0, cells.shape))] = True
    floor, places = Floor(np.array([-1.0, 2.0]), cells), rng.uniform(-2.0, 6.0, (5, 2))
    listed = np.argwhere(cells)
    for place, found in zip(places, floor.inside(places)):
        own = np.clip(np.floor((place - floor.low) / CELL_M), 0, np.array(cells.shape) - 1)
        x, y = min(listed.tolist(), key=lambda cell: (
            np.sum((np.array(cell) - own) ** 2), cell[1], cell[0]))
        corner = floor.low + CELL_M * np.array([x, y])
        np.testing.assert_allclose(found, np.clip(place, corner, corner + CELL_M), atol=2e-6)


@pytest.mark.parametrize('floor', [True, False])
def test_without_a_clearance_the_plane_is_what_it_was(parted, floor):
    points = parted if floor else parted[parted[:, 2] > 1.7]
    plane = FreePlane.of(points, HEIGHT, 3, MARGIN, 0.0)
    np.testing.assert_allclose(plane.low, [MARGIN, MARGIN], atol=1e-6)
    assert plane.clearance == 0.0 and plane.contains(np.array([3.0, 2.0]))
    assert (plane.floor is not None) == floor
    if floor:
        known = floor_of(points, HEIGHT)
        assert plane.floor.edge == CELL_M and np.array_equal(plane.floor.low, known.low)
        assert not (plane.floor.open & ~known.open).any()


def test_the_inside_of_a_cabinet_is_no_place():
    cabinet = box_sides(np.array([1.0, 1.0, 2.4]), np.array([4.0, 2.0, 1.2]))
    inside = np.array([4.0, 2.0])
    for clearance in (0.0, 0.15):
        plane = FreePlane.of(with_things(cabinet), HEIGHT, 3, MARGIN, clearance)
        assert plane.contains(inside) == (clearance == 0.0)
    # A room no larger than that is believed.
    alone = FreePlane.of(box_sides(np.array([1.0, 1.0, 2.4]), np.array([4.0, 2.0, 1.2])),
                         HEIGHT, 3, MARGIN, 0.15)
    assert alone.clearance == 0.15 and alone.contains(inside)


def test_cameras_of_different_heights_keep_it_at_each_of_them():
    shelf = np.column_stack([np.random.default_rng(0).uniform(2.5, 3.5, (400, 2)),
                             np.full(400, 1.2)])
    positions = np.array([[1.0, 1.0, 1.3], [1.0, 3.0, 1.9], [5.0, 3.0, 2.0]])
    points = with_things(shelf)
    plane = FreePlane.around(points, positions, MARGIN, 0.15)
    assert plane.height == 1.9 and not plane.contains(np.array([3.0, 3.0]))
    assert FreePlane.of(points, 1.9, 3, MARGIN, 0.15).contains(np.array([3.0, 3.0]))


def test_a_camera_leaves_where_it_must_not_be(parted):
    plane = FreePlane.of(parted, HEIGHT, 3, MARGIN, 0.15)
    # In the panel: out of it, the way that was asked for; who holds still is left there.
    inside = np.tile([3.0, 2.0], (3, 1))
    moved = plane.moved(inside, np.array([[0.5, 0.0], [-0.05, 0.0], [0.0, 0.0]]), 0.5)
    assert moved[0, 0] == pytest.approx(3.5, abs=1e-5) and 2.7 < moved[1, 0] < 2.85
    assert distances(parted, moved[:2]).min() >= 0.15 - ROUNDING
    np.testing.assert_array_equal(moved[2], inside[2])
    # Too far within a thick thing to get out at once: as it likes.
    panels = [panel(x, (0.5, 3.5), HIGH) for x in np.arange(2.0, 4.0, 0.1)]
    thick = FreePlane.of(with_things(*panels), HEIGHT, 3, MARGIN, 0.15)
    np.testing.assert_allclose(
        thick.moved(inside, np.tile([0.3, 0.0], (3, 1)), 0.5), inside + [0.3, 0.0])


@pytest.mark.parametrize('name', planner_names(SCORES))
def test_no_planner_puts_a_camera_at_a_surface_or_off_the_floor(validation, name):
    plane, asked = FreePlane.of(validation, HEIGHT, 3, MARGIN), []
    # Cameras are asked for where none may be: in the panel and beyond the walls.
    wanted = np.array([plane.low - 1.0, 0.5 * (plane.low + plane.high), plane.high + 1.0])

    def score(placements):
        asked.extend(placements)
        errors = np.array([np.linalg.norm(wanted[:, None] - placement[:, :2], axis=2).min(axis=1)
                           .sum() if len(placement) else 20.0 for placement in placements])
        return Scores(errors, -errors)

    solve(PLANNERS[name].make(plane, np.random.default_rng(0), 300), score, 300)
    places = np.concatenate(asked)
    assert plane.contains(places[:, :2]).all()
    assert cKDTree(validation).query(places)[0].min() >= CLEARANCE - ROUNDING


def test_lookahead_keeps_it_from_what_it_has_seen(validation):
    config = SimulationConfig(
        RigConfig(cameras=3), EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0),
        EpisodeConfig(turns=5))
    problem = PlaneProblem(Simulator(Scene(validation, 'validation'), config))
    episode, seen = Episode(problem, np.random.default_rng(0)), []
    online = Lookahead(*settings_of(config.episode, problem.rig, np.random.default_rng(1)))

    def record_views(turn):
        seen.append(episode.observed_cloud)
        return False

    outcome = play(online, episode, record_views)
    for cloud, placement in zip(seen, outcome.trajectory[1:]):
        assert cKDTree(cloud).query(placement)[0].min() >= CLEARANCE - ROUNDING
    assert np.linalg.norm(outcome.trajectory[-1] - outcome.trajectory[0], axis=1).max() > 0.5


class Stubborn(Online):
    """Wants to stand in the panel."""

    def move(self, cloud, positions, turn, turns):
        """Go straight there."""
        return self.towards(positions, np.tile([3.0, 2.0], (3, 1))) - positions[:, :2]


@pytest.mark.parametrize('clearance', [0.0, 0.15, 0.4])
def test_commands_keep_it_whatever_the_planner_wants(parted, clearance):
    step = OnlineStep(Stubborn(np.random.default_rng(0), 0.5, 4.0, MARGIN),
                      Limits(0.5, 0.5, MARGIN, clearance))
    placement = np.zeros((3, 6))
    placement[:, :3] = [[1.2, 1.0, HEIGHT], [4.6, 2.0, HEIGHT], [2.0, 3.2, HEIGHT]]
    for turn in range(8):
        placement = step(parted, RigState(placement, (CameraModel(),) * 3, 3), turn, 8).placement
        nearest = cKDTree(parted).query(placement[:, :3])[0]
        assert nearest.min() >= clearance - ROUNDING
    assert nearest.max() < clearance + 0.15


def test_starts_are_out_of_furniture():
    scene = Scene(with_things(box_sides(np.array([0.6, 0.6, 2.4]), np.array([3.0, 2.0, 1.2]))),
                  'column')
    problem = PlaneProblem(Simulator(scene, SimulationConfig(RigConfig(cameras=3))))
    free, anywhere = (np.concatenate([problem.start(np.random.default_rng(seed), episode, 3)
                                      for seed in range(20)])
                      for episode in (EpisodeConfig(), EpisodeConfig(clearance=0.0)))
    assert cKDTree(scene.points).query(free[:, :3])[0].min() >= CLEARANCE - ROUNDING
    assert cKDTree(scene.points).query(anywhere[:, :3])[0].min() < 0.05
    # Each begins beside where it would have.
    assert np.linalg.norm(free - anywhere, axis=1).max() < 0.3 + 0.15 + 2.0 * CELL_M
    np.testing.assert_array_equal(
        anywhere[:3, :2], problem.start(np.random.default_rng(0), replace(
            EpisodeConfig(), clearance=0.0), 3)[:, :2])


@pytest.mark.parametrize(('mount', 'expected'), [
    ({'on': 'plane', 'height': 1.9}, 0.35), ({'on': 'free', 'height': [1.5, 2.0]}, 0.35),
    ({'on': 'ceiling'}, 0.0), ({'on': 'walls', 'height': [1.5, 2.0]}, 0.0)])
def test_a_rig_file_says_how_far_its_cameras_stay(mount, expected):
    rig = rig_of(3, 'omnidirectional', mount=mount, keep_clear=0.35)
    assert rig.clearance == expected
    rig_state = RigState(np.zeros((3, 6)), rig.models, 3, clearance=rig.clearance)
    assert clearance_of(rig_state, 0.15) == expected and clearance_of(rig_state, 0.0) == 0.0
    assert clearance_of(None, 0.2) == clearance_of(rig_state._replace(clearance=None), 0.2) == 0.2
