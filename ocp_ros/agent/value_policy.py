# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The trained network of the map actor, ready to be asked."""

import numpy as np
import torch

from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.value_network import CellChoices, valued, ValueMap, ValueMapNetwork


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
        """Return what runs other weights."""
        return type(self)(checkpoint)

    def values(self, room: np.ndarray, others: np.ndarray, numbers: np.ndarray, lens: np.ndarray
               ) -> np.ndarray:
        """
        Value all cells for one camera, given the others.

        :param room: of :class:`~ocp_ros.agent.observation_map.ObservationMap`.
        :param others: of its :meth:`~ocp_ros.agent.observation_map.ObservationMap.others`.
        :param numbers: of the same.
        :param lens: of the camera; see :func:`~ocp_ros.agent.observation_map.told_of`.
        :returns: (D, 64, 64) float32: ln((E with the camera + e) / (E of the others + e)) of the
            depth error E, for each heading of
            :func:`~ocp_ros.agent.observation_map.yaws_of`; inf beyond what was seen.
        """
        aimed = self._network.aimed
        network = self._network if aimed is None or lens.min() >= 1.0 else aimed
        return _valued(network, {'room': room, 'others': others, 'numbers': numbers,
                                 'lens': lens})[0].numpy()

    def draw(self, inputs: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
        """
        Draw where a camera goes from the distribution that soft actor-critic trains.

        :param inputs: of :meth:`values`, and ``choices`` (64, 64), not 0 where it may go.
        :param rng: the only source of chance.
        :returns: (2,) float32, from the map's middle in units of half its side.
        """
        free = torch.from_numpy(inputs['choices'])[None]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(rng.integers(1 << 62)))
            return CellChoices(_valued(self._network, inputs), free).sample()[0].numpy()


def _valued(network: ValueMap, inputs: dict[str, np.ndarray]) -> torch.Tensor:
    """Value all cells: (1, D, 64, 64)."""
    with torch.inference_mode():
        return valued(network, {name: torch.from_numpy(value)[None]
                                for name, value in inputs.items()})
