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

"""Texts and tables of the page as HTML; everything that comes from files is escaped."""

from collections.abc import Sequence
from html import escape

import numpy as np
from ocp_ros.report.drawing.assessment_pictures import COUNT_COLOURS, COUNT_NAMES
from ocp_ros.report.drawing.plan_marks import camera_colour
from ocp_ros.report.facts import (
    links_line,
    percent,
    REGION_COLUMNS,
    region_rows,
    score_figures,
)
from ocp_ros.report.rig_planning import certificate_data
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.studio.model import Evaluation

#: Colours of points without a finding, of points that too few cameras see, of unseen points in a
#: region that must be seen, and of points that the selected camera alone sees.
PLAIN, MISSED, REQUIRED, ALONE = '#dcdcd6', COUNT_COLOURS[0], '#332288', COUNT_COLOURS[3]
#: The ways to colour the points, and the legend of each.
BY_COUNT, BY_NEED, BY_CAMERA = PAINTS = (
    'seen by how many cameras', 'requirements that fail', 'what the selected camera adds')
LEGENDS = {
    BY_COUNT: tuple(zip(COUNT_NAMES, COUNT_COLOURS)),
    BY_NEED: (('seen by enough cameras', PLAIN), ('seen by too few', MISSED),
              ('unseen part of a region that must be seen', REQUIRED)),
    BY_CAMERA: (('others see it', PLAIN), ('seen by no camera', MISSED),
                ('seen by it and others', COUNT_COLOURS[1]), ('seen by it alone', ALONE))}
#: The ways to show the room.
POINTS, BOTH, MESH = ROOMS = 'points', 'points and mesh', 'mesh'
HELP = ('Drag a camera: the colours show what is seen.',
        'Cameras: type exact poses. Ctrl+Alt+Z: undo.',
        'Plan finds better poses, Files saves them.')
#: Sentence in place of a certificate.
UNPROVED = 'How far from the best is not known for this rig: Plan all finds out.'
#: Rules for all pages: lines of a message stay lines, and on a phone the panel has its full width.
STYLE_RULES = ('<style>.mantine-Notification-description{white-space:pre-line}'
         '@media(max-width:36em){div[style*="width: 20em"]{width:100vw!important}}</style>')
STYLE = 'font-size:0.85em;line-height:1.35;padding:0.2em 0.6em;overflow-wrap:anywhere'


def rgb(colour: str) -> tuple[int, int, int]:
    """Return a colour such as ``#d55e00`` as three numbers from 0 to 255."""
    return tuple(int(colour[k:k + 2], 16) for k in (1, 3, 5))  # type: ignore[return-value]


def colours_of(evaluation: Evaluation, paint: str, camera: int) -> np.ndarray:
    """
    Return the colour of each point in the engine's order: (N, 3) uint8.

    :param paint: one of :data:`PAINTS`.
    :param camera: number of the selected camera.
    """
    counts = evaluation.counts
    kinds = np.minimum(counts, len(COUNT_COLOURS) - 1)
    if paint == BY_NEED:
        kinds = (counts < evaluation.problem.rig.seen_by).astype(np.uint8)
        kinds[evaluation.unseen_in_regions()] = 2
    elif paint == BY_CAMERA:
        mine = evaluation.seen_from(camera)
        kinds = np.where(mine, np.where(counts > 1, 2, 3), np.where(counts > 0, 0, 1))
    palette = np.array([rgb(colour) for _, colour in LEGENDS[paint]], dtype=np.uint8)
    return palette[kinds]


def legend(paint: str) -> str:
    """Return the legend of a way to colour the points."""
    return _boxed(''.join(
        f'<div><span style="display:inline-block;width:1em;height:1em;background:{colour};'
        f'border:1px solid #777;vertical-align:middle"></span> {escape(name)}</div>'
        for name, colour in LEGENDS[paint]))


def figures_of(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Return the labels and values of the key figures, written as ``ocp score`` does."""
    scores = evaluation.rig_scores
    return [*((figure.label, f'{figure.value} ({figure.remark})')
              for figure in score_figures(scores, evaluation.expected)),
            ('objective value', f'{scores["loss"]:.4f}')]


def regions_of(evaluation: Evaluation) -> str:
    """Return the table of the regions; '' without regions."""
    rows = region_rows(evaluation.rig_scores)
    return table(rows, REGION_COLUMNS) if rows else ''


def summary(evaluation: Evaluation) -> str:
    """Return the most important figures, and the constraints that poses violate."""
    error, _, seen, *_ = figures_of(evaluation)
    return _boxed(table([error, seen]) + regions_of(evaluation)
                  + _sentences(evaluation.misplaced))


def numbers(evaluation: Evaluation, certificate: Certificate | None,
            other: Evaluation | None = None) -> str:
    """
    Return all figures of a placement.

    :param certificate: lower bound that holds for it; None if there is none.
    :param other: a placement to compare with.
    """
    rows: list[Sequence[str]] = [*figures_of(evaluation)]
    scores = evaluation.scores
    rows += [(f'seen by {count}', percent(points / scores['points']))
             for count, points in scores['overlap'].items()]
    head: Sequence[str] = ()
    if other is not None:
        before = dict(figures_of(other)) | {
            f'seen by {count}': percent(points / other.scores['points'])
            for count, points in other.scores['overlap'].items()}
        rows = [(*row, before.get(row[0], '-')) for row in rows]
        head = ('', 'now', 'A')
    known = UNPROVED if certificate is None else certificate_data(certificate)['sentence']
    links = scores.get('calibratable')
    cameras = [(added['name'], f'{added["depth_error"]:.2f} m', percent(added['only']))
               for added in scores['cameras']]
    return _boxed(
        table(rows, head) + regions_of(evaluation) + f'<p>{escape(known)}</p>'
        + (f'<p>{escape(links_line(links))}</p>' if links else '')
        + table(cameras, ('camera', 'error reduction', 'seen by it only'))
        + (_sentences(evaluation.broken) or '<p>All constraints are satisfied.</p>'))


def message(text: str) -> str:
    """Return a sentence for a person."""
    return _boxed(f'<p>{escape(text)}</p>') if text else ''


def table(rows: Sequence[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Return a table."""
    rows_of = [f'<tr>{"".join(f"<td>{escape(cell)}</td>" for cell in row)}</tr>' for row in rows]
    # Long names may be broken anywhere; heads are words.
    top = ''.join(f'<th style="overflow-wrap:normal">{escape(cell)}</th>' for cell in head)
    return (f'<table style="width:100%;text-align:left;border-spacing:0 0.15em">'
            f'<tr>{top}</tr>{"".join(rows_of)}</table>')


def camera_title(name: str, locked: bool) -> str:
    """Return the label of a camera in the room."""
    return f'{name} (locked)' if locked else name


def camera_rgb(number: int) -> tuple[int, int, int]:
    """Return the colour of a camera, counted from 0."""
    return rgb(camera_colour(number))


def _sentences(lines: Sequence[str]) -> str:
    """Return sentences on violated constraints as a list; empty without any."""
    items = ''.join(f'<li>{escape(line)}</li>' for line in lines)
    return f'<ul style="color:#a33f00;padding-left:1.2em">{items}</ul>' if lines else ''


def _boxed(content: str) -> str:
    """Return content in the style of the page."""
    return f'<div style="{STYLE}">{content}</div>'
