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

"""Zones and regions of a rig as entries of lists that the page shows and edits."""

from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.report.drawing.plan_marks import STYLES, zones_of
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.zones import Zone
from ocp_ros.scenes.scene import Scene

#: Keys of the rig's lists by the names of their zones for people.
KEYS = {'region': 'regions', 'keep-out zone': 'keep_out', 'mounting zone': 'keep_in'}
#: Metres: the edges of a new box, and how far it goes below the floor.
EDGES, BELOW = np.array([1.5, 1.5, 1.2]), 0.05
#: Decimals of metres in the rig.
METRES = 3


class Entry(NamedTuple):
    """
    A zone of a rig.

    :ivar key: key of its list in the rig's document.
    :ivar number: position in that list.
    :ivar data: its data in the document.
    :ivar zone: its shape.
    :ivar label: its name for people.
    :ivar colour: of its edges.
    """

    key: str
    number: int
    data: dict[str, Any]
    zone: Zone
    label: str
    colour: str

    @property
    def is_box(self) -> bool:
        """Return whether it is a box, which people can drag."""
        return 'box' in self.data


def entries_of(rig: Rig) -> Iterator[Entry]:
    """Yield all zones and regions of a rig."""
    numbers = Counter[str]()
    for kind, name, zone in zones_of(rig):
        key = KEYS.get(kind, KEYS['region'])
        number = numbers[key]
        numbers[key] += 1
        yield Entry(key, number, rig.document.data[key][number], zone,
                    name if kind in KEYS else f'region {name}', STYLES[kind]['edgecolor'])


def changed_entry(rig: Rig, entry: Entry, **parts: Any) -> dict[str, Any]:
    """Return the list of an entry with other values in it, for :meth:`Studio.set_rig`."""
    data = {key: value for key, value in {**entry.data, **parts}.items() if value is not None}
    others = list(rig.document.data[entry.key])
    others[entry.number] = data
    return {entry.key: others}


def moved_box(rig: Rig, entry: Entry, middle: np.ndarray) -> dict[str, Any]:
    """Return the list of a box with the box around another middle (3,), metres."""
    low, high = np.array(entry.data['box'], dtype=np.float64)
    half = 0.5 * (high - low)
    return changed_entry(rig, entry, box=box_of(middle - half, middle + half))


def box_of(low: np.ndarray, high: np.ndarray) -> list[list[float]]:
    """Return a box for a rig's document."""
    return [np.round(np.asarray(corner, dtype=np.float64), METRES).tolist()
            for corner in (low, high)]


def without(rig: Rig, entry: Entry) -> dict[str, Any]:
    """Return the list of an entry without it."""
    others = list(rig.document.data[entry.key])
    del others[entry.number]
    return {entry.key: others}


def with_new(rig: Rig, key: str, scene: Scene, floor: float) -> dict[str, Any]:
    """Return a list with a new box in the middle of the room."""
    before = list(rig.document.data.get(key, ()))
    middle = np.append(scene.bounds.mean(axis=0)[:2], floor - BELOW + 0.5 * EDGES[2])
    data: dict[str, Any] = {'box': box_of(middle - 0.5 * EDGES, middle + 0.5 * EDGES)}
    if key == 'regions':
        names = {entry['name'] for entry in before}
        data['name'] = next(name for name in (f'region_{k}' for k in range(1, len(names) + 2))
                            if name not in names)
    return {key: [*before, data]}
