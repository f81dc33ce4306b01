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

"""The policy: a trained network that chooses moves or targets from the observed cloud."""

import numpy as np
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.policy.networks import Actor, SYMMETRIES, turned_observation, turned_vectors
from ocp_ros.policy.observation_cloud import encode
from ocp_ros.policy.value_network import CellChoices, valued, ValueMap, ValueMapNetwork
from ocp_ros.rig.motion import order_of
import torch


class Policy:
    """
    Run a checkpoint that reads the observed cloud; stable-baselines3 is not needed.

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
        :param turn: time steps taken so far.
        :param turns: time steps of the whole episode.
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

        :param encoded: one observation; see :mod:`ocp_ros.policy.observation_cloud`.
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


class ValuePolicy:
    """
    Run a checkpoint of the map actor; stable-baselines3 is not needed.

    :param checkpoint: weights and sizes.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.checkpoint = checkpoint
        network = ValueMapNetwork(checkpoint.config)
        network.load_state_dict(checkpoint.weights)
        self._network = network.eval().to(memory_format=torch.channels_last)

    def replaced(self, checkpoint: Checkpoint) -> 'ValuePolicy':
        """Return a policy with other weights."""
        return type(self)(checkpoint)

    def values(self, room: np.ndarray, others: np.ndarray, numbers: np.ndarray, lens: np.ndarray
               ) -> np.ndarray:
        """
        Return the values of all cells for one camera, given the other cameras.

        :param room: channels of :class:`~ocp_ros.policy.observation_map.ObservationMap`.
        :param others: channels of
            :meth:`~ocp_ros.policy.observation_map.ObservationMap.others`.
        :param numbers: scalars of the same method.
        :param lens: of the camera; see :func:`~ocp_ros.policy.observation_map.lens_features`.
        :returns: (D, 64, 64) float32: ln((E1 + e) / (E0 + e)) of the depth error E0 of the other
            cameras, E1 with this camera too, and a small e; for each of the D headings of
            :func:`~ocp_ros.policy.observation_map.yaws_of`; inf outside the observed part.
        """
        aimed = self._network.aimed
        # The values of ``lens`` are 1 for an omnidirectional camera.
        network = self._network if aimed is None or lens.min() >= 1.0 else aimed
        inputs = {'room': room, 'others': others, 'numbers': numbers, 'lens': lens}
        return _cell_values(network, inputs)[0].numpy()

    def draw(self, inputs: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """
        Draw the target of a camera from the distribution that soft actor-critic trains.

        :param inputs: ``room``, ``others`` and ``numbers`` of :meth:`values`, and ``choices``
            (64, 64), not 0 for feasible cells.
        :param rng: the only source of random numbers.
        :returns: (2,) float32, x and y from the centre of the map, in units of half its side.
        """
        feasible = torch.from_numpy(inputs['choices'])[None]
        # The draw depends on ``rng`` alone, and the generator of torch does not advance.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(1 << 62)))
            return CellChoices(_cell_values(self._network, inputs), feasible).sample()[0].numpy()


def _cell_values(network: ValueMap, inputs: dict[str, np.ndarray]) -> torch.Tensor:
    """Return the values of all cells for one observation: (1, D, 64, 64)."""
    with torch.inference_mode():
        return valued(network, {name: torch.from_numpy(value)[None]
                                for name, value in inputs.items()})


def make_policy(checkpoint: Checkpoint) -> Policy | ValuePolicy:
    """Return the policy that runs a checkpoint."""
    return ValuePolicy(checkpoint) if checkpoint.config.map else Policy(checkpoint)
