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
from ocp_ros.geometry.cameras import heading_of, Pose
from ocp_ros.rig.motion import wrapped
from ocp_ros.studio.scene_nodes import wxyz_of
from ocp_ros.studio.texts import camera_rgb, message, RULES, STYLE
import viser

#: Number of points of the cloud that a phone shows, cells of the plan along its longer edge, and
#: width of the plan, pixels.
SHOWN, CELLS, WIDTH = 20_000, 90, 320
#: Metres and degrees below which a camera is where it shall be; they are not written.
NEAR, STRAIGHT = 0.05, 3.0
#: Percentile of the heights that counts as the floor.
FLOOR = 1.0
#: Size of a point and of a camera, metres.
POINT, CAMERA = 0.03, 0.12
#: Buttons and what they mean.
ARRIVED, HOLD, GO_ON, RESET, ACCEPT = BUTTONS = (
    'Arrived: as near as I can', 'Hold', 'Go on', 'Reset', 'Accept this placement')


class GuidePage:
    """
    Show the observed cloud, the cameras and their targets, on a phone too.

    Each setter may be called from any thread. The page changes when :meth:`show` is called.

    :param server: of the page.
    :param pressed: is called with one of :data:`BUTTONS` when a person presses it.
    """

    def __init__(self, server: viser.ViserServer, pressed: Callable[[str], None]) -> None:
        self.server, self._lock = server, Lock()
        self.points = np.empty((0, 3), dtype=np.float32)
        self.poses: Sequence[Pose] = ()
        self.targets: Sequence[Pose] = ()
        self.expected = self.status = ''
        self._cloud_news = False
        self._nodes: dict[str, viser.SceneNodeHandle] = {}
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width='large')
        gui.add_html(RULES)
        self.text = gui.add_html('')
        for label in BUTTONS:
            gui.add_button(label).on_click(lambda _, label=label: pressed(label))
        self.answer = gui.add_html('')
        self.plan = gui.add_html('')
        server.initial_camera.position, server.initial_camera.look_at = (-4, -6, 8), (0, 0, 1)

    def set_cloud(self, points: np.ndarray) -> None:
        """Take the points observed so far: (N, 3) metres."""
        with self._lock:
            self.points, self._cloud_news = points[::max(len(points) // SHOWN, 1)], True

    def say(self, text: str) -> None:
        """Show the answer to a button."""
        self.answer.content = message(text)

    def show(self) -> None:
        """Show what has been set."""
        with self._lock:
            points, news, self._cloud_news = self.points, self._cloud_news, False
        if news and len(points):
            self._show_cloud(points)
        floor = float(np.percentile(points[:, 2], FLOOR)) if len(points) else 0.0
        lines = [sentence(number, pose, target, floor)
                 for number, (pose, target) in enumerate(zip(self.poses, self.targets))]
        head = lines or ['waiting for the poses of the cameras and the first target']
        parts = [f'<p><b>{escape(line)}</b></p>' for line in head]
        parts += [f'<p>{escape(line)}</p>' for line in (self.expected, self.status) if line]
        self._set(self.text, f'<div style="{STYLE}">{"".join(parts)}</div>')
        self._set(self.plan, plan_of(points, self.poses, self.targets))
        for number, pose in enumerate(self.poses):
            self._place(f'/cameras/{number}', number, pose, 1.0)
        for number, target in enumerate(self.targets):
            self._place(f'/targets/{number}', number, target, 0.4)

    @staticmethod
    def _set(handle: viser.GuiHtmlHandle, content: str) -> None:
        """Send content only if it has changed."""
        if handle.content != content:
            handle.content = content

    def _show_cloud(self, points: np.ndarray) -> None:
        """Show the observed points, coloured by their height."""
        low, high = np.percentile(points[:, 2], [FLOOR, 100.0 - FLOOR])
        share = np.clip((points[:, 2] - low) / max(high - low, 1e-3), 0.0, 1.0)[:, None]
        colours = (np.array([23, 79, 143]) * (1.0 - share) + np.array([230, 220, 170]) * share)
        self.server.scene.add_point_cloud('/cloud', points, colours.astype(np.uint8),
                                          point_size=POINT, precision='float32')
        middle = points.mean(axis=0)
        self.server.initial_camera.look_at = middle
        self.server.initial_camera.position = middle + np.array([-4.0, -6.0, 8.0])

    def _place(self, name: str, number: int, pose: Pose, opacity: float) -> None:
        """Show a camera or a target at its pose."""
        node = self._nodes.get(name)
        if node is None:
            node = self._nodes[name] = self.server.scene.add_frame(
                name, axes_length=2.0 * CAMERA, axes_radius=0.1 * CAMERA)
            self.server.scene.add_icosphere(f'{name}/ball', CAMERA, camera_rgb(number),
                                            opacity=opacity)
            self.server.scene.add_label(
                f'{name}/label', f'{"to " if opacity < 1.0 else ""}{number}')
        node.position, node.wxyz = pose.position, wxyz_of(pose.rotation)


def sentence(number: int, pose: Pose, target: Pose, floor: float) -> str:
    """
    Return in words where a camera shall go, and how far off it still is.

    Right and left, up and down are those of the plan; the camera turns as a person sees it who
    looks in its direction.

    :param number: of the camera, from 0.
    :param pose: where it is.
    :param target: where it shall be.
    :param floor: height of the floor, metres.
    """
    way = target.position - pose.position
    parts = [f'{abs(length):.2f} m {words[int(length < 0.0)]}' for length, words in zip(
        way, (('to the right', 'to the left'), ('up in the plan', 'down in the plan')))
        if abs(length) >= NEAR]
    if abs(way[2]) >= NEAR:
        parts.append(f'{abs(way[2]):.2f} m {"higher" if way[2] > 0 else "lower"}, to '
                     f'{target.position[2] - floor:.2f} m above the floor')
    angles = np.rad2deg(wrapped(heading_of(target.rotation) - heading_of(pose.rotation)))
    turns = [f'{abs(angle):.0f} degrees {words[int(angle < 0.0)]}' for angle, words in zip(
        angles[:2], (('to the left', 'to the right'), ('down', 'up'))) if abs(angle) >= STRAIGHT]
    if turns:
        parts.append(f'turn {" and ".join(turns)}')
    if not parts:
        return f'camera {number}: is where it shall be'
    return f'camera {number}: {"; ".join(parts)} ({np.linalg.norm(way):.2f} m off)'


def plan_of(points: np.ndarray, poses: Sequence[Pose], targets: Sequence[Pose]) -> str:
    """
    Return a plan as SVG: the points from above, the cameras and the ways to their targets.

    :param points: (N, 3) metres.
    """
    flat = np.array([*points[:, :2], *(pose.position[:2] for pose in (*poses, *targets))])
    if len(flat) == 0:
        return ''
    low, high = flat.min(axis=0) - 0.3, flat.max(axis=0) + 0.3
    edge = float((high - low).max()) / CELLS
    cells = np.unique(np.floor((points[:, :2] - low) / edge).astype(int), axis=0)
    across, up = (high - low).tolist()
    marks = ''.join(f'M{x * edge:.2f} {up - y * edge:.2f}h{edge:.2f}' for x, y in cells.tolist())
    shapes = [f'<path d="{marks}" stroke="#a3aeb6" stroke-width="{edge:.3f}"/>']
    for number, pose in enumerate(poses):
        colour = '#{:02x}{:02x}{:02x}'.format(*camera_rgb(number))
        x, y = (pose.position[:2] - low).tolist()
        end_x, end_y = (pose.position[:2] - low + 4 * edge * pose.rotation[:2, 0]).tolist()
        shapes.append(f'<line x1="{x:.2f}" y1="{up - y:.2f}" x2="{end_x:.2f}" '
                      f'y2="{up - end_y:.2f}" stroke="{colour}" stroke-width="{edge:.3f}"/>')
        if number < len(targets):
            to_x, to_y = (targets[number].position[:2] - low).tolist()
            shapes.append(
                f'<line x1="{x:.2f}" y1="{up - y:.2f}" x2="{to_x:.2f}" y2="{up - to_y:.2f}" '
                f'stroke="black" stroke-width="{0.5 * edge:.3f}" stroke-dasharray="{edge:.2f}"/>'
                f'<circle cx="{to_x:.2f}" cy="{up - to_y:.2f}" r="{2 * edge:.2f}" fill="none" '
                f'stroke="{colour}" stroke-width="{0.7 * edge:.3f}"/>')
        shapes.append(f'<circle cx="{x:.2f}" cy="{up - y:.2f}" r="{1.6 * edge:.2f}" '
                      f'fill="{colour}"/><text x="{x + 2 * edge:.2f}" y="{up - y - edge:.2f}" '
                      f'font-size="{6 * edge:.2f}">{number}</text>')
    return (f'<svg viewBox="0 0 {across:.2f} {up:.2f}" width="100%" '
            f'style="max-width:{WIDTH}px;background:white">{"".join(shapes)}</svg>')
