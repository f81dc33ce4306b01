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
All planners by their names.

``OFFLINE`` ones are given a scan and a budget of evaluations, ``ONLINE`` ones a rig, turns and
what the rig has seen. Those of other packages are in the same tables: a package names its classes
as entry points of the group ``ocp_ros.planners``, which are loaded with this module, here and in
each worker; a program adds its own by :func:`register_planner`.
"""

from collections.abc import Callable
from importlib.metadata import entry_points
import logging
import os
import re
from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.online.greedy_step import GreedyStep
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import Online
from ocp_ros.policy.encoder import Encoder
from ocp_ros.policy.learned import Learned
from ocp_ros.policy.map_actor import MapActor
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.rig_file import Rig
from ocp_ros.search.annealing import FixedAnnealing, TransDimensionalAnnealing
from ocp_ros.search.baselines import Random, RegularGrid
from ocp_ros.search.bee_colony import BeeColony
from ocp_ros.search.evolution import CmaEs, DifferentialEvolution
from ocp_ros.search.greedy import GreedyCoverage, GreedyError, GreedySwap
from ocp_ros.search.particle_swarm import BinaryParticleSwarm
from ocp_ros.search.planner import Planner
from ocp_ros.simulation.simulation_config import EpisodeConfig
from ocp_ros.util.resources import DEFAULT_MODEL, find_model
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.shown_text import printable

if TYPE_CHECKING:
    from ocp_ros.policy.policy import Policy, ValuePolicy

#: Entry points of packages that bring planners, and names that mean something else.
GROUP = 'ocp_ros.planners'
#: Environment variable with the names of those that cannot be used, once somebody was told so.
TOLD = 'OCP_ROS_BROKEN_PLANNERS'
TAKEN = ('rig_search', 'random_placement', 'truth_search', 'priced_plane')

_log = logging.getLogger(__name__)


def settings_of(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator) -> tuple:
    """Return what every online planner gets of its rig and its time steps."""
    return rng, episode.max_step, rig.farthest, episode.wall_margin, episode.clearance


def _without_weights(planner: type[Online]) -> Callable[..., Online]:
    """Return what makes an online planner that has no weights."""
    def make(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator, model: str = ''
             ) -> Online:
        return planner(*settings_of(episode, rig, rng))

    return make


def planned_by(policy: 'Policy | ValuePolicy', settings: tuple) -> Learned | MapActor:
    """
    Return the planner that moves cameras as a policy says.

    :param policy: from :func:`ocp_ros.policy.policy.make_policy`.
    :param settings: of :class:`~ocp_ros.online.online_planner.Online`.
    """
    from ocp_ros.policy.policy import ValuePolicy
    if isinstance(policy, ValuePolicy):
        return MapActor(policy, *settings)
    _, max_step, max_range, *margins = settings
    policy.encoder = Encoder(policy.checkpoint.config, max_range, max_step, *margins)
    return Learned(policy, *settings)


def _learned(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator,
             model: str = DEFAULT_MODEL) -> Online:
    """Return a policy."""
    # Only here: PyTorch takes longer to start than most searches.
    from ocp_ros.policy.checkpoint import Checkpoint
    from ocp_ros.policy.policy import make_policy
    policy = make_policy(Checkpoint.load(find_model(model)))
    return planned_by(policy, settings_of(episode, rig, rng))


def _learned_lookahead(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator,
                       model: str = DEFAULT_MODEL) -> Lookahead:
    """Return lookahead that a policy makes proposals to."""
    return Lookahead(*settings_of(episode, rig, rng), guide=_learned(episode, rig, rng, model))


OFFLINE: dict[str, Callable[[FreePlane, np.random.Generator, int], Planner]] = {
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

#: Time steps, a rig, the source of chance, and the weights of those that have learned: path or
#: name.
ONLINE: dict[str, Callable[..., Online]] = {
    'greedy_step': _without_weights(GreedyStep),
    'learned': _learned,
    'lookahead': _without_weights(Lookahead),
    'learned_lookahead': _learned_lookahead,
}


def register_planner(name: str, planner: type[Planner] | type[Online]) -> None:
    """
    Add a planner under a name that commands and calls know it by.

    It is known in this process alone; worker processes find those of entry points.

    :param name: letters, digits and _; no other planner has it.
    :param planner: a subclass of :class:`~ocp_ros.search.planner.Planner` or of
        :class:`~ocp_ros.online.online_planner.Online` that is made with the same arguments.
    :raises ConfigurationError: if the name is taken or none, or the class is of neither kind.
    """
    if not isinstance(name, str) or not re.fullmatch(r'[A-Za-z]\w*', name, re.ASCII):
        raise ConfigurationError(f'planner: found the name {name!r}; expected letters, digits and '
                                 '_, a letter first; choose another')
    if name in (*OFFLINE, *ONLINE, *TAKEN):
        raise ConfigurationError(f'planner: found the name {name!r}, which another planner has; '
                                 'expected one of its own; choose another')
    kinds = [kind for kind in (Planner, Online)
             if isinstance(planner, type) and issubclass(planner, kind)]
    if len(kinds) != 1 or getattr(planner, '__abstractmethods__', ()):
        raise ConfigurationError(
            f'planner {name}: found {printable(repr(planner))}; expected a class that is derived '
            'from Planner (offline) or Online and has all their methods; see docs/tasks/python.md')
    if issubclass(planner, Planner):
        OFFLINE[name] = planner
    else:
        ONLINE[name] = _without_weights(planner)


def _load_plugins() -> None:
    """Register what installed packages bring; one that is broken is left out, and is named."""
    told = [name for name in os.environ.get(TOLD, '').split(',') if name]
    for entry in entry_points(group=GROUP):
        try:
            register_planner(entry.name, entry.load())
        except (Exception, SystemExit) as error:  # A package of others may raise anything.
            # Workers load them too; one warning is enough, and they inherit that it was given.
            if entry.name not in told:
                reason = printable(f'{type(error).__name__}: {error}')[:300]
                _log.warning(
                    'planner %s: found the entry point %s of %s, which cannot be used (%s); going '
                    'on without it; mend or remove that package', printable(entry.name),
                    printable(entry.value), entry.dist.name if entry.dist else 'a package', reason)
            told.append(entry.name)
    if told:
        os.environ[TOLD] = ','.join(told)


_load_plugins()
