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

"""Register the cameras of a placement to the scan, and write the placement as built."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
import logging
from typing import Any

import numpy as np
from ocp_ros.geometry.cameras import (
    heading_of,
    OPTICAL_TO_BODY,
    Pose,
    rotation_matrix,
    TO_BODY,
)
from ocp_ros.registration.camera_registration import register, registered_nearby, Registration
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.rig.placement_file import ANGLES, created_by, FIXED, Placed, Placement
from ocp_ros.rig.rig_file import Rig, rig_from
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.yaml_files import Document

OPENGL = ('its cloud has x right, y up and z backward, as the RealSense Viewer writes it '
          '(--cloud-frame opengl)')
#: How a camera may differ from the placement: a description, a roll about the viewing direction in
#: radians, and a rotation (3, 3) from the axes of the cloud to those of the body.
OTHER_SETUPS = (
    ('it is mounted upside down', np.pi, np.eye(3)),
    ('it is mounted on its side', 0.5 * np.pi, np.eye(3)),
    ('it is mounted on its other side', -0.5 * np.pi, np.eye(3)),
    ('its cloud has optical axes (--cloud-frame optical)', 0.0, OPTICAL_TO_BODY),
    ('its cloud has the axes of the body (--cloud-frame body)', 0.0, OPTICAL_TO_BODY.T),
    # Of files that are read as optical, and of files that are read as body.
    (OPENGL, 0.0, TO_BODY['opengl'] @ OPTICAL_TO_BODY.T),
    (OPENGL, 0.0, TO_BODY['opengl']))
#: The largest number of cameras whose clouds are tried at the poses of each other.
MAX_EXCHANGED = 8


_log = logging.getLogger(__name__)


def calibrate(scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray]
              ) -> tuple[dict[str, Registration], dict[str, str]]:
    """
    Register each camera that has a cloud, starting at its pose in the placement.

    :param scan: the scan of the room, in the frame of the placement.
    :param placement: the planned or measured placement.
    :param clouds: the clouds (N, 3), metres, body frame, by the camera's name.
    :returns: the registrations, and for unusable clouds the reasons, both by the camera's name.
    """
    registrations, reasons = _for_each_camera(_register_camera, scan, placement, clouds)
    return _with_other_setups(scan, placement, clouds, registrations), reasons


def _for_each_camera(register_camera: Callable[[ScanSurfaces, np.ndarray, Placed], Registration],
                     scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray]
                     ) -> tuple[dict[str, Registration], dict[str, str]]:
    """Call a function for each camera that has a cloud; see :func:`calibrate` for the rest."""
    registrations, reasons = {}, {}
    for placed in [one for one in placement.cameras if one.camera.name in clouds]:
        name = placed.camera.name
        try:
            registrations[name] = register_camera(scan, clouds[name], placed)
        except SceneError as error:
            reasons[name] = str(error)
        except Exception as error:  # The other cameras keep their results.
            _log.exception('the registration of a camera failed')
            reasons[name] = (f'{name}: found an error ({type(error).__name__}: {error}); expected '
                             'a registration; send the cloud and this message to the authors')
    return registrations, reasons


def _register_camera(scan: ScanSurfaces, cloud: np.ndarray, placed: Placed) -> Registration:
    """
    Register a camera as the placement describes it.

    :param cloud: (N, 3) metres, body frame.
    :raises SceneError: if the cloud cannot be used.
    """
    model = placed.camera.model
    view = LiveView(cloud, model, placed.camera.name)
    return register(scan, view, Pose.of(placed.pose), model)


def _with_other_setups(scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray],
                       registrations: Mapping[str, Registration]) -> dict[str, Registration]:
    """
    Register cameras whose clouds do not match the scan with other clouds, mountings and axes.

    :returns: the registrations, with those that fit otherwise in place of those that do not match.
    """
    found = dict(registrations)
    mismatched = [placed for placed in placement.cameras if placed.camera.name in found
                  and found[placed.camera.name].mismatched]
    for placed in mismatched:
        start, name, model = Pose.of(placed.pose), placed.camera.name, placed.camera.model
        attempts = [(clouds[name], *setup) for setup in OTHER_SETUPS]
        if len(mismatched) <= MAX_EXCHANGED:
            others = [other.camera.name for other in mismatched if other is not placed]
            attempts = [(clouds[other], f'the cloud given for {other} is its own', 0.0, np.eye(3))
                        for other in others] + attempts
        for cloud, description, roll, axes in attempts:
            points = cloud @ axes.T
            # Most cameras see nothing behind them, so that these axes are wrong.
            if model.horizontal_fov < np.pi and (
                    np.count_nonzero(points[:, 0] < 0.0) > 0.1 * np.count_nonzero(
                        points[:, 0] > 0.0)):
                continue
            with suppress(SceneError):
                rolled = Pose(start.position, start.rotation @ rotation_matrix(roll=roll))
                other = register(scan, LiveView(points, model, name), rolled, model)
                if not other.refused:
                    found[name] = other._replace(actual_setup=description)
                    break
    return found


def drift(scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray]) -> list[str]:
    """
    Return a sentence for each camera that has moved since it was calibrated.

    A camera whose cloud is unusable or does not match the scan gets a sentence too.
    Only certain displacements are reported: a camera that the scan does not constrain may not have
    moved.

    :param scan: the scan of the room, in the frame of the placement.
    :param placement: the placement as built.
    :param clouds: the clouds (N, 3), metres, body frame, by the camera's name.
    """
    registrations, reasons = _for_each_camera(_register_nearby, scan, placement, clouds)
    sentences = list(reasons.values())
    poses = {placed.camera.name: Pose.of(placed.pose) for placed in placement.cameras}
    for name, registration in registrations.items():
        metres, radians = registration.pose.away_from(poses[name])
        degrees = float(np.rad2deg(radians))
        if registration.mismatched:
            sentences.append(f'{name} no longer fits the scan: {registration.refused}')
        # More than 2 cm or 1 degree, and three times the largest expected deviation, the first.
        elif (metres > max(0.02, 3.0 * registration.certainty.metres[0])
              or degrees > max(1.0, 3.0 * registration.certainty.degrees[0])):
            sentences.append(
                f'{name} hangs {metres:.3f} m and {degrees:.1f} degrees from where it is said to '
                'be; expected it there; call ~/calibrate, or put it back')
    return sentences


def _register_nearby(scan: ScanSurfaces, cloud: np.ndarray, placed: Placed) -> Registration:
    """Register a camera that has hardly moved; see :func:`_register_camera`."""
    model = placed.camera.model
    view = LiveView(cloud, model, placed.camera.name)
    return registered_nearby(scan, view, Pose.of(placed.pose), model)


def as_built(placement: Placement, found: Mapping[str, Registration], command: str) -> Placement:
    """
    Return a placement with the cameras at the registered poses; others keep theirs.

    :param placement: the planned or measured placement.
    :param found: the registrations by the camera's name, see :func:`calibrate`.
    :param command: the command line, for the record.
    """
    cameras = tuple(_at_registered_pose(placed, found) for placed in placement.cameras)
    rig = placement.rig and _with_fixed_poses(placement.rig, [
        placed for placed in cameras if placed.mount == FIXED])
    calibrated = [name for name, registration in found.items() if not registration.refused]
    created = {**created_by(command, placement.created.get('planner', '')),
               'calibrated': ', '.join(calibrated)}
    # The scores of the plan do not hold for measured poses. A camera at a measured pose keeps its
    # planned pose in ``planned``; for others this is None.
    scores = {} if any(placed.planned for placed in cameras) else placement.scores
    return replace(placement, cameras=cameras, rig=rig, scores=scores, created=created,
                   document=None, key_paths=())


def answer_of(placed: Placed, found: Registration) -> dict[str, Any]:
    """Return the registration of a camera as plain data for JSON, without a pose if refused."""
    certainty = found.certainty
    row = {'camera': placed.camera.name, 'refused': found.refused,
           'residual': found.residual, 'overlap': found.overlap, 'violated': found.violated_share,
           'loose': certainty.loose_motions, 'otherwise': found.actual_setup,
           'note': found.note,
           'deviations': [
               *({'along': axis.tolist(), 'metres': float(value)}
                 for axis, value in zip(certainty.slide_axes, certainty.metres)),
               *({'about': axis.tolist(), 'degrees': float(value)}
                 for axis, value in zip(certainty.turn_axes, certainty.degrees))]}
    if not found.refused:
        metres, radians = found.pose.away_from(Pose.of(placed.pose))
        row |= {'position': found.pose.position.round(4).tolist(),
                **dict(zip(ANGLES, np.rad2deg(heading_of(found.pose.rotation)).round(3).tolist())),
                'moved_metres': metres, 'moved_degrees': float(np.rad2deg(radians))}
    return row


def _at_registered_pose(placed: Placed, found: Mapping[str, Registration]) -> Placed:
    """Return a camera at its registered pose; unchanged without a usable registration."""
    registration = found.get(placed.camera.name)
    if registration is None or registration.refused:
        return placed
    pose = registration.pose
    return placed.at_measured_pose(np.concatenate([pose.position, heading_of(pose.rotation)]))


def _with_fixed_poses(rig: Rig, fixed: list[Placed]) -> Rig:
    """
    Return a rig whose fixed cameras are at registered poses; unchanged if none was registered.

    :param fixed: the fixed cameras, in the order of the rig file.
    """
    # ``planned`` is None for cameras without a measured pose, see :func:`as_built`.
    if not any(placed.planned for placed in fixed):
        return rig
    # The rig is read again from a changed copy of its document.
    data = deepcopy(rig.document.data)
    for entry, placed in zip(data['fixed'], fixed, strict=True):
        entry |= {'position': list(placed.position), **dict(zip(ANGLES, placed.angles))}
    return rig_from(Document(rig.document.name, data))
