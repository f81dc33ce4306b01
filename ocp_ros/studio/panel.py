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

"""The panel beside the room: numbers, and what people click and type."""

from collections.abc import Callable
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np
from ocp_ros.rig.rig_config import KINDS as SENSORS
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.studio import texts
from ocp_ros.studio.depth_image import NO_DEPTH_COLOUR
from ocp_ros.studio.model import Evaluation
from ocp_ros.studio.state import State
from ocp_ros.studio.tasks import addition_work, find_least_useful, Progress, search_work, Task, Work
from ocp_ros.studio.zone_edits import (
    box_of,
    changed_entry,
    entries_of,
    Entry,
    KEYS,
    added_box,
    without,
)
from ocp_ros.util.settings import ConfigurationError
import viser

if TYPE_CHECKING:
    from ocp_ros.studio.page import Page

#: Seconds of a search: default, least and largest.
SECONDS = 20.0, 1.0, 3600.0
#: Metres and degrees of one step of the number fields.
METRES, DEGREES = 0.05, 1.0
#: Choice of a list without entries.
NONE = '-'
MODIFIER = 'cmd/ctrl+alt'


class Panel:
    """
    The panel of the page; all clients share it.

    :param page: applies what people do.
    :param cut: height at which the room is cut off at first, metres, map frame.
    :ivar camera: list of the cameras, whose value is the selected one.
    :ivar cut: slider of that height.
    :ivar picture: depth image of the selected camera.
    """

    def __init__(self, page: 'Page', cut: float) -> None:
        self.page, gui = page, page.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width='large')
        gui.add_html(texts.STYLE_RULES)
        self.summary = gui.add_html('')
        self.said = gui.add_html('')
        tabs = gui.add_tab_group()
        with tabs.add_tab('Cameras'):
            self._add_cameras(gui)
        with tabs.add_tab('View'):
            self._add_view(gui, cut)
        with tabs.add_tab('Zones'):
            self._add_zones(gui)
        with tabs.add_tab('Plan'):
            self._add_plan(gui)
        with tabs.add_tab('Files'):
            self._add_files(gui)
        with tabs.add_tab('Numbers'):
            self.numbers = gui.add_html('')
        for label, key, action in (('Undo', 'z', self._undo), ('Redo', 'y', self._redo),
                                   ('Lock or unlock the selected camera', 'l', self._turn_lock)):
            command = gui.add_command(label, hotkey=key, modifier=MODIFIER)
            command.on_trigger(lambda _, action=action: page.do(action))

    def _add_cameras(self, gui: viser.GuiApi) -> None:
        """Add the fields of the selected camera."""
        self.camera = gui.add_dropdown('Camera', (NONE,))
        self.sensor = gui.add_dropdown('Sensor', SENSORS)
        self.position = gui.add_vector3('x, y, z (m)', (0.0, 0.0, 0.0), step=METRES)
        self.heading = gui.add_vector3('yaw, pitch, roll (degrees)', (0.0, 0.0, 0.0),
                                       step=DEGREES)
        self.locked = gui.add_checkbox('Locked', False)
        self.edit = gui.add_button_group('Edit', ('Add', 'Copy', 'Remove'))
        self.steps = gui.add_button_group('Steps', ('Undo', 'Redo'))
        self.nearest = gui.add_button('Move to the nearest allowed pose', visible=False)
        self.picture = gui.add_image(np.full((2, 2, 3), NO_DEPTH_COLOUR), label='What it sees (depth)')
        self._on(self.camera, lambda _: None)
        self._on(self.sensor, self._set_sensor)
        self._on(self.position, lambda _: self._type_pose())
        self._on(self.heading, lambda _: self._type_pose())
        self._on(self.locked, lambda value: self._camera_edit(
            lambda camera: self.page.studio.set_locked(camera, bool(value))))
        edits = {'Add': self._add, 'Copy': self._copy,
                 'Remove': lambda: self._camera_edit(self.page.studio.remove)}
        self._on(self.edit, lambda value: edits[value]())
        self._on(self.steps, lambda value: {'Undo': self._undo, 'Redo': self._redo}[value]())
        self._on(self.nearest, lambda _: self._go_nearest())

    def _add_view(self, gui: viser.GuiApi, cut: float) -> None:
        """Add the colours, the cut-away height and the comparison."""
        page, (low, high) = self.page, self.page.studio.scene.bounds[:, 2].tolist()
        self.colours = gui.add_dropdown('Colours', texts.COLOURINGS)
        self.legend = gui.add_html(texts.legend(texts.BY_COUNT))
        self.room = gui.add_dropdown('Room', texts.ROOM_VIEWS, visible=page.surfaces is not None)
        self.cut = gui.add_slider('Show up to (m)', round(low, 1), round(high + 0.1, 1), 0.05,
                                  round(cut, 1))
        self.compare = gui.add_button_group('Compare', ('Keep as A', 'Go to A', 'Stop'))
        self._on(self.colours, lambda _: self._set_colours())
        self._on(self.room, page.show_room)
        self._on(self.cut, lambda value: page.cut(float(value)))
        actions: dict[str, Callable[[], None]] = {
            'Keep as A': lambda: page.compare(page.evaluation), 'Go to A': self._go_to_kept,
            'Stop': lambda: page.compare(None)}
        self._on(self.compare, lambda value: actions[value]())

    def _add_zones(self, gui: viser.GuiApi) -> None:
        """Add the list of zones and the fields of the selected one."""
        self.zone = gui.add_dropdown('Zone', (NONE,))
        self.low = gui.add_vector3('Lowest corner (m)', (0.0, 0.0, 0.0), step=METRES)
        self.high = gui.add_vector3('Highest corner (m)', (0.0, 0.0, 0.0), step=METRES)
        self.zone_name = gui.add_text('Name', '')
        self.weight = gui.add_number('Weight', 1.0, min=0.0, max=1000.0, step=0.5)
        self.must_see = gui.add_number('Share that must be seen', 0.0, min=0.0, max=1.0,
                                       step=0.05)
        self.new_zone = gui.add_button_group('Add', tuple(KEYS))
        self.no_zone = gui.add_button('Remove this zone')
        self._on(self.zone, lambda _: self._show_zone())
        for field in (self.low, self.high):
            self._on(field, lambda _: self._edit_zone(box=box_of(self.low.value,
                                                                 self.high.value)))
        self._on(self.zone_name, lambda value: self._edit_region(name=value))
        self._on(self.weight, lambda value: self._edit_region(weight=float(value)))
        self._on(self.must_see, lambda value: self._edit_region(
            must_see=float(value) if value else None))
        self._on(self.new_zone, self._add_zone)
        self._on(self.no_zone, lambda _: self._remove_zone())

    def _add_plan(self, gui: viser.GuiApi) -> None:
        """Add the buttons of the planners."""
        default, least, most = SECONDS
        self.seconds = gui.add_number('Seconds', default, min=least, max=most, step=1.0)
        actions = {'Plan all': lambda: self._search(False),
                   'Improve from here': lambda: self._search(True),
                   'Best additional camera': self._search_addition,
                   'Which camera to leave out': self._leave_out}
        self.planners = {}
        for label, action in actions.items():
            self.planners[label] = gui.add_button(label)
            self._on(self.planners[label], lambda _, action=action: action())
        self.progress = gui.add_progress_bar(0.0, visible=False)
        self.stop = gui.add_button('Stop', visible=False)
        self.stop.on_click(lambda _: self._stop())
        self._told = self.task_said = gui.add_html('')

    def _add_files(self, gui: viser.GuiApi) -> None:
        """Add what saves, loads and exports."""
        self.name = gui.add_text('Name', 'placement')
        self.save = gui.add_button_group('Save', ('Placement', 'Rig'))
        self.export = gui.add_button('Export as ocp plan does')
        self.file = gui.add_dropdown('File', (NONE,))
        self.load = gui.add_button('Load')
        self.file_said = gui.add_html('')
        self._list_files()
        self._on(self.save, self._save)
        self._on(self.export, lambda _: self._export())
        self._on(self.load, lambda _: self._load())

    def _on(self, handle: Any, action: Callable[[Any], None]) -> None:
        """Apply an action with the value of a field when a person changes it."""
        def changed(event: viser.GuiEvent) -> None:
            # Without a client, the program itself has changed the value.
            if event.client is not None:
                value = event.target.value
                self.page.do(lambda: self._acted(action, value))
        (handle.on_click if hasattr(handle, 'on_click') else handle.on_update)(changed)

    def _acted(self, action: Callable[[Any], None], value: Any) -> None:
        """Apply an action, and forget the last message and the details that it has changed."""
        self.say('')
        action(value)

    def say(self, text: str) -> None:
        """Show a message at the top of the panel."""
        self.said.content = texts.message(text)

    @property
    def paint(self) -> str:
        """Return the chosen way to colour the points."""
        value = self.colours.value
        return value if value in texts.COLOURINGS else texts.BY_COUNT

    def select(self, name: str) -> None:
        """Select a camera."""
        if name in self.camera.options:
            self.camera.value = name
        self.page.paint()

    def show_summary(self, evaluation: Evaluation) -> None:
        """Show the most important figures."""
        self.summary.content = texts.summary(evaluation)

    def show_numbers(self, evaluation: Evaluation, certificate: Certificate | None,
                     kept: Evaluation | None) -> None:
        """Show all figures; see :func:`ocp_ros.studio.texts.all_figures`."""
        self.numbers.content = texts.all_figures(evaluation, certificate, kept)

    def show_details(self, state: State, camera: int) -> None:
        """Show the pose of the selected camera in its fields."""
        pose, chosen = state.poses[camera], state.rig.cameras[camera]
        self.position.value = tuple(pose[:3].round(4).tolist())
        self.heading.value = tuple(np.rad2deg(pose[3:]).round(3).tolist())
        self.locked.value = chosen.name in state.locked
        if chosen.sensor in SENSORS:
            self.sensor.value = chosen.sensor
        if self.paint == texts.BY_CAMERA:
            self.page.paint()

    def show_nearest(self, pose: np.ndarray | None, broken: bool) -> None:
        """Offer the nearest allowed pose of the selected camera; None if there is none."""
        self.nearest.visible = pose is not None
        self._near = pose
        if broken and pose is None:
            self.say('found no allowed pose of this camera in the room; expected one at least; '
                     'change the mount, keep_clear or the zones of the rig')

    def show_rig(self, state: State) -> None:
        """Show the cameras and zones of the rig in the lists."""
        _choose_from(self.camera, state.names)
        _choose_from(self.zone, [entry.label for entry in entries_of(state.rig)] or [NONE])
        self._show_zone()

    def show_progress(self, news: Progress) -> None:
        """Show the news of a task."""
        self.progress.value = 100.0 * min(news.share, 1.0)
        self.progress.visible = self.stop.visible = not news.over
        if news.said:
            self._told.content = texts.message(news.said)

    def _start(self, work: Work, seconds: float, said: str, told: viser.GuiHtmlHandle) -> None:
        """Start a task whose news are told in a part of the panel."""
        self.page.start_task(work, seconds)
        self._told = told
        self.show_progress(Progress(0.0, said))

    def _camera_edit(self, edit: Callable[[int], Any]) -> None:
        """Edit the selected camera."""
        self.page.stop_task()
        edit(self.page.selected)

    def _set_sensor(self, sensor: str) -> None:
        """Give the selected camera another sensor."""
        self._camera_edit(lambda camera: self.page.studio.set_sensor(camera, sensor))

    def _type_pose(self) -> None:
        """Move the selected camera to the pose in the fields."""
        pose = np.concatenate([self.position.value, np.deg2rad(self.heading.value)])
        camera = self.page.selected
        if not np.allclose(pose, self.page.studio.state.poses[camera], atol=1e-9):
            self._camera_edit(lambda camera: self.page.studio.move(camera, pose))

    def _add(self) -> None:
        """Add a camera with the sensor of the field, and select it."""
        self._new_camera(self.sensor.value)

    def _copy(self) -> None:
        """Add a camera like the selected one beside it, and select the new one."""
        state, camera = self.page.studio.state, self.page.selected
        pose = state.poses[camera] + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
        self._new_camera(state.names[camera], pose)

    def _new_camera(self, sensor: str, pose: np.ndarray | None = None) -> None:
        """Add a camera, and select it."""
        self.page.stop_task()
        camera = self.page.studio.add(sensor, pose)
        names = self.page.studio.state.names
        _choose_from(self.camera, names)
        self.camera.value = names[camera]

    def _undo(self) -> None:
        """Go one step back."""
        self.page.stop_task()
        if not self.page.studio.history.undo():
            self.say('nothing to undo')

    def _redo(self) -> None:
        """Go one step forward."""
        self.page.stop_task()
        if not self.page.studio.history.redo():
            self.say('nothing to redo')

    def _turn_lock(self) -> None:
        """Lock the selected camera, or unlock it."""
        state = self.page.studio.state
        self._camera_edit(lambda camera: self.page.studio.set_locked(
            camera, state.names[camera] not in state.locked))

    def _go_nearest(self) -> None:
        """Move the selected camera to the nearest allowed pose."""
        if (pose := self._near) is not None:
            self._camera_edit(lambda camera: self.page.studio.move(camera, pose))

    def _set_colours(self) -> None:
        """Colour the points in another way."""
        self.legend.content = texts.legend(self.paint)
        self.page.paint()
        if self.page.kept is not None:
            self.page.compare(self.page.kept)

    def _go_to_kept(self) -> None:
        """Continue with the kept placement."""
        if self.page.kept is not None:
            state = self.page.kept.state
            self.page.stop_task()
            self.page.studio.change(state.rig, state.poses, state.locked)

    @property
    def _entry(self) -> Entry | None:
        """Return the selected zone."""
        return next((entry for entry in entries_of(self.page.studio.state.rig)
                     if entry.label == self.zone.value), None)

    def _show_zone(self) -> None:
        """Show the numbers of the selected zone in the fields."""
        entry = self._entry
        region = entry is not None and entry.key == 'regions'
        self.low.visible = self.high.visible = entry is not None and entry.is_box
        self.zone_name.visible = self.weight.visible = self.must_see.visible = region
        self.no_zone.visible = entry is not None
        if entry is not None and entry.is_box:
            self.low.value, self.high.value = map(tuple, box_of(*entry.data['box']))
        if region:
            chosen = self.page.studio.state.rig.regions[entry.number]
            self.zone_name.value = entry.data['name']
            self.weight.value, self.must_see.value = chosen.weight, chosen.must_see

    def _edit_zone(self, **parts: Any) -> None:
        """Change values of the selected zone, and select it again under its new name."""
        if (entry := self._entry) is not None:
            rig = self.page.studio.state.rig
            self.page.edit_rig(**changed_entry(rig, entry, **parts))
            self._select_zone(entry.key, entry.number)

    def _edit_region(self, **parts: Any) -> None:
        """Change values of the selected zone if it is a region."""
        if self._entry is not None and self._entry.key == 'regions':
            self._edit_zone(**parts)

    def _add_zone(self, kind: str) -> None:
        """Add a box in the middle of the room, and select it."""
        key, studio = KEYS[kind], self.page.studio
        floor = self.page.evaluation.problem.region.floor
        self.page.edit_rig(**added_box(studio.state.rig, key, studio.scene, floor))
        self._select_zone(key, len(studio.state.rig.document.data[key]) - 1)

    def _remove_zone(self) -> None:
        """Remove the selected zone."""
        if (entry := self._entry) is not None:
            self.page.edit_rig(**without(self.page.studio.state.rig, entry))

    def _select_zone(self, key: str, number: int) -> None:
        """Select a zone."""
        entries = list(entries_of(self.page.studio.state.rig))
        _choose_from(self.zone, [entry.label for entry in entries])
        self.zone.value = next(entry.label for entry in entries
                               if (entry.key, entry.number) == (key, number))
        self._show_zone()

    def _search(self, from_here: bool) -> None:
        """Search for better poses."""
        seconds = float(np.clip(float(self.seconds.value), *SECONDS[1:]))
        studio = self.page.studio
        self._start(search_work(studio, studio.state, from_here), seconds, 'searching',
                    self.task_said)

    def _stop(self) -> None:
        """Stop the task at its next step; what it has found stays."""
        task = self.page.task
        if task is not None:
            task.stop()

    def _search_addition(self) -> None:
        """Search for the best pose of one more camera, and add it."""
        page = self.page
        self._start(addition_work(page.evaluation, lambda sensor, pose: page.do(
            partial(page.studio.add, sensor, pose))), SECONDS[2], 'searching', self.task_said)

    def _leave_out(self) -> None:
        """Select the camera that can be left out best."""
        evaluation = self.page.evaluation
        camera, loss = find_least_useful(evaluation)
        name = evaluation.state.names[camera]
        self.select(name)
        self.task_said.content = texts.message(
            f'without {name} the objective value is {loss:.4f} in place of '
            f'{evaluation.rig_evaluation.loss:.4f}: the least loss of all cameras; it is selected')

    def _save(self, kind: str) -> None:
        """Save the placement or the rig."""
        studio, folder = self.page.studio, self.page.folder
        path = (folder.save_placement(self.name.value, studio.placement(True))
                if kind == 'Placement' else folder.save_rig(self.name.value, studio.state.rig))
        self._list_files(path.name)
        self.file_said.content = texts.message(f'wrote {path.name}')

    def _load(self) -> None:
        """Load the selected file."""
        studio, name = self.page.studio, self.file.value
        rig, poses = self.page.folder.load(name, studio.scene)
        self.page.stop_task()
        studio.load(rig, poses)
        self.name.value = name.rpartition('.')[0]
        self.file_said.content = texts.message(f'loaded {name}')

    def _export(self) -> None:
        """Write all files of the placement in the background."""
        page, name, placement = self.page, self.name.value, self.page.studio.placement(True)

        def work(_: Task) -> Any:
            files = page.folder.export(name, page.studio.scene, placement, page.studio.command)
            yield Progress(1.0, f'wrote {len(files)} files to {name}: {", ".join(files)}')
        self._start(work, SECONDS[2], 'writing all files', self.file_said)

    def _list_files(self, chosen: str = '') -> None:
        """Show the files of the folder in the list."""
        _choose_from(self.file, self.page.folder.names() or [NONE])
        if chosen:
            self.file.value = chosen


def _choose_from(dropdown: Any, options: list[str]) -> None:
    """Offer other choices in a list; the chosen one stays if it is still there."""
    if not options:
        raise ConfigurationError('list: found no choice; expected one at least; add one')
    if tuple(options) != tuple(dropdown.options):
        before = dropdown.value
        dropdown.options = options
        dropdown.value = before if before in options else options[0]
