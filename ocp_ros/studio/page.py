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

from collections import deque
from collections.abc import Callable
import logging
from threading import Condition, Thread
from typing import Any

import numpy as np
from ocp_ros.studio.depth_image import depth_colours, depth_image
from ocp_ros.studio.folder import Folder
from ocp_ros.studio.model import Evaluation, Studio
from ocp_ros.studio.panel import Panel
from ocp_ros.studio.scene_nodes import CameraNode, Cloud, Surfaces, ZoneNode
from ocp_ros.studio.state import State
from ocp_ros.studio.tasks import Progress, Task
from ocp_ros.studio.texts import (
    BOTH,
    camera_rgb,
    camera_title,
    colours_of,
    HELP,
    MESH,
    MISSED,
    PLAIN,
    rgb,
)
from ocp_ros.studio.zone_edits import entries_of, Entry, moved_box
from ocp_ros.util.settings import UserError
import viser

#: Seconds without an event after which everything is shown that takes longer.
QUIET = 0.15
#: From the middle of the room to where the view is at first, and to a place that is below the
#: middle in the picture, in diagonals of the room.
AWAY, BELOW = np.array([-0.35, -0.5, 0.6]), np.array([-0.2, -0.28, -0.35])
#: Share of the room's height up to which it is shown at first.
CUT = 0.8
#: Seconds for which the help is shown.
HELPED = 20.0
#: Metres between two placements that are shown side by side.
APART = 1.0

_log = logging.getLogger(__name__)


class Page:
    """
    A page on which a placement is edited, for any number of clients.

    :param server: of the page.
    :param studio: the placement.
    :param folder: for its files.
    """

    def __init__(self, server: viser.ViserServer, studio: Studio, folder: Folder) -> None:
        self.server, self.studio, self.folder = server, studio, folder
        self.task: Task | None = None
        self.kept: Evaluation | None = None
        self._shown: Evaluation | None = None
        self._news = Condition()
        #: Actions of people, and the newest pose of each dragged camera.
        self._actions: deque[Callable[[], None]] = deque()
        self._drags: dict[str, tuple[np.ndarray, np.ndarray, object]] = {}
        self._gestures = 0
        self._over = self._detailed = False
        scene = studio.scene
        self._points = scene.points[studio.order]
        self._spacing = float(np.median(scene.spacing))
        self._normals = scene.normals_or_estimate[studio.order]
        self.cloud = Cloud(server.scene, '/room', self._points, self._normals, self._spacing)
        self.surfaces = Surfaces(server.scene, scene.mesh) if scene.mesh is not None else None
        self._other: list[Cloud | CameraNode] = []
        self._cameras: dict[str, tuple[tuple[Any, ...], CameraNode]] = {}
        self._zones: dict[str, tuple[tuple[Any, ...], ZoneNode]] = {}
        self._ghost: CameraNode | None = None
        low, high = scene.bounds
        self.panel = Panel(self, low[2] + CUT * (high[2] - low[2]))
        self.cut(self.panel.cut.value)
        self._middle, self._size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        server.initial_camera.position = self._middle + self._size * AWAY
        server.initial_camera.look_at = self._middle
        server.on_client_connect(self._welcome)
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait until the process is interrupted."""
        self._thread.join()

    def close(self) -> None:
        """End the search, the thread and the server."""
        if self.task is not None:
            self.task.stop()
        with self._news:
            self._over = True
            self._news.notify()
        self._thread.join()
        self.server.stop()

    def do(self, action: Callable[[], None]) -> None:
        """Apply an action soon, in the thread of the page."""
        with self._news:
            self._actions.append(action)
            self._news.notify()

    def drag(self, name: str, position: np.ndarray, rotation: np.ndarray, phase: str, client: int
             ) -> None:
        """Take the newest pose of a camera that a person drags."""
        with self._news:
            if phase == 'start':
                self._gestures += 1
            elif phase == 'end':
                self._actions.append(self._place_cameras)
            else:
                self._drags[name] = position, rotation, (name, client, self._gestures)
            self._news.notify()

    @property
    def evaluation(self) -> Evaluation:
        """Return the evaluation of the present placement."""
        return self.studio.evaluation()

    @property
    def selected(self) -> int:
        """Return the number of the selected camera."""
        names = self.studio.state.names
        chosen = self.panel.camera.value
        return names.index(chosen) if chosen in names else 0

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Show the room on a phone too, and three lines of help until something is edited."""
        if client.camera.aspect < 1.0:
            # The panel covers the lower part.
            below = self._middle + self._size * BELOW
            client.camera.position = below + 1.5 * self._size * AWAY
            client.camera.look_at = below
        if not self.studio.history.past:
            client.add_notification('ocp studio', '\n'.join(HELP), auto_close_seconds=HELPED)

    def _run(self) -> None:
        """Apply what people do, and show the result, until the page is closed."""
        self._guarded(self._show)
        while True:
            with self._news:
                waits = not (self._actions or self._drags or self._over)
                if waits and not self._news.wait(None if self._detailed else QUIET):
                    actions, drags = None, {}
                elif self._over:
                    return
                else:
                    actions, drags = list(self._actions), self._drags
                    self._drags = {}
                    self._actions.clear()
            if actions is None:
                self._guarded(self._show_details)
                continue
            for action in (*(self._dragged(name, *drag) for name, drag in drags.items()),
                           *actions):
                self._guarded(action)
            self._guarded(self._show)

    def _guarded(self, action: Callable[[], None]) -> None:
        """Run an action; show an error instead of ending the thread."""
        try:
            action()
        except (UserError, OSError) as error:
            self.panel.say(str(error))
        except Exception as error:  # The page goes on for all other clients.
            _log.exception('an action of the studio failed')
            self.panel.say(f'found an error ({type(error).__name__}); the placement is unchanged')

    def _dragged(self, name: str, position: np.ndarray, rotation: np.ndarray, gesture: object
                 ) -> Callable[[], None]:
        """Return the action that moves a dragged camera."""
        def move() -> None:
            names = self.studio.state.names
            if name in names and np.isfinite(position).all() and np.isfinite(rotation).all():
                camera = names.index(name)
                self.stop_task()
                self.studio.move(camera, self.studio.pose_of(camera, position, rotation), gesture)
        return move

    def _show(self) -> None:
        """Show the present placement and its figures: colours first, people wait for them."""
        self._detailed = False
        evaluation = self.evaluation
        if evaluation is not self._shown:
            fresh = self._shown is None or evaluation.state.rig is not self._shown.state.rig or (
                evaluation.state.locked != self._shown.state.locked)
            self._shown = evaluation
            self.paint()
            self.server.flush()
            self.panel.show_summary(evaluation)
            self._mark(evaluation)
            if fresh:
                self._show_rig(evaluation.state)
        self.panel.show_numbers(evaluation, self.studio.certificate(evaluation), self.kept)

    def paint(self) -> None:
        """Colour the points."""
        self.cloud.paint(colours_of(self.evaluation, self.panel.paint, self.selected))

    def _show_details(self) -> None:
        """Show what takes longer or would disturb a person who drags a camera."""
        self._detailed = True
        evaluation, camera = self.evaluation, self.selected
        self._place_cameras()
        self.panel.show_details(evaluation.state, camera)
        self._show_nearest(evaluation, camera)
        scene, order = self.studio.scene, self.studio.order
        seen = order[evaluation.seen_from(camera)]
        model = evaluation.problem.models[camera]
        self.panel.picture.image = depth_colours(depth_image(
            scene.points[seen], scene.pitch[seen], evaluation.state.poses[camera], model), model)

    def _show_rig(self, state: State) -> None:
        """Add and remove nodes, so that those of the page are the cameras and zones of the rig."""
        cameras, scene = {}, self.server.scene
        for number, camera in enumerate(state.rig.all_cameras):
            fixed = number >= len(state.poses)
            locked = fixed or camera.name in state.locked
            poses = state.rig.fixed_poses[number - len(state.poses)] if fixed else (
                state.poses[number])
            title = camera_title(camera.name, locked)
            cameras[camera.name] = (title, camera.model, locked), (
                title, camera.model, poses, rgb('#777777') if fixed else camera_rgb(number),
                None if locked else self._drag_of(camera.name),
                None if fixed else self._select(camera.name))
        _exchange(self._cameras, cameras, lambda name, *parts: CameraNode(
            scene, f'/cameras/{name}', *parts))
        self._place_cameras()
        floor, zones = self._shown.problem.region.floor, {}
        for entry in entries_of(state.rig):
            zones[entry.label] = (str(entry.data),), (entry, )
        _exchange(self._zones, zones, lambda label, entry: ZoneNode(
            scene, f'/zones/{entry.key}_{entry.number}', entry.zone, self.studio.scene.bounds,
            floor, rgb(entry.colour), self._drag_of_zone(entry) if entry.is_box else None))
        self.panel.show_rig(state)

    def _drag_of(self, name: str) -> Callable[[np.ndarray, np.ndarray, str, int], None]:
        """Return the function that takes the poses of a dragged camera."""
        return lambda *drag: self.drag(name, *drag)

    def _drag_of_zone(self, entry: Entry) -> Callable[[np.ndarray, np.ndarray, str, int], None]:
        """Return the function that moves a zone when its drag ends."""
        def dragged(position: np.ndarray, _: np.ndarray, phase: str, __: int) -> None:
            if phase == 'end' and np.isfinite(position).all():
                self.do(lambda: self.edit_rig(**moved_box(self.studio.state.rig, entry, position)))
        return dragged

    def _select(self, name: str) -> Callable[[], None]:
        """Return the function that selects a camera."""
        return lambda: self.do(lambda: self.panel.select(name))

    def _place_cameras(self) -> None:
        """Move the nodes of the cameras to their poses, which dragging may have left."""
        state = self.studio.state
        for name, pose in zip(state.names, state.poses):
            if name in self._cameras:
                self._cameras[name][1].place(pose)

    def _mark(self, evaluation: Evaluation) -> None:
        """Draw cameras that violate a constraint in another colour."""
        for number, name in enumerate(self.studio.state.names):
            if name in self._cameras:
                self._cameras[name][1].colour(
                    rgb(MISSED) if evaluation.is_misplaced(name) else camera_rgb(number))

    def _show_nearest(self, evaluation: Evaluation, camera: int) -> None:
        """Show the nearest allowed pose of the selected camera if its own is not allowed."""
        if self._ghost is not None:
            self._ghost.remove()
            self._ghost = None
        broken = evaluation.is_misplaced(evaluation.state.names[camera])
        near = self.studio.nearest_allowed(evaluation, camera) if broken else None
        self.panel.show_nearest(near, broken)
        if near is not None:
            self._ghost = CameraNode(self.server.scene, '/nearest', 'nearest allowed pose',
                                     evaluation.problem.models[camera], near, rgb(PLAIN))

    def edit_rig(self, **parts: Any) -> None:
        """Change keys of the rig, such as zones."""
        self.stop_task()
        self.studio.set_rig(**parts)

    def start_task(self, work: Callable[[Task], Any], seconds: float) -> None:
        """Start a task in the background; the one before is stopped."""
        self.stop_task()
        gesture = object()
        self.task = Task(work, seconds, lambda news: self.do(lambda: self._take(news, gesture)))
        self._task_gesture, self._task_state = gesture, self.studio.state

    def stop_task(self) -> None:
        """Stop the task in the background."""
        if self.task is not None:
            self.task.stop()
            self.task = None

    def _take(self, news: Progress, gesture: object) -> None:
        """Show the news of a task, unless it has been replaced or the placement was edited."""
        if self.task is None or gesture is not self._task_gesture:
            return
        self.panel.show_progress(news)
        if news.poses is not None and self.studio.state is self._task_state:
            self.studio.change(self.studio.state.rig, news.poses, action=gesture)
            self._task_state = self.studio.state
        if news.over:
            self.task = None

    def compare(self, kept: Evaluation | None) -> None:
        """Show another placement beside the present one; None to show it no more."""
        for node in self._other:
            node.remove()
        self._other, self.kept = [], kept
        if kept is None:
            return
        shift = np.array([-self.studio.scene.size[0] - APART, 0.0, 0.0])
        cloud = Cloud(self.server.scene, '/kept/room', self._points, self._normals,
                      self._spacing, shift)
        cloud.cut(self.panel.cut.value)
        cloud.paint(colours_of(kept, self.panel.paint, 0))
        self._other = [cloud]
        for number, (camera, pose) in enumerate(zip(kept.state.rig.cameras, kept.state.poses)):
            self._other.append(CameraNode(
                self.server.scene, f'/kept/{camera.name}', f'A: {number + 1}', camera.model,
                pose + np.concatenate([shift, np.zeros(3)]), camera_rgb(number)))

    def cut(self, height: float) -> None:
        """Show the room up to a height, metres."""
        for node in (self.cloud, self.surfaces, *self._other):
            if isinstance(node, (Cloud, Surfaces)):
                node.cut(height)

    def show_room(self, shown: str) -> None:
        """Show the room in one of the ways of :data:`ocp_ros.studio.texts.ROOMS`."""
        self.cloud.show(shown != MESH)
        if self.surfaces is not None:
            self.surfaces.show(shown in (BOTH, MESH))


def _exchange(shown: dict[str, tuple[tuple[Any, ...], Any]], wanted: dict[str, Any],
              make: Callable[..., Any]) -> None:
    """Remove nodes that are not wanted or have changed, and make those that are missing."""
    for name in list(shown):
        if name not in wanted or wanted[name][0] != shown[name][0]:
            shown.pop(name)[1].remove()
    for name, (key, parts) in wanted.items():
        if name not in shown:
            shown[name] = key, make(name, *parts)
