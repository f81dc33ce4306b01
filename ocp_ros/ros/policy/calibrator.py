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
Register the clouds of live cameras to a scan, for their poses and later for their drift.

Registration takes seconds: it runs in a separate thread, one job at a time, and turns continue.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import time

import numpy as np
from ocp_ros.geometry.cameras import heading_of
from ocp_ros.registration.calibration import as_built, calibrate, drift
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.rig.placement_file import Placed, Placement, placement_of, save_placement
from ocp_ros.rig.rig_file import Camera
from ocp_ros.ros.interface.conversions import MessageError, shortened
from ocp_ros.ros.interface.frames import LiveRig, Sighting
from ocp_ros.ros.policy.decider import Decider
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.util.settings import ConfigurationError, UserError
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger


class Calibrator:
    """
    Register live cameras to a scan on request, and check their drift at intervals if configured.

    :param node: gets the service and a timer.
    :param config: of the node, with ``scan``.
    :param decider: has the rig of the rig file, or without one the camera models.
    :param sighted: returns the newest cloud of each camera.
    :param final: returns whether the placement is final.
    :raises ConfigurationError: if the file of the scan does not exist.
    """

    def __init__(self, node: Node, config: PolicyNodeConfig, decider: Decider,
                 sighted: Callable[[], Sighting], final: Callable[[], bool]) -> None:
        if not Path(config.scan).is_file():
            raise ConfigurationError(f'scan: found no file {config.scan!r}; expected a scan of '
                                     'the room; correct the path, or leave it empty')
        self._node = node
        self._config = config
        self._decider = decider
        self._sighted, self._final = sighted, final
        self._worker = ThreadPoolExecutor(1, thread_name_prefix='calibrator')
        self._scan: ScanSurfaces | None = None
        self._busy = False
        self._checked_at = time.monotonic()
        #: A sentence for each camera that had drifted at the last check.
        self.drifted: list[str] = []
        self.checks = 0
        node.create_service(Trigger, '~/calibrate', self._on_calibrate)
        node.create_timer(1.0, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def change(self, config: PolicyNodeConfig) -> None:
        """Continue with other parameters."""
        self._config = config
        if not config.drift_seconds:
            self.drifted = []

    def close(self) -> None:
        """Start no more jobs; drop the waiting ones."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    async def _on_calibrate(self, request: Trigger.Request, response: Trigger.Response
                            ) -> Trigger.Response:
        """Register the newest clouds, and answer with a line for each camera."""
        if self._busy:
            response.message = 'busy with another registration; call it again'
            return response
        try:
            sighting = self._sighted()
            placement = self._placement(sighting.rig)
        except MessageError as error:
            response.message = shortened(error)
            return response
        response.success, response.message = await self._begun(
            lambda: self._calibrated(placement, sighting.clouds))
        return response

    def _on_tick(self) -> None:
        """Start a drift check if one is due."""
        due = self._config.drift_seconds
        if not due or self._busy or not self._final() or \
                time.monotonic() - self._checked_at < due:
            return
        self._checked_at = time.monotonic()
        try:
            sighting = self._sighted()
            placement = self._placement(sighting.rig)
        except MessageError:
            return
        self._begun(lambda: self._drift(placement, sighting.clouds))

    def _begun(self, job: Callable[[], tuple[bool, str]]) -> Future:
        """Run a job in the thread; the future holds whether it succeeded, and a message."""
        done, self._busy = Future(executor=self._node.executor), True

        def run() -> None:
            try:
                result = job()
            except (UserError, OSError) as error:
                result = False, shortened(error)
            except Exception as error:
                # No error that a scan or a cloud causes in the registration may end this node.
                result = False, f'found {type(error).__name__}: {shortened(error)}'
            self._busy = False
            if not result[0]:
                self._node.get_logger().warning(f'registration: {result[1]}')
            done.set_result(result)

        self._worker.submit(run)
        return done

    def _surfaces(self) -> ScanSurfaces:
        """Return the surfaces of the scan; read the scan once."""
        if self._scan is None:
            self._scan = ScanSurfaces(load_scene(self._config.scan))
        return self._scan

    def _placement(self, rig: LiveRig) -> Placement:
        """Return the placement with the reported poses of the cameras."""
        poses = np.array([[*pose.position, *heading_of(pose.rotation)] for pose in rig.poses])
        known, models = self._decider.rig, self._decider.models
        if known is not None and len(poses) >= len(known.cameras):
            return placement_of(known, poses[:len(known.cameras)], frame=rig.frame)
        return Placement(tuple(
            Placed(Camera(f'camera_{number}', '', models[min(number, len(models) - 1)]),
                   tuple(pose[:3].tolist()), tuple(np.rad2deg(pose[3:]).tolist()), 'free')
            for number, pose in enumerate(poses)), frame=rig.frame)

    def _calibrated(self, placement: Placement, clouds: Mapping[int, np.ndarray]
                    ) -> tuple[bool, str]:
        """Register the cameras, and write their registered poses to a file."""
        found, broken = calibrate(self._surfaces(), placement, _by_name(placement, clouds))
        lines = []
        for placed in placement.cameras:
            name = placed.camera.name
            if name not in found or found[name].refused:
                why = found[name].refused if name in found else broken.get(name, 'it has no cloud')
                lines.append(f'{name}: refused: {why}')
                continue
            away = found[name].pose.position - placed.position
            lines.append(f'{name}: {np.linalg.norm(away):.3f} m from where it was said to be, '
                         f'expected within {1000.0 * found[name].certainty.metres[0]:.0f} mm')
        built = as_built(placement, found, 'policy_node')
        given = any(not one.refused for one in found.values())
        if given and self._config.placement_file:
            path = Path(self._config.placement_file)
            path = path.with_name(f'{path.stem}_as_built{path.suffix}')
            save_placement(path, built)
            lines.append(f'wrote {path}')
        return given, '\n'.join(lines)

    def _drift(self, placement: Placement, clouds: Mapping[int, np.ndarray]) -> tuple[bool, str]:
        """Find the cameras whose registered pose differs from their reported pose."""
        self.drifted = drift(self._surfaces(), placement, _by_name(placement, clouds))
        self.checks += 1
        return not self.drifted, '; '.join(self.drifted)

    def status(self) -> tuple[str, dict[str, object]]:
        """Return a warning, empty if all is well, and values to show."""
        return '; '.join(self.drifted), {'drift_checks': self.checks}


def _by_name(placement: Placement, clouds: Mapping[int, np.ndarray]) -> dict[str, np.ndarray]:
    """Return clouds by the names of their cameras."""
    return {placement.cameras[number].camera.name: cloud for number, cloud in clouds.items()
            if number < len(placement.cameras)}
