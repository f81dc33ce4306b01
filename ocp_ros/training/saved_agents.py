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
Agents of users in comparisons: files of stable-baselines3, or any object with ``predict``.

Such a file is unpickled, so it can run any code: it is read only from a path that the user names.
"""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from ocp_ros.online.online_planner import Online, settings_of
from ocp_ros.rig.rig_file import Rig
from ocp_ros.search.registry import OBSERVED, PLANNERS, RegisteredPlanner
from ocp_ros.simulation.environment import (
    moves_and_headings,
    observation_of,
    observation_space_of,
)
from ocp_ros.simulation.simulation_config import EpisodeConfig
from ocp_ros.util.settings import ConfigurationError

#: Name of the planner in results.
OWN_POLICY = 'own_policy'
#: Observations: the dictionary of the environment, or all its values in one array.
DICT, FLAT = 'dict', 'flat'


class SavedAgent(Online):
    """
    Move cameras by an agent that was trained in the environment of the package.

    :param agent: has ``predict(observation, deterministic=True)``, which returns an action of
        :class:`~ocp_ros.simulation.environment.CameraPlacementEnv` and a state.
    :param observe: returns the observation of the agent, given that of the environment.
    :param rig: the rig, for the axes of actions.
    :param max_turn: the farthest a camera turns in one turn, radians.
    :param points: number of points of an observed cloud.
    :param settings: positional arguments of :class:`Online`.
    """

    def __init__(self, agent: Any, observe: Callable[[dict[str, np.ndarray]], Any], rig: Rig,
                 max_turn: float, points: int, *settings: Any) -> None:
        super().__init__(*settings)
        if 'z' in rig.axes:
            raise ConfigurationError('--policy: found a rig whose cameras change their height; '
                                     'expected one height; write one number under mount')
        self._agent, self._observe, self._axes = agent, observe, rig.axes
        self._max_turn, self._points = max_turn, points

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Return the next moves, and set the next headings; see :meth:`Online.move`."""
        headings = None
        if 'yaw' in self._axes:
            headings = self.rig_state.placement[:self.rig_state.movable, 3:]
        observation = observation_of(cloud, positions, headings, len(positions), self._points)
        action, _ = self._agent.predict(self._observe(observation), deterministic=True)
        rows = np.asarray(action, dtype=np.float64).reshape(-1)
        if len(rows) != len(positions) * len(self._axes):
            raise ConfigurationError(f'--policy: found an action of {len(rows)} numbers; expected '
                                     f'{", ".join(self._axes)} of {len(positions)} cameras; train '
                                     'it for this rig, or name its rig')
        moves, self.headings = moves_and_headings(
            rows.reshape(len(positions), -1), self._axes, headings, self.max_step, self._max_turn)
        return moves


def register_policy(policy: str, observation: str = DICT) -> None:
    """
    Add the agent of a user to the table of planners in this process, as :data:`OWN_POLICY`.

    :param policy: ``[ALGORITHM:]FILE.zip`` of stable-baselines3, by default PPO; or
        ``MODULE:FUNCTION``, which returns an agent.
    :param observation: ``dict``, ``flat``, or ``MODULE:FUNCTION``, which returns the observation
        of the agent, given that of the environment.
    :raises ConfigurationError: if it cannot be used.
    """
    agent = _load_agent(policy)

    def make(episode: EpisodeConfig, rig: Rig, rng: np.random.Generator, model: str = ''
             ) -> Online:
        space = getattr(agent, 'observation_space', None)
        points, cameras = 1024, len(rig.cameras)
        if isinstance(space, gym.spaces.Dict) and 'cloud' in space.spaces:
            points = space['cloud'].shape[0]
        elif observation == FLAT and space is not None:
            # Besides the points, the array has as many numbers as without any.
            others = gym.spaces.flatdim(observation_space_of(cameras, 1, 'yaw' in rig.axes)) - 3
            points = (space.shape[0] - others) // 3
        observe = _observer(observation, cameras, points, 'yaw' in rig.axes)
        return SavedAgent(agent, observe, rig, episode.max_turn, points,
                          *settings_of(episode, rig, rng))

    PLANNERS[OWN_POLICY] = RegisteredPlanner(OBSERVED, make)


def _observer(observation: str, cameras: int, points: int, aimed: bool
              ) -> Callable[[dict[str, np.ndarray]], Any]:
    """Return the function from the observation of the environment to that of an agent."""
    if observation == DICT:
        return lambda values: values
    if observation == FLAT:
        return partial(gym.spaces.flatten, observation_space_of(cameras, points, aimed))
    return _named_object(observation, '--observation')


def _load_agent(policy: str) -> Any:
    """Return an agent; see :func:`register_policy`."""
    if not policy.endswith('.zip'):
        agent = _named_object(policy, '--policy')()
        if not callable(getattr(agent, 'predict', None)):
            raise ConfigurationError(f'--policy: found {type(agent).__name__} by {policy}; '
                                     'expected an object with predict(observation, '
                                     'deterministic=True)')
        return agent
    import stable_baselines3
    algorithm, _, path = policy.rpartition(':')
    cls = getattr(stable_baselines3, algorithm or 'PPO', None)
    if not hasattr(cls, 'load') or not Path(path).is_file():
        raise ConfigurationError(
            f'--policy: found {policy}; expected ALGORITHM:FILE.zip with an algorithm of '
            'stable-baselines3, such as SAC, and an existing file')
    try:
        return cls.load(path, device='cpu')
    # Unpickling may raise any error.
    except Exception as error:
        raise ConfigurationError(
            f'--policy: found {path}, which {algorithm or "PPO"} cannot load '
            f'({type(error).__name__}: {error}); expected a file that it has saved; name the '
            'algorithm, as in SAC:FILE.zip') from error


def _named_object(name: str, option: str) -> Any:
    """Return an object by ``MODULE:NAME``."""
    module, separator, attribute = name.partition(':')
    try:
        if not separator:
            raise ImportError('it has no colon')
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(f'{option}: found {name!r}, which cannot be imported ({error}); '
                                 'expected MODULE:FUNCTION; correct it') from error
