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

"""Cameras stay over the floor of a room, whatever its shape and however it stands."""

from dataclasses import replace

from conftest import around_z, l_shaped, made_room
from hypothesis import given, settings, strategies
import numpy as np
from ocp_ros.rig.free_plane import CELL_M, Floor, floor_of, FreePlane
from ocp_ros.rig.motion import towards
from ocp_ros.scenes.scene import turned
from ocp_ros.search.annealing import TransDimensionalAnnealing
import pytest
from scipy import stats

#: Metres by which the floor may reach round an inner corner: two cells.
CORNER = 2.0 * CELL_M


def in_room(positions, margin=-CORNER):
    """Return whether positions (..., 2) are in the room of l_shaped, or nearly."""
    x, y = positions[..., 0], positions[..., 1]
    return ((x > margin) & (y > margin)
            & (((x < 3.0 - margin) & (y < 4.0 - margin))
               | ((x < 6.0 - margin) & (y < 2.0 - margin))))


@pytest.fixture(scope='module')
def space():
    """Return where three cameras may be in the L-shaped room, however near to its walls."""
    return FreePlane.of(l_shaped().points, 1.9, 3, 0.1, clearance=0.0)


def test_the_floor_is_the_room_and_not_its_bounding_box(space):
    assert space.floor is not None
    # 18 square metres, less a strip along 20 m of walls.
    assert 18.0 - 20.0 * 1.5 * CELL_M < space.area < 18.0
    places = np.random.default_rng(0).uniform(0.0, [6.0, 4.0], (2000, 2))
    allowed = space.contains(places)
    assert in_room(places[allowed]).all()
    assert in_room(places[allowed], 0.05).mean() > 0.97
    assert allowed[in_room(places, 2.5 * CELL_M)].all()


@settings(deadline=None, max_examples=25)
@given(x=strategies.floats(-0.7, 6.7), y=strategies.floats(-0.7, 4.7))
def test_what_is_outside_moves_to_the_nearest_place_inside(space, x, y):
    position = np.array([x, y])
    inside = space.inside(position)
    assert space.contains(inside) and in_room(inside)
    if space.contains(position):
        np.testing.assert_allclose(inside, position, atol=1e-5)
    others = space.grid(400)
    nearest = np.linalg.norm(others - position, axis=1).min()
    assert np.linalg.norm(inside - position) < nearest + 2.0 * CELL_M


def test_placements_are_drawn_uniformly_over_the_floor(space):
    drawn = np.concatenate([space.random(np.random.default_rng(k)) for k in range(1000)])
    assert space.contains(drawn).all()
    cells = np.floor((drawn - space.floor.low) / CELL_M).astype(int)
    counts = np.array([np.count_nonzero((cells == cell).all(axis=1))
                       for cell in np.argwhere(space.floor.open)])
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize('most', [1, 5, 40, 300])
def test_a_grid_is_no_larger_than_asked_and_over_the_floor(space, most):
    grid = space.grid(most)
    assert 1 <= len(grid) <= most and space.contains(grid).all()
    assert most < 40 or len(grid) > 0.7 * most


def test_without_energy_annealing_is_uniform_over_the_floor(space):
    """Moves that lead off the floor are refused; projected ones would heap up at its edge."""
    planner = TransDimensionalAnnealing(replace(space, cameras=1), np.random.default_rng(1), 100)
    placed, seen = planner.space.random(planner.rng), []
    for step in range(40000):
        trial, ratio = planner.propose(placed, 1.0)
        if planner.rng.random() < ratio:
            placed = trial
        if step % 10 == 0 and len(placed):
            seen.append(placed[0])

    def shares(places):
        """Return how many are in either arm and in the corner between them."""
        x, y = np.array(places).T
        return np.array([(x > 3.0).mean(), (y > 2.0).mean(), ((x <= 3.0) & (y <= 2.0)).mean()])

    cells = CELL_M * (np.argwhere(space.floor.open) + 0.5) + space.floor.low
    np.testing.assert_allclose(shares(seen), shares(cells), atol=0.05)


def test_a_move_stops_at_the_wall(space):
    positions = np.array([[2.7, 3.0], [2.0, 1.0], [5.0, 3.5]])
    moved = space.moved(positions, np.tile([0.5, 0.0], (3, 1)), 0.5)
    # At the wall, in the open, and where no camera should be to begin with.
    assert 2.7 <= moved[0, 0] < 3.0 + CORNER / 2 and space.contains(moved[0])
    np.testing.assert_allclose(moved[1:], [[2.5, 1.0], [5.5, 3.5]], atol=1e-5)


#: Metres: a move of the planes below.
STEP = 0.5


def walk(plane, position, target, most, go):
    """Return how many moves a camera needs to a target; None for more than so many."""
    for count in range(most + 1):
        if np.linalg.norm(position - target) <= plane.floor.edge:
            return count
        moved = go(position[None], target[None], STEP)[0]
        assert np.linalg.norm(moved - position) <= STEP + 1e-9 and plane.contains(moved)
        position = moved
    return None


def plane_over(cells):
    """Return where a camera may be: over open cells of 5 cm."""
    high = 0.05 * np.array(cells.shape)
    return FreePlane(np.zeros(2), high, 1.9, 1, Floor(np.zeros(2), cells, 0.05), 0.15)


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


@settings(deadline=None, max_examples=40)
@given(seed=strategies.integers(0, 2 ** 32 - 1), closed=strategies.floats(0.0, 0.6))
def test_a_camera_is_there_as_soon_as_it_can_be(seed, closed):
    rng = np.random.default_rng(seed)
    cells = (rng.random((8, 8)) >= closed).repeat(6, axis=0).repeat(6, axis=1)
    if not cells.any():
        return
    plane = plane_over(cells)
    here, there = plane.random(rng, 2)
    turns = next((turn for turn in range(1, 40)
                  if plane.reached(here, STEP, turn).contains(there)), None)
    needed = walk(plane, here, there, 40, plane.on_way)
    if turns is None:
        assert needed is None
    else:
        # A camera is not in the middle of its cell, so that one move more may be needed.
        assert needed is not None and needed <= turns + 1


@pytest.mark.parametrize('degrees', [30.0, 120.0])
def test_a_room_that_stands_askew_has_as_much_floor(space, degrees):
    scene = turned(l_shaped(), degrees)
    askew = FreePlane.of(scene.points, 1.9, 3, 0.1, clearance=0.0)
    assert askew.area == pytest.approx(space.area, rel=0.12)
    drawn = np.concatenate([askew.random(np.random.default_rng(k)) for k in range(200)])
    assert in_room(drawn @ around_z(degrees)).all()


def test_gaps_behind_furniture_count_and_other_rooms_do_not():
    points = l_shaped().points
    hole = (np.abs(points[:, :2] - [1.5, 1.5]) < 0.4).all(axis=1) & (points[:, 2] < 1.0)
    beyond = np.stack(np.meshgrid(np.arange(8, 9.2, 0.1), np.arange(0, 1.2, 0.1), [0.0]),
                      axis=-1).reshape(-1, 3).astype(np.float32)
    space = FreePlane.of(np.concatenate([points[~hole], beyond]), 1.9, 3, 0.1)
    assert space.contains(np.array([1.5, 1.5]))
    assert not space.contains(np.array([8.5, 0.5]))


@pytest.mark.parametrize(('wide', 'bridged'), [(0.5, True), (1.0, False)])
def test_a_slot_across_the_floor_is_bridged_if_it_is_narrow(wide, bridged):
    points = l_shaped().points
    slot = (points[:, 0] > 4.0) & (points[:, 0] < 4.0 + wide) & (points[:, 2] < 1.6)
    space = FreePlane.of(points[~slot], 1.9, 3, 0.1)
    assert space.contains(np.array([2.0, 1.0]))
    assert space.contains(np.array([5.5, 1.0])) == bridged


def test_a_courtyard_is_no_floor():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 10, 0.1), np.arange(0, 10, 0.1)))
    around = (np.abs(x - 5.0) > 3.0) | (np.abs(y - 5.0) > 3.0)
    points = np.stack([x, y, np.zeros(len(x))], axis=1)[around].astype(np.float32)
    space = FreePlane.of(points, 1.9, 3, 0.1)
    assert not space.contains(np.array([5.0, 5.0])) and space.contains(np.array([1.0, 5.0]))


@pytest.mark.parametrize('count', [1000, 2000])
def test_few_points_still_make_a_floor(count):
    """Where points are sparse, gaps between them are no gaps of the floor."""
    full, few = (FreePlane.of(made_room(3001, n).points, 1.9, 4, 0.1) for n in (15000, count))
    assert few.area > 0.6 * full.area
    ends = few.random(np.random.default_rng(0), 200)
    assert full.contains(ends).mean() > 0.95


def test_where_no_floor_is_seen_the_rectangle_is_all_there_is():
    ceiling = l_shaped().points
    ceiling = ceiling[ceiling[:, 2] > 1.7]
    assert floor_of(ceiling, 1.9) is None
    space = FreePlane.of(ceiling, 1.9, 3, 0.1, clearance=0.0)
    assert space.floor is None and space.area == pytest.approx(np.prod(space.size))
