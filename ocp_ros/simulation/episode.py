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
One episode: a rig moves through a scene in turns, and all points seen are accumulated.

Each turn has a reward.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.rig.motion import shortened
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, RewardConfig
from ocp_ros.simulation.simulator import View


class RewardTerms(NamedTuple):
    """
    The reward of a turn and its terms.

    :ivar reward: the reward itself.
    :ivar delta_space_coverage: cubic metres gained.
    :ivar delta_depth_error: the reduction of the error of rewards, metres, see
        :meth:`~ocp_ros.simulation.problem.Problem.error`; positive is better.
    :ivar penalty: 1.0 if a camera was commanded to a position that is not allowed (on a plane:
        out of the bounding box), else 0.0.
    """

    reward: float
    delta_space_coverage: float
    delta_depth_error: float
    penalty: float


class Value(NamedTuple):
    """
    What rewards are computed from.

    :ivar space_coverage: of the current placement, cubic metres.
    :ivar error: the error of rewards, metres, see
        :meth:`~ocp_ros.simulation.problem.Problem.error`.
    :ivar explored: the share of the room's points that were seen since the episode began.
    """

    space_coverage: float
    error: float
    explored: float


#: Added to the reward of a turn, or K_P of the paper, if a command is not allowed.
PENALTY = -1.0
#: The reward of a state that no turn has led to.
NO_REWARD = RewardTerms(0.0, 0.0, 0.0, 0.0)


def potential(space_coverage: float, depth_error: float, volume: float, worst: float) -> float:
    """
    Return the potential of a placement, more is better; its change is the reward ``potential``.

    :param space_coverage: cubic metres.
    :param depth_error: metres.
    :param volume: the volume of the bounding box, cubic metres.
    :param worst: the depth error of seeing nothing, metres.
    """
    # 0.01 keeps the logarithm finite if the depth error is 0.
    return -2.0 * math.log(depth_error / worst + 0.01) + 3.0 * space_coverage / volume


def reward(before: Value, after: Value, outside: bool, volume: float, worst: float,
           config: RewardConfig) -> RewardTerms:
    """
    Return the reward of a turn.

    ``paper``: section III-C of arXiv 2110.11106, a weighted sum of the gain of coverage and the
    reduction of depth error, or a penalty, raised to the third power. The power has a flaw: a
    camera that moves away slowly and jumps back gains reward.

    ``potential``: the change of -2 ln(D / D_none + 0.01) + 3 x covered share of the volume, with
    depth error D, and D_none if nothing is seen. So the total reward of an episode depends only on
    its first and last placement. With the weight ``explored``, the potential also has the share of
    the points that were seen since the episode began.

    :param before: the value before the turn.
    :param after: the value after the turn.
    :param outside: whether a camera was commanded to a position that is not allowed.
    :param volume: the volume of the bounding box, cubic metres.
    :param worst: the depth error of seeing nothing, metres.
    :param config: the kind of reward and its weights.
    """
    coverage_gain = after.space_coverage - before.space_coverage
    error_reduction = before.error - after.error
    penalty = float(outside)
    if config.kind == 'paper':
        value = config.coverage * coverage_gain + config.depth_error * error_reduction
        # The penalty replaces the weighted sum if a position is not allowed.
        value = (value * (1.0 - penalty) + PENALTY * penalty) ** 3
    else:
        value = potential(*after[:2], volume, worst) - potential(*before[:2], volume, worst)
        value += config.explored * (after.explored - before.explored)
        value += PENALTY * penalty
    return RewardTerms(value, coverage_gain, error_reduction, penalty)


@dataclass(frozen=True)
class Turn:
    """
    The state after a turn.

    :ivar step: the number of turns since the episode began.
    :ivar positions: (K, 3) float64, metres, map frame.
    :ivar headings: (K, 3) float64, yaw, pitch and roll in radians.
    :ivar space_coverage: cubic metres, of the current placement.
    :ivar depth_error: metres, of the current placement.
    :ivar terms: the reward of the turn and its terms.
    :ivar truncated: whether the last turn of the episode has been played.
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
    Move the cameras of a rig that are to be placed, in one scene.

    :param problem: the rig in the scene.
    :param rng: the random generator that draws the start positions.
    :param cameras: the number of cameras; all cameras of the problem by default.
    :param config: the limits of the episode; those of the problem's settings by default.
    :ivar simulator: the engine.
    :ivar scene: the room.
    :ivar observed: the points seen since the episode began.
    :ivar turn: the state after the last turn.
    :ivar views: the current view of each camera that is to be placed.
    :ivar value: what rewards are computed from; see :meth:`value_of`.
    """

    def __init__(self, problem: Problem, rng: np.random.Generator,
                 cameras: int | None = None, config: EpisodeConfig | None = None) -> None:
        self.problem = problem
        self.simulator = problem.simulator
        self.scene = self.simulator.scene
        self.config = config or self.simulator.config.episode
        self.observed = problem.seen_by_fixed()
        #: Cached ``observed_cloud``; None if it has to be computed again.
        self._cloud: np.ndarray | None = None
        start = problem.start(
            rng, self.config, len(problem.rig.cameras) if cameras is None else cameras)
        self.turn = self._look(0, start)
        #: The value, the views and the points seen before the last turn; those of the start until
        #: the first turn.
        self._previous = self.value, self.views, self.observed

    @property
    def placement(self) -> np.ndarray:
        """Return the poses (K + F, 6), metres and radians, of K cameras, then of F in place."""
        poses = np.hstack([self.turn.positions, self.turn.headings])
        return np.vstack([poses, self.problem.fixed_poses])

    def move(self, moves: np.ndarray, headings: np.ndarray | None = None) -> Turn:
        """
        Move the cameras in one turn, and evaluate the new placement.

        :param moves: (K, 2) metres on the plane, or (K, 3), where a plane ignores the height;
            moves longer than ``max_step`` are shortened.
        :param headings: (K, 3) yaw, pitch and roll in radians; None keeps the headings.
        :returns: the new state, also kept as ``turn``.
        """
        moves = np.asarray(moves, dtype=np.float64)[:, :self.problem.dimensions]
        poses = np.hstack([self.turn.positions, self.turn.headings])
        targets = poses.copy()
        targets[:, :moves.shape[1]] += shortened(moves, self.config.max_step)
        if headings is not None:
            targets[:, 3:] = headings
        reached, outside = self.problem.reached_poses(poses, targets, self.config)
        self._previous = self.value, self.views, self.observed
        turn = self._look(self.turn.step + 1, reached)
        self.turn = replace(turn, terms=self.reward(self._previous[0], self.value, outside))
        return self.turn

    def shares(self, order: Sequence[int]) -> list[RewardTerms]:
        """
        Return the reward of each camera's last move, as if one camera moved after the other.

        For the ``potential`` reward, they add up to the reward of the turn without the penalty.

        :param order: the indices of the cameras, in the assumed order of their moves.
        :returns: one entry per camera, in this order.
        """
        before, previous_views, observed = self._previous
        views, shares = list(previous_views), []
        for camera in order:
            views[camera] = self.views[camera]
            observed |= Subset(views[camera].seen, observed.order)
            after = self.value_of(views, observed)
            shares.append(self.reward(before, after))
            before = after
        return shares

    def value_of(self, views: Sequence[View], observed: Subset) -> Value:
        """
        Return the value of a placement.

        :param views: the view of each camera that is to be placed.
        :param observed: the points seen since the episode began.
        """
        result = self.problem.evaluate_views(views)
        return Value(result.space_coverage, self.problem.error(result),
                     len(observed) / len(self.scene))

    def reward(self, before: Value, after: Value, outside: bool = False) -> RewardTerms:
        """
        Return the reward for a change of the value.

        :param before: the value before the change; see :meth:`value_of`.
        :param after: the value after it.
        :param outside: whether a target was not allowed.
        """
        return reward(before, after, outside, self.simulator.volume,
                      self.simulator.depth_error.worst, self.simulator.config.reward)

    def _look(self, step: int, poses: np.ndarray) -> Turn:
        """
        Set views and value to those of poses (K, 6); add the points seen to ``observed``.

        :returns: the new state without its reward, which :meth:`move` adds.
        """
        self.views = self.problem.look(poses)
        result = self.problem.evaluate_views(self.views)
        self.observed |= result.seen
        self.value = Value(result.space_coverage, self.problem.error(result),
                           len(self.observed) / len(self.scene))
        self._cloud = None
        return Turn(step, poses[:, :3].copy(), poses[:, 3:].copy(), result.space_coverage,
                    result.depth_error, NO_REWARD, truncated=step >= self.config.turns)

    @property
    def observed_cloud(self) -> np.ndarray:
        """
        Return all points seen since the episode began, in an array that must not be changed.

        :returns: (M, 3) float32, metres, map frame.
        """
        if self._cloud is None:
            self._cloud = self.scene.points.compress(self.observed.mask, axis=0)
        return self._cloud
