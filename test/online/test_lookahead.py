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

"""Planners that are told how a rig stands: cameras in place, and cameras that look one way."""

from itertools import product

from conftest import box_room
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.packed_bits import pack, unpack
from ocp_ros.online.candidate_sites import (
    ANY_CANDIDATE_SHARE,
    Candidates,
    kinds_of,
    PROPOSALS,
    PROPOSALS_PER_CAMERA,
    TEMPERATURES,
)
from ocp_ros.online.episode_places import EpisodePlaces
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.observed_turn import ObservedTurns
from ocp_ros.online.online_planner import matched
from ocp_ros.online.partial_map import PartialMap, thinned
from ocp_ros.online.rig_state import directions, RigState
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.util.annealing import between
import pytest

pytestmark = pytest.mark.usefixtures('quick_lookahead')
MAX_STEP, MAX_RANGE, MARGIN, TURNS = 0.5, 3.0, 0.1, 6
NEAR = CameraModel(max_range=MAX_RANGE)
D455 = SENSORS['realsense_d455'].model
CLOUD = thinned(box_room(12.0, 4.0).points, 4000)
#: A camera starts in the middle of a long room, and one is in place near either end of it.
START, PLACED = np.array([6.0, 2.0, 1.9]), (2.0, 10.0)
SETTINGS = MAX_STEP, MAX_RANGE, MARGIN
#: Points and depth-map rows of the models of these tests.
POINTS, ROWS = 12000, 64


def played(sight_at):
    """Let one camera move through a room that is known; return where it was."""
    online = Lookahead(np.random.default_rng(0), *SETTINGS)
    trail = [START]
    for turn in range(TURNS):
        online.set_rig_state(sight_at(trail[-1]))
        move = online.move(CLOUD, trail[-1][None], turn, TURNS)[0]
        assert np.linalg.norm(move) <= MAX_STEP + 1e-9
        trail.append(trail[-1] + [*move, 0.0])
    return np.array(trail)


def state_of(*placement, model=D455, **limits):
    """Return how a rig of cameras of one kind stands, of which one can be moved."""
    return RigState(np.array(placement), (model,) * len(placement), 1, **limits)


def test_cameras_go_where_a_camera_in_place_leaves_most_to_be_seen():
    """To the end of a long room where nobody is; from the middle one sees neither."""
    ends = [played(lambda at, x=x: state_of(
        [*at, 0, 0, 0], [x, 2.0, 1.9, 0, 0, 0], model=NEAR))[-1, 0] for x in PLACED]
    assert ends[0] > START[0] + 1.0 and ends[1] < START[0] - 1.0


def test_a_rig_that_sees_all_around_is_moved_as_if_nothing_were_known_of_it():
    alone = played(lambda at: state_of([*at, 0.3, 0.2, 0.1], model=NEAR))
    np.testing.assert_array_equal(alone, played(lambda at: None))


def test_a_camera_that_looks_one_way_and_is_not_turned_stands_where_that_helps():
    """It looks along the room, so it goes back to where it sees most of it."""
    ends = [played(lambda at, yaw=yaw: state_of(
        [*at, yaw, 0.2, 0.0], may_rotate=False))[-1, 0] for yaw in (0.0, np.pi)]
    assert ends[0] < START[0] - 0.5 and ends[1] > START[0] + 0.5


def test_a_plan_says_how_cameras_are_turned_within_the_limits():
    online = Lookahead(np.random.default_rng(0), *SETTINGS)
    assert online.headings is None
    online.set_rig_state(state_of([*START, 0.0, 0.2, 0.0], pitch=(0.1, 0.7)))
    online.move(CLOUD, START[None], 0, TURNS)
    assert online.headings.shape == (1, 3) and 0.1 <= online.headings[0, 1] <= 0.7


def test_moves_are_judged_by_what_a_camera_sees_as_it_is_turned():
    """Who looks one way misses what is behind it."""
    placement = np.array([[*START, 0.0, 0.2, 0.0], [2.0, 2.0, 1.9, 1.0, 0.3, 0.0]])
    model = PartialMap(CLOUD, START[None], MAX_RANGE, POINTS, ROWS)
    one_way, fixed = (unpack(model.look(row, D455.lens).seen, len(model.points))
                      for row in placement)
    around = unpack(model.look(START).seen, len(model.points))
    nothing = np.zeros_like(fixed)
    for rig_state, own, others in ((state_of(*placement), one_way, fixed),
                                   (None, around, nothing),
                                   (state_of(placement[0]), one_way, nothing)):
        turns = ObservedTurns(MAX_RANGE, MARGIN, points=POINTS, rows=ROWS)
        turns.rig_state = rig_state
        np.testing.assert_array_equal(turns(CLOUD, START[None], 0, 30).seen_now(0),
                                      (own, others))


@pytest.mark.parametrize(('reach', 'within'), [(20.0, [4, 4]), (1.7, [2, 2])])
def test_the_best_of_an_episode_is_of_different_turns_and_within_reach(reach, within):
    """Each of two cameras saw most where the other one saw little."""
    model, places = PartialMap(CLOUD, START[None], MAX_RANGE, POINTS, ROWS), EpisodePlaces()
    placements = np.array([[[*START, yaw, 0.2, 0.0] for yaw in (np.pi, 0.0)]] * 4)
    placements[:, :, 0] = [[3.0, 5.0], [7.5, 9.0], [3.5, 6.0], [6.0, 7.0]]
    # The last ones are where they are now.
    for placement in placements:
        state = RigState(placement, (D455, D455), 2)
        places.add(placement[:, :3], state)
    found = places.best(model, state, placement[:, :3], reach)

    def error(poses):
        return model.error([model.look(pose, D455.lens) for pose in poses])

    near = [own[np.abs(own[:, 0] - own[-1, 0]) <= reach] for own in placements.swapaxes(0, 1)]
    assert [len(own) for own in near] == within
    assert error(found) == min(map(error, product(*near))) < 0.9 * min(map(error, placements))


#: A rig of two kinds: two cameras that look one way, one that sees all around.
MIXED = RigState(np.hstack([START + [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
                            [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]]),
                 (D455, NEAR, D455), 3)
SPACE = FreePlane.of(CLOUD, 1.9, 3, MARGIN)


@pytest.fixture(scope='module')
def model():
    """Return a coarse model of the room."""
    return PartialMap(CLOUD, MIXED.placement[:, :3], 4.0, 2000, 16)


def test_a_camera_keeps_its_roll_and_its_kind_with_it():
    np.testing.assert_array_equal(kinds_of(MIXED)[0], [0, 1, 0])
    np.testing.assert_array_equal(kinds_of(MIXED._replace(may_rotate=False))[0], [0, 1, 2])
    portrait = MIXED._replace(placement=MIXED.placement.copy())
    portrait.placement[2, 5] = 0.5 * np.pi
    assert (portrait.headings(2, 8, 2)[:, 2] == 0.5 * np.pi).all()
    assert not portrait.headings(0, 8, 2)[:, 2].any()
    np.testing.assert_array_equal(kinds_of(portrait)[0], [0, 1, 2])


def test_cameras_take_places_of_their_kind_only(model):
    places, rng = SPACE.placement(SPACE.grid(12)), np.random.default_rng(0)
    sites = Candidates(model, places, [MIXED.placement], MIXED,
                       np.zeros_like(model.look(START).covered), 0.0)
    assert len(sites.poses) == 3 + len(places) * (len(directions(MIXED.pitch, 8, 2)) + 1)
    own = sites.poses[3:]
    assert len(np.unique(own[:-len(places), 3:], axis=0)) == 16
    assert not own[-len(places):, 4:].any()
    chosen = sites.choose_greedily()
    for _ in range(3):
        before = sites.value(chosen)
        (chosen,) = sites.anneal(chosen, rng)
        assert sites.value(chosen) <= before
        assert all(site in sites.of_kind[kind] for site, kind in zip(chosen, sites.kind_of))


@pytest.mark.parametrize(('kinds', 'weight'), [(1, 0.0), (2, 0.01)])
def test_annealing_agrees_with_its_twin(model, kinds, weight):
    places, unseen = SPACE.placement(SPACE.grid(20)), pack(model.cells % 3 > 0)
    found = Candidates(model, places, [], RigState.omnidirectional(3) if kinds == 1 else MIXED,
                       unseen, weight)
    kind_of = [0, kinds - 1, 0]

    def annealed(state, rng):
        shares = np.arange(PROPOSALS) / PROPOSALS
        temperatures = model.depth_error.worst * between(*TEMPERATURES, shares)
        best, best_value = list(state), np.inf
        for block in range(0, PROPOSALS, PROPOSALS_PER_CAMERA):
            camera, value = int(rng.integers(0, 3)), found.value(state)
            if value < best_value:
                best, best_value = list(state), value
            own = found.of_kind[kind_of[camera]]
            for temperature in temperatures[block:block + PROPOSALS_PER_CAMERA]:
                anywhere = rng.random() < ANY_CANDIDATE_SHARE
                sites = own if anywhere else found.neighbours[state[camera]][:len(own) - 1]
                site = int(sites[rng.integers(0, len(sites))])
                trial = [*state[:camera], site, *state[camera + 1:]]
                most, trial_value = value + temperature * rng.exponential(), found.value(trial)
                if trial_value <= most:
                    state, value = trial, trial_value
                    if value < best_value:
                        best, best_value = list(state), value
        return best

    start = found.choose_greedily()[::-1] if kinds == 1 else found.choose_greedily()
    for seed, parts in enumerate((1, 2, 3)):
        rng, twin = np.random.default_rng(seed), np.random.default_rng(seed)
        assert [*found.anneal(start, rng, parts)][-1] == annealed(start, twin)
        # They drew as often, so what is drawn next is the same.
        assert rng.bit_generator.state == twin.bit_generator.state
        start = [int(found.of_kind[kind][0]) for kind in kind_of]


def test_nobody_is_matched_with_a_place_of_another_kind():
    positions = np.array([[0.0, 0.0, 1.9], [5.0, 0.0, 1.9], [9.0, 0.0, 1.9]])
    targets = np.array([[9.0, 0.0], [0.0, 0.0], [5.0, 0.0]])
    np.testing.assert_array_equal(matched(positions, targets), [1, 2, 0])
    found = matched(positions, targets, np.array([0, 1, 0]))
    assert found[1] == 1 and sorted(found) == [0, 1, 2]
