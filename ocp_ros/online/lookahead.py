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
The views of the candidates are computed once for several turns. One-camera exchanges without
annealing end in worse plans. In the last turns the better one of the plan and of the best
places of the episode is annealed once more among all candidates and then in small steps, on a
finer model and among positions that the cameras can still reach: a plan that is good on a coarsely
thinned cloud is often worse in the room.

In an episode of many turns, and with real cameras, the next plan is computed while the cameras
move; see :meth:`~ocp_ros.online.online_planner.Online.plans_ahead`. There the annealing on the
finer model is done in parts: one in each turn, or with real cameras as many as there is time for.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.visibility import FINE
from ocp_ros.online.candidate_sites import Candidates, max_positions
from ocp_ros.online.episode_places import EpisodePlaces, scouted
from ocp_ros.online.online_planner import matched, MIN_PIPELINED_TURNS, PipelinedPlanner
from ocp_ros.online.partial_map import cell_weight, KeptModel, PartialMap, View
from ocp_ros.online.rig_state import AIR_RADIUS_M, clearance_of, fixed_views, RigState, view_from
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.annealing import annealed, between
from ocp_ros.util.threads import mapped


@dataclass(frozen=True)
class LookaheadTuning:
    """
    Constants of the planner; pairs are the first and the last value of a geometric schedule.

    An episode is *pipelined* if its plans are computed while the cameras move, with a fixed amount
    of work in each turn. An episode *at once* has no such amount.

    :ivar spacing_m: metres between candidate positions; more in a large room.
    :ivar max_positions: largest number of candidate positions.
    :ivar candidate_model: largest number of points, and number of depth-map rows, of the model on
        which candidates are compared.
    :ivar candidate_turns: turns for which a pipelined episode reuses candidates; their views
        are computed in the first of these turns.
    :ivar refining_share: share of the episode after which plans are refined; earlier the observed
        cloud is too small.
    :ivar refining_model: the same sizes, of the finer model for the refinement.
    :ivar refining_turns: smallest number of turns for which that model is reused; an episode at
        once creates it again as soon as the cloud has grown.
    :ivar survey_turns: turns before the refinement at which a pipelined episode creates that
        model and anneals the plan on it among all candidates (the survey).
    :ivar lead_turns: the same, in an episode at once.
    :ivar survey_runs: runs of annealing in the survey of an episode at once: each ends in another
        local optimum, and the best one holds.
    :ivar parts: parts of each run of annealing among candidates in an episode at once.
    :ivar proposals: proposals of a turn of refinement.
    :ivar pipelined_proposals: the same, in a pipelined episode.
    :ivar most_proposals: the same, in an episode at once, if there is time.
    :ivar model_turn_proposals: the same, in a turn that also creates a model.
    :ivar parallel_proposals: proposals whose views are computed in parallel, as a group.
    :ivar groups_per_camera: consecutive groups for one camera; the views of the others are merged
        once for these.
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
    lead_turns: int = 1
    survey_runs: int = 3
    parts: int = 10
    proposals: int = 240
    pipelined_proposals: int = 112
    most_proposals: int = 720
    model_turn_proposals: int = 16
    parallel_proposals: int = 4
    groups_per_camera: int = 4
    temperatures: tuple[float, float] = 0.1, 0.003
    position_deviations_m: tuple[float, float] = 0.5, 0.02
    heading_deviations: tuple[float, float] = 0.5, 0.05


TUNING = LookaheadTuning()


class Lookahead(PipelinedPlanner):
    """
    Explore, plan on the observed cloud, and refine the plan while the cameras move to it.

    :param settings: of :class:`~ocp_ros.online.online_planner.Online`.
    :ivar places: the placements of the episode; the survey begins with the best of them.
    """

    def __init__(self, *settings) -> None:
        super().__init__(*settings)
        self.reset()

    def reset(self) -> None:
        """Discard the state of the last episode."""
        super().reset()
        self.targets = self.headings = None
        self.places = EpisodePlaces()
        self._candidates: Candidates | None = None
        self._choice: list[int] = []
        self._kept_model = KeptModel(self.max_range, self.wall_margin, *TUNING.refining_model)
        #: The remaining parts of the survey, see :meth:`_survey`.
        self._remaining_survey: Iterator[object] = iter(())
        self._is_explored = self._is_surveyed = False
        #: Turn in which the last refining model or the last candidates were created.
        self._model_turn = 0

    def _think(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Compute the plan for a turn; see :meth:`PipelinedPlanner._think`."""
        pipelined = self.plans_ahead(turns)
        if self._finishes(turn, turns):
            self._is_explored = turn >= TUNING.refining_share * turns
            is_complete = self._do_survey(cloud, positions, turn, turns)
            # An episode at once takes the best choice so far when the exploration is over.
            takes_plan = self._is_explored if self.at_once else is_complete
            if takes_plan and not self._is_surveyed and self._candidates is not None:
                self._set_plan(positions)
                self._is_surveyed = is_complete
            # The refinement begins as soon as the last part of the survey is done.
            if self._is_surveyed:
                self._refine(cloud, positions, turn, turns)
            return
        if (self._candidates is None or not pipelined
                or turn - self._model_turn >= TUNING.candidate_turns):
            self._create_candidates(cloud, positions, turn, turns)
        # In a pipelined episode, the greedy choice suffices for the first turn.
        if not (pipelined and self._waits_for_plan(turns, len(positions))):
            for choice in self._candidates.anneal(self._choice, self.rng,
                                                  TUNING.parts if self.at_once else 1):
                self._choice = choice
                if self.interrupted():
                    break
        self._set_plan(positions)

    def _record(self, positions: np.ndarray) -> None:
        """Record the places of the cameras too; see :meth:`PipelinedPlanner._record`."""
        super()._record(positions)
        self.places.add(positions, self.rig_state)

    def _finishes(self, turn: int, turns: int) -> bool:
        """Return whether the survey has begun in a turn."""
        # In an episode that plans ahead, the survey begins some turns before the exploration ends.
        lead = TUNING.survey_turns if self._is_paced(turns) else TUNING.lead_turns * self.at_once
        return turn >= TUNING.refining_share * turns - lead

    def _is_paced(self, turns: int) -> bool:
        """Return whether an episode is pipelined, with a fixed amount of work in each turn."""
        return self.plans_ahead(turns) and not self.at_once

    def _coarse_model(self, cloud: np.ndarray, positions: np.ndarray) -> PartialMap:
        """Return the model on which candidates are compared."""
        return PartialMap(cloud, positions, self.max_range, *TUNING.candidate_model,
                          air_radius=AIR_RADIUS_M if self.directional else 0.0)

    def _scouted(self, cloud: np.ndarray, positions: np.ndarray, goals: np.ndarray, turn: int,
                 turns: int) -> np.ndarray:
        """
        Return goals (K, 2) in which cameras scout; in long episodes and at their end the same.

        See :func:`~ocp_ros.online.episode_places.scouted`.
        """
        left = TUNING.refining_share * turns - turn
        if left <= 0.0 or turns >= MIN_PIPELINED_TURNS or not len(cloud):
            return goals
        with suppress(SceneError):
            model = self._coarse_model(cloud, positions)
            return scouted(model, self.space(cloud, positions), self.memory.unseen(model),
                           self.rig_state, positions, goals, self.max_step, max(left, 1.0))
        return goals

    def _create_candidates(self, cloud: np.ndarray, positions: np.ndarray, turn: int,
                           turns: int) -> None:
        """Create candidates, the current plan included, and choose the best plan."""
        model = self._coarse_model(cloud, positions)
        unseen = self.memory.unseen(model)
        self._space = self.space(cloud, positions)
        self._choose_plan(model, self._space, unseen, cell_weight(model, unseen, turn, turns),
                          self._current_plans(len(positions)), len(positions))
        self._model_turn = turn

    def _choose_plan(self, model: PartialMap, space: FreePlane, unseen: np.ndarray, weight: float,
                     plans: list[np.ndarray], cameras: int) -> None:
        """
        Create candidates on a model, and choose the best plan among given ones and a greedy one.

        :param weight: bonus for each covered cell of ``unseen`` (packed bits), metres.
        :param plans: placements (K, 6), metres and radians; the list may be empty. A greedy plan
            is compared only if there is no current plan; in an episode at once only if ``plans``
            is empty, because it takes longer than all else.
        :param cameras: K, the number of movable cameras, which an empty list does not show.
        """
        count = int(np.clip(space.area / TUNING.spacing_m ** 2, 4, TUNING.max_positions))
        plans = [np.hstack([space.placement(space.inside(plan[:, :2])), plan[:, 3:]])
                 for plan in plans]
        state = self.rig_state or RigState.omnidirectional(cameras)
        positions = space.placement(space.grid(min(count, max_positions(state))))
        self._candidates = Candidates(model, positions, plans, state, unseen, weight)
        # The poses of the plans are the first candidates.
        choices = np.arange(len(plans) * cameras).reshape(-1, cameras).tolist()
        if not (choices if self.at_once else self._has_plan(cameras)):
            choices.append(self._candidates.choose_greedily())
        self._choice = min(choices, key=self._candidates.value)

    def _current_plans(self, cameras: int) -> list[np.ndarray]:
        """Return a list of the current plan, (K, 6) metres and radians, if any; z is not used."""
        if not self._has_plan(cameras):
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
        may_create = self.at_once or turn - self._model_turn >= TUNING.refining_turns
        if may_create and not self._kept_model.lasts(cloud, positions):
            self._create_refining_model(cloud, positions, turn)
        proposals = TUNING.pipelined_proposals if self._is_paced(turns) else TUNING.proposals
        if self.at_once:
            proposals = TUNING.most_proposals
        elif self._model_turn == turn:
            proposals = TUNING.model_turn_proposals
        # The survey has created the first model.
        model, self._space = self._kept_model.made
        spaces = [self._space.reached(position[:2], self.max_step, turns - turn)
                  for position in positions]
        targets = np.array([
            space.inside(target) for space, target in zip(spaces, self.targets, strict=True)])
        # The views of a group of proposals are computed in parallel. For each group: the elapsed
        # share of the refinement, which lasts from ``first_turn`` to the end of the episode.
        first_turn = TUNING.refining_share * turns
        shares = ((turn - first_turn + done / proposals) / (turns - first_turn)
                  for done in range(0, proposals, TUNING.parallel_proposals))
        refinement = Refinement(model, self.rig_state, spaces, self.rng)
        self.targets, self.headings = refinement.refined(
            targets, self._planned_headings(),
            takewhile(lambda _: not self.interrupted(), shares))

    def _create_refining_model(self, cloud: np.ndarray, positions: np.ndarray, turn: int) -> None:
        """Create the model for the refinement."""
        self._kept_model.make(cloud, positions, FINE, clearance_of(self.rig_state, self.clearance),
                              self._limit(cloud, positions))
        self._model_turn = turn

    def _do_survey(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> bool:
        """
        Do a part of the survey; all of it if the turn waits for its plan, or if there is time.

        :returns: whether the survey is complete.
        """
        # The first part creates the model; without a model the survey has not begun.
        if self._kept_model.made is None:
            self._remaining_survey = self._survey(cloud, positions, turn, turns)
        # Each item is a part that was just done, see :meth:`_survey`.
        for _ in self._remaining_survey:
            if self.interrupted() if self.at_once else (
                    not self._waits_for_plan(turns, len(positions))):
                return False
        return True

    def _survey(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int
                ) -> Iterator[object]:
        """
        Anneal once more among all candidates, on the model for the refinement.

        The first plans are the current one and the best combination of the places of the episode.

        :returns: an iterator with an item of no meaning after each part of the computation.
        """
        self._create_refining_model(cloud, positions, turn)
        model, space = self._kept_model.made
        # The first access computes the depth error; the first part ends with it.
        yield model.depth_error
        best = self.places.best(model, self.rig_state, positions,
                                reach=(turns - turn) * self.max_step)
        if self.at_once:
            yield
        self._choose_plan(model, space, self.memory.unseen(model), 0.0,
                          [*self._current_plans(len(positions)), best], len(positions))
        yield
        runs, parts = (TUNING.survey_runs, TUNING.parts) if self.at_once else (1, 2)
        for _ in range(runs):
            for choice in self._candidates.anneal(self._choice, self.rng, parts):
                self._choice = choice
                yield
            # Now a refinement is worth more than another run.
            if self._is_explored:
                break

    def _planned_headings(self) -> np.ndarray | None:
        """
        Return the headings (K, 3) of the plan; None if all cameras are omnidirectional.

        Cameras without a plan, and cameras that may not rotate, have their current headings.
        """
        if not self.directional:
            return None
        if self.headings is not None and self.rig_state.may_rotate:
            return self.headings
        return self.rig_state.placement[:self.rig_state.movable, 3:].copy()


class PlannedCamera(NamedTuple):
    """
    A camera in a plan.

    :ivar position: (3,) metres, map frame.
    :ivar heading: (3,) yaw, pitch, roll in radians; None if all cameras are omnidirectional.
    :ivar view: its view from there.
    """

    position: np.ndarray
    heading: np.ndarray | None
    view: View


#: The K movable cameras of a plan.
Plan = tuple[PlannedCamera, ...]


class Refinement:
    """
    Annealing of a plan in small steps.

    :param model: partial map of the observed cloud.
    :param rig_state: the rig; None if all cameras are omnidirectional.
    :param spaces: for each movable camera the positions that it can still reach.
    :param rng: draws the proposals.
    """

    def __init__(self, model: PartialMap, rig_state: RigState | None, spaces: Sequence[FreePlane],
                 rng: np.random.Generator) -> None:
        self.model, self.rig_state, self.spaces, self.rng = model, rig_state, spaces, rng
        self._fixed_views = fixed_views(model, rig_state)
        #: Number of the camera that the next proposals move.
        self._camera = 0
        #: Least depth error so far, metres; the start plan sets it before it is used.
        self._best_error = np.inf
        #: Number of the present group of proposals, and elapsed share, from 0 to 1.
        self._group = 0
        self._share = 0.0

    def refined(self, targets: np.ndarray, headings: np.ndarray | None, shares: Iterable[float]
                ) -> tuple[np.ndarray, np.ndarray | None]:
        """
        Return the best plan found.

        :param targets: (K, 2) metres: planned positions.
        :param headings: (K, 3) radians: planned headings; None if all cameras are omnidirectional.
        :param shares: elapsed share of the refinement, from 0 to 1, for each group of proposals.
        :returns: positions and headings of the same form.
        """
        # All spaces have the same height of the cameras.
        positions = self.spaces[0].placement(targets)
        plan = tuple(self._planned_camera(
            camera, position, None if headings is None else headings[camera])
            for camera, position in enumerate(positions))
        # The start plan is rated before the first proposals. Its error is the same whichever
        # camera is the moving one.
        self._move_next(plan, 0)
        best = annealed(plan, self._error_of, self._propose, self._temperatures(shares), self.rng)
        return (np.array([camera.position[:2] for camera in best]),
                None if headings is None else np.array([camera.heading for camera in best]))

    def _temperatures(self, shares: Iterable[float]) -> Iterator[float]:
        """Yield the temperature of each group of proposals, metres."""
        # The loop sets group and share also for the proposals of the group.
        for self._group, self._share in enumerate(shares):
            # An error counts as at least 1 mm, so the temperature is never 0.
            yield max(self._best_error, 1e-3) * between(*TUNING.temperatures, self._share)

    def _move_next(self, plan: Plan, camera: int) -> None:
        """Let the next proposals move a camera: merge the views of all others."""
        self._camera = camera
        others = [other.view for other in (*plan[:camera], *plan[camera + 1:])]
        self._error_with = self.model.depth_error.given(
            self.model.together(others + self._fixed_views).seen)

    def _error_of(self, plan: Plan, max_error: float) -> float:
        """Return the depth error of a plan, metres; above the limit, any value above it."""
        error = self._error_with(plan[self._camera].view.seen, max_error)
        self._best_error = min(self._best_error, error)
        return error

    def _propose(self, plan: Plan) -> Iterator[Plan]:
        """Yield plans with another pose of one camera; see :func:`annealed`."""
        if self._group % TUNING.groups_per_camera == 0:
            self._move_next(plan, int(self.rng.integers(len(plan))))
        camera = self._camera
        poses = [self._draw_pose(plan[camera]) for _ in range(TUNING.parallel_proposals)]
        for moved in mapped(lambda pose: self._planned_camera(camera, *pose), poses):
            yield (*plan[:camera], moved, *plan[camera + 1:])

    def _planned_camera(self, camera: int, position: np.ndarray, heading: np.ndarray | None
                        ) -> PlannedCamera:
        """Return a camera with its view from a pose."""
        return PlannedCamera(position, heading, view_from(
            self.model, self.rig_state, camera, position, heading))

    def _draw_pose(self, planned: PlannedCamera) -> tuple[np.ndarray, np.ndarray | None]:
        """Draw a pose near that of the camera that moves, within its space and its limits."""
        space = self.spaces[self._camera]
        target = space.reflected(planned.position[:2] + self.rng.normal(
            0.0, between(*TUNING.position_deviations_m, self._share), 2))
        position = space.placement(target[None])[0]
        state = self.rig_state
        if planned.heading is None or not state.may_rotate or self._camera not in state.aimed:
            return position, planned.heading
        heading = planned.heading.copy()
        heading[:2] += self.rng.normal(0.0, between(*TUNING.heading_deviations, self._share), 2)
        heading[1] = np.clip(heading[1], *state.pitch)
        return position, heading
