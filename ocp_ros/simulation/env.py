# SPDX-License-Identifier: Apache-2.0
"""The Gymnasium environment."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import gymnasium as gym
from gymnasium import spaces
import numpy as np

from ocp_ros.geometry.clouds import fixed_size
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.config import SimulationConfig
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.moves import bounded_moves
from ocp_ros.simulation.simulator import Simulator

LARGEST_ROOM = 1000.0


class CameraPlacementEnv(gym.Env):
    """
    Move depth cameras on a plane until what they see together explains the room.

    ## Action space
    ``Box(-1, 1, (K, 2))``: each camera's move in units of ``max_step``, shortened to the unit
    disc.

    ## Observation space
    | key | shape | meaning |
    |---|---|---|
    | ``cloud`` | (P, 3) | points seen since the episode began, metres |
    | ``camera_positions`` | (K, 3) | metres |
    | ``bounds`` | (2, 3) | bounding box of all points seen, metres |

    ## Reward
    See :mod:`ocp_ros.simulation.reward`; all terms are in ``info``.

    ## Start
    A scene drawn from ``scenes`` (or ``options={'scene': index}``), cameras near its centre.

    ## End
    ``truncated`` after the configured number of turns. A placement is never final in itself, so
    ``terminated`` stays False.

    :param scenes: rooms to draw from.
    :param config: rig, engine, episode and reward.
    :param observation_points: P.
    """

    metadata = {'render_modes': []}

    def __init__(self, scenes: Sequence[Scene], config: SimulationConfig | None = None,
                 observation_points: int = 1024) -> None:
        if not scenes:
            raise ValueError('scenes: found none; expected at least one room')
        self.scenes, self.config = list(scenes), config or SimulationConfig()
        self.observation_points = observation_points
        self.simulator = lru_cache(maxsize=None)(
            lambda index: Simulator(self.scenes[index], self.config))
        self.episode: Episode | None = None
        cameras = self.config.rig.cameras
        self.action_space = spaces.Box(-1.0, 1.0, (cameras, 2), np.float32)
        self.observation_space = spaces.Dict({
            name: spaces.Box(-LARGEST_ROOM, LARGEST_ROOM, shape, np.float32)
            for name, shape in (('cloud', (observation_points, 3)),
                                ('camera_positions', (cameras, 3)), ('bounds', (2, 3)))})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; ``options={'scene': index}`` chooses the room."""
        super().reset(seed=seed)
        index = (options or {}).get('scene')
        if index is None:
            index = int(self.np_random.integers(len(self.scenes)))
        self.episode = Episode(self.simulator(index), self.np_random)
        return self._observation(), self._info()

    def step(self, action):
        """Move every camera by its action and look."""
        turn = self.episode.move(bounded_moves(action, self.config.episode.max_step))
        return self._observation(), turn.terms.reward, False, turn.truncated, self._info()

    def _observation(self) -> dict[str, np.ndarray]:
        """Return what the agent may know."""
        # Where no camera sees anything, the cameras themselves are all that is known to be there.
        cloud = self.episode.observed_cloud
        if len(cloud) == 0:
            cloud = self.episode.turn.positions.astype(np.float32)
        return {'cloud': fixed_size(cloud, self.observation_points),
                'camera_positions': self.episode.turn.positions.astype(np.float32),
                'bounds': np.stack([cloud.min(axis=0), cloud.max(axis=0)])}

    def _info(self) -> dict[str, Any]:
        """Return the true state of the placement and the terms of the reward."""
        turn = self.episode.turn
        return {'scene': self.episode.scene.name, 'step': turn.step,
                'space_coverage': turn.space_coverage, 'depth_error': turn.depth_error,
                'worst_depth_error': self.episode.simulator.depth_error.worst,
                **turn.terms._asdict()}
