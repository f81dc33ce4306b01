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

"""The Gymnasium environment."""

from collections.abc import Sequence
from functools import lru_cache
from os import PathLike
from typing import Any

import gymnasium as gym
from gymnasium import spaces
import numpy as np
from ocp_ros.geometry.clouds import corners_of, fixed_size
from ocp_ros.rig.motion import bounded_moves, wrapped
from ocp_ros.rooms.room_sets import TRAINING
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.scenes.scene import Scene, turned
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import make_problem, Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.settings import ConfigurationError, from_nested, to_nested

#: The number of problems (a scene with a rotation) whose engines are cached.
MAX_PROBLEMS = 16
#: The largest number of points, over all rooms, that are kept in memory. Rooms are kept because
#: making a room takes as long as a hundred turns in it.
MAX_CACHED_POINTS = 4_000_000


def observation_space_of(cameras: int, points: int, aimed: bool) -> spaces.Dict:
    """
    Return the observation space of :class:`CameraPlacementEnv`.

    :param cameras: the largest number of cameras.
    :param points: number of points of an observed cloud.
    :param aimed: whether cameras are turned.
    """
    shapes = {'cloud': (points, 3), 'camera_positions': (cameras, 3),
              'bounds': (2, 3), 'present': (cameras,)}
    if aimed:
        shapes['camera_headings'] = (cameras, 3)
    # The bound of all coordinates in an observation.
    max_coordinate_m = 1000.0
    return spaces.Dict({name: spaces.Box(-max_coordinate_m, max_coordinate_m, shape, np.float32)
                        for name, shape in shapes.items()})


def observation_of(cloud: np.ndarray, positions: np.ndarray, headings: np.ndarray | None,
                   cameras: int, points: int) -> dict[str, np.ndarray]:
    """
    Return an observation of :class:`CameraPlacementEnv`.

    :param cloud: (M, 3) metres, the points seen; if it is empty, the positions replace it.
    :param positions: (K, 3) metres, of the cameras.
    :param headings: (K, 3) radians; None if cameras are not turned.
    :param cameras: as for :func:`observation_space_of`, like ``points``.
    """
    shown = cloud if len(cloud) else positions.astype(np.float32)
    all_positions = np.zeros((cameras, 3), dtype=np.float32)
    all_positions[:len(positions)] = positions
    inputs = {'cloud': fixed_size(shown, points), 'camera_positions': all_positions,
              'present': (np.arange(cameras) < len(positions)).astype(np.float32),
              'bounds': corners_of(shown)}
    return inputs if headings is None else {
        **inputs, 'camera_headings': headings.astype(np.float32)}


def moves_and_headings(rows: np.ndarray, axes: Sequence[str], headings: np.ndarray | None,
                       max_step: float, max_turn: float
                       ) -> tuple[np.ndarray, np.ndarray | None]:
    """
    Return what an action of :class:`CameraPlacementEnv` asks for.

    :param rows: (K, A) the action of K cameras, A being the number of ``axes`` of their rig.
    :param headings: (K, 3) radians, the present ones; None if cameras are not turned.
    :param max_step: metres.
    :param max_turn: radians.
    :returns: (K, 2 or 3) moves, metres; and the new headings (K, 3), None if cameras are not
        turned.
    """
    columns = 3 if 'z' in axes else 2
    moves = bounded_moves(rows[:, :columns], max_step)
    if 'yaw' not in axes or headings is None:
        return moves, None
    # The yaw is wrapped here; the problem limits the pitch.
    headings = headings.copy()
    headings[:, :2] += bounded_moves(rows[:, columns:], max_turn)
    headings[:, 0] = wrapped(headings[:, 0])
    return moves, headings


class CameraPlacementEnv(gym.Env):
    """
    Move depth cameras until their views together reconstruct the room.

    The cameras are omnidirectional and move on a plane, or are those of ``config.rig_file`` with
    its constraints. A camera moves to the allowed position nearest to its target. The views of
    cameras in place are included.

    **Action space**
    ``Box(-1, 1, (K, 2))``: each camera's move in units of ``max_step``, shortened to the unit
    disc. Moves of absent cameras are ignored. A rig file may add columns (named by ``axes``):
    ``z`` if the mount allows a range of heights, and ``yaw`` and ``pitch`` in units of
    ``max_turn`` if a camera is not omnidirectional.

    **Observation space**
    ==================== ====== ==========================================================
    key                  shape  meaning
    ==================== ====== ==========================================================
    ``cloud``            (P, 3) points seen since the episode began, metres
    ``camera_positions`` (K, 3) metres; zeros for cameras that the episode does not have
    ``camera_headings``  (K, 3) yaw, pitch, roll in radians; only where cameras are turned
    ``present``          (K,)   1 for each camera that the episode has, else 0
    ``bounds``           (2, 3) bounding box of all points seen, metres
    ==================== ====== ==========================================================

    **Reward**
    See :func:`~ocp_ros.simulation.episode.reward`; all terms are in ``info``.

    **Start**
    A scene drawn from ``scenes``, rotated by an angle drawn from ``rotations``, with a drawn
    number of cameras near its centre; ``options`` may set ``scene`` (index), ``rotation``
    (degrees), ``cameras``, ``limits`` (an ``EpisodeConfig``) and, without a rig file,
    ``max_range`` (metres).

    **End**
    ``truncated`` after the configured number of turns. A placement is never final in itself, so
    ``terminated`` stays False.

    :param scenes: rooms to draw from; a room is loaded when its episode begins.
    :param config: rig, engine, episode and reward.
    :param observation_points: the number P of points of an observed cloud.
    :param fewest: the least number of cameras of an episode, K by default; the largest is K.
    :param rotations: degrees about the vertical axis.
    :raises ConfigurationError: if the rig file cannot be used, or does not fit these numbers of
        cameras and rotations.
    """

    metadata = {'render_modes': []}

    def __init__(self, scenes: Sequence[Scene], config: SimulationConfig | None = None,
                 observation_points: int = 1024, fewest: int | None = None,
                 rotations: Sequence[float] = (0.0,)) -> None:
        if not scenes:
            raise ConfigurationError('scenes: found none; expected at least one room')
        self.scenes = scenes
        self.config = config or SimulationConfig()
        self.rig = self.config.placed_rig
        self.observation_points = observation_points
        self.rotations = tuple(rotations)
        #: Returns the problem of a scene's index and a rotation; the last ones are cached.
        self.problem = lru_cache(maxsize=MAX_PROBLEMS)(self._make_problem)
        self.episode: Episode | None = None
        cameras = len(self.rig.cameras)
        self.fewest = cameras if fewest is None else fewest
        if not 1 <= self.fewest <= cameras:
            raise ValueError(f'fewest: found {self.fewest}; expected 1 to {cameras}')
        self._check_rig()
        self.axes = self.rig.axes
        self.action_space = spaces.Box(-1.0, 1.0, (cameras, len(self.axes)), np.float32)
        self.observation_space = observation_space_of(cameras, observation_points,
                                                      'yaw' in self.axes)

    def _check_rig(self) -> None:
        """Refuse too few cameras for a rig file, and rotations if it has map coordinates."""
        rig, cameras = self.rig, len(self.rig.cameras)
        if self.fewest < cameras and not rig.free:
            raise ConfigurationError(f'fewest: found {self.fewest} with a rig file; expected '
                                     f'{cameras}, all cameras that {rig.document.name} lists')
        rig.check_rotations(self.rotations, f'rotations: found {self.rotations}', '0 alone')

    def _make_problem(self, index: int, rotation: float) -> Problem:
        """Build the problem of scene ``index``, rotated by ``rotation`` degrees."""
        scene = self.scenes[index]
        return make_problem(turned(scene, rotation) if rotation else scene, self.config)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; see **Start** for what ``options`` may set."""
        super().reset(seed=seed)
        drawn = {'rotation': self.rotations[int(self.np_random.integers(len(self.rotations)))],
                 'scene': int(self.np_random.integers(len(self.scenes))),
                 'cameras': int(self.np_random.integers(self.fewest, len(self.rig.cameras) + 1))}
        chosen = {**drawn, **(options or {})}
        problem = self.problem(chosen['scene'], chosen['rotation'])
        if 'max_range' in chosen:
            problem = problem.with_range(chosen['max_range'])
        self.episode = Episode(problem, self.np_random, chosen['cameras'], chosen.get('limits'))
        return self._observation(), self._info()

    def step(self, action):
        """Move every camera by its row of the action, and evaluate the new placement."""
        now = self.episode.turn
        # The last rows are those of cameras that the episode does not have.
        rows = np.asarray(action, float).reshape(-1, len(self.axes))[:len(now.positions)]
        limits = self.episode.config
        turn = self.episode.move(*moves_and_headings(
            rows, self.axes, now.headings, limits.max_step, limits.max_turn))
        return self._observation(), turn.terms.reward, False, turn.truncated, self._info()

    def _observation(self) -> dict[str, np.ndarray]:
        """Return the observation of the agent; see the class."""
        turn = self.episode.turn
        return observation_of(
            self.episode.observed_cloud, turn.positions,
            turn.headings if 'yaw' in self.axes else None, len(self.rig.cameras),
            self.observation_points)

    def _info(self) -> dict[str, Any]:
        """Return the exact coverage and error of the placement, and the terms of the reward."""
        turn = self.episode.turn
        return {'scene': self.episode.scene.name, 'step': turn.step,
                'space_coverage': turn.space_coverage, 'depth_error': turn.depth_error,
                'worst_depth_error': self.episode.simulator.depth_error.worst,
                **turn.terms._asdict()}


class Rooms(Sequence[Scene]):
    """
    Rooms that are made at first use, and kept up to ``MAX_CACHED_POINTS`` points in all.

    Rooms beyond this limit are made again at each use.

    :param names: seeds of generated rooms, or paths of scans.
    :param points: the number of points of a generated room; larger scans are thinned to it.
    :param reading: options of a scan; see :func:`~ocp_ros.rooms.scene_source.make_room`.
    """

    def __init__(self, names: Sequence[int | str | PathLike[str]], points: int, **reading: Any
                 ) -> None:
        self._names = tuple(str(name) for name in names)
        self._points, self._reading = points, reading
        self._kept: dict[int, Scene] = {}

    def __len__(self) -> int:
        """Return the number of rooms."""
        return len(self._names)

    def __getitem__(self, index):
        """Return a room; the caller must not change it, as it is given to other callers too."""
        if index in self._kept:
            return self._kept[index]
        scene = make_room(self._names[index], 0.0, self._points, **self._reading)
        if (len(self._kept) + 1) * self._points <= MAX_CACHED_POINTS:
            self._kept[index] = scene
        return scene


def environment_of(rooms: Sequence[int | str | PathLike[str]] = TRAINING, points: int = 15000,
                   cameras: int | None = None, config: SimulationConfig | None = None,
                   **more: Any) -> CameraPlacementEnv:
    """
    Return the environment that ``gymnasium.make`` makes.

    :param rooms: seeds of generated rooms, or paths of scans; or a single seed or path.
    :param points: the number of points of a generated room; larger scans are thinned to it.
    :param cameras: the number of cameras without a rig file; 4 by default.
    :param config: rig, engine, episode and reward.
    :param more: other arguments of :class:`CameraPlacementEnv`.
    :raises ConfigurationError: for an impossible number of cameras.
    """
    if isinstance(rooms, (str, int, PathLike)):
        rooms = (rooms,)
    config = config or SimulationConfig()
    if cameras is not None:
        # Settings are checked when they are built from nested dictionaries.
        config = from_nested(SimulationConfig, {
            **to_nested(config), 'rig': {**to_nested(config.rig), 'cameras': cameras}}, 'cameras')
    return CameraPlacementEnv(Rooms(rooms, points), config, **more)


# Gymnasium 1 loads no entry points of packages: importing this module registers the environment.
gym.register('ocp_ros/CameraPlacement-v0', f'{__name__}:{environment_of.__name__}')
