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
Lookahead: plan on the observed cloud as if it were the room, and plan again as the cloud grows.

During exploration the objective is the depth error of the observed cloud, less a bonus for the
unseen cells of the air that a plan covers. The bonus decreases to 0 at about half of the episode;
from then on the objective is the depth error alone.

The planner chooses among candidates on a grid, by simulated annealing on unions of packed bits.
The views of the candidates are computed once for several time steps. One-camera exchanges without
annealing end in worse plans. In the last time steps the best plan is annealed once more among all
candidates and then in small steps, on a finer model and among positions that the cameras can still
reach: a plan that is good on a coarsely thinned cloud is often worse in the room.

In an episode of many time steps the next plan is computed while the cameras move; see
:class:`~ocp_ros.online.online_planner.PipelinedPlanner`. There the annealing on the finer model is
done in parts, one in each time step.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from ocp_ros.geometry.visibility import FINE
from ocp_ros.online.candidate_sites import Candidates, max_positions
from ocp_ros.online.online_planner import KnownTurn, matched, Online, PipelinedPlanner
from ocp_ros.online.partial_map import cell_weight, KeptModel, PartialMap
from ocp_ros.online.rig_state import AIR_RADIUS_M, clearance_of, fixed_views, RigState, view_from
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.util.annealing import between
from ocp_ros.util.threads import mapped


@dataclass(frozen=True)
class LookaheadTuning:
    """
    Constants of the planner; pairs are the first and the last value of a geometric schedule.

    An episode is *pipelined* if its plans are computed while the cameras move.

    :ivar spacing_m: metres between candidate positions; more in a large room.
    :ivar max_positions: largest number of candidate positions.
    :ivar candidate_model: largest number of points, and number of depth-map rows, of the model on
        which candidates are compared.
    :ivar candidate_turns: time steps for which a pipelined episode reuses candidates; their views
        are computed in the first of these time steps.
    :ivar refining_share: share of the episode after which plans are refined; earlier the observed
        cloud is too small.
    :ivar refining_model: the same sizes, of the finer model for the refinement.
    :ivar refining_turns: smallest number of time steps for which that model is reused.
    :ivar survey_turns: time steps before the refinement at which a pipelined episode creates that
        model and anneals the plan on it among all candidates (the survey).
    :ivar proposals: proposals of a time step of refinement.
    :ivar pipelined_proposals: the same, in a pipelined episode.
    :ivar model_turn_proposals: the same, in a time step that also creates a model.
    :ivar proposals_per_camera: consecutive proposals for one camera; the views of the others are
        merged once for these.
    :ivar parallel_proposals: proposals whose views are computed in parallel.
    :ivar temperatures: of the refinement, in multiples of the best plan's error.
    :ivar position_deviations_m: standard deviations of the changes of a position, metres.
    :ivar heading_deviations: standard deviations of the changes of yaw and pitch, radians.
    """

    spacing_m: float = 0.5
    max_positions: int = 400
    candidate_model: tuple[int, int] = 6000, 32
    candidate_turns: int = 2
    refining_share: float = 0.6
    refining_model: tuple[int, int] = 60000, 128
    refining_turns: int = 4
    survey_turns: int = 2
    proposals: int = 240
    pipelined_proposals: int = 112
    model_turn_proposals: int = 16
    proposals_per_camera: int = 16
    parallel_proposals: int = 4
    temperatures: tuple[float, float] = 0.1, 0.003
    position_deviations_m: tuple[float, float] = 0.5, 0.02
    heading_deviations: tuple[float, float] = 0.5, 0.05


TUNING = LookaheadTuning()


class Lookahead(PipelinedPlanner):
    """
    Explore, plan on the observed cloud, and refine the plan while the cameras move to it.

    :param settings: of :class:`Online`.
    :param guide: a planner, such as a trained actor, that proposes placements as first plans;
        None without.
    """

    def __init__(self, *settings, guide: Online | None = None) -> None:
        super().__init__(*settings)
        self.guide = guide
        self.reset()

    def set_rig_state(self, rig_state: RigState | None) -> None:
        """Set the state of the guide too; see :meth:`Online.set_rig_state`."""
        super().set_rig_state(rig_state)
        if self.guide is not None:
            self.guide.set_rig_state(rig_state)

    def reset(self) -> None:
        """Discard the state of the last episode."""
        super().reset()
        if self.guide is not None:
            self.guide.reset()
        self.targets = self.headings = None
        self._candidates: Candidates | None = None
        self._choice: list[int] = []
        self._kept_model = KeptModel(self.max_range, self.wall_margin, *TUNING.refining_model)
        #: The remaining parts of the survey, see :meth:`_survey`.
        self._remaining_survey: Iterator[object] = iter(())
        self._is_surveyed = False
        #: Time step in which the last model or the last candidates were created.
        self._model_turn = 0

    def _think(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Compute the plan for a time step; see :meth:`PipelinedPlanner._think`."""
        pipelined = self._ahead(turns)
        if turn >= TUNING.refining_share * turns - TUNING.survey_turns * pipelined:
            if self._is_surveyed or self._do_survey(cloud, positions, turn, turns):
                self._refine(cloud, positions, turn, turns)
            return
        if (self._candidates is None or not pipelined
                or turn - self._model_turn >= TUNING.candidate_turns):
            self._create_candidates(cloud, positions, turn, turns)
        # In a pipelined episode, the greedy choice suffices for the first time step.
        if not (pipelined and self._waits_for_plan(turns, len(positions))):
            (self._choice,) = self._candidates.anneal(self._choice, self.rng)
        self._set_plan(positions)

    def _create_candidates(self, cloud: np.ndarray, positions: np.ndarray, turn: int,
                           turns: int) -> None:
        """Create candidates, the current and proposed plans included, and choose the best plan."""
        model = PartialMap(cloud, positions, self.max_range, *TUNING.candidate_model,
                           air_radius=AIR_RADIUS_M if self.directional else 0.0)
        unseen = self.memory.unseen(model)
        self._space = self.space(cloud, positions)
        plans = self._current_plans(len(positions))
        if self.guide is not None:
            self.guide.interrupted = self.interrupted
            plans.append(self.guide.propose(KnownTurn(
                cloud, positions, turn, turns, model, self._space, unseen)))
        self._choose_plan(model, self._space, unseen, cell_weight(model, unseen, turn, turns),
                          plans, len(positions))
        self._model_turn = turn

    def _choose_plan(self, model: PartialMap, space: FreePlane, unseen: np.ndarray, weight: float,
                     plans: list[np.ndarray], cameras: int) -> None:
        """
        Create candidates on a model, and choose the best plan among given ones and a greedy one.

        :param weight: bonus for each covered cell of ``unseen`` (packed bits), metres.
        :param plans: placements (K, 6) of K = ``cameras`` cameras, metres and radians. A greedy
            plan is compared only if there is no current plan.
        """
        count = int(np.clip(space.area / TUNING.spacing_m ** 2, 4, TUNING.max_positions))
        plans = [np.hstack([space.placement(space.inside(plan[:, :2])), plan[:, 3:]])
                 for plan in plans]
        state = self.rig_state or RigState.omnidirectional(cameras)
        positions = space.placement(space.grid(min(count, max_positions(state))))
        self._candidates = Candidates(model, positions, plans, state, unseen, weight)
        # The poses of the plans are the first candidates.
        choices = np.arange(len(plans) * cameras).reshape(-1, cameras).tolist()
        if not self._planned(cameras):
            choices.append(self._candidates.choose_greedily())
        self._choice = min(choices, key=self._candidates.value)

    def _current_plans(self, cameras: int) -> list[np.ndarray]:
        """Return a list of the current plan, (K, 6) metres and radians, if any; z is not used."""
        if not self._planned(cameras):
            return []
        headings = self._planned_headings() if self.directional else np.zeros((cameras, 3))
        return [np.hstack([self.targets, np.zeros((cameras, 1)), headings])]

    def _set_plan(self, positions: np.ndarray) -> None:
        """Assign the chosen poses to the cameras with the shortest total path."""
        poses = self._candidates.poses[self._choice]
        poses = poses[matched(positions, poses[:, :2], self._candidates.kind_of)]
        self.targets, self.headings = poses[:, :2], poses[:, 3:] if self.directional else None

    def _refine(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Anneal the plan in small steps, among the positions that the cameras can still reach."""
        if (turn - self._model_turn >= TUNING.refining_turns
                and not self._kept_model.lasts(cloud, positions)):
            self._create_refining_model(cloud, positions, turn)
        proposals = TUNING.pipelined_proposals if self._ahead(turns) else TUNING.proposals
        if self._model_turn == turn:
            proposals = TUNING.model_turn_proposals
        model, self._space = self._kept_model.made
        first_turn = TUNING.refining_share * turns
        reachable = [self._space.reached(position[:2], self.max_step, turns - turn)
                     for position in positions]
        targets = best_targets = np.array([
            space.inside(target) for space, target in zip(reachable, self.targets, strict=True)])
        headings = best_headings = self._planned_headings()
        views = [view_from(model, self.rig_state, camera, position,
                           None if headings is None else headings[camera])
                 for camera, position in enumerate(self._space.placement(targets))]
        fixed = fixed_views(model, self.rig_state)
        error = best_error = model.error(views + fixed)
        for proposal in range(0, proposals, TUNING.parallel_proposals):
            if self.interrupted():
                break
            if proposal % TUNING.proposals_per_camera == 0:
                camera = int(self.rng.integers(len(targets)))
                others = model.together([*views[:camera], *views[camera + 1:], *fixed])
                error_with = model.depth_error.given(others.seen)
            share = (turn - first_turn + proposal / proposals) / (turns - first_turn)
            # The temperature is never 0: an error counts as at least 1 mm.
            temperature = max(best_error, 1e-3) * between(*TUNING.temperatures, share)
            trials = [self._draw_pose(camera, targets, headings, reachable[camera], share)
                      for _ in range(TUNING.parallel_proposals)]
            trial_views = mapped(lambda trial, model=model, camera=camera: view_from(
                model, self.rig_state, camera, *trial), trials)
            for (position, heading), view in zip(trials, trial_views):
                max_error = error + temperature * self.rng.exponential()
                trial_error = error_with(view.seen, max_error)
                if trial_error > max_error:
                    continue
                targets, error = targets.copy(), trial_error
                targets[camera], views[camera] = position[:2], view
                if headings is not None:
                    headings = headings.copy()
                    headings[camera] = heading
                if error < best_error:
                    best_targets, best_headings, best_error = targets, headings, error
        self.targets, self.headings = best_targets, best_headings

    def _create_refining_model(self, cloud: np.ndarray, positions: np.ndarray, turn: int) -> None:
        """Create the model for the refinement."""
        self._kept_model.make(cloud, positions, FINE, clearance_of(self.rig_state, self.clearance))
        self._model_turn = turn

    def _do_survey(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> bool:
        """
        Do a part of the survey, or all of it if the time step waits for its plan.

        :returns: whether the survey is complete.
        """
        if self._kept_model.made is None:
            self._remaining_survey = self._survey(cloud, positions, turn)
        for _ in self._remaining_survey:
            if not self._waits_for_plan(turns, len(positions)):
                return False
        self._set_plan(positions)
        self._is_surveyed = True
        return True

    def _survey(self, cloud: np.ndarray, positions: np.ndarray, turn: int) -> Iterator[object]:
        """
        Anneal the plan once more among all candidates, on the model for the refinement.

        :returns: an iterator with an item of no meaning after each part of the computation.
        """
        self._create_refining_model(cloud, positions, turn)
        model, space = self._kept_model.made
        # The depth error is computed when it is first needed.
        yield model.depth_error
        self._choose_plan(model, space, self.memory.unseen(model), 0.0,
                          self._current_plans(len(positions)), len(positions))
        yield
        for choice in self._candidates.anneal(self._choice, self.rng, parts=2):
            self._choice = choice
            yield

    def _draw_pose(self, camera: int, targets: np.ndarray, headings: np.ndarray | None,
                   space: FreePlane, share: float) -> tuple[np.ndarray, np.ndarray | None]:
        """
        Draw a pose near that of a camera, among the positions that it can reach.

        :param targets: (K, 2) metres: planned positions of the cameras.
        :param headings: (K, 3) radians: planned headings; None if all are omnidirectional.
        :param space: the positions that the camera can reach.
        :param share: elapsed share of the refinement.
        :returns: the position (3,) in metres, and the heading (3,) in radians; None if all cameras
            are omnidirectional.
        """
        target = space.reflected(targets[camera] + self.rng.normal(
            0.0, between(*TUNING.position_deviations_m, share), 2))
        heading = None if headings is None else self._draw_heading(
            headings[camera], camera, between(*TUNING.heading_deviations, share))
        return space.placement(target[None])[0], heading

    def _planned_headings(self) -> np.ndarray | None:
        """Return the headings (K, 3) of the plan; None if all cameras are omnidirectional."""
        if not self.directional:
            return None
        if self.headings is not None and self.rig_state.turns:
            return self.headings
        return self.rig_state.placement[:self.rig_state.movable, 3:].copy()

    def _draw_heading(self, heading: np.ndarray, camera: int, deviation: float) -> np.ndarray:
        """Return a heading (3,) with random changes of yaw and pitch, within the limits."""
        if not self.rig_state.turns or camera not in self.rig_state.aimed:
            return heading
        changed = heading.copy()
        changed[:2] += self.rng.normal(0.0, deviation, 2)
        changed[1] = np.clip(changed[1], *self.rig_state.pitch)
        return changed
