# SPDX-License-Identifier: Apache-2.0
"""The policy: a trained actor that turns what was seen into the next move of each camera."""

import numpy as np
import torch

from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.networks import Actor
from ocp_ros.agent.observation import encode


class Policy:
    """
    Run a checkpoint; stable-baselines3 is not needed.

    :param checkpoint: weights and sizes.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.checkpoint = checkpoint
        self.actor = Actor(checkpoint.config)
        self.actor.load_state_dict(checkpoint.weights)
        self.actor.eval()

    def act(self, cloud: np.ndarray, camera_positions: np.ndarray,
            rng: np.random.Generator | None = None) -> np.ndarray:
        """
        Choose the next move of each camera.

        :param cloud: (N, 3) float32, metres, map frame: all points seen so far, N >= 1.
        :param camera_positions: (K, 3), metres, map frame.
        :param rng: draw the moves from the policy's distribution; None for the most likely ones.
        :returns: (K, 2) float32 in [-1, 1], in units of the longest step.
        """
        bounds = np.stack([cloud.min(axis=0), cloud.max(axis=0)])
        encoded = encode(cloud, camera_positions, bounds, self.checkpoint.config)
        batch = {name: torch.from_numpy(value)[None] for name, value in encoded.items()}
        with torch.inference_mode():
            mean, log_std = (value[0].numpy() for value in self.actor(batch))
        if rng is not None:
            mean = mean + np.exp(log_std) * rng.standard_normal(mean.shape, dtype=np.float32)
        return np.tanh(mean)
