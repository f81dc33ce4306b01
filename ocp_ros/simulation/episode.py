# SPDX-License-Identifier: Apache-2.0
"""One episode: a rig moves through a scene turn by turn, and what it has seen stays seen."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ocp_ros.rig.motion import drawn_near, kept_inside
from ocp_ros.simulation.reward import NO_REWARD, reward, RewardTerms
from ocp_ros.simulation.simulator import Simulator, View


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
    Move a rig in one scene.

    :param simulator: the engine for the scene.
    :param rng: where the cameras start is drawn from it.
    :param cameras: how many there are; those of the simulator's rig unless told otherwise.
    """

    def __init__(self, simulator: Simulator, rng: np.random.Generator,
                 cameras: int | None = None) -> None:
        self.simulator, self.scene = simulator, simulator.scene
        rig = simulator.config.rig
        self.rig = rig if cameras is None else replace(rig, cameras=cameras)
        self.config = simulator.config.episode
        self.observed = simulator.nothing()
        self._views: list[View] = []
        self.turn = self._look(0, self._start(rng), self.rig.headings)
        #: The turn before, and what each camera saw then.
        self._before = self.turn, self._views

    def _start(self, rng: np.random.Generator) -> np.ndarray:
        """Draw the cameras' positions around the centre: (K, 3) metres."""
        positions = np.empty((self.rig.cameras, 3))
        positions[:, :2] = self.scene.bounds.mean(axis=0)[:2]
        positions[:, :2] += drawn_near(rng, len(positions), self.config.start_radius)
        positions[:, 2] = self.simulator.height
        return kept_inside(positions, self.scene.bounds, self.config.wall_margin)[0]

    def move(self, moves: np.ndarray, headings: np.ndarray | None = None) -> Turn:
        """
        Play one turn.

        :param moves: (K, 2) metres on the plane; a longer one than ``max_step`` is shortened.
        :param headings: (K, 3) yaw, pitch and roll in radians; None for cameras that stay turned
            as they are.
        :returns: the new state, also kept as ``turn``.
        """
        moves = np.asarray(moves, dtype=np.float64)
        length = np.linalg.norm(moves, axis=1, keepdims=True)
        target = self.turn.positions.copy()
        target[:, :2] += moves * np.minimum(
            self.config.max_step / np.maximum(length, 1e-12), 1.0)
        target, outside = kept_inside(target, self.scene.bounds, self.config.wall_margin)
        before, self._before = self.turn, (self.turn, self._views)
        self.turn = self._look(before.step + 1, target,
                               before.headings if headings is None else headings)
        simulator = self.simulator
        terms = reward((before.space_coverage, before.depth_error),
                       (self.turn.space_coverage, self.turn.depth_error), outside,
                       simulator.volume, simulator.depth_error.worst, simulator.config.reward)
        self.turn = Turn(**{**vars(self.turn), 'terms': terms})
        return self.turn

    def shares(self, order: Sequence[int]) -> list[RewardTerms]:
        """
        Say what each camera's last move was worth, as if they had moved one after the other.

        Of a reward that telescopes, the shares add up to that of the turn.

        :param order: in which the cameras moved.
        :returns: one per camera, in this order.
        """
        turn, views = self._before
        views, simulator, found = list(views), self.simulator, []
        before = turn.space_coverage, turn.depth_error
        for camera in order:
            views[camera] = self._views[camera]
            result = simulator.judge(views)
            after = result.space_coverage, result.depth_error
            found.append(reward(before, after, False, simulator.volume,
                                simulator.depth_error.worst, simulator.config.reward))
            before = after
        return found

    def _look(self, step: int, positions: np.ndarray, headings: np.ndarray) -> Turn:
        """Judge the placement and remember what it sees."""
        self._views = [self.simulator.look(pose, camera) for camera, pose in enumerate(
            np.hstack([positions, headings]))]
        result = self.simulator.judge(self._views)
        self.observed |= result.seen
        return Turn(step, positions, headings, result.space_coverage, result.depth_error,
                    NO_REWARD, truncated=step >= self.config.turns)

    @property
    def observed_cloud(self) -> np.ndarray:
        """Return all points seen since the episode began: (M, 3) float32, metres, map frame."""
        return self.scene.points[self.observed.mask]
