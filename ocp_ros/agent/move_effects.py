# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
World-model inputs: what some moves of each camera would change on what has been seen.

Around each camera some places are tried on the observed cloud as if it were the room: by how much
the depth error would fall if the camera stood there, and how much air that nobody has looked into
it would cover. Nothing but what was observed enters. All of it is told by direction, so that
turning the room by the angle between two directions shifts it along one axis, and mirroring the
room reverses that axis.
"""

import numpy as np

from ocp_ros.agent.partial_map import KeptModel, LookHistory, PartialMap
from ocp_ros.agent.rig_state import clearance_of, fixed_views, remember, RigState, view_from
from ocp_ros.geometry.packed_bits import count_bits, unpack
from ocp_ros.geometry.visibility import FAST, FINE
from ocp_ros.rig.free_plane import CLEARANCE, FreePlane
from ocp_ros.simulation.simulator import View
from ocp_ros.util.threads import mapped

#: Directions, and the distances, metres, at which a camera is tried in each of them. The first
#: ones are those it can move in a turn.
DIRECTIONS = 8
TRIED = (0.04, 0.15, 0.5, 1.5, 4.0)
MOVES = 3
#: Metres: the longest of these moves, the unit of the network's answers and of the last move.
LONGEST = TRIED[MOVES - 1]
#: What is told of each place that is tried, of each direction, and of each camera.
OF_PLACES, OF_DIRECTIONS, OF_CAMERAS = 4, 4, 7
#: Which of the camera's own inputs are the error now, as a logarithm, and the share of the turns.
ERROR, TIME = 1, 2
#: What covering all unseen cells is worth at first, as a share of the error of seeing nothing, and
#: the share of the turns after which it is worth nothing.
CURIOSITY, EXPLORING = 2.0, 0.55
WIDTH = len(TRIED) * OF_PLACES + OF_DIRECTIONS
#: Errors are compared as logarithms, with so much of the error of seeing nothing added.
FLOOR = 0.01
#: Points and rows of depth maps of the model: on a coarser one the best move is often a bad one.
POINTS, ROWS = 12000, 64
#: Share of the turns after which the model is as fine as can be.
LATE = 0.6
#: Metres: a place farther than this from where cameras may be counts as beyond.
BEYOND = 0.15
#: Metres between the places that are asked for the edge of the floor, and the farthest.
STRIDE, FARTHEST = 0.25, 8.0

_ANGLES = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
#: (D, 2) unit vectors, counter-clockwise from +x.
WAYS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
#: (1 + D * MOVES, 2) metres: staying, then the moves of each direction, the shortest first.
CHOICES = np.concatenate([np.zeros((1, 2)), (
    WAYS[:, None] * np.array(TRIED[:MOVES])[None, :, None]).reshape(-1, 2)])


class WorldTurn:
    """
    What is known at one turn, and what each camera could do about it.

    :param model: the engine on what has been seen.
    :param unseen: packed bits of the model's cells that no camera has covered.
    :param space: where the cameras may be.
    :param positions: (K, 3) metres: where they are, or will be after the turn.
    :param moved: (K, 2) the last moves, in units of ``LONGEST``.
    :param time: turns played so far / turns of the whole episode.
    :param sight: what cameras see and how they are turned; None if all are omnidirectional.
    """

    def __init__(self, model: PartialMap, unseen: np.ndarray, space: FreePlane,
                 positions: np.ndarray,
                 moved: np.ndarray, time: float, sight: RigState | None = None) -> None:
        self.model, self.unseen, self.space, self.moved, self.time = (
            model, unseen, space, moved, time)
        self.positions, self._sight = positions.copy(), sight
        self._views = [self._look(camera, position) for camera, position in enumerate(positions)]
        self._fixed = fixed_views(model, sight)
        self._count = max(int(count_bits(unseen)), 1)

    def _look(self, camera: int, position: np.ndarray) -> View:
        """Compute what a camera would see at a position (3,)."""
        return view_from(self.model, self._sight, camera, position)

    def place(self, camera: int, position: np.ndarray) -> None:
        """Let a camera be at a position (3,), for those that are asked after it."""
        self.positions[camera], self._views[camera] = position, self._look(camera, position)

    @property
    def unseen_share(self) -> float:
        """Return the share of the air that no camera has covered."""
        return self._count / max(len(self.model.cells), 1)

    def seen_now(self, camera: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Tell what is seen of the model's points, each camera being where it is or will be.

        :returns: (N,) bool, whether the camera sees a point, and (N,) uint8, how many others do.
        """
        count = len(self.model.points)
        others = np.zeros(count, dtype=np.uint8)
        for view in self._views[:camera] + self._views[camera + 1:] + self._fixed:
            others += unpack(view.seen, count)
        return unpack(self._views[camera].seen, count), others

    def inputs(self, camera: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Try a camera in all directions.

        :returns: ``directions`` (D, ``WIDTH``) and ``own`` (``OF_CAMERAS``,), float32.
        """
        views, position = self._views, self.positions[camera]
        model, space, unseen = self.model, self.space, self.unseen
        error, seen, covered = model.error(views + self._fixed), np.zeros_like(views[0].seen), (
            np.zeros_like(views[0].covered))
        for view in views[:camera] + views[camera + 1:] + self._fixed:
            seen |= view.seen
            covered |= view.covered
        fresh, alone = unseen & ~covered, views[camera].covered & ~covered
        places = position[:2] + WAYS[:, None] * np.array(TRIED)[None, :, None]
        inside = space.inside(places)
        off = np.linalg.norm(inside - places, axis=-1)
        tried = np.empty((DIRECTIONS, len(TRIED), OF_PLACES), dtype=np.float32)

        def told(place: np.ndarray) -> tuple[float, float]:
            look = self._look(camera, place)
            return (self._ratio(model.depth_error(seen | look.seen), error),
                    int(count_bits(look.covered & fresh)) / self._count)

        tried.reshape(-1, OF_PLACES)[:, :2] = mapped(
            told, space.placement(inside.reshape(-1, 2)))
        tried[..., 2], tried[..., 3] = off < BEYOND, np.minimum(off, 4.0) / 4.0
        others = _others(position, np.delete(self.positions, camera, axis=0))
        directions = np.concatenate([tried.reshape(DIRECTIONS, -1), np.column_stack([
            *others, _way_to_the_edge(space, position[:2]), WAYS @ self.moved[camera]])], axis=1)
        cells = max(len(model.cells), 1)
        own = (self._ratio(model.depth_error(seen), error),
               self._ratio(error, model.depth_error.worst), self.time, self._count / cells,
               int(count_bits(alone)) / cells, space.area / 100.0, len(self.positions) / 4.0)
        return directions.astype(np.float32), np.array(own, dtype=np.float32)

    def _ratio(self, one: float, other: float) -> float:
        """Compare two errors."""
        floor = FLOOR * self.model.depth_error.worst
        return float(np.log((one + floor) / (other + floor)))


class WorldInputs:
    """
    Encode turn after turn of an episode.

    :param max_range: effective range of the omnidirectional cameras, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all points that were seen, metres.
    :param most: points of the model.
    :param rows: of its depth maps.
    """

    def __init__(self, max_range: float, wall_margin: float, clearance: float = CLEARANCE,
                 most: int = POINTS, rows: int = ROWS) -> None:
        self.max_range, self.wall_margin, self.clearance = max_range, wall_margin, clearance
        self._sizes = most, rows
        #: What cameras see and how they are turned; None if all are omnidirectional.
        self.sight: RigState | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._memory = LookHistory()
        self._last: np.ndarray | None = None
        self._kept = KeptModel(self.max_range, self.wall_margin, *self._sizes)

    def turn(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> WorldTurn:
        """
        Take note of a turn.

        :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
        :param positions: (K, 3) metres: where the cameras are.
        :param turn: turns played so far.
        :param turns: turns of the whole episode.
        :raises SceneError: if the points are too few or too flat to be a room.
        """
        moved = np.zeros((len(positions), 2))
        if self._last is not None and len(self._last) == len(positions):
            moved = (positions - self._last)[:, :2] / LONGEST
        self._last = positions.copy()
        remember(self._memory, positions, self.sight)
        model, space = self._kept(cloud, positions, FINE if turn >= LATE * turns else FAST,
                                  clearance_of(self.sight, self.clearance))
        return WorldTurn(model, self._memory.unseen(model), space, positions, moved, turn / turns,
                         self.sight)

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int
                 ) -> dict[str, np.ndarray]:
        """
        Encode a turn; see :meth:`turn`.

        :returns: ``directions`` (K, D, ``WIDTH``) and ``own`` (K, ``OF_CAMERAS``), float32.
        """
        known = self.turn(cloud, positions, turn, turns)
        directions, own = zip(*(known.inputs(camera) for camera in range(len(positions))))
        return {'directions': np.stack(directions), 'own': np.stack(own)}


def greedy(inputs: dict[str, np.ndarray]) -> np.ndarray:
    """
    Judge the choices of one camera by their next outcome alone: what learning has to beat.

    :param inputs: ``directions`` (1, D, ``WIDTH``) and ``own`` (1, ``OF_CAMERAS``).
    :returns: (1 + D * MOVES,) less is better: the depth error that would be left, less a bonus for
        unseen cells that falls to nothing early, both as shares of the error of seeing nothing.
    """
    told = inputs['directions'][0, :, :MOVES * OF_PLACES].reshape(-1, OF_PLACES)
    own = inputs['own'][0]
    values = np.exp(own[ERROR] + np.append(0.0, told[:, 0]))
    return values - curiosity(own[TIME]) * np.append(0.0, told[:, 1])


def curiosity(time: float) -> float:
    """Return what covering all unseen cells is worth, in errors of seeing nothing."""
    return CURIOSITY * max(1.0 - time / EXPLORING, 0.0)


def cell_weight(model: PartialMap, unseen: np.ndarray, turn: int, turns: int) -> float:
    """Return what covering one of a model's unseen cells is worth, metres of depth error."""
    return curiosity(turn / turns) * model.depth_error.worst / max(int(count_bits(unseen)), 1)


def nothing_known(cameras: int) -> dict[str, np.ndarray]:
    """Return the inputs of a turn in which there is no room to be tried."""
    return {'directions': np.zeros((cameras, DIRECTIONS, WIDTH), dtype=np.float32),
            'own': np.zeros((cameras, OF_CAMERAS), dtype=np.float32)}


def _others(position: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell how near the nearest other camera is in each direction, and how many are there."""
    nearest, crowd = np.zeros(DIRECTIONS), np.zeros(DIRECTIONS)
    for other in others:
        way = other[:2] - position[:2]
        distance = float(np.linalg.norm(way))
        share = np.clip(WAYS @ way / max(distance, 1e-6), 0.0, 1.0) ** 2
        nearest = np.maximum(nearest, share * np.exp(-distance / 2.0))
        crowd += share * np.exp(-distance / 6.0)
    return nearest, crowd


def _way_to_the_edge(space: FreePlane, position: np.ndarray) -> np.ndarray:
    """Tell how far one can go in each direction before the floor ends: (D,), 1 is farthest."""
    steps = np.arange(STRIDE, FARTHEST + 0.01, STRIDE)
    free = space.contains(position + WAYS[:, None] * steps[None, :, None])
    first = np.where(free.all(axis=1), len(steps), np.argmin(free, axis=1))
    return first / len(steps)
