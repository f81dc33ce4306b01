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

"""The page of the guide: where a person shall carry each camera next."""

from collections.abc import Callable, Sequence
from html import escape
from threading import Lock

import numpy as np
from ocp_ros.geometry.cameras import Pose
from ocp_ros.studio.scene_nodes import wxyz_of
from ocp_ros.studio.server import in_order
from ocp_ros.studio.texts import camera_rgb, message, STYLE_RULES, styled
import viser

#: Percentile of the heights of a cloud that counts as the height of the floor.
FLOOR_PERCENTILE = 1.0
#: Labels of the buttons.
ARRIVED, HOLD, GO_ON, RESET, ACCEPT = BUTTONS = (
    'Arrived: as near as I can', 'Hold', 'Go on', 'Reset', 'Accept this placement')


class GuidePage:
    """
    Show the observed cloud, the cameras and their targets, on a phone too.

    The attributes may be set, and :meth:`set_cloud` called, from any thread. The page changes when
    :meth:`show` is called.

    :param server: of the page.
    :param on_press: is called with the label of a button, one of :data:`BUTTONS`, when a person
        presses the button.
    :ivar points: (N, 3) float32, some points of the observed cloud, metres, map frame.
    :ivar poses: measured poses of the cameras.
    :ivar targets: pose to which each camera shall go.
    :ivar instructions: lines that say where the cameras shall go; may be empty.
    :ivar status: sentence on the progress towards a final placement; may be empty.
    """

    def __init__(self, server: viser.ViserServer, on_press: Callable[[str], None]) -> None:
        self.server, self._lock = server, Lock()
        self.points = np.empty((0, 3), dtype=np.float32)
        self.poses: Sequence[Pose] = ()
        self.targets: Sequence[Pose] = ()
        self.instructions = self.status = ''
        self._cloud_changed = False
        self._nodes: dict[str, viser.SceneNodeHandle] = {}
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width='large')
        gui.add_html(STYLE_RULES)
        self.text = gui.add_html('')
        for label in BUTTONS:
            gui.add_button(label).on_click(in_order(lambda event: on_press(event.target.label)))
        self.answer = gui.add_html('')
        self.plan = gui.add_html('')
        # The view until there is a cloud; then :meth:`_show_cloud` sets another one.
        server.initial_camera.position = (-4, -6, 8)
        server.initial_camera.look_at = (0, 0, 1)

    def set_cloud(self, points: np.ndarray) -> None:
        """Set the points observed so far: (N, 3) metres, map frame."""
        with self._lock:
            # Of a larger cloud, this keeps 20,000 to 40,000 points, which a phone draws without
            # delay.
            self.points = points[::max(len(points) // 20_000, 1)]
            self._cloud_changed = True

    def show_message(self, text: str) -> None:
        """Show a message, such as the answer to a button."""
        self.answer.content = message(text)

    def show(self) -> None:
        """Show the values that have been set since the last call."""
        with self._lock:
            points, cloud_changed = self.points, self._cloud_changed
            self._cloud_changed = False
        if cloud_changed and len(points):
            self._show_cloud(points)
        lines = self.instructions or 'waiting for the poses of the cameras and the first target'
        paragraphs = [f'<p><b>{escape(line)}</b></p>' for line in lines.splitlines()]
        self.text.content = styled(''.join([*paragraphs, f'<p>{escape(self.status)}</p>']))
        self.plan.content = plan_svg(points, self.poses, self.targets)
        for number, pose in enumerate(self.poses):
            self._show_pose(f'/cameras/{number}', f'{number}', number, pose, opacity=1.0)
        for number, target in enumerate(self.targets):
            self._show_pose(f'/targets/{number}', f'to {number}', number, target, opacity=0.4)

    def _show_cloud(self, points: np.ndarray) -> None:
        """Show the observed points, coloured by their height."""
        low, high = np.percentile(points[:, 2], [FLOOR_PERCENTILE, 100.0 - FLOOR_PERCENTILE])
        share = np.clip((points[:, 2] - low) / max(high - low, 1e-3), 0.0, 1.0)[:, None]
        # From dark blue for low points to light yellow for high ones.
        colours = (np.array([23, 79, 143]) * (1.0 - share) + np.array([230, 220, 170]) * share)
        self.server.scene.add_point_cloud('/cloud', points, colours.astype(np.uint8),
                                          point_size=0.03, precision='float32')
        centre = points.mean(axis=0)
        self.server.initial_camera.look_at = centre
        self.server.initial_camera.position = centre + np.array([-4.0, -6.0, 8.0])

    def _show_pose(self, name: str, label: str, number: int, pose: Pose, opacity: float) -> None:
        """Show the pose of a camera or its target as a ball with axes, or move the ball there."""
        radius = 0.12
        node = self._nodes.get(name)
        if node is None:
            node = self._nodes[name] = self.server.scene.add_frame(
                name, axes_length=2.0 * radius, axes_radius=0.1 * radius)
            self.server.scene.add_icosphere(f'{name}/ball', radius, camera_rgb(number),
                                            opacity=opacity)
            self.server.scene.add_label(f'{name}/label', label)
        node.position = pose.position
        node.wxyz = wxyz_of(pose.rotation)


def plan_svg(points: np.ndarray, poses: Sequence[Pose], targets: Sequence[Pose]) -> str:
    """
    Return a plan as SVG: the points from above, the cameras, and lines to their targets.

    :param points: (N, 3) metres.
    :param poses: of the cameras.
    :param targets: pose to which each camera shall go; may be empty.
    :returns: an empty string if there is nothing to draw.
    """
    positions = np.array([*points[:, :2], *(pose.position[:2] for pose in (*poses, *targets))])
    if len(positions) == 0:
        return ''
    # The plan has a margin of 0.3 m, and its longer side has 90 cells.
    low, high = positions.min(axis=0) - 0.3, positions.max(axis=0) + 0.3
    edge = float((high - low).max()) / 90
    cells = np.unique(np.floor((points[:, :2] - low) / edge).astype(int), axis=0)
    width, height = (high - low).tolist()

    def svg_point(offset: np.ndarray) -> tuple[float, float]:
        # The y axis of an SVG points down.
        x, y = offset.tolist()
        return x, height - y

    # A cell is drawn as a line through its middle along x that is as wide as it is long.
    cell_path = ''.join(f'M{x * edge:.2f} {height - (y + 0.5) * edge:.2f}h{edge:.2f}'
                        for x, y in cells.tolist())
    shapes = [f'<path d="{cell_path}" stroke="#a3aeb6" stroke-width="{edge:.3f}"/>']
    for number, pose in enumerate(poses):
        # A line in the viewing direction, which is the first column of the rotation.
        colour = '#{:02x}{:02x}{:02x}'.format(*camera_rgb(number))
        x, y = svg_point(pose.position[:2] - low)
        end_x, end_y = svg_point(pose.position[:2] - low + 4 * edge * pose.rotation[:2, 0])
        shapes.append(f'<line x1="{x:.2f}" y1="{y:.2f}" x2="{end_x:.2f}" y2="{end_y:.2f}" '
                      f'stroke="{colour}" stroke-width="{edge:.3f}"/>')
        # A dashed line to the target, and a circle around it.
        if number < len(targets):
            target_x, target_y = svg_point(targets[number].position[:2] - low)
            shapes.append(
                f'<line x1="{x:.2f}" y1="{y:.2f}" x2="{target_x:.2f}" y2="{target_y:.2f}" '
                f'stroke="black" stroke-width="{0.5 * edge:.3f}" stroke-dasharray="{edge:.2f}"/>'
                f'<circle cx="{target_x:.2f}" cy="{target_y:.2f}" r="{2 * edge:.2f}" fill="none" '
                f'stroke="{colour}" stroke-width="{0.7 * edge:.3f}"/>')
        shapes.append(f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{1.6 * edge:.2f}" fill="{colour}"/>'
                      f'<text x="{x + 2 * edge:.2f}" y="{y - edge:.2f}" '
                      f'font-size="{6 * edge:.2f}">{number}</text>')
    return (f'<svg viewBox="0 0 {width:.2f} {height:.2f}" width="100%" '
            f'style="max-width:320px;background:white">{"".join(shapes)}</svg>')
