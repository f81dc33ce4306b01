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
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.rig_config import KINDS, OMNIDIRECTIONAL, RigConfig
from ocp_ros.rig.schemas import MAX_NAME_LENGTH, MIN_FOV_DEG, MODEL, RIG
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rig.zones import Zone, zone_of, zones_of
from ocp_ros.util.settings import ConfigurationError, MAX_CAMERAS
from ocp_ros.util.yaml_files import check, describe, Document, nearest, read_document, Way

#: The share of a region's points that has to be seen with ``must_see: true``: some points are
#: noise, and some are occluded from everywhere.
MUST_SEE_SHARE = 0.95
#: The default heights above the floor in metres; a ceiling mount has the height of the ceiling.
DEFAULT_HEIGHTS_M = {'plane': (1.9, 1.9), 'ceiling': None, 'walls': (1.5, 2.5), 'free': (1.5, 2.5)}


class Camera(NamedTuple):
    """
    A camera of a rig.

    :ivar name: its unique name in tables.
    :ivar sensor: its preset, or '' for parameters given directly.
    :ivar model: its camera model.
    """

    name: str
    sensor: str
    model: CameraModel


class Fixed(NamedTuple):
    """
    A camera that is in place already and stays.

    :ivar camera: the camera.
    :ivar pose: (6,) x, y, z, yaw, pitch, roll: metres, map frame, and radians.
    :ivar where: the place in the file, for messages.
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
    :ivar footprint: the radius around the point below a camera that has to be free floor, metres:
        the feet of a tripod; 0 for cameras on poles and rods.
    """

    on: str
    heights: tuple[float, float] | None
    footprint: float = 0.0


class Watched(NamedTuple):
    """
    The condition for a position in the air to count as seen.

    :ivar seen_by: the number of cameras that have to see it.
    :ivar angle: the least angle between the lines of sight of any two of these cameras, radians.
    """

    seen_by: int
    angle: float


class Region(NamedTuple):
    """
    A part of the room with an additional weight or requirement.

    :ivar weight: the weight in the objective; the whole room has 1.
    :ivar must_see: the share of its points, or of its air, that has to be seen; 0 for none.
    :ivar where: the place in the file, for messages.
    :ivar air: the condition for its air to count as seen; None for a region whose points have to
        be seen.
    """

    name: str
    zone: Zone
    weight: float
    must_see: float
    where: str
    air: Watched | None = None

    @property
    def parts(self) -> str:
        """Return the kind of parts of the region that have to be seen."""
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
    :ivar regions: the regions with additional weights or requirements.
    :ivar seen_by: the number of cameras that have to see a point.
    :ivar calibratable: the condition for links between cameras, which have to connect all of them;
        None if not required.
    :ivar document: the document that the rig was read from; empty if there is none.
    """

    cameras: tuple[Camera, ...]
    fixed: tuple[Fixed, ...]
    mount: Mount
    pitch: tuple[float, float]
    rolls: tuple[float, ...]
    keep_clear: float
    spacing: float
    keep_out: tuple[Zone, ...]
    keep_in: tuple[Zone, ...]
    regions: tuple[Region, ...]
    seen_by: int
    calibratable: Calibratable | None
    document: Document

    @classmethod
    def plane(cls, config: RigConfig) -> 'Rig':
        """
        Build the simplest rig: cameras that move freely on a horizontal plane.

        Their headings change only if the caller changes them.
        """
        models = config.models * (config.cameras // len(config.models))
        cameras = tuple(Camera(f'camera_{k}', '', model) for k, model in enumerate(models))
        return cls(cameras, (), Mount('box', (config.height, config.height)), (0.0, 0.5 * np.pi),
                   (0.0,), 0.0, 0.0, (), (), (), 1, None, Document('rig', {}))

    @property
    def free(self) -> bool:
        """Return whether its cameras move freely on a plane without any constraint."""
        return self.mount.on == 'box'

    @property
    def farthest(self) -> float:
        """Return the largest range of its cameras that planners use, metres."""
        return min(max(camera.model.max_range for camera in self.cameras), 100.0)

    @property
    def clearance(self) -> float | None:
        """
        Return the distance that cameras on a horizontal plane keep from all points, metres.

        :returns: 0 for cameras that are mounted on walls or the ceiling: on a plane their own
            surface looks like any other; None without a rig file: ``episode.clearance`` applies.
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
        """Return the models of the cameras to be placed, each once."""
        return tuple(dict.fromkeys(camera.model for camera in self.cameras))

    @property
    def all_cameras(self) -> tuple[Camera, ...]:
        """Return all cameras: K to be placed, then F in place."""
        return self.cameras + tuple(fixed.camera for fixed in self.fixed)

    @property
    def axes(self) -> tuple[str, ...]:
        """
        Return the components of an action on a camera to be placed.

        :returns: ``x`` and ``y``; ``z`` if the mount allows a range of heights; ``yaw`` and
            ``pitch`` if a camera is not omnidirectional.
        """
        if self.free:
            return 'x', 'y'
        heights = self.mount.heights
        upwards = ('z',) if heights is not None and heights[0] < heights[1] else ()
        aimed = any(not camera.model.omnidirectional for camera in self.cameras)
        return ('x', 'y', *upwards, *(('yaw', 'pitch') if aimed else ()))

    def check_rotations(self, degrees: Iterable[float], found: str, expected: str) -> None:
        """
        Refuse rotated rooms for a rig with poses or zones in the map, which do not rotate.

        :param degrees: the rotations of rooms.
        :param found: the setting of the rotations and its value, with which the message begins.
        :param expected: the value that fits this rig.
        :raises ConfigurationError: if the rig has such poses or zones, and rooms are rotated.
        """
        if any(degrees) and (
                self.fixed or self.keep_out or self.keep_in or self.regions):
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
    :raises ConfigurationError: if it cannot be used: one sentence with file, line and key.
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
    document = Document('rig', data)
    check(document, RIG)
    return rig_from(document)


def with_count(rig: Rig, count: int) -> Rig:
    """
    Return a rig with another number of cameras to be placed.

    :param rig: a rig whose cameras are of one group.
    :param count: the number of cameras to be placed, above 0.
    :raises ConfigurationError: if its cameras are of several groups, or too few or too many.
    """
    document = rig.document
    if len(groups := document.data['cameras']) > 1:
        raise document.error(('cameras',), f'{len(groups)} groups', 'one, whose cameras can be '
                             'counted', 'leave out --count, or all groups but one')
    data = {**document.data, 'cameras': [{**groups[0], 'count': count}]}
    return rig_from(Document(document.name, data, document.lines))


def sensor_named(name: str) -> str:
    """
    Find a preset by its name or a unique part of it.

    :raises ConfigurationError: if no preset or several match; the message lists them.
    """
    if not isinstance(name, str):
        raise ConfigurationError(f'sensor: found {name!r}; expected the name of one, such as d455')
    if name in KINDS:
        return name
    found = [kind for kind in KINDS if name and name.lower() in kind]
    if len(found) == 1:
        return found[0]
    if found:
        raise ConfigurationError(f'sensor: found {name!r}, which {" and ".join(found)} have in '
                                 'common; expected one of them; write more of its name')
    raise ConfigurationError(f'sensor: found {name!r}; expected one of {", ".join(KINDS)} or a '
                             f'part of it; {nearest(name, KINDS, "choose one of them")}')


def model_of(document: Document, way: Way) -> CameraModel:
    """
    Read a camera model: the parameters of its sensor, overridden by those given beside it.

    :param way: the path of the camera in the document.
    :raises ConfigurationError: if parameters are missing or contradict each other.
    """
    data = document.value(*way)
    given = {key: data[key] for key in MODEL if key in data}
    given = {key: float(np.deg2rad(value)) if key.endswith('fov') else value
             for key, value in given.items()}
    given |= _lens(document, way, given)
    if 'resolution' in given:
        given['resolution'] = tuple(given['resolution'])
    sensor = given.pop('sensor', None)
    if sensor is None:
        for key in ('horizontal_fov', 'vertical_fov', 'max_range'):
            if key not in given:
                raise document.error(
                    way, f'no {key} and no sensor', MODEL[key]['description'],
                    f'add {key}: {MODEL[key]["examples"][0]:g}, or a sensor')
        preset = CameraModel()
    elif sensor == OMNIDIRECTIONAL:
        preset, = RigConfig(cameras=1).models
    else:
        preset = SENSORS[sensor].model
    low = given.get('min_range', preset.min_range)
    high = given.get('max_range', preset.max_range)
    if not low < high:
        key = 'min_range' if 'min_range' in given else 'max_range'
        raise document.error((*way, key), f'min_range {low:g} m with max_range {high:g} m',
                             'the first to be less', 'exchange or correct them')
    return replace(preset, **given)


def _lens(document: Document, way: Way, given: dict[str, Any]) -> dict[str, float]:
    """Remove the keys of a lens from ``given``, and return the field of view of its pinhole."""
    focal, size = given.pop('focal_length', None), given.pop('sensor_size', None)
    if focal is None and size is None:
        return {}
    if focal is None or size is None:
        there, missing = ('sensor_size', 'focal_length') if focal is None else (
            'focal_length', 'sensor_size')
        raise document.error((*way, there), f'no {missing}', 'both or none',
                             f'add {missing}: {MODEL[missing]["examples"][0]}')
    for key in ('horizontal_fov', 'vertical_fov'):
        if key in given:
            raise document.error((*way, key), 'it beside focal_length', 'one of the two, which '
                                 'both say the field of view', f'leave {key} out')
    fields = [2.0 * float(np.arctan(edge / (2.0 * focal))) for edge in size]
    if min(fields) < np.deg2rad(MIN_FOV_DEG):
        raise document.error((*way, 'focal_length'), f'{focal:g} mm with the sensor_size {size}, '
                             f'a field of view of {np.rad2deg(min(fields)):.2g} degrees',
                             f'one of {MIN_FOV_DEG:g} degrees or more', 'correct the two')
    return dict(zip(('horizontal_fov', 'vertical_fov'), fields))


def pose_of(data: dict[str, Any]) -> np.ndarray:
    """Return the pose of an entry of a file: (6,) metres and radians."""
    angles = np.deg2rad([float(data.get(key, 0.0)) for key in ('yaw', 'pitch', 'roll')])
    return np.array([*data['position'], *angles], dtype=np.float64)


def rig_from(document: Document) -> Rig:
    """
    Build a rig from a document that is valid under its schema.

    :raises ConfigurationError: for values that contradict each other.
    """
    data = document.data
    cameras, fixed = _cameras(document)
    regions = tuple(_regions(document, len(cameras) + len(fixed)))
    seen_by = data.get('seen_by', 1)
    if seen_by > len(cameras) + len(fixed):
        raise document.error(('seen_by',), str(seen_by), f'at most {len(cameras) + len(fixed)}, '
                             'as many as there are cameras', 'lower it or add cameras')
    low, high = _range(document, ('pitch',), data.get('pitch', [0.0, 90.0]))
    return Rig(cameras, fixed, _mount(document), (float(np.deg2rad(low)), float(np.deg2rad(high))),
               tuple(map(float, np.deg2rad(data.get('roll', [0.0])))),
               float(data.get('keep_clear', 0.2)), float(data.get('spacing', 0.2)),
               zones_of(document, 'keep_out'), zones_of(document, 'keep_in'), regions, seen_by,
               _calibratable(data), document)


def _cameras(document: Document) -> tuple[tuple[Camera, ...], tuple[Fixed, ...]]:
    """Read the cameras to be placed and those in place, with unique names."""
    groups, fixed = document.data['cameras'], document.data.get('fixed', [])
    movable = [('cameras', k) for k, group in enumerate(groups)
               for _ in range(group.get('count', 1))]
    if len(movable) + len(fixed) > MAX_CAMERAS:
        raise document.error(('cameras',), f'{len(movable) + len(fixed)} cameras',
                             f'at most {MAX_CAMERAS}, fixed ones included', 'lower a count')
    ways = [*movable, *(('fixed', k) for k in range(len(fixed)))]
    cameras = tuple(cameras_at(document, ways))
    count = len(movable)
    return cameras[:count], tuple(
        Fixed(camera, pose_of(data), document.where('fixed', k))
        for k, (camera, data) in enumerate(zip(cameras[count:], fixed)))


def cameras_at(document: Document, ways: list[Way]) -> Iterator[Camera]:
    """
    Read cameras with unique names.

    :param ways: the path of each camera in the document; cameras of one group share a path.
    :raises ConfigurationError: if a name is given twice or a camera is invalid.
    """
    for way, name in zip(ways, names_of(document, ways)):
        yield Camera(name, document.value(*way).get('sensor', ''), model_of(document, way))


def names_of(document: Document, ways: list[Way]) -> Iterator[str]:
    """
    Yield unique camera names from name, sensor or kind, numbered if several share one.

    :param ways: the path of each camera in the document; cameras of one group share a path.
    :raises ConfigurationError: if a name is given twice.
    """
    entries = [document.value(*way) for way in ways]
    stems = [entry.get('name', entry.get('sensor', 'camera')) for entry in entries]
    totals, used = Counter(stems), Counter()
    given: dict[str, Way] = {}
    taken: set[str] = set()
    for way, entry, stem in zip(ways, entries, stems):
        used[stem] += 1
        named = 'name' in entry
        # Cameras of one group share a name, followed by a number.
        number = '' if totals[stem] == 1 else f'_{used[stem]}'
        name = stem[:MAX_NAME_LENGTH - len(number)] + number
        if name in taken or (named and given.setdefault(stem, way) != way):
            raise document.error((*way, 'name' if named else 'sensor'), f'the name {stem!r}, '
                                 'which another camera has', 'one of its own',
                                 'give it another name')
        taken.add(name)
        yield name


def _mount(document: Document) -> Mount:
    """Read the mount of the cameras."""
    data = document.data.get('mount', {'on': 'plane'})
    on, given, footprint = data['on'], data.get('height'), data.get('footprint', 0.0)
    if footprint and on not in ('plane', 'free'):
        raise document.error(('mount', 'footprint'), describe(footprint), f'none for {on}',
                             'leave it out, or write on: plane for cameras on tripods')
    if given is None:
        return Mount(on, DEFAULT_HEIGHTS_M[on], footprint)
    if isinstance(given, list) and on in ('plane', 'ceiling'):
        raise document.error(('mount', 'height'), describe(given), f'one number for {on}',
                             f'write, for example, height: {given[0]:g}, or on: free')
    return Mount(on, _range(document, ('mount', 'height'), given), footprint)


def _range(document: Document, way: Way, value: Any) -> tuple[float, float]:
    """Read one number or a range."""
    low, high = value if isinstance(value, list) else (value, value)
    if low > high:
        raise document.error(way, describe(value), 'the lower number first',
                             f'write [{high:g}, {low:g}]')
    return float(low), float(high)


def _calibratable(data: dict[str, Any]) -> Calibratable | None:
    """Read the condition for links between cameras, if the file has one."""
    asked = data.get('calibratable')
    return None if asked is None else Calibratable(
        float(asked.get('overlap', 0.2)), float(np.deg2rad(asked.get('angle', 60.0))))


def _regions(document: Document, most: int) -> Iterator[Region]:
    """Read the regions, with unique names; ``most`` is the number of cameras."""
    names = set()
    for k, data in enumerate(document.data.get('regions', [])):
        if data['name'] in names:
            raise document.error(('regions', k, 'name'), f'the name {data["name"]!r}, which '
                                 'another region has', 'one of its own', 'give it another name')
        names.add(data['name'])
        must_see = data.get('must_see', False)
        share = MUST_SEE_SHARE * must_see if isinstance(must_see, bool) else float(must_see)
        yield Region(data['name'], zone_of(document, ('regions', k)),
                     float(data.get('weight', 1.0)), share, document.where('regions', k),
                     _watched(document, ('regions', k, 'air'), most))


def _watched(document: Document, way: Way, most: int) -> Watched | None:
    """Read the condition for the air of a region to count as seen, if it has one."""
    data = document.value(*way[:-1]).get('air')
    if data is None:
        return None
    seen_by = data.get('seen_by', 1)
    if seen_by > most:
        raise document.error((*way, 'seen_by'), str(seen_by), f'at most {most}, as many as there '
                             'are cameras', 'lower it or add cameras')
    return Watched(seen_by, float(np.deg2rad(data.get('angle', 0.0))))
