# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp score``: how good is a placement of a rig in a room, and what would make it better."""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
import hashlib
from itertools import chain
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ocp_ros.cli.common import inputs_of
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.exports import export, FORMS
from ocp_ros.report.findings import verdict
from ocp_ros.report.key_figures import percent
from ocp_ros.rig.placement_file import (
    ANGLES,
    created_by,
    data_of,
    FIXED,
    load_placement,
    Placement,
)
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.scene_source import make_room
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.files import folder_to_write
from ocp_ros.util.own_files import check_own, note_own, remove_own
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.shown_text import printable
from ocp_ros.util.yaml_files import written

#: All that is written of a placement, and the part of it that counting cameras adds.
CURVE = 'curve.png'
WRITTEN = (*FORMS, 'report.png', 'report.html', CURVE)
#: Points of a room where the placement does not say.
POINTS = 60_000
#: How a scan is read, as command lines and placement files say it.
READING = ('scale', 'up', 'drop_nonfinite')
#: Scores that differ by more than this are not the same.
SAME = 1e-6


def room_named(name: str, points: int = POINTS, **reading: Any) -> tuple[Scene, dict[str, Any]]:
    """
    Read or generate a room, and say which it is as placement files do.

    :param name: path of a scan, or seed of a generated room.
    :param reading: of a scan: scale, up, drop_nonfinite; see
        :func:`~ocp_ros.scenes.scene_source.make_room`.
    :raises SceneError: if the scan cannot be used.
    """
    scene = make_room(name, 0.0, points, **reading)
    if name.isdecimal():
        return scene, {'seed': int(name), 'points': points,
                       'sha256': hashlib.sha256(scene.points.tobytes()).hexdigest()}
    content = hashlib.sha256(Path(name).read_bytes()).hexdigest()
    room = {'file': name, 'sha256': content, 'points': points, 'scale': 1.0, 'up': 'z', **reading}
    if not scene.source.is_map:
        room['source_from_map'] = scene.source.matrix.tolist()
    return scene, room


def judge(scene: Scene, placement: Placement, room: dict[str, Any], command: str,
          frame: str | None = None) -> Assessment:
    """
    Judge a placement in a room.

    :param placement: it need not say what was asked for.
    :param room: which room it is, from :func:`room_named`.
    :param command: the command line, for the record.
    :param frame: that files are asked for in, ``'map'`` or ``'source'``.
    :raises ConfigurationError: if the placement's rig cannot be used in this room.
    """
    rig = placement.rig_in(scene)
    problem = Problem.of(scene, rig, SimulationConfig(engine=placement.engine))
    found = {'room': room, 'cameras': data_of(placement)['cameras'],
             **verdict(problem, placement.poses)}
    scores = found['scores']
    found['notes'] += _notes(placement, room, scores)
    created = created_by(command, placement.created.get('planner', ''))
    return Assessment(problem.objective, replace(
        placement, rig=rig, room=room, scores=scores, created=created), found, frame)


def score(arguments: argparse.Namespace, command: str) -> dict[str, Any]:
    """
    Judge a placement, and write what is asked for.

    :param arguments: of ``ocp score``.
    :param command: the command line, for the record.
    :returns: what ``--json`` prints.
    """
    if arguments.out:
        claim_folder(arguments, arguments.out)
    scene, placement, room = room_and_placement(arguments)
    folder = arguments.out and folder_to_write(arguments.out)
    judged = judge(scene, placement, room, command, arguments.frame)
    if folder is None:
        return dict(judged.found)
    return {**judged.found, **written_to(folder, judged, prefix=arguments.frame_prefix)}


def claim_folder(arguments: argparse.Namespace, folder: Path, curve: bool = False) -> None:
    """
    Check that all that belongs to a placement may be written, before any work is done for it.

    :param curve: whether what more cameras are worth is to be drawn as well.
    :raises ConfigurationError: if somebody would lose a file.
    """
    names = [name for name in WRITTEN if curve or name != CURVE]
    check_own([folder / name for name in names], inputs_of(arguments), arguments.overwrite)


def written_to(folder: Path, judged: Assessment, more: Iterable[Path] = (), prefix: str = ''
               ) -> dict[str, Any]:
    """
    Write a placement in all forms, and the reports; what an earlier run left beside them goes.

    :param more: files that are written as they are asked for.
    :param prefix: of the names of frames.
    :returns: ``written``; where not all could be, for want of space say, ``error`` as well.
    """
    paths: list[Path] = []
    try:
        for path in chain(export(folder, judged, prefix), reports(folder, judged), more):
            paths.append(path)
            note_own([path])
        remove_own(_earlier(folder, paths))
    except OSError as error:
        return {'written': [str(path) for path in paths], 'error': (
            f'--out: found {folder}, where not all could be written ({error.strerror or error}); '
            'expected room for it; use what is printed, or make room and do it again'
            + earlier_files(folder, paths))}
    return {'written': [str(path) for path in paths]}


def earlier_files(folder: Path, paths: Sequence[Path]) -> str:
    """Say which files beside those of this run are of an earlier one, if any are."""
    names = [path.name for path in _earlier(folder, paths) if path.exists()]
    return f'; of an earlier run, not of this placement: {", ".join(names)}' if names else ''


def _earlier(folder: Path, paths: Sequence[Path]) -> list[Path]:
    """Return where files of an earlier run may be."""
    return [path for name in WRITTEN if (path := folder / name) not in paths]


def reports(folder: Path, judged: Assessment) -> Iterator[Path]:
    """
    Write the one-page report and the page that can be turned around, and yield each.

    :param folder: it is made where it is not there.
    """
    # What draws is slow to import, and most placements are judged without.
    from ocp_ros.report import sheet
    from ocp_ros.report.viewer import write_view
    sheet.draw(folder / 'report.png', judged)
    yield folder / 'report.png'
    write_view(folder / 'report.html', judged.scene, judged)
    yield folder / 'report.html'


def room_and_placement(arguments: argparse.Namespace
                       ) -> tuple[Scene, Placement, dict[str, Any]]:
    """
    Read what a command line names.

    :param arguments: with ``room``, ``placement``, ``rig``, ``scale`` and ``up``.
    :returns: the room, the placement, and which room it is.
    """
    rig = load_rig(arguments.rig) if arguments.rig else None
    placement = load_placement(arguments.placement, rig)
    scene, room = room_asked(arguments, placement.room)
    return scene, placement, room


def room_asked(arguments: argparse.Namespace, known: dict[str, Any]
               ) -> tuple[Scene, dict[str, Any]]:
    """
    Read the room of a command line.

    :param arguments: with ``room``, ``scale`` and ``up``.
    :param known: how it was read before, as placement files have it; what the command line says
        comes first.
    """
    given = {key: value for key in READING
             if (value := getattr(arguments, key)) is not None and value is not False}
    if given and arguments.room.isdecimal():
        raise ConfigurationError(
            f'--{next(iter(given)).replace("_", "-")}: found it with the generated room '
            f'{arguments.room}; expected a scan, since generated rooms are in metres, z up; leave '
            'it out')
    known = {key: known[key] for key in ('points', *READING) if key in known}
    if arguments.room.isdecimal():
        known = {key: value for key, value in known.items() if key == 'points'}
    return room_named(arguments.room, **{**known, **given})


def _notes(placement: Placement, room: dict[str, Any], scores: dict[str, Any]) -> list[str]:
    """Say where the file is about something else than what was judged."""
    before = placement.scores.get('loss')
    if placement.room.get('sha256') not in (None, room['sha256']):
        return ['the file was made for a room of other content; its own scores are not these']
    if isinstance(before, float) and abs(before - scores['loss']) > SAME:
        return [f'the file says loss {before:.6f}; found {scores["loss"]:.6f}: rig, points or '
                'engine are not those that it was scored with']
    return []


def show(found: dict[str, Any]) -> None:
    """Print a verdict and what was written."""
    show_verdict(found)
    show_written(found)


def show_verdict(found: dict[str, Any]) -> None:
    """Print a verdict."""
    console, scores = Console(width=100), found['scores']
    cameras = Table('camera', 'place (m)', 'yaw, pitch, roll', 'error reduction',
                    'seen by this camera only', title='Cameras')
    for placed, added in zip(found['cameras'], scores['cameras']):
        name = f'{added["name"]} (in place)' if placed['mount'] == FIXED else added['name']
        cameras.add_row(name, ', '.join(f'{value:.2f}' for value in placed['position']),
                        ', '.join(f'{placed[angle]:.0f}' for angle in ANGLES),
                        f'{added["depth_error"]:.2f} m', percent(added['only']))
    console.print(cameras)
    least = scores['seen_by']
    by = 'a camera' if least == 1 else f'{least} cameras'
    console.print(f'depth error {scores["depth_error"]:.3f} m of '
                  f'{scores["depth_error_of_nothing"]:.3f} m; space coverage '
                  f'{scores["space_coverage"]:.1f} of {scores["volume"]:.1f} m³; '
                  f'{percent(scores["seen"])} of the points seen by {by}; loss '
                  f'{scores["loss"]:.4f}')
    console.print('seen by ' + ', '.join(f'{count}: {percent(points / scores["points"])}'
                                         for count, points in scores['overlap'].items()))
    for region in scores['regions']:
        must = f', {percent(region["must_see"])} asked for' if region['must_see'] else ''
        console.print(f'region {region["name"]}: {percent(region["seen"])} seen{must}')
    _show_rest(console, found)


def _show_rest(console: Console, found: dict[str, Any]) -> None:
    """Print what is wrong and what would be better."""
    broken, missed, more = found['broken'], found['missed'], found['one_more']
    kept = 'every constraint is kept' + (', with doubts (notes below)' if found['notes'] else '')
    console.print(kept if not broken else 'broken constraints:')
    for sentence in broken:
        console.print(f'  {sentence}', style='red', markup=False, highlight=False)
    console.print(f'missed: {percent(missed["share"])} of the points; '
                  f'{percent(missed["hopeless"])} no candidate sees either')
    for part in missed['places']:
        corners = (', '.join(f'{value:.2f}' for value in part[key]) for key in ('low', 'high'))
        console.print(f'  {percent(part["share"])} from ({next(corners)}) to ({next(corners)})')
    if more is None:
        console.print('one more camera: there is no allowed place for it')
    else:
        place = ', '.join(f'{value:.2f}' for value in more['position'])
        console.print(f'one more {more["sensor"]} helps most at ({place}), yaw {more["yaw"]:.0f}, '
                      f'pitch {more["pitch"]:.0f}: depth error {more["depth_error"]:.3f} m, '
                      f'{more["gain"]:.3f} m less')
    for remark in found['remarks']:
        console.print(remark, markup=False, highlight=False)
    for note in found['notes']:
        console.print(f'note: {note}', style='yellow', markup=False, highlight=False)


def show_written(found: dict[str, Any]) -> None:
    """Print which files were written, and the placement itself where not all could be."""
    for path in found.get('written', ()):
        print(f'wrote {printable(path)}')
    if 'error' in found:
        print(written({'cameras': found['cameras']}, '.yaml'), end='')
