# SPDX-License-Identifier: Apache-2.0
"""
Planners that know only what has been seen, played with a rig under all its constraints.

The room is a simulation: a turn shows what the cameras see from where they are, and each target is
held to the rig and each camera turned as ``policy_node`` does it. Where the cameras end they are
hung up.
"""

from collections.abc import Callable

import numpy as np

from ocp_ros.agent.heading_planner import MAX_TURN
from ocp_ros.agent.rig_state import RigState
from ocp_ros.geometry.blocks import Subset
from ocp_ros.planners.budget import Budget
from ocp_ros.planners.candidate_pool import check_room, Pool
from ocp_ros.planners.pose_decoder import Decoder
from ocp_ros.planners.registry import ONLINE
from ocp_ros.planners.rig_search import Answer, Progress, views_of
from ocp_ros.planners.step import Limits, OnlineStep
from ocp_ros.rig.feasible_region import FeasibleRegion
from ocp_ros.rig.motion import drawn_near
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import Rig
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig

#: Metres: farther than this no planner is told that cameras see.
FARTHEST = 100.0


def play_online(name: str, objective: Objective, allowed: FeasibleRegion, pool: Pool,
                budget: Budget, seed: int, progress: Progress | None = None) -> Answer:
    """
    Find a placement of a rig's cameras by an online planner.

    :param name: of ``ONLINE``.
    :param objective: judges placements of the rig.
    :param allowed: its constraints, by which the cameras are hung up at the end.
    :param pool: candidates of all its models.
    :param budget: a turn is an evaluation; more turns than an episode has are not played, and
        fewer only if it is stopped.
    :param seed: of all chance.
    :param progress: called after each turn.
    :raises ConfigurationError: if there is no placement.
    """
    check_room(objective, pool)
    decoder, config = Decoder(objective, allowed, pool), config_of(objective.rig)
    online = ONLINE[name](config, np.random.default_rng([seed, 1]))
    turns = min(config.episode.turns, budget.evaluations or config.episode.turns)
    played = 0

    def over(turn: int) -> bool:
        nonlocal played
        played = turn
        if progress is not None:
            progress(turn / turns, np.inf)
        # The clock cuts no episode short: it takes seconds, where candidates may take longer.
        return turn >= turns or budget.stopped

    start = _start(decoder, config.episode, np.random.default_rng([seed, 0]))
    limits = Limits(config.episode.max_step, MAX_TURN, config.episode.wall_margin)
    poses = rollout(OnlineStep(online, limits, objective.rig), objective, start, turns, over)
    sites = decoder(poses[:, :3], poses[:, 3:])
    loss = objective.loss(views_of(sites))
    return Answer(sites, loss, (loss,), played)


def config_of(rig: Rig) -> SimulationConfig:
    """Return what an online planner is told: how many cameras, and how far one of them sees."""
    farthest = min(max(camera.model.max_range for camera in rig.cameras), FARTHEST)
    return SimulationConfig(RigConfig(cameras=len(rig.cameras), max_range=farthest))


def _start(decoder: Decoder, config: EpisodeConfig, rng: np.random.Generator) -> np.ndarray:
    """Draw where cameras begin, as near the room's middle as they may hang: (K, 3) metres."""
    near = drawn_near(rng, len(decoder.rig.cameras), config.start_radius)
    middle = decoder.objective.simulator.scene.bounds.mean(axis=0)[:2]
    return np.array([site.pose[:3] for site in decoder(middle + near)])


def rollout(step: OnlineStep, objective: Objective, positions: np.ndarray, turns: int,
            over: Callable[[int], bool]) -> np.ndarray:
    """
    Play a rig in a room that it knows only by what it has seen.

    :param step: chooses the commands; it is reset first.
    :param objective: the room and the rig; cameras in place see, but do not move.
    :param positions: (K, 3) metres, where the cameras begin.
    :param turns: of the whole episode.
    :param over: gets the turns played so far and tells whether to end.
    :returns: (K, 6) metres and radians, where the cameras end and how they are turned.
    """
    rig, simulator = objective.rig, objective.simulator
    poses = np.hstack([positions, _headings(positions, objective)])
    order, seen = simulator.visibility.order, simulator.nothing()
    for view in objective.fixed:
        seen |= Subset(view.seen, order)
    step.reset()
    turn = 0
    while not over(turn):
        for view in objective.look(poses):
            seen |= Subset(view.seen, order)
        state = RigState(np.vstack([poses, rig.fixed_poses]), rig.models, len(poses), rig.pitch)
        command = step(simulator.scene.points[seen.mask], state, turn, turns)
        poses = command.placement[:len(poses)]
        turn += 1
    return poses


def _headings(positions: np.ndarray, objective: Objective) -> np.ndarray:
    """Turn cameras to begin with: outwards, or from walls to the middle: (K, 3) radians."""
    rig, count = objective.rig, len(positions)
    headings = np.zeros((count, 3))
    headings[:, 0] = 2.0 * np.pi * np.arange(count) / count
    if rig.mount.on == 'walls':
        way = objective.simulator.scene.bounds.mean(axis=0)[:2] - positions[:, :2]
        headings[:, 0] = np.arctan2(way[:, 1], way[:, 0])
    headings[:, 1] = np.clip(0.0, *rig.pitch)
    return headings
