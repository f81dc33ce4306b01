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
Rewards of one turn.

``paper``: section III-C of arXiv 2110.11106, a weighted sum of the gain of coverage and the
reduction of depth error, or a penalty, raised to the third power. The power has a flaw: a camera
that moves away slowly and jumps back gains reward.

``potential``: the change of -2 ln(D / D_none + 0.01) + 3 x covered share of the volume, with depth
error D, and D_none if nothing is seen. So the total reward of an episode depends only on its first
and last placement. With the weight ``explored``, the potential also has the share of the points
that were seen since the episode began.
"""

import math
from typing import NamedTuple

from ocp_ros.simulation.simulation_config import RewardConfig


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
