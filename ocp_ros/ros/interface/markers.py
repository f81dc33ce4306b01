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

"""Markers for RViz and Foxglove: cameras, their trajectories, and their fields of view."""

from collections.abc import Sequence

from geometry_msgs.msg import Point, Vector3
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, PINHOLE, Pose
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

#: Colours by the namespace of the markers.
COLOURS = {'cameras': ColorRGBA(r=0.84, g=0.15, b=0.16, a=1.0),
           'trajectories': ColorRGBA(r=1.0, g=1.0, b=1.0, a=0.9),
           'ranges': ColorRGBA(r=0.4, g=0.65, b=1.0, a=0.08),
           'frusta': ColorRGBA(r=0.4, g=0.65, b=1.0, a=0.8),
           'moves': ColorRGBA(r=1.0, g=0.75, b=0.1, a=1.0)}


def rig_markers(trajectories: np.ndarray, poses: Sequence[Pose], models: Sequence[CameraModel],
                header: Header) -> MarkerArray:
    """
    Draw a rig: the position, trajectory and frustum (or range sphere) of each camera.

    :param trajectories: (T, K, 3), metres: camera positions after each turn; the last row is now.
    :param poses: K present poses.
    :param models: one camera model per camera, or one for all.
    """
    markers = []
    for camera, pose in enumerate(poses):
        model = models[camera if len(models) > 1 else 0]
        way = _points(trajectories[:, camera])
        markers.append(_ball(header, 'cameras', camera, way[-1], 0.2, COLOURS['cameras']))
        if model.lens.kind == PINHOLE:
            markers.append(_lines(header, 'frusta', camera, Marker.LINE_LIST, 0.015,
                                  COLOURS['frusta'], _points(frustum_edges(pose, model))))
        else:
            markers.append(_ball(header, 'ranges', camera, way[-1], 2.0 * model.max_range,
                                 COLOURS['ranges']))
        markers.append(_lines(header, 'trajectories', camera, Marker.LINE_STRIP, 0.03,
                              COLOURS['trajectories'], way))
    return MarkerArray(markers=markers)


def frustum_edges(pose: Pose, model: CameraModel) -> np.ndarray:
    """
    Return the edges of a viewing pyramid whose corners are at the maximum range of the camera.

    :param model: a pinhole camera.
    :returns: (16, 3) metres: end points of eight edges, four from the camera and four of the base.
    """
    lens = model.lens
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=np.float64)
    corners = np.column_stack([np.ones(4), signs * [lens.half_horizontal, lens.half_vertical]])
    corners *= model.max_range / np.linalg.norm(corners, axis=1, keepdims=True)
    corners = corners @ pose.rotation.T + pose.position
    pairs = [(pose.position, corner) for corner in corners]
    pairs += list(zip(corners, np.roll(corners, -1, axis=0)))
    return np.array(pairs).reshape(-1, 3)


def move_markers(positions: np.ndarray, targets: np.ndarray, moving: np.ndarray, header: Header
                 ) -> MarkerArray:
    """
    Draw an arrow for each camera that is to be moved.

    :param positions: (K, 3) metres, present positions.
    :param targets: (K, 3) metres, target positions.
    :param moving: (K,) bool; cameras with False get no arrow.
    """
    markers = []
    for camera, moves in enumerate(moving):
        # The scale has the diameters of shaft and head, and the length of the head.
        arrow = Marker(header=header, ns='moves', id=camera, type=Marker.ARROW,
                       action=Marker.ADD if moves else Marker.DELETE,
                       scale=Vector3(x=0.04, y=0.1, z=0.1), color=COLOURS['moves'],
                       points=_points(np.array([positions[camera], targets[camera]])))
        arrow.pose.orientation.w = 1.0
        markers.append(arrow)
    return MarkerArray(markers=markers)


def _points(positions: np.ndarray) -> list[Point]:
    """Return positions (N, 3) as messages."""
    return [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in positions]


def _lines(header: Header, namespace: str, number: int, kind: int, width: float,
           colour: ColorRGBA, points: list[Point]) -> Marker:
    """Draw lines."""
    # RViz warns about a line of one point.
    lines = Marker(header=header, ns=namespace, id=number, type=kind,
                   action=Marker.ADD if len(points) > 1 else Marker.DELETE,
                   scale=Vector3(x=width), color=colour, points=points)
    lines.pose.orientation.w = 1.0
    return lines


def _ball(header: Header, namespace: str, number: int, centre: Point, diameter: float,
          colour: ColorRGBA) -> Marker:
    """Draw a ball."""
    ball = Marker(header=header, ns=namespace, id=number, type=Marker.SPHERE, action=Marker.ADD,
                  scale=Vector3(x=diameter, y=diameter, z=diameter), color=colour)
    ball.pose.position = centre
    ball.pose.orientation.w = 1.0
    return ball
