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

"""One episode: a rig moves through a scene turn by turn, and what it has seen stays seen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from ocp_ros.rig.motion import shortened
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.reward import NO_REWARD, reward, RewardTerms
from ocp_ros.simulation.simulator import View


@dataclass(frozen=True)
class Turn:
    """
    The state after a turn.

    :ivar step: turns since the episode began.
    :ivar positions: (K, 3) float64, metres, map frame.
    :ivar headings: (K, 3) float64, yaw, pitch and roll in radians.
    :ivar space_coverage: cubic metres, of the current placement.
    :ivar depth_error: metres, of the current placement.
    :ivar terms: the turn's reward and what it is made of.
    :ivar truncated: whether the turns are used up.
    """

    step: int
    positions: np.ndarray
    headings: np.ndarray
    space_coverage: float
    depth_error: float
    terms: RewardTerms
    truncated: bool


class Episode:
    """
    Move the cameras of a rig that are to be placed in one scene.

    :param problem: the rig in the scene.
    :param rng: where the cameras start is drawn from it.
    :param cameras: how many there are; those of the problem by default.
    :ivar simulator: the engine.
    :ivar scene: the room.
    :ivar views: what each camera that is to be placed sees now.
    :ivar value: space coverage, cubic metres, and the error of rewards, metres, now; see
        :meth:`value_of`.
    """

    def __init__(self, problem: Problem, rng: np.random.Generator,
                 cameras: int | None = None) -> None:
        self.problem, self.simulator = problem, problem.simulator
        self.scene, self.config = self.simulator.scene, self.simulator.config.episode
        self.observed = problem.nothing()
        start = problem.start(
            rng, self.config, len(problem.rig.cameras) if cameras is None else cameras)
        self.turn = self._look(0, start)
        #: The value before the turn, and what each camera saw then.
        self._before = self.value, self.views

    @property
    def placement(self) -> np.ndarray:
        """Return all cameras, then those in place: (K + F, 6) metres, map frame, and radians."""
        moved = np.hstack([self.turn.positions, self.turn.headings])
        return np.vstack([moved, self.problem.fixed_poses])

    def move(self, moves: np.ndarray, headings: np.ndarray | None = None) -> Turn:
        """
        Play one turn.

        :param moves: (K, 2) metres on the plane, or (K, 3), of which a plane leaves out the
            height; a longer one than ``max_step`` is shortened.
        :param headings: (K, 3) yaw, pitch and roll in radians; None for cameras that stay turned
            as they are.
        :returns: the new state, also kept as ``turn``.
        """
        moves = np.asarray(moves, dtype=np.float64)[:, :self.problem.dimensions]
        poses = np.hstack([self.turn.positions, self.turn.headings])
        target = poses.copy()
        target[:, :moves.shape[1]] += shortened(moves, self.config.max_step)
        if headings is not None:
            target[:, 3:] = headings
        target, outside = self.problem.reached(poses, target, self.config)
        self._before = before, _ = self.value, self.views
        turn = self._look(self.turn.step + 1, target)
        self.turn = replace(turn, terms=self.reward(before, self.value, outside))
        return self.turn

    def shares(self, order: Sequence[int]) -> list[RewardTerms]:
        """
        Say what each camera's last move was worth, as if they had moved one after the other.

        Of a reward that telescopes, the shares add up to that of the turn.

        :param order: in which the cameras moved.
        :returns: one per camera, in this order.
        """
        before, views = self._before
        views, found = list(views), []
        for camera in order:
            views[camera] = self.views[camera]
            after = self.value_of(views)
            found.append(self.reward(before, after))
            before = after
        return found

    def value_of(self, views: Sequence[View]) -> tuple[float, float]:
        """Return space coverage, cubic metres, and the error of rewards, metres, of views."""
        result = self.problem.judge(views)
        return result.space_coverage, self.problem.error(result)

    def reward(self, before: tuple[float, float], after: tuple[float, float],
               outside: bool = False) -> RewardTerms:
        """Reward what led from one value, of :meth:`value_of`, to another."""
        return reward(before, after, outside, self.simulator.volume,
                      self.simulator.depth_error.worst, self.simulator.config.reward)

    def _look(self, step: int, poses: np.ndarray) -> Turn:
        """Judge the placement (K, 6) and remember what it sees."""
        self.views = self.problem.look(poses)
        result = self.problem.judge(self.views)
        self.value = result.space_coverage, self.problem.error(result)
        self.observed |= result.seen
        return Turn(step, poses[:, :3].copy(), poses[:, 3:].copy(), result.space_coverage,
                    result.depth_error, NO_REWARD, truncated=step >= self.config.turns)

    @property
    def observed_cloud(self) -> np.ndarray:
        """Return all points seen since the episode began: (M, 3) float32, metres, map frame."""
        return self.scene.points.compress(self.observed.mask, axis=0)
