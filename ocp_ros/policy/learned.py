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

"""The online planner that moves cameras by a trained policy."""

from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.online.online_planner import Online
from ocp_ros.online.rig_state import RigState
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.policy.map_actor import MapActor
from ocp_ros.rig.motion import bounded_moves

if TYPE_CHECKING:
    from ocp_ros.policy.policy import Policy, ValuePolicy


class Learned(Online):
    """
    Move cameras by a trained policy that reads the observed cloud.

    :param policy: chooses moves in units of ``max_step``.
    :param settings: positional arguments of :class:`Online`.
    """

    def __init__(self, policy: 'Policy', *settings) -> None:
        super().__init__(*settings)
        self.policy = policy

    def set_rig_state(self, rig_state: RigState | None) -> None:
        """Set the rig state of the policy's encoder too; see :meth:`Online.set_rig_state`."""
        super().set_rig_state(rig_state)
        self.policy.encoder.partial_maps.rig_state = rig_state

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self.policy.reset()

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Return the next moves; see :meth:`Online.move`."""
        if len(cloud) == 0:
            return self.random_walk(cloud, positions)
        start = positions[:, :2]
        moves = bounded_moves(self.policy.act(cloud, positions, turn, turns), self.max_step)
        return self.space(cloud, positions).moved(start, moves, self.max_step) - start


def planned_by(policy: 'Policy | ValuePolicy', settings: tuple) -> Learned | MapActor:
    """
    Return the online planner that moves cameras by a policy.

    :param policy: from :func:`ocp_ros.policy.policy.make_policy`.
    :param settings: positional arguments of :class:`~ocp_ros.online.online_planner.Online`.
    """
    # This import loads torch; an import of the present module alone does not.
    from ocp_ros.policy.policy import ValuePolicy
    if isinstance(policy, ValuePolicy):
        return MapActor(policy, *settings)
    _, max_step, max_range, *margins = settings
    # The policy was made with an encoder for default settings.
    policy.encoder = Encoder(policy.checkpoint.config, max_range, max_step, *margins)
    return Learned(policy, *settings)
