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
A rig: its cameras, their constraints and their tasks, mostly read from a YAML file.

Angles are degrees in files and radians here; docs/reference/rig.md explains every key.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, DepthNoise
from ocp_ros.geometry.measurement_quality import QualityLimits
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.schemas import MAX_NAME_LENGTH, MIN_FOV_DEG, MODEL, PIXEL_DENSITIES, RIG
from ocp_ros.rig.sensors import KINDS, OMNIDIRECTIONAL, PRICES, SENSORS
from ocp_ros.rig.zones import Zone, zone_of, zones_of
from ocp_ros.util.settings import ConfigurationError, MAX_CAMERAS
from ocp_ros.util.yaml_files import describe, Document, document_of, nearest, read_document, Way

#: The share of a region's points that has to be seen with ``must_see: true``, and that has to meet
#: what it requires: some points are noise, and some are occluded from everywhere.
MUST_SEE_SHARE = 0.95
#: Radians: the largest gap, seen from above, between the directions of cameras all around.
MAX_GAP = np.deg2rad(120.0)
#: The default heights above the floor in metres; a ceiling mount has the height of the ceiling.
DEFAULT_HEIGHTS_M = {'plane': (1.9, 1.9), 'ceiling': None, 'walls': (1.5, 2.5), 'free': (1.5, 2.5)}
#: Cameras on a plane below this height stand on tripods, unless the file gives a footprint.
MAX_TRIPOD_HEIGHT_M = 2.2
#: Limits of a turn of cameras that move themselves: turns, metres and radians. With short steps,
#: cameras on tripods end at furniture.
MOVING = {'turns': 12, 'max_step': 1.5, 'max_turn': 1.6}
#: Default radius of free floor below a camera on a tripod, metres.
TRIPOD_FOOTPRINT_M = 0.4


class Device(NamedTuple):
    """
    What connects a camera to a computer; texts are empty where a file does not give them.

    :ivar serial: the serial number, by which a driver finds the camera.
    :ivar driver: the ROS 2 driver, one of :data:`~ocp_ros.rig.schemas.DRIVERS`.
    :ivar namespace: the namespace of the driver's topics.
    :ivar host: the computer that the camera is connected to.
    """

    serial: str = ''
    driver: str = ''
    namespace: str = ''
    host: str = ''


class Camera(NamedTuple):
    """
    A camera of a rig.

    :ivar name: the unique name in tables.
    :ivar sensor: the name of the sensor's preset; empty for parameters given directly.
    :ivar model: the camera model.
    :ivar device: what connects the camera to a computer.
    :ivar price: of one camera; None if unknown.
    """

    name: str
    sensor: str
    model: CameraModel
    device: Device = Device()
    price: float | None = None


class FixedCamera(NamedTuple):
    """
    A camera that is in place already and stays.

    :ivar camera: the camera.
    :ivar pose: (6,) x, y, z, yaw, pitch, roll: metres, map frame, and radians.
    :ivar where: file, line and keys of its entry, for messages.
    """

    camera: Camera
    pose: np.ndarray
    where: str


class Mount(NamedTuple):
    """
    The mount of cameras.

    :ivar on: ``plane``, ``ceiling``, ``walls`` or ``free``; or ``box``, which files cannot
        contain, for any position at a height within the bounding box of the room.
    :ivar heights: the lowest and the highest height above the floor, or for a ``box`` above the
        lowest point of the room, metres; None for just below the ceiling.
    :ivar footprint: the radius of free floor below a camera, metres, for the feet of a tripod; 0
        for cameras on poles, rods and rails.
    """

    on: str
    heights: tuple[float, float] | None
    footprint: float = 0.0


class SightCondition(NamedTuple):
    """
    The condition of lines of sight for a point, or a position in the air, to count as seen.

    :ivar seen_by: the number of cameras that have to see the point or position.
    :ivar angle: the least angle between the lines of sight of any two of these cameras, radians.
    :ivar around: whether cameras have to stand all around the position: seen from above, no gap
        between their directions is larger than :data:`MAX_GAP`.
    """

    seen_by: int
    angle: float
    around: bool = False

    def eased(self, seen_by: int) -> tuple[int, float, float]:
        """
        Return the condition if at most a number of cameras have to see the position.

        :returns: the number of cameras, the angle, and the largest gap between directions, which
            grows for fewer cameras up to a full turn for one, radians.
        """
        if not self.around:
            return min(self.seen_by, seen_by), self.angle, 2.0 * np.pi
        missing = max(self.seen_by - seen_by, 0) / (self.seen_by - 1)
        return (min(self.seen_by, seen_by), self.angle,
                MAX_GAP + missing * (2.0 * np.pi - MAX_GAP))


class Requirement(NamedTuple):
    """
    What the points of a region, or of the whole room, require of the cameras that see them.

    A camera counts for a point if it measures the point within all limits.

    :ivar region: the name of the region; empty for the whole room.
    :ivar zone: the volume of the region; None for the whole room.
    :ivar pixel_density: the least number of pixels per metre; None for no limit.
    :ivar max_noise: the largest standard deviation of a depth, metres; None for no limit.
    :ivar incidence: the largest angle of incidence, radians; None for no limit.
    :ivar sight: the cameras that have to count for a point, and the angle between them.
    :ivar one_may_fail: whether the share has to be met without any one of the cameras.
    :ivar share: the share of the points that has to meet the requirement.
    :ivar where: file, line and keys of its entry, for messages.
    """

    region: str
    zone: Zone | None
    pixel_density: float | None
    max_noise: float | None
    incidence: float | None
    sight: SightCondition
    one_may_fail: bool
    share: float
    where: str

    def limits_of(self, model: CameraModel) -> QualityLimits:
        """Return the limits within which a camera of a model measures a point well enough."""
        return QualityLimits.of(model, self.pixel_density, self.max_noise, self.incidence)

    @property
    def searched_share(self) -> float:
        """
        Return the share that a search aims at.

        A tenth more than is asked for, at most half of what lies between it and 1: the engine
        promises up to a tenth more than rays at the mesh deliver.
        """
        return min(1.1 * self.share, 0.5 * (1.0 + self.share))

    @property
    def cameras(self) -> int:
        """Return the least number of cameras with which the requirement can be met."""
        return self.sight.seen_by + self.one_may_fail

    @property
    def text(self) -> str:
        """Return the requirement in words, without its region and its share."""
        cameras = self.sight.seen_by
        levels = [name for name, level in PIXEL_DENSITIES.items() if level == self.pixel_density]
        name = f' ({", ".join(levels)})' if levels else ''
        return ', '.join(filter(None, [
            self.pixel_density and f'{self.pixel_density:g} px/m{name}',
            self.max_noise and f'depth to {1e3 * self.max_noise:g} mm',
            self.incidence and f'incidence up to {np.rad2deg(self.incidence):.3g} degrees',
            f'by {cameras} camera{"s" * (cameras > 1)}'
            + (f' at least {np.rad2deg(self.sight.angle):.3g} degrees apart'
               if self.sight.angle and cameras > 1 else '')
            + ' from all around' * self.sight.around,
            self.one_may_fail and 'also if any one camera fails']))


class Region(NamedTuple):
    """
    A part of the room with an additional weight or requirement.

    :ivar name: the unique name of the region.
    :ivar zone: the volume of the region.
    :ivar weight: the weight in the objective; the whole room has 1.
    :ivar must_see: the share of its points, or of its air, that has to be seen; 0 for none.
    :ivar where: file, line and keys of its entry, for messages.
    :ivar air: the condition for the air of the region to count as seen; None if points have to be
        seen.
    """

    name: str
    zone: Zone
    weight: float
    must_see: float
    where: str
    air: SightCondition | None = None

    @property
    def parts(self) -> str:
        """Return what has to be seen of the region, for messages: points or air."""
        return 'points' if self.air is None else 'air'


class Calibratable(NamedTuple):
    """
    The condition for two cameras to be calibrated to each other.

    :ivar overlap: the least number of shared points as a share of the points of the camera that
        sees fewer, above 0.
    :ivar angle: the largest angle between the lines of sight of both cameras to a shared point,
        radians.
    """

    overlap: float
    angle: float


@dataclass(frozen=True, eq=False)
class Rig:
    """
    Cameras to be placed, cameras in place, and the constraints and tasks of a placement.

    :ivar cameras: the K cameras to be placed.
    :ivar fixed: the F cameras in place.
    :ivar mount: the mount of the K cameras.
    :ivar pitch: the least and the largest pitch, radians; positive looks down.
    :ivar rolls: the rolls that the mount offers, radians.
    :ivar keep_clear: the least distance of a camera from any surface except its mount, metres.
    :ivar spacing: the least distance of two cameras, metres.
    :ivar keep_out: zones in which no camera may be.
    :ivar keep_in: zones, of which each camera has to be in one; empty for no limit.
    :ivar regions: the regions with additional weights or shares that must be seen.
    :ivar requirements: what the whole room and regions require of the cameras that see them.
    :ivar seen_by: the number of cameras that have to see a point.
    :ivar no_interference: whether no two cameras may disturb each other by their light.
    :ivar calibratable: the condition for links between cameras, which have to connect all of them;
        None if not required.
    :ivar document: the document that the rig was read from; empty if there is none.
    :ivar computer: where the cables of the cameras end: (3,) metres, map frame; None for a place
        at a wall with short cables.
    """

    cameras: tuple[Camera, ...]
    fixed: tuple[FixedCamera, ...]
    mount: Mount
    pitch: tuple[float, float]
    rolls: tuple[float, ...]
    keep_clear: float
    spacing: float
    keep_out: tuple[Zone, ...]
    keep_in: tuple[Zone, ...]
    regions: tuple[Region, ...]
    requirements: tuple[Requirement, ...]
    seen_by: int
    no_interference: bool
    calibratable: Calibratable | None
    document: Document
    computer: np.ndarray | None = None

    @classmethod
    def plane(cls, config: RigConfig) -> 'Rig':
        """
        Build the simplest rig: cameras that move freely on a horizontal plane.

        Their headings change only if the caller changes them.
        """
        cameras = tuple(Camera(f'camera_{k}', '', config.model) for k in range(config.cameras))
        return cls(
            cameras, (), Mount('box', (config.height, config.height)), pitch=(0.0, 0.5 * np.pi),
            rolls=(0.0,), keep_clear=0.0, spacing=0.0, keep_out=(), keep_in=(), regions=(),
            requirements=(), seen_by=1, no_interference=False, calibratable=None,
            document=Document('rig', {}))

    @property
    def free(self) -> bool:
        """Return whether the cameras move freely on a plane without any constraint."""
        return self.mount.on == 'box'

    @property
    def group_cameras(self) -> list[Camera]:
        """Return the first camera of each group of the document; none has a count of 0."""
        counts = [group.get('count', 1) for group in self.document.data['cameras']]
        return [self.cameras[first] for first in np.cumsum([0, *counts[:-1]])]

    @property
    def least_cameras(self) -> int:
        """Return the least number of cameras, fixed ones included, that anything requires."""
        return max([self.seen_by, *(region.air.seen_by for region in self.regions if region.air),
                    *(requirement.cameras for requirement in self.requirements)])

    @property
    def motion(self) -> dict[str, float]:
        """Return the limits of a turn that the rig states: metres, radians, number of turns."""
        limits = dict(self.document.data.get('motion', {}))
        if 'max_turn' in limits:
            limits['max_turn'] = np.deg2rad(limits['max_turn'])
        return {name: limit if name == 'turns' else float(limit)
                for name, limit in limits.items()}

    @property
    def limits(self) -> dict[str, float]:
        """Return what replaces the default limits of a turn, also where the rig states none."""
        return (MOVING if self.mount.footprint else {}) | self.motion

    @property
    def farthest(self) -> float:
        """Return the largest range of the cameras, metres, at most 100 m for planners."""
        return min(max(camera.model.max_range for camera in self.cameras), 100.0)

    @property
    def clearance(self) -> float | None:
        """
        Return the distance that cameras on a horizontal plane keep from all points, metres.

        :returns: ``keep_clear`` for the mounts plane and free; 0 for walls and ceiling, since the
            cells of a plane do not distinguish the surface of the mount from other surfaces; None
            without a rig file: then ``episode.clearance`` applies.
        """
        if self.free:
            return None
        return self.keep_clear if self.mount.on in ('plane', 'free') else 0.0

    @property
    def models(self) -> tuple[CameraModel, ...]:
        """Return the models of all cameras: K to be placed, then F in place."""
        return tuple(camera.model for camera in self.all_cameras)

    @property
    def placed_models(self) -> tuple[CameraModel, ...]:
        """Return the different models of the cameras to be placed, each once."""
        return tuple(dict.fromkeys(camera.model for camera in self.cameras))

    @property
    def all_cameras(self) -> tuple[Camera, ...]:
        """Return all cameras: K to be placed, then F in place."""
        return self.cameras + tuple(fixed.camera for fixed in self.fixed)

    @property
    def axes(self) -> tuple[str, ...]:
        """
        Return the names of the components of an action on a camera to be placed.

        :returns: ``x`` and ``y``; also ``z`` if the mount allows a range of heights; also ``yaw``
            and ``pitch`` if a camera is not omnidirectional.
        """
        if self.free:
            return 'x', 'y'
        heights = self.mount.heights
        upwards = ('z',) if heights is not None and heights[0] < heights[1] else ()
        aimed = any(not camera.model.omnidirectional for camera in self.cameras)
        return ('x', 'y', *upwards, *(('yaw', 'pitch') if aimed else ()))

    def check_rotations(self, degrees: Iterable[float], found: str, expected: str) -> None:
        """
        Check that rooms are not rotated if the rig has poses or zones in the map frame.

        :param degrees: the rotations of rooms, degrees.
        :param found: the setting of the rotations and its value, with which the message begins.
        :param expected: the value that fits this rig.
        :raises ConfigurationError: if the rig has such poses or zones, and a room is rotated.
        """
        if any(degrees) and (self.fixed or self.keep_out or self.keep_in or self.regions):
            raise ConfigurationError(
                f'{found} with {self.document.name}, whose fixed, keep_out, keep_in or regions '
                f'are places in the map; expected {expected}: they do not turn with the room')

    @property
    def fixed_poses(self) -> np.ndarray:
        """Return the poses of the cameras in place: (F, 6) metres, map frame, and radians."""
        return np.array([fixed.pose for fixed in self.fixed]).reshape(-1, 6)


def load_rig(path: str | Path) -> Rig:
    """
    Read a rig.

    :param path: a YAML or JSON file; docs/reference/rig.md explains its keys.
    :raises ConfigurationError: if the file cannot be used: one sentence with file, line and key.
    """
    return rig_from(read_document(path, RIG))


def rig_of(cameras: int, sensor: str = OMNIDIRECTIONAL, **more: Any) -> Rig:
    """
    Build a rig of equal cameras without a file.

    :param cameras: the number of cameras.
    :param sensor: a preset, or a unique part of its name, such as ``d455``.
    :param more: other keys of a rig file.
    :raises ConfigurationError: for an unknown or ambiguous sensor, or another bad value.
    """
    data = {'cameras': [{'sensor': sensor_named(sensor), 'count': cameras}], **more}
    return rig_from(document_of('rig', data, RIG))


def with_count(rig: Rig, count: int) -> Rig:
    """
    Return a rig with another number of cameras to be placed.

    :param rig: a rig whose document has one group of cameras, which is one entry with a count.
    :param count: the number of cameras to be placed, above 0.
    :raises ConfigurationError: if there are several groups, or too many cameras.
    """
    document = rig.document
    if len(groups := document.data['cameras']) > 1:
        raise document.error(('cameras',), f'{len(groups)} groups', 'one, whose cameras can be '
                             'counted', 'write --count auto, or leave it out, or all groups but '
                             'one')
    return with_counts(rig, [count])


def with_counts(rig: Rig, counts: Sequence[int]) -> Rig:
    """
    Return a rig with another number of cameras of each of its groups.

    :param counts: for each entry of ``cameras`` in the rig's document; groups with 0 are left out.
    :raises ConfigurationError: if there are too many cameras.
    """
    document, groups = rig.document, []
    for old, count in zip(document.data['cameras'], counts, strict=True):
        group = {**old, 'count': count}
        # Serial numbers belong to a number of cameras.
        if 'serial' in group and count != old.get('count', 1):
            del group['serial']
        if count:
            groups.append(group)
    return rig_from(Document(document.name, {**document.data, 'cameras': groups},
                             document.lines))


def sensor_named(name: str) -> str:
    """
    Return the name of a preset, given this name or a unique part of it.

    :raises ConfigurationError: if no preset or several match; the message lists them.
    """
    if not isinstance(name, str):
        raise ConfigurationError(f'sensor: found {name!r}; expected the name of one, such as d455')
    if name in KINDS:
        return name
    matches = [kind for kind in KINDS if name and name.lower() in kind]
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise ConfigurationError(f'sensor: found {name!r}, which {" and ".join(matches)} have in '
                                 'common; expected one of them; write more of its name')
    raise ConfigurationError(f'sensor: found {name!r}; expected one of {", ".join(KINDS)} or a '
                             f'part of it; {nearest(name, KINDS, "choose one of them")}')


def model_of(document: Document, keys: Way) -> CameraModel:
    """
    Read a camera model: the parameters of a sensor, overridden by those given directly.

    :param keys: the keys that lead to the camera in the document.
    :raises ConfigurationError: if parameters are missing or contradict each other.
    """
    data = document.value(*keys)
    given: dict[str, Any] = {
        key: float(np.deg2rad(data[key])) if key.endswith('fov') else data[key]
        for key in MODEL if key in data}
    if 'depth_noise' in given:
        given['noise'] = DepthNoise(*(1e-3 * value for value in given.pop('depth_noise')))
    # Fields of view replace a focal length with a sensor size.
    given |= _pop_pinhole(document, keys, given)
    if 'resolution' in given:
        given['resolution'] = tuple(given['resolution'])
    sensor = given.pop('sensor', None)
    if sensor is None:
        for key in ('horizontal_fov', 'vertical_fov', 'max_range'):
            if key not in given:
                raise document.error(
                    keys, f'no {key} and no sensor', MODEL[key]['description'],
                    f'add {key}: {MODEL[key]["examples"][0]:g}, or a sensor')
        # The defaults of the parameters that need not be given.
        preset = CameraModel()
    elif sensor == OMNIDIRECTIONAL:
        preset = RigConfig().model
    else:
        preset = SENSORS[sensor].model
    low = given.get('min_range', preset.min_range)
    high = given.get('max_range', preset.max_range)
    if not low < high:
        key = 'min_range' if 'min_range' in given else 'max_range'
        raise document.error((*keys, key), f'min_range {low:g} m with max_range {high:g} m',
                             'the first to be less', 'exchange or correct them')
    return replace(preset, **given)


def _pop_pinhole(document: Document, keys: Way, given: dict[str, Any]) -> dict[str, float]:
    """Remove focal length and sensor size from ``given``; return their field of view, radians."""
    focal, size = given.pop('focal_length', None), given.pop('sensor_size', None)
    if focal is None and size is None:
        return {}
    if focal is None or size is None:
        present, missing = ('sensor_size', 'focal_length') if focal is None else (
            'focal_length', 'sensor_size')
        raise document.error((*keys, present), f'no {missing}', 'both or none',
                             f'add {missing}: {MODEL[missing]["examples"][0]}')
    for key in ('horizontal_fov', 'vertical_fov'):
        if key in given:
            raise document.error((*keys, key), 'it beside focal_length', 'one of the two, which '
                                 'both say the field of view', f'leave {key} out')
    fov = [2.0 * float(np.arctan(edge / (2.0 * focal))) for edge in size]
    if min(fov) < np.deg2rad(MIN_FOV_DEG):
        raise document.error((*keys, 'focal_length'), f'{focal:g} mm with the sensor_size {size}, '
                             f'a field of view of {np.rad2deg(min(fov)):.2g} degrees',
                             f'one of {MIN_FOV_DEG:g} degrees or more', 'correct the two')
    return dict(zip(('horizontal_fov', 'vertical_fov'), fov))


def pose_of(data: dict[str, Any]) -> np.ndarray:
    """Return the pose of a camera's entry in a file: (6,) metres and radians."""
    angles = np.deg2rad([float(data.get(key, 0.0)) for key in ('yaw', 'pitch', 'roll')])
    return np.array([*data['position'], *angles], dtype=np.float64)


def rig_from(document: Document) -> Rig:
    """
    Build a rig from a document that is valid under its schema.

    :raises ConfigurationError: for values that contradict each other.
    """
    data = document.data
    cameras, fixed = _cameras(document)
    count = len(cameras) + len(fixed)
    models = {camera.name: camera.model for camera in (*cameras, *(one.camera for one in fixed))}
    regions = tuple(_regions(document, count))
    seen_by = data.get('seen_by', 1)
    if seen_by > count:
        raise document.error(('seen_by',), str(seen_by), f'at most {count}, '
                             'as many as there are cameras', 'lower it or add cameras')
    low, high = np.deg2rad(_range(document, ('pitch',), data.get('pitch', [0.0, 90.0]))).tolist()
    return Rig(
        cameras, fixed, _mount(document), pitch=(low, high),
        rolls=tuple(np.deg2rad(data.get('roll', [0.0])).tolist()),
        keep_clear=float(data.get('keep_clear', 0.2)), spacing=float(data.get('spacing', 0.2)),
        keep_out=zones_of(document, 'keep_out'), keep_in=zones_of(document, 'keep_in'),
        regions=regions, requirements=tuple(_requirements(document, regions, models)),
        seen_by=seen_by, no_interference='interference' in data.get('require', {}),
        calibratable=_calibratable(data), document=document,
        computer=np.array(data['computer'], float) if 'computer' in data else None)


def _cameras(document: Document) -> tuple[tuple[Camera, ...], tuple[FixedCamera, ...]]:
    """Return the cameras to be placed and those in place, with unique names."""
    groups, fixed = document.data['cameras'], document.data.get('fixed', [])
    movable = [('cameras', k) for k, group in enumerate(groups)
               for _ in range(group.get('count', 1))]
    if len(movable) + len(fixed) > MAX_CAMERAS:
        raise document.error(('cameras',), f'{len(movable) + len(fixed)} cameras',
                             f'at most {MAX_CAMERAS}, fixed ones included', 'lower a count')
    cameras = tuple(cameras_at(document, [*movable, *(('fixed', k) for k in range(len(fixed)))]))
    return cameras[:len(movable)], tuple(
        FixedCamera(camera, pose_of(data), document.where('fixed', k))
        for k, (camera, data) in enumerate(zip(cameras[len(movable):], fixed)))


def cameras_at(document: Document, key_paths: list[Way]) -> Iterator[Camera]:
    """
    Yield cameras with unique names.

    :param key_paths: the keys that lead to each camera in the document; those of one group are the
        same.
    :raises ConfigurationError: if a name is given twice or a camera is invalid.
    """
    devices = _devices_of(document, key_paths)
    for keys, name, device in zip(key_paths, names_of(document, key_paths), devices):
        data = document.value(*keys)
        listed = PRICES.get(data.get('sensor', ''))
        yield Camera(name, data.get('sensor', ''), model_of(document, keys), device,
                     data.get('price', listed and listed.amount))


def _devices_of(document: Document, key_paths: list[Way]) -> Iterator[Device]:
    """
    Yield what connects cameras to computers; the parameters are those of :func:`cameras_at`.

    :raises ConfigurationError: if a serial number occurs twice, or a group of several cameras does
        not have one for each.
    """
    used: set[str] = set()
    for keys, count in Counter(key_paths).items():
        data = document.value(*keys)
        serials = data.get('serial', [''] * count)
        serials = [serials] if isinstance(serials, str) else serials
        if len(serials) != count:
            raise document.error((*keys, 'serial'), f'{len(serials)} for {count} cameras',
                                 'one for each camera of the group', 'write a list of them')
        for serial in filter(None, serials):
            if serial in used:
                raise document.error((*keys, 'serial'), f'{serial!r}, which another camera has',
                                     'one of its own', 'correct it')
            used.add(serial)
        yield from (Device(serial, *(data.get(key, '') for key in Device._fields[1:]))
                    for serial in serials)


def names_of(document: Document, key_paths: list[Way]) -> Iterator[str]:
    """
    Yield unique camera names: the name, else the sensor, else ``camera``; numbered if shared.

    :param key_paths: the keys that lead to each camera in the document; those of one group are the
        same.
    :raises ConfigurationError: if a name is given twice.
    """
    entries = [document.value(*keys) for keys in key_paths]
    stems = [entry.get('name', entry.get('sensor', 'camera')) for entry in entries]
    # How many cameras have each stem: in all, and up to the present camera.
    totals, used = Counter(stems), Counter()
    given_at: dict[str, Way] = {}
    names: set[str] = set()
    for keys, entry, stem in zip(key_paths, entries, stems):
        used[stem] += 1
        named = 'name' in entry
        # Cameras with the same stem, such as those of one group, are numbered.
        number = '' if totals[stem] == 1 else f'_{used[stem]}'
        name = stem[:MAX_NAME_LENGTH - len(number)] + number
        # Only cameras of one group, which have the same keys, may be given the same name.
        if name in names or (named and given_at.setdefault(stem, keys) != keys):
            raise document.error((*keys, 'name' if named else 'sensor'), f'the name {stem!r}, '
                                 'which another camera has', 'one of its own',
                                 'give it another name')
        names.add(name)
        yield name


def _mount(document: Document) -> Mount:
    """Return the mount of the cameras."""
    data = document.data.get('mount', {'on': 'plane'})
    on, given = data['on'], data.get('height')
    if isinstance(given, list) and on in ('plane', 'ceiling'):
        raise document.error(('mount', 'height'), describe(given), f'one number for {on}',
                             f'write, for example, height: {given[0]:g}, or on: free')
    heights = DEFAULT_HEIGHTS_M[on] if given is None else _range(
        document, ('mount', 'height'), given)
    on_tripods = on == 'plane' and heights[1] < MAX_TRIPOD_HEIGHT_M
    footprint = data.get('footprint', TRIPOD_FOOTPRINT_M if on_tripods else 0.0)
    if footprint and on not in ('plane', 'free'):
        raise document.error(('mount', 'footprint'), describe(footprint), f'none for {on}',
                             'leave it out, or write on: plane for cameras on tripods')
    return Mount(on, heights, footprint)


def _range(document: Document, keys: Way, value: Any) -> tuple[float, float]:
    """Return the low and the high end of a value: one number, or two in a list."""
    low, high = value if isinstance(value, list) else (value, value)
    if low > high:
        raise document.error(keys, describe(value), 'the lower number first',
                             f'write [{high:g}, {low:g}]')
    return float(low), float(high)


def _calibratable(data: dict[str, Any]) -> Calibratable | None:
    """Return the condition for links between cameras; None if the file has none."""
    condition = data.get('calibratable')
    return None if condition is None else Calibratable(
        float(condition.get('overlap', 0.2)), float(np.deg2rad(condition.get('angle', 60.0))))


def _regions(document: Document, cameras: int) -> Iterator[Region]:
    """Yield the regions, with unique names; ``cameras`` is the limit of their ``seen_by``."""
    names = set()
    for k, data in enumerate(document.data.get('regions', [])):
        if data['name'] in names:
            raise document.error(('regions', k, 'name'), f'the name {data["name"]!r}, which '
                                 'another region has', 'one of its own', 'give it another name')
        names.add(data['name'])
        must_see = data.get('must_see', False)
        # As numbers, True is 1 and False is 0.
        share = MUST_SEE_SHARE * must_see if isinstance(must_see, bool) else float(must_see)
        yield Region(data['name'], zone_of(document, ('regions', k)),
                     float(data.get('weight', 1.0)), share, document.where('regions', k),
                     _sight_condition(document, ('regions', k, 'air'), cameras))


def _requirements(document: Document, regions: Sequence[Region], models: dict[str, CameraModel]
                  ) -> Iterator[Requirement]:
    """
    Yield the requirement of the whole room and those of regions, where the file has them.

    :param models: the model of each camera, by its name.
    :raises ConfigurationError: for a region of air, more cameras than there are, or a limit for
        which a camera lacks a parameter.
    """
    parts: list[tuple[Way, Region | None]] = [
        ((), None), *((('regions', k), region) for k, region in enumerate(regions))]
    for parents, region in parts:
        keys = (*parents, 'require')
        data = document.value(*parents).get('require')
        # Interference is about pairs of cameras, not about points.
        if data is None or data.keys() == {'interference'}:
            continue
        if region is not None and region.air is not None:
            raise document.error(keys, 'it in a region of air', 'a region of points', 'write '
                                 'seen_by and angle under air, or leave out air')
        density, noise, angle = (data.get(key) for key in (
            'pixel_density', 'depth_accuracy', 'incidence'))
        requirement = Requirement(
            '' if region is None else region.name, None if region is None else region.zone,
            PIXEL_DENSITIES.get(density, density),
            None if noise is None else 1e-3 * noise,
            None if angle is None else float(np.deg2rad(angle)),
            _sight_condition(document, keys, len(models)),
            data.get('one_may_fail', False), float(data.get('share', MUST_SEE_SHARE)),
            document.where(*keys))
        if requirement.cameras > len(models):
            raise document.error((*keys, 'one_may_fail'), f'true with {len(models)} cameras',
                                 f'{requirement.cameras} cameras or more', 'add cameras')
        for camera, model in models.items():
            try:
                requirement.limits_of(model)
            except ValueError as error:
                raise document.error(keys, f'{camera}, a camera without {error}', 'cameras with '
                                     'it', f'add {error} to it') from error
        yield requirement


def _sight_condition(document: Document, keys: Way, cameras: int) -> SightCondition | None:
    """
    Return the condition for points or air to count as seen; None if there is none.

    :param keys: the keys that lead to the condition, which the document may lack.
    :param cameras: the number of cameras, which is the limit of ``seen_by``.
    """
    data = document.value(*keys[:-1]).get(keys[-1])
    if data is None:
        return None
    around = data.get('around', False)
    least = 3 if around else 1
    seen_by = data.get('seen_by', least)
    if seen_by < least:
        raise document.error((*keys, 'seen_by'), f'{seen_by} with around: true', f'at least '
                             f'{least}: fewer cameras leave a gap of more than 120 degrees',
                             'raise it or leave around out')
    if seen_by > cameras:
        raise document.error((*keys, 'seen_by' if 'seen_by' in data else 'around'), str(seen_by),
                             f'at most {cameras}, as many as there are cameras',
                             'lower it or add cameras')
    return SightCondition(seen_by, float(np.deg2rad(data.get('angle', 0.0))), around)
