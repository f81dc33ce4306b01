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
from functools import partial
from itertools import combinations
import logging
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import (
    CameraModel,
    heading_of,
    OPTICAL_TO_BODY,
    Pose,
    rotation_matrix,
    TO_BODY,
)
from ocp_ros.geometry.clouds import voxel_downsample
from ocp_ros.registration.alignment import Certainty
from ocp_ros.registration.camera_registration import (
    depth_share,
    FARTHEST_M,
    register,
    register_together,
    registered_nearby,
    Registration,
)
from ocp_ros.registration.carried import carried_by, Seen
from ocp_ros.registration.joint_alignment import with_distances
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.movement import movements_since, sentence_of, way_back
from ocp_ros.registration.mutual_registration import register_mutually
from ocp_ros.registration.scan_surfaces import ScanSurfaces
from ocp_ros.registration.steady_cloud import measured as measured_points
from ocp_ros.rig.placement_file import ANGLES, created_by, FIXED, Placed, placed_at, Placement
from ocp_ros.rig.rig_file import Camera, Rig, rig_from, sensor_named
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.yaml_files import Document

OPTICAL = 'its cloud has optical axes (--cloud-frame optical)'
OPENGL = ('its cloud has x right, y up and z backward, as the RealSense Viewer writes it '
          '(--cloud-frame opengl)')
#: How a camera may differ from the placement: a description, a roll about the viewing direction in
#: radians, and a rotation (3, 3) from the axes of the cloud to those of the body.
OTHER_SETUPS = (
    ('it is mounted upside down', np.pi, np.eye(3)),
    ('it is mounted on its side', 0.5 * np.pi, np.eye(3)),
    ('it is mounted on its other side', -0.5 * np.pi, np.eye(3)),
    (OPTICAL, 0.0, OPTICAL_TO_BODY),
    ('its cloud has the axes of the body (--cloud-frame body)', 0.0, OPTICAL_TO_BODY.T),
    # Of files that are read as optical, and of files that are read as body.
    (OPENGL, 0.0, TO_BODY['opengl'] @ OPTICAL_TO_BODY.T),
    (OPENGL, 0.0, TO_BODY['opengl']))
#: The largest number of cameras whose clouds are tried at the poses of each other.
MAX_EXCHANGED = 8
#: The least share by which depths are too long to be named, steps to find it, and its largest
#: standard deviation: three walls that meet look alike from farther off with longer depths.
WRONG_DEPTHS, DEPTH_STEPS, MAX_DEPTH_DEVIATION = 0.003, 4, 0.005
#: How many standard deviations it is at least to be corrected, and to be named.
CORRECTED, NAMED = 2.5, 1.5
NO_CLOUD = 'it has no cloud; name it (--clouds CAMERA=FILE, or --topics CAMERA=TOPIC)'
#: Metres: the edge of the voxels of what cameras see together.
FUSED_VOXEL_M = 0.02


_log = logging.getLogger(__name__)


def calibrate(scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray],
              measured: Mapping[tuple[str, str], float] | None = None, near: float = FARTHEST_M,
              seen: Seen | None = None) -> tuple[dict[str, Registration], dict[str, str]]:
    """
    Register each camera that has a cloud to the scan and to the others.

    :param scan: the scan of the room, in the frame of the placement.
    :param placement: the planned or measured placement, at whose poses registration starts.
    :param clouds: the clouds (N, 3), metres, body frame, by the camera's name; of several frames
        see :func:`~ocp_ros.registration.steady_cloud.steady_cloud`.
    :param measured: measured distances between two cameras, metres, by their names.
    :param near: how far a camera is from its pose in the placement at most, metres.
    :param seen: what was set down in the views of cameras,
        see :func:`~ocp_ros.registration.carried.carried_by`.
    :returns: the registrations, and for unusable clouds the reasons, both by the camera's name.
    """
    registrations, reasons = _for_each_camera(
        partial(register, near=near), scan, placement, clouds)
    found, used = _with_other_setups(scan, placement, clouds, registrations)
    own = {name: one for name, one in (seen or {}).items() if used.get(name) is clouds.get(name)}
    factors = _correct_depths(scan, placement, found, used, near)
    models = {one.camera.name: one.camera.model for one in placement.cameras}
    views = {name: (LiveView(used[name], models[name], name), models[name]) for name in found}
    # Of a camera whose cloud was turned or exchanged, it is left out.
    carried = carried_by({name: {moment: [thing * factors[name] for thing in things]
                                 for moment, things in one.items()}
                          for name, one in own.items() if name in factors},
                         {name: models[name] for name in found})
    alone = found
    found, _ = with_distances(lambda left_out: (register_together(
        scan, views, alone, measured, carried, left_out), {}), measured or {})
    return _with_exchanged(placement, found), reasons


def _with_exchanged(placement: Placement, found: Mapping[str, Registration]
                    ) -> dict[str, Registration]:
    """Return registrations with a note for two cameras that fit each other's planned poses."""
    planned = placement.pose_by_name
    noted = dict(found)
    for pair in combinations([name for name, one in found.items() if not one.refused], 2):
        # Metres and radians from the own planned poses, and from those of the other camera.
        own, exchanged = (sum(sum(found[name].pose.away_from(planned[other]))
                              for name, other in zip(pair, others))
                          for others in (pair, pair[::-1]))
        if own > 0.3 and exchanged < 0.5 * own:
            for name, other in zip(pair, pair[::-1]):
                noted[name] = noted[name].with_note(
                    f'it is nearer to the planned pose of {other}, and {other} to its own: check '
                    'whether their clouds are exchanged')
    return noted


def _for_each_camera(
        register_camera: Callable[[ScanSurfaces, LiveView, Pose, CameraModel], Registration],
        scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray]
        ) -> tuple[dict[str, Registration], dict[str, str]]:
    """Call a function for each camera that has a cloud; see :func:`calibrate` for the rest."""
    registrations, reasons = {}, {}
    for placed in [one for one in placement.cameras if one.camera.name in clouds]:
        name, model = placed.camera.name, placed.camera.model
        try:
            registrations[name] = register_camera(
                scan, LiveView(clouds[name], model, name), Pose.of(placed.pose), model)
        except SceneError as error:
            reasons[name] = str(error)
        except Exception as error:  # The other cameras keep their results.
            _log.exception('the registration of a camera failed')
            reasons[name] = (f'{name}: found an error ({type(error).__name__}: {error}); expected '
                             'a registration; send the cloud and this message to the authors')
    return registrations, reasons


def _with_other_setups(scan: ScanSurfaces, placement: Placement, clouds: Mapping[str, np.ndarray],
                       registrations: Mapping[str, Registration]
                       ) -> tuple[dict[str, Registration], dict[str, np.ndarray]]:
    """
    Register cameras whose clouds do not match the scan with other clouds, mountings and axes.

    :returns: the registrations, with those that fit otherwise in place of those that do not match;
        and the clouds used, (N, 3) metres, body frame, by the camera's name.
    """
    found, used = dict(registrations), dict(clouds)
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
            if _is_behind(points, model):
                continue
            with suppress(SceneError):
                rolled = Pose(start.position, start.rotation @ rotation_matrix(roll=roll))
                other = register(scan, LiveView(points, model, name), rolled, model)
                if not other.refused:
                    found[name], used[name] = other._replace(actual_setup=description), points
                    break
    return found, used


def _is_behind(points: np.ndarray, model: CameraModel) -> bool:
    """Return whether points (N, 3), body frame, are behind a camera that sees nothing there."""
    behind, ahead = (np.count_nonzero(sign * points[:, 0] > 0.0) for sign in (-1.0, 1.0))
    return bool(model.horizontal_fov < np.pi and behind > 0.1 * ahead)


def _correct_depths(scan: ScanSurfaces, placement: Placement, found: dict[str, Registration],
                    used: dict[str, np.ndarray], near: float) -> dict[str, float]:
    """
    Register cameras whose depths are all too long or too short again, with right ones.

    :param found: the registrations by the camera's name; changed.
    :param used: their clouds (N, 3), metres, body frame; changed.
    :returns: by what the depths of each camera were multiplied, by its name.
    """
    factors = dict.fromkeys(found, 1.0)
    for placed in [one for one in placement.cameras if one.camera.name in found]:
        name, model = placed.camera.name, placed.camera.model
        one, factor = found[name], 1.0
        if one.mismatched:
            continue
        share, deviation = depth_share(scan, LiveView(used[name], model, name), one.pose, model)
        # One step finds a part of a large error, since wrong depths also make it uncertain.
        for _ in range(DEPTH_STEPS):
            if abs(share) < max(0.1 * WRONG_DEPTHS, (factor == 1.0) * max(
                    0.5 * WRONG_DEPTHS, 0.7 * deviation)):
                break
            factor /= 1.0 + share
            view = LiveView(used[name] * factor, model, name)
            one = registered_nearby(scan, view, one.pose, model)
            share, deviation = depth_share(scan, view, one.pose, model)
        wrong = abs(1.0 / factor - 1.0)
        if deviation > MAX_DEPTH_DEVIATION or wrong < max(WRONG_DEPTHS, NAMED * deviation):
            continue
        text = (f'{100.0 * wrong:.1f} % too {"long" if factor < 1.0 else "short"}, or the scale '
                'of the scan is wrong')
        if wrong > CORRECTED * deviation:
            used[name], factors[name] = used[name] * factor, factor
            one = register(scan, LiveView(used[name], model, name), one.pose, model, near)
            found[name] = one.with_note(
                f'its depths are {text}; its pose is by corrected depths; calibrate its depths')
        else:
            away = one.pose.away_from(found[name].pose)[0]
            found[name] = found[name].with_note(
                f'its depths may be {text}, but that is uncertain by {100.0 * deviation:.1f} %; '
                f'its pose would then be off by {1000.0 * away:.0f} mm; calibrate its depths')
    return factors


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
    registrations, reasons = _for_each_camera(registered_nearby, scan, placement, clouds)
    sentences = list(reasons.values())
    poses = placement.pose_by_name
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


class Calibrated(NamedTuple):
    """
    The result of a calibration.

    :ivar placement: the cameras where they hang.
    :ivar rows: of each camera, plain data for JSON; without a pose if ``refused`` is not empty.
    :ivar references: the clouds to find out by later whether a camera has moved, by its name.
    :ivar fused: (N, 3) metres, what all cameras see together; None with a scan.
    """

    placement: Placement
    rows: list[dict[str, Any]]
    references: dict[str, np.ndarray]
    fused: np.ndarray | None = None


def by_scan(scene: Scene, placement: Placement, clouds: Mapping[str, np.ndarray], command: str,
            measured: Mapping[tuple[str, str], float] | None = None, near: float = FARTHEST_M,
            seen: Seen | None = None) -> Calibrated:
    """
    Register cameras to a scan and to each other; see :func:`calibrate`.

    :param command: the command line, for the record.
    """
    found, failures = calibrate(ScanSurfaces(scene), placement, clouds, measured=measured,
                                near=near, seen=seen)
    rows = [answer_of(placed, found[name]) if (name := placed.camera.name) in found else
            {'camera': name, 'refused': failures.get(name, NO_CLOUD)}
            for placed in placement.cameras]
    # A cloud that is not the camera's own, or has other axes, is no reference for it.
    certain = {row['camera'] for row in rows if not (row['refused'] or row['otherwise'])}
    return Calibrated(as_built(placement, found, command), rows, {
        name: cloud for name, cloud in clouds.items() if name in certain})


def without_scan(clouds: Mapping[str, np.ndarray], sensor: str, command: str,
                 measured: Mapping[tuple[str, str], float] | None = None,
                 seen: Seen | None = None) -> Calibrated:
    """
    Register cameras to each other.

    :param clouds: the clouds (N, 3), metres, body frame, by the camera's name.
    :param sensor: the preset of all cameras; '' to measure field of view and range in the clouds.
    :param command: the command line, for the record.
    :param measured: measured distances between two cameras, metres, by their names.
    :param seen: see :func:`calibrate`.
    :raises ConfigurationError: if the sensor is unknown, or fewer than two cameras agree.
    """
    if sensor:
        sensor = sensor_named(sensor)
    models = {name: SENSORS[sensor].model if sensor else model_of_cloud(cloud)
              for name, cloud in clouds.items()}
    views, reasons = views_of(clouds, models)
    carried = carried_by(seen or {}, {name: models[name] for name in views})
    found, failures = with_distances(lambda left_out: register_mutually(
        views, measured, carried=carried, left_out=left_out), measured or {})
    reasons |= failures
    placed, rows, fused = [], [], []
    for name in clouds:
        row = {'camera': name, 'refused': found[name].refused if name in found else reasons[name]}
        if not row['refused']:
            one = found[name]
            placed.append(placed_at(Camera(name, sensor, models[name]), _row_of(one.pose), 'free'))
            fused.append(views[name].points @ one.pose.rotation.T + one.pose.position)
            row |= {'overlap': one.overlap, 'lead': one.lead, 'note': one.note,
                    **_deviations(one.certainty),
                    **pose_data(one.pose)}
        rows.append(row)
    if len(placed) < 2:
        raise ConfigurationError('--clouds: found no two cameras that agree (' + '; '.join(
            f'{row["camera"]}: {row["refused"]}' for row in rows) + '); expected cameras that see '
            'the floor and some of the same things; turn them, or give a scan')
    placement = Placement(tuple(placed), created={**created_by(command), 'calibrated': ', '.join(
        one.camera.name for one in placed)})
    return Calibrated(placement, rows, {one.camera.name: clouds[one.camera.name]
                                        for one in placed},
                      voxel_downsample(np.concatenate(fused), FUSED_VOXEL_M))


def calibrate_mutually(placement: Placement, clouds: Mapping[str, np.ndarray]
                       ) -> tuple[dict[str, Registration], dict[str, str]]:
    """
    Register cameras to each other; the most certain one stays where the placement has it.

    It keeps its position and heading there; the floor says how it is tilted.

    :returns: as :func:`calibrate`.
    """
    placed = {one.camera.name: one for one in placement.cameras}
    views, reasons = views_of(clouds, {name: one.camera.model for name, one in placed.items()})
    found, failures = register_mutually(views)
    registrations: dict[str, Registration] = {}
    if found:
        base = min(found, key=lambda name: found[name].certainty.metres[0])
        place = Pose.of(placed[base].pose)
        # The level frame of the rig in that of the placement.
        turn = rotation_matrix(heading_of(place.rotation)[0]
                               - heading_of(found[base].pose.rotation)[0])
        for name, one in found.items():
            pose = Pose(place.position + turn @ (one.pose.position - found[base].pose.position),
                        turn @ one.pose.rotation)
            certainty = one.certainty._replace(slide_axes=one.certainty.slide_axes @ turn.T,
                                               turn_axes=one.certainty.turn_axes @ turn.T)
            registrations[name] = Registration(
                pose, np.nan, one.overlap, 0.0, certainty, 0.0, 0.0, one.refused)
    return registrations, {**reasons, **failures}


def views_of(clouds: Mapping[str, np.ndarray], models: Mapping[str, CameraModel]
             ) -> tuple[dict[str, LiveView], dict[str, str]]:
    """
    Return what cameras see, and the reasons why clouds are unusable, both by the camera's name.

    :param clouds: (N, 3) metres, body frame; those without a model are left out.
    """
    views, reasons = {}, {}
    for name, model in models.items():
        if name not in clouds:
            continue
        if _is_behind(clouds[name], model):
            reasons[name] = ('found points behind the camera; expected all of them before it; say '
                             'which axes its cloud has (--cloud-frame)')
            continue
        try:
            views[name] = LiveView(clouds[name], model, name)
        except SceneError as error:
            reasons[name] = str(error)
    return views, reasons


def model_of_cloud(points: np.ndarray) -> CameraModel:
    """Return a camera whose field of view and range contain nearly all points (N, 3), metres."""
    points = measured_points(points)
    if len(points) == 0:
        return CameraModel()
    azimuth = np.abs(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.abs(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    distance = np.linalg.norm(points, axis=1)
    horizontal, vertical = (2.0 * float(np.percentile(angle, 99.8))
                            for angle in (azimuth, elevation))
    # 1e-3: points of a single direction still need a field of view.
    return CameraModel(0.0, float(np.percentile(distance, 99.9)) * 1.02 + 1e-3,
                       max(horizontal, 1e-3), min(max(vertical, 1e-3), np.pi))


def since_reference(placement: Placement, references: Mapping[str, np.ndarray],
                    clouds: Mapping[str, np.ndarray], command: str) -> Calibrated:
    """
    Find out which cameras have moved since an earlier calibration.

    :param placement: the placement as built then.
    :param references: the clouds (N, 3) of that time, metres, body frame, by the camera's name.
    :param clouds: the present clouds.
    :param command: the command line, for the record.
    :returns: cameras that have moved at their present poses; others as they were.
    """
    models = {placed.camera.name: placed.camera.model for placed in placement.cameras}
    poses = placement.pose_by_name
    before, _ = views_of(references, models)
    views, reasons = views_of(clouds, models)
    movements = movements_since(before, views, poses)
    rows, cameras, kept = [], [], dict(references)
    for placed in placement.cameras:
        name = placed.camera.name
        row: dict[str, Any] = {'camera': name, 'refused': ''}
        if name not in movements:
            row['refused'] = reasons.get(name, NO_CLOUD) if name in before else \
                'it has no reference: calibrate it once without --against'
        elif (movement := movements[name]).is_lost:
            row['refused'] = sentence_of(name, movement, poses[name])
        else:
            if movement.has_moved:
                placed = placed.at_measured_pose(_row_of(movement.pose_now(poses[name])))
                row['put_back'] = way_back(movement, poses[name])
                kept[name] = clouds[name]
            row |= {'overlap': movement.agreement, 'moved': movement.has_moved,
                    'moved_metres': movement.metres, 'moved_degrees': movement.degrees,
                    **pose_data(Pose.of(placed.pose))}
            if movement.by_others:
                row['note'] = ('it sees too little of what it saw before; its pose is by what the '
                               'other cameras see')
        rows.append(row)
        cameras.append(placed)
    built = _with_cameras(placement, cameras, created_by(command))
    return Calibrated(built, rows, kept)


def as_built(placement: Placement, found: Mapping[str, Registration], command: str) -> Placement:
    """
    Return a placement with the cameras at the registered poses; others keep theirs.

    :param placement: the planned or measured placement.
    :param found: the registrations by the camera's name, see :func:`calibrate`.
    :param command: the command line, for the record.
    """
    calibrated = [name for name, registration in found.items() if not registration.refused]
    created = {**created_by(command, placement.created.get('planner', '')),
               'calibrated': ', '.join(calibrated)}
    return _with_cameras(
        placement, [_at_registered_pose(placed, found) for placed in placement.cameras], created)


def _with_cameras(placement: Placement, cameras: list[Placed], created: dict[str, str]
                  ) -> Placement:
    """Return a placement with its cameras at other poses, also those in place."""
    rig = placement.rig and _with_fixed_poses(placement.rig, [
        placed for placed in cameras if placed.mount == FIXED])
    # The scores of the plan do not hold for measured poses. A camera at a measured pose keeps its
    # planned pose in ``planned``; for others this is None.
    scores = {} if any(placed.planned for placed in cameras) else placement.scores
    return replace(placement, cameras=tuple(cameras), rig=rig, scores=scores, created=created,
                   document=None, key_paths=())


def answer_of(placed: Placed, found: Registration) -> dict[str, Any]:
    """Return the registration of a camera as plain data for JSON, without a pose if refused."""
    certainty = found.certainty
    row = {'camera': placed.camera.name, 'refused': found.refused,
           'residual': found.residual, 'overlap': found.overlap, 'violated': found.violated_share,
           'loose': certainty.loose_motions, 'otherwise': found.actual_setup,
           'note': found.note, **_deviations(certainty)}
    if not found.refused:
        metres, radians = found.pose.away_from(Pose.of(placed.pose))
        row |= {**pose_data(found.pose), 'from_plan_metres': metres,
                'from_plan_degrees': float(np.rad2deg(radians))}
    return row


def _deviations(certainty: Certainty) -> dict[str, Any]:
    """Return the expected deviations of a pose as plain data: three along axes, three about."""
    return {'deviations': [
        *({'along': axis.tolist(), 'metres': float(value), 'held_by': held} for axis, value, held
          in zip(certainty.slide_axes, certainty.metres, certainty.held_by[:3])),
        *({'about': axis.tolist(), 'degrees': float(value), 'held_by': held} for axis, value, held
          in zip(certainty.turn_axes, certainty.degrees, certainty.held_by[3:]))]}


def _row_of(pose: Pose) -> np.ndarray:
    """Return a pose as the row (6,) of a placement, metres and radians."""
    return np.concatenate([pose.position, heading_of(pose.rotation)])


def pose_data(pose: Pose) -> dict[str, Any]:
    """Return a pose as plain data: metres and degrees."""
    return {'position': pose.position.round(4).tolist(),
            **dict(zip(ANGLES, np.rad2deg(heading_of(pose.rotation)).round(3).tolist()))}


def _at_registered_pose(placed: Placed, found: Mapping[str, Registration]) -> Placed:
    """Return a camera at its registered pose; unchanged without a usable registration."""
    registration = found.get(placed.camera.name)
    if registration is None or registration.refused:
        return placed
    return placed.at_measured_pose(_row_of(registration.pose))


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
