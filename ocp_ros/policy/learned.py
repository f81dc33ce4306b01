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
Planner ``learned``: a trained policy explores, then lookahead's search finishes.

This module does not import torch.
"""

import logging
from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.online.lookahead import Lookahead, TUNING
from ocp_ros.online.online_planner import Allowed, Online, PlannedTurn
from ocp_ros.online.rig_state import RigState
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.rig.motion import bounded_moves

if TYPE_CHECKING:
    from ocp_ros.policy.policy import Policy

_log = logging.getLogger(__name__)


class PolicyAlone(Online):
    """
    Move cameras by a trained policy alone, without any search.

    :param policy: chooses moves in units of ``max_step``.
    :param settings: positional arguments of :class:`Online`.
    :param drawn: whether moves are drawn from the policy's distribution; otherwise they are the
        most probable ones.
    """

    def __init__(self, policy: 'Policy', *settings, drawn: bool = False) -> None:
        super().__init__(*settings)
        self._drawn = drawn
        self._is_checked = False
        self._encoder = Encoder(policy.checkpoint.config, self.max_range, self.max_step,
                                self.wall_margin, self.clearance)
        self.use(policy)

    def use(self, policy: 'Policy') -> None:
        """Continue with a policy, which may have other weights of the same network."""
        self.policy = policy
        policy.encoder = self._encoder

    def set_rig_state(self, rig_state: RigState | None) -> None:
        """Set the rig state of the encoder too; see :meth:`Online.set_rig_state`."""
        super().set_rig_state(rig_state)
        self._encoder.partial_maps.rig_state = rig_state

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self._encoder.partial_maps.reset()

    def _check_domain(self, cameras: int, turns: int) -> None:
        """Warn once if the rig or the episode is outside of what the weights have learned."""
        if self._is_checked:
            return
        self._is_checked = True
        found = {'cameras': cameras, 'turns': turns, 'max_step': self.max_step,
                 'max_range': self.max_range}
        outside = [f'{name} {found[name]:g} (learned: {low:g} to {high:g})'
                   for name, (low, high) in self.policy.checkpoint.domain.items()
                   if name in found and not low <= found[name] <= high]
        if outside:
            _log.warning(
                'model: found %s; expected values that the weights have learned; the agent '
                'explores all the same, perhaps badly; the planner lookahead needs no weights',
                ', '.join(outside))

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Return the next moves; see :meth:`Online.move`."""
        self._check_domain(len(positions), turns)
        if self._drawn:
            # A trainer learns from these moves, so nothing corrects them.
            return bounded_moves(self.policy.act(cloud, positions, turn, turns, self.rng),
                                 self.max_step)
        if len(cloud) == 0:
            return self.random_walk(cloud, positions)
        moves = bounded_moves(self.policy.act(cloud, positions, turn, turns), self.max_step)
        ends = self.space(cloud, positions).moved(positions[:, :2], moves, self.max_step)
        return ends - positions[:, :2]


class Learned(Lookahead):
    """
    Explore by a trained policy; then survey and refine as :class:`Lookahead` does.

    :param policy: chooses the moves of the exploration.
    :param settings: positional arguments of :class:`Online`.
    :ivar agent: the policy alone.
    :ivar explorer: moves the cameras until there is a plan: the agent.
    """

    def __init__(self, policy: 'Policy', *settings) -> None:
        self.agent = PolicyAlone(policy, *settings)
        self.explorer: Online = self.agent
        super().__init__(*settings)

    def set_rig_state(self, rig_state: RigState | None) -> None:
        """Set the rig state of the explorer too; see :meth:`Online.set_rig_state`."""
        super().set_rig_state(rig_state)
        self.explorer.set_rig_state(rig_state)

    def limit_to(self, allowed: Allowed | None) -> None:
        """Limit the explorer too; see :meth:`Online.limit_to`."""
        super().limit_to(allowed)
        self.explorer.limit_to(allowed)

    def reset(self) -> None:
        """Discard the state of the last episode."""
        super().reset()
        self.explorer.reset()

    def _waits_for_plan(self, turns: int, cameras: int) -> bool:
        """Return False in a pipelined episode: until there is a plan, the explorer moves."""
        return not self.plans_ahead(turns)

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Return the next moves; see :meth:`Online.move`."""
        # Do a part of the survey here if no caller did it while the cameras moved.
        self.plan_ahead()
        if self._has_plan(len(positions)) or (
                not self.plans_ahead(turns) and turn >= TUNING.refining_share * turns):
            return super().move(cloud, positions, turn, turns)
        self._record(positions)
        moves = self.explorer.move(cloud, positions, turn, turns)
        moves = self._scouted(cloud, positions, positions[:, :2] + moves, turn, turns
                              ) - positions[:, :2]
        if self.plans_ahead(turns) and turn + 1 < turns and self._finishes(turn + 1, turns):
            ends = positions + np.column_stack([moves, np.zeros(len(moves))])
            self._next_turn = PlannedTurn(cloud.copy(), ends, turn + 1, turns, self.rig_state)
        return moves
