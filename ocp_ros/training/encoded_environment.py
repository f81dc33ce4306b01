# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The environment as the networks read it: encoded, padded, and with what it was encoded from."""

from typing import NamedTuple

import gymnasium as gym
from gymnasium import spaces
import numpy as np

from ocp_ros.agent import move_effects
from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.encoder import EncodedTurn, Encoder, order_of, PER_CAMERA
from ocp_ros.agent.heading_planner import HeadingPlanner
from ocp_ros.agent.observation import MARKS, OF_OTHERS, OF_TURN
from ocp_ros.agent.observation_map import CELLS, NUMBERS, OF_ROOM
from ocp_ros.agent.observation_map import OF_OTHERS as MAPS_OF_OTHERS
from ocp_ros.planners.rollout import state_of
from ocp_ros.rig.motion import bounded_moves, way_between
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.reward import RewardTerms
from ocp_ros.simulation.simulation_config import SimulationConfig

LARGEST = 1000.0


class Known(NamedTuple):
    """
    What an observation is made from.

    :ivar scene: index into the training scenes.
    :ivar observed: (W,) uint64, packed flags in the engine's spatial order (see
        :class:`ocp_ros.geometry.packed_bits.Subset`).
    :ivar positions: (K, 3) float64, metres, map frame; float32 when it comes from a replay buffer;
        NaN for cameras that the episode does not have.
    """

    scene: int
    observed: np.ndarray
    positions: np.ndarray


def encoded_space(agent: AgentConfig, cameras: int) -> spaces.Dict:
    """Return the space of encoded observations of up to so many cameras, padded with zeros."""
    def real(*shape):
        return spaces.Box(-LARGEST, LARGEST, shape, np.float32)

    def index(*shape):
        return spaces.Box(0, np.iinfo(np.int16).max, shape, np.int16)

    def maps(*shape):
        return spaces.Box(0, 255, shape, np.uint8)

    if agent.map:
        return spaces.Dict({'room': maps(OF_ROOM, CELLS, CELLS),
                            'others': maps(MAPS_OF_OTHERS, CELLS, CELLS),
                            'numbers': real(NUMBERS), 'choices': maps(CELLS, CELLS)})
    space = {'present': real(cameras)}
    if agent.cloud:
        space |= {
            'points': real(agent.points, 3), 'cameras': real(cameras, 3), 'half_size': real(3),
            'keys_1': index(agent.keys_1), 'groups_1': index(agent.keys_1, agent.group_1),
            'keys_2': index(agent.keys_2), 'groups_2': index(agent.keys_2, agent.group_2)}
    if agent.others:
        space |= {'others': real(agent.others, OF_OTHERS), 'turn': real(OF_TURN)}
    if agent.marks:
        space |= {'marks': spaces.Box(0, 255, (agent.points, MARKS), np.uint8)}
    if agent.world:
        space |= {'directions': real(cameras, move_effects.DIRECTIONS, move_effects.WIDTH),
                  'own': real(cameras, move_effects.OF_CAMERAS)}
    return spaces.Dict(space)


def index_counts(agent: AgentConfig) -> dict[str, int]:
    """Return how many points or keys each array of indices chooses from."""
    return {'keys_1': agent.points, 'groups_1': agent.points,
            'keys_2': agent.keys_1, 'groups_2': agent.keys_1}


def padded(encoded: dict[str, np.ndarray], cameras: int) -> dict[str, np.ndarray]:
    """
    Fill up an encoded observation with zeros for cameras that there are not.

    :param encoded: from :class:`~ocp_ros.agent.encoder.Encoder`.
    :param cameras: how many rows there shall be.
    :returns: the same with ``present`` (cameras,).
    """
    filled, count = dict(encoded), 0
    for name in PER_CAMERA:
        if name in encoded:
            count = len(encoded[name])
            filled[name] = np.zeros((cameras, *encoded[name].shape[1:]), dtype=np.float32)
            filled[name][:count] = encoded[name]
    filled['present'] = (np.arange(cameras) < count).astype(np.float32)
    return filled


def action_space(cameras: int) -> spaces.Box:
    """Return the space of moves, as the environment has it."""
    return spaces.Box(-1.0, 1.0, (cameras, 2), np.float32)


def encoder_of(agent: AgentConfig, config: SimulationConfig) -> Encoder:
    """Return the encoder of a simulated rig."""
    return Encoder(agent, float(config.rig.ranges.max()), config.episode.max_step,
                   config.episode.wall_margin, config.episode.clearance)


def tell(encoder: Encoder, episode: Episode) -> None:
    """Tell an encoder how the cameras of a rig file stand and what each sees."""
    encoder.know(None if episode.problem.rig is None else state_of(episode))


def unwrapped(env: gym.Env) -> CameraPlacementEnv:
    """Return the environment inside of its wrappers."""
    inner = env.unwrapped
    if not isinstance(inner, CameraPlacementEnv):
        raise TypeError(f'env: found {type(inner).__name__}; expected CameraPlacementEnv')
    return inner


def encoded(env: CameraPlacementEnv, agent: AgentConfig) -> gym.Env:
    """
    Return an environment as the networks read it, in which an action is a move on the plane.

    :param agent: what the network reads; in which cameras choose one by one or all at once.
    """
    level = env if env.axes == PlaneProblem.axes else PlaneMoves(env)
    return (CameraByCamera if agent.one_by_one else EncodedObservation)(level, agent)


class PlaneMoves(gym.Wrapper):
    """
    Let actions be moves on the plane alone.

    Heights stay, and the heading planner turns the cameras as it does in ``policy_node``.

    :param env: with a rig file.
    """

    def __init__(self, env: CameraPlacementEnv) -> None:
        super().__init__(env)
        config, rig = env.config, env.rig
        self.action_space = action_space(config.rig.cameras)
        self._aim = HeadingPlanner(rig.models, len(rig.cameras), rig.pitch,
                                   config.episode.wall_margin)

    def reset(self, **kwargs):
        """Begin an episode."""
        self._aim.reset()
        return self.env.reset(**kwargs)

    def step(self, action):
        """Play a turn."""
        env = unwrapped(self.env)
        axes = np.zeros((len(action), len(env.axes)))
        axes[:, :2] = action
        if 'yaw' in env.axes:
            axes[:, -2:] = self._rotations(env.episode, np.asarray(action, dtype=np.float64))
        return self.env.step(axes)

    def _rotations(self, episode: Episode, action: np.ndarray) -> np.ndarray:
        """Choose how cameras are turned where they go: (K, 2) yaw and pitch, of ``max_turn``."""
        limits, state, turn = episode.config, state_of(episode), episode.turn
        targets = state.placement[:, :3].copy()
        targets[:state.movable, :2] += bounded_moves(action, limits.max_step)
        headings = self._aim(episode.observed_cloud, state, targets, limits.max_turn, turn.step,
                             limits.turns)
        return way_between(turn.headings, headings[:state.movable]) / limits.max_turn


class EncodedObservation(gym.Wrapper):
    """
    Store with each observation what the network reads: the observation cache.

    ``info`` has what the observation was made from, before and after the turn.

    :param env: :class:`~ocp_ros.simulation.environment.CameraPlacementEnv`, or in
        :class:`PlaneMoves`.
    :param agent: what the network reads.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        config = unwrapped(env).config
        self._cameras = config.rig.cameras
        self._encoder = encoder_of(agent, config)
        self.observation_space = encoded_space(agent, self._cameras)

    def reset(self, **kwargs):
        """Begin an episode."""
        _, info = self.env.reset(**kwargs)
        self._encoder.reset()
        return self._encoded(), info | {'after': self._known()}

    def step(self, action):
        """Play a turn."""
        before = self._known()
        _, *rest, info = self.env.step(action)
        return self._encoded(), *rest, info | {'before': before, 'after': self._known()}

    def _encoded(self) -> dict[str, np.ndarray]:
        """Encode the turn."""
        episode = unwrapped(self.env).episode
        tell(self._encoder, episode)
        return padded(self._encoder(episode.observed_cloud, episode.turn.positions,
                                    episode.turn.step, episode.config.turns), self._cameras)

    def _known(self) -> Known:
        """Return what the observation is made from."""
        env = unwrapped(self.env)
        positions = np.full((self._cameras, 3), np.nan)
        positions[:len(env.episode.turn.positions)] = env.episode.turn.positions
        return Known(env.number, env.episode.observed.bits.copy(), positions)


class CameraByCamera(gym.Wrapper):
    """
    One camera after the other chooses, each told where those before it will be.

    An action is one camera's move, and its reward what that move alone is worth in the room; when
    all have chosen, the turn is played. However many cameras there are, one is seen at a time.

    :param env: :class:`~ocp_ros.simulation.environment.CameraPlacementEnv`, or in
        :class:`PlaneMoves`.
    :param agent: what the network reads.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        config = unwrapped(env).config
        self._encoder = encoder_of(agent, config)
        self.observation_space, self.action_space = encoded_space(agent, 1), action_space(1)
        self.encoded: EncodedTurn | None = None
        #: The cameras that have not chosen yet, and the moves of those that have.
        self._left, self._moves = np.empty(0, dtype=np.int64), np.empty((0, 2))

    def reset(self, **kwargs):
        """Begin an episode."""
        _, info = self.env.reset(**kwargs)
        self._encoder.reset()
        return self._begin(), info

    @property
    def camera(self) -> int:
        """Return the camera whose turn it is."""
        return int(self._left[0])

    def step(self, action):
        """Choose a camera's move; the last one of a turn plays it."""
        camera, self._left = self.camera, self._left[1:]
        self._moves[camera] = self.encoded.move(camera, np.asarray(action, dtype=np.float64)[0])
        terms = self._judge(camera)
        if len(self._left):
            return self._observation(), terms.reward, False, False, terms._asdict()
        moves = np.zeros(self.env.action_space.shape)
        moves[:len(self._moves)] = self._moves
        _, _, terminated, truncated, info = self.env.step(moves)
        return self._begin(), terms.reward, terminated, truncated, info | terms._asdict()

    def _begin(self) -> dict[str, np.ndarray]:
        """Take note of a turn and show it to the first camera."""
        episode = unwrapped(self.env).episode
        turn = episode.turn
        tell(self._encoder, episode)
        self.encoded = self._encoder.turn(episode.observed_cloud, turn.positions, turn.step,
                                          episode.config.turns)
        self._left = order_of(turn.step, len(turn.positions))
        self._moves = np.zeros((len(turn.positions), 2))
        self._views, self._value = list(episode.views), episode.value
        return self._observation()

    def _observation(self) -> dict[str, np.ndarray]:
        """Show the turn to the camera that is next."""
        return padded(self.encoded.inputs(self.camera), 1)

    def _judge(self, camera: int) -> RewardTerms:
        """Tell what a camera's move is worth, the others being where they are by now."""
        episode = unwrapped(self.env).episode
        pose = np.concatenate([self.encoded.positions[camera], episode.turn.headings[camera]])
        self._views[camera] = episode.simulator.look(pose, camera)
        before, self._value = self._value, episode.value_of(self._views)
        return episode.reward(before, self._value)
