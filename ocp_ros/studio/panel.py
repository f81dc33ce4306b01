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

"""The panel beside the room: figures, and fields and buttons for people."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from ocp_ros.report.drawing.depth_image import NO_DEPTH_COLOUR
from ocp_ros.rig.sensors import KINDS as SENSORS
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.studio import texts, zone_edits
from ocp_ros.studio.model import Evaluation, State
from ocp_ros.studio.server import in_order
from ocp_ros.studio.session import Session
from ocp_ros.studio.tasks import addition_work, find_least_useful, Progress, search_work, Work
from ocp_ros.util.settings import ConfigurationError
import viser

#: Least and largest duration of a task, seconds.
MIN_SECONDS, MAX_SECONDS = 1.0, 3600.0
#: Step of the number fields for lengths, metres.
STEP_M = 0.05
#: Choice of a list without entries.
NO_CHOICE = '-'


class Panel:
    """
    The panel of the page; all clients (open browsers) share it.

    :param session: runs the actions of people.
    :param height: height up to which the room is shown at first, metres, map frame.
    :ivar camera_list: list of the cameras, whose value is the name of the selected camera.
    :ivar height_slider: slider of the height up to which the room is shown.
    :ivar depth_picture: depth image of the selected camera.
    """

    def __init__(self, session: Session, height: float) -> None:
        self.session, self.studio = session, session.studio
        #: Fields whose values people have entered since :meth:`show_details`.
        self._entered_fields: list[Any] = []
        #: Nearest allowed pose (6,) of the selected camera; None if it is not needed or unknown.
        self._nearest_pose: np.ndarray | None = None
        gui = session.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width='large')
        gui.add_html(texts.STYLE_RULES)
        self.summary = gui.add_html('')
        self.message = gui.add_html('')
        tabs = gui.add_tab_group()
        for label, add_fields in (
                ('Cameras', self._add_camera_fields),
                ('View', partial(self._add_view_fields, height=height)),
                ('Zones', self._add_zone_fields), ('Plan', self._add_plan_fields),
                ('Files', self._add_file_fields), ('Numbers', self._add_figures)):
            with tabs.add_tab(label):
                add_fields(gui)
        for label, key, action in (('Undo', 'z', self._undo), ('Redo', 'y', self._redo),
                                   ('Lock or unlock the selected camera', 'l', self._toggle_lock)):
            command = gui.add_command(label, hotkey=key, modifier='cmd/ctrl+alt')
            command.on_trigger(in_order(lambda _, action=action: session.enqueue(action)))

    def _add_camera_fields(self, gui: viser.GuiApi) -> None:
        """Add the fields of the selected camera."""
        self.camera_list = gui.add_dropdown('Camera', (NO_CHOICE,))
        self.sensor_list = gui.add_dropdown('Sensor', SENSORS)
        self.position = gui.add_vector3('x, y, z (m)', (0.0, 0.0, 0.0), step=STEP_M)
        self.angles = gui.add_vector3('yaw, pitch, roll (degrees)', (0.0, 0.0, 0.0), step=1.0)
        self.locked_box = gui.add_checkbox('Locked', initial_value=False)
        self.edit_buttons = self._add_buttons(gui, 'Edit', {
            'Add': self._add_camera, 'Copy': self._copy_camera, 'Remove': self._remove_camera})
        self.step_buttons = self._add_buttons(
            gui, 'Steps', {'Undo': self._undo, 'Redo': self._redo})
        self.nearest_button = gui.add_button('Move to the nearest allowed pose', visible=False)
        self.depth_picture = gui.add_image(np.full((2, 2, 3), NO_DEPTH_COLOUR),
                                           label='What it sees (depth)')
        # After any action, the page shows the selected camera, so this one does nothing itself.
        self._connect(self.camera_list, lambda _: None)
        self._connect(self.sensor_list, self._set_sensor)
        self._connect(self.position, self._set_typed_pose)
        self._connect(self.angles, self._set_typed_pose)
        self._connect(self.locked_box, self._set_locked)
        self._connect(self.nearest_button, self._move_to_nearest)

    def _add_view_fields(self, gui: viser.GuiApi, height: float) -> None:
        """Add the colours, the height up to which the room is shown, and the comparison."""
        scene = self.studio.scene
        low, high = scene.bounds[:, 2].tolist()
        self.colouring_list = gui.add_dropdown('Colours', texts.COLOURINGS)
        self.legend = gui.add_html(texts.legend(texts.COLOURINGS.by_count))
        self.room_list = gui.add_dropdown('Room', texts.ROOM_VIEWS, visible=scene.mesh is not None)
        # The slider ends a little above the room, so that rounding does not cut the top.
        self.height_slider = gui.add_slider('Show up to (m)', round(low, 1), round(high + 0.1, 1),
                                            STEP_M, round(height, 1))
        self.compare_buttons = self._add_buttons(gui, 'Compare', {
            'Keep as A': lambda: self.compare(self.session.evaluation),
            'Go to A': self._restore_kept, 'Stop': lambda: self.compare(None)})
        self._connect(self.colouring_list, self._set_colours)
        self._connect(self.room_list, self.session.show_room)
        self._connect(self.height_slider, lambda value: self.session.cut_room(float(value)))

    def _add_zone_fields(self, gui: viser.GuiApi) -> None:
        """Add the list of zones and the fields of the selected zone."""
        self.zone_list = gui.add_dropdown('Zone', (NO_CHOICE,))
        self.low_corner = gui.add_vector3('Lowest corner (m)', (0.0, 0.0, 0.0), step=STEP_M)
        self.high_corner = gui.add_vector3('Highest corner (m)', (0.0, 0.0, 0.0), step=STEP_M)
        self.zone_name = gui.add_text('Name', '')
        self.weight = gui.add_number('Weight', 1.0, min=0.0, max=1000.0, step=0.5)
        self.must_see = gui.add_number('Share that must be seen', 0.0, min=0.0, max=1.0, step=0.05)
        self.new_zone_buttons = gui.add_button_group('Add', tuple(zone_edits.KEYS))
        self.remove_zone_button = gui.add_button('Remove this zone')
        self._connect(self.zone_list, lambda _: self._show_zone())
        for corner in (self.low_corner, self.high_corner):
            self._connect(corner, lambda _: self._edit_zone(
                box=zone_edits.box_data(self.low_corner.value, self.high_corner.value)))
        self._connect(self.zone_name, lambda value: self._edit_region(name=value))
        self._connect(self.weight, lambda value: self._edit_region(weight=float(value)))
        # A share of 0 removes the key from the region.
        self._connect(self.must_see, lambda value: self._edit_region(
            must_see=float(value) if value else None))
        self._connect(self.new_zone_buttons, self._add_zone)
        self._connect(self.remove_zone_button, self._remove_zone)

    def _add_plan_fields(self, gui: viser.GuiApi) -> None:
        """Add the buttons that start and stop searches, and their progress."""
        self.seconds = gui.add_number('Seconds', 20.0, min=MIN_SECONDS, max=MAX_SECONDS, step=1.0)
        actions: dict[str, Callable[[Any], None]] = {
            'Plan all': self._search,
            'Best additional camera': self._search_addition,
            'Which camera to leave out': self._select_least_useful}
        self.plan_buttons = {label: gui.add_button(label) for label in actions}
        # Without an action, so that all clients show the same value.
        self._connect(self.seconds, lambda _: None)
        for label, button in self.plan_buttons.items():
            self._connect(button, actions[label])
        self.progress_bar = gui.add_progress_bar(0.0, visible=False)
        self.stop_button = gui.add_button('Stop', visible=False)
        # Without :meth:`_connect`, the task is stopped at once, also while another action runs.
        self.stop_button.on_click(lambda _: self._stop_search())
        self.search_message = gui.add_html('')
        #: Where the messages of the present task are shown.
        self._task_message = self.search_message

    def _add_file_fields(self, gui: viser.GuiApi) -> None:
        """Add the fields and buttons that save, export and load."""
        self.file_name = gui.add_text('Name', 'placement')
        self.save_buttons = gui.add_button_group('Save', ('Placement', 'Rig'))
        self.export_button = gui.add_button('Export as ocp plan does')
        self.file_list = gui.add_dropdown('File', (NO_CHOICE,))
        self.load_button = gui.add_button('Load')
        self.file_message = gui.add_html('')
        self._list_files()
        self._connect(self.file_name, lambda _: None)
        self._connect(self.save_buttons, self._save)
        self._connect(self.export_button, self._export)
        self._connect(self.load_button, self._load)

    def _add_figures(self, gui: viser.GuiApi) -> None:
        """Add all figures of the placement."""
        self.figures = gui.add_html('')

    def _add_buttons(self, gui: viser.GuiApi, label: str, actions: dict[str, Callable[[], None]]
                     ) -> viser.GuiButtonGroupHandle:
        """Add a button for each action, and return the group of these buttons."""
        group = gui.add_button_group(label, tuple(actions))
        self._connect(group, lambda button: actions[button]())
        return group

    def _connect(self, field: Any, action: Callable[[Any], None]) -> None:
        """Call an action with the value of a field or button that a person changes or clicks."""
        def run(value: Any) -> None:
            self.show_message('')
            action(value)

        def enqueue_action(event: viser.GuiEvent) -> None:
            # Without a client, the program itself has changed the value.
            if event.client is not None:
                self._entered_fields.append(field)
                self.session.enqueue(partial(run, event.target.value))
        # Only buttons have on_click.
        (field.on_click if hasattr(field, 'on_click') else field.on_update)(
            in_order(enqueue_action))

    def show_message(self, text: str) -> None:
        """Show a message at the top of the panel; an empty one removes the last message."""
        self.message.content = texts.message(text)

    @property
    def colouring(self) -> str:
        """Return the chosen colouring of the points, one of :data:`.texts.COLOURINGS`."""
        value = self.colouring_list.value
        return value if value in texts.COLOURINGS else texts.COLOURINGS.by_count

    @property
    def selected_camera(self) -> int:
        """Return the number of the selected camera; the first camera if none is selected."""
        names = self.studio.state.names
        name = self.camera_list.value
        return names.index(name) if name in names else 0

    def select_camera(self, name: str) -> None:
        """Select the camera with this name."""
        if name in self.camera_list.options:
            self.camera_list.value = name
        self.colour_points()

    def colour_points(self) -> None:
        """Colour the points as chosen."""
        self.session.colour_points(self.colouring, self.selected_camera)

    def compare(self, kept: Evaluation | None) -> None:
        """Show another placement beside the present one; None to end the comparison."""
        self.session.compare(kept, self.colouring, self.height_slider.value)

    def show_summary(self, evaluation: Evaluation) -> None:
        """Show the most important figures of a placement."""
        self.summary.content = texts.summary(evaluation)

    def show_figures(self, evaluation: Evaluation, certificate: Certificate | None,
                     kept: Evaluation | None) -> None:
        """Show all figures of a placement; see :func:`.texts.all_figures`."""
        self.figures.content = texts.all_figures(evaluation, certificate, kept)

    def show_details(self, state: State, camera: int) -> None:
        """Show the values of a camera in its fields."""
        pose, rig_camera = state.poses[camera], state.rig.cameras[camera]
        self.position.value = tuple(pose[:3].round(4).tolist())
        self.angles.value = tuple(np.rad2deg(pose[3:]).round(3).tolist())
        self.locked_box.value = rig_camera.name in state.locked
        if rig_camera.sensor in SENSORS:
            self.sensor_list.value = rig_camera.sensor
        # viser sends a value to all clients but its sender, and nothing if it is unchanged: of two
        # clients that enter values at once, each would show that of the other.
        entered_fields, self._entered_fields = self._entered_fields, []
        if len(self.session.server.get_clients()) > 1:
            for field in entered_fields:
                if not hasattr(field, 'on_click'):
                    field._queue_update('value', field.value)
        # This colouring depends on the selected camera, which may be another one now.
        if self.colouring == texts.COLOURINGS.by_camera:
            self.colour_points()

    def show_nearest(self, pose: np.ndarray | None, is_violating: bool) -> None:
        """
        Offer the nearest allowed pose of the selected camera.

        :param pose: (6,) metres, map frame, and radians; None if there is none to offer.
        :param is_violating: whether the present pose of the camera violates a constraint.
        """
        self.nearest_button.visible = pose is not None
        self._nearest_pose = pose
        if is_violating and pose is None:
            self.show_message(
                'found no allowed pose of this camera in the room; expected one at least; '
                'change the mount, keep_clear or the zones of the rig')

    def show_rig(self, state: State) -> None:
        """Show the cameras and zones of the rig in the lists."""
        _set_choices(self.camera_list, state.names)
        _set_choices(self.zone_list, [entry.label for entry in zone_edits.entries_of(state.rig)]
                     or [NO_CHOICE])
        self._show_zone()

    def show_progress(self, progress: Progress) -> None:
        """Show a report of the present task."""
        self.progress_bar.value = 100.0 * min(progress.share, 1.0)
        self.progress_bar.visible = self.stop_button.visible = not progress.ended
        if progress.message:
            self._task_message.content = texts.message(progress.message)

    def _start_task(self, work: Work, seconds: float, message: str, field: viser.GuiHtmlHandle
                    ) -> None:
        """Start a task; show a message, and all later ones of this task, in a field."""
        self.session.start_task(work, seconds, self.show_progress)
        self._task_message = field
        self.show_progress(Progress(0.0, message))

    def _edit_camera(self, edit: Callable[..., Any], *values: Any) -> None:
        """Stop the task; call a function with the number of the selected camera and the values."""
        self.session.stop_task()
        edit(self.selected_camera, *values)

    def _set_sensor(self, sensor: str) -> None:
        """Give the selected camera another sensor."""
        self._edit_camera(self.studio.set_sensor, sensor)

    def _set_locked(self, locked: Any) -> None:
        """Lock the selected camera, or unlock it."""
        self._edit_camera(self.studio.set_locked, bool(locked))

    def _toggle_lock(self) -> None:
        """Lock the selected camera if it is not locked, otherwise unlock it."""
        state = self.studio.state
        self._set_locked(state.names[self.selected_camera] not in state.locked)

    def _set_typed_pose(self, _: Any) -> None:
        """Move the selected camera to the pose in the fields."""
        pose = np.concatenate([self.position.value, np.deg2rad(self.angles.value)])
        # An unchanged pose must not become a step that people can undo.
        if not np.allclose(pose, self.studio.state.poses[self.selected_camera], atol=1e-9):
            self._edit_camera(self.studio.move_camera, pose)

    def _move_to_nearest(self, _: Any) -> None:
        """Move the selected camera to the nearest allowed pose."""
        if self._nearest_pose is not None:
            self._edit_camera(self.studio.move_camera, self._nearest_pose)

    def _add_camera(self) -> None:
        """Add a camera with the sensor of the field, and select it."""
        self._add_and_select(self.sensor_list.value)

    def _copy_camera(self) -> None:
        """Add a camera like the selected one, half a metre beside it, and select the new one."""
        state, camera = self.studio.state, self.selected_camera
        pose = state.poses[camera] + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
        self._add_and_select(state.names[camera], pose)

    def _add_and_select(self, sensor: str, pose: np.ndarray | None = None) -> None:
        """Add a camera, and select it; see :meth:`.Studio.add_camera`."""
        self.session.stop_task()
        camera = self.studio.add_camera(sensor, pose)
        names = self.studio.state.names
        _set_choices(self.camera_list, names)
        self.camera_list.value = names[camera]

    def _remove_camera(self) -> None:
        """Remove the selected camera."""
        self._edit_camera(self.studio.remove_camera)

    def _undo(self) -> None:
        """Go back to the previous placement."""
        self.session.stop_task()
        if not self.studio.history.undo():
            self.show_message('nothing to undo')

    def _redo(self) -> None:
        """Go to the placement that was undone last."""
        self.session.stop_task()
        if not self.studio.history.redo():
            self.show_message('nothing to redo')

    def _set_colours(self, _: Any) -> None:
        """Colour the points as chosen, and show the legend."""
        self.legend.content = texts.legend(self.colouring)
        self.colour_points()
        if self.session.kept_evaluation is not None:
            self.compare(self.session.kept_evaluation)

    def _restore_kept(self) -> None:
        """Make the kept placement the present one."""
        if self.session.kept_evaluation is not None:
            state = self.session.kept_evaluation.state
            self.session.stop_task()
            self.studio.set_placement(state.rig, state.poses, state.locked)

    @property
    def _selected_entry(self) -> zone_edits.Entry | None:
        """Return the selected zone."""
        return next((entry for entry in zone_edits.entries_of(self.studio.state.rig)
                     if entry.label == self.zone_list.value), None)

    def _show_zone(self) -> None:
        """Show the values of the selected zone in the fields, and hide all other fields."""
        entry = self._selected_entry
        is_box = entry is not None and entry.is_box
        is_region = entry is not None and entry.key == 'regions'
        # Values first: a field that can be seen holds what it shows.
        if is_box:
            low, high = zone_edits.box_data(*entry.data['box'])
            self.low_corner.value, self.high_corner.value = tuple(low), tuple(high)
        if is_region:
            region = self.studio.state.rig.regions[entry.number]
            self.zone_name.value = entry.data['name']
            self.weight.value, self.must_see.value = region.weight, region.must_see
        self.low_corner.visible = self.high_corner.visible = is_box
        self.zone_name.visible = self.weight.visible = self.must_see.visible = is_region
        self.remove_zone_button.visible = entry is not None

    def _edit_zone(self, **new_values: Any) -> None:
        """Change values of the selected zone, and select it again, since its name may be new."""
        if (entry := self._selected_entry) is not None:
            self.session.edit_rig(
                **zone_edits.changed_entry(self.studio.state.rig, entry, **new_values))
            self._select_zone(entry.key, entry.number)

    def _edit_region(self, **new_values: Any) -> None:
        """Change values of the selected zone if it is a region."""
        entry = self._selected_entry
        if entry is not None and entry.key == 'regions':
            self._edit_zone(**new_values)

    def _add_zone(self, kind: str) -> None:
        """Add a box in the middle of the room, and select it; one of :data:`.zone_edits.KEYS`."""
        key, studio = zone_edits.KEYS[kind], self.studio
        floor = self.session.evaluation.problem.region.floor
        self.session.edit_rig(**zone_edits.added_box(studio.state.rig, key, studio.scene, floor))
        self._select_zone(key, len(studio.state.rig.document.data[key]) - 1)

    def _remove_zone(self, _: Any) -> None:
        """Remove the selected zone."""
        if (entry := self._selected_entry) is not None:
            self.session.edit_rig(**zone_edits.removed_entry(self.studio.state.rig, entry))

    def _select_zone(self, key: str, number: int) -> None:
        """Select the zone with this key of a list and this index in the list."""
        entries = list(zone_edits.entries_of(self.studio.state.rig))
        _set_choices(self.zone_list, [entry.label for entry in entries])
        self.zone_list.value = next(entry.label for entry in entries
                                    if (entry.key, entry.number) == (key, number))
        self._show_zone()

    def _search(self, _: Any) -> None:
        """Search for better poses."""
        # In this order, NaN is the least duration.
        seconds = min(max(MIN_SECONDS, float(self.seconds.value)), MAX_SECONDS)
        self._start_task(search_work(self.studio, self.studio.state), seconds, 'searching',
                         self.search_message)

    def _stop_search(self) -> None:
        """Stop the task at its next step; what it has found stays."""
        task = self.session.task
        if task is not None:
            task.stop()

    def _search_addition(self, _: Any) -> None:
        """Search for the best pose of one more camera, and add this camera."""
        def add(name: str, pose: np.ndarray) -> None:
            self.session.enqueue(partial(self.studio.add_camera, name, pose))
        self._start_task(addition_work(self.session.evaluation, add), MAX_SECONDS, 'searching',
                         self.search_message)

    def _select_least_useful(self, _: Any) -> None:
        """Select the camera whose removal leaves the least objective value; show this value."""
        evaluation = self.session.evaluation
        camera, loss = find_least_useful(evaluation)
        name = evaluation.state.names[camera]
        self.select_camera(name)
        self.search_message.content = texts.message(
            f'without {name} the objective value is {loss:.4f} in place of '
            f'{evaluation.rig_evaluation.loss:.4f}: the least loss of all cameras; it is selected')

    def _save(self, kind: str) -> None:
        """Save the placement or the rig: ``Placement`` or ``Rig``."""
        folder, name = self.session.folder, self.file_name.value
        path = (folder.save_placement(name, self.studio.placement(scored=True))
                if kind == 'Placement' else folder.save_rig(name, self.studio.state.rig))
        self._list_files(path.name)
        self.file_message.content = texts.message(f'wrote {path.name}')

    def _load(self, _: Any) -> None:
        """Load the selected file."""
        name = self.file_list.value
        rig, poses = self.session.folder.load(name, self.studio.scene)
        self.session.stop_task()
        self.studio.replace_rig(rig, poses)
        self.file_name.value = name.rpartition('.')[0]
        self.file_message.content = texts.message(f'loaded {name}')

    def _export(self, _: Any) -> None:
        """Write all files of the placement in the background."""
        name, placement = self.file_name.value, self.studio.placement(scored=True)

        def work(_: Any) -> Any:
            files = self.session.folder.export(name, self.studio.scene, placement,
                                               self.studio.command)
            yield Progress(1.0, f'wrote {len(files)} files to {name}: {", ".join(files)}')
        self._start_task(work, MAX_SECONDS, 'writing all files', self.file_message)

    def _list_files(self, selected_name: str = '') -> None:
        """List the files of the folder, and select one by its name; empty to keep the choice."""
        _set_choices(self.file_list, self.session.folder.file_names() or [NO_CHOICE])
        if selected_name:
            self.file_list.value = selected_name


def _set_choices(dropdown: Any, choices: list[str]) -> None:
    """Set the choices of a list; if its value is no longer a choice, select the first one."""
    if not choices:
        raise ConfigurationError('list: found no choice; expected one at least; add one')
    if tuple(choices) != tuple(dropdown.options):
        value = dropdown.value
        dropdown.options = choices
        dropdown.value = value if value in choices else choices[0]
