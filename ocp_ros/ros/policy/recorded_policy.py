# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A policy whose choices others can learn from."""

import numpy as np

from ocp_ros.agent.policy import Policy
from ocp_ros.training.experience import Choice


class RecordedPolicy(Policy):
    """A policy that remembers what it read and chose since somebody asked last."""

    def __init__(self, *args) -> None:
        super().__init__(*args)
        self._choices: list[Choice] = []

    def choose(self, encoded: dict[str, np.ndarray], rng: np.random.Generator | None = None
               ) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.agent.policy.Policy.choose`."""
        moves = super().choose(encoded, rng)
        self._choices.append(Choice(encoded, moves))
        return moves

    def take(self) -> list[Choice]:
        """Return the choices since the last call, in their order."""
        choices, self._choices = self._choices, []
        return choices
