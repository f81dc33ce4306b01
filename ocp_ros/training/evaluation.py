# SPDX-License-Identifier: Apache-2.0
"""What a way of moving the cameras ends with, in rooms it has not seen."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.config import SimulationConfig
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.moves import bounded_moves
from ocp_ros.simulation.simulator import Simulator

#: (cloud seen so far (M, 3), camera positions (K, 3), rng) -> actions (K, 2) in [-1, 1].
Act = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]


class Outcome(NamedTuple):
    """Depth error, in metres, and space coverage, in cubic metres, of one episode's two ends."""

    scene: str
    depth_error_start: float
    depth_error_end: float
    space_coverage_start: float
    space_coverage_end: float


def random_moves(cloud: np.ndarray, positions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Move every camera at random: the control that learning has to beat."""
    return rng.uniform(-1.0, 1.0, (len(positions), 2))


def simulators(scenes: Sequence[Scene], config: SimulationConfig) -> list[Simulator]:
    """Prepare the engine for each scene."""
    return [Simulator(scene, config) for scene in scenes]


def play(act: Act, simulator: Simulator, seed: int) -> Outcome:
    """
    Play one episode; the start depends on the seed alone, never on what ``act`` draws.

    :param act: what moves the cameras.
    :param simulator: the engine for one scene.
    :param seed: of the start and of ``act``.
    """
    episode = Episode(simulator, np.random.default_rng([seed, 0]))
    rng, start = np.random.default_rng([seed, 1]), episode.turn
    while not episode.turn.truncated:
        actions = act(episode.observed_cloud, episode.turn.positions, rng)
        episode.move(bounded_moves(actions, episode.config.max_step))
    return Outcome(simulator.scene.name, start.depth_error, episode.turn.depth_error,
                   start.space_coverage, episode.turn.space_coverage)


def evaluate(act: Act, engines: Sequence[Simulator], seed: int = 0) -> dict[str, float]:
    """
    Play one episode in each room.

    :returns: mean depth error at start and end (metres), their ratio, and mean space coverage at
        the end (cubic metres).
    """
    outcomes = [play(act, engine, seed + i) for i, engine in enumerate(engines)]
    start = float(np.mean([o.depth_error_start for o in outcomes]))
    end = float(np.mean([o.depth_error_end for o in outcomes]))
    return {'depth_error_start': start, 'depth_error_end': end, 'ratio': end / start,
            'space_coverage_end': float(np.mean([o.space_coverage_end for o in outcomes]))}
