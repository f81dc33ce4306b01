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

from collections import Counter
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
from ocp_ros.search.candidate_pool import views_of
from ocp_ros.search.mixes import Mix, mixes_of, pareto_front, prices_of
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.search.registry import check_planner, RIG_SEARCH
from ocp_ros.search.rig_plan import RigPlan, RigPlanner
from ocp_ros.simulation.objective import RigEvaluation
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.room_gains import VIEWPOINT_TOLERANCE
from ocp_ros.util.settings import ConfigurationError, MAX_CAMERAS

#: Default number of cameras.
CAMERAS = 4
#: Default mount: cameras cannot be mounted in mid-air.
MOUNT = 'walls'
#: Smallest reported optimality gap, per cent.
MIN_GAP_PERCENT = 0.1


class Counting(NamedTuple):
    """
    Criterion to choose the number of cameras.

    :ivar target: share to reach of the best possible value, above 0, at most 1; on a floor of
        several rooms in each room.
    :ivar by: quantity that the share is of: ``error`` (reduction of the depth error), ``seen``
        (points) or ``coverage`` (of space).
    :ivar most: largest number of cameras to try; on a floor, times the number of rooms.
    :ivar budget: largest price of all cameras to be placed; infinite for no limit.
    """

    target: float = 0.95
    by: str = 'error'
    most: int = 12
    budget: float = np.inf


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
        self._is_mixed = len(rig.document.data['cameras']) > 1
        #: The Pareto front of mixes, if the rig has several groups to count.
        self.mixes: list[Mix] = []
        #: On a floor, a lower bound of the number of cameras, or with groups of their price.
        self.least: float | None = None
        if task.counting is None:
            self.plans = [self.planner.plan(rig)]
        elif scene.rooms is not None:
            self.plans = self._plans_of_floor(rig, task.counting, scene.rooms.count)
        elif self._is_mixed:
            self.plans = self._plans_by_price(rig, task.counting)
        else:
            self.plans = list(self._plans_by_count(rig, task.counting))
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
        most = max(counting.most, first)
        if np.isfinite(counting.budget):
            price, = prices_of(rig)
            most = int(min(most, counting.budget // price if price else most))
            if most < first:
                raise _poor_budget(counting, first * price)
        for plan in self.planner.count_up(lambda count: with_count(rig, count), first, most):
            yield plan
            if plan.reaches(counting.by, counting.target):
                return

    def _plans_of_floor(self, rig: Rig, counting: Counting, rooms: int) -> list[RigPlan]:
        """Return plans until the fewest or cheapest cameras that reach the target in each room."""
        prices = prices_of(rig) if self._is_mixed or np.isfinite(counting.budget) else [1.0]
        least = max(rig.least_cameras - len(rig.fixed), 1)
        if min(prices) * least > counting.budget:
            raise _poor_budget(counting, min(prices) * least)
        most = min(max(counting.most, least) * rooms, MAX_CAMERAS - len(rig.fixed))
        plans, bound = self.planner.count_in_rooms(rig, counting.by, counting.target, most, prices,
                                                   counting.budget)
        if bound is not None:
            self.least = bound if self._is_mixed else ceil(bound / prices[0])
        return plans

    def _plans_by_price(self, rig: Rig, counting: Counting) -> list[RigPlan]:
        """
        Return plans of the Pareto front of mixes until one reaches the target, cheapest first.

        If none does, the plan with the lowest loss is the last one.
        """
        planner, prices = self.planner, prices_of(rig)
        mixes = mixes_of(planner.problem(rig).objective, planner.pool, counting.most,
                         counting.budget, np.random.default_rng([self.task.seed, 2]))
        if not mixes:
            raise _poor_budget(counting, min(prices) * max(rig.least_cameras - len(rig.fixed), 1))
        self.mixes = pareto_front(mixes, [mix.price for mix in mixes], [mix.loss for mix in mixes])
        plans: list[RigPlan] = []
        for mix in self.mixes:
            if plans:
                # The search for each mix has the whole budget.
                planner.budget = planner.budget.restarted()
            plans.append(planner.plan(mix.rig, start=mix.sites))
            if plans[-1].reaches(counting.by, counting.target):
                return plans
            if self.budget.stopped:
                break
        best = int(np.argmin([plan.evaluation.loss for plan in plans]))
        return plans[:best + 1]

    def _front_rows(self) -> list[dict[str, Any]]:
        """Return the Pareto front of price and loss: the plans, then estimates of dearer mixes."""
        priced = [plan for plan in self.plans
                  if all(camera.price is not None for camera in plan.rig.cameras)]
        rows = [_front_row(plan.rig, plan.evaluation, True) for plan in priced]
        # Mixes differ in their cameras alone, so one objective evaluates them all.
        objective = self.planner.problem(self.best.rig).objective
        rows += [_front_row(mix.rig, objective.evaluate_views(views_of(mix.sites)), False)
                 for mix in self.mixes[len(self.plans):]]
        return pareto_front(rows, [row['price'] for row in rows], [row['loss'] for row in rows])

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
            'curve': curve_rows(self.plans), 'count': self._count_data(),
            'front': self._front_rows()}
        assessed = Assessment.of(self.planner.problem(self.best.rig), placement, frame,
                                 search=self._search_data(), **count_findings)
        columns = ['number', *INSTRUCTION_COLUMNS]
        assessed.found['installer'] = [dict(zip(columns, row)) | {'aim': aim}
                                       for row, aim in zip(assessed.rows, assessed.aims)]
        return assessed

    def _count_data(self) -> dict[str, Any]:
        """Return the number of cameras of the result, and the number tried before, as data."""
        target, by, *_ = self.task.counting
        found = {'cameras': len(self.best.rig.cameras), 'by': by, 'target': target,
                 'reached': self.best.reaches(by, target)}
        if len(shares := self.best.room_shares):
            found['rooms'] = [{'name': f'room {number}', 'share': float(share),
                               'reached': bool(share >= target - VIEWPOINT_TOLERANCE)}
                              for number, share in enumerate(shares, start=1)]
            # Poses off the candidates may do with less than the bound.
            used = sum(camera.price for camera in self.best.rig.cameras) if self._is_mixed else (
                found['cameras'])
            found['at_least'] = self.least if (self.least or 0.0) <= used else None
        if self._is_mixed:
            # The plan before may have more cameras, which cost less.
            return {**found, 'mix': mix_text(self.best.rig)}
        return {**found,
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
    limit = f'{gap_percent(proof.gap):.1f} %'
    if proof.bound <= 0.0:
        # A relaxed choice of the poses misses nothing.
        limit = f'all that it still misses, {100.0 * proof.found:.2g} % of the error of no cameras'
    if proof.relaxed:
        limit += f', even with {" and ".join(proof.relaxed)} relaxed'
    # The properties ``gap`` and ``moved`` are added, since ``asdict`` has the fields only.
    return {'sentence': f'No placement on {proof.candidates:,} candidate poses ({spacing} '
                        f'apart{near}) is better by more than {limit}{gain} (computed '
                        f'on depth maps of {proof.rows} rows).'
                        + ' This is not final: more seconds refine it.' * (not proof.final),
            'gap': proof.gap, 'moved': proof.moved, **asdict(proof)}


def _front_row(rig: Rig, evaluation: RigEvaluation, planned: bool) -> dict[str, Any]:
    """Return a row of the Pareto front as plain data; ``planned`` tells plans from estimates."""
    return {'mix': mix_text(rig),
            'price': float(sum(camera.price for camera in rig.cameras)),
            'cameras': len(rig.cameras), 'depth_error': evaluation.depth_error,
            'loss': evaluation.loss, 'planned': planned}


def mix_text(rig: Rig) -> str:
    """Return the cameras to be placed as text, such as ``2 x kinect_v2 + 1 x realsense_d455``."""
    sensors = Counter(camera.sensor or camera.name for camera in rig.cameras)
    return ' + '.join(f'{count} x {sensor}' for sensor, count in sensors.items())


def _poor_budget(counting: Counting, price: float) -> ConfigurationError:
    """Return the error that a budget is below the price of the cheapest cameras."""
    return ConfigurationError(f'--budget: found {counting.budget:g}; expected at least {price:g}, '
                              'the price of the fewest cameras; raise it')


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
