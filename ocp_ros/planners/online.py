# SPDX-License-Identifier: Apache-2.0
"""
Planners that know only what has been seen: they move cameras turn by turn, without a scan.

What they know of the room is the observed cloud; :class:`Observed` makes an engine of it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
import time
from typing import TYPE_CHECKING

import numpy as np

from ocp_ros.geometry.blocks import count_bits, no_bits, pack, unpack
from ocp_ros.geometry.cameras import CameraModel, Pose
from ocp_ros.geometry.clouds import fixed_size
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.geometry.surfels import SurfelSettings
from ocp_ros.geometry.visibility import FAST, SurfelVisibility
from ocp_ros.planners.space import Space
from ocp_ros.scenes.scene import Scene, SceneError, voxel_downsample, voxel_size_for
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.moves import bounded_moves, towards
from ocp_ros.simulation.simulator import ERROR_CUBE, View

if TYPE_CHECKING:
    from ocp_ros.agent.policy import Policy

#: Metres: edge of the cells of the air. They are anchored to the map frame's origin, so that they
#: stay the same while the observed bounding box grows.
CELL = 0.5
#: The most cells of the air: where there are more, their edge is doubled until there are not.
MOST_CELLS = 20_000
#: Cells are numbered by three numbers of 21 bits each.
BITS, OFFSET = 21, 1 << 20
#: Points of a cloud per point wanted: of what is denser, points are left out before voxels are
#: sought, which takes long.
DENSE = 4
#: Points and rows of depth maps of a model for quick decisions.
QUICK_POINTS, QUICK_ROWS = 6000, 32
#: What covering all unseen cells is worth at first, as a share of the error of seeing nothing, and
#: the share of the turns after which it is worth nothing.
CURIOSITY, EXPLORING = 2.0, 0.55
#: The hand rule's moves: how many directions, and how far, metres.
DIRECTIONS, LENGTHS = 8, (0.12, 0.5)


class Online(ABC):
    """
    A planner that knows only what has been seen.

    :param rng: the only source of chance.
    :param max_step: farthest a camera moves in one turn, metres.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    """

    def __init__(self, rng: np.random.Generator, max_step: float, max_range: float,
                 wall_margin: float) -> None:
        self.rng, self.max_step = rng, max_step
        self.max_range, self.wall_margin = max_range, wall_margin

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

    def space(self, cloud: np.ndarray, positions: np.ndarray) -> Space:
        """Return where the cameras may be as far as is known; the cloud is not empty."""
        return Space.of(cloud, float(positions[0, 2]), len(positions), self.wall_margin)

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


@dataclass(frozen=True)
class Outcome:
    """
    An episode that an online planner has played.

    :ivar trajectory: (T + 1, K, 3) metres: where the cameras were, the start first.
    :ivar depth_error: (T + 1,) metres, of the placement at each of these.
    :ivar seconds: (T,) how long the planner thought at each turn.
    """

    trajectory: np.ndarray
    depth_error: np.ndarray
    seconds: np.ndarray


def play(online: Online, episode: Episode,
         clock: Callable[[], float] = time.perf_counter) -> Outcome:
    """
    Play an episode to its end.

    :param online: moves the cameras; it is reset first.
    :param episode: a new one.
    :param clock: tells the seconds.
    """
    online.reset()
    states, seconds = [episode.turn], []
    while not episode.turn.truncated:
        cloud = episode.observed_cloud
        began = clock()
        moves = online.move(cloud, episode.turn.positions, episode.turn.step,
                            episode.config.turns)
        seconds.append(clock() - began)
        states.append(episode.move(moves))
    return Outcome(np.array([state.positions for state in states]),
                   np.array([state.depth_error for state in states]), np.array(seconds))


class Observed:
    """
    The engine on what has been seen, and the cells of the air within its bounding box.

    :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
    :param max_range: of the cameras, metres.
    :param most: a cloud of more points is thinned to at most as many.
    :param rows: rows of the depth maps of the error.
    :param settings: rules of visibility.
    :ivar cells: (C,) int64, the number of each cell, in the order of the bits of a view.
    :raises SceneError: if the points are too few or too flat to be a room.
    """

    def __init__(self, cloud: np.ndarray, max_range: float, most: int, rows: int,
                 settings: SurfelSettings = FAST) -> None:
        scene = Scene(thinned(cloud, most), 'observed cloud')
        centres, numbers = cells_of_the_air(scene.bounds)
        self.visibility = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch,
                                           centres, settings)
        order = self.visibility.order
        self.cells = numbers[self.visibility.place_order]
        self.depth_error = DepthError(scene.points[order], scene.spacing[order], scene.bounds,
                                      rows, ERROR_CUBE)
        self._lens = CameraModel(max_range=max_range).lens

    def look(self, position: np.ndarray) -> View:
        """Compute what a camera at a position (3,) would see of what is known."""
        view = View(no_bits(len(self.visibility.order)), no_bits(len(self.cells)))
        self.visibility.look(Pose.of(position), self._lens, *view)
        return view

    def error(self, views: list[View]) -> float:
        """Return the depth error of some views together, metres."""
        return self.depth_error(np.bitwise_or.reduce([view.seen for view in views]))

    def covered(self, positions: np.ndarray) -> np.ndarray:
        """Return the numbers of the cells that cameras at positions (K, 3) cover together."""
        bits = np.bitwise_or.reduce([self.look(position).covered for position in positions])
        return self.cells[unpack(bits, len(self.cells))]


class Memory:
    """Which cells of the air some camera has covered since the episode began."""

    def __init__(self) -> None:
        self._seen = np.empty(0, dtype=np.int64)
        self._visited: list[np.ndarray] = []

    def visit(self, positions: np.ndarray) -> None:
        """Remember where the cameras were at a turn: (K, 3) metres."""
        self._visited.append(positions.copy())

    def unseen(self, model: Observed) -> np.ndarray:
        """Return packed bits of a model's cells: those that no camera covered, as far as known."""
        covered = [model.covered(positions) for positions in self._visited]
        self._seen = np.unique(np.concatenate([self._seen, *covered]))
        self._visited.clear()
        return pack(~np.isin(model.cells, self._seen))


def thinned(cloud: np.ndarray, most: int) -> np.ndarray:
    """Return at most so many points of a cloud (M, 3), evenly spread where there are more."""
    if len(cloud) <= most:
        return cloud
    if len(cloud) > DENSE * most:
        cloud = fixed_size(cloud, DENSE * most)
    return voxel_downsample(cloud, voxel_size_for(cloud, most))


def curiosity(turn: int, turns: int) -> float:
    """Return what covering all unseen cells is worth at a turn, in errors of seeing nothing."""
    return CURIOSITY * max(1.0 - turn / (EXPLORING * turns), 0.0)


def cell_weight(model: Observed, unseen: np.ndarray, turn: int, turns: int) -> float:
    """Return what covering one of a model's unseen cells is worth, metres of depth error."""
    return curiosity(turn, turns) * model.depth_error.worst / max(int(count_bits(unseen)), 1)


def cells_of_the_air(bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    List the cells of a grid whose centres are inside a bounding box.

    :param bounds: (2, 3) metres.
    :returns: centres (C, 3) float32, metres, and numbers (C,) int64 that name the cells in any
        bounding box.
    """
    edge = CELL
    while np.prod(np.ptp(bounds, axis=0) / edge) > MOST_CELLS:
        edge *= 2.0
    first = np.ceil(bounds[0] / edge - 0.5).astype(np.int64)
    last = np.floor(bounds[1] / edge - 0.5).astype(np.int64)
    axes = [np.arange(first[k], last[k] + 1) for k in range(3)]
    index = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    shifted = index + OFFSET
    numbers = (shifted[:, 0] << 2 * BITS) | (shifted[:, 1] << BITS) | shifted[:, 2]
    return ((index + 0.5) * edge).astype(np.float32), numbers


class Learned(Online):
    """
    The moves that a trained policy finds most likely.

    :param policy: chooses them in units of ``max_step``.
    :param settings: of :class:`Online`.
    """

    def __init__(self, policy: 'Policy', *settings) -> None:
        super().__init__(*settings)
        self.policy = policy

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        if len(cloud) == 0:
            return self.wander(cloud, positions)
        flat = positions[:, :2]
        moves = bounded_moves(self.policy.act(cloud, positions), self.max_step)
        return self.space(cloud, positions).moved(flat, moves, self.max_step) - flat


class HandRule(Online):
    """
    One camera after the other takes the best of a few moves, one turn ahead.

    Moves are judged by the depth error of the observed cloud and the unseen cells they cover.
    """

    def __init__(self, *settings) -> None:
        super().__init__(*settings)
        self.reset()

    def reset(self) -> None:
        """Forget what has been seen."""
        self._memory = Memory()

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        self._memory.visit(positions)
        try:
            model = Observed(cloud, self.max_range, QUICK_POINTS, QUICK_ROWS)
        except SceneError:
            return self.wander(cloud, positions)
        unseen, space = self._memory.unseen(model), self.space(cloud, positions)
        weight = cell_weight(model, unseen, turn, turns)
        placed = positions[:, :2].copy()
        views = [model.look(position) for position in space.placement(placed)]
        for camera in range(len(placed)):
            trials = self._trials(space, placed[camera])
            looks = [model.look(position) for position in space.placement(trials)]
            values = []
            for look in looks:
                views[camera] = look
                covered = np.bitwise_or.reduce([view.covered for view in views]) & unseen
                values.append(model.error(views) - weight * int(count_bits(covered)))
            choice = int(np.argmin(values))
            placed[camera], views[camera] = trials[choice], looks[choice]
        return placed - positions[:, :2]

    def _trials(self, space: Space, position: np.ndarray) -> np.ndarray:
        """Return the places (T, 2) that a camera at (2,) may go to; the first is where it is."""
        angles = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
        ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        moves = np.vstack([np.zeros((1, 2)), *(length * ways for length in LENGTHS)])
        start = np.repeat(position[None], len(moves), axis=0)
        return self.towards(start, space.inside(start + moves))


class ThenLookahead(Online):
    """
    One planner first, another in the last turns.

    :param first: plays until then, such as :class:`Learned`.
    :param lookahead: plays the last turns.
    :param switch: how many these are.
    """

    def __init__(self, first: Online, lookahead: Online, switch: int) -> None:
        super().__init__(first.rng, first.max_step, first.max_range, first.wall_margin)
        self.first, self.lookahead, self.switch = first, lookahead, switch

    def reset(self) -> None:
        """Reset both."""
        self.first.reset()
        self.lookahead.reset()

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        online = self.first if turn < turns - self.switch else self.lookahead
        return online.move(cloud, positions, turn, turns)
