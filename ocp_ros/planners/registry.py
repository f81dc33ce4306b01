# SPDX-License-Identifier: Apache-2.0
"""
All planners by their names.

``OFFLINE`` ones are given a scan and a budget of evaluations, ``ONLINE`` ones a rig, turns and
what the rig has seen.
"""

from collections.abc import Callable

import numpy as np

from ocp_ros.planners.annealing import FixedAnnealing, TransDimensionalAnnealing
from ocp_ros.planners.bees import BeeColony
from ocp_ros.planners.evolution import CmaEs, DifferentialEvolution, WarmCmaEs
from ocp_ros.planners.greedy import GreedyCoverage, GreedyError, GreedySwap
from ocp_ros.planners.lookahead import Lookahead
from ocp_ros.planners.online import HandRule, Learned, Online, ThenLookahead
from ocp_ros.planners.planner import Planner
from ocp_ros.planners.simple import Random, RegularGrid
from ocp_ros.planners.swarm import BinaryParticleSwarm
from ocp_ros.resources import find_model
from ocp_ros.simulation.config import SimulationConfig
from ocp_ros.simulation.space import Space

#: Turns of lookahead after those of the policy.
REFINING_TURNS = 18


def _settings(config: SimulationConfig, rng: np.random.Generator) -> tuple:
    """Return what every online planner is told of its rig."""
    return (rng, config.episode.max_step, float(config.rig.ranges.max()),
            config.episode.wall_margin)


def _learned(config: SimulationConfig, rng: np.random.Generator) -> Learned:
    """Return the policy that comes with the package."""
    # Only here: PyTorch takes longer to start than most searches.
    from ocp_ros.agent.checkpoint import Checkpoint
    from ocp_ros.agent.policy import Policy
    return Learned(Policy(Checkpoint.load(find_model('default'))), *_settings(config, rng))


def _learned_lookahead(config: SimulationConfig, rng: np.random.Generator) -> ThenLookahead:
    """Return the policy with lookahead in the last turns."""
    return ThenLookahead(_learned(config, rng), Lookahead(*_settings(config, rng)),
                         REFINING_TURNS)


def _learned_cma_es(space: Space, rng: np.random.Generator, budget: int) -> WarmCmaEs:
    """Return CMA-ES that begins where the policy has gone, in the turns it was trained for."""
    config = SimulationConfig()
    return WarmCmaEs(_learned(config, rng), config.episode, space, rng, budget)


OFFLINE: dict[str, Callable[[Space, np.random.Generator, int], Planner]] = {
    'random': Random,
    'regular_grid': RegularGrid,
    'greedy_coverage': GreedyCoverage,
    'greedy_error': GreedyError,
    'greedy_swap': GreedySwap,
    'tdsa': TransDimensionalAnnealing,
    'annealing': FixedAnnealing,
    'bpso': BinaryParticleSwarm,
    'bee_colony': BeeColony,
    'differential_evolution': DifferentialEvolution,
    'cma_es': CmaEs,
    'learned_cma_es': _learned_cma_es,
}

#: What planners know of a room; what is not named here knows the scores of its placements.
KNOWS = {
    **dict.fromkeys(('greedy_coverage', 'greedy_error'), 'scores of places on a grid'),
    'greedy_swap': 'scores, at first of places on a grid',
    'tdsa': 'scores, also of fewer cameras',
    'bpso': 'scores of places on a grid',
    'learned_cma_es': 'scores, and what its placements see',
}

ONLINE: dict[str, Callable[[SimulationConfig, np.random.Generator], Online]] = {
    'hand_rule': lambda config, rng: HandRule(*_settings(config, rng)),
    'learned': _learned,
    'lookahead': lambda config, rng: Lookahead(*_settings(config, rng)),
    'learned_lookahead': _learned_lookahead,
}
