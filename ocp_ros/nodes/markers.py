# SPDX-License-Identifier: Apache-2.0
"""Markers for RViz and Foxglove: cameras, the ways they took, and how far they see."""

from geometry_msgs.msg import Point, Vector3
import numpy as np
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

CAMERA_COLOUR = ColorRGBA(r=0.84, g=0.15, b=0.16, a=1.0)
TRAJECTORY_COLOUR = ColorRGBA(r=1.0, g=1.0, b=1.0, a=0.9)
RANGE_COLOUR = ColorRGBA(r=0.4, g=0.65, b=1.0, a=0.08)
MOVE_COLOUR = ColorRGBA(r=1.0, g=0.75, b=0.1, a=1.0)


def rig_markers(trajectories: np.ndarray, ranges: np.ndarray, header: Header) -> MarkerArray:
    """
    Draw a rig.

    :param trajectories: (T, K, 3), metres: where the cameras were after each turn, last row now.
    :param ranges: (K,) effective ranges, metres.
    """
    markers = []
    for camera in range(trajectories.shape[1]):
        way = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in trajectories[:, camera]]
        markers.append(_ball(header, 'cameras', camera, way[-1], 0.2, CAMERA_COLOUR))
        markers.append(_ball(header, 'ranges', camera, way[-1], 2.0 * float(ranges[camera]),
                             RANGE_COLOUR))
        # RViz complains of a line of one point.
        line = Marker(header=header, ns='trajectories', id=camera, type=Marker.LINE_STRIP,
                      action=Marker.ADD if len(way) > 1 else Marker.DELETE,
                      scale=Vector3(x=0.03), color=TRAJECTORY_COLOUR, points=way)
        line.pose.orientation.w = 1.0
        markers.append(line)
    return MarkerArray(markers=markers)


def move_markers(positions: np.ndarray, targets: np.ndarray, moving: np.ndarray, header: Header
                 ) -> MarkerArray:
    """
    Draw where cameras shall be moved.

    :param positions: (K, 3) metres, where they are.
    :param targets: (K, 3) metres, where they shall go.
    :param moving: (K,) bool; the others have no arrow.
    """
    markers = []
    for camera, moves in enumerate(moving):
        way = [Point(x=float(x), y=float(y), z=float(z))
               for x, y, z in (positions[camera], targets[camera])]
        # Diameters of the shaft and of the head, length of the head.
        arrow = Marker(header=header, ns='moves', id=camera, type=Marker.ARROW,
                       action=Marker.ADD if moves else Marker.DELETE,
                       scale=Vector3(x=0.04, y=0.1, z=0.1), color=MOVE_COLOUR, points=way)
        arrow.pose.orientation.w = 1.0
        markers.append(arrow)
    return MarkerArray(markers=markers)


def _ball(header: Header, namespace: str, number: int, centre: Point, diameter: float,
          colour: ColorRGBA) -> Marker:
    """Draw a ball."""
    ball = Marker(header=header, ns=namespace, id=number, type=Marker.SPHERE, action=Marker.ADD,
                  scale=Vector3(x=diameter, y=diameter, z=diameter), color=colour)
    ball.pose.position = centre
    ball.pose.orientation.w = 1.0
    return ball
