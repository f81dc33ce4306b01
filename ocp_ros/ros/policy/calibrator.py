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

"""
Register the clouds of live cameras to a scan or to each other, and find out which move later.

Registration takes seconds: it runs in a separate thread, one job at a time, and turns continue.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import json
from pathlib import Path
import time
from typing import Any, TYPE_CHECKING

import numpy as np
from ocp_ros.geometry.cameras import heading_of, Pose
from ocp_ros.registration.calibration import (
    as_built,
    calibrate,
    calibrate_mutually,
    drift,
    pose_data,
    views_of,
)
from ocp_ros.registration.camera_registration import differ
from ocp_ros.registration.movement import (
    load_references,
    MOVED,
    movements_since,
    REFERENCES,
    save_references,
    sentence_of,
    still_cloud,
)
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.rig.placement_file import Placement, save_placement
from ocp_ros.ros.interface.conversions import MessageError, shortened
from ocp_ros.ros.policy.live_turns import LiveTurns
from ocp_ros.ros.runtime.managed_node import create_steady_timer
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.util.settings import ConfigurationError, UserError
from rclpy.task import Future
from std_srvs.srv import Trigger

if TYPE_CHECKING:
    from ocp_ros.ros.policy_node import PolicyNode


class Calibrator:
    """
    Register live cameras on request, and check at intervals whether they move, if configured.

    Movements are checked only when the placement is final: each camera is compared with its
    reference, and with the scan, if there is one. The reference is what it saw when it was
    calibrated, or at the first check since it is said to be where it is. References are kept
    beside the placement file, if there is one, so that they outlive the node.

    :param node: gets the service and a timer; its parameter ``scan`` names the scan or is empty.
    :param source: has the newest clouds.
    :raises ConfigurationError: if the file of the scan does not exist, or that of the references
        cannot be read.
    """

    def __init__(self, node: 'PolicyNode', source: LiveTurns) -> None:
        scan = node.config.scan
        if scan and not Path(scan).is_file():
            raise ConfigurationError(f'scan: found no file {scan!r}; expected a scan of the room; '
                                     'correct the path, or leave it empty')
        self._node = node
        self._source = source
        self._worker = ThreadPoolExecutor(1, thread_name_prefix='calibrator')
        self._surfaces: ScanSurfaces | None = None
        self._job_runs = False
        #: Time of the last drift check, or of the start, by a steady clock.
        self._check_time = time.monotonic()
        file = node.config.placement_file
        self._reference_file = Path(file).with_name(REFERENCES) if file else None
        #: The references: clouds (N, 3), metres, body frame, and the poses there, by name.
        self._references: dict[str, np.ndarray] = {}
        self._reference_poses: dict[str, Pose] = {}
        if self._reference_file and self._reference_file.exists():
            clouds, self._reference_poses = load_references(self._reference_file)
            self._references = {name: cloud for name, cloud in clouds.items()
                                if name in self._reference_poses}
        #: A sentence for each camera that had drifted at the last check.
        self.drift_warnings: list[str] = []
        #: The present poses of cameras that had moved at the last check, as plain data, by name.
        self.moved_cameras: dict[str, dict[str, Any]] = {}
        self.drift_checks = 0
        node.create_service(Trigger, '~/calibrate', self._on_calibrate)
        create_steady_timer(node, 1.0, self._check_drift)

    def close(self) -> None:
        """Let the present job end, and start no more jobs."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    async def _on_calibrate(self, request: Trigger.Request, response: Trigger.Response
                            ) -> Trigger.Response:
        """Register the newest clouds, and respond with a line for each camera."""
        if self._job_runs:
            response.message = 'busy with another registration; call it again'
            return response
        try:
            placement, clouds = self._placement_and_clouds()
        except MessageError as error:
            response.message = shortened(error)
            return response
        response.success, response.message = await self._start_job(
            lambda: self._calibrate(placement, clouds))
        return response

    def _check_drift(self) -> None:
        """Start a drift check if one is due."""
        interval = self._node.config.drift_seconds
        if not interval:
            self.drift_warnings, self.moved_cameras = [], {}
        if not interval or self._job_runs or not self._node.convergence.is_final or \
                time.monotonic() - self._check_time < interval:
            return
        self._check_time = time.monotonic()
        try:
            placement, clouds = self._placement_and_clouds()
        except MessageError:
            return
        self._start_job(lambda: self._find_drift(placement, clouds))

    def _start_job(self, job: Callable[[], tuple[bool, str]]) -> Future:
        """
        Run a job in the thread.

        :param job: returns whether it succeeded, and a message.
        :returns: a future with the result of the job.
        """
        future = Future(executor=self._node.executor)
        self._job_runs = True

        def run() -> None:
            try:
                result = job()
            except (UserError, OSError) as error:
                result = False, shortened(error)
            except Exception as error:
                # Without a result, the caller would wait for ever and no other job could start.
                result = False, f'found {type(error).__name__}: {shortened(error)}'
            self._job_runs = False
            if not result[0]:
                self._node.get_logger().warning(f'registration: {result[1]}')
            future.set_result(result)

        self._worker.submit(run)
        return future

    def _scan_surfaces(self) -> ScanSurfaces:
        """Return the surfaces of the scan; read the scan once."""
        if self._surfaces is None:
            self._surfaces = ScanSurfaces(load_scene(self._node.config.scan))
        return self._surfaces

    def _placement_and_clouds(self) -> tuple[Placement, dict[str, Sequence[np.ndarray]]]:
        """Return the placement as reported, and the newest frames by the names of the cameras."""
        rig, clouds = self._source.latest_clouds()
        poses = np.array([[*pose.position, *heading_of(pose.rotation)] for pose in rig.poses])
        placement = self._node.decider.placement(poses, rig.frame)
        # Cameras that are not in the rig file are left out.
        return placement, {placement.cameras[number].camera.name: cloud for number, cloud
                           in clouds.items() if number < len(placement.cameras)}

    def _calibrate(self, placement: Placement, frames: Mapping[str, Sequence[np.ndarray]]
                   ) -> tuple[bool, str]:
        """
        Register the cameras, and write their registered poses beside the placement file, if any.

        :param frames: by the name of the camera: clouds, each (N, 3) metres, body frame.
        :returns: whether any camera was registered, and a line of text for each camera.
        """
        clouds, moving = _still_clouds(frames)
        registrations, unusable_clouds = (
            calibrate(self._scan_surfaces(), placement, clouds) if self._node.config.scan
            else calibrate_mutually(placement, clouds))
        unusable_clouds |= moving
        self._references = {}
        lines = []
        for placed in placement.cameras:
            name = placed.camera.name
            registration = registrations.get(name)
            if registration is None:
                lines.append(f'{name}: refused: {unusable_clouds.get(name, "it has no cloud")}')
            elif registration.refused:
                lines.append(f'{name}: refused: {registration.refused}')
            else:
                # ``certainty.metres`` begins with the largest expected deviation.
                distance = np.linalg.norm(registration.pose.position - placed.position)
                lines.append(f'{name}: {distance:.3f} m from where it was said to be, expected '
                             f'within {1000.0 * registration.certainty.metres[0]:.0f} mm')
                lines += [f'{name}: {text}' for text in (
                    registration.note, registration.actual_setup) if text]
        built = as_built(placement, registrations, 'policy_node')
        any_registered = any(not registration.refused for registration in registrations.values())
        if any_registered and self._node.config.placement_file:
            path = Path(self._node.config.placement_file)
            path = path.with_name(f'{path.stem}_as_built{path.suffix}')
            save_placement(path, built)
            lines.append(f'wrote {path}, and {REFERENCES} beside it')
        # A cloud that is not the camera's own, or has other axes, is no reference for it.
        self._keep_references({
            name: clouds[name] for name, one in registrations.items()
            if not (one.refused or one.actual_setup)}, built.pose_by_name)
        return any_registered, '\n'.join(lines)

    def _find_drift(self, placement: Placement, frames: Mapping[str, Sequence[np.ndarray]]
                    ) -> tuple[bool, str]:
        """Find cameras that have drifted; return True for none, and a text about those found."""
        clouds, moving = _still_clouds(frames)
        warnings = drift(self._scan_surfaces(), placement, clouds) if self._node.config.scan \
            else []
        poses = placement.pose_by_name
        models = {placed.camera.name: placed.camera.model for placed in placement.cameras}
        views, reasons = views_of(clouds, models)
        warnings += [*reasons.values(), *moving.values()]
        # A camera that is said to be elsewhere than its reference has a new one.
        limits = MOVED[0], np.deg2rad(MOVED[1])
        new = {name: clouds[name] for name in views if name not in self._references
               or differ(poses[name], self._reference_poses[name], limits)}
        references, _ = views_of({**self._references, **new}, models)
        moved = {name: movement for name, movement
                 in movements_since(references, views, poses).items() if movement.has_moved}
        warnings += [sentence_of(name, one, poses[name]) for name, one in moved.items()]
        self.drift_warnings = list(dict.fromkeys(warnings))
        self.moved_cameras = {name: pose_data(one.pose_now(poses[name]))
                              for name, one in moved.items() if not one.is_lost}
        self.drift_checks += 1
        if new:
            self._keep_references(new, poses)
        return not self.drift_warnings, '; '.join(self.drift_warnings)

    def _keep_references(self, clouds: Mapping[str, np.ndarray], poses: Mapping[str, Pose]
                         ) -> None:
        """Keep the clouds (N, 3) of cameras at poses as references, by name, also in the file."""
        self._references |= clouds
        self._reference_poses |= {name: poses[name] for name in clouds}
        if self._reference_file:
            save_references(self._reference_file, self._references, self._reference_poses)

    def status(self) -> tuple[str, dict[str, object]]:
        """Return the drift warnings as text (empty if there are none), and values to show."""
        return '; '.join(self.drift_warnings), {
            'drift_checks': self.drift_checks, 'moved_cameras': json.dumps(self.moved_cameras)}


def _still_clouds(frames: Mapping[str, Sequence[np.ndarray]]
                  ) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """
    Return what most clouds of each camera show, (N, 3) metres, body frame, by name.

    :returns: also the reasons why cameras have none, as they moved meanwhile, by name.
    """
    clouds, reasons = {}, {}
    for name, taken in frames.items():
        try:
            clouds[name] = still_cloud(name, dict(enumerate(taken, 1)))
        except ConfigurationError as error:
            reasons[name] = str(error)
    return clouds, reasons
