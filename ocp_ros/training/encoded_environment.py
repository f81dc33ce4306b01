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

"""The environment with the inputs and actions of the networks; each turn is encoded once."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
from gymnasium import spaces
import numpy as np
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.online.heading_planner import HeadingPlanner
from ocp_ros.online.online_planner import settings_of
from ocp_ros.online.step import state_of
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.cloud_encoder import (
    encode,
    EncodedTurn,
    Encoder,
    MARKS,
    MAX_OTHERS,
    OF_OTHERS,
    OF_SECTOR,
    OF_TURN,
    SECTORS,
)
from ocp_ros.rig.motion import bounded_moves, order_of, way_between
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.episode import Episode, RewardTerms, Value
from ocp_ros.simulation.simulation_config import EpisodeConfig
from ocp_ros.simulation.simulator import View
from ocp_ros.training.training_config import EpisodesConfig


def encoded_space(agent: AgentConfig) -> spaces.Dict:
    """
    Return the space of one input of the agent's network.

    See :class:`~ocp_ros.policy.cloud_encoder.Encoder` for the inputs ``cloud``, and
    :func:`~ocp_ros.policy.cloud_encoder.encode` for ``paper``.
    """
    def real_box(*shape):
        # A finite bound that no input reaches.
        limit = 1000.0
        return spaces.Box(-limit, limit, shape, np.float32)

    def index_box(count, *shape):
        return spaces.Box(0, count - 1, shape, np.int16)

    space = {
        'points': real_box(agent.points, 3), 'half_size': real_box(3),
        'cameras': real_box(cameras_of(agent), 3),
        'keys_1': index_box(agent.points, agent.keys_1),
        'groups_1': index_box(agent.points, agent.keys_1, agent.group_1),
        'keys_2': index_box(agent.keys_1, agent.keys_2),
        'groups_2': index_box(agent.keys_1, agent.keys_2, agent.group_2)}
    if agent.one_by_one:
        space |= {'others': real_box(MAX_OTHERS, OF_OTHERS), 'turn': real_box(OF_TURN),
                  'heading': real_box(1, 3), 'air': real_box(SECTORS, OF_SECTOR),
                  'marks': spaces.Box(0, 255, (agent.points, MARKS), np.uint8)}
    return spaces.Dict(space)


def cameras_of(agent: AgentConfig) -> int:
    """Return the number of cameras that one action moves: one, or with ``paper`` all."""
    return 1 if agent.one_by_one else agent.cameras


def action_space(cameras: int) -> spaces.Box:
    """Return the space of actions of some cameras: two components in [-1, 1] for each."""
    return spaces.Box(-1.0, 1.0, (cameras, 2), np.float32)


def unwrapped(env: gym.Env) -> CameraPlacementEnv:
    """Return the environment inside its wrappers."""
    inner = env.unwrapped
    if not isinstance(inner, CameraPlacementEnv):
        raise TypeError(f'env: found {type(inner).__name__}; expected CameraPlacementEnv')
    return inner


class PlaneMoves(gym.ActionWrapper):
    """
    Restrict actions to moves in the plane: (K, 2).

    The heights do not change, and the heading planner rotates the cameras as in ``policy_node``.

    :param env: environment with a rig file.
    """

    def __init__(self, env: CameraPlacementEnv) -> None:
        super().__init__(env)
        rig = env.rig
        self.action_space = action_space(len(rig.cameras))
        self._heading_planner = HeadingPlanner(rig.models, len(rig.cameras), rig.pitch,
                                               env.config.episode.wall_margin)

    def reset(self, **kwargs):
        """Begin an episode."""
        self._heading_planner.reset()
        return self.env.reset(**kwargs)

    def action(self, action: np.ndarray) -> np.ndarray:
        """Return the action on all axes of the environment."""
        env = unwrapped(self.env)
        axes = np.zeros((len(action), len(env.axes)))
        axes[:, :2] = action
        # The last two axes are then yaw and pitch.
        if 'yaw' in env.axes:
            axes[:, -2:] = self._rotations(env.episode, np.asarray(action, dtype=np.float64))
        return axes

    def _rotations(self, episode: Episode, action: np.ndarray) -> np.ndarray:
        """Return a rotation for each camera: (K, 2) yaw and pitch, in units of ``max_turn``."""
        limits, state, turn = episode.config, state_of(episode), episode.turn
        targets = state.placement[:, :3].copy()
        targets[:state.movable, :2] += bounded_moves(action, limits.max_step)
        headings = self._heading_planner(episode.observed_cloud, state, targets, limits.max_turn,
                                         turn.step, limits.turns)
        return way_between(turn.headings, headings[:state.movable]) / (
            # Cameras that must not turn have rotations of 0.
            limits.max_turn or 1.0)


class EncodedObservation(gym.ObservationWrapper):
    """
    Encode the observed cloud for a network that moves all cameras at once.

    :param env: :class:`~ocp_ros.simulation.environment.CameraPlacementEnv`, or in
        :class:`PlaneMoves`.
    :param agent: settings with the inputs ``paper``.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        self._agent = agent
        self.observation_space = encoded_space(agent)

    def observation(self, observation) -> dict[str, np.ndarray]:
        """Return the encoded turn, in place of the environment's own observation."""
        episode = unwrapped(self.env).episode
        return encode(episode.observed_cloud, episode.turn.positions, self._agent)


class CameraByCamera(gym.Wrapper):
    """
    The cameras choose one after the other; each observation has the targets chosen so far.

    An action is the move of one camera, and its reward is that of this move alone. When all
    cameras have chosen, the turn is played. An observation is for one camera, so the number of
    cameras may vary.

    :param env: :class:`~ocp_ros.simulation.environment.CameraPlacementEnv`, or in
        :class:`PlaneMoves`.
    :param agent: settings with the inputs ``cloud``.
    :param draws: what is drawn at the start of each episode.
    :param rig_env: the environment of the episodes of ``draws.rig_file``; None without these.
    :ivar encoded: the present turn, encoded for the network.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig, draws: EpisodesConfig | None = None,
                 rig_env: gym.Env | None = None) -> None:
        super().__init__(env)
        self._draws = draws or EpisodesConfig()
        #: The environments of the two kinds of episodes; ``env`` is that of the present one.
        self._envs = env, rig_env or env
        self._rng = np.random.default_rng()
        self._agent = agent
        self._encoder = Encoder(agent)
        self.observation_space, self.action_space = encoded_space(agent), action_space(1)
        self.encoded: EncodedTurn | None = None
        #: The cameras that have not chosen yet.
        self._waiting = np.empty(0, dtype=np.int64)
        #: (K, 2) in units of ``max_step``, the moves of all cameras; 0 if not chosen yet.
        self._moves = np.empty((0, 2))
        #: The views of all cameras, of those that have chosen from their new positions.
        self._views: list[View] = []
        #: The value of these views; see ``Episode.value_of``.
        self._value = Value(0.0, 0.0, 0.0)
        #: The points seen since the episode began, those of these views included.
        self._observed: Subset | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; ``options`` replace what is drawn."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self.env = self._envs[int(self._rng.random() < self._draws.rig_share)]
        inner = unwrapped(self.env)
        drawn = drawn_options(self._draws, inner, self._rng)
        # The seed draws the rest: the start positions, and what ``options`` leave out.
        _, info = self.env.reset(seed=int(self._rng.integers(1 << 31)),
                                 options={**drawn, **(options or {})})
        # The first setting is the random generator, which the encoder does not need; the last ones
        # are the distances to keep from walls and from points.
        _, max_step, max_range, *margins = settings_of(
            inner.episode.config, inner.episode.problem.rig, self._rng)
        self._encoder = Encoder(self._agent, max_range, max_step, *margins)
        return self._begin(), info

    @property
    def camera(self) -> int:
        """Return the camera that chooses next."""
        return int(self._waiting[0])

    def step(self, action):
        """Take one camera's move; after the last camera play the turn."""
        camera = self.camera
        self._waiting = self._waiting[1:]
        self._moves[camera] = self.encoded.move(camera, np.asarray(action, dtype=np.float64)[0])
        terms = self._reward_of(camera)
        if len(self._waiting):
            return self._observation(), terms.reward, False, False, terms._asdict()
        # The action space has a row for each camera of the rig; an episode may have fewer cameras.
        moves = np.zeros(self.env.action_space.shape)
        moves[:len(self._moves)] = self._moves
        before = self._value
        _, _, terminated, truncated, info = self.env.step(moves)
        # The last camera also gets what the cameras' rotations have changed.
        episode = unwrapped(self.env).episode
        rotated = episode.reward(before, episode.value)
        terms = RewardTerms(*np.add(terms, rotated))
        return self._begin(), terms.reward, terminated, truncated, info | terms._asdict()

    def _begin(self) -> dict[str, np.ndarray]:
        """Encode a new turn, and return the observation of the first camera to choose."""
        episode = unwrapped(self.env).episode
        turn = episode.turn
        self._encoder.partial_maps.rig_state = state_of(episode)
        self.encoded = self._encoder.turn(episode.observed_cloud, turn.positions, turn.step,
                                          episode.config.turns)
        self._waiting = order_of(turn.step, len(turn.positions))
        self._moves = np.zeros((len(turn.positions), 2))
        self._views, self._observed = list(episode.views), episode.observed
        self._value = episode.value
        return self._observation()

    def _observation(self) -> dict[str, np.ndarray]:
        """Return the observation of the camera that chooses next."""
        return self.encoded.inputs(self.camera)

    def _reward_of(self, camera: int) -> RewardTerms:
        """Return the reward of one camera's move, given the moves chosen before it."""
        episode = unwrapped(self.env).episode
        # ``encoded.positions`` has the new position of each camera that has chosen.
        pose = np.concatenate([self.encoded.positions[camera], episode.turn.headings[camera]])
        self._views[camera] = episode.simulator.look(pose, camera)
        self._observed |= Subset(self._views[camera].seen, self._observed.order)
        before, self._value = self._value, episode.value_of(self._views, self._observed)
        return episode.reward(before, self._value)


def turn_for(max_step: float, limits: EpisodeConfig) -> float:
    """Return the largest rotation in a turn, radians, for a longest step in metres."""
    return float(np.clip(max_step, limits.max_turn, 1.6))


def drawn_options(draws: EpisodesConfig, env: CameraPlacementEnv, rng: np.random.Generator
                  ) -> dict[str, Any]:
    """
    Draw the options of an episode; see ``CameraPlacementEnv.reset``.

    Turns and steps are drawn with a uniform logarithm. Each room has one rotation.
    """
    scene = int(rng.integers(len(env.scenes)))
    options: dict[str, Any] = {'scene': scene,
                               'rotation': env.rotations[scene % len(env.rotations)]}
    limits = env.config.episode
    if draws.fewest_turns:
        turns = np.exp(rng.uniform(*np.log([draws.fewest_turns, limits.turns])))
        limits = replace(limits, turns=round(turns))
    if draws.longest_step:
        step = float(np.exp(rng.uniform(*np.log([limits.max_step, draws.longest_step]))))
        limits = replace(limits, max_step=step, max_turn=turn_for(step, limits))
    if draws.widest_start:
        radius = float(rng.uniform(limits.start_radius, draws.widest_start))
        limits = replace(limits, start_radius=radius)
    if draws.farthest_range and env.rig.free:
        options['max_range'] = float(rng.uniform(env.config.rig.max_range, draws.farthest_range))
    return {**options, 'limits': limits}


def playable(env: CameraPlacementEnv, agent: AgentConfig, draws: EpisodesConfig | None = None,
             rig_env: CameraPlacementEnv | None = None) -> gym.Env:
    """
    Return an environment with the inputs and actions of an agent.

    :param env: the environment.
    :param draws: with the inputs ``cloud``, what is drawn at the start of each episode.
    :param rig_env: with the inputs ``cloud``, the environment of the episodes of
        ``draws.rig_file``.
    :param agent: settings of the network. An action is the move of one camera in the plane
        (``cloud``), or the moves of all cameras (``paper``).
    """
    plane_env = in_plane(env)
    if not agent.one_by_one:
        return EncodedObservation(plane_env, agent)
    return CameraByCamera(plane_env, agent, draws, rig_env and in_plane(rig_env))


def in_plane(env: CameraPlacementEnv) -> gym.Env:
    """Return an environment whose actions are moves in the plane."""
    return env if len(env.axes) == 2 else PlaneMoves(env)
