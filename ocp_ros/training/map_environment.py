# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The environment as the map actor plays it: an interaction is where one camera goes."""

import gymnasium as gym
import numpy as np

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.planners.map_actor import MapActor
from ocp_ros.planners.map_turn import MapTurn
from ocp_ros.planners.registry import settings_of
from ocp_ros.planners.rollout import state_of
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.reward import NO_REWARD
from ocp_ros.training.encoded_environment import (
    action_space,
    encoded,
    encoded_space,
    on_plane,
    unwrapped,
)


class MapChoices(gym.Wrapper):
    """
    One camera after the other chooses where it goes; when all that are asked have, they walk.

    The reward of a turn comes with its last choice. What is read and who is asked is the map
    actor's: see :class:`~ocp_ros.planners.map_actor.MapActor`.

    :param env: :class:`~ocp_ros.simulation.environment.CameraPlacementEnv`, or in
        :class:`~ocp_ros.training.encoded_environment.PlaneMoves`.
    :param agent: with the inputs ``map``.
    """

    def __init__(self, env: gym.Env, agent: AgentConfig) -> None:
        super().__init__(env)
        self.observation_space, self.action_space = encoded_space(agent), action_space(1)
        self._actor: MapActor | None = None
        self._known: MapTurn | None = None
        self._left: list[int] = []

    def reset(self, **kwargs):
        """Begin an episode, in which something is seen of a room."""
        _, info = self.env.reset(**kwargs)
        while not self._begin(new=True):
            _, info = self.env.reset()
        return self._observation(), info

    def step(self, action):
        """Send a camera somewhere; after the last choice of a turn all cameras walk."""
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
        """Take note of a turn; returns whether anything is known of the room."""
        env = unwrapped(self.env)
        episode, turn, turns = env.episode, env.episode.turn, env.config.episode.turns
        if new:
            self._actor = MapActor(None, *settings_of(env.config, env.np_random))
        self._actor.know(None if episode.problem.rig is None else state_of(episode))
        known = self._actor.begin(episode.observed_cloud, turn.positions, turn.step, turns)
        if known is None:
            return False
        self._known = known
        self._left = self._actor.asked(len(known.plan), turn.step, turns).tolist()
        return True

    def _observation(self) -> dict[str, np.ndarray]:
        """Show the turn to the camera that is next."""
        return self._known.experience(self._left[0])


def playable(env: CameraPlacementEnv, agent: AgentConfig) -> gym.Env:
    """Return an environment as the agent plays it, whatever its inputs are."""
    if not agent.map:
        return encoded(env, agent)
    return MapChoices(on_plane(env), agent)
