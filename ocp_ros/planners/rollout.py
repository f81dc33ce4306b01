# SPDX-License-Identifier: Apache-2.0
"""Episodes that online planners play: the time step of :mod:`ocp_ros.planners.step`, repeated."""

from collections.abc import Callable
from dataclasses import dataclass
import time

import numpy as np

from ocp_ros.agent.heading_planner import MAX_TURN
from ocp_ros.agent.rig_state import RigState
from ocp_ros.planners.online_planner import Online
from ocp_ros.planners.step import Limits, OnlineStep
from ocp_ros.simulation.episode import Episode


@dataclass(frozen=True)
class Outcome:
    """
    An episode that an online planner has played.

    :ivar trajectory: (T + 1, K, 3) metres: where the cameras were, the start first.
    :ivar depth_error: (T + 1,) metres, of the placement at each of these.
    :ivar seconds: (T,) how long each step took.
    """

    trajectory: np.ndarray
    depth_error: np.ndarray
    seconds: np.ndarray


def play(online: Online, episode: Episode,
         clock: Callable[[], float] = time.perf_counter) -> Outcome:
    """
    Play an episode to its end.

    :param online: moves the cameras; it is reset first.
    :param episode: a new one, of omnidirectional cameras on a plane.
    :param clock: tells the seconds.
    """
    config, models = episode.config, episode.simulator.models
    step = OnlineStep(online, Limits(config.max_step, MAX_TURN, config.wall_margin))
    step.reset()
    states, seconds = [episode.turn], []
    while not episode.turn.truncated:
        turn = episode.turn
        placement = np.hstack([turn.positions, turn.headings])
        state = RigState(placement, models * (len(placement) // len(models)), len(placement))
        cloud = episode.observed_cloud
        began = clock()
        command = step(cloud, state, turn.step, config.turns)
        seconds.append(clock() - began)
        states.append(episode.move((command.placement - placement)[:, :2]))
    return Outcome(np.array([state.positions for state in states]),
                   np.array([state.depth_error for state in states]), np.array(seconds))
