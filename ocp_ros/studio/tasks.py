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

"""Searches that the page starts: they run in a thread and hand over each better placement."""

from collections.abc import Callable, Iterator
import logging
from threading import Thread
from typing import NamedTuple

import numpy as np
from ocp_ros.report.facts import one_more_line
from ocp_ros.report.findings import improvements
from ocp_ros.rig.placement_file import ANGLES
from ocp_ros.rig.rig_file import Rig
from ocp_ros.search.budget import Budget
from ocp_ros.search.candidate_pool import check_regions, MountedCamera, pool_of
from ocp_ros.search.plan import plan
from ocp_ros.search.pose_annealing import SearchResult
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.search.registry import RIG_SEARCH
from ocp_ros.simulation.problem import Problem
from ocp_ros.studio.model import Evaluation, Studio
from ocp_ros.studio.state import changed_rig, State
from ocp_ros.util.settings import ConfigurationError, UserError

#: Shares of the time of the searches that follow one another; each begins from the best so far,
#: and the page shows what it has found.
ROUNDS = (0.15, 0.3, 0.55)

_log = logging.getLogger(__name__)


class Progress(NamedTuple):
    """
    News of a task.

    :ivar share: done, from 0 to 1.
    :ivar said: a sentence for a person; empty for none.
    :ivar poses: (K, 6) a better placement, metres, map frame, and radians; None if there is none.
    :ivar over: whether the task has ended.
    """

    share: float
    said: str = ''
    poses: np.ndarray | None = None
    over: bool = False


class Task:
    """
    A task in a thread of its own.

    :param work: is called with the budget, and yields news.
    :param seconds: largest duration; the work may need less.
    :param report: is called with all news.
    """

    def __init__(self, work: 'Work', seconds: float,
                 report: Callable[[Progress], None]) -> None:
        self.budget, self.report = Budget(seconds), report
        self._work = work
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the work at its next step; it keeps what it has found."""
        self.budget.stop()

    def join(self) -> None:
        """Wait for the end."""
        self._thread.join()

    def _run(self) -> None:
        """Do the work, and report its news and its errors."""
        said = ''
        try:
            for news in self._work(self):
                self.report(news)
                said = news.said or said
        except (UserError, OSError) as error:
            said = str(error)
        except Exception as error:  # The page goes on.
            _log.exception('a task of the studio failed')
            said = f'found an error in this task ({type(error).__name__}: {error}); do it again'
        self.report(Progress(1.0, said, over=True))


#: The work of a task: is called with it, and yields news.
Work = Callable[[Task], Iterator[Progress]]


def searched(studio: Studio, state: State, from_here: bool) -> Work:
    """
    Return a task that searches for better poses; locked cameras stay.

    :param state: the placement at the start.
    :param from_here: whether the search begins from this placement.
    """
    def work(task: Task) -> Iterator[Progress]:
        free = [k for k, name in enumerate(state.names) if name not in state.locked]
        problem = studio.problem_of(_rig_of_free(state, free))
        pool = pool_of(problem, task.budget)
        check_regions(problem.objective, pool)
        best = _start(studio, problem, state, free) if from_here else ()
        found: SearchResult | None = None
        proved: Certificate | None = None
        done, seconds = 0.0, task.budget.seconds
        for number, part in enumerate(ROUNDS):
            def progress(share: float, loss: float, done: float = done, part: float = part
                         ) -> None:
                task.report(Progress(done + part * min(share, 1.0),
                                     f'searching: objective value {loss:.4f}'
                                     if np.isfinite(loss) else ''))
            found = plan(problem, task.budget.restarted(part * seconds), RIG_SEARCH, pool, number,
                         best, progress)
            best, done = found.sites, done + part
            proved = max(filter(None, (proved, found.certificate)),
                         key=lambda known: known.bound, default=None)
            poses = state.poses.copy()
            poses[free] = found.poses
            yield Progress(done, f'found the objective value {found.loss:.4f}', poses)
            if task.budget.stopped:
                break
        if proved is not None and len(free) == len(state.names):
            studio.prove(state.rig, proved)
        elif proved is None:
            yield Progress(1.0, f'found the objective value {found.loss:.4f}; how far from the '
                                f'best is not known: {found.uncertain}')
    return work


def _rig_of_free(state: State, free: list[int]) -> Rig:
    """Return the rig in which the locked cameras are in place."""
    if not free:
        raise ConfigurationError('cameras: found all of them locked; expected one at least that '
                                 'may move; unlock one')
    data = state.rig.document.data
    locked = [{**entry, 'position': pose[:3].tolist(),
               **dict(zip(ANGLES, np.rad2deg(pose[3:]).tolist()))}
              for k, (entry, pose) in enumerate(zip(data['cameras'], state.poses))
              if k not in free]
    return changed_rig(state.rig, cameras=[data['cameras'][k] for k in free],
                   fixed=[*data.get('fixed', []), *locked])


def _start(studio: Studio, problem: Problem, state: State, free: list[int]
           ) -> tuple[MountedCamera, ...]:
    """Return the free cameras at their poses, or at the nearest allowed ones; () if none is."""
    placed = State(problem.rig, state.poses[free])
    for camera, pose in enumerate(placed.poses.copy()):
        if not problem.region.allowed(pose[None], problem.rig.models[camera])[0]:
            evaluation = Evaluation(problem, placed, ())
            if (near := studio.nearest_allowed(evaluation, camera)) is None:
                return ()
            placed.poses[camera] = near
    if problem.region.broken(placed.poses):
        return ()
    return tuple(MountedCamera(pose, view)
                 for pose, view in zip(placed.poses, problem.look(placed.poses)))


def best_addition(evaluation: Evaluation, add: Callable[[str, np.ndarray], None]
                  ) -> Work:
    """
    Return a task that finds the best pose of one more camera.

    :param add: is called with the name of a camera of the same model and the pose.
    """
    def work(_: Task) -> Iterator[Progress]:
        yield Progress(0.1, 'comparing poses of one more camera')
        found = improvements(evaluation.problem, evaluation.state.poses, evaluation.views)
        if (more := found['one_more']) is not None:
            like = next(camera.name for camera in evaluation.state.rig.cameras
                        if (camera.sensor or camera.name) == more['sensor'])
            add(like, np.array([*more['position'],
                                *np.deg2rad([more[angle] for angle in ANGLES])]))
        yield Progress(1.0, one_more_line(more))
    return work


def least_useful(evaluation: Evaluation) -> tuple[int, float]:
    """
    Return the camera without which the objective value is the least, and that value.

    :raises ConfigurationError: if there is one camera only.
    """
    views = evaluation.views
    if len(views) < 2:
        raise ConfigurationError('cameras: found one; expected two or more, of which one can be '
                                 'left out; add another first')
    losses = [evaluation.objective.loss([*views[:k], *views[k + 1:]]) for k in range(len(views))]
    camera = int(np.argmin(losses))
    return camera, losses[camera]
