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
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.policy.learned import Learned, planned_by
from ocp_ros.policy.map_actor import MapActor
from ocp_ros.policy.map_turn import MapTurn
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig

if TYPE_CHECKING:
    from ocp_ros.policy.checkpoint import Checkpoint


class ExploringMap(MapActor):
    """Draw target positions from the distribution that a trained map actor gives."""

    def _ahead(self, turns: int) -> bool:
        """Return False: plan nothing ahead, since each turn publishes its own observation."""
        return False

    def choose(self, map_turn: MapTurn, camera: int, elapsed_share: float) -> None:
        """Draw the target position of a camera, and send the camera there."""
        map_turn.send_to(camera, self.policy.draw(map_turn.experience(camera), self.rng))


class Exploring(Learned):
    """Draw moves from the distribution that a trained policy gives."""

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.online.online_planner.Online.move`."""
        actions = self.policy.act(cloud, positions, turn, turns, self.rng)
        return bounded_moves(actions, self.max_step)


def make_planner(config: PolicyNodeConfig, checkpoint: 'Checkpoint | None'
                 ) -> tuple[Online, Learned | MapActor | None]:
    """
    Build the planner that chooses the moves.

    :param config: parameters of the node: the name of the planner, and limits of the moves.
    :param checkpoint: weights of the policy; None if no policy is used.
    :returns: the planner, and its part that runs the policy (None without a policy).
    """
    rng = np.random.default_rng(config.seed)
    margins = config.wall_margin, config.clearance
    # The positional arguments of Online.
    settings = rng, config.max_step, config.max_range, *margins
    if checkpoint is None:
        return Lookahead(*settings), None
    # Imported only here: PyTorch takes longer to import than all other packages together.
    from ocp_ros.policy.policy import make_policy
    from ocp_ros.ros.policy.recorded_policy import RecordedPolicy, RecordedValues
    if config.explore:
        explorer: Learned | MapActor
        if checkpoint.config.map:
            explorer = ExploringMap(RecordedValues(checkpoint), *settings)
        else:
            encoder = Encoder(checkpoint.config, config.max_range, config.max_step, *margins)
            explorer = Exploring(RecordedPolicy(checkpoint, encoder), *settings)
        return explorer, explorer
    learned = planned_by(make_policy(checkpoint), settings)
    if config.planner == 'learned':
        return learned, learned
    return Lookahead(*settings, guide=learned), learned


def planner_suits(planner_config: PolicyNodeConfig, config: PolicyNodeConfig) -> bool:
    """Return whether the planner made with one configuration also suits another."""
    # The constructor of a planner takes these parameters, which may change at run time.
    names = ('max_step', 'max_range', 'wall_margin', 'clearance')
    return all(getattr(planner_config, name) == getattr(config, name) for name in names)
