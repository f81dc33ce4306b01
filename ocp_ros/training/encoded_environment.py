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
from ocp_ros.simulation.simulator import View


def encoded_space(agent: AgentConfig) -> spaces.Dict:
    """
    Return the space of one input of the agent's network.

    See :meth:`~ocp_ros.policy.map_turn.MapTurn.experience` for the inputs ``map``,
    :class:`~ocp_ros.policy.cloud_encoder.Encoder` for ``cloud``, and
    :func:`~ocp_ros.policy.observation_cloud.encode` for ``paper``.
    """
    def real_box(*shape):
        # A finite bound that no input reaches.
        limit = 1000.0
        return spaces.Box(-limit, limit, shape, np.float32)

    def index_box(count, *shape):
        return spaces.Box(0, count - 1, shape, np.int16)

    def map_box(*shape):
        return spaces.Box(0, 255, shape, np.uint8)

    if agent.map:
        return spaces.Dict({'room': map_box(OF_ROOM, CELLS, CELLS),
                            'others': map_box(MAPS_OF_OTHERS, CELLS, CELLS),
                            'numbers': real_box(NUMBERS), 'choices': map_box(CELLS, CELLS)})
    space = {
        'points': real_box(agent.points, 3), 'half_size': real_box(3),
        'cameras': real_box(cameras_of(agent), 3),
        'keys_1': index_box(agent.points, agent.keys_1),
        'groups_1': index_box(agent.points, agent.keys_1, agent.group_1),
        'keys_2': index_box(agent.keys_1, agent.keys_2),
        'groups_2': index_box(agent.keys_1, agent.keys_2, agent.group_2)}
    if agent.one_by_one:
        space |= {'others': real_box(MAX_OTHERS, OF_OTHERS), 'turn': real_box(OF_TURN),
                  'marks': map_box(agent.points, MARKS)}
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
        return way_between(turn.headings, headings[:state.movable]) / limits.max_turn


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
    :ivar encoded: the present turn, encoded for the network.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        # The first setting is the random generator, which the encoder does not need; the last ones
        # are the distances to keep from walls and from points.
        _, max_step, max_range, *margins = settings_of(
            unwrapped(env).config.episode, unwrapped(env).rig, env.np_random)
        self._encoder = Encoder(agent, max_range, max_step, *margins)
        self.observation_space, self.action_space = encoded_space(agent), action_space(1)
        self.encoded: EncodedTurn | None = None
        #: The cameras that have not chosen yet.
        self._waiting = np.empty(0, dtype=np.int64)
        #: (K, 2) in units of ``max_step``, the moves of all cameras; 0 if not chosen yet.
        self._moves = np.empty((0, 2))
        #: The views of all cameras, of those that have chosen from their new positions.
        self._views: list[View] = []
        #: Space coverage and error of these views; see ``Episode.value_of``.
        self._value = (0.0, 0.0)

    def reset(self, **kwargs):
        """Begin an episode."""
        _, info = self.env.reset(**kwargs)
        self._encoder.partial_maps.reset()
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
        _, _, terminated, truncated, info = self.env.step(moves)
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
        self._views = list(episode.views)
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
        before, self._value = self._value, episode.value_of(self._views)
        return episode.reward(before, self._value)


class MapChoices(gym.Wrapper):
    """
    The cameras choose their targets on a map one after the other; then all cameras move.

    The last choice of a turn gets the reward of the turn, all others get 0. The map actor defines
    the observations, and which cameras choose in a turn: see
    :class:`~ocp_ros.policy.map_actor.MapActor`.

    :param env: :class:`~ocp_ros.simulation.environment.CameraPlacementEnv`, or in
        :class:`PlaneMoves`.
    :param agent: settings with the inputs ``map``.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        self.observation_space, self.action_space = encoded_space(agent), action_space(1)
        #: The actor that makes the maps of the episode, and the map of the turn.
        self._actor: MapActor | None = None
        self._map_turn: MapTurn | None = None
        #: The cameras that are still to choose in this turn, in order; one may occur repeatedly.
        self._waiting: list[int] = []

    def reset(self, **kwargs):
        """Begin an episode; begin others until the observed points are enough for a map."""
        _, info = self.env.reset(**kwargs)
        while not self._begin(new=True):
            _, info = self.env.reset()
        return self._observation(), info

    def step(self, action):
        """Take the target of one camera; after the last choice of a turn move all cameras."""
        map_turn = self._map_turn
        map_turn.send_to(self._waiting.pop(0), np.asarray(action)[0])
        if self._waiting:
            return self._observation(), 0.0, False, False, NO_REWARD._asdict()
        max_step = unwrapped(self.env).config.episode.max_step
        moves = np.zeros(self.env.action_space.shape)
        moves[:len(map_turn.plan)] = self._actor.end(map_turn) / max_step
        _, reward, terminated, truncated, info = self.env.step(moves)
        # The result is not needed: the points were enough for a map in ``reset``, and more follow.
        self._begin()
        return self._observation(), reward, terminated, truncated, info

    def _begin(self, new: bool = False) -> bool:
        """
        Prepare a turn; return whether the observed points are enough for a map.

        :param new: whether this is the first turn of an episode.
        """
        env = unwrapped(self.env)
        episode, turn, turns = env.episode, env.episode.turn, env.config.episode.turns
        if new:
            # Without a policy, as the actions of the environment choose the targets.
            self._actor = MapActor(None, *settings_of(env.config.episode, env.rig, env.np_random))
        self._actor.set_rig_state(state_of(episode))
        map_turn = self._actor.begin(episode.observed_cloud, turn.positions, turn.step, turns)
        if map_turn is None:
            return False
        self._map_turn = map_turn
        self._waiting = self._actor.asked(len(map_turn.plan), turn.step, turns).tolist()
        return True

    def _observation(self) -> dict[str, np.ndarray]:
        """Return the observation of the camera that chooses next."""
        return self._map_turn.experience(self._waiting[0])


def playable(env: CameraPlacementEnv, agent: AgentConfig) -> gym.Env:
    """
    Return an environment with the inputs and actions of an agent.

    :param agent: settings of the network. An action is the target of one camera on the map
        (``map``), the move of one camera in the plane (``cloud``), or the moves of all cameras
        (``paper``).
    """
    plane_env = env if len(env.axes) == 2 else PlaneMoves(env)
    if agent.map:
        return MapChoices(plane_env, agent)
    return (CameraByCamera if agent.one_by_one else EncodedObservation)(plane_env, agent)
