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
Table of all planners by name, with the input of each planner.

Planners of other packages are in the same table: a package declares its classes as entry points of
the group ``ocp_ros.planners``. They are loaded with this module, in this process and in each
worker. A program adds its own planners by :func:`register_planner`.
"""

from collections.abc import Callable
from importlib.metadata import entry_points
import logging
import os
import re
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import Online, settings_of
from ocp_ros.rig.rig_file import Rig
from ocp_ros.search.annealing import TransDimensionalAnnealing
from ocp_ros.search.greedy import GreedyCoverage, GreedyError, GreedySwap, Random, RegularGrid
from ocp_ros.search.planner import Planner
from ocp_ros.search.population import (
    BeeColony,
    BinaryParticleSwarm,
    CmaEs,
    DifferentialEvolution,
)
from ocp_ros.search.rig_search import search
from ocp_ros.simulation.simulation_config import EpisodeConfig
from ocp_ros.util.files import printable
from ocp_ros.util.resources import DEFAULT_MODEL, find_model
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.yaml_files import nearest

#: The default planner.
RIG_SEARCH = 'rig_search'
#: Input of a planner: the scan itself, the scores of its proposals, or the observed cloud.
SCAN, SCORES, OBSERVED = 'the scan', 'scores', 'observed points'
#: Names of the references of a comparison, which are not planners.
REFERENCES = ('random_placement', 'truth_search')

_log = logging.getLogger(__name__)


class RegisteredPlanner(NamedTuple):
    """
    A planner of the table.

    :ivar input_kind: input of the planner: ``SCAN``, ``SCORES`` or ``OBSERVED``.
    :ivar make: for ``SCAN``, a function that returns the result, such as
        :func:`~ocp_ros.search.rig_search.search`; for ``SCORES``, creates a
        :class:`~ocp_ros.search.planner.Planner` from a space, a random generator and a budget; for
        ``OBSERVED``, creates an :class:`~ocp_ros.online.online_planner.Online` from an episode
        configuration, a rig, a random generator and weights (path or name).
    """

    input_kind: str
    make: Callable[..., Any]


def _maker_without_weights(planner: type[Online]) -> Callable[..., Online]:
    """Return a function that creates an online planner and ignores the weights."""
    def make(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator, model: str = ''
             ) -> Online:
        return planner(*settings_of(episode, rig, rng))

    return make


def _make_learned(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator,
                  model: str = DEFAULT_MODEL) -> Online:
    """Create the online planner of a trained policy."""
    # Imported only here: the import of PyTorch takes longer than most searches.
    from ocp_ros.policy.checkpoint import Checkpoint
    from ocp_ros.policy.learned import Learned
    from ocp_ros.policy.policy import Policy
    policy = Policy(Checkpoint.load(find_model(model)))
    return Learned(policy, *settings_of(episode, rig, rng))


PLANNERS = {name: RegisteredPlanner(*planner) for name, planner in {
    RIG_SEARCH: (SCAN, search),
    'random': (SCORES, Random),
    'regular_grid': (SCORES, RegularGrid),
    'greedy_coverage': (SCORES, GreedyCoverage),
    'greedy_error': (SCORES, GreedyError),
    'greedy_swap': (SCORES, GreedySwap),
    'tdsa': (SCORES, TransDimensionalAnnealing),
    'bpso': (SCORES, BinaryParticleSwarm),
    'bee_colony': (SCORES, BeeColony),
    'differential_evolution': (SCORES, DifferentialEvolution),
    'cma_es': (SCORES, CmaEs),
    'learned': (OBSERVED, _make_learned),
    'lookahead': (OBSERVED, _maker_without_weights(Lookahead))}.items()}


def planner_names(*input_kinds: str) -> tuple[str, ...]:
    """
    Return the names of planners.

    :param input_kinds: some of ``SCAN``, ``SCORES`` and ``OBSERVED``; none for all planners.
    """
    return tuple(name for name, planner in PLANNERS.items()
                 if not input_kinds or planner.input_kind in input_kinds)


def check_planner(name: str, counting: bool = False) -> None:
    """
    Check that a planner exists and supports the task.

    :param counting: whether the task is to choose the number of cameras.
    :raises ConfigurationError: if it does not; the message begins with the option.
    """
    # A name of any type can be compared with the names in a tuple; a dict needs a hashable one.
    if name not in tuple(PLANNERS):
        raise ConfigurationError(
            f'--planner: found {name!r}; expected one of {", ".join(PLANNERS)}; '
            f'{nearest(str(name), PLANNERS, "choose one of them")}')
    if counting and PLANNERS[name].input_kind == OBSERVED:
        raise ConfigurationError(
            f'--count: found auto with --planner {name}, which moves the cameras there are and '
            'compares no numbers of them; expected a number; name one, or a planner that '
            f'searches a scan, such as {RIG_SEARCH}')


def register_planner(name: str, planner: type[Planner] | type[Online]) -> None:
    """
    Add a planner to the table, for commands and calls.

    The planner is added only in this process; worker processes load the planners of entry points.

    :param name: unique; a letter, then letters, digits and _.
    :param planner: a subclass of :class:`~ocp_ros.search.planner.Planner` or of
        :class:`~ocp_ros.online.online_planner.Online` with the same constructor arguments.
    :raises ConfigurationError: if the name is invalid or in use, or the class is of neither type.
    """
    if not isinstance(name, str) or not re.fullmatch(r'[A-Za-z]\w*', name, re.ASCII):
        raise ConfigurationError(f'planner: found the name {name!r}; expected letters, digits and '
                                 '_, a letter first; choose another')
    if name in (*PLANNERS, *REFERENCES):
        raise ConfigurationError(f'planner: found the name {name!r}, which another planner has; '
                                 'expected one of its own; choose another')
    # The class has to be derived from one of the two, and must not lack methods.
    bases = [base for base in (Planner, Online)
             if isinstance(planner, type) and issubclass(planner, base)]
    if len(bases) != 1 or getattr(planner, '__abstractmethods__', ()):
        raise ConfigurationError(
            f'planner {name}: found {printable(repr(planner))}; expected a class that is derived '
            'from Planner (offline) or Online and has all their methods; see docs/tasks/python.md')
    PLANNERS[name] = (RegisteredPlanner(SCORES, planner) if issubclass(planner, Planner)
                      else RegisteredPlanner(OBSERVED, _maker_without_weights(planner)))


def _load_plugins() -> None:
    """Register the planners of installed packages; skip a broken planner with a warning."""
    # This environment variable has the names of broken planners for which a warning was given.
    variable = 'OCP_ROS_BROKEN_PLANNERS'
    warned = [name for name in os.environ.get(variable, '').split(',') if name]
    for entry in entry_points(group='ocp_ros.planners'):
        try:
            register_planner(entry.name, entry.load())
        except (Exception, SystemExit) as error:  # Another package may raise any error.
            # Worker processes load the planners too and inherit the variable.
            if entry.name not in warned:
                reason = printable(f'{type(error).__name__}: {error}')[:300]
                _log.warning(
                    'planner %s: found the entry point %s of %s, which cannot be used (%s); going '
                    'on without it; mend or remove that package', printable(entry.name),
                    printable(entry.value), entry.dist.name if entry.dist else 'a package', reason)
            warned.append(entry.name)
    if warned:
        os.environ[variable] = ','.join(warned)


_load_plugins()
