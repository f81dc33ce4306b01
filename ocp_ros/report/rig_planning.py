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
from dataclasses import asdict, dataclass
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.camera_words import INSTRUCTION_COLUMNS
from ocp_ros.rig.placement_file import created_by, Placement, placement_of
from ocp_ros.rig.rig_file import Rig, with_count
from ocp_ros.scenes.scene import Scene
from ocp_ros.search.budget import Budget, Progress
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.search.registry import check_planner, RIG_SEARCH
from ocp_ros.search.rig_plan import RigPlan, RigPlanner
from ocp_ros.simulation.ray_visibility import with_rays

#: Default number of cameras.
CAMERAS = 4
#: Default mount: cameras cannot be mounted in mid-air.
MOUNT = 'walls'
#: Smallest reported optimality gap, per cent.
MIN_GAP_PERCENT = 0.1


class Counting(NamedTuple):
    """
    Criterion to choose the number of cameras.

    :ivar target: share to reach of the best possible value, above 0, at most 1.
    :ivar by: quantity that the share is of: ``error`` (reduction of the depth error), ``seen``
        (points) or ``coverage`` (of space).
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
        """Return the budget of the search, and the seconds of the proof (None for no limit)."""
        seconds = self.seconds
        if seconds is None and self.evaluations is None:
            seconds = 60.0 if self.counting is None else 15.0
        if seconds is None or self.planner == RIG_SEARCH:
            # No time is set aside for the proof if there is no limit of time, or if the search
            # includes the proof, as that of ``RIG_SEARCH`` does.
            return Budget(seconds, self.evaluations), seconds
        proof_share = 0.25
        return Budget((1.0 - proof_share) * seconds, self.evaluations), proof_share * seconds


class PlannedRig:
    """
    A rig and its plans in a room; the constructor runs the search.

    :param scene: the room.
    :param rig: the rig; with :class:`Counting`, its number of cameras is replaced.
    :param task: settings of the search.
    :param budget: of the search, from :meth:`PlanTask.budgets`; the caller may stop it.
    :param proof_seconds: seconds of the proof; None for no limit.
    :param progress: called several times a second with the used share of the budget and the
        smallest objective value so far; its result is ignored.
    :ivar engine: settings of the engine.
    :ivar plans: one plan, or one for each number of cameras; the last plan is the result.
    :raises ConfigurationError: if the rig has no placement in this room.
    """

    def __init__(self, scene: Scene, rig: Rig, task: PlanTask, budget: Budget,
                 proof_seconds: float | None = None, progress: Progress | None = None) -> None:
        self.task = task
        self.budget = budget
        # If the points lie exactly on a mesh, rays cast at the mesh give their exact occlusion.
        has_exact_mesh = scene.mesh is not None and scene.mesh.exact
        self.engine = with_rays(PROMISING, scene) if has_exact_mesh else PROMISING
        self.planner = RigPlanner(scene, rig, self.engine, budget, task.seed, progress,
                                  task.planner)
        self.plans = (list(self._plans_by_count(rig, task.counting)) if task.counting
                      else [self.planner.plan(rig)])
        # Only the result gets a proof.
        self.plans[-1] = self.planner.certified(self.plans[-1], budget.restarted(proof_seconds))

    @property
    def best(self) -> RigPlan:
        """Return the last plan, which is the result."""
        return self.plans[-1]

    def _plans_by_count(self, rig: Rig, counting: Counting) -> Iterator[RigPlan]:
        """Yield plans with an increasing number of cameras until one reaches the target."""
        # With fewer cameras no point would be seen by enough cameras.
        first = max(rig.least_cameras - len(rig.fixed), 1)
        for plan in self.planner.count_up(lambda count: with_count(rig, count), first,
                                          max(counting.most, first)):
            yield plan
            if plan.reaches(counting.by, counting.target):
                return

    def placement(self, room: dict[str, Any], command: str) -> Placement:
        """
        Return the placement without scores.

        :param room: record of the room, as in placement files.
        :param command: the command line, for the record of the placement.
        """
        return placement_of(self.best.rig, self.best.answer.poses, room=room, engine=self.engine,
                            created=created_by(command, self.best.planner))

    def assessment_of(self, placement: Placement, frame: str | None = None) -> Assessment:
        """
        Evaluate the placement.

        :param placement: from :meth:`placement`.
        :param frame: requested frame of files, ``'map'`` or ``'source'``; None for the default.
        """
        # If the search chose the number of cameras, add the scores of each number, and the choice.
        count_findings = {} if self.task.counting is None else {
            'curve': curve_rows(self.plans), 'count': self._count_data()}
        assessed = Assessment.of(self.planner.problem(self.best.rig), placement, frame,
                                 search=self._search_data(), **count_findings)
        columns = ['number', *INSTRUCTION_COLUMNS]
        assessed.found['installer'] = [dict(zip(columns, row)) | {'aim': aim}
                                       for row, aim in zip(assessed.rows, assessed.aims)]
        return assessed

    def _count_data(self) -> dict[str, Any]:
        """Return the number of cameras of the result, and the number tried before, as data."""
        target, by, _ = self.task.counting
        return {'cameras': len(self.best.rig.cameras), 'by': by, 'target': target,
                'reached': self.best.reaches(by, target),
                'fewer': len(self.plans[-2].rig.cameras) if len(self.plans) > 1 else None}

    def _search_data(self) -> dict[str, Any]:
        """Return figures of the search, and values to compare the result with, as plain data."""
        plan = self.best
        # The objective values of random placements.
        random = plan.random
        return {'planner': plan.planner, 'seed': self.task.seed,
                'loss': plan.evaluation.loss, 'searches': sorted(plan.answer.losses),
                'evaluations': plan.answer.evaluations, 'seconds': round(plan.seconds, 2),
                'stopped': self.budget.stopped, 'candidates': plan.candidates,
                'random': {'placements': len(random),
                           'median': float(np.median(random)) if len(random) else None,
                           'best': float(random.min()) if len(random) else None},
                # The values with a camera at each candidate, which are lower bounds.
                'everywhere': {'loss': plan.union_bound.loss,
                               'depth_error': plan.union_bound.depth_error,
                               **({'requirements': plan.union_bound.requirements.tolist()}
                                  if plan.rig.requirements else {})},
                'certificate': certificate_data(plan.certificate, plan.uncertain)}


def certificate_data(proof: Certificate | None, reason: str = '') -> dict[str, Any]:
    """
    Return a certificate, the proof of an optimality gap, as plain data.

    :param proof: the certificate; None if there is none.
    :param reason: why there is no certificate.
    :returns: ``sentence``, and the values in it; ``gap`` is None without a certificate.
    """
    if proof is None:
        return {'sentence': f'The optimality gap is unknown: {reason}.', 'gap': None}
    spacing = f'{proof.step:.2g} m' + (f' and {proof.turn:g} degrees' if proof.turn else '')
    near = ', closer around the cameras' if proof.near else ''
    gain = (f'; moving off this grid gained {100.0 * proof.moved:.1f} %'
            if (proof.moved or 0.0) >= MIN_GAP_PERCENT / 100.0 else '')
    # The properties ``gap`` and ``moved`` are added, since ``asdict`` has the fields only.
    return {'sentence': f'No placement on {proof.candidates:,} candidate poses ({spacing} '
                        f'apart{near}) is better by more than '
                        f'{gap_percent(proof.gap):.1f} %{gain} (computed '
                        f'on depth maps of {proof.rows} rows).',
            'gap': proof.gap, 'moved': proof.moved, **asdict(proof)}


def curve_rows(plans: Sequence[RigPlan]) -> list[dict[str, Any]]:
    """Return the scores of the plan with each number of cameras, as plain data."""
    return [{'cameras': len(plan.rig.cameras), 'loss': plan.evaluation.loss,
             'depth_error': plan.evaluation.depth_error,
             'space_coverage': plan.evaluation.space_coverage,
             **{f'share_{name}': share for name, share in plan.shares.items()},
             'seconds': round(plan.seconds, 2)} for plan in plans]


def gap_percent(gap: float) -> float:
    """Return an optimality gap in per cent, rounded up to tenths, so that it is an upper limit."""
    # Without the 1e-6, rounding errors of the gap could raise an exact tenth to the next one.
    return max(ceil(1000.0 * gap - 1e-6) / 10.0, MIN_GAP_PERCENT)
