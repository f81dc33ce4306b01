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

from collections.abc import Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
from ocp_ros.geometry.cameras import heading_of, OPTICAL_TO_BODY, Pose, rotation_matrix
from ocp_ros.registration.camera_registration import checked, register, Registration
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.rig.placement_file import ANGLES, created_by, FIXED, Placed, Placement
from ocp_ros.rig.rig_file import Rig, rig_from
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.yaml_files import Document

#: Alternatives to try: a description, a roll in radians about the viewing direction, and the axes
#: of the cloud.
ALTERNATIVES = (
    ('it is mounted upside down', np.pi, np.eye(3)),
    ('it is mounted on its side', 0.5 * np.pi, np.eye(3)),
    ('it is mounted on its other side', -0.5 * np.pi, np.eye(3)),
    ('its cloud has optical axes (--cloud-frame optical)', 0.0, OPTICAL_TO_BODY),
    ('its cloud has the axes of the body (--cloud-frame body)', 0.0, OPTICAL_TO_BODY.T))


def calibrate(scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray]
              ) -> tuple[dict[str, Registration], dict[str, str]]:
    """
    Register each camera that has a cloud, starting at its pose in the placement.

    :param scan: the scan of the room, in the frame of the placement.
    :param placement: the planned or measured placement.
    :param clouds: the clouds (N, 3), metres, body frame, by the camera's name.
    :returns: the registrations, and for unusable clouds the reasons, both by the camera's name.
    """
    found, broken = {}, {}
    for placed in placement.cameras:
        name = placed.camera.name
        if name in clouds:
            try:
                found[name] = _registered(scan, clouds[name], placed)
            except SceneError as error:
                broken[name] = str(error)
    return found, broken


def _registered(scan: ScanSurfaces, cloud: np.ndarray, placed: Placed) -> Registration:
    """
    Register a camera; if its cloud does not match the scan, try other mountings.

    :raises SceneError: if its cloud cannot be used.
    """
    start, model, name = Pose.of(placed.pose), placed.camera.model, placed.camera.name
    first = register(scan, LiveView(cloud, model, name), start, model)
    if not first.unlike:
        return first
    for said, roll, axes in ALTERNATIVES:
        with suppress(SceneError):
            turned = Pose(start.position, start.rotation @ rotation_matrix(roll=roll))
            answer = register(scan, LiveView(cloud @ axes.T, model, name), turned, model)
            if not answer.refused:
                return answer._replace(otherwise=said)
    return first


def drift(scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray]
          ) -> list[str]:
    """
    Return which cameras no longer fit the scan at their poses, one sentence each.

    Only certain displacements are reported: a camera that the scan does not constrain may not have
    moved.
    """
    moved = []
    for placed in placement.cameras:
        name, start = placed.camera.name, Pose.of(placed.pose)
        if name not in clouds:
            continue
        try:
            view = LiveView(clouds[name], placed.camera.model, name)
        except SceneError as error:
            moved.append(str(error))
            continue
        found = checked(scan, view, start, placed.camera.model)
        away, turn = found.pose.away_from(start)
        turn = float(np.rad2deg(turn))
        if found.unlike:
            moved.append(f'{name} no longer fits the scan: {found.refused}')
        # More than 2 cm or 1 degree, and three times the expected deviation.
        elif (away > max(0.02, 3.0 * found.certainty.metres[0])
              or turn > max(1.0, 3.0 * found.certainty.degrees[0])):
            moved.append(f'{name} hangs {away:.3f} m and {turn:.1f} degrees from where it is said '
                         'to be; expected it there; call ~/calibrate, or put it back')
    return moved


def as_built(placement: Placement, found: Mapping[str, Registration], command: str) -> Placement:
    """
    Return a placement with the cameras at the registered poses; refused ones keep theirs.

    :param command: the command line, for the record.
    """
    cameras = tuple(_found(placed, found) for placed in placement.cameras)
    rig = placement.rig and _with_fixed(placement.rig, [
        placed for placed in cameras if placed.mount == FIXED])
    created = {**created_by(command, placement.created.get('planner', '')),
               'calibrated': ', '.join(name for name, one in found.items() if not one.refused)}
    # The scores of the plan do not hold for the placement as built.
    scores = {} if any(placed.planned for placed in cameras) else placement.scores
    return replace(placement, cameras=cameras, rig=rig, scores=scores, created=created,
                   document=None, ways=())


def answer_of(placed: Placed, found: Registration) -> dict[str, Any]:
    """Return the registration of a camera as plain data."""
    held, start = found.certainty, Pose.of(placed.pose)
    row = {'camera': placed.camera.name, 'refused': found.refused,
           'residual': found.residual, 'overlap': found.overlap, 'violated': found.violated,
           'loose': held.loose, 'otherwise': found.otherwise,
           'deviations': [
               *({'along': axis.tolist(), 'metres': float(value)}
                 for axis, value in zip(held.along, held.metres)),
               *({'about': axis.tolist(), 'degrees': float(value)}
                 for axis, value in zip(held.about, held.degrees))]}
    if not found.refused:
        away, turn = found.pose.away_from(start)
        row |= {'position': found.pose.position.round(4).tolist(),
                **dict(zip(ANGLES, np.rad2deg(heading_of(found.pose.rotation)).round(3).tolist())),
                'moved_metres': away, 'moved_degrees': float(np.rad2deg(turn))}
    return row


def _found(placed: Placed, found: Mapping[str, Registration]) -> Placed:
    """Return a camera at its registered pose, if it has one."""
    one = found.get(placed.camera.name)
    if one is None or one.refused:
        return placed
    return placed.found_at(np.concatenate([one.pose.position, heading_of(one.pose.rotation)]))


def _with_fixed(rig: Rig, placed: list[Placed]) -> Rig:
    """Return a rig with the cameras in place at their registered poses."""
    if not any(one.planned for one in placed):
        return rig
    data = deepcopy(rig.document.data)
    for entry, one in zip(data['fixed'], placed, strict=True):
        entry |= {'position': list(one.position), **dict(zip(ANGLES, one.angles))}
    return rig_from(Document(rig.document.name, data))
