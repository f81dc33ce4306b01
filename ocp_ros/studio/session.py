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

"""A session of the studio: what people do, their background task, and the room as it is shown."""

from collections.abc import Callable
from threading import Condition
from typing import Any

import numpy as np
from ocp_ros.studio import texts
from ocp_ros.studio.folder import Folder
from ocp_ros.studio.model import Evaluation, Studio
from ocp_ros.studio.scene_nodes import CameraNode, Cloud, Surfaces
from ocp_ros.studio.tasks import Progress, Task, Work
import viser


class Session:
    """
    A placement that people edit together; all clients (open browsers) show the same.

    :param server: of the page.
    :param studio: the room and the placement.
    :param folder: for the files of the studio.
    :ivar task: the task in the background; None if there is none.
    :ivar kept_evaluation: of the kept placement, which is shown for comparison; None if there is
        none.
    :ivar cloud: the points of the room.
    :ivar surfaces: the mesh of the room; None if the room has no mesh.
    """

    def __init__(self, server: viser.ViserServer, studio: Studio, folder: Folder) -> None:
        self.server, self.studio, self.folder = server, studio, folder
        self.task: Task | None = None
        self.kept_evaluation: Evaluation | None = None
        #: Is notified of new actions; its lock guards them.
        self._changed = Condition()
        self._actions: list[Callable[[], None]] = []
        scene = studio.scene
        self._points = scene.points[studio.point_order]
        self._spacing = float(np.median(scene.spacing))
        self._normals = scene.normals_or_estimate[studio.point_order]
        self.cloud = Cloud(server.scene, '/room', self._points, self._normals, self._spacing)
        self.surfaces = Surfaces(server.scene, scene.mesh) if scene.mesh is not None else None
        self._comparison_nodes: list[Cloud | CameraNode] = []

    def enqueue(self, action: Callable[[], None]) -> None:
        """Let the thread of the page run an action soon, and show its result."""
        with self._changed:
            self._actions.append(action)
            self._changed.notify()

    @property
    def evaluation(self) -> Evaluation:
        """Return the evaluation of the present placement."""
        return self.studio.evaluation()

    def edit_rig(self, **new_values: Any) -> None:
        """Change values of the rig by their keys, such as zones; this stops the task."""
        self.stop_task()
        self.studio.set_rig(**new_values)

    def start_task(self, work: Work, seconds: float, show: Callable[[Progress], None]) -> None:
        """
        Stop the present task, and start another one in the background; see :class:`.Task`.

        :param show: shows a report of the task.
        """
        self.stop_task()
        # The gesture identifies this task, whose changes of the placement are undone together.
        gesture = object()
        self.task = Task(work, seconds, lambda progress: self.enqueue(
            lambda: self._use_progress(progress, gesture, show)))
        # Poses of the task are used only while this state is the present one.
        self._task_gesture, self._task_state = gesture, self.studio.state

    def stop_task(self) -> None:
        """Stop the task in the background, if there is one."""
        if self.task is not None:
            self.task.stop()
            self.task = None

    def _use_progress(self, progress: Progress, gesture: object,
                      show: Callable[[Progress], None]) -> None:
        """Show a report of the present task; use its poses unless the placement was edited."""
        if self.task is None or gesture is not self._task_gesture:
            return
        show(progress)
        if progress.poses is not None and self.studio.state is self._task_state:
            self.studio.set_placement(self.studio.state.rig, progress.poses, action=gesture)
            self._task_state = self.studio.state
        if progress.ended:
            self.task = None

    def colour_points(self, colouring: str, camera: int) -> None:
        """Colour the points of the room; see :func:`.texts.point_colours`."""
        self.cloud.set_colours(texts.point_colours(self.evaluation, colouring, camera))

    def compare(self, kept: Evaluation | None, colouring: str, height: float) -> None:
        """
        Show another placement beside the present one, in a second room.

        :param kept: the evaluation of the other placement; None to end the comparison.
        :param colouring: of the points, one of :data:`.texts.COLOURINGS`.
        :param height: height up to which the room is shown, metres.
        """
        for node in self._comparison_nodes:
            node.remove()
        self._comparison_nodes = []
        self.kept_evaluation = kept
        if kept is None:
            return
        # The second room is beside the room, with this gap.
        gap_m = 1.0
        offset = np.array([-self.studio.scene.size[0] - gap_m, 0.0, 0.0])
        cloud = Cloud(self.server.scene, '/kept/room', self._points, self._normals,
                      self._spacing, offset)
        cloud.cut(height)
        # In the colouring by camera, camera 0 of the kept placement is the selected one.
        cloud.set_colours(texts.point_colours(kept, colouring, 0))
        self._comparison_nodes = [cloud]
        for number, (camera, pose) in enumerate(zip(kept.state.rig.cameras, kept.state.poses)):
            self._comparison_nodes.append(CameraNode(
                self.server.scene, f'/kept/{camera.name}', f'A: {number + 1}', camera.model,
                pose + np.concatenate([offset, np.zeros(3)]), texts.camera_rgb(number)))

    def cut_room(self, height: float) -> None:
        """Show the room up to a height, metres."""
        # Cameras are not cut, and there may be no mesh.
        for node in (self.cloud, self.surfaces, *self._comparison_nodes):
            if isinstance(node, (Cloud, Surfaces)):
                node.cut(height)

    def show_room(self, room_view: str) -> None:
        """Show the points or the mesh of the room, or both; one of :data:`.texts.ROOM_VIEWS`."""
        self.cloud.show(room_view != texts.MESH)
        if self.surfaces is not None:
            self.surfaces.show(room_view in (texts.POINTS_AND_MESH, texts.MESH))
