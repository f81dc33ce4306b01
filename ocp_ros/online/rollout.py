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

"""Rollout of an episode by an online planner: :mod:`ocp_ros.online.step`, repeated."""

from collections.abc import Callable
from dataclasses import dataclass
import time

import numpy as np
from ocp_ros.online.online_planner import Online
from ocp_ros.online.rig_state import Limits, RigState
from ocp_ros.online.step import OnlineStep
from ocp_ros.simulation.episode import Episode


def state_of(episode: Episode) -> RigState:
    """Return the current state of an episode's rig, fixed cameras included."""
    problem, rig = episode.problem, episode.problem.rig
    # An episode may place only the first cameras of the rig.
    movable = len(episode.turn.positions)
    models = (*problem.models[:movable], *problem.models[len(rig.cameras):])
    return RigState(episode.placement, models, movable, rig.pitch, clearance=rig.clearance)


@dataclass(frozen=True)
class Outcome:
    """
    Result of the rollout of an episode with K movable cameras; T time steps were taken.

    :ivar trajectory: (T + 1, K, 3) metres: positions of the cameras, the start first.
    :ivar depth_error: (T + 1,) metres, of the start and of the placement after each time step.
    :ivar seconds: (T,) duration of the computation of each command.
    """

    trajectory: np.ndarray
    depth_error: np.ndarray
    seconds: np.ndarray


def play(online: Online, episode: Episode, should_stop: Callable[[int], bool] = lambda turn: False,
         clock: Callable[[], float] = time.perf_counter) -> Outcome:
    """
    Run an episode to its end; the cameras of a rig file satisfy all constraints of the file.

    :param online: the planner that moves the cameras; it is reset first.
    :param episode: an episode before its first time step.
    :param should_stop: gets the number of time steps taken, and returns whether to end the
        episode early.
    :param clock: returns the current time, seconds.
    """
    config, rig = episode.config, episode.problem.rig
    step = OnlineStep(online, Limits(config.max_step, config.max_turn, config.wall_margin,
                                     config.clearance), rig)
    step.reset()
    turn_states, seconds = [episode.turn], []
    while not (episode.turn.truncated or should_stop(episode.turn.step)):
        state, cloud = state_of(episode), episode.observed_cloud
        start_time = clock()
        command = step(cloud, state, episode.turn.step, config.turns)
        seconds.append(clock() - start_time)
        moves = (command.placement - state.placement)[:state.movable, :3]
        turn_states.append(episode.move(moves, command.placement[:state.movable, 3:]))
    return Outcome(np.array([turn.positions for turn in turn_states]),
                   np.array([turn.depth_error for turn in turn_states]), np.array(seconds))
