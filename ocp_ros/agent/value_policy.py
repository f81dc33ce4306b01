# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The trained network of the map actor, ready to be asked."""

import numpy as np
import torch

from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.observation_map import CELLS, used_part
from ocp_ros.agent.value_network import ValueMapNetwork


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
        return ValuePolicy(checkpoint)

    def values(self, room: np.ndarray, others: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """
        Value all cells for one camera, given the others.

        :param room: of :class:`~ocp_ros.agent.observation_map.ObservationMap`.
        :param others: of its :meth:`~ocp_ros.agent.observation_map.ObservationMap.others`.
        :param numbers: of the same.
        :returns: (64, 64) float32: ln((D with the camera + e) / (D of the others + e)); inf
            beyond what was seen.
        """
        rows, columns = used_part(room)
        values = np.full((CELLS, CELLS), np.inf, dtype=np.float32)
        with torch.inference_mode():
            values[rows, columns] = self._network({
                'room': torch.from_numpy(room[None, :, rows, columns]),
                'others': torch.from_numpy(others[None, :, rows, columns]),
                'numbers': torch.from_numpy(numbers)[None]})[0].numpy()
        return values
