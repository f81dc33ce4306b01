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

"""States of the studio, between which undo and redo go, and changes of a rig."""

from collections.abc import Sequence
from dataclasses import dataclass, field
import re
from typing import Any

import numpy as np
from ocp_ros.rig.rig_file import Camera, Rig, rig_from
from ocp_ros.rig.schemas import MAX_NAME_LENGTH, RIG
from ocp_ros.util.yaml_files import check, Document


@dataclass(frozen=True, eq=False)
class State:
    """
    The placement at one moment of the editing; a state never changes.

    :ivar rig: cameras, constraints and tasks; its document has one entry for each of the K cameras
        to be placed.
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
    """The present state, and the states that undo and redo bring back."""

    present: State
    past_states: list[State] = field(default_factory=list)
    undone_states: list[State] = field(default_factory=list)
    #: The action that led to the present state.
    _action: object = None

    def set_present(self, state: State, action: object = None) -> None:
        """
        Make a state the present one.

        :param action: identifies an action of several changes, such as a drag, which are undone
            together; None if this change is the whole action.
        """
        if action is None or action != self._action:
            # At most 200 states can be undone.
            self.past_states = [*self.past_states, self.present][-200:]
        self.present = state
        self.undone_states = []
        self._action = action

    def undo(self) -> bool:
        """Go back to the previous state; return whether there was one."""
        return self._move_state(self.past_states, self.undone_states)

    def redo(self) -> bool:
        """Go to the state that was undone last; return whether there was one."""
        return self._move_state(self.undone_states, self.past_states)

    def _move_state(self, source: list[State], target: list[State]) -> bool:
        """Append the present state to ``target``, and take the new one from ``source``."""
        if not source:
            return False
        target.append(self.present)
        self.present = source.pop()
        # The next change becomes a step of its own, also if it belongs to the same action.
        self._action = None
        return True


def changed_rig(rig: Rig, **new_values: Any) -> Rig:
    """
    Return a rig with other values of some keys of its document.

    :param new_values: by the keys of the document.
    :raises ConfigurationError: if a value cannot be used.
    """
    document = Document(rig.document.name, {**rig.document.data, **new_values})
    check(document, RIG)
    return rig_from(document)


def split_groups(rig: Rig) -> Rig:
    """Return the same rig with one named entry in its document for each camera to be placed."""
    # One entry per camera, in the order of ``rig.cameras``.
    groups = [group for group in rig.document.data['cameras']
              for _ in range(group.get('count', 1))]
    return changed_rig(rig, cameras=[camera_entry(group, camera.name)
                                     for group, camera in zip(groups, rig.cameras)])


def camera_entry(group: dict[str, Any], name: str) -> dict[str, Any]:
    """
    Return the entry of a single camera with a name.

    :param group: the entry of one or more cameras of the same kind.
    """
    return {'name': name, **{key: value for key, value in group.items()
                             if key not in ('name', 'count')}}


def new_name(stem: str, cameras: Sequence[Camera]) -> str:
    """Return a name that no camera has: the stem, followed by a number if necessary."""
    used_names = {camera.name for camera in cameras}
    # The number of the stem is replaced by another one; 4 characters are for _ and this number.
    if stem in used_names:
        stem = re.sub(r'_\d+$', '', stem)[:MAX_NAME_LENGTH - 4]
    names = (stem, *(f'{stem}_{k}' for k in range(1, len(used_names) + 2)))
    return next(name for name in names if name not in used_names)
