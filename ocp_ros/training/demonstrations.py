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

"""Demonstrations: episodes in which cameras go to placements planned with the whole scan."""

from collections.abc import Sequence

import numpy as np
from ocp_ros.online.online_planner import matched
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.search.greedy import GreedySwap
from ocp_ros.search.scorer import Scorer
from ocp_ros.search.solve import solve
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import space_of
from ocp_ros.training.encoded_environment import CameraByCamera, unwrapped


class Demonstrator:
    """
    Choose the actions of cameras that go straight to a good placement in their room.

    A call returns the next action of each of E environments: (E, 1, 2) float32.

    :param envs: the E environments.
    :param seed: random seed of the searches for placements.
    """

    def __init__(self, envs: Sequence[CameraByCamera], seed: int) -> None:
        self._envs = envs
        self._rng = np.random.default_rng(seed)
        #: The episode and its targets (K, 2), metres, for K cameras, of each environment. The
        #: episode is None until the first action is chosen.
        self._plans: list[tuple[Episode | None, np.ndarray]] = [
            (None, np.empty((0, 2)))] * len(envs)

    def __call__(self) -> np.ndarray:
        """Return the next action of each environment: (E, 1, 2) float32."""
        return np.array([[self._action(number)] for number in range(len(self._envs))], np.float32)

    def _action(self, number: int) -> np.ndarray:
        """Return the move (2,) of the next camera of an environment, in units of ``max_step``."""
        env = self._envs[number]
        episode = unwrapped(env).episode
        # A new episode needs new targets.
        if self._plans[number][0] is not episode:
            self._plans[number] = episode, self._targets(episode)
        target = self._plans[number][1][env.camera]
        offset = target - env.encoded.positions[env.camera, :2]
        return bounded_moves(offset / episode.config.max_step, 1.0)[0]

    def _targets(self, episode: Episode) -> np.ndarray:
        """Search for a placement; return the target of each of K cameras: (K, 2) metres."""
        positions = episode.turn.positions
        space = space_of(episode.simulator, len(positions))
        evaluations = 300
        targets = solve(GreedySwap(space, self._rng, evaluations), Scorer(episode.simulator),
                        evaluations).placement[:, :2]
        # Assign the targets to the cameras with the shortest total path.
        return targets[matched(positions, targets)]
