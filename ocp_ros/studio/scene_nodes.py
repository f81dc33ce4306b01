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

"""The room, the cameras and the zones on the page, as viser's scene nodes."""

from collections.abc import Callable

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, OPTICAL_TO_BODY, PINHOLE, rotation_matrix
from ocp_ros.rig.zones import Zone
from ocp_ros.scenes.scene import Mesh
from ocp_ros.studio.server import in_order
from scipy.spatial.transform import Rotation
import viser

#: Width of lines, metres.
LINE_WIDTH_M = 0.012
#: Is called when a person drags the handles of a camera or a zone: with the position (3,), metres,
#: the rotation (3, 3), the phase ``start``, ``update`` or ``end``, and the number of the client.
DragCallback = Callable[[np.ndarray, np.ndarray, str, int], None]


def wxyz_of(rotation: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) as a quaternion w, x, y, z."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def rotation_of(wxyz: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of a quaternion w, x, y, z; NaN if its length cannot be used."""
    if not 1e-6 < np.linalg.norm(wxyz) < 1e6:
        return np.full((3, 3), np.nan)
    return Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()


class Cloud:
    """
    The points of the room up to a height.

    :param scene: of the page.
    :param name: of the node.
    :param points: (N, 3) float32, metres, map frame.
    :param normals: (N, 3) unit vectors, which shade the points.
    :param spacing: median distance of neighbouring points, metres.
    :param offset: (3,) of the shown points from their positions, metres; None for no offset.
    """

    def __init__(self, scene: viser.SceneApi, name: str, points: np.ndarray, normals: np.ndarray,
                 spacing: float, offset: np.ndarray | None = None) -> None:
        self._scene, self._name, self._points = scene, name, points
        self._point_size = 0.9 * spacing
        # From 150, dark, to 255; a normal may point to either side of its surface.
        to_light = np.array([0.36, 0.48, 0.8])
        self._shades = (150 + 105 * np.abs(normals @ to_light)).astype(np.uint16)
        self._offset = np.zeros(3) if offset is None else offset
        # All points are light grey until :meth:`set_colours` is called.
        self._colours = np.full(points.shape, 200, dtype=np.uint8)
        self._visible = True
        self.cut(np.inf)

    def show(self, visible: bool) -> None:
        """Show the points, or hide them."""
        self._visible = self._node.visible = visible

    def cut(self, height: float) -> None:
        """Show only the points up to a height, metres."""
        self._shown_indices = np.flatnonzero(self._points[:, 2] <= height)
        # viser replaces the node that has the same name.
        self._node = self._scene.add_point_cloud(
            self._name, self._points[self._shown_indices], self._colours[self._shown_indices],
            point_size=self._point_size, point_shape='circle', precision='float32',
            point_shading='flat', position=self._offset, visible=self._visible)

    def set_colours(self, colours: np.ndarray) -> None:
        """Set the colours of all points, (N, 3) uint8; their positions are not sent again."""
        # Integers are faster here, and people wait for the colours; 256 would be full brightness.
        self._colours = (colours * self._shades[:, None] >> 8).astype(np.uint8)
        self._node.colors = self._colours[self._shown_indices]

    def remove(self) -> None:
        """Remove the cloud from the page."""
        self._node.remove()


class Surfaces:
    """
    The mesh of the room up to a height; hidden at first.

    :param scene: of the page.
    :param mesh: of the room.
    """

    def __init__(self, scene: viser.SceneApi, mesh: Mesh) -> None:
        self._scene, self._mesh = scene, mesh
        self._height = np.inf
        self._node: viser.MeshHandle | None = None

    def show(self, visible: bool) -> None:
        """Show the mesh, or remove it from the page."""
        if self._node is not None:
            self._node.remove()
        self._node = self._scene.add_mesh_simple(
            '/surfaces', *mesh_below(self._mesh, self._height), color=(236, 236, 230),
            flat_shading=True, side='double', cast_shadow=False, receive_shadow=False,
        ) if visible else None

    def cut(self, height: float) -> None:
        """Show only the parts up to a height, metres."""
        self._height = height
        self.show(self._node is not None)


def mesh_below(mesh: Mesh, height: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the parts of a mesh up to a height; triangles at this height are cut.

    :param height: metres, map frame.
    :returns: V vertices (V, 3), metres, and the indices of the vertices of T triangles (T, 3).
    """
    corners = mesh.corners
    is_below = corners[:, :, 2] <= height
    count_below = is_below.sum(axis=1)
    # The part below is a triangle if one corner is below, and two triangles if two corners are.
    triangles = []
    for count, is_single in ((1, is_below), (2, ~is_below)):
        chosen = count_below == count
        # Corner a is the single one on its side of the cut; the order around the triangle stays.
        order = (np.argmax(is_single[chosen], axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[chosen], order[..., None], axis=1).swapaxes(0, 1)
        # The points at which the edges from a to b and from a to c are cut.
        ab, ac = (a + (height - a[:, 2:]) / (end - a)[:, 2:] * (end - a) for end in (b, c))
        triangles += [(a, ab, ac)] if count == 1 else [(ab, b, c), (ab, c, ac)]
    new_vertices = np.concatenate([np.stack(each, axis=1) for each in triangles]).reshape(-1, 3)
    new_triangles = len(mesh.vertices) + np.arange(len(new_vertices)).reshape(-1, 3)
    return (np.concatenate([mesh.vertices, new_vertices]),
            np.concatenate([mesh.triangles[count_below == 3], new_triangles]))


class CameraNode:
    """
    A camera: the frustum of a pinhole camera, or a ball for any other camera.

    :param scene: of the page.
    :param name: of the node.
    :param title: label beside the camera.
    :param model: of the camera.
    :param pose: (6,) metres, map frame, and radians.
    :param colour: red, green and blue of its lines, from 0 to 255.
    :param on_drag: is called when a person drags the camera; None for a camera without handles.
    :param on_click: is called when a person clicks on the camera; None for no reaction.
    """

    def __init__(self, scene: viser.SceneApi, name: str, title: str, model: CameraModel,
                 pose: np.ndarray, colour: tuple[int, int, int],
                 on_drag: DragCallback | None = None,
                 on_click: Callable[[], None] | None = None) -> None:
        self.node = add_node(scene, name, on_drag)
        lens = model.lens
        if lens.kind == PINHOLE:
            # viser needs the vertical angle and the aspect; the lens has tangents of half angles.
            self.body = scene.add_camera_frustum(
                f'{name}/body', 2.0 * float(np.arctan(lens.half_vertical)),
                lens.half_horizontal / lens.half_vertical, scale=0.35, thickness=LINE_WIDTH_M,
                color=colour, wxyz=wxyz_of(OPTICAL_TO_BODY))
        else:
            self.body = scene.add_icosphere(f'{name}/body', radius=0.09, color=colour)
        scene.add_label(f'{name}/label', title, position=(0.0, 0.0, 0.12), anchor='bottom-center')
        if on_click is not None:
            self.body.on_click(in_order(lambda _: on_click()))
        self.set_pose(pose)

    def set_pose(self, pose: np.ndarray) -> None:
        """Move the camera to a pose (6,), metres and radians."""
        self.node.position = pose[:3]
        self.node.wxyz = wxyz_of(rotation_matrix(*pose[3:]))

    def set_colour(self, colour: tuple[int, int, int]) -> None:
        """Set the red, green and blue of the camera's lines, from 0 to 255."""
        self.body.color = colour

    def remove(self) -> None:
        """Remove the camera from the page."""
        self.node.remove()


class ZoneNode:
    """
    The edges of a zone.

    :param scene: of the page.
    :param name: of the node.
    :param zone: the zone.
    :param bounds: (2, 3) metres, lowest and highest corner of the room. Boxes, and the
        heights of polygons, are shown up to 1 m outside the room.
    :param floor: height of the floor, metres.
    :param colour: red, green and blue of its lines, from 0 to 255.
    :param on_drag: is called when a person drags the zone; None for a zone without handles.
    """

    def __init__(self, scene: viser.SceneApi, name: str, zone: Zone, bounds: np.ndarray,
                 floor: float, colour: tuple[int, int, int], on_drag: DragCallback | None) -> None:
        low, high = zone.corners(floor)
        low, high = np.maximum(low, bounds[0] - 1.0), np.minimum(high, bounds[1] + 1.0)
        centre = 0.5 * (low + high)
        self.node = add_node(scene, name, on_drag, disable_rotations=True)
        self.node.position = centre
        # The polygon of a box is its base.
        polygon = zone.polygon if zone.polygon is not None else np.array(
            [low[:2], [high[0], low[1]], high[:2], [low[0], high[1]]])
        scene.add_line_segments(f'{name}/edges', prism_edges(polygon, low[2], high[2]) - centre,
                                colour, thickness=LINE_WIDTH_M)

    def remove(self) -> None:
        """Remove the zone from the page."""
        self.node.remove()


def prism_edges(polygon: np.ndarray, bottom: float, top: float) -> np.ndarray:
    """
    Return the edges of an upright prism.

    :param polygon: (P, 2) x and y of the P corners of its base, metres.
    :param bottom: height of its base, metres.
    :param top: height of its top, metres.
    :returns: (3 P, 2, 3) metres, both ends of each edge.
    """
    rings = [np.column_stack([polygon, np.full(len(polygon), z)]) for z in (bottom, top)]
    ring_edges = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings]
    return np.concatenate([*ring_edges, np.stack(rings, axis=1)])


def add_node(scene: viser.SceneApi, name: str, on_drag: DragCallback | None,
             disable_rotations: bool = False) -> viser.SceneNodeHandle:
    """
    Add a node, and return it.

    :param scene: of the page.
    :param name: of the node.
    :param on_drag: is called when a person drags the arrows and rings of the node; None for a node
        without them.
    :param disable_rotations: whether to leave out the rings.
    """
    if on_drag is None:
        return scene.add_frame(name, show_axes=False)
    node = scene.add_transform_controls(name, scale=0.6, line_width=2.0, depth_test=False,
                                        disable_rotations=disable_rotations)
    node.on_update(in_order(lambda event: on_drag(
        np.array(event.target.position), rotation_of(event.target.wxyz), event.phase,
        event.client_id)))
    return node
