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

"""A step of a rig file's cameras is thought about while they move, and holds all the same."""

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import MIN_PIPELINED_TURNS, settings_of
from ocp_ros.online.rig_state import Limits
from ocp_ros.online.rollout import state_of
from ocp_ros.online.step import OnlineStep
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
import pytest

RIG = rig_of(2, 'realsense_d455', mount={'on': 'plane', 'height': 1.9})


def begun(room, planner=Lookahead, max_turn=0.5):
    """Return the steps of an episode, and the episode."""
    config = SimulationConfig(engine=EngineConfig('fast', 32, 0.5))
    episode = Episode(Problem.of(room, RIG, config), np.random.default_rng(3))
    online = planner(np.random.default_rng(0), 0.5, 4.0, 0.1)
    return OnlineStep(online, Limits(0.5, max_turn, 0.1), RIG), episode


def steps(room, turns, reflects, monkeypatch):
    """Play an episode: commands, and at which turns somebody waited for something."""
    config = SimulationConfig(engine=EngineConfig('fast', 32, 0.5),
                              episode=EpisodeConfig(turns=turns))
    episode = Episode(Problem.of(room, RIG, config), np.random.default_rng(3))
    planner = Lookahead(*settings_of(config.episode, RIG, np.random.default_rng(0)))
    step = OnlineStep(planner, Limits(0.5, 0.5, 0.1), RIG)
    step.reset()
    waited, commands, turn = set(), [], 0

    def watched(what, name):
        plain = getattr(what, name)

        def counted(*given):
            if answering:
                waited.add((turn, name))
            return plain(*given)

        monkeypatch.setattr(what, name, counted)

    for what, name in ((planner, '_think'), (step.constraints.filter, '_update_region'),
                       (step.aim, 'think')):
        watched(what, name)
    while not episode.turn.truncated:
        turn, state, answering = episode.turn.step, state_of(episode), True
        command = step(episode.observed_cloud, state, turn, turns)
        answering = False
        commands.append(command.placement)
        if reflects:
            step.plan_ahead()
        episode.move((command.placement - state.placement)[:, :3], command.placement[:, 3:])
    return np.array(commands), waited


def test_only_the_first_step_is_waited_for(room, monkeypatch):
    prompt, waited = steps(room, MIN_PIPELINED_TURNS, True, monkeypatch)
    assert {turn for turn, name in waited if name == 'think'} == {0}
    assert {turn for turn, name in waited if name == '_think'} == {0}
    # Where a camera could go nowhere, the newest points are asked as well: at first it happens.
    assert 0 in (looked := {turn for turn, name in waited if name == '_update_region'})
    assert len(looked) < 0.75 * MIN_PIPELINED_TURNS
    late, _ = steps(room, MIN_PIPELINED_TURNS, False, monkeypatch)
    np.testing.assert_array_equal(prompt, late)
    turned = np.abs(np.diff(prompt[:, :, 3], axis=0))
    assert turned.max() > 0.1 and np.ptp(prompt[:, :, :2], axis=0).max() > 0.5


def test_in_few_turns_each_step_is_of_what_is_newest(room, monkeypatch):
    _, waited = steps(room, MIN_PIPELINED_TURNS - 1, True, monkeypatch)
    for name in ('_think', '_update_region', 'think'):
        assert (MIN_PIPELINED_TURNS - 2, name) in waited


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


class Staying(Lookahead):
    """Stays, and does not say where it goes."""

    targets = None

    def move(self, cloud, positions, turn, turns):
        """Stay."""
        return np.zeros((len(positions), 2))

    def plan_ahead(self):
        """Plan nothing."""


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
    asked = []

    def played(patience):
        """Take two steps; whoever waits for the second interrupts after so many questions."""
        step, episode = begun(room)
        asked.clear()

        def interrupted():
            asked.append(1)
            return len(asked) > patience

        for turn in (30, 31):
            command = step(episode.observed_cloud, state_of(episode), turn, 40)
            step.plan_ahead(interrupted)
        return command.placement, len(asked)

    patient, questions = played(10 ** 6)
    hurried, fewer = played(0)
    assert fewer < questions and hurried.shape == patient.shape and np.isfinite(hurried).all()
