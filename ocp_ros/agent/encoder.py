# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The encoder: what the network reads, turn after turn of an episode."""

from contextlib import suppress

import numpy as np

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.move_effects import LONGEST, nothing_known, WorldInputs, WorldTurn
from ocp_ros.agent.observation import chosen, encode, MARKS, told_of_others
from ocp_ros.agent.rig_state import RigState
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.rig.free_plane import CLEARANCE
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.scenes.scene import SceneError

#: Arrays that have a row for each camera.
PER_CAMERA = ('cameras', 'directions', 'own')
#: Points and rows of depth maps of the model in which points are marked by who sees them.
MARKED_POINTS, MARKED_ROWS = 6000, 16


class EncodedTurn:
    """
    What the network reads of one turn, camera by camera.

    Cameras are asked one after the other, each with those before it where they will be: two that
    choose at once both go for the same gap.

    :param config: what the network reads.
    :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
    :param world: what moves would change; None where there is no room to be tried.
    :param positions: (K, 3) metres: where the cameras are.
    :param max_step: farthest a camera moves in one turn, metres.
    :param time: turns played so far / turns of the whole episode.
    """

    def __init__(self, config: AgentConfig, cloud: np.ndarray, world: WorldTurn | None,
                 positions: np.ndarray, max_step: float, time: float) -> None:
        self._config, self._world, self._max_step = config, world, max_step
        self.positions, self._time = positions.copy(), time
        self._has_chosen = np.zeros(len(positions), dtype=bool)
        # Points are marked in the model: those that it was made of are read.
        known = world.model.points if config.marks and world is not None else cloud
        self._cloud = encode_cloud(known, positions, config) if config.cloud else {}

    @property
    def known(self) -> bool:
        """Return whether there is a room in which moves can be tried."""
        return self._world is not None

    def inputs(self, camera: int) -> dict[str, np.ndarray]:
        """Return the arrays of a single camera; see :class:`Encoder`."""
        encoded = dict(self._cloud)
        if 'cameras' in encoded:
            encoded['cameras'] = encoded['cameras'][camera:camera + 1]
        if self._config.others:
            encoded |= self._told(camera)
        if not self._config.world:
            return encoded
        if self._world is None:
            return encoded | nothing_known(1)
        directions, own = self._world.inputs(camera)
        return encoded | {'directions': directions[None], 'own': own[None]}

    def _told(self, camera: int) -> dict[str, np.ndarray]:
        """Tell a camera of the others, of the turn, and who sees which points now."""
        config, world = self._config, self._world
        unseen = 1.0 if world is None else world.unseen_share
        told = {'others': told_of_others(camera, self.positions, self._has_chosen, config),
                'turn': np.array([self._time, len(self.positions) / 4.0, unseen], np.float32)}
        if config.marks:
            marks = np.zeros((config.points, MARKS), dtype=np.uint8)
            if world is not None:
                marks = chosen(np.stack(world.seen_now(camera), axis=1).astype(np.uint8), config)
            told['marks'] = marks
        return told

    def move(self, camera: int, action: np.ndarray) -> np.ndarray:
        """
        Let a camera move, for those that are asked after it.

        :param action: (2,) in units of the longest step.
        :returns: (2,) the move it will make, in the same units: it stays over the floor.
        """
        step, here = bounded_moves(action, self._max_step), self.positions[camera:camera + 1, :2]
        if self._world is not None:
            target = self._world.space.moved(here, step, self._max_step)
        else:
            target = here + step
        step = (target - here)[0]
        self.positions[camera, :2], self._has_chosen[camera] = target[0], True
        if self._world is not None:
            self._world.place(camera, self.positions[camera])
        return step / self._max_step


def order_of(turn: int, cameras: int) -> np.ndarray:
    """Return the order in which cameras are asked at a turn: nobody is always the first."""
    return np.roll(np.arange(cameras), turn)


class Encoder:
    """
    Encode what was seen, as the agent's settings ask for it.

    The world-model inputs depend on what the cameras did since the episode began, the cloud's on
    the turn alone. The arrays, for K cameras, are those of
    :func:`~ocp_ros.agent.observation.encode` and of
    :class:`~ocp_ros.agent.move_effects.WorldInputs`.

    :param config: what the network reads.
    :param max_range: effective range of the omnidirectional cameras, metres.
    :param max_step: farthest a camera moves in one turn, metres.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :param clearance: cameras stay this far from all points that were seen, metres.
    """

    def __init__(self, config: AgentConfig, max_range: float = 4.0, max_step: float = 0.5,
                 wall_margin: float = 0.1, clearance: float = CLEARANCE) -> None:
        self.config, self.max_step = config, max_step
        self._world: WorldInputs | None = None
        if config.one_by_one:
            sizes = () if config.world else (MARKED_POINTS, MARKED_ROWS)
            self._world = WorldInputs(max_range, wall_margin, clearance, *sizes)

    @property
    def unit(self) -> float:
        """Return what the network's answers are counted in, in units of the longest step."""
        return LONGEST / self.max_step if self.config.world else 1.0

    def know(self, sight: RigState | None) -> None:
        """Learn before a turn how the cameras stand and what each sees; None for all around."""
        if self._world is not None:
            self._world.sight = sight

    def reset(self) -> None:
        """Forget the last episode."""
        if self._world is not None:
            self._world.reset()

    def turn(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> EncodedTurn:
        """
        Take note of a turn, to encode it camera by camera.

        :param cloud: (M, 3) float32, metres, map frame: the points seen so far.
        :param positions: (K, 3) metres: where the cameras are.
        :param turn: turns played so far.
        :param turns: turns of the whole episode.
        """
        world = None
        if self._world is not None:
            with suppress(SceneError):
                world = self._world.turn(cloud, positions, turn, turns)
        return EncodedTurn(self.config, cloud, world, positions, self.max_step, turn / turns)

    def __call__(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int
                 ) -> dict[str, np.ndarray]:
        """Encode a turn at once, as if all cameras chose at the same time; see :meth:`turn`."""
        if self._world is None:
            return encode_cloud(cloud, positions, self.config)
        encoded = self.turn(cloud, positions, turn, turns)
        each = [encoded.inputs(camera) for camera in range(len(positions))]
        return each[0] | {name: np.concatenate([one[name] for one in each])
                          for name in PER_CAMERA if name in each[0]}


def encode_cloud(cloud: np.ndarray, positions: np.ndarray, config: AgentConfig
                 ) -> dict[str, np.ndarray]:
    """
    Encode what was seen in a turn; see :func:`~ocp_ros.agent.observation.encode`.

    :param cloud: (M, 3) float32, metres, map frame: the points seen so far, in any order.
    :param positions: (K, 3) metres.
    :param config: sizes.
    """
    positions = positions.astype(np.float32)
    # Where nothing is seen, the cameras themselves are all that is known to be there.
    known = cloud if len(cloud) else positions
    bounds = corners_of(known)
    return encode(known, positions, bounds, config)
