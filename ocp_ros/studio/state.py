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

"""States of the studio, which undo and redo exchange, and changes of a rig."""

from collections.abc import Sequence
from dataclasses import dataclass, field
import re
from typing import Any

import numpy as np
from ocp_ros.rig.rig_file import Camera, Rig, rig_from
from ocp_ros.rig.schemas import MAX_NAME_LENGTH, RIG
from ocp_ros.util.yaml_files import check, Document

#: Number of states that can be undone.
MOST = 200


@dataclass(frozen=True, eq=False)
class State:
    """
    A placement that is being edited; it never changes.

    :ivar rig: cameras, constraints and tasks; its document has one entry for each camera.
    :ivar poses: (K, 6) metres, map frame, and radians, rounded as in placement files.
    :ivar locked: names of the cameras that neither a person nor a planner may move.
    """

    rig: Rig
    poses: np.ndarray
    locked: frozenset[str] = frozenset()

    @property
    def names(self) -> list[str]:
        """Return the names of the cameras to be placed."""
        return [camera.name for camera in self.rig.cameras]


@dataclass
class History:
    """The present state and those before and after it."""

    now: State
    past: list[State] = field(default_factory=list)
    future: list[State] = field(default_factory=list)
    #: The action that led to the present state.
    _action: object = None

    def change(self, state: State, action: object = None) -> None:
        """
        Set the present state.

        :param action: steps of one action, such as a drag, are undone together; None for an action
            of a single step.
        """
        if action is None or action != self._action:
            self.past = [*self.past, self.now][-MOST:]
        self.now, self.future, self._action = state, [], action

    def undo(self) -> bool:
        """Go back to the state before; return whether there is one."""
        return self._step(self.past, self.future)

    def redo(self) -> bool:
        """Go to the state that was undone last; return whether there is one."""
        return self._step(self.future, self.past)

    def _step(self, source: list[State], target: list[State]) -> bool:
        """Take the present state from the end of a list, and put the old one on another."""
        if not source:
            return False
        target.append(self.now)
        self.now, self._action = source.pop(), None
        return True


def changed(rig: Rig, **parts: Any) -> Rig:
    """
    Return a rig with other values of some keys of its document.

    :raises ConfigurationError: if a value cannot be used.
    """
    document = Document(rig.document.name, {**rig.document.data, **parts})
    check(document, RIG)
    return rig_from(document)


def separated(rig: Rig) -> Rig:
    """Return the same rig; its document has one entry with a name for each camera."""
    groups = [group for group in rig.document.data['cameras']
              for _ in range(group.get('count', 1))]
    return changed(rig, cameras=[entry_of(group, camera.name)
                                 for group, camera in zip(groups, rig.cameras)])


def entry_of(entry: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the entry of a single camera with a name."""
    return {'name': name, **{key: value for key, value in entry.items()
                             if key not in ('name', 'count')}}


def new_name(stem: str, cameras: Sequence[Camera]) -> str:
    """Return a name that no camera has: a stem, followed by a number if necessary."""
    taken = {camera.name for camera in cameras}
    stem = re.sub(r'_\d+$', '', stem)[:MAX_NAME_LENGTH - 4] if stem in taken else stem
    names = (stem, *(f'{stem}_{k}' for k in range(1, len(taken) + 2)))
    return next(name for name in names if name not in taken)
