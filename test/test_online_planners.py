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

"""Planners without a scan: they keep the rules, know only what was seen, and get somewhere."""

from dataclasses import replace

from conftest import box_room, flat_clouds, random_checkpoint
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.online.greedy_step import GreedyStep
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import MIN_PIPELINED_TURNS, Online, PipelinedPlanner
from ocp_ros.online.partial_map import cells_of_the_air, LookHistory, NO_CELL, PartialMap, thinned
from ocp_ros.online.rig_state import Limits, RigState
from ocp_ros.online.rollout import play
from ocp_ros.online.step import OnlineStep
from ocp_ros.policy.agent_config import AgentConfig, CLOUD
from ocp_ros.policy.learned import Learned
from ocp_ros.policy.map_actor import MapActor
from ocp_ros.policy.observation_map import CELLS
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.free_plane import FINE_CELL_M
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
import pytest

MAX_STEP, MAX_RANGE, MARGIN = 0.5, 4.0, 0.1
#: Three cameras cannot see all of the small room: where they stand makes a difference.
CONFIG = SimulationConfig(rig=RigConfig(cameras=3, max_range=MAX_RANGE),
                          episode=EpisodeConfig(turns=12, max_step=MAX_STEP))


class Wanderer(Online):
    """Random moves: the control."""

    def move(self, cloud, positions, turn, turns):
        """Move at random."""
        return self.random_walk(cloud, positions)


def settings(seed=0):
    """Return what every online planner is made with."""
    return np.random.default_rng(seed), MAX_STEP, MAX_RANGE, MARGIN


def learned(seed=0):
    """Return a policy of random weights as a planner."""
    return Learned(Policy(random_checkpoint(AgentConfig(CLOUD), seed=1)), *settings(seed))


def guided(seed=0):
    """Return lookahead that the greedy step makes proposals to."""
    return Lookahead(*settings(seed), guide=GreedyStep(*settings(seed)))


MADE = {
    'wanderer': lambda seed=0: Wanderer(*settings(seed)),
    'learned': learned,
    'greedy step': lambda seed=0: GreedyStep(*settings(seed)),
    'lookahead': lambda seed=0: Lookahead(*settings(seed)),
    'guided lookahead': guided}


@pytest.fixture(scope='module')
def engine(room):
    """Return the engine of the small room."""
    return Simulator(room, CONFIG)


class Outcomes(dict):
    """What each planner's episode came to, played when it is asked for; all start alike."""

    def __init__(self, engine):
        super().__init__()
        self.engine = engine

    def __missing__(self, name):
        """Play the episode of a planner."""
        episode = Episode(PlaneProblem(self.engine), np.random.default_rng(5))
        self[name] = play(MADE[name](), episode)
        return self[name]


@pytest.fixture(scope='module')
def outcomes(engine):
    """Return what each planner's episode comes to."""
    return Outcomes(engine)


@pytest.mark.parametrize('name', MADE)
def test_an_episode_is_played_to_its_end_by_the_rules(name, outcomes, engine):
    outcome = outcomes[name]
    assert outcome.trajectory.shape == (13, 3, 3)
    assert outcome.depth_error.shape == (13,) and outcome.seconds.shape == (12,)
    assert (outcome.seconds > 0.0).all()
    steps = np.linalg.norm(np.diff(outcome.trajectory, axis=0), axis=2)
    assert steps.max() <= MAX_STEP + 1e-9
    np.testing.assert_allclose(outcome.trajectory[..., 2], engine.height)
    for at in (0, -1):
        assert engine.evaluate(outcome.trajectory[at]).depth_error == outcome.depth_error[at]


def thinking(planner, episode, turns, reflects):
    """Yield moves, and how often plans were made to answer, of a planner that reflects or not."""
    made, plan = [0], planner._think

    def counted(*what):
        made[0] += 1
        plan(*what)

    planner._think = counted
    for turn in range(turns):
        positions = episode.turn.positions
        made[0] = 0
        moves = planner.move(episode.observed_cloud, positions, turn, turns)
        yield moves, made[0]
        episode.move(moves)
        if reflects:
            planner.plan_ahead()


class Middle:
    """A network that finds the middle of the map best."""

    def values(self, room, others, numbers, lens):
        """Return the same for everybody."""
        away = np.linalg.norm(np.indices((CELLS, CELLS)) - 0.5 * CELLS, axis=0)
        return 0.01 * away[None].astype(np.float32)


THINKING = {
    'lookahead': lambda: Lookahead(*settings()),
    'map actor': lambda: MapActor(Middle(), *settings()),
    'guided lookahead': lambda: Lookahead(*settings(), guide=MapActor(Middle(), *settings()))}


@pytest.mark.parametrize('name', THINKING)
def test_in_many_turns_plans_are_made_while_the_cameras_move(name, engine):
    """Who lets the planner reflect gets the same moves, without plans that are waited for."""
    config = replace(CONFIG, episode=EpisodeConfig(turns=MIN_PIPELINED_TURNS, max_step=MAX_STEP))
    prompt, late = (list(thinking(
        THINKING[name](),
        Episode(PlaneProblem(Simulator(engine.scene, config)), np.random.default_rng(7)),
        MIN_PIPELINED_TURNS, reflects)) for reflects in (True, False))
    for (one, _), (other, _) in zip(prompt, late):
        np.testing.assert_array_equal(one, other)
    assert [turn for turn, (_, made) in enumerate(prompt) if made] == [0]
    assert all(made for _, made in late)
    # In few turns they are made of the newest cloud.
    episode = Episode(PlaneProblem(engine), np.random.default_rng(7))
    assert CONFIG.episode.turns < MIN_PIPELINED_TURNS and all(made for _, made in thinking(
        THINKING[name](), episode, CONFIG.episode.turns, True))


class Sent(PipelinedPlanner):
    """A plan for one camera that never changes."""

    def __init__(self, target):
        super().__init__(*settings())
        self.reset()
        self.targets = np.array([target])

    def _think(self, cloud, positions, turn, turns):
        self._space = self.space(cloud, positions)


def test_a_camera_with_a_cabinet_in_its_way_gets_to_its_target(furnished):
    """Straight on it would walk into the side of the cabinet in every turn."""
    step = OnlineStep(Sent([5.0, 2.0]), Limits(MAX_STEP, 0.0, MARGIN))
    placement = np.array([[3.0, 2.0, 1.9, 0.0, 0.0, 0.0]])
    for turn in range(MIN_PIPELINED_TURNS):
        state = RigState(placement, (CameraModel(),), 1)
        placement = step(furnished.points, state, turn, MIN_PIPELINED_TURNS).placement
    np.testing.assert_allclose(placement[0, :2], [5.0, 2.0], atol=FINE_CELL_M)


@pytest.mark.parametrize('turn', [24, 26, 29])
def test_lookahead_sends_nobody_where_it_cannot_be_in_time(furnished, turn):
    """One of two cameras before a cabinet had best be behind it, which takes some turns."""
    online = Lookahead(*settings())
    positions = np.array([[3.2, 2.0, 1.9], [3.1, 1.8, 1.9]])
    online.move(furnished.points, positions, turn, 30)
    placed, space = positions[:, :2], online.space(furnished.points, positions)
    assert (space.contains([[5.0, 2.0]]) & space.contains(placed)).all()
    # Ways are counted in cells, so that one move more may be needed; the next plan knows.
    for _ in range(30 - turn + 1):
        placed = space.on_way(placed, online.targets, MAX_STEP)
    assert (placed[:, 0].max() > 4.5) == (turn != 29)
    np.testing.assert_allclose(placed, online.targets, atol=FINE_CELL_M)


@pytest.mark.parametrize('name', ['wanderer', 'greedy step', 'lookahead', 'guided lookahead'])
def test_no_move_leads_out_of_what_has_been_seen(name, engine):
    online, episode = MADE[name](), Episode(PlaneProblem(engine), np.random.default_rng(6))
    while not episode.turn.truncated:
        cloud, positions = episode.observed_cloud, episode.turn.positions
        moves = online.move(cloud, positions, episode.turn.step, CONFIG.episode.turns)
        places = positions[:, :2] + moves
        assert (places >= cloud.min(axis=0)[:2] + MARGIN - 1e-6).all()
        assert (places <= cloud.max(axis=0)[:2] - MARGIN + 1e-6).all()
        episode.move(moves)


@pytest.mark.parametrize('name', ['wanderer', 'lookahead', 'guided lookahead'])
def test_a_seed_and_a_reset_give_the_same_episode(name, engine, outcomes):
    # A new planner with the same seed; and the second episode of one is that of another.
    one, other = MADE[name](), MADE[name]()
    first = play(one, Episode(PlaneProblem(engine), np.random.default_rng(5)))
    np.testing.assert_array_equal(first.trajectory, outcomes[name].trajectory)
    play(other, Episode(PlaneProblem(engine), np.random.default_rng(5)))
    second = [play(online, Episode(PlaneProblem(engine), np.random.default_rng(9))).trajectory
              for online in (one, other)]
    np.testing.assert_array_equal(*second)


def test_planners_end_far_better_than_they_began_and_than_random_moves(outcomes, engine):
    greedy = outcomes['greedy step'].depth_error
    assert greedy[-1] < 0.7 * greedy[0]
    final = {name: outcomes[name].depth_error[-1] for name in ('wanderer', 'lookahead')}
    assert final['lookahead'] < 0.5 * final['wanderer']
    low, high = engine.scene.bounds
    placements = np.random.default_rng(1).uniform(low + MARGIN, high - MARGIN, (300, 3, 3))
    placements[..., 2] = engine.height
    errors = engine.evaluate_many(placements)[:, 1]
    # In twelve turns and without a scan, it does better than nearly all placements drawn at once.
    assert np.mean(errors < final['lookahead']) < 0.01


class Proposing(Online):
    """Proposes the same placement each time."""

    def __init__(self, placement):
        super().__init__(*settings())
        self._placement = placement

    def move(self, cloud, positions, turn, turns):
        """Stay: nobody asks for moves."""
        return np.zeros((len(positions), 2))

    def propose(self, known):
        """Propose it."""
        return self._placement


def test_a_proposal_is_taken_where_it_is_better_and_else_changes_nothing(engine):
    """The first of many turns is answered by a plan to begin with; late ones explore no more."""
    episode = Episode(PlaneProblem(engine), np.random.default_rng(7))
    cloud, positions = engine.scene.points, episode.turn.positions

    def planned(guide):
        online = Lookahead(*settings(), guide=guide)
        online.move(cloud, positions, 57, 100)
        return np.column_stack([online.targets, positions[:, 2]])

    alone = planned(None)
    best = play(MADE['lookahead'](), episode).trajectory[-1]
    assert engine.evaluate(best).depth_error < engine.evaluate(alone).depth_error
    for proposal, expected in ((best, best), (positions[[0, 0, 0]], alone)):
        found = planned(Proposing(np.hstack([proposal, np.zeros((3, 3))])))
        np.testing.assert_allclose(sorted(found.tolist()), sorted(expected.tolist()), atol=1e-6)


@pytest.mark.parametrize('name', ['greedy step', 'lookahead', 'guided lookahead'])
def test_what_nobody_has_seen_changes_no_move(name, room):
    # Starts keep a clearance from all of the room, seen or not.
    config = replace(CONFIG, episode=replace(CONFIG.episode, clearance=0.0))
    episode = Episode(PlaneProblem(Simulator(room, config)), np.random.default_rng(2))
    # Disturb what is out of every camera's range, but not the bounds.
    way = room.points[:, None] - episode.turn.positions
    far = np.linalg.norm(way, axis=2).min(axis=1) > MAX_RANGE + 0.8
    far[np.concatenate([room.points.argmin(axis=0), room.points.argmax(axis=0)])] = False
    noise = np.random.default_rng(0).normal(0.0, 0.05, room.points.shape)
    points = room.points.copy()
    points[far] = np.clip(points + noise, *room.bounds)[far]
    disturbed = Scene(points, normals=room.normals_or_estimate)
    other = Episode(PlaneProblem(Simulator(disturbed, config)), np.random.default_rng(2))
    assert far.sum() > 50 and other.turn.depth_error != episode.turn.depth_error
    np.testing.assert_array_equal(other.observed_cloud, episode.observed_cloud)
    one, two = (MADE[name]().move(either.observed_cloud, either.turn.positions, 0, 12)
                for either in (episode, other))
    np.testing.assert_array_equal(one, two)
    assert np.abs(one).max() > 0.0


CRUMB = {'a crumb': np.random.default_rng(0).uniform(0.0, 0.1, (300, 3)),
         'few points': np.random.default_rng(0).uniform(0.0, 3.0, (20, 3))}


@pytest.mark.parametrize('kind', [*flat_clouds(), *CRUMB])
@pytest.mark.parametrize('name', MADE)
def test_clouds_that_are_no_room_do_no_harm(name, kind):
    online, cloud = MADE[name](), (flat_clouds() | CRUMB)[kind].astype(np.float32)
    positions = np.array([[1.0, 1.0, 1.9], [1.5, 1.0, 1.9], [1.0, 1.5, 1.9], [2.0, 2.0, 1.9]])
    for turn in (0, 1, 11):
        moves = online.move(cloud, positions, turn, 12)
        assert moves.shape == (4, 2) and np.isfinite(moves).all()
        assert np.linalg.norm(moves, axis=1).max() <= MAX_STEP + 1e-9


@pytest.mark.parametrize('turns', [1, 2, 3])
def test_lookahead_plays_short_episodes_of_one_camera(turns, room):
    config = SimulationConfig(rig=RigConfig(cameras=1), episode=EpisodeConfig(turns=turns))
    problem = PlaneProblem(Simulator(room, config))
    outcome = play(Lookahead(*settings()), Episode(problem, np.random.default_rng(0)))
    assert outcome.trajectory.shape == (turns + 1, 1, 3)
    assert np.isfinite(outcome.depth_error).all()


def test_cells_keep_their_numbers_while_the_bounds_grow():
    small = np.array([[-1.2, 0.3, 0.0], [2.1, 3.0, 2.5]])
    large = small + [[-1.7, -0.4, -0.1], [3.3, 0.2, 0.6]]
    centres, numbers, edge = cells_of_the_air(small)
    more, more_numbers, _ = cells_of_the_air(large)
    assert edge == 0.5
    assert len(set(more_numbers)) == len(more_numbers) > len(numbers)
    place = {number: tuple(centre) for number, centre in zip(more_numbers, more)}
    assert all(place[number] == tuple(centre) for number, centre in zip(numbers, centres))
    assert (centres >= small[0]).all() and (centres <= small[1]).all()


def test_a_huge_cloud_has_no_more_cells_than_it_may():
    centres, numbers, edge = cells_of_the_air(np.array([[0.0] * 3, [200.0, 150.0, 4.0]]))
    assert edge > 0.5 and 1000 < len(numbers) <= 20_000 and len(centres) == len(numbers)


def test_what_was_covered_stays_covered(room):
    corner = room.bounds[0] + [0.6, 0.6, 1.9]
    model, memory = PartialMap(room.points, corner[None], MAX_RANGE, 6000, 32), LookHistory()
    left = []
    for position in (corner, room.bounds[1] - [0.6, 0.6, 0.8], corner):
        memory.visit(position[None])
        left.append(memory.unseen(model))
    assert not (left[1] & ~left[0]).any() and (left[1] != left[0]).any()
    np.testing.assert_array_equal(left[2], left[1])


def test_what_was_covered_stays_covered_when_cells_grow():
    hall = box_room(40.0, 30.0, 4.0).points
    corner, memory, here = hall[(hall[:, 0] < 20.0) & (hall[:, 1] < 20.0)], LookHistory(), (
        np.array([[10.0, 10.0, 2.0]]))
    small, large = (PartialMap(cloud, here, 8.0, 6000, 32) for cloud in (corner, hall))
    assert (small.edge, large.edge) == (0.5, 1.0)
    memory.visit(here)
    memory.unseen(small)
    fresh = LookHistory()
    fresh.visit(here)
    # Whoever saw the whole hall from the beginning remembers nearly the same.
    one, other = (unpack(found.unseen(large), len(large.cells)) for found in (memory, fresh))
    seen = ~other & (large.cells != NO_CELL)
    assert seen.sum() > 300 and (one != other).sum() < 0.25 * seen.sum()


def test_thinned_clouds_stay_where_they_were():
    cloud = np.random.default_rng(0).uniform(0.0, 5.0, (9000, 3)).astype(np.float32)
    few = thinned(cloud, 500)
    assert 250 < len(few) <= 500
    # No corner of the cube is left without points.
    for corner in np.stack(np.meshgrid([0, 5], [0, 5], [0, 5]), axis=-1).reshape(-1, 3):
        assert np.linalg.norm(few - corner, axis=1).min() < 1.5
    assert thinned(few, 500) is few
