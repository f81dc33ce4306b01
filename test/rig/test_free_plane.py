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

"""Cameras stay over the floor of a room and keep a distance from surfaces, whoever plans."""

from dataclasses import replace

from conftest import around_z, box_room, box_sides, for_any, l_shaped, made_room, panel
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.online.online_planner import Online
from ocp_ros.online.rig_state import clearance_of, RigState
from ocp_ros.online.step import play
from ocp_ros.rig import free_plane
from ocp_ros.rig.free_plane import CELL_M, CLEARANCE, close_cells, Floor, floor_of, FreePlane
from ocp_ros.rig.motion import towards
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.scenes.scene import Scene, turned
from ocp_ros.search.annealing import TransDimensionalAnnealing
from ocp_ros.search.planner import Scores, solve
from ocp_ros.search.registry import planner_names, PLANNERS, SCORES
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
import pytest
from scipy import stats
from scipy.spatial import cKDTree

#: Metres by which the floor may reach round an inner corner: two cells.
CORNER = 2.0 * CELL_M
#: Metres: of cameras; their moves; bottom and top of panels; where single precision rounds.
HEIGHT, MARGIN, STEP, HIGH, ROUNDING = 1.9, 0.1, 0.5, (0.0, 2.2), 1e-6
PILLAR = box_sides(np.array([1.0, 1.0, 2.4]), np.array([3.0, 2.0, 1.2]))
seeds = st.integers(0, 2 ** 32 - 1)


def plane_of(points, clearance=CLEARANCE):
    """Return where three cameras may be in a room."""
    return FreePlane.of(points, HEIGHT, 3, MARGIN, clearance)


def in_room(positions, margin=-CORNER):
    """Return whether positions (M, 2) are in the room of l_shaped, or nearly."""
    x, y = positions.T
    in_arm = ((x < 3.0 - margin) & (y < 4.0 - margin)) | ((x < 6.0 - margin) & (y < 2.0 - margin))
    return (x > margin) & (y > margin) & in_arm


@pytest.fixture(scope='module')
def space():
    """Return where three cameras may be in the L-shaped room, however near to its walls."""
    return plane_of(l_shaped().points, 0.0)


def test_the_floor_is_the_room_and_not_its_bounding_box(space):
    # 18 square metres, less a strip along 20 m of walls.
    assert 18.0 - 20.0 * 1.5 * CELL_M < space.area < 18.0
    places = np.random.default_rng(0).uniform(0.0, [6.0, 4.0], (2000, 2))
    allowed = space.contains(places)
    assert in_room(places[allowed]).all() and in_room(places[allowed], 0.05).mean() > 0.97
    assert allowed[in_room(places, 2.5 * CELL_M)].all()


def test_placements_are_drawn_uniformly_over_the_floor(space):
    drawn = np.concatenate([space.random(np.random.default_rng(k)) for k in range(1000)])
    assert space.contains(drawn).all()
    cells = np.floor((drawn - space.floor.low) / CELL_M).astype(int)
    counts = np.array([np.count_nonzero((cells == cell).all(axis=1))
                       for cell in np.argwhere(space.floor.open)])
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize(('least', 'most'), [(1, 1), (1, 5), (29, 40), (211, 300)])
def test_a_grid_is_no_larger_than_asked_and_over_the_floor(space, least, most):
    grid = space.grid(most)
    assert least <= len(grid) <= most and space.contains(grid).all()


def test_without_energy_annealing_is_uniform_over_the_floor(space):
    """Moves that lead off the floor are refused; projected ones would heap up at its edge."""
    planner = TransDimensionalAnnealing(replace(space, cameras=1), np.random.default_rng(1), 100)
    placed, seen = planner.space.random(planner.rng), []
    for step in range(30000):
        trial, ratio = planner.propose(placed, 1.0)
        if planner.rng.random() < ratio:
            placed = trial
        if step % 10 == 0 and len(placed):
            seen.append(placed[0])

    def shares(places):
        """Return how many are in either arm; the others are in the corner between them."""
        x, y = np.array(places).T
        return [(x > 3.0).mean(), (y > 2.0).mean()]

    cells = CELL_M * (np.argwhere(space.floor.open) + 0.5) + space.floor.low
    np.testing.assert_allclose(shares(seen), shares(cells), atol=0.05)


def test_a_move_stops_at_the_wall(space):
    positions = np.array([[2.7, 3.0], [2.0, 1.0], [5.0, 3.5]])
    moved = space.moved(positions, np.tile([0.5, 0.0], (3, 1)), 0.5)
    # At the wall, in the open, and where no camera should be to begin with.
    assert 2.7 <= moved[0, 0] < 3.0 + CORNER / 2 and space.contains(moved[0])
    np.testing.assert_allclose(moved[1:], [[2.5, 1.0], [5.5, 3.5]], atol=1e-5)


def walk(plane, position, target, most, go):
    """Return how many moves a camera needs to a target; None for more than so many."""
    for count in range(most + 1):
        if np.linalg.norm(position - target) <= plane.floor.edge:
            return count
        before, position = position, go(position[None], target[None], STEP)[0]
        assert np.linalg.norm(position - before) <= STEP + 1e-9 and plane.contains(position)
    return None


def plane_over(cells):
    """Return where a camera may be: over open cells of 5 cm."""
    return FreePlane(np.zeros(2), 0.05 * np.array(cells.shape), 1.9, 1,
                     Floor(np.zeros(2), cells, 0.05), 0.15)


def test_a_camera_goes_around_what_it_cannot_step_over():
    cells = np.ones((160, 120), dtype=bool)
    cells[70:90, 20:] = False
    plane, here, there = plane_over(cells), np.array([2.0, 3.0]), np.array([6.0, 3.0])

    def straight(positions, targets, step):
        return plane.moved(positions, towards(positions, targets, step) - positions, step)

    assert walk(plane, here, there, 100, straight) is None
    # To an end of what is 2 m away and 2 m to the side, along its metre, and back.
    assert walk(plane, here, there, 100, plane.on_way) == 13
    assert not plane.reached(here, STEP, 7).contains(there)
    assert plane.reached(here, STEP, 13).contains(there)
    # With moves of 2 m it steps over.
    np.testing.assert_allclose(plane.on_way(here[None], there[None], 2.0)[0, 0], 3.5, atol=0.05)


@pytest.mark.parametrize('step', [0.001, 0.04, 0.09])
def test_steps_too_short_for_the_cells_are_straight_and_bounded(step):
    plane = plane_over(np.ones((60, 60), dtype=bool))
    here, there = np.ones(2), np.array([2.5, 1.0])
    moved = plane.on_way(here[None], there[None], step)[0]
    np.testing.assert_allclose(moved, here + [step, 0.0], atol=1e-5)
    reached = plane.reached(here, step, 12).inside(there)
    np.testing.assert_allclose(reached, here + [12.0 * step, 0.0], atol=1e-5)


def test_a_room_without_width_still_has_ways():
    plane = FreePlane(np.zeros(2), np.array([5.0, 0.0]), 1.9, 1)
    here, there = np.array([0.3, 0.0]), np.array([3.0, 0.0])
    np.testing.assert_array_equal(plane.on_way(here[None], there[None], STEP)[0], [0.8, 0.0])
    np.testing.assert_array_equal(plane.reached(here, STEP, 2).inside(there), [1.3, 0.0])


@for_any(40, seed=seeds, closed=st.floats(0.0, 0.6))
def test_a_camera_is_there_as_soon_as_it_can_be(seed, closed):
    rng = np.random.default_rng(seed)
    cells = (rng.random((8, 8)) >= closed).repeat(6, axis=0).repeat(6, axis=1)
    if not cells.any():
        return
    plane = plane_over(cells)
    here, there = plane.random(rng, 2)
    turns = next((turn for turn in range(1, 40)
                  if plane.reached(here, STEP, turn).contains(there)), np.inf)
    needed = walk(plane, here, there, 40, plane.on_way)
    # A camera is not in the middle of its cell, so that one move more may be needed.
    assert (needed is None) == (turns == np.inf)
    assert needed is None or needed <= turns + 1


@pytest.mark.parametrize('degrees', [30.0, 120.0])
def test_a_room_that_stands_askew_has_as_much_floor(space, degrees):
    askew = plane_of(turned(l_shaped(), degrees).points, 0.0)
    assert askew.area == pytest.approx(space.area, rel=0.12)
    drawn = np.concatenate([askew.random(np.random.default_rng(k)) for k in range(200)])
    assert in_room(drawn @ around_z(degrees)).all()


def test_gaps_behind_furniture_count_and_other_rooms_and_courtyards_do_not():
    points = l_shaped().points
    hole = (np.abs(points[:, :2] - [1.5, 1.5]) < 0.4).all(axis=1) & (points[:, 2] < 1.0)
    beyond = np.stack(np.meshgrid(np.arange(8, 9.2, 0.1), np.arange(0, 1.2, 0.1), [0.0]),
                      axis=-1).reshape(-1, 3).astype(np.float32)
    space = plane_of(np.concatenate([points[~hole], beyond]))
    assert space.contains(np.array([[1.5, 1.5], [8.5, 0.5]])).tolist() == [True, False]
    # A slot across the floor is bridged if it is narrow.
    for wide in (0.5, 1.0):
        slot = (points[:, 0] > 4.0) & (points[:, 0] < 4.0 + wide) & (points[:, 2] < 1.6)
        found = plane_of(points[~slot]).contains(np.array([[2.0, 1.0], [5.5, 1.0]]))
        assert found.tolist() == [True, wide == 0.5]
    # A courtyard is no floor.
    along = np.arange(0, 10, 0.1)
    level = np.stack(np.meshgrid(along, along, [0.0]), axis=-1).reshape(-1, 3).astype(np.float32)
    space = plane_of(level[np.abs(level[:, :2] - 5.0).max(axis=1) > 3.0])
    assert space.contains(np.array([[1.0, 5.0], [5.0, 5.0]])).tolist() == [True, False]


def test_few_points_still_make_a_floor():
    """Where points are sparse, gaps between them are no gaps of the floor."""
    full, few = (plane_of(made_room(3001, count).points) for count in (15000, 1000))
    assert few.area > 0.6 * full.area
    assert full.contains(few.random(np.random.default_rng(0), 200)).mean() > 0.95


def test_where_no_floor_is_seen_the_rectangle_is_all_there_is():
    points = l_shaped().points
    ceiling = points[points[:, 2] > 1.7]
    assert floor_of(ceiling, HEIGHT) is None
    space = plane_of(ceiling, 0.0)
    assert space.floor is None and space.area == pytest.approx(np.prod(space.size))
    np.testing.assert_allclose(space.low, [0.1, 0.1], atol=1e-6)


def with_things(*things):
    """Return the points (N, 3) float32 of a box of 6 x 4 x 2.8 m with things in it."""
    return np.concatenate([box_room().points, *things]).astype(np.float32)


def distances(points, places):
    """Return how far (M, 3), or (M, 2) at HEIGHT, are from the nearest point, metres: (M,)."""
    if places.shape[1] == 2:
        places = np.column_stack([places, np.full(len(places), HEIGHT)])
    return cKDTree(points).query(places)[0]


@pytest.fixture(scope='module')
def parted():
    """Return points of a room with a panel as high as cameras that has two ways past it."""
    return with_things(panel(3.0, (1.0, 3.0), HIGH))


@st.composite
def clouds(draw):
    """Draw a room of any size with boxes, panels and stray points in it, or a part of one."""
    rng = np.random.default_rng(draw(st.integers(0, 2 ** 31)))
    size = np.array([*rng.uniform(0.6, 8.0, 2), rng.uniform(2.0, 4.0)])
    parts = [box_sides(size, size / 2.0, 0.2)]
    for _ in range(draw(st.integers(0, 5))):
        box = rng.uniform([0.02, 0.02, 0.5], [1.5, 1.5, 2.5])
        parts.append(box_sides(box, np.append(rng.uniform(0.0, size[:2]), box[2] / 2.0), 0.1))
    points = np.concatenate([*parts, rng.uniform(0.0, size, (draw(st.integers(0, 40)), 3))])
    if draw(st.booleans()):
        points = points[points[:, 2] > draw(st.floats(0.0, 1.9))]
    return (points + rng.uniform(-20.0, 20.0, 3) * [1.0, 1.0, 0.0]).astype(np.float32)


@for_any(40, points=clouds(), clearance=st.floats(0.01, 1.5), margin=st.floats(0.0, 0.5),
         seed=seeds)
def test_every_place_of_a_plane_keeps_its_distance(points, clearance, margin, seed):
    plane, rng = FreePlane.of(points, HEIGHT, 3, margin, clearance), np.random.default_rng(seed)
    if not plane.clearance:
        # Nothing would be left open.
        old = FreePlane.of(points, HEIGHT, 3, margin, 0.0)
        np.testing.assert_array_equal(plane.low, old.low)
        assert plane.area == old.area
        most = clearance + np.sqrt(2.0) * CELL_M + 2.0 * free_plane.SLACK_M
        near = distances(points, old.grid(400)) < most
        assert near.all() or plane.area > 100_000 * free_plane.FINE_CELL_M ** 2
        return
    anywhere = rng.uniform(plane.low - 1.0, plane.high + 1.0, (40, 2))
    drawn = plane.random(rng, 20)
    moved = plane.moved(drawn, rng.normal(0.0, 0.7, (20, 2)), 0.5)
    assert np.linalg.norm(moved - drawn, axis=1).max() <= 0.5 + 1e-9
    inside, reflected = plane.inside(anywhere), plane.reflected(anywhere)
    places = np.concatenate([drawn, moved, plane.grid(60), inside, reflected])
    assert plane.contains(places).all()
    assert distances(points, places).min() >= clearance - ROUNDING
    np.testing.assert_array_equal(plane.inside(inside), inside)


@for_any(40, seed=seeds, clearance=st.floats(0.01, 0.8), edge=st.floats(0.05, 0.4))
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


@for_any(40, seed=seeds, share=st.sampled_from([0.02, 0.1, 0.5]))
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


def test_the_inside_of_a_cabinet_is_no_place():
    room, inside = with_things(PILLAR), np.array([3.0, 2.0])
    # A room no larger than that is believed.
    for points, clearance, is_open in ((room, 0.0, True), (room, 0.15, False),
                                       (PILLAR, 0.15, True)):
        plane = plane_of(points, clearance)
        assert plane.clearance == clearance and plane.contains(inside) == is_open


def test_cameras_of_different_heights_keep_it_at_each_of_them():
    shelf = np.random.default_rng(0).uniform([2.5, 2.5, 1.2], [3.5, 3.5, 1.2], (400, 3))
    positions = np.array([[1.0, 1.0, 1.3], [1.0, 3.0, 1.9], [5.0, 3.0, 2.0]])
    plane = FreePlane.around(with_things(shelf), positions, MARGIN, 0.15)
    assert plane.height == 1.9 and not plane.contains(np.array([3.0, 3.0]))
    assert plane_of(with_things(shelf)).contains(np.array([3.0, 3.0]))


def test_a_camera_leaves_where_it_must_not_be(parted):
    plane = plane_of(parted)
    # In the panel: out of it, the way that was asked for; who holds still is left there.
    inside = np.tile([3.0, 2.0], (3, 1))
    moved = plane.moved(inside, np.array([[0.5, 0.0], [-0.05, 0.0], [0.0, 0.0]]), 0.5)
    assert moved[0, 0] == pytest.approx(3.5, abs=1e-5) and 2.7 < moved[1, 0] < 2.85
    assert distances(parted, moved[:2]).min() >= 0.15 - ROUNDING
    np.testing.assert_array_equal(moved[2], inside[2])
    # Too far within a thick thing to get out at once: as it likes.
    panels = [panel(x, (0.5, 3.5), HIGH) for x in np.arange(2.0, 4.0, 0.1)]
    moved = plane_of(with_things(*panels)).moved(inside, np.tile([0.3, 0.0], (3, 1)), 0.5)
    np.testing.assert_allclose(moved, inside + [0.3, 0.0])


@pytest.mark.parametrize('name', planner_names(SCORES))
def test_no_planner_puts_a_camera_at_a_surface_or_off_the_floor(parted, name):
    plane = plane_of(parted)
    # The best positions are where none may be: in the panel and beyond the walls.
    wanted = np.array([plane.low - 1.0, 0.5 * (plane.low + plane.high), plane.high + 1.0])

    def score(placements):
        errors = np.array([np.linalg.norm(wanted[:, None] - placement, axis=2).min(axis=1)
                           .sum() if len(placement) else 20.0 for placement in placements])
        return Scores(errors, -errors)

    found = solve(PLANNERS[name].make(plane, np.random.default_rng(0), 300), score, 300)
    assert distances(parted, plane.placement(found.positions)).min() >= CLEARANCE - ROUNDING


class Stubborn(Online):
    """Wants to stand in the panel."""

    def move(self, cloud, positions, turn, turns):
        """Go straight there."""
        return self.towards(positions, np.tile([3.0, 2.0], (3, 1))) - positions[:, :2]


@pytest.mark.parametrize('clearance', [0.0, 0.15, 0.4])
def test_commands_keep_it_whatever_the_planner_wants(parted, clearance):
    config = SimulationConfig(
        RigConfig(cameras=3), EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0),
        EpisodeConfig(turns=8, clearance=clearance))
    problem, seen = PlaneProblem(Simulator(Scene(parted, 'parted'), config)), []
    episode = Episode(problem, np.random.default_rng(0))
    # What append returns, None, does not end the episode.
    trail = play(Stubborn(np.random.default_rng(0), 0.5, 4.0, MARGIN), episode,
                 lambda turn: seen.append(episode.observed_cloud)).trajectory
    for cloud, placement in zip(seen, trail[1:], strict=True):
        assert distances(cloud, placement).min() >= clearance - ROUNDING
    assert distances(parted, trail[-1]).max() < clearance + 0.15


def test_starts_are_out_of_furniture():
    pillar = box_sides(np.array([0.6, 0.6, 2.4]), np.array([3.0, 2.0, 1.2]))
    scene = Scene(with_things(pillar), 'pillar')
    problem = PlaneProblem(Simulator(scene, SimulationConfig(RigConfig(cameras=3))))
    free, anywhere = (np.concatenate([problem.start(np.random.default_rng(seed), episode, 3)
                                      for seed in range(20)])
                      for episode in (EpisodeConfig(), EpisodeConfig(clearance=0.0)))
    assert distances(scene.points, free[:, :3]).min() >= CLEARANCE - ROUNDING
    assert distances(scene.points, anywhere[:, :3]).min() < 0.05
    # Each begins beside where it would have.
    assert np.linalg.norm(free - anywhere, axis=1).max() < 0.3 + 0.15 + 2.0 * CELL_M


@pytest.mark.parametrize(('mount', 'expected'), [
    ({'on': 'plane', 'height': 1.9}, 0.35), ({'on': 'free', 'height': [1.5, 2.0]}, 0.35),
    ({'on': 'ceiling'}, 0.0), ({'on': 'walls', 'height': [1.5, 2.0]}, 0.0)])
def test_a_rig_file_says_how_far_its_cameras_stay(mount, expected):
    rig = rig_of(3, 'omnidirectional', mount=mount, keep_clear=0.35)
    assert rig.clearance == expected
    rig_state = RigState(np.zeros((3, 6)), rig.models, 3, clearance=rig.clearance)
    assert clearance_of(rig_state, 0.15) == expected and clearance_of(rig_state, 0.0) == 0.0
    assert clearance_of(None, 0.2) == clearance_of(rig_state._replace(clearance=None), 0.2) == 0.2
