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

"""
Interference: active cameras of the same kind that light the same surface, and time slots for them.

A camera lights what it sees. Cameras that interfere must not measure at the same time; the least
number of time slots is the chromatic number of the graph of their conflicts.
"""

from collections.abc import Sequence

import numpy as np
from ocp_ros.rig.connections import INTERFERING, light_of
from ocp_ros.rig.rig_file import Calibratable, Camera
from ocp_ros.simulation.covisibility import covisibility
from ocp_ros.simulation.simulator import View

#: The share of the points of a camera that another one may light as well.
MAX_LIT_SHARE = 0.01
#: The largest number of steps of the search for the least number of time slots.
MAX_STEPS = 200_000


def lit_shares(points: np.ndarray, views: Sequence[View], cameras: Sequence[Camera]
               ) -> np.ndarray:
    """
    Return what pairs of C cameras with the same kind of disturbing light light in common.

    :param points: (N, 3) the points of the room in the engine's order, metres, map frame.
    :param views: the views of the C cameras, each from one position.
    :returns: (C, C) the number of common points as a share of those of the camera that sees
        fewer; 0 for other pairs.
    """
    lights = [light_of(camera) for camera in cameras]
    same = np.array([[light == other and light in INTERFERING for other in lights]
                     for light in lights]) & ~np.eye(len(lights), dtype=bool)
    if not same.any():
        return np.zeros(same.shape)
    # Under any angle.
    return np.where(same, covisibility(points, views, Calibratable(0.0, np.pi)).shares, 0.0)


def time_slots(conflicts: np.ndarray) -> list[int]:
    """
    Assign cameras to the least number of time slots; those in conflict have different ones.

    Branch and bound with the camera first that has conflicts with most slots (Brelaz, New methods
    to color the vertices of a graph, 1979).

    :param conflicts: (C, C) bool, symmetric, False on the diagonal.
    :returns: the slot of each camera, from 0; with more than :data:`MAX_STEPS` steps, perhaps not
        the least number of slots.
    """
    count, steps = len(conflicts), 0
    best = list(range(count))

    def search(slots: list[int], used: int) -> None:
        nonlocal best, steps
        steps += 1
        if used > max(best, default=-1) or steps > MAX_STEPS:
            return
        if -1 not in slots:
            best = slots[:]
            return
        taken = [{slots[other] for other in np.flatnonzero(conflicts[camera])} - {-1}
                 for camera in range(count)]
        camera = max((camera for camera in range(count) if slots[camera] < 0),
                     key=lambda camera: (len(taken[camera]), conflicts[camera].sum()))
        # The last slot is a new one.
        for slot in range(used + 1):
            if slot not in taken[camera]:
                slots[camera] = slot
                search(slots, max(used, slot + 1))
                slots[camera] = -1

    search([-1] * count, 0)
    return best
