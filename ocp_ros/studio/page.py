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

"""The page: one thread applies what people do, evaluates the placement and shows the result."""

from collections.abc import Callable
from functools import partial
import logging
from threading import Thread
from typing import Any

import numpy as np
from ocp_ros.report.drawing.depth_image import depth_colours, depth_image
from ocp_ros.studio import texts
from ocp_ros.studio.folder import Folder
from ocp_ros.studio.model import Evaluation, Studio
from ocp_ros.studio.panel import Panel
from ocp_ros.studio.scene_nodes import CameraNode, ZoneNode
from ocp_ros.studio.session import Session
from ocp_ros.studio.zone_edits import entries_of, Entry, moved_box
from ocp_ros.util.settings import UserError
import viser

#: Offset of the view at first from the centre of the room, in diagonals of the room.
VIEW_OFFSET = np.array([-0.35, -0.5, 0.6])

_log = logging.getLogger(__name__)


class Page(Session):
    """
    The page of a session; see :class:`.Session` for the parameters.

    One thread of the page runs all actions of people.
    """

    def __init__(self, server: viser.ViserServer, studio: Studio, folder: Folder) -> None:
        super().__init__(server, studio, folder)
        self._shown_evaluation: Evaluation | None = None
        #: Newest position (3,), rotation (3, 3) and gesture of each dragged camera, by its name. A
        #: gesture identifies one drag, whose moves are undone together.
        self._drags: dict[str, tuple[np.ndarray, np.ndarray, object]] = {}
        self._gesture_count = 0
        self._closed = self._details_shown = False
        #: Nodes with the values that they show: see :func:`_update_nodes`.
        self._camera_nodes: dict[str, tuple[Any, CameraNode]] = {}
        self._zone_nodes: dict[str, tuple[Any, ZoneNode]] = {}
        self._nearest_node: CameraNode | None = None
        low, high = studio.scene.bounds
        # At first the room is shown without its upper fifth.
        self.panel = Panel(self, low[2] + 0.8 * (high[2] - low[2]))
        self.cut_room(self.panel.height_slider.value)
        self._centre = 0.5 * (low + high)
        self._diagonal = float(np.linalg.norm(high - low))
        server.initial_camera.position = self._centre + self._diagonal * VIEW_OFFSET
        server.initial_camera.look_at = self._centre
        server.on_client_connect(self._greet_client)
        self._thread = Thread(target=self._run_actions, daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait until the process is interrupted."""
        self._thread.join()

    def close(self) -> None:
        """End the task, the thread and the server."""
        if self.task is not None:
            self.task.stop()
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self.server.stop()

    def take_drag(self, name: str, position: np.ndarray, rotation: np.ndarray, phase: str,
                  client: int) -> None:
        """Let the thread of the page move a dragged camera; see :data:`.DragCallback`."""
        with self._changed:
            if phase == 'start':
                self._gesture_count += 1
            elif phase == 'end':
                self._actions.append(self._place_cameras)
            else:
                self._drags[name] = position, rotation, (name, client, self._gesture_count)
            self._changed.notify()

    def _greet_client(self, client: viser.ClientHandle) -> None:
        """Move the view of a phone, and show three lines of help until something is edited."""
        if client.camera.aspect < 1.0:
            # The panel covers the lower part of a phone, so the view looks at a point below.
            target = self._centre + self._diagonal * np.array([-0.2, -0.28, -0.35])
            client.camera.position = target + 1.5 * self._diagonal * VIEW_OFFSET
            client.camera.look_at = target
        if not self.studio.history.past_states:
            client.add_notification(
                'ocp studio', 'Drag a camera: the colours show what is seen.\n'
                'Cameras: type exact poses. Ctrl+Alt+Z: undo.\n'
                'Plan finds better poses, Files saves them.', auto_close_seconds=20.0)

    def _run_actions(self) -> None:
        """Run actions and show their results; show details after 0.15 s without an action."""
        self._run_action(self._show)
        while True:
            with self._changed:
                # Closing counts as work. Without work, the thread waits: ``wait`` returns True
                # after a notification, and False at the timeout, after which it is quiet.
                has_work = bool(self._actions or self._drags or self._closed)
                is_quiet = not has_work and not self._changed.wait(
                    timeout=None if self._details_shown else 0.15)
                if self._closed and not is_quiet:
                    return
            if is_quiet:
                actions = [self._show_details]
            else:
                actions = [*self._take_actions(), self._show]
            for action in actions:
                self._run_action(action)

    def _take_actions(self) -> list[Callable[[], None]]:
        """Return the waiting actions, drags first, and empty their lists."""
        with self._changed:
            drags, self._drags = self._drags, {}
            actions, self._actions = self._actions, []
        return [*(partial(self._move_dragged_camera, name, *drag)
                  for name, drag in drags.items()), *actions]

    def _run_action(self, action: Callable[[], None]) -> None:
        """Run an action; show an error instead of ending the thread."""
        try:
            action()
        except (UserError, OSError) as error:
            self.panel.show_message(str(error))
        except Exception as error:  # The page goes on for all other clients.
            _log.exception('an action of the studio failed')
            self.panel.show_message(
                f'found an error ({type(error).__name__}); the terminal of ocp studio shows it; '
                'undo the last step if it comes again')

    def _move_dragged_camera(self, name: str, position: np.ndarray, rotation: np.ndarray,
                             gesture: object) -> None:
        """Move a camera to the position (3,) and rotation (3, 3) to which it was dragged."""
        names = self.studio.state.names
        if name in names and np.isfinite(position).all() and np.isfinite(rotation).all():
            camera = names.index(name)
            self.stop_task()
            pose = self.studio.dragged_pose(camera, position, rotation)
            self.studio.move_camera(camera, pose, action=gesture)

    def _show(self) -> None:
        """Show the present placement and its figures; colours first, as people wait for them."""
        self._details_shown = False
        previous, evaluation = self._shown_evaluation, self.evaluation
        if evaluation is not previous:
            rig_changed = previous is None or evaluation.state.rig is not previous.state.rig or (
                evaluation.state.locked != previous.state.locked)
            self._shown_evaluation = evaluation
            self.panel.colour_points()
            self.server.flush()
            self.panel.show_summary(evaluation)
            if rig_changed:
                self._show_rig(evaluation)
            self._colour_cameras(evaluation)
        self.panel.show_figures(evaluation, self.studio.certificate(evaluation),
                                self.kept_evaluation)

    def _show_details(self) -> None:
        """Show what takes longer or would disturb a person who drags a camera."""
        self._details_shown = True
        evaluation, camera = self.evaluation, self.panel.selected_camera
        self._place_cameras()
        self.panel.show_details(evaluation.state, camera)
        self._show_nearest(evaluation, camera)
        scene = self.studio.scene
        seen = self.studio.point_order[evaluation.points_seen_by(camera)]
        model = evaluation.problem.models[camera]
        self.panel.depth_picture.image = depth_colours(depth_image(
            scene.points[seen], scene.pitch[seen], evaluation.state.poses[camera], model), model)

    def _show_rig(self, evaluation: Evaluation) -> None:
        """Show a node for each camera and zone of the rig, and all of them in the panel."""
        state, scene = evaluation.state, self.server.scene
        # For each node: the values that it shows, and a function that makes it. The pose is not
        # one of the values, since :meth:`_place_cameras` moves nodes.
        cameras: dict[str, tuple[Any, Callable[[], CameraNode]]] = {}
        poses = np.vstack([state.poses, state.rig.fixed_poses])
        for number, (camera, pose) in enumerate(zip(state.rig.all_cameras, poses)):
            is_fixed = number >= len(state.poses)
            is_locked = is_fixed or camera.name in state.locked
            title = f'{camera.name} (locked)' if is_locked else camera.name
            cameras[camera.name] = (title, camera.model, is_locked), partial(
                CameraNode, scene, f'/cameras/{camera.name}', title, camera.model, pose,
                texts.rgb('#777777') if is_fixed else texts.camera_rgb(number),
                None if is_locked else partial(self.take_drag, camera.name),
                None if is_fixed else partial(self.enqueue,
                                              partial(self.panel.select_camera, camera.name)))
        _update_nodes(self._camera_nodes, cameras)
        self._place_cameras()
        _update_nodes(self._zone_nodes, {entry.label: (str(entry.data), partial(
            ZoneNode, scene, f'/zones/{entry.key}_{entry.number}', entry.zone,
            self.studio.scene.bounds, evaluation.problem.region.floor, texts.rgb(entry.colour),
            partial(self._take_zone_drag, entry) if entry.is_box else None))
            for entry in entries_of(state.rig)})
        self.panel.show_rig(state)

    def _take_zone_drag(self, entry: Entry, position: np.ndarray, _: np.ndarray, phase: str,
                        __: int) -> None:
        """Move a box when its drag ends; see :data:`.DragCallback`."""
        if phase == 'end' and np.isfinite(position).all():
            self.enqueue(lambda: self.edit_rig(
                **moved_box(self.studio.state.rig, entry, position)))

    def _place_cameras(self) -> None:
        """Move the nodes of the cameras to their poses, since drags move nodes elsewhere."""
        state = self.studio.state
        for camera, pose in zip(state.rig.all_cameras, [*state.poses, *state.rig.fixed_poses]):
            if camera.name in self._camera_nodes:
                self._camera_nodes[camera.name][1].set_pose(pose)

    def _colour_cameras(self, evaluation: Evaluation) -> None:
        """Colour each camera; one that violates a constraint gets the colour of unseen points."""
        for number, name in enumerate(self.studio.state.names):
            if name in self._camera_nodes:
                self._camera_nodes[name][1].set_colour(
                    texts.rgb(texts.UNSEEN_COLOUR) if evaluation.violates_constraint(name)
                    else texts.camera_rgb(number))

    def _show_nearest(self, evaluation: Evaluation, camera: int) -> None:
        """Show the nearest allowed pose of a camera whose own pose is not allowed."""
        if self._nearest_node is not None:
            self._nearest_node.remove()
            self._nearest_node = None
        is_violating = evaluation.violates_constraint(evaluation.state.names[camera])
        pose = self.studio.nearest_allowed(evaluation, camera) if is_violating else None
        self.panel.show_nearest(pose, is_violating)
        if pose is not None:
            self._nearest_node = CameraNode(
                self.server.scene, '/nearest', 'nearest allowed pose',
                evaluation.problem.models[camera], pose, texts.rgb(texts.PLAIN_COLOUR))


def _update_nodes(nodes: dict[str, tuple[Any, Any]],
                  wanted: dict[str, tuple[Any, Callable[[], Any]]]) -> None:
    """
    Remove nodes that are not wanted or show old values, and make those that are missing.

    :param nodes: shown values and node, by the name of the node; this function changes it.
    :param wanted: values to show and a function that makes the node, by the name of the node.
    """
    for name in list(nodes):
        if name not in wanted or wanted[name][0] != nodes[name][0]:
            nodes.pop(name)[1].remove()
    for name, (values, make_node) in wanted.items():
        if name not in nodes:
            nodes[name] = values, make_node()
