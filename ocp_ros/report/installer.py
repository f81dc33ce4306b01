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

"""The installer's page: mounting instructions for each camera, and a plan with lettered walls."""

from html import escape
import re

import numpy as np
from ocp_ros.report.assessment import Assessment, COLUMNS
from ocp_ros.report.camera_words import lens_of
from ocp_ros.report.key_figures import expectation
from ocp_ros.util.terminal_text import printable

#: Instruction for the roll of a camera.
LEVEL = 'Unless the table gives a roll, keep the long side of the camera level, top side up. '
#: Mount of the cameras in words, by the rig file's ``mount.on``.
MOUNTED = {'walls': 'on walls', 'ceiling': 'under the ceiling',
           'plane': 'on stands, poles or rods, all at one height',
           'free': 'on stands, poles or rods'}
#: Characters that begin or end markup within a line; an underscore between letters does not.
MARKS = re.compile(r'[\\`*\[\]|~]|(?<![^\W_])_|_(?![^\W_])|:(?=//)|(?<=www)\.|@')


def in_markdown(text: str) -> str:
    """Return an untrusted text as one line of Markdown, with all markup escaped."""
    return MARKS.sub(r'\\\g<0>', escape(printable(text), quote=False))


def frame_named(judged: Assessment) -> str:
    """Return unit and frame of the coordinates in words."""
    frame = judged.frame
    if frame.is_map:
        return 'metres in the frame of the ' + ('scan' if judged.scene.source.is_map else 'map')
    return 'in the axes and units of the scan' + (
        '' if frame.scale == 1.0 else f', {frame.scale:g} m each')


def instructions(judged: Assessment, plan: str) -> str:
    """
    Write the installer's page as Markdown.

    :param judged: the placement in its room.
    :param plan: file name of the plan beside it.
    """
    references, placement = judged.references, judged.placement
    sizes = ', '.join(wall.said for wall in references.sides)
    inner = '' if not references.inner else (
        'Other surfaces to measure from: ' + ', '.join(
            wall.said(references.sides, judged.floor) for wall in references.inner) + '. ')
    lines = [f'# How to mount the cameras: {in_markdown(judged.scene.name)}', '',
             f'![Plan]({plan})', '', *(f'**Check first:** {in_markdown(note)}.\n'
                                       for note in judged.found.get('notes', ())),
             f'**Walls.** The plan shows the room from above, with letters clockwise: {sizes}. '
             'In a room that is not a rectangle, A to D are the sides of the rectangle around it: '
             'measure from the surface that stands there, which may be some centimetres inside. '
             + inner, '', *_mounted(judged),
             '**How to measure.** A distance is perpendicular to the wall, to the centre of the '
             "camera's front; where a wall is lower than the camera, drop a plumb line. Left and "
             'right are seen by a person who stands behind the camera. Set the pan first, then '
             'the tilt. '
             + (LEVEL if any(not placed.camera.model.omnidirectional
                             for placed in placement.cameras) else '')
             + f'x, y and z are {frame_named(judged)}, for software: do not measure by '
             f'them if walls are given. {_corner_of(judged)}', '',
             f'| | {" | ".join(COLUMNS)} |', '|---' * (len(COLUMNS) + 1) + '|']
    lines += ['| ' + ' | '.join(map(in_markdown, row)) + ' |' for row in judged.rows]
    lines += ['', '**Lens and aim.** What the middle of the picture shows:', '', *(
        f'- {in_markdown(words.name)}: ' + '; '.join(filter(None, (
            lens_of(placed.camera.model), aim)))
        for words, placed, aim in zip(judged.words, placement.cameras, judged.aims))]
    lines += ['', '**When all cameras are mounted,** write down each difference from this page. '
              'The command ocp calibrate can check the poses: it compares what each camera sees '
              'with the scan.']
    if 'scores' in judged.found:
        lines += ['', _how_good(judged)]
    created = [f'Plan of {placement.created["date"][:10]}' if 'date' in placement.created else '',
               f'found by the planner {in_markdown(placement.created["planner"])}'
               if 'planner' in placement.created else '']
    if any(created):
        lines += ['', f'{", ".join(filter(None, created))}.']
    return '\n'.join([*lines, ''])


def _mounted(judged: Assessment) -> list[str]:
    """Return the lines on the mount of the cameras; [] if the rig does not define it."""
    rig = judged.objective.rig
    if 'mount' not in rig.document.data:
        return []
    return [f'**Mount.** The cameras are {MOUNTED[rig.mount.on]}. The room is '
            f'{100.0 * (judged.scene.bounds[1, 2] - judged.floor):.0f} cm high.', '']


def _corner_of(judged: Assessment) -> str:
    """Return a sentence with the coordinates of a corner of the room."""
    at = judged.frame.to_source(np.append(judged.corner.at, judged.floor))
    return (f'The corner of walls {judged.corner.letters} is at '
            f'{", ".join(f"{value + 0.0:.2f}" for value in at.round(2))} on the floor; the plan '
            'shows the axes there.')


def _how_good(judged: Assessment) -> str:
    """Return sentences on the visible share, the expected depth error and the certificate."""
    scores = judged.found['scores']
    whose = 'a camera sees' if scores['seen_by'] == 1 else f'{scores["seen_by"]} cameras see'
    sentence = (f'**How good it is.** Of the points of the scan, {whose} '
                f'{100.0 * scores["seen"]:.0f} %. The depth error in the room is expected to be '
                f'{expectation(judged.found["expected"])}.')
    if 'search' in judged.found:
        sentence += f' {in_markdown(judged.found["search"]["certificate"]["sentence"])}'
    return sentence
