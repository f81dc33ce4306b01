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

"""Make the planner of ``policy_node`` from its parameters."""

from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import Online
from ocp_ros.policy.learned import Learned, PolicyAlone
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig

if TYPE_CHECKING:
    from ocp_ros.policy.checkpoint import Checkpoint


def make_planner(config: PolicyNodeConfig, checkpoint: 'Checkpoint | None'
                 ) -> tuple[Online, PolicyAlone | None]:
    """
    Build the planner that chooses the moves.

    :param config: parameters of the node: the name of the planner, and limits of the moves.
    :param checkpoint: weights of the policy; None if no policy is used.
    :returns: the planner, and its part that runs the policy (None without a policy).
    """
    rng = np.random.default_rng(config.seed)
    # The positional arguments of Online.
    settings = rng, config.max_step, config.max_range, config.wall_margin, config.clearance
    if checkpoint is None:
        return Lookahead(*settings), None
    # Imported only here: PyTorch takes longer to import than all other packages together.
    from ocp_ros.policy.policy import Policy
    from ocp_ros.ros.policy.recorded_policy import RecordedPolicy
    if config.explore:
        explorer = PolicyAlone(RecordedPolicy(checkpoint), *settings, drawn=True)
        return explorer, explorer
    learned = Learned(Policy(checkpoint), *settings)
    return learned, learned.agent


def planner_suits(planner_config: PolicyNodeConfig, config: PolicyNodeConfig) -> bool:
    """Return whether the planner made with one configuration also suits another."""
    # The constructor of a planner takes these parameters, which may change at run time.
    names = ('max_step', 'max_range', 'wall_margin', 'clearance')
    return all(getattr(planner_config, name) == getattr(config, name) for name in names)
