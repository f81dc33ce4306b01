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

"""The policy: a trained network that chooses moves from the observed cloud."""

import numpy as np
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.cloud_encoder import encode, Encoder
from ocp_ros.policy.networks import Actor, SYMMETRIES, turned_observation, turned_vectors
from ocp_ros.rig.motion import order_of
import torch


class Policy:
    """
    Run a checkpoint; stable-baselines3 is not needed.

    :param checkpoint: weights, and sizes of the network.
    :param encoder: makes the network's inputs; None for an encoder of a rig with default values.
    """

    def __init__(self, checkpoint: Checkpoint, encoder: Encoder | None = None) -> None:
        self.checkpoint = checkpoint
        self.encoder = Encoder(checkpoint.config) if encoder is None else encoder
        self.actor = Actor(checkpoint.config)
        self.actor.load_state_dict(checkpoint.weights)
        self.actor.eval()

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self.encoder.partial_maps.reset()

    def replaced(self, checkpoint: Checkpoint) -> 'Policy':
        """Return a policy with other weights; it keeps the encoder's state of the episode."""
        return type(self)(checkpoint, self.encoder)

    def act(self, cloud: np.ndarray, camera_positions: np.ndarray, turn: int = 0, turns: int = 30,
            rng: np.random.Generator | None = None) -> np.ndarray:
        """
        Choose the next move of each camera.

        :param cloud: (N, 3) float32, metres, map frame: N observed points.
        :param camera_positions: (K, 3), metres, map frame, of the K cameras.
        :param turn: turns taken so far.
        :param turns: turns of the whole episode.
        :param rng: generator to draw the moves at random; None for the most probable moves.
        :returns: (K, 2) float32, in units of the longest step.
        :raises ConfigurationError: if the weights are for another number of cameras.
        """
        self.checkpoint.config.check_cameras(len(camera_positions))
        if not self.checkpoint.config.one_by_one:
            return self.choose(encode(cloud, camera_positions, self.checkpoint.config), rng)
        moves = np.empty((len(camera_positions), 2), dtype=np.float32)
        encoded = self.encoder.turn(cloud, camera_positions, turn, turns)
        for camera in order_of(turn, len(moves)):
            moves[camera] = encoded.move(camera, self.choose(encoded.inputs(camera), rng)[0])
        return moves

    def choose(self, encoded: dict[str, np.ndarray], rng: np.random.Generator | None = None
               ) -> np.ndarray:
        """
        Choose the next moves of the cameras of an encoded observation.

        The most probable move of the network ``cloud`` is the mean over the eight symmetries of
        the plane, which reduces the network's errors.

        :param encoded: one observation; see :mod:`ocp_ros.policy.cloud_encoder`.
        :param rng: generator to draw the moves at random; None for the most probable moves.
        :returns: (K, 2) float32, in units of the longest step.
        """
        is_averaged = rng is None and self.checkpoint.config.one_by_one
        # The first symmetry changes nothing.
        matrices = SYMMETRIES if is_averaged else SYMMETRIES[:1]
        batch = {name: torch.from_numpy(value).expand(len(matrices), *value.shape)
                 for name, value in encoded.items()}
        with torch.inference_mode():
            mean, log_std = self.actor(turned_observation(batch, matrices))
            if rng is not None:
                # The draw depends on ``rng`` alone, and the generator of torch does not advance.
                with torch.random.fork_rng(devices=[]):
                    torch.manual_seed(int(rng.integers(1 << 62)))
                    mean = mean + log_std.exp() * torch.randn_like(mean)
            moves = torch.tanh(mean).unflatten(1, (-1, 2))
            # The transposed matrices turn the moves back.
            return turned_vectors(moves, matrices.transpose(1, 2)).mean(dim=0).numpy()
