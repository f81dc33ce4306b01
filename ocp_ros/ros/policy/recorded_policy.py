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

"""A policy that records its choices, so that a trainer can learn from them."""

import numpy as np
from ocp_ros.policy.policy import Policy
from ocp_ros.training.experience import Choice


class RecordedPolicy(Policy):
    """A policy that records its observations and choices until they are taken."""

    def __init__(self, *args) -> None:
        super().__init__(*args)
        self._choices: list[Choice] = []

    def take_choices(self) -> list[Choice]:
        """Return the choices since the last call, in their order, and clear them."""
        choices = self._choices
        self._choices = []
        return choices

    def choose(self, encoded: dict[str, np.ndarray], rng: np.random.Generator | None = None
               ) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.policy.policy.Policy.choose`."""
        moves = super().choose(encoded, rng)
        self._choices.append(Choice(encoded, moves))
        return moves
