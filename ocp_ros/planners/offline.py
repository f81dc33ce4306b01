# SPDX-License-Identifier: Apache-2.0
"""The planners that are given a scan: by name, with what each of them knows."""

from ocp_ros.planners.annealing import FixedAnnealing, TransDimensionalAnnealing
from ocp_ros.planners.bees import BeeColony
from ocp_ros.planners.evolution import CmaEs, DifferentialEvolution
from ocp_ros.planners.greedy import GreedyCoverage, GreedyError, GreedySwap
from ocp_ros.planners.planner import Planner
from ocp_ros.planners.simple import Random, RegularGrid
from ocp_ros.planners.swarm import BinaryParticleSwarm

OFFLINE: dict[str, type[Planner]] = {
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
}
