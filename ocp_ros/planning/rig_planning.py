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

"""Plan a rig in a room: the search, the proof, and the assessment of the result."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.planning.assessment import Assessment, COLUMNS
from ocp_ros.planning.findings import evaluate_placement
from ocp_ros.rig.placement_file import created_by, data_of, Placement, placement_of
from ocp_ros.rig.rig_file import Rig, with_count
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.budget import Budget
from ocp_ros.search.pose_annealing import Progress
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.search.registry import check_planner, RIG_SEARCH
from ocp_ros.search.rig_plan import RigPlan, RigPlanner
from ocp_ros.simulation.ray_visibility import with_rays

#: Default number of cameras, and default seconds of search: for a given number of cameras, and for
#: each number if the number is chosen.
CAMERAS, SECONDS, SECONDS_EACH = 4, 60.0, 15.0
#: Default mount: cameras cannot be mounted in mid-air.
MOUNT = 'walls'
#: Share of the seconds for the proof.
PROVING = 0.25
#: Smallest reported optimality gap, per cent.
LEAST_PERCENT = 0.1


class Counting(NamedTuple):
    """
    Criterion to choose the number of cameras.

    :ivar target: share of the best possible value, above 0, at most 1.
    :ivar by: quantity of this share: ``error``, ``seen`` or ``coverage``.
    :ivar most: largest number of cameras to try.
    """

    target: float = 0.95
    by: str = 'error'
    most: int = 12


@dataclass(frozen=True)
class PlanTask:
    """
    Settings of a search.

    :ivar planner: one of :func:`~ocp_ros.search.registry.planner_names`.
    :ivar seconds: of search for each number of cameras; None for 60, or 15 with ``counting``,
        unless evaluations are given.
    :ivar evaluations: largest number of placements to evaluate; with it and without ``seconds``,
        the same seed gives the same result.
    :ivar seed: random seed.
    :ivar counting: criterion to choose the number of cameras; None for a given number.
    :raises ConfigurationError: if the planner does not exist or cannot choose the number.
    """

    planner: str = RIG_SEARCH
    seconds: float | None = None
    evaluations: int | None = None
    seed: int = 0
    counting: Counting | None = None

    def __post_init__(self) -> None:
        """Reject a planner that does not support the settings."""
        check_planner(self.planner, self.counting is not None)

    def budgets(self) -> tuple[Budget, float | None]:
        """Return the budget of the search, and the seconds of the proof."""
        seconds = self.seconds
        if seconds is None and self.evaluations is None:
            seconds = SECONDS if self.counting is None else SECONDS_EACH
        if seconds is None or self.planner == RIG_SEARCH:
            # The search of ``RIG_SEARCH`` includes the proof.
            return Budget(seconds, self.evaluations), seconds
        return Budget((1.0 - PROVING) * seconds, self.evaluations), PROVING * seconds


class PlannedRig:
    """
    A rig that is planned in a room.

    :param scene: the room.
    :param rig: the rig; with :class:`Counting`, its number of cameras is replaced.
    :param task: settings of the search.
    :param budget: of the search, from :meth:`PlanTask.budgets`; the caller may stop it.
    :param proving: seconds of the proof.
    :param progress: called several times a second.
    :ivar engine: settings of the engine.
    :ivar plans: one, or one for each number of cameras; the last one is the result.
    :raises ConfigurationError: if the rig has no placement in this room.
    """

    def __init__(self, scene: Scene, rig: Rig, task: PlanTask, budget: Budget,
                 proving: float | None = None, progress: Progress | None = None) -> None:
        self.task, self.budget = task, budget
        # A mesh gives the exact occlusion of its points by ray casting.
        exact = scene.mesh is not None and scene.mesh.exact
        self.engine = with_rays(PROMISING, scene) if exact else PROMISING
        self.planner = RigPlanner(scene, rig, self.engine, budget, task.seed, progress,
                                  task.planner)
        self.plans = list(self._counted(rig, task.counting) if task.counting
                          else [self.planner.plan(rig)])
        self.plans[-1] = self.planner.certified(self.plans[-1], budget.restarted(proving))

    @property
    def best(self) -> RigPlan:
        """Return the last plan, which is the result."""
        return self.plans[-1]

    def _counted(self, rig: Rig, counting: Counting) -> Iterator[RigPlan]:
        """Yield plans with an increasing number of cameras until one reaches the target."""
        first = max(rig.seen_by - len(rig.fixed), 1)
        for plan in self.planner.count_up(lambda count: with_count(rig, count), first,
                                          max(counting.most, first)):
            yield plan
            if plan.reaches(counting.by, counting.target):
                return

    def placement(self, room: dict[str, Any], command: str) -> Placement:
        """
        Return the placement without scores.

        :param room: description of the room, as in placement files.
        :param command: for the record.
        """
        return placement_of(self.best.rig, self.best.answer.poses, room=room, engine=self.engine,
                            created=created_by(command, self.best.planner))

    def judged(self, placement: Placement, frame: str | None = None) -> Assessment:
        """
        Evaluate the placement.

        :param placement: from :meth:`placement`.
        :param frame: requested frame of files, ``'map'`` or ``'source'``.
        """
        problem = self.planner.problem(self.best.rig)
        found = {'room': placement.room, 'cameras': data_of(placement)['cameras'],
                 **evaluate_placement(problem, placement.poses), 'search': self._search()}
        if self.task.counting is not None:
            found |= {'curve': rows_of_curve(self.plans), 'count': self._count()}
        judged = Assessment(problem.objective, replace(placement, scores=found['scores']), found,
                            frame)
        found['installer'] = [dict(zip(['number', *COLUMNS], row)) | {'aim': aim}
                              for row, aim in zip(judged.rows, judged.aims)]
        return judged

    def _count(self) -> dict[str, Any]:
        """Return the number of cameras that reaches the target, and the last that does not."""
        target, by, _ = self.task.counting
        return {'cameras': len(self.best.rig.cameras), 'by': by, 'target': target,
                'reached': self.best.reaches(by, target),
                'fewer': len(self.plans[-2].rig.cameras) if len(self.plans) > 1 else None}

    def _search(self) -> dict[str, Any]:
        """Return the data of the search and the values for comparison, as plain data."""
        plan, answer, random = self.best, self.best.answer, self.best.random
        return {'planner': plan.planner, 'seed': self.task.seed,
                'loss': plan.evaluation.loss, 'searches': sorted(answer.losses),
                'evaluations': answer.evaluations, 'seconds': round(plan.seconds, 2),
                'stopped': self.budget.stopped, 'candidates': plan.candidates,
                'random': {'placements': len(random),
                           'median': float(np.median(random)) if len(random) else None,
                           'best': float(random.min()) if len(random) else None},
                'everywhere': {'loss': plan.union_bound.loss,
                               'depth_error': plan.union_bound.depth_error},
                'certificate': certificate_data(plan.certificate, plan.uncertain)}


def certificate_data(known: Certificate | None, uncertain: str = '') -> dict[str, Any]:
    """
    Return a certificate as plain data.

    :param uncertain: reason why there is none.
    :returns: ``sentence``, and the values in it; ``gap`` is None without a certificate.
    """
    if known is None:
        return {'sentence': f'The optimality gap is unknown: {uncertain}.', 'gap': None}
    apart = f'{known.step:.2g} m' + (f' and {known.turn:g} degrees' if known.turn else '')
    gained = (f'; moving off this grid gained {100.0 * known.moved:.1f} %'
              if known.moved >= LEAST_PERCENT / 100.0 else '')
    return {'sentence': f'No placement on {known.candidates:,} candidate poses ({apart} apart, '
                        f'closer around the cameras) is better by more than '
                        f'{max(gap_percent(known.gap), LEAST_PERCENT):.1f} %{gained} (computed on '
                        f'depth maps of {known.rows} rows).',
            'gap': known.gap, 'moved': known.moved, **asdict(known)}


def rows_of_curve(plans: Sequence[RigPlan]) -> list[dict[str, Any]]:
    """Return the scores of each number of cameras as plain data."""
    return [{'cameras': len(plan.rig.cameras), 'loss': plan.evaluation.loss,
             'depth_error': plan.evaluation.depth_error,
             'space_coverage': plan.evaluation.space_coverage,
             **{f'share_{name}': share for name, share in plan.shares.items()},
             'seconds': round(plan.seconds, 2)} for plan in plans]


def gap_percent(gap: float) -> float:
    """Return a gap in per cent, rounded up to tenths, so that it remains an upper limit."""
    return ceil(1000.0 * gap - 0.01) / 10.0
