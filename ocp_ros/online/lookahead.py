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

import numpy as np
from ocp_ros.geometry.visibility import FINE
from ocp_ros.online.candidate_sites import Candidates, max_positions
from ocp_ros.online.online_planner import (
    KnownTurn,
    matched,
    Online,
    PipelinedPlanner,
    REFINING_SHARE,
)
from ocp_ros.online.partial_map import cell_weight, KeptModel, PartialMap
from ocp_ros.online.rig_state import AIR_RADIUS_M, clearance_of, fixed_views, RigState, view_from
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.util.annealing import between
from ocp_ros.util.threads import mapped

#: Metres between candidate positions; in a large room the spacing is larger.
SPACING_M = 0.5
#: Largest number of candidate positions.
MAX_PLACES = 400
#: Points and depth-map rows of the model on which candidates are compared.
QUICK_POINTS, QUICK_ROWS = 6000, 32
#: Time steps for which candidates are reused if plans are computed while the cameras move. Their
#: views are computed in the first of these time steps.
CANDIDATES_KEPT = 2
#: Points and depth-map rows of the model for the refinement.
REFINING_POINTS, REFINING_ROWS = 60000, 128
#: In an episode of many time steps: how many of them before the refinement that model is created,
#: and the parts of the annealing on it, each in a time step of its own.
SURVEY_AHEAD, SURVEY_PARTS = 2, 2
#: Smallest number of time steps for which that model is reused.
REFINING_KEPT = 4
#: Proposals in a time step of refinement: in a short episode, in one of many time steps, and in a
#: time step that also creates a model.
PROPOSALS, PROPOSALS_OF_MANY, PROPOSALS_WITH_MODEL = 240, 112, 16
#: Consecutive proposals for one camera: the views of the others are merged once for these.
IN_A_ROW = 16
#: First and last temperature of the refinement, in multiples of the best plan's error.
FIRST_TEMPERATURE, LAST_TEMPERATURE = 0.1, 0.003
#: Smallest error that is used to compute temperatures, metres.
MIN_ERROR_M = 1e-3
#: Standard deviation of the first and last changes of a position, metres.
FIRST_STEP_M, LAST_STEP_M = 0.5, 0.02
#: The same for headings of cameras that are not omnidirectional, radians.
FIRST_TURN, LAST_TURN = 0.5, 0.05
#: Proposals whose views are computed in parallel.
PARALLEL_PROPOSALS = 4


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
        self.targets, self.headings = None, None
        self._candidates: Candidates | None = None
        self._chosen: list[int] = []
        self._kept = KeptModel(self.max_range, self.wall_margin, REFINING_POINTS, REFINING_ROWS)
        #: The rest of the survey, see :meth:`_parts_of_survey`, and whether it is complete.
        self._survey: Iterator[object] = iter(())
        self._surveyed = False
        #: Time step in which the last model or the last candidates were created.
        self._made = 0

    def _think(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Compute the plan for a time step; see :meth:`PipelinedPlanner._think`."""
        ahead = self._ahead(turns)
        if turn >= REFINING_SHARE * turns - SURVEY_AHEAD * ahead:
            if self._surveyed or self._survey_on(cloud, positions, turn, turns):
                self._refine(cloud, positions, turn, turns)
            return
        if self._candidates is None or not ahead or turn - self._made >= CANDIDATES_KEPT:
            self._look_around(cloud, positions, turn, turns)
        # In an episode of many time steps, the greedy choice suffices for the first one.
        if not (ahead and self._waited_for(turn, turns, len(positions))):
            (self._chosen,) = self._candidates.anneal(self._chosen, self.rng)
        self._settle(positions)

    def _look_around(self, cloud: np.ndarray, positions: np.ndarray, turn: int,
                     turns: int) -> None:
        """Compute the views of new candidates, the current and proposed plans included."""
        model = PartialMap(cloud, positions, self.max_range, QUICK_POINTS, QUICK_ROWS,
                           around=AIR_RADIUS_M if self.directional else 0.0)
        unseen, self._space = self.memory.unseen(model), self.space(cloud, positions)
        plans = self._plans(len(positions))
        if self.guide is not None:
            self.guide.interrupted = self.interrupted
            plans.append(self.guide.propose(KnownTurn(
                cloud, positions, turn, turns, model, self._space, unseen)))
        self._list(model, self._space, unseen, cell_weight(model, unseen, turn, turns), plans,
                   len(positions))
        self._made = turn

    def _list(self, model: PartialMap, space: FreePlane, unseen: np.ndarray, weight: float,
              plans: list[np.ndarray], cameras: int) -> None:
        """List candidates, first the poses of some plans (K, 6), and choose the best plan."""
        count = int(np.clip(space.area / SPACING_M ** 2, 4, MAX_PLACES))
        plans = [np.hstack([space.placement(space.inside(plan[:, :2])), plan[:, 3:]])
                 for plan in plans]
        state = self.rig_state or RigState.omnidirectional(cameras)
        places = space.placement(space.grid(min(count, max_positions(state))))
        self._candidates = Candidates(model, places, plans, state, unseen, weight)
        begun = np.arange(len(plans) * cameras).reshape(-1, cameras).tolist()
        if not self._planned(cameras):
            begun.append(self._candidates.choose_greedily())
        self._chosen = min(begun, key=self._candidates.value)

    def _plans(self, cameras: int) -> list[np.ndarray]:
        """Return the current plan, (K, 6) metres and radians, in a list, or []; z is not used."""
        if not self._planned(cameras):
            return []
        headings = self._planned_headings() if self.directional else np.zeros((cameras, 3))
        return [np.hstack([self.targets, np.zeros((cameras, 1)), headings])]

    def _settle(self, positions: np.ndarray) -> None:
        """Assign the chosen sites to the cameras with the shortest total path."""
        poses = self._candidates.poses[self._chosen]
        poses = poses[matched(positions, poses[:, :2], self._candidates.kind_of)]
        self.targets, self.headings = poses[:, :2], poses[:, 3:] if self.directional else None

    def _refine(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Anneal the plan in small steps, among the positions that the cameras can still reach."""
        if turn - self._made >= REFINING_KEPT and not self._kept.lasts(cloud, positions):
            self._make_model(cloud, positions, turn)
        steps = PROPOSALS_OF_MANY if self._ahead(turns) else PROPOSALS
        if self._made == turn:
            steps = PROPOSALS_WITH_MODEL
        (model, self._space), first = self._kept.made, REFINING_SHARE * turns
        reached = [self._space.reached(position[:2], self.max_step, turns - turn)
                   for position in positions]
        placed = best = np.array([
            area.inside(place) for area, place in zip(reached, self.targets, strict=True)])
        headings = best_headings = self._planned_headings()
        views = [view_from(model, self.rig_state, camera, position,
                           None if headings is None else headings[camera])
                 for camera, position in enumerate(self._space.placement(placed))]
        fixed = fixed_views(model, self.rig_state)
        error = best_error = model.error(views + fixed)
        for step in range(0, steps, PARALLEL_PROPOSALS):
            if self.interrupted():
                break
            if step % IN_A_ROW == 0:
                camera = int(self.rng.integers(len(placed)))
                others = model.together([*views[:camera], *views[camera + 1:], *fixed])
                error_with = model.depth_error.given(others.seen)
            share = (turn - first + step / steps) / (turns - first)
            temperature = max(best_error, MIN_ERROR_M) * between(
                FIRST_TEMPERATURE, LAST_TEMPERATURE, share)
            trials = [self._trial(camera, placed, headings, reached[camera], share)
                      for _ in range(PARALLEL_PROPOSALS)]
            looks = mapped(lambda trial, model=model, camera=camera: view_from(
                model, self.rig_state, camera, *trial), trials)
            for (position, heading), view in zip(trials, looks):
                most = error + temperature * self.rng.exponential()
                trial_error = error_with(view.seen, most)
                if trial_error > most:
                    continue
                placed, error = placed.copy(), trial_error
                placed[camera], views[camera] = position[:2], view
                if headings is not None:
                    headings = headings.copy()
                    headings[camera] = heading
                if error < best_error:
                    best, best_headings, best_error = placed, headings, error
        self.targets, self.headings = best, best_headings

    def _make_model(self, cloud: np.ndarray, positions: np.ndarray, turn: int) -> None:
        """Create the model for the refinement."""
        self._kept.make(cloud, positions, FINE, clearance_of(self.rig_state, self.clearance))
        self._made = turn

    def _survey_on(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> bool:
        """
        Do a part of the survey, or all of it if the time step waits for its plan.

        :returns: whether the survey is complete.
        """
        if self._kept.made is None:
            self._survey = self._parts_of_survey(cloud, positions, turn)
        for _ in self._survey:
            if not self._waited_for(turn, turns, len(positions)):
                return False
        self._settle(positions)
        self._surveyed = True
        return True

    def _parts_of_survey(self, cloud: np.ndarray, positions: np.ndarray, turn: int
                         ) -> Iterator[object]:
        """Anneal the plan once more among all candidates, on the model for the refinement."""
        self._make_model(cloud, positions, turn)
        model, space = self._kept.made
        # The depth error is computed when it is first needed.
        yield model.depth_error
        self._list(model, space, self.memory.unseen(model), 0.0, self._plans(len(positions)),
                   len(positions))
        yield
        for chosen in self._candidates.anneal(self._chosen, self.rng, SURVEY_PARTS):
            self._chosen = chosen
            yield

    def _trial(self, camera: int, placed: np.ndarray, headings: np.ndarray | None,
               space: FreePlane, share: float) -> tuple[np.ndarray, np.ndarray | None]:
        """
        Draw a pose near that of a camera, among the positions that it can reach.

        :returns: the position (3,) in metres, and the heading (3,) in radians; None if all cameras
            are omnidirectional.
        """
        place = space.reflected(
            placed[camera] + self.rng.normal(0.0, between(FIRST_STEP_M, LAST_STEP_M, share), 2))
        heading = None if headings is None else self._wiggled(
            headings[camera], camera, between(FIRST_TURN, LAST_TURN, share))
        return space.placement(place[None])[0], heading

    def _planned_headings(self) -> np.ndarray | None:
        """Return the headings (K, 3) of the plan; None if all cameras are omnidirectional."""
        if not self.directional:
            return None
        if self.headings is not None and self.rig_state.turns:
            return self.headings
        return self.rig_state.placement[:self.rig_state.movable, 3:].copy()

    def _wiggled(self, heading: np.ndarray, camera: int, most: float) -> np.ndarray:
        """Return a heading (3,) with random changes of yaw and pitch, within the limits."""
        if not self.rig_state.turns or camera not in self.rig_state.aimed:
            return heading
        turned = heading.copy()
        turned[:2] += self.rng.normal(0.0, most, 2)
        turned[1] = np.clip(turned[1], *self.rig_state.pitch)
        return turned
