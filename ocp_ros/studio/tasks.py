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

"""Tasks that the page starts, such as searches: they run in a thread and report progress."""

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
from ocp_ros.search.plan import plan, prepare_search
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.search.registry import RIG_SEARCH
from ocp_ros.simulation.problem import Problem
from ocp_ros.studio.model import changed_rig, Evaluation, State, Studio
from ocp_ros.util.settings import ConfigurationError, UserError

_log = logging.getLogger(__name__)


class Progress(NamedTuple):
    """
    A report of a task about its progress.

    :ivar share: share of the task that is done, from 0 to 1.
    :ivar message: a sentence for a person; empty if the last one stays.
    :ivar poses: (K, 6) poses of the K cameras in a better placement, metres, map frame, and
        radians; None if there is no better one since the last report.
    :ivar ended: whether the task has ended.
    """

    share: float
    message: str = ''
    poses: np.ndarray | None = None
    ended: bool = False


class Task:
    """
    A task that runs in its own thread.

    :param work: is called with this task, and yields reports.
    :param seconds: largest duration; the work may need less.
    :param report: is called with each report, in the thread of the task.
    :ivar budget: the time that is left.
    """

    def __init__(self, work: 'Work', seconds: float, report: Callable[[Progress], None]) -> None:
        self.budget = Budget(seconds)
        self.report, self._work = report, work
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the work to end at its next step, and to report what it has found."""
        self.budget.stop()

    def join(self) -> None:
        """Wait for the end of the task."""
        self._thread.join()

    def _run(self) -> None:
        """Do the work; report its progress, its errors and its end."""
        message = ''
        try:
            for progress in self._work(self):
                self.report(progress)
                message = progress.message or message
        except (UserError, OSError) as error:
            message = str(error)
        except Exception as error:  # The page goes on.
            _log.exception('a task of the studio failed')
            message = f'found an error in this task ({type(error).__name__}: {error}); do it again'
        self.report(Progress(1.0, message, ended=True))


#: The work of a task: is called with the task, and yields reports.
Work = Callable[[Task], Iterator[Progress]]


def search_work(studio: Studio, state: State) -> Work:
    """
    Return the work of searching for better poses; locked cameras stay.

    :param studio: gets the certificate, a lower bound, that the search finds.
    :param state: the placement at the start, which is one start of the search.
    """
    def work(task: Task) -> Iterator[Progress]:
        unlocked = [k for k, name in enumerate(state.names) if name not in state.locked]
        problem = studio.problem_of(_rig_of_unlocked(state, unlocked))
        yield Progress(0.0, 'loading the search')
        prepare_search()
        budget = task.budget.restarted()
        pool = pool_of(problem, budget)
        check_regions(problem.objective, pool)
        best_sites = _start_sites(studio, problem, state, unlocked)
        present_poses = state.poses.copy()
        certificate: Certificate | None = None
        done_share = 0.0
        # Each search begins from the best placement so far, which the page shows meanwhile, and
        # has a larger share of the time than the search before.
        for seed, time_share in enumerate((0.15, 0.3, 0.55)):
            # The defaults are the values of this search, as they change before the next one.
            def report(share: float, loss: float, done_share: float = done_share,
                       time_share: float = time_share) -> None:
                task.report(Progress(done_share + time_share * min(share, 1.0),
                                     f'searching: objective value {loss:.4f}'
                                     if np.isfinite(loss) else ''))
            result = plan(problem, budget.restarted(time_share * budget.seconds),
                          RIG_SEARCH, pool, seed, best_sites, report)
            best_sites = result.sites
            done_share += time_share
            # Of several lower bounds, the largest one says most.
            certificate = max(filter(None, (certificate, result.certificate)),
                              key=lambda each: each.bound, default=None)
            poses = state.poses.copy()
            poses[unlocked] = result.poses
            is_better = not np.array_equal(poses, present_poses)
            present_poses = poses
            yield Progress(done_share, f'found {"" if is_better else "no better than "}the '
                           f'objective value {result.loss:.4f}', poses if is_better else None)
            if task.budget.stopped:
                break
        # With locked cameras, the lower bound does not hold for all placements of the rig.
        if certificate is not None and len(unlocked) == len(state.names):
            studio.set_certificate(state.rig, certificate)
        elif certificate is None:
            yield Progress(1.0, f'found the objective value {result.loss:.4f}; how far from the '
                                f'best is not known: {result.uncertain}')
    return work


def _rig_of_unlocked(state: State, unlocked: list[int]) -> Rig:
    """Return a rig in which only the unlocked cameras are to be placed; the others are fixed."""
    if not unlocked:
        raise ConfigurationError('cameras: found all of them locked; expected one at least that '
                                 'may move; unlock one')
    data = state.rig.document.data
    locked = [{**entry, 'position': pose[:3].tolist(),
               **dict(zip(ANGLES, np.rad2deg(pose[3:]).tolist()))}
              for k, (entry, pose) in enumerate(zip(data['cameras'], state.poses))
              if k not in unlocked]
    return changed_rig(state.rig, cameras=[data['cameras'][k] for k in unlocked],
                       fixed=[*data.get('fixed', []), *locked])


def _start_sites(studio: Studio, problem: Problem, state: State, unlocked: list[int]
                 ) -> tuple[MountedCamera, ...]:
    """
    Return the unlocked cameras at the nearest allowed poses.

    :param problem: of a rig in which only the unlocked cameras are to be placed.
    :returns: () if a camera has no allowed pose, or if all poses together violate a constraint.
    """
    # Indexing by a list makes a copy, so the poses may be replaced below.
    poses = state.poses[unlocked]
    for camera, model in enumerate(problem.rig.models[:len(poses)]):
        if not problem.region.allowed(poses[[camera]], model)[0]:
            # Only the rig and the poses of this evaluation are used, so it needs no views.
            present = Evaluation(problem, State(problem.rig, poses), ())
            if (nearest_pose := studio.nearest_allowed(present, camera)) is None:
                return ()
            poses[camera] = nearest_pose
    if problem.region.broken(poses):
        return ()
    return tuple(MountedCamera(pose, view) for pose, view in zip(poses, problem.look(poses)))


def addition_work(evaluation: Evaluation, add: Callable[[str, np.ndarray], None]) -> Work:
    """
    Return the work of finding the best pose of one more camera.

    :param evaluation: of the present placement.
    :param add: adds the camera; is called with the name of a camera that has the same model, and
        the pose (6,), metres, map frame, and radians.
    """
    def work(_: Task) -> Iterator[Progress]:
        """Add the best further camera to the studio, if there is one."""
        yield Progress(0.1, 'comparing poses of one more camera')
        addition = improvements(evaluation.problem, evaluation.state.poses,
                                evaluation.views)['one_more']
        if addition is not None:
            # A camera without a preset of a sensor is listed under its own name.
            model_name = next(camera.name for camera in evaluation.state.rig.cameras
                              if (camera.sensor or camera.name) == addition['sensor'])
            add(model_name, np.array([*addition['position'],
                                      *np.deg2rad([addition[angle] for angle in ANGLES])]))
        yield Progress(1.0, one_more_line(addition))
    return work


def find_least_useful(evaluation: Evaluation) -> tuple[int, float]:
    """
    Find the camera whose removal leaves the least objective value.

    :returns: the number of the camera, and the objective value without it.
    :raises ConfigurationError: if there is only one camera.
    """
    views = evaluation.views
    if len(views) < 2:
        raise ConfigurationError('cameras: found one; expected two or more, of which one can be '
                                 'left out; add another first')
    losses = [evaluation.objective.loss([*views[:k], *views[k + 1:]]) for k in range(len(views))]
    camera = int(np.argmin(losses))
    return camera, losses[camera]
