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
Placement files: the poses of a rig's cameras, written by a planner for the installer.

A file contains everything that its scores depend on: the sensor parameters, the rig, the engine's
settings and the hash of the room. Its numbers are rounded before the placement is evaluated, so
that a reader of the file gets the same scores. docs/reference/placement.md explains every key.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ocp_ros import __version__
from ocp_ros.geometry.cameras import CameraModel, Pose, rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig, PROMISING
from ocp_ros.rig.rig_file import (
    Camera,
    cameras_at,
    Device,
    model_of,
    names_of,
    pose_of,
    Rig,
    rig_from,
)
from ocp_ros.rig.schemas import MODEL, PLACEMENT
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rig.structure import Floors, floors_of
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.files import write_atomically
from ocp_ros.util.yaml_files import Document, read_document, timestamp, Way, written

FIXED = 'fixed'
FRAME = 'map'
#: Metres, and entries of the rotation matrix, by which a camera in place may differ between the
#: rig and the placement.
POSE_TOLERANCE = 1e-3
ANGLES = ('yaw', 'pitch', 'roll')


class Placed(NamedTuple):
    """
    A camera with its pose.

    :ivar camera: the camera.
    :ivar position: x, y, z, metres, map frame.
    :ivar angles: yaw, pitch, roll, degrees.
    :ivar mount: the surface that the camera is mounted on; ``fixed`` if it was in place before.
    :ivar planned: the planned position and angles, if the camera was measured elsewhere.
    """

    camera: Camera
    position: tuple[float, float, float]
    angles: tuple[float, float, float]
    mount: str
    planned: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def at_measured_pose(self, pose: np.ndarray) -> 'Placed':
        """Return the camera at its measured pose (6,), metres and radians, rounded."""
        return placed_at(self.camera, pose, self.mount)._replace(
            planned=self.planned or (self.position, self.angles))

    @property
    def pose(self) -> np.ndarray:
        """Return the pose (6,): x, y, z in metres and yaw, pitch, roll in radians."""
        return np.array([*self.position, *np.deg2rad(self.angles)])


@dataclass(frozen=True)
class Placement:
    """
    A placement of a rig.

    :ivar cameras: the cameras that were to be placed, then those in place before.
    :ivar rig: the rig; None if the file does not contain it.
    :ivar room: the room, as in the file: file or seed, sha256, points, scale, up.
    :ivar engine: the engine settings of the scores.
    :ivar scores: the scores, as in the file.
    :ivar created: date, command and version, as in the file.
    :ivar frame: the frame of all poses.
    :ivar document: the document that the placement was read from; None if there is none.
    :ivar key_paths: the keys that lead to each camera in that document, in the order of
        ``cameras``; without cameras in place that the rig has and the document leaves out.
    """

    cameras: tuple[Placed, ...]
    rig: Rig | None = None
    room: dict[str, Any] = field(default_factory=dict)
    engine: EngineConfig = PROMISING
    scores: dict[str, Any] = field(default_factory=dict)
    created: dict[str, str] = field(default_factory=dict)
    frame: str = FRAME
    document: Document | None = None
    key_paths: tuple[Way, ...] = ()

    @property
    def poses(self) -> np.ndarray:
        """Return the poses of the cameras that were to be placed: (K, 6) metres and radians."""
        return np.array([placed.pose for placed in self.cameras
                         if placed.mount != FIXED]).reshape(-1, 6)

    @property
    def pose_by_name(self) -> dict[str, Pose]:
        """Return the poses of all cameras by their names."""
        return {placed.camera.name: Pose.of(placed.pose) for placed in self.cameras}

    @property
    def planned_poses(self) -> np.ndarray | None:
        """Return the planned poses (K, 6) if any camera was measured elsewhere; otherwise None."""
        movable = [placed for placed in self.cameras if placed.mount != FIXED]
        if not any(placed.planned for placed in movable):
            return None
        return np.array([[*position, *np.deg2rad(angles)] for position, angles in (
            placed.planned or (placed.position, placed.angles) for placed in movable)])

    def rig_in(self, scene: Scene) -> Rig:
        """
        Return the rig; if the file contains none, a rig whose constraints these cameras satisfy.

        :param scene: the room, for heights above its floor.
        """
        return self.rig or _rig_like(self, floors_of(scene))


def created_by(command: str, planner: str = '') -> dict[str, str]:
    """Return the origin of a placement for its file: date, command, version and planner."""
    return {'date': timestamp(), 'command': command, 'version': __version__,
            **({'planner': planner} if planner else {})}


def placement_of(rig: Rig, poses: np.ndarray, **fields: Any) -> Placement:
    """
    Return the placement of a rig, rounded as in its file.

    :param poses: (K, 6), the poses of the K cameras to be placed, metres, map frame, and radians;
        (K, 3) where no camera has a heading.
    :param fields: other fields of :class:`Placement`.
    :raises ValueError: if the number of poses differs from that of the cameras to be placed.
    """
    poses = np.asarray(poses, dtype=np.float64)
    if len(poses) != len(rig.cameras):
        raise ValueError(f'poses: found {len(poses)}; expected {len(rig.cameras)}, one for each '
                         'camera that is to be placed')
    full = np.zeros((len(poses), 6))
    full[:, :poses.shape[1]] = poses
    mounts = [*[rig.mount.on] * len(rig.cameras), *[FIXED] * len(rig.fixed)]
    placed = map(placed_at, rig.all_cameras, [*full, *rig.fixed_poses], mounts)
    return Placement(tuple(placed), rig, **fields)


def placed_at(camera: Camera, pose: np.ndarray, mount: str) -> Placed:
    """Return a camera at a pose (6,), metres and radians, rounded as in its file."""
    position, angles = _rounded_poses(np.asarray(pose)[None])
    return Placed(camera, tuple(position[0].tolist()), tuple(angles[0].tolist()), mount)


def _rounded_poses(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions, metres, and angles, degrees, (M, 3) each, rounded as in files."""
    angles = np.rad2deg(poses[:, 3:])
    # Yaw and roll are wrapped to -180 up to 180 degrees.
    angles[:, [0, 2]] = (angles[:, [0, 2]] + 180.0) % 360.0 - 180.0
    # Cameras are mounted less accurately than to 0.1 mm and 0.001 degrees.
    # Adding 0.0 turns -0.0 into 0.0.
    return np.round(poses[:, :3], 4) + 0.0, np.round(angles, 3) + 0.0


def as_written(poses: np.ndarray) -> np.ndarray:
    """
    Return poses rounded as in a file, so that a search evaluates the poses that it will write.

    :param poses: (M, 6), M poses, metres, map frame, and radians.
    """
    positions, angles = _rounded_poses(poses)
    return np.hstack([positions, np.deg2rad(angles)])


def load_placement(path: str | Path, rig: Rig | None = None) -> Placement:
    """
    Read a placement.

    :param path: a YAML or JSON file; docs/reference/placement.md explains its keys.
    :param rig: the rig to use instead of the one in the file.
    :raises ConfigurationError: if the file cannot be used or does not match this rig: one sentence
        with file, line and key.
    """
    return placement_from(read_document(path, PLACEMENT), rig)


def placement_from(document: Document, rig: Rig | None = None) -> Placement:
    """
    Build a placement from a document that is valid under its schema.

    :param rig: the rig to use instead of the one in the document.
    :raises ConfigurationError: if the placement does not match this rig.
    """
    data = document.data
    if rig is None and 'rig' in data:
        rig = rig_from(document.part('rig'))
    # Cameras that may be moved come first, then those in place; both groups in the file's order.
    movable, fixed = ([('cameras', k) for k, entry in enumerate(data['cameras'])
                       if (entry.get('mount') == FIXED) == in_place] for in_place in (False, True))
    key_paths = [*movable, *fixed]
    names = dict(zip(key_paths, names_of(document, key_paths)))
    if rig is not None:
        rig = _renamed_rig(document, rig, movable, names)
        _check_fixed(document, rig, fixed)
    elif not movable:
        raise document.error(('cameras',), 'fixed cameras only', 'one at least that may be '
                             'moved', f'write another mount than {FIXED}')
    if rig is None:
        placed = [_placed(document, keys, camera, 'free')
                  for keys, camera in zip(key_paths, cameras_at(document, key_paths))]
    else:
        placed = [_placed(document, keys, camera, rig.mount.on)
                  for keys, camera in zip(movable, rig.cameras)]
        # Cameras in place come from the rig, since the file may leave them out.
        placed += [placed_at(one.camera, one.pose, FIXED) for one in rig.fixed]
    return Placement(tuple(placed), rig, data.get('room', {}),
                     EngineConfig(**data['engine']) if 'engine' in data else PROMISING,
                     data.get('scores', {}), data.get('created', {}),
                     data.get('frame', FRAME), document, tuple(key_paths))


def _placed(document: Document, keys: Way, camera: Camera, mount: str) -> Placed:
    """Return a camera with the pose and the mount of its entry; ``mount`` is the default."""
    data = document.value(*keys)
    planned = _position_and_angles(data['planned']) if 'planned' in data else None
    return Placed(camera, *_position_and_angles(data), data.get('mount', mount), planned)


def _position_and_angles(data: dict[str, Any]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the position, metres, and the angles, degrees, of an entry of a file."""
    return (tuple(float(value) for value in data['position']),
            tuple(float(data.get(angle, 0.0)) for angle in ANGLES))


def _renamed_rig(document: Document, rig: Rig, paths: Sequence[Way], names: dict[Way, str]) -> Rig:
    """
    Return a rig with the names that its cameras have in a placement.

    :param paths: the keys that lead to each camera to be placed, in the order of the rig.
    :param names: the name of each camera.
    :raises ConfigurationError: if the cameras do not match those of the rig.
    """
    if len(paths) != len(rig.cameras):
        raise document.error(
            ('cameras',), f'{len(paths)} cameras that may be moved',
            f'{len(rig.cameras)}, as in {rig.document.name}',
            f'add or remove some, or mark those in place by mount: {FIXED}')
    cameras = []
    for keys, camera in zip(paths, rig.cameras):
        data = document.value(*keys)
        # An entry may leave out its sensor, and its name: it then has those of the rig.
        if any(key in data for key in MODEL) and not _has_model(document, keys, camera.model):
            raise document.error(
                keys, 'the numbers of another sensor', f'those of {camera.name} in '
                f'{rig.document.name}', "put the cameras in the rig's order, or leave them out")
        name = names[keys] if 'name' in data else camera.name
        if name in {other.name for other in (*cameras, *(one.camera for one in rig.fixed))}:
            raise document.error(keys, f'the name {name!r}, which another camera of '
                                 f'{rig.document.name} has', 'one of its own',
                                 'give it another name')
        cameras.append(camera._replace(name=name, device=Device(*(
            data.get(key, value) for key, value in camera.device._asdict().items()))))
    return replace(rig, cameras=tuple(cameras))


def _check_fixed(document: Document, rig: Rig, key_paths: Sequence[Way]) -> None:
    """Raise ConfigurationError for cameras in place that differ from those of the rig."""
    for k, keys in enumerate(key_paths):
        data = document.value(*keys)
        # The numbers are compared inside the loop, so that a file without such cameras passes.
        if (len(key_paths) != len(rig.fixed)
                or not _has_model(document, keys, rig.fixed[k].camera.model)
                or not _same_pose(pose_of(data), rig.fixed[k].pose)):
            raise document.error(keys, 'a fixed camera', f'those that {rig.document.name} has, '
                                 'or none', 'correct it, or leave all of them out')


def _has_model(document: Document, keys: Way, model: CameraModel) -> bool:
    """Return whether a camera of a file has the parameters of a model, up to rounding."""
    found = model_of(document, keys)
    return found.resolution == model.resolution and all(
        math.isclose(getattr(found, key), getattr(model, key))
        for key in ('min_range', 'max_range', 'horizontal_fov', 'vertical_fov'))


def _same_pose(pose: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two poses (6,) differ by ``POSE_TOLERANCE`` at most."""
    # Rotations are compared, since different angles may stand for the same rotation.
    difference = rotation_matrix(*pose[3:]) - rotation_matrix(*other[3:])
    return max(np.abs(pose[:3] - other[:3]).max(), np.abs(difference).max()) <= POSE_TOLERANCE


def _rig_like(placement: Placement, floors: Floors) -> Rig:
    """
    Return a rig for a placement without one, whose constraints its cameras satisfy.

    :param floors: the floors of the room.
    """
    placed = placement.cameras
    movable = [one for one in placed if one.mount != FIXED]
    positions = np.array([one.position for one in movable]).reshape(-1, 3)
    # A rig has no heights below the floor.
    heights = np.maximum(positions[:, 2] - floors.under(positions), 0.0).tolist()
    pitches = [one.angles[1] for one in movable if not one.camera.model.omnidirectional]
    # Cameras with different mounts, or at different heights of a plane, have the mount free.
    mounts = {one.mount for one in movable}
    on = mounts.pop() if len(mounts) == 1 else 'free'
    if on == 'plane' and np.ptp(heights) > POSE_TOLERANCE:
        on = 'free'
    mount: dict[str, Any] = {'on': on}
    # Without a height, a mount on the ceiling has the height of the ceiling.
    if on != 'ceiling':
        mount['height'] = heights[0] if on == 'plane' else [min(heights), max(heights)]
    # The range of pitches is 0 to 60 degrees, extended to the pitches of all cameras. Real cameras
    # are more than 5 cm in size, so all of them satisfy this distance to surfaces (keep_clear). A
    # spacing of 0 is no limit.
    data = {
        'cameras': [{'name': one.camera.name, **numbers_of(one.camera)} for one in movable],
        'fixed': [_entry(one, complete=False) for one in placed if one.mount == FIXED],
        'mount': mount, 'pitch': [min([0.0, *pitches]), max([60.0, *pitches])],
        'keep_clear': 0.05, 'spacing': 0.0}
    return rig_from(_rig_document(placement, data, int(np.argmin(heights))))


def _rig_document(placement: Placement, data: dict[str, Any], lowest: int) -> Document:
    """
    Return a document of rig data whose errors name the keys of the placement.

    :param lowest: the index of the lowest camera to be placed, for errors about the mount; it is
        an index of ``key_paths`` too, where cameras to be placed come first.
    """
    document, key_paths = placement.document, placement.key_paths
    if document is None:
        return Document('placement', data)
    in_place = (keys for keys, one in zip(key_paths, placement.cameras) if one.mount == FIXED)
    sources = {('mount', 'height'): (*key_paths[lowest], 'position'),
               ('mount', 'on'): (*key_paths[lowest], 'mount'),
               **{('fixed', k): (*keys, 'position') for k, keys in enumerate(in_place)}}
    return Document(document.name, data, document.lines, sources)


def numbers_of(camera: Camera) -> dict[str, Any]:
    """Return the sensor and the parameters of a camera for a file, angles in degrees."""
    model: CameraModel = camera.model
    numbers: dict[str, Any] = {'sensor': camera.sensor} if camera.sensor else {}
    for key in ('horizontal_fov', 'vertical_fov'):
        # Twelve digits: the later ones are rounding errors of degrees computed from radians.
        numbers[key] = float(f'{np.rad2deg(getattr(model, key)):.12g}')
    numbers |= {'min_range': model.min_range, 'max_range': model.max_range}
    if model.resolution is not None:
        numbers['resolution'] = list(model.resolution)
    # The model of a preset has a term that files have not, so it is left to the preset.
    preset = SENSORS.get(camera.sensor)
    if model.noise is not None and (preset is None or preset.model.noise != model.noise):
        numbers['depth_noise'] = [float(f'{1e3 * term:.12g}') for term in model.noise[:3]]
    return numbers


def _entry(placed: Placed, complete: bool = True) -> dict[str, Any]:
    """Return the entry of a camera for a file, complete or without mount and planned pose."""
    device = {key: value for key, value in placed.camera.device._asdict().items() if value}
    entry = {'name': placed.camera.name, **numbers_of(placed.camera), **device,
             **_pose_entry(placed.position, placed.angles),
             **({'mount': placed.mount} if complete else {})}
    if placed.planned and complete:
        entry['planned'] = _pose_entry(*placed.planned)
    return entry


def _pose_entry(position: Sequence[float], angles: Sequence[float]) -> dict[str, Any]:
    """Return a position, metres, and angles, degrees, as a mapping for a file."""
    return {'position': list(position), **dict(zip(ANGLES, angles))}


def data_of(placement: Placement) -> dict[str, Any]:
    """Return a placement as plain data for its file."""
    data = {'version': 1, 'frame': placement.frame, 'room': placement.room,
            'cameras': [_entry(placed) for placed in placement.cameras],
            'engine': asdict(placement.engine),
            'rig': placement.rig.document.data if placement.rig else None,
            'scores': placement.scores, 'created': placement.created}
    # A file has no empty values.
    return {key: value for key, value in data.items() if value}


def save_placement(path: str | Path, placement: Placement) -> None:
    """
    Write a placement.

    :param path: ``.json`` for JSON, YAML for any other suffix.
    :raises OSError: if it cannot be written.
    """
    path = Path(path)
    write_atomically(path, written(data_of(placement), path.suffix.lower()))
