# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Planners that know only what has been seen, played with a rig under all its constraints.

The room is a simulation: a turn shows what the cameras see from where they are, and each target is
held to the rig and each camera turned as ``policy_node`` does it. Where the cameras end they are
mounted.
"""

from dataclasses import replace

import numpy as np

from ocp_ros.planners.budget import Budget
from ocp_ros.planners.candidate_pool import check_room, Pool
from ocp_ros.planners.pose_decoder import Decoder
from ocp_ros.planners.registry import ONLINE
from ocp_ros.planners.rig_search import Answer, Progress, views_of
from ocp_ros.planners.rollout import play
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import described, Problem
from ocp_ros.util.resources import DEFAULT_MODEL


def play_online(name: str, problem: Problem, pool: Pool, budget: Budget, seed: int,
                progress: Progress | None = None, model: str = DEFAULT_MODEL) -> Answer:
    """
    Find a placement of a rig's cameras by an online planner.

    :param name: of ``ONLINE``.
    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param budget: a turn is an evaluation; more turns than an episode has are not played, and
        fewer only if it is stopped.
    :param seed: random seed.
    :param progress: called after each turn.
    :param model: weights of those that have learned: path or name.
    :raises ConfigurationError: if there is no placement.
    """
    check_room(problem.objective, pool)
    config = replace(problem.simulator.config, rig=described(problem.rig))
    online = ONLINE[name](config, np.random.default_rng([seed, 1]), model)
    episode = Episode(problem, np.random.default_rng([seed, 0]))
    turns = min(episode.config.turns, budget.evaluations or episode.config.turns)
    episode.config = replace(episode.config, turns=turns)

    def over(turn: int) -> bool:
        if progress is not None:
            progress(turn / turns, np.inf)
        # The clock cuts no episode short: it takes seconds, where candidates may take longer.
        return budget.stopped

    play(online, episode, over)
    sites = Decoder(problem, pool)(episode.turn.positions, episode.turn.headings)
    loss = problem.objective.loss(views_of(sites))
    return Answer(sites, loss, (loss,), episode.turn.step)
