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

"""
Planners without a scan: they keep the rules, know only what was seen, and get somewhere.

A step is thought about while the cameras move, and holds all the same.
"""

from copy import deepcopy
from dataclasses import replace
from functools import cache
import itertools

from conftest import flat_clouds, random_checkpoint
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.visibility import FINE
from ocp_ros.online import lookahead
from ocp_ros.online.candidate_sites import Candidates
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import (
    MIN_PIPELINED_TURNS,
    Online,
    PipelinedPlanner,
    settings_of,
)
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import RigState
from ocp_ros.online.step import OnlineStep, play, state_of
from ocp_ros.policy.agent_config import AgentConfig, CLOUD
from ocp_ros.policy.learned import Learned
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.free_plane import FINE_CELL_M
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem, Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, EpisodeLimits, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
import pytest

pytestmark = pytest.mark.usefixtures('quick_lookahead')
MAX_STEP, MAX_RANGE, MARGIN = 0.5, 4.0, 0.1
#: Three cameras cannot see all of the small room: where they stand makes a difference.
CONFIG = SimulationConfig(rig=RigConfig(cameras=3, max_range=MAX_RANGE),
                          episode=EpisodeConfig(turns=12, max_step=MAX_STEP))
#: A rig whose cameras are turned as well.
RIG = rig_of(2, 'realsense_d455', mount={'on': 'plane', 'height': 1.9, 'footprint': 0})


class Wanderer(Online):
    """Random moves: the control."""

    def move(self, cloud, positions, turn, turns):
        """Move at random."""
        return self.random_walk(cloud, positions)


def settings(rng=None):
    """Return what every online planner is made with."""
    return rng or np.random.default_rng(0), MAX_STEP, MAX_RANGE, MARGIN


MADE = {
    'wanderer': Wanderer,
    'learned': lambda *given, **known: Learned(
        Policy(random_checkpoint(AgentConfig(CLOUD), seed=1, **known)), *given),
    'lookahead': Lookahead}


@pytest.fixture(scope='module')
def engine(room):
    """Return the engine of the small room."""
    return Simulator(room, CONFIG)


def episode_of(engine, seed, turns=CONFIG.episode.turns):
    """Return an episode of that room."""
    config = replace(CONFIG, episode=EpisodeConfig(turns=turns, max_step=MAX_STEP))
    return Episode(PlaneProblem(Simulator(engine.scene, config)), np.random.default_rng(seed))


@pytest.fixture(scope='module')
def outcome_of(engine):
    """Return what plays the episode of a planner once: all planners start alike."""
    @cache
    def played(name):
        online, sent = MADE[name](*settings()), []
        move = online.move

        def kept(cloud, positions, turn, turns):
            moves = move(cloud, positions, turn, turns)
            # Where it sent cameras, and how far was seen.
            sent.append((positions[:, :2] + moves, cloud[:, :2].min(axis=0),
                         cloud[:, :2].max(axis=0)))
            return moves

        online.move = kept
        return play(online, episode_of(engine, 5)), sent
    return played


@pytest.mark.parametrize('name', MADE)
def test_an_episode_is_played_to_its_end_by_the_rules(name, outcome_of, engine):
    outcome, sent = outcome_of(name)
    assert outcome.trajectory.shape == (13, 3, 3) and len(sent) == 12
    assert outcome.depth_error.shape == (13,) and outcome.seconds.shape == (12,)
    assert (outcome.seconds > 0.0).all()
    steps = np.linalg.norm(np.diff(outcome.trajectory, axis=0), axis=2)
    assert steps.max() <= MAX_STEP + 1e-9
    np.testing.assert_allclose(outcome.trajectory[..., 2], engine.height)
    for at in (0, -1):
        assert engine.evaluate(outcome.trajectory[at]).depth_error == outcome.depth_error[at]
    for places, low, high in sent:
        assert (places >= low + MARGIN - 1e-6).all() and (places <= high - MARGIN + 1e-6).all()


@pytest.mark.parametrize('name', ['learned', 'lookahead'])
def test_a_seed_gives_the_same_episode_and_a_reset_forgets_it(name, engine, outcome_of):
    rng = np.random.default_rng(0)
    online = MADE[name](*settings(rng))
    first = play(online, episode_of(engine, 5))
    np.testing.assert_array_equal(first.trajectory, outcome_of(name)[0].trajectory)
    fresh = MADE[name](*settings(deepcopy(rng)))
    one, other = (play(planner, episode_of(engine, 9, turns=4)) for planner in (online, fresh))
    np.testing.assert_array_equal(one.trajectory, other.trajectory)


@pytest.mark.parametrize('turns', [3, CONFIG.episode.turns, MIN_PIPELINED_TURNS])
def test_a_policy_explores_and_a_better_plan_follows(engine, turns):
    """
    In many turns the plan is made in parts meanwhile, and the policy goes on for two more.

    In few turns, cameras that would see nothing new explore instead.
    """
    online, walks = MADE['learned'](*settings()), []
    online.explorer = Wanderer(*settings())
    walk = online.explorer.move
    online.explorer.move = lambda *turn: (walks.append(turn), walk(*turn))[1]
    errors = play(online, episode_of(engine, 5, turns)).depth_error
    pipelined = turns >= MIN_PIPELINED_TURNS
    assert len(walks) == np.ceil(0.6 * turns) + 2 * pipelined
    assert [turn for *_, turn, _ in walks] == list(range(len(walks)))
    # The policy's own moves are carried out, and the end is better than all they lead to.
    trail = play(Wanderer(*settings()), episode_of(engine, 5, turns)).depth_error
    if pipelined:
        np.testing.assert_array_equal(errors[:len(walks) + 1], trail[:len(walks) + 1])
    assert errors[-1] < trail.min() * (1.0 if turns == 3 else 0.5)


@pytest.mark.parametrize('name', ['learned', 'lookahead'])
def test_real_cameras_wait_for_no_plan_and_are_placed_all_the_same(engine, name):
    """Interrupted at once, the planner does a part of its work in each turn."""
    ends, work = [], []
    for limit in (10 ** 6, 0):
        asked, waits = itertools.count(), 0
        episode, planner = episode_of(engine, 5), MADE[name](*settings())
        step = OnlineStep(planner, episode.config, at_once=True)
        think = planner._think
        planner._think = lambda *turn: work.append(turn) or think(*turn)
        while not episode.turn.truncated:
            before, state = len(work), state_of(episode)
            command = step(episode.observed_cloud, state, episode.turn.step, 12,
                           lambda: next(asked) >= limit)  # noqa: B023
            waits += len(work) > before
            step.plan_ahead(lambda: next(asked) >= limit)  # noqa: B023
            episode.move((command.placement - state.placement)[:, :3])
        # Only lookahead's first turn has no plan.
        assert waits == (name == 'lookahead')
        ends.append(episode.turn.depth_error)
    start = episode_of(engine, 5).turn.depth_error
    assert ends[0] < ends[1] < 0.7 * start


def test_a_plan_is_no_worse_than_the_places_of_the_episode_if_nothing_is_searched(
        engine, monkeypatch):
    monkeypatch.setattr(lookahead, 'TUNING', replace(
        lookahead.TUNING, proposals=0, model_turn_proposals=0))
    monkeypatch.setattr(Candidates, 'choose_greedily', lambda self: [0, 0, 0])
    monkeypatch.setattr(Candidates, 'anneal',
                        lambda self, choice, rng, parts=1: iter([choice] * parts))
    online, episode, places = MADE['learned'](*settings()), episode_of(engine, 5), []
    online.explorer = Wanderer(*settings())
    while online.targets is None:
        cloud, positions = episode.observed_cloud, episode.turn.positions
        places.append(positions)
        episode.move(online.move(cloud, positions, episode.turn.step, 12))
    model = PartialMap(cloud, positions, MAX_RANGE, *lookahead.TUNING.refining_model, FINE)
    planned, *errors = (model.error([model.look(place) for place in placement]) for placement in (
        np.column_stack([online.targets, positions[:, 2]]), *places))
    assert len(errors) == 9 and planned < min(errors)


@pytest.mark.parametrize(('domain', 'words'), [
    ({'cameras': [4, 6], 'turns': [5, 30], 'max_range': [1, 2]},
     'cameras 3 (learned: 4 to 6), max_range 4 (learned: 1 to 2);'),
    ({'cameras': [2, 3], 'turns': [12, 12], 'max_step': [0.5, 2.0], 'max_range': [3.0, 4.0]}, ''),
    # A card that says nothing readable of it.
    *((odd, '') for odd in (7, None, {'turns': 3}, {'turns': 'ab'}, {'turns': [1, 2, 3]},
                            {'turns': [0, 10 ** 400]}))])
def test_a_rig_unlike_those_that_the_weights_have_learned_is_told_of_once(
        engine, caplog, domain, words):
    online = MADE['learned'](*settings(), provenance={'domain': domain})
    episode = episode_of(engine, 5)
    for step in (0, 1):
        online.move(episode.observed_cloud, episode.turn.positions, step, 12)
    assert len(caplog.records) == bool(words) and words in caplog.text


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
    step = OnlineStep(Sent([5.0, 2.0]), EpisodeLimits(
        max_step=MAX_STEP, max_turn=0.0, wall_margin=MARGIN))
    placement = np.array([[3.0, 2.0, 1.9, 0.0, 0.0, 0.0]])
    for turn in range(MIN_PIPELINED_TURNS):
        state = RigState(placement, (CameraModel(),), 1)
        placement = step(furnished.points, state, turn, MIN_PIPELINED_TURNS).placement
    np.testing.assert_allclose(placement[0, :2], [5.0, 2.0], atol=FINE_CELL_M)


@pytest.mark.parametrize('turn', [26, 29])
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


def test_planners_end_far_better_than_they_began_and_than_random_moves(outcome_of, engine):
    final = {name: outcome_of(name)[0].depth_error[-1] for name in ('wanderer', 'lookahead')}
    assert final['lookahead'] < 0.5 * final['wanderer']
    low, high = engine.scene.bounds
    placements = np.random.default_rng(1).uniform(low + MARGIN, high - MARGIN, (300, 3, 3))
    placements[..., 2] = engine.height
    errors = np.array([engine.evaluate(one).depth_error for one in placements])
    # In twelve turns and without a scan, it does better than nearly all placements drawn at once.
    assert np.mean(errors < final['lookahead']) < 0.01


class Staying(Online):
    """Stays, and does not say where it goes."""

    def move(self, cloud, positions, turn, turns):
        """Stay."""
        return np.zeros((len(positions), 2))


@pytest.mark.parametrize('name', ['learned', 'lookahead'])
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
    one, two = (MADE[name](*settings()).move(either.observed_cloud, either.turn.positions, 0, 12)
                for either in (episode, other))
    np.testing.assert_array_equal(one, two)
    assert np.abs(one).max() > 0.0


NO_ROOMS = {**flat_clouds(), 'a crumb': np.random.default_rng(0).uniform(0.0, 0.1, (300, 3)),
            'few points': np.random.default_rng(0).uniform(0.0, 3.0, (20, 3))}


@pytest.mark.parametrize('kind', NO_ROOMS)
@pytest.mark.parametrize('name', MADE)
def test_clouds_that_are_no_room_do_no_harm(name, kind):
    online, cloud = MADE[name](*settings()), NO_ROOMS[kind].astype(np.float32)
    positions = np.array([[1.0, 1.0, 1.9], [1.5, 1.0, 1.9], [1.0, 1.5, 1.9], [2.0, 2.0, 1.9]])
    for turn in (0, 1, 11):
        moves = online.move(cloud, positions, turn, 12)
        assert moves.shape == (4, 2) and np.isfinite(moves).all()
        assert np.linalg.norm(moves, axis=1).max() <= MAX_STEP + 1e-9


@pytest.mark.parametrize('turns', [1, 3])
def test_lookahead_plays_short_episodes_of_one_camera(turns, room):
    config = SimulationConfig(rig=RigConfig(cameras=1), episode=EpisodeConfig(turns=turns))
    problem = PlaneProblem(Simulator(room, config))
    outcome = play(Lookahead(*settings()), Episode(problem, np.random.default_rng(0)))
    assert outcome.trajectory.shape == (turns + 1, 1, 3)
    assert np.isfinite(outcome.depth_error).all()


def begun(room, planner=Lookahead, max_turn=0.5):
    """Return the steps of an episode, and the episode."""
    config = SimulationConfig(engine=EngineConfig('fast', 32, 0.5))
    episode = Episode(Problem.of(room, RIG, config), np.random.default_rng(4))
    online = planner(*settings_of(config.episode, RIG, np.random.default_rng(0)))
    return OnlineStep(online, EpisodeLimits(max_turn=max_turn), RIG), episode


def steps(room, name, turns, reflects, monkeypatch, played):
    """Play some turns of an episode: commands, and at which turns somebody waited for what."""
    step, episode = begun(room, MADE[name])
    waited, commands, answering = set(), [], False

    def watched(what, name):
        plain = getattr(what, name)

        def counted(*given):
            if answering:
                waited.add((turn, name))
            return plain(*given)

        monkeypatch.setattr(what, name, counted)

    for what, name in ((step.planner, '_think'), (step.aim, 'think'),
                       (step.constraints.filter, '_update_region')):
        watched(what, name)
    for turn in range(played):
        state, answering = state_of(episode), True
        command = step(episode.observed_cloud, state, turn, turns)
        answering = False
        commands.append(command.placement)
        if reflects:
            step.plan_ahead()
        episode.move((command.placement - state.placement)[:, :3], command.placement[:, 3:])
    return np.array(commands), waited


@pytest.mark.parametrize(('name', 'first'), [('lookahead', '_think'), ('learned', 'think')])
def test_in_many_turns_only_the_first_step_is_waited_for(room, monkeypatch, name, first):
    """
    Who lets a step reflect gets the same commands without waiting for them.

    Lookahead plans headings too; while a policy explores, the heading planner does.
    """
    # Plans are refined from turn 10 on, and on a new model four turns later.
    (prompt, waited), (late, _) = (
        steps(room, name, MIN_PIPELINED_TURNS, reflects, monkeypatch, 16)
        for reflects in (True, False))
    np.testing.assert_array_equal(prompt, late)
    assert {(turn, what) for turn, what in waited if what != '_update_region'} == {(0, first)}
    # Where a camera could go nowhere, the newest points are asked as well: at first it happens.
    looked = {turn for turn, what in waited if what == '_update_region'}
    assert 0 in looked and len(looked) < 0.8 * len(prompt)
    turned = np.abs(np.diff(prompt[:, :, 3], axis=0))
    assert turned.max() > 0.1 and np.ptp(prompt[:, :, :2], axis=0).max() > 0.5
    # In few turns each step is of what is newest.
    _, waited = steps(room, 'lookahead', MIN_PIPELINED_TURNS - 1, True, monkeypatch, played=3)
    assert waited == {(turn, what) for turn in range(3) for what in ('_think', '_update_region')}


def test_a_new_episode_knows_nothing_of_the_last_one(room, monkeypatch):
    step, episode = begun(room)
    state = state_of(episode)
    step(episode.observed_cloud, state, 0, MIN_PIPELINED_TURNS)
    step.plan_ahead()
    step.reset()
    looked = []
    monkeypatch.setattr(step.constraints.filter, '_update_region',
                        lambda *given: looked.append(given))
    # The same cameras, a little beside where they were.
    beside = state._replace(placement=state.placement + [0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
    step(episode.observed_cloud, beside, 0, MIN_PIPELINED_TURNS)
    assert looked


@pytest.mark.parametrize('max_turn', [0.0, 0.3])
def test_a_planner_that_says_no_targets_is_thought_about_too(room, max_turn):
    step, episode = begun(room, Staying, max_turn)
    state = state_of(episode)
    for turn in range(3):
        command = step(episode.observed_cloud, state, turn, MIN_PIPELINED_TURNS)
        step.plan_ahead()
        assert np.array_equal(command.placement[:, :3], state.placement[:, :3])
        assert bool(command.rotated) == bool(max_turn)


def test_thinking_ends_when_the_next_step_has_waited(room):
    """What was found so far holds, and the step after is taken as ever."""
    placements, questions = [], []
    for patience in (10 ** 6, 0):
        # Whoever waits for the second step interrupts after so many questions.
        asked = itertools.count(1)
        step, episode = begun(room)
        for turn in (30, 31):
            command = step(episode.observed_cloud, state_of(episode), turn, 40)
            step.plan_ahead(lambda asked=asked, most=patience: next(asked) > most)
        placements.append(command.placement)
        questions.append(next(asked))
    assert questions[1] < questions[0]
    assert placements[0].shape == placements[1].shape and np.isfinite(placements[1]).all()
