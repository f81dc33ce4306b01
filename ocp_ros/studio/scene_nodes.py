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
from scipy.spatial.transform import Rotation
import viser

#: Length of a drawn frustum and of its handles, and radius of a camera without an image plane,
#: metres.
FRUSTUM, HANDLE, BALL = 0.35, 0.6, 0.09
#: Width of lines, metres, and size of a point in multiples of the median spacing.
LINE, POINT = 0.012, 0.9
#: Colour of the mesh: lighter than all colours of points.
SURFACE = (236, 236, 230)
#: Direction of the light that shades the points, and the darkest shade of 255.
LIGHT, DARKEST = np.array([0.36, 0.48, 0.8]), 150
#: Handles of cameras and zones: is called with the position (3,), metres, the rotation (3, 3), the
#: phase ``start``, ``update`` or ``end``, and the number of the client.
Dragged = Callable[[np.ndarray, np.ndarray, str, int], None]


def wxyz_of(rotation: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) as a quaternion w, x, y, z."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def rotation_of(wxyz: np.ndarray) -> np.ndarray:
    """Return a quaternion w, x, y, z as a rotation (3, 3); NaN if it is none."""
    length = np.linalg.norm(wxyz)
    if not 1e-6 < length < 1e6:
        return np.full((3, 3), np.nan)
    return Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()


OPTICAL = wxyz_of(OPTICAL_TO_BODY)


class Cloud:
    """
    The points of the room, cut off at a height.

    :param scene: of the page.
    :param name: of the node.
    :param points: (N, 3) float32, metres.
    :param normals: (N, 3) unit vectors, which shade the points.
    :param spacing: median distance of neighbouring points, metres.
    :param shift: (3,) metres, by which the cloud is shown elsewhere.
    """

    def __init__(self, scene: viser.SceneApi, name: str, points: np.ndarray, normals: np.ndarray,
                 spacing: float, shift: np.ndarray | None = None) -> None:
        self._scene, self._name, self._points = scene, name, points
        self._size = POINT * spacing
        # The normals have no sign.
        self._shade = (DARKEST + (255 - DARKEST) * np.abs(normals @ LIGHT)).astype(np.uint16)
        self._shift = np.zeros(3) if shift is None else shift
        self._colours, self._visible = np.full(points.shape, 200, dtype=np.uint8), True
        self.cut(np.inf)

    def show(self, visible: bool) -> None:
        """Show the points, or hide them."""
        self._visible = self._node.visible = visible

    def cut(self, height: float) -> None:
        """Show only the points up to a height, metres."""
        self._shown = np.flatnonzero(self._points[:, 2] <= height)
        self._node = self._scene.add_point_cloud(
            self._name, self._points[self._shown], self._colours[self._shown],
            point_size=self._size, point_shape='circle', precision='float32',
            point_shading='flat', position=self._shift, visible=self._visible)

    def paint(self, colours: np.ndarray) -> None:
        """Colour the points: (N, 3) uint8; positions are not sent again."""
        # In whole numbers, since people wait for it.
        self._colours = (colours * self._shade[:, None] >> 8).astype(np.uint8)
        self._node.colors = self._colours[self._shown]

    def remove(self) -> None:
        """Remove the cloud from the page."""
        self._node.remove()


class Surfaces:
    """
    The mesh of the room, cut off at a height; hidden at first.

    :param scene: of the page.
    :param mesh: of the room.
    """

    def __init__(self, scene: viser.SceneApi, mesh: Mesh) -> None:
        self._scene, self._mesh, self._height = scene, mesh, np.inf
        self._node: viser.MeshHandle | None = None

    def show(self, visible: bool) -> None:
        """Show the mesh, or remove it from the page."""
        if self._node is not None:
            self._node.remove()
        self._node = self._scene.add_mesh_simple(
            '/surfaces', *below(self._mesh, self._height), color=SURFACE, flat_shading=True,
            side='double', cast_shadow=False, receive_shadow=False) if visible else None

    def cut(self, height: float) -> None:
        """Show only the parts up to a height, metres."""
        self._height = height
        self.show(self._node is not None)


def below(mesh: Mesh, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (V, 3) and triangles (T, 3) of the parts of a mesh up to a height."""
    corners = mesh.corners
    under = corners[:, :, 2] <= height
    count, parts = under.sum(axis=1), []
    for number, alone in ((1, under), (2, ~under)):
        some = count == number
        # The corner that is alone on its side comes first; the order around the triangle stays.
        order = (np.argmax(alone[some], axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[some], order[..., None], axis=1).swapaxes(0, 1)
        ab, ac = (a + (height - a[:, 2:]) / (end - a)[:, 2:] * (end - a) for end in (b, c))
        parts += [(a, ab, ac)] if number == 1 else [(ab, b, c), (ab, c, ac)]
    cut = np.concatenate([np.stack(part, axis=1) for part in parts]).reshape(-1, 3)
    new = len(mesh.vertices) + np.arange(len(cut)).reshape(-1, 3)
    return (np.concatenate([mesh.vertices, cut]),
            np.concatenate([mesh.triangles[count == 3], new]))


class CameraNode:
    """
    A camera with handles to drag it, or without if it is locked.

    :param scene: of the page.
    :param name: of the node.
    :param title: label.
    :param model: its camera model.
    :param pose: (6,) metres, map frame, and radians.
    :param colour: of its lines.
    :param dragged: is called when a person drags it; None for a camera without handles.
    :param clicked: is called when a person clicks on it.
    """

    def __init__(self, scene: viser.SceneApi, name: str, title: str, model: CameraModel,
                 pose: np.ndarray, colour: tuple[int, int, int], dragged: Dragged | None = None,
                 clicked: Callable[[], None] | None = None) -> None:
        if dragged is None:
            self.node = scene.add_frame(name, show_axes=False)
        else:
            self.node = with_handles(scene, name, dragged)
        lens = model.lens
        if lens.kind == PINHOLE:
            self.body = scene.add_camera_frustum(
                f'{name}/body', 2.0 * float(np.arctan(lens.half_vertical)),
                lens.half_horizontal / lens.half_vertical, scale=FRUSTUM, thickness=LINE,
                color=colour, wxyz=OPTICAL)
        else:
            self.body = scene.add_icosphere(f'{name}/body', BALL, colour)
        self.label = scene.add_label(f'{name}/label', title, position=(0.0, 0.0, 0.12),
                                     anchor='bottom-center')
        if clicked is not None:
            self.body.on_click(lambda _: clicked())
        self.place(pose)

    def place(self, pose: np.ndarray) -> None:
        """Move it to a pose (6,), metres and radians."""
        self.node.position, self.node.wxyz = pose[:3], wxyz_of(rotation_matrix(*pose[3:]))

    def colour(self, colour: tuple[int, int, int]) -> None:
        """Change the colour of its lines."""
        self.body.color = colour

    def remove(self) -> None:
        """Remove it from the page."""
        self.node.remove()


class ZoneNode:
    """
    The edges of a zone, with handles to drag a box.

    :param scene: of the page.
    :param name: of the node.
    :param zone: the zone.
    :param bounds: (2, 3) metres, lowest and highest corner that are shown.
    :param floor: height of the floor, metres.
    :param colour: of its lines.
    :param dragged: is called when a person drags it; None for a zone without handles.
    """

    def __init__(self, scene: viser.SceneApi, name: str, zone: Zone, bounds: np.ndarray,
                 floor: float, colour: tuple[int, int, int], dragged: Dragged | None) -> None:
        low, high = zone.corners(floor)
        low, high = np.maximum(low, bounds[0] - 1.0), np.minimum(high, bounds[1] + 1.0)
        middle = 0.5 * (low + high)
        if dragged is None:
            self.node = scene.add_frame(name, show_axes=False, position=middle)
        else:
            self.node = with_handles(scene, name, dragged, disable_rotations=True)
            self.node.position = middle
        corners = zone.polygon if zone.polygon is not None else np.array(
            [low[:2], [high[0], low[1]], high[:2], [low[0], high[1]]])
        scene.add_line_segments(f'{name}/edges', edges_between(corners, low[2], high[2]) - middle,
                                colour, thickness=LINE)

    def remove(self) -> None:
        """Remove it from the page."""
        self.node.remove()


def edges_between(corners: np.ndarray, bottom: float, top: float) -> np.ndarray:
    """Return the edges of a prism over a polygon (P, 2): (3 P, 2, 3) metres."""
    rings = [np.column_stack([corners, np.full(len(corners), z)]) for z in (bottom, top)]
    sides = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings]
    return np.concatenate([*sides, np.stack(rings, axis=1)])


def with_handles(scene: viser.SceneApi, name: str, dragged: Dragged, **options: bool
                 ) -> viser.TransformControlsHandle:
    """Return a node with arrows and rings that a person can drag."""
    node = scene.add_transform_controls(name, HANDLE, line_width=2.0, depth_test=False, **options)

    @node.on_update
    async def _(event: viser.TransformControlsEvent) -> None:
        # Coroutines keep the order of the events.
        dragged(np.array(event.target.position), rotation_of(event.target.wxyz), event.phase,
                event.client_id)
    return node
