# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Every planner as a method that finds a placement of a rig under all its constraints.

``rig_search`` and ``exact`` choose full poses themselves; what the others propose is decoded.
"""

from collections.abc import Sequence

from ocp_ros.planners.budget import Budget
from ocp_ros.planners.candidate_pool import Pool, Site
from ocp_ros.planners.exact import search_exact
from ocp_ros.planners.registry import OFFLINE, ONLINE
from ocp_ros.planners.rig_offline import search_offline
from ocp_ros.planners.rig_online import play_online
from ocp_ros.planners.rig_search import Answer, Progress, search, views_of
from ocp_ros.simulation.problem import Problem
from ocp_ros.util.resources import DEFAULT_MODEL
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.yaml_files import nearest

#: The planner that is used unless another is named, and the one that proves its answer.
RIG_SEARCH, EXACT = 'rig_search', 'exact'


def planner_names() -> tuple[str, ...]:
    """Return the names of all planners, those of plug-ins included."""
    return (RIG_SEARCH, *OFFLINE, EXACT, *ONLINE)


def check_planner(name: str, counting: bool = False) -> None:
    """
    Refuse a planner that does not exist, or that cannot do what is asked.

    :param counting: whether it is to find out how many cameras are needed.
    :raises ConfigurationError: one sentence that begins with the option.
    """
    known = planner_names()
    if name not in known:
        raise ConfigurationError(
            f'--planner: found {name!r}; expected one of {", ".join(known)}; '
            f'{nearest(str(name), known, "choose one of them")}')
    if counting and name in ONLINE:
        raise ConfigurationError(
            f'--count: found auto with --planner {name}, which moves the cameras there are and '
            'compares no numbers of them; expected a number; name one, or a planner that '
            f'searches a scan, such as {RIG_SEARCH}')


def find(name: str, problem: Problem, pool: Pool, budget: Budget, seed: int,
         start: Sequence[Site] = (), progress: Progress | None = None,
         model: str = DEFAULT_MODEL) -> Answer:
    """
    Find the best placement of a rig's cameras by a planner.

    :param name: one of :func:`planner_names`.
    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param budget: how long to go on.
    :param seed: random seed.
    :param start: a placement that the answer is to be no worse than, where there is one.
    :param progress: called several times a second or after each placement or turn.
    :param model: weights of online planners that have learned: path or name.
    :raises ConfigurationError: if there is no placement.
    """
    if name == RIG_SEARCH:
        return search(problem, pool, budget, seed, start, progress)
    if name == EXACT:
        found = search_exact(problem, pool, budget, seed, progress)
    elif name in ONLINE:
        found = play_online(name, problem, pool, budget, seed, progress, model)
    else:
        found = search_offline(name, problem, pool, budget, seed, progress)
    if start and (loss := problem.objective.loss(views_of(start))) < found.loss:
        return Answer(tuple(start), loss, (loss,), found.evaluations)
    return found
