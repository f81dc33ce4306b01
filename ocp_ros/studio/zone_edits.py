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
from ocp_ros.report.drawing.plan_drawing import STYLES, zones_of
from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.zones import Zone
from ocp_ros.scenes.scene import Scene

#: Keys of the lists in a rig's document, by the kinds of their zones as people read them.
KEYS = {'region': 'regions', 'keep-out zone': 'keep_out', 'mounting zone': 'keep_in'}


class Entry(NamedTuple):
    """
    A zone or region of a rig.

    :ivar key: key of its list in the rig's document.
    :ivar number: index in that list.
    :ivar data: its item of that list.
    :ivar zone: its shape.
    :ivar label: its name for people.
    :ivar colour: of its edges, such as ``#d55e00``.
    """

    key: str
    number: int
    data: dict[str, Any]
    zone: Zone
    label: str
    colour: str

    @property
    def is_box(self) -> bool:
        """Return whether the zone is a box, which people can drag."""
        return 'box' in self.data


def entries_of(rig: Rig) -> Iterator[Entry]:
    """Yield an entry for each zone and region of a rig, in the order of their lists."""
    entry_counts = Counter[str]()
    for kind, name, zone in zones_of(rig):
        # Must-see and weighted regions, whose kinds are not in KEYS, share the list ``regions``.
        # The zones of each list come in its order, so counting them gives the index.
        key = KEYS.get(kind, 'regions')
        number = entry_counts[key]
        entry_counts[key] += 1
        # The name of a keep-out or mounting zone begins with its kind, that of a region does not.
        yield Entry(key, number, rig.document.data[key][number], zone,
                    name if kind in KEYS else f'region {name}', STYLES[kind]['edgecolor'])


def changed_entry(rig: Rig, entry: Entry, **new_values: Any) -> dict[str, Any]:
    """
    Return the change of a rig that changes one entry, for :meth:`.Studio.set_rig`.

    :param new_values: by the keys of the entry's data; None removes a key.
    :returns: the key of the entry's list, and the new list.
    """
    data = {key: value for key, value in {**entry.data, **new_values}.items() if value is not None}
    items = list(rig.document.data[entry.key])
    items[entry.number] = data
    return {entry.key: items}


def moved_box(rig: Rig, entry: Entry, centre: np.ndarray) -> dict[str, Any]:
    """
    Return the change of a rig that moves a box, for :meth:`.Studio.set_rig`.

    :param centre: (3,) new centre of the box, metres, map frame.
    :returns: the key of the box's list, and the new list.
    """
    low, high = np.array(entry.data['box'], dtype=np.float64)
    half_size = 0.5 * (high - low)
    return changed_entry(rig, entry, box=box_data(centre - half_size, centre + half_size))


def box_data(low: np.ndarray, high: np.ndarray) -> list[list[float]]:
    """
    Return a box for a rig's document: its lowest and highest corner, rounded to millimetres.

    :param low: (3,) lowest corner, metres, map frame.
    :param high: (3,) highest corner, metres, map frame.
    """
    return [np.round(np.asarray(corner, dtype=np.float64), decimals=3).tolist()
            for corner in (low, high)]


def removed_entry(rig: Rig, entry: Entry) -> dict[str, Any]:
    """
    Return the change of a rig that removes one entry, for :meth:`.Studio.set_rig`.

    :returns: the key of the entry's list, and the list without the entry.
    """
    items = list(rig.document.data[entry.key])
    del items[entry.number]
    return {entry.key: items}


def added_box(rig: Rig, key: str, scene: Scene, floor: float) -> dict[str, Any]:
    """
    Return the change of a rig that adds a box in the middle of the room.

    :param key: key of the list that gets the box, one of the values of :data:`KEYS`.
    :param scene: the room.
    :param floor: height of the floor, metres, map frame.
    :returns: the key, and the new list.
    """
    half_size = 0.5 * np.array([1.5, 1.5, 1.2])
    # The box begins 5 cm below the floor, so that the points of the floor are inside.
    centre = np.append(scene.bounds.mean(axis=0)[:2], floor - 0.05 + half_size[2])
    items = list(rig.document.data.get(key, ()))
    data: dict[str, Any] = {'box': box_data(centre - half_size, centre + half_size)}
    if key == 'regions':
        used_names = {item['name'] for item in items}
        names = (f'region_{k}' for k in range(1, len(used_names) + 2))
        data['name'] = next(name for name in names if name not in used_names)
    return {key: [*items, data]}
