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

"""The environment with the inputs and actions of the networks; a turn is encoded once."""

import gymnasium as gym
from gymnasium import spaces
import numpy as np
from ocp_ros.online.heading_planner import HeadingPlanner
from ocp_ros.online.online_planner import settings_of
from ocp_ros.online.rollout import state_of
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.cloud_encoder import EncodedTurn, Encoder
from ocp_ros.policy.map_actor import MapActor
from ocp_ros.policy.map_turn import MapTurn
from ocp_ros.policy.observation_cloud import encode, MARKS, MAX_OTHERS, OF_OTHERS, OF_TURN
from ocp_ros.policy.observation_map import CELLS, NUMBERS, OF_ROOM
from ocp_ros.policy.observation_map import OF_OTHERS as MAPS_OF_OTHERS
from ocp_ros.rig.motion import bounded_moves, order_of, way_between
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.reward import NO_REWARD, RewardTerms


def encoded_space(agent: AgentConfig) -> spaces.Dict:
    """Return the space of one input of the agent's network."""
    def real(*shape):
        limit = 1000.0
        return spaces.Box(-limit, limit, shape, np.float32)

    def index(most, *shape):
        return spaces.Box(0, most - 1, shape, np.int16)

    def maps(*shape):
        return spaces.Box(0, 255, shape, np.uint8)

    if agent.map:
        return spaces.Dict({'room': maps(OF_ROOM, CELLS, CELLS),
                            'others': maps(MAPS_OF_OTHERS, CELLS, CELLS),
                            'numbers': real(NUMBERS), 'choices': maps(CELLS, CELLS)})
    space = {
        'points': real(agent.points, 3), 'half_size': real(3),
        'cameras': real(cameras_of(agent), 3),
        'keys_1': index(agent.points, agent.keys_1),
        'groups_1': index(agent.points, agent.keys_1, agent.group_1),
        'keys_2': index(agent.keys_1, agent.keys_2),
        'groups_2': index(agent.keys_1, agent.keys_2, agent.group_2)}
    if agent.one_by_one:
        space |= {'others': real(MAX_OTHERS, OF_OTHERS), 'turn': real(OF_TURN),
                  'marks': maps(agent.points, MARKS)}
    return spaces.Dict(space)


def cameras_of(agent: AgentConfig) -> int:
    """Return the number of cameras in one action: one, or all."""
    return 1 if agent.one_by_one else agent.cameras


def action_space(cameras: int) -> spaces.Box:
    """Return the space of actions for a number of cameras: two components for each."""
    return spaces.Box(-1.0, 1.0, (cameras, 2), np.float32)


def unwrapped(env: gym.Env) -> CameraPlacementEnv:
    """Return the environment inside its wrappers."""
    inner = env.unwrapped
    if not isinstance(inner, CameraPlacementEnv):
        raise TypeError(f'env: found {type(inner).__name__}; expected CameraPlacementEnv')
    return inner


class PlaneMoves(gym.ActionWrapper):
    """
    Restrict actions to moves in the plane.

    Heights stay, and the heading planner rotates the cameras as in ``policy_node``.

    :param env: environment with a rig file.
    """

    def __init__(self, env: CameraPlacementEnv) -> None:
        super().__init__(env)
        rig = env.rig
        self.action_space = action_space(len(rig.cameras))
        self._aim = HeadingPlanner(rig.models, len(rig.cameras), rig.pitch,
                                   env.config.episode.wall_margin)

    def reset(self, **kwargs):
        """Begin an episode."""
        self._aim.reset()
        return self.env.reset(**kwargs)

    def action(self, action: np.ndarray) -> np.ndarray:
        """Return the action on all axes of the environment."""
        env = unwrapped(self.env)
        axes = np.zeros((len(action), len(env.axes)))
        axes[:, :2] = action
        if 'yaw' in env.axes:
            axes[:, -2:] = self._rotations(env.episode, np.asarray(action, dtype=np.float64))
        return axes

    def _rotations(self, episode: Episode, action: np.ndarray) -> np.ndarray:
        """Choose rotations at the targets: (K, 2) yaw and pitch, in units of ``max_turn``."""
        limits, state, turn = episode.config, state_of(episode), episode.turn
        targets = state.placement[:, :3].copy()
        targets[:state.movable, :2] += bounded_moves(action, limits.max_step)
        headings = self._aim(episode.observed_cloud, state, targets, limits.max_turn, turn.step,
                             limits.turns)
        return way_between(turn.headings, headings[:state.movable]) / limits.max_turn


class EncodedObservation(gym.ObservationWrapper):
    """
    Encode the observed cloud for a network that moves all cameras at once.

    :param env: :class:`~ocp_ros.simulation.environment.CameraPlacementEnv`, or in
        :class:`PlaneMoves`.
    :param agent: with the inputs ``paper``.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        self._agent = agent
        self.observation_space = encoded_space(agent)

    def observation(self, observation) -> dict[str, np.ndarray]:
        """Encode the turn."""
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
    :param agent: with the inputs ``cloud``.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        _, max_step, max_range, *margins = settings_of(
            unwrapped(env).config.episode, unwrapped(env).rig, env.np_random)
        self._encoder = Encoder(agent, max_range, max_step, *margins)
        self.observation_space, self.action_space = encoded_space(agent), action_space(1)
        self.encoded: EncodedTurn | None = None
        #: The cameras that have not chosen yet, and the moves of all cameras (0 if not chosen).
        self._left, self._moves = np.empty(0, dtype=np.int64), np.empty((0, 2))

    def reset(self, **kwargs):
        """Begin an episode."""
        _, info = self.env.reset(**kwargs)
        self._encoder.turns.reset()
        return self._begin(), info

    @property
    def camera(self) -> int:
        """Return the camera that chooses next."""
        return int(self._left[0])

    def step(self, action):
        """Take one camera's move; after the last camera play the turn."""
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
        """Prepare a new turn, and return the observation of the first camera."""
        episode = unwrapped(self.env).episode
        turn = episode.turn
        self._encoder.turns.rig_state = state_of(episode)
        self.encoded = self._encoder.turn(episode.observed_cloud, turn.positions, turn.step,
                                          episode.config.turns)
        self._left = order_of(turn.step, len(turn.positions))
        self._moves = np.zeros((len(turn.positions), 2))
        self._views = list(episode.views)
        self._value = episode.value
        return self._observation()

    def _observation(self) -> dict[str, np.ndarray]:
        """Return the observation of the camera that chooses next."""
        return self.encoded.inputs(self.camera)

    def _judge(self, camera: int) -> RewardTerms:
        """Return the reward of one camera's move, given the moves chosen before it."""
        episode = unwrapped(self.env).episode
        pose = np.concatenate([self.encoded.positions[camera], episode.turn.headings[camera]])
        self._views[camera] = episode.simulator.look(pose, camera)
        before, self._value = self._value, episode.value_of(self._views)
        return episode.reward(before, self._value)


class MapChoices(gym.Wrapper):
    """
    The cameras choose their targets on a map one after the other; then all cameras move.

    The reward of a turn comes with its last choice. The map actor defines the observation and
    which cameras choose in a turn: see :class:`~ocp_ros.policy.map_actor.MapActor`.

    :param env: :class:`~ocp_ros.simulation.environment.CameraPlacementEnv`, or in
        :class:`PlaneMoves`.
    :param agent: with the inputs ``map``.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        self.observation_space, self.action_space = encoded_space(agent), action_space(1)
        self._actor: MapActor | None = None
        self._known: MapTurn | None = None
        self._left: list[int] = []

    def reset(self, **kwargs):
        """Begin an episode; repeat until the first observation is enough for a map."""
        _, info = self.env.reset(**kwargs)
        while not self._begin(new=True):
            _, info = self.env.reset()
        return self._observation(), info

    def step(self, action):
        """Take the target of one camera; after the last choice of a turn move all cameras."""
        known, camera = self._known, self._left.pop(0)
        known.send_to(camera, np.asarray(action)[0])
        if self._left:
            return self._observation(), 0.0, False, False, NO_REWARD._asdict()
        limits, moves = unwrapped(self.env).config.episode, np.zeros(self.env.action_space.shape)
        moves[:len(known.plan)] = self._actor.end(known) / limits.max_step
        _, reward, terminated, truncated, info = self.env.step(moves)
        self._begin()
        return self._observation(), reward, terminated, truncated, info

    def _begin(self, new: bool = False) -> bool:
        """Prepare a turn; return whether the observed points are enough for a map."""
        env = unwrapped(self.env)
        episode, turn, turns = env.episode, env.episode.turn, env.config.episode.turns
        if new:
            self._actor = MapActor(None, *settings_of(env.config.episode, env.rig, env.np_random))
        self._actor.set_rig_state(state_of(episode))
        known = self._actor.begin(episode.observed_cloud, turn.positions, turn.step, turns)
        if known is None:
            return False
        self._known = known
        self._left = self._actor.asked(len(known.plan), turn.step, turns).tolist()
        return True

    def _observation(self) -> dict[str, np.ndarray]:
        """Return the observation of the camera that chooses next."""
        return self._known.experience(self._left[0])


def playable(env: CameraPlacementEnv, agent: AgentConfig) -> gym.Env:
    """
    Wrap an environment for the inputs and actions of an agent.

    :param agent: settings of the network. An action is the target of one camera on the map
        (``map``), the move of one camera in the plane (``cloud``), or the moves of all cameras
        (``paper``).
    """
    level = env if len(env.axes) == 2 else PlaneMoves(env)
    if agent.map:
        return MapChoices(level, agent)
    return (CameraByCamera if agent.one_by_one else EncodedObservation)(level, agent)
