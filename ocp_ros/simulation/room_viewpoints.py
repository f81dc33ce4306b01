# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Viewpoints of the depth error where a scan is more than one star-shaped room.

The five of the paper are placed by the bounding box. In a floor of many rooms they see few of
them, and what they do not see does not count. Where they miss much of what can be seen from the
air of the rooms at all, viewpoints are taken from that air instead: greedily, each time the place
from which most is seen that no place before it sees.
"""

from collections.abc import Callable

import numpy as np

from ocp_ros.geometry.depth_error import viewpoints
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.rig.structure import Air
from ocp_ros.scenes.scene import Scene

#: Share of the points in sight from the air that the five may miss: they miss up to 0.21 of
#: generated rooms, niches and partitions included, and 0.6 of a floor of ten offices.
MISSED = 0.25
#: Places in the air that are looked at, share of the points that may be left out, and the most
#: viewpoints.
PLACES, LEFT, MOST = 160, 0.01, 48


def viewpoints_in(scene: Scene, air: Air, look: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """
    Place the viewpoints of the depth error in a room, or in several.

    :param scene: the room.
    :param air: where a ball can be carried to in it.
    :param look: returns the packed bits (W,) of the points seen from a position (3,), metres.
    :returns: (V, 3) metres: the five of the paper where they see most of what can be seen.
    """
    five = viewpoints(scene.bounds)
    seen = np.bitwise_or.reduce([look(place) for place in five])
    # Of what nobody sees there is no more than this.
    if len(scene) - count_bits(seen) <= MISSED * len(scene):
        return five
    places = air.places(float(scene.bounds[:, 2].mean()), PLACES)
    views = [look(place) for place in places]
    whole = np.bitwise_or.reduce([seen, *views])
    if count_bits(whole & ~seen) <= MISSED * count_bits(whole):
        return five
    left, chosen, points = np.bitwise_or.reduce(views), [], count_bits(whole)
    while count_bits(left) > LEFT * points and len(chosen) < MOST:
        best = int(np.argmax([count_bits(view & left) for view in views]))
        chosen.append(best)
        left = left & ~views[best]
    return places[chosen]
