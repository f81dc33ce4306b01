# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Planners that know only what has been seen: they move cameras turn by turn, without a scan.

What they know of the room is the observed cloud;
:class:`~ocp_ros.agent.partial_map.PartialMap` makes an engine of it.
"""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.encoder import Encoder, order_of
from ocp_ros.agent.move_effects import CHOICES, greedy
from ocp_ros.agent.rig_state import clearance_of, RigState
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.rig.motion import bounded_moves, towards

if TYPE_CHECKING:
    from ocp_ros.agent.policy import Policy
    from ocp_ros.planners.lookahead import Lookahead

#: Metres: no way is worth that a camera takes the place of one of another kind.
UNLIKE = 1e6
#: Share of the turns after which plans are refined: before that too little has been seen.
REFINING = 0.6
#: Share of the turns that who explores plays, and how many it plays at least, before another
#: planner goes on with its plan.
HANDOVER, FIRST = 0.2, 3


def matched(positions: np.ndarray, targets: np.ndarray, kinds: np.ndarray | None = None
            ) -> np.ndarray:
    """
    Match targets with cameras, so that they walk least.

    :param positions: (K, 3) metres, where the cameras are.
    :param targets: (K, 2) metres, where they shall go.
    :param kinds: (K,) of cameras and of targets: a camera takes one of its kind; None for one
        kind.
    :returns: (K,) the target of each camera.
    """
    way = np.linalg.norm(positions[:, None, :2] - targets[None], axis=2)
    if kinds is not None:
        way = way + np.where(kinds[:, None] == kinds[None], 0.0, UNLIKE)
    return linear_sum_assignment(way)[1]


def shared_out(positions: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return targets (K, 2) in the order of the cameras at (K, 3), so that they walk least."""
    return targets[matched(positions, targets)]


class Online(ABC):
    """
    A planner that knows only what has been seen.

    :param rng: the only source of chance.
    :param max_step: farthest a camera moves in one turn, metres.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all points that were seen, metres.
    :ivar targets: (K, 2) metres, where each camera goes in the end; None for planners that do not
        say so, and before the first turn.
    """

    targets: np.ndarray | None = None

    def __init__(self, rng: np.random.Generator, max_step: float, max_range: float,
                 wall_margin: float, clearance: float = CLEARANCE) -> None:
        self.rng, self.max_step, self.max_range = rng, max_step, max_range
        self.wall_margin, self.clearance = wall_margin, clearance
        self.sight: RigState | None = None

    def know(self, sight: RigState | None) -> None:
        """Learn before a turn how the cameras stand and what each sees; None for all around."""
        self.sight = sight

    @property
    def headings(self) -> np.ndarray | None:
        """Return how the cameras would best be turned, (K, 3) radians, where a plan says so."""
        return None

    @property
    def directional(self) -> bool:
        """Return whether a camera is known not to be omnidirectional."""
        return self.sight is not None and bool(self.sight.aimed)

    def reset(self) -> None:  # noqa: B027
        """Forget the last episode; most planners remember nothing."""

    @abstractmethod
    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """
        Choose the next move of each camera.

        :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
        :param positions: (K, 3) metres: where the cameras are.
        :param turn: turns played so far.
        :param turns: turns of the whole episode.
        :returns: (K, 2) metres on the plane, none longer than ``max_step``.
        """

    def reflect(self) -> None:  # noqa: B027
        """
        Think about the next turn while the cameras move; most planners only answer.

        Who does not call it gets the same answers: :meth:`move` makes up for it.
        """

    def space(self, cloud: np.ndarray, positions: np.ndarray) -> FreePlane:
        """Return where the cameras may be as far as is known; the cloud is not empty."""
        return FreePlane.around(cloud, positions, self.wall_margin,
                                clearance_of(self.sight, self.clearance))

    def towards(self, positions: np.ndarray, targets: np.ndarray, steps: int = 1) -> np.ndarray:
        """
        Go from positions to targets as far as some steps reach.

        :param positions: (K, 3) or (K, 2) metres.
        :param targets: (K, 2) metres.
        :param steps: how many turns there are.
        :returns: (K, 2) metres.
        """
        return towards(positions[:, :2], targets, steps * self.max_step)

    def wander(self, cloud: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Move at random, for want of anything to plan with: (K, 2) metres."""
        moves = bounded_moves(self.rng.uniform(-1.0, 1.0, (len(positions), 2)), self.max_step)
        if len(cloud) == 0:
            return moves
        inside = self.space(cloud, positions).inside(positions[:, :2] + moves)
        return self.towards(positions, inside) - positions[:, :2]


class Learned(Online):
    """
    The moves that a trained policy finds best.

    :param policy: chooses them in units of ``max_step``.
    :param settings: of :class:`Online`.
    """

    def __init__(self, policy: 'Policy', *settings) -> None:
        super().__init__(*settings)
        self.policy = policy

    def know(self, sight: RigState | None) -> None:
        """Tell what the policy reads; see :meth:`Online.know`."""
        super().know(sight)
        self.policy.encoder.know(sight)

    def reset(self) -> None:
        """Forget the last episode."""
        self.policy.reset()

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        if len(cloud) == 0:
            return self.wander(cloud, positions)
        flat = positions[:, :2]
        moves = bounded_moves(self.policy.act(cloud, positions, turn, turns), self.max_step)
        return self.space(cloud, positions).moved(flat, moves, self.max_step) - flat


class GreedyStep(Online):
    """
    One camera after the other takes the best of a few moves, one turn ahead.

    It reads what the policy reads and chooses among the same moves: a control for learning.
    """

    def __init__(self, *settings) -> None:
        super().__init__(*settings)
        self._encoder = Encoder(AgentConfig(inputs='world'), self.max_range, self.max_step,
                                self.wall_margin, self.clearance)

    def know(self, sight: RigState | None) -> None:
        """Tell what is read; see :meth:`Online.know`."""
        super().know(sight)
        self._encoder.know(sight)

    def reset(self) -> None:
        """Forget what has been seen."""
        self._encoder.reset()

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        encoded = self._encoder.turn(cloud, positions, turn, turns)
        if not encoded.known:
            return self.wander(cloud, positions)
        for camera in order_of(turn, len(positions)):
            best = int(np.argmin(greedy(encoded.inputs(camera))))
            encoded.move(camera, CHOICES[best] / self.max_step)
        return (encoded.positions - positions)[:, :2]


class ThenLookahead(Online):
    """
    One planner explores and settles, another goes on with its placement on what has been seen.

    :param first: plays the first turns, such as :class:`~ocp_ros.planners.map_actor.MapActor`.
    :param lookahead: plays the others; it begins with the targets of the first, or without.
    """

    def __init__(self, first: Online, lookahead: 'Lookahead') -> None:
        super().__init__(first.rng, first.max_step, first.max_range, first.wall_margin,
                         first.clearance)
        self.first, self.lookahead = first, lookahead
        self._playing: Online = first

    @property
    def headings(self) -> np.ndarray | None:
        """Return those of the planner that has played last; see :attr:`Online.headings`."""
        return self._playing.headings

    def know(self, sight: RigState | None) -> None:
        """Tell both."""
        super().know(sight)
        self.first.know(sight)
        self.lookahead.know(sight)

    def reset(self) -> None:
        """Reset both."""
        self.first.reset()
        self.lookahead.reset()
        self._playing = self.first

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        planner = self.lookahead if turn >= max(HANDOVER * turns, FIRST) else self.first
        if planner is self.lookahead and planner is not self._playing:
            self.lookahead.take_over(self.first)
        self._playing = planner
        return planner.move(cloud, positions, turn, turns)

    def reflect(self) -> None:
        """Let the one that plays think; see :meth:`Online.reflect`."""
        self._playing.reflect()
