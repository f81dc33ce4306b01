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

"""``ocp_ros.plan`` and ``ocp_ros.score``: Python functions for ``ocp plan`` and ``ocp score``."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import fspath, PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from ocp_ros.report.assessment import assess, Assessment
from ocp_ros.report.rig_planning import CAMERAS, Counting, MOUNT, PlannedRig, PlanTask
from ocp_ros.report.terminal import as_text, show_score
from ocp_ros.rig.placement_file import (
    load_placement,
    Placement,
    placement_from,
    placement_of,
    save_placement,
)
from ocp_ros.rig.rig_file import load_rig, Rig, rig_from, rig_of, with_count
from ocp_ros.rig.schemas import PLACEMENT, RIG
from ocp_ros.rig.sensors import OMNIDIRECTIONAL
from ocp_ros.rooms.scene_source import READING, room_named, ROOM_POINTS, sha256_of
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.scene_files import scene_of
from ocp_ros.search.budget import Progress
from ocp_ros.search.registry import RIG_SEARCH
from ocp_ros.util.settings import (
    check_positive,
    check_whole,
    ConfigurationError,
    MAX_CAMERAS,
    MAX_SEED,
    MIN_ROOM_POINTS,
)
from ocp_ros.util.yaml_files import document_of

RoomLike: TypeAlias = str | PathLike[str] | int | Scene | ArrayLike
RigLike: TypeAlias = str | PathLike[str] | Mapping[str, Any] | Rig
#: The value of ``cameras`` with which the function chooses the number of cameras.
AUTO = 'auto'


@dataclass(frozen=True, eq=False)
class ScoreResult:
    """
    The scores of a placement; ``print`` shows the output of ``ocp score``.

    :ivar placement: the poses of the cameras, the rig and the record of the room.
    :ivar loss: objective value, which planners minimise.
    :ivar depth_error: metres.
    :ivar space_coverage: cubic metres.
    :ivar seen: share of the points that are visible to at least as many cameras as the rig asks
        for.
    :ivar broken: a sentence for each violated constraint of the rig.
    :ivar notes: a sentence for each reason to doubt the room or the result.
    :ivar assessment: the room, the engine and all results, for reports.
    """

    placement: Placement
    loss: float
    depth_error: float
    space_coverage: float
    seen: float
    broken: tuple[str, ...]
    notes: tuple[str, ...]
    assessment: Assessment = field(repr=False)

    @property
    def poses(self) -> np.ndarray:
        """Return the poses of the placed cameras: (K, 6) metres, map frame, and radians."""
        return self.placement.poses

    @property
    def found(self) -> dict[str, Any]:
        """Return the output of ``--json`` as plain data."""
        return dict(self.assessment.found)

    def save(self, path: str | Path) -> None:
        """
        Write the placement with its scores, for ``ocp score`` and ``ocp view``.

        :param path: ``.json`` for JSON, YAML for any other suffix.
        :raises OSError: if the file cannot be written.
        """
        save_placement(path, self.placement)

    def __str__(self) -> str:
        """Return the result as tables and sentences."""
        return as_text(show_score, self.assessment.found)


@dataclass(frozen=True, eq=False)
class PlanResult(ScoreResult):
    """
    A planned placement with its scores; ``print`` shows the output of ``ocp plan``.

    :ivar planner: name of the planner.
    :ivar evaluations: number of placements that were evaluated, or of turns that were played.
    :ivar seconds: duration of the search, seconds.
    :ivar gap: optimality gap: no placement on the candidate poses of the proof has an objective
        value that is lower by more than this share; None if no bound was proved.
    :ivar reached: whether the target was reached; None without ``cameras='auto'``.
    """

    planner: str
    evaluations: int
    seconds: float
    gap: float | None
    reached: bool | None


def plan(room: RoomLike, rig: RigLike | None = None, *, cameras: int | str | None = None,
         sensor: str = OMNIDIRECTIONAL, mount: str | None = None, planner: str = RIG_SEARCH,
         seconds: float | None = None, evaluations: int | None = None, seed: int = 0,
         target: float = 0.95, by: str = 'error', most: int = 12, budget: float | None = None,
         points: int = ROOM_POINTS, progress: Progress | None = None, **reading: Any
         ) -> PlanResult:
    """
    Find the best poses of cameras in a room, as ``ocp plan`` does.

    :param room: path of a scan, seed of a generated room, (N, 3) points or a scene.
    :param rig: path of a rig file, the content of such a file as a mapping, or a rig.
    :param cameras: number of cameras, or ``'auto'`` to find the number; default: 4, or as in the
        rig.
    :param sensor: sensor of all cameras if no rig is given, or a part of its name such as
        ``d455``.
    :param mount: mount of all cameras if no rig is given: ``walls`` (the default), ``ceiling``,
        ``plane`` or ``free``.
    :param planner: name of the planner, see docs/reference/planners.md.
    :param seconds: largest time of the search; default without ``evaluations``: 60, or with
        ``'auto'`` 15 for each number of cameras.
    :param evaluations: number of placements to evaluate; with it and without ``seconds``, the
        same seed gives the same result.
    :param seed: random seed.
    :param target: with ``'auto'``, the share to reach, from 0 to 1; 1 is the value of all
        candidates together.
    :param by: with ``'auto'``, the quantity of this share: ``error`` (reduction of the depth
        error), ``seen`` (visible points) or ``coverage`` (covered space).
    :param most: with ``'auto'``, the largest number of cameras to try, times the number of rooms
        on a floor of several rooms; these have the share in each room.
    :param budget: with ``'auto'``, the largest price of all cameras to be placed.
    :param points: largest number of points of the room; a larger scan is thinned to it.
    :param progress: is called several times a second with the used share of the budget and the
        lowest objective value; its result is ignored.
    :param reading: options for a scan or points: ``scale``, ``up``, ``drop_nonfinite``,
        ``all_rooms``, ``height`` and others; see :func:`~ocp_ros.scenes.scene_files.load_scene`.
    :raises UserError: if the room, the rig or an argument cannot be used; the text is one
        sentence.
    """
    check_positive('seconds', seconds)
    check_whole('evaluations', evaluations)
    check_whole('seed', seed, 0, MAX_SEED)
    if progress is not None and not callable(progress):
        raise ConfigurationError(f'progress: found {progress!r}; expected a function')
    auto = isinstance(cameras, str) and cameras == AUTO
    check_positive('budget', budget)
    counting = _counting(target, by, most) if auto else None
    if counting is not None and budget is not None:
        counting = counting._replace(budget=float(budget))
    task = PlanTask(planner, seconds, evaluations, seed, counting)
    full_rig = _read_rig(rig, cameras, sensor, mount)
    scene, record = _read_room(room, points, reading)
    # The constructor runs the search.
    planned = PlannedRig(scene, full_rig, task, *task.budgets(), progress)
    assessment = planned.assessment_of(planned.placement(record, 'ocp_ros.plan'))
    search = assessment.found['search']
    # None if the number of cameras was given.
    counted = assessment.found.get('count')
    return PlanResult(
        **_result_fields(assessment), gap=search['certificate']['gap'],
        reached=counted and counted['reached'],
        **{name: search[name] for name in ('planner', 'evaluations', 'seconds')})


def score(room: RoomLike, placement: str | PathLike[str] | Mapping[str, Any] | Placement
          | ScoreResult | ArrayLike, rig: RigLike | None = None, *,
          sensor: str = OMNIDIRECTIONAL, points: int | None = None, **reading: Any
          ) -> ScoreResult:
    """
    Evaluate a planned or existing placement of cameras in a room, as ``ocp score`` does.

    :param room: path of a scan, seed of a generated room, (N, 3) points or a scene.
    :param placement: path of a placement file, the content of such a file as a mapping, a
        placement, a result of :func:`plan`, or poses (K, 3) or (K, 6): metres, map frame, and
        radians.
    :param rig: rig with constraints and weights, used instead of the one in the placement.
    :param sensor: sensor of all cameras if the placement is an array of poses and no rig is given.
    :param points: largest number of points of the room; default: as in the placement, or 60,000.
    :param reading: options for a scan or points: ``scale``, ``up``, ``drop_nonfinite``,
        ``all_rooms`` and others, as for :func:`plan`.
    :raises UserError: if the room, the placement or the rig cannot be used; the text is one
        sentence.
    """
    other_rig = None if rig is None else _read_rig(rig, None, sensor)
    full_placement = _read_placement(placement, other_rig, sensor)
    record = full_placement.room
    # A scan is read with the options in the placement; arguments replace them.
    stored_reading = {key: record[key] for key in READING
                      if key in record and isinstance(room, (str, PathLike))}
    max_points = points if points is not None else record.get('points', ROOM_POINTS)
    scene, new_record = _read_room(room, max_points, {**stored_reading, **reading})
    return ScoreResult(**_result_fields(
        assess(scene, full_placement, new_record, 'ocp_ros.score')))


def _result_fields(assessment: Assessment) -> dict[str, Any]:
    """Return the values of the fields of a ScoreResult, by name."""
    found = assessment.found
    scores = found['scores']
    return {'placement': assessment.placement, 'broken': tuple(found['broken']),
            'notes': tuple(found['notes']), 'assessment': assessment,
            **{name: scores[name] for name in ('loss', 'depth_error', 'space_coverage', 'seen')}}


def _read_room(room: RoomLike, max_points: int, options: dict[str, Any]
               ) -> tuple[Scene, dict[str, Any]]:
    """Return the scene of a room, and the record of the room for placement files."""
    check_whole('points', max_points, MIN_ROOM_POINTS)
    for key in options:
        if key not in READING:
            raise ConfigurationError(f'{key}: found an argument that is not known; expected one '
                                     f'of {", ".join(READING)}; correct its name')
    if isinstance(room, (Scene, int, np.integer)) and options:
        raise ConfigurationError(
            f'{next(iter(options))}: found it with a room that is in metres, z up; expected a '
            'scan or points; leave it out')
    if isinstance(room, (int, np.integer)) and not isinstance(room, bool) and room >= 0:
        return room_named(str(room), max_points)
    if isinstance(room, (str, PathLike)):
        return room_named(fspath(room), max_points, **options)
    if room is None or isinstance(room, (bool, int, float)):
        raise ConfigurationError(f'room: found {room!r}; expected the path of a scan, a seed of 0 '
                                 'or more, (N, 3) points or a Scene')
    scene = room if isinstance(room, Scene) else scene_of(room, max_points=max_points, **options)
    record: dict[str, Any] = {'sha256': sha256_of(scene)}
    # Placement files need a transform if the axes or units of the input are not those of the map.
    if not scene.source.is_map:
        record['source_from_map'] = scene.source.matrix.tolist()
    return scene, record


def _read_rig(rig: RigLike | None, cameras: int | str | None, sensor: str,
              mount: str | None = None) -> Rig:
    """Return a rig; with ``'auto'``, planning replaces its number of cameras later."""
    auto = isinstance(cameras, str) and cameras == AUTO
    if not auto:
        # The check accepts None, with which the rig says the number.
        check_whole('cameras', cameras, 1, MAX_CAMERAS)
    count = None if auto else cameras
    if rig is None:
        return rig_of(int(count or CAMERAS), sensor, mount={'on': mount or MOUNT})
    # The default means that no sensor was given.
    if sensor != OMNIDIRECTIONAL:
        raise ConfigurationError(f'sensor: found {sensor!r} with a rig; expected one of the two: '
                                 'a rig says its sensors; leave one out')
    if mount is not None:
        raise ConfigurationError(f'mount: found {mount!r} with a rig; expected one of the two: a '
                                 'rig says its mount; leave one out')
    if isinstance(rig, (str, PathLike)):
        rig = load_rig(fspath(rig))
    elif isinstance(rig, Mapping):
        rig = rig_from(document_of('rig', rig, RIG))
    elif not isinstance(rig, Rig):
        raise ConfigurationError(f'rig: found {type(rig).__name__}; expected the path of a rig '
                                 'file, its content as a mapping, or a rig; see '
                                 'docs/reference/rig.md')
    # ``with_count`` refuses a rig with several groups of cameras.
    return with_count(rig, int(count)) if count else rig


def _read_placement(placement: Any, rig: Rig | None, sensor: str) -> Placement:
    """Return a placement from any of the types that :func:`score` takes."""
    if isinstance(placement, ScoreResult):
        placement = placement.placement
    if isinstance(placement, (str, PathLike)):
        return load_placement(fspath(placement), rig)
    if isinstance(placement, Mapping):
        return placement_from(document_of('placement', placement, PLACEMENT), rig)
    if isinstance(placement, Placement):
        return placement if rig is None else placement_of(
            rig, _checked_poses(placement.poses, rig), room=placement.room,
            engine=placement.engine)
    poses = _checked_poses(placement, rig)
    return placement_of(rig or rig_of(len(poses), sensor), poses)


def _checked_poses(poses: Any, rig: Rig | None) -> np.ndarray:
    """Return poses as an array (K, 3) or (K, 6) of finite numbers, a row for each camera."""
    try:
        array = np.array(poses, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(
            f'placement: found {type(poses).__name__}; expected the path of a placement file, its '
            'content as a mapping, a placement, or poses (K, 3) or (K, 6)') from error
    if array.ndim != 2 or array.shape[1] not in (3, 6) or not len(array):
        raise ConfigurationError(f'placement: found an array of shape {array.shape}; expected '
                                 '(K, 3) or (K, 6), a row for each camera')
    if not np.isfinite(array).all():
        raise ConfigurationError('placement: found NaN or inf; expected finite metres and radians')
    if rig is not None and len(array) != len(rig.cameras):
        raise ConfigurationError(f'placement: found {len(array)} poses; expected '
                                 f'{len(rig.cameras)}, one for each camera of the rig')
    return array


def _counting(target: float, by: str, most: int) -> Counting:
    """Check the arguments of ``'auto'``, and return the criterion for enough cameras."""
    quantities = ('error', 'seen', 'coverage')
    if by not in quantities:
        raise ConfigurationError(f'by: found {by!r}; expected one of {", ".join(quantities)}')
    check_positive('target', target)
    if target > 1.0:
        raise ConfigurationError(f'target: found {target}; expected a share of at most 1')
    check_whole('most', most, 1, MAX_CAMERAS)
    return Counting(float(target), by, most)
