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
    Return the markers of a rig: position, trajectory and field of view of each camera.

    The field of view is a frustum for a pinhole camera, and a sphere of its range for others.

    :param trajectories: (T, K, 3), metres: positions of K cameras at T times, the present last.
    :param poses: K present poses.
    :param models: one camera model per camera, or a single model for all cameras.
    :param header: stamp of the markers, and frame of the positions and poses.
    """
    markers = []
    for camera, pose in enumerate(poses):
        model = models[camera if len(models) > 1 else 0]
        trajectory = _point_messages(trajectories[:, camera])
        markers.append(_sphere_marker(header, 'cameras', camera, trajectory[-1], diameter=0.2))
        if model.lens.kind == PINHOLE:
            markers.append(_line_marker(header, 'frusta', camera, Marker.LINE_LIST, width=0.015,
                                        points=_point_messages(frustum_edges(pose, model))))
        else:
            markers.append(_sphere_marker(header, 'ranges', camera, trajectory[-1],
                                          diameter=2.0 * model.max_range))
        markers.append(_line_marker(header, 'trajectories', camera, Marker.LINE_STRIP, width=0.03,
                                    points=trajectory))
    return MarkerArray(markers=markers)


def frustum_edges(pose: Pose, model: CameraModel) -> np.ndarray:
    """
    Return the edges of a viewing pyramid; its corners are at the maximum range of the camera.

    :param model: a pinhole camera.
    :returns: (16, 3) metres, in the frame of the pose: the two ends of each of eight edges, four
        from the camera and four of the base.
    """
    lens = model.lens
    # The lens of a pinhole camera has tangents of half its field of view: these corners, in their
    # order around the base, are 1 m ahead.
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=np.float64)
    corners = np.column_stack([np.ones(4), signs * [lens.half_horizontal, lens.half_vertical]])
    corners *= model.max_range / np.linalg.norm(corners, axis=1, keepdims=True)
    corners = corners @ pose.rotation.T + pose.position
    edges = [(pose.position, corner) for corner in corners]
    edges += list(zip(corners, np.roll(corners, -1, axis=0)))
    return np.array(edges).reshape(-1, 3)


def move_markers(positions: np.ndarray, targets: np.ndarray, moving: np.ndarray, header: Header
                 ) -> MarkerArray:
    """
    Return an arrow for each camera that is to be moved, and delete the arrows of the others.

    :param positions: (K, 3) metres, present positions.
    :param targets: (K, 3) metres, target positions.
    :param moving: (K,) bool, whether each camera is to be moved.
    :param header: stamp of the markers, and frame of the positions.
    """
    markers = []
    for camera, moves in enumerate(moving):
        # The scale has the diameters of shaft and head, and the length of the head.
        arrow = Marker(header=header, ns='moves', id=camera, type=Marker.ARROW,
                       action=Marker.ADD if moves else Marker.DELETE,
                       scale=Vector3(x=0.04, y=0.1, z=0.1), color=COLOURS['moves'],
                       points=_point_messages(np.array([positions[camera], targets[camera]])))
        arrow.pose.orientation.w = 1.0
        markers.append(arrow)
    return MarkerArray(markers=markers)


def _point_messages(positions: np.ndarray) -> list[Point]:
    """Return positions, (N, 3) metres, as messages."""
    return [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in positions]


def _line_marker(header: Header, namespace: str, marker_id: int, line_type: int, width: float,
                 points: list[Point]) -> Marker:
    """Return a marker of lines; with less than two points, one that deletes the old lines."""
    # RViz would warn about a line of one point.
    marker = Marker(header=header, ns=namespace, id=marker_id, type=line_type,
                    action=Marker.ADD if len(points) > 1 else Marker.DELETE,
                    scale=Vector3(x=width), color=COLOURS[namespace], points=points)
    marker.pose.orientation.w = 1.0
    return marker


def _sphere_marker(header: Header, namespace: str, marker_id: int, centre: Point, diameter: float
                   ) -> Marker:
    """Return a marker of a sphere; the diameter is in metres."""
    sphere = Marker(header=header, ns=namespace, id=marker_id, type=Marker.SPHERE,
                    action=Marker.ADD, color=COLOURS[namespace],
                    scale=Vector3(x=diameter, y=diameter, z=diameter))
    sphere.pose.position = centre
    sphere.pose.orientation.w = 1.0
    return sphere
