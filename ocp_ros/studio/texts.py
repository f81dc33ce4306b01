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

"""Texts and tables of the page as HTML; all text that comes from files is escaped."""

from collections.abc import Sequence
from html import escape
from itertools import repeat
from typing import NamedTuple

import numpy as np
from ocp_ros.report import facts
from ocp_ros.report.drawing.assessment_pictures import COUNT_COLOURS, COUNT_NAMES
from ocp_ros.report.drawing.plan_drawing import camera_colour
from ocp_ros.report.drawing.room_drawing import PLAIN_COLOUR
from ocp_ros.report.rig_planning import certificate_data
from ocp_ros.search.proof.certificate import Certificate
from ocp_ros.studio.model import Evaluation


class Colourings(NamedTuple):
    """The colourings of the points: what a colour stands for."""

    by_count: str = 'seen by how many cameras'
    by_requirement: str = 'requirements that fail'
    by_camera: str = 'what the selected camera adds'


COLOURINGS = Colourings()
#: Colour of points that too few cameras see.
UNSEEN_COLOUR = COUNT_COLOURS[0]
#: The names and colours of each colouring.
LEGENDS = {
    COLOURINGS.by_count: tuple(zip(COUNT_NAMES, COUNT_COLOURS)),
    COLOURINGS.by_requirement: (
        ('seen by enough cameras', PLAIN_COLOUR), ('seen by too few', UNSEEN_COLOUR),
        ('unseen part of a region that must be seen', '#332288')),
    COLOURINGS.by_camera: (
        ('others see it', PLAIN_COLOUR), ('seen by no camera', UNSEEN_COLOUR),
        ('seen by it and others', COUNT_COLOURS[1]), ('seen by it alone', COUNT_COLOURS[3]))}
#: What is shown of the room.
POINTS, POINTS_AND_MESH, MESH = ROOM_VIEWS = 'points', 'points and mesh', 'mesh'
#: Attribute of a row that is not as it should be.
BAD_STYLE = ' style="color:#a33f00"'
#: Sentence in place of that of a certificate.
NO_CERTIFICATE = 'How far from the best is not known for this rig: Plan all finds out.'
#: CSS of the page: lines of a message stay lines, and on a phone the panel has its full width.
STYLE_RULES = (
    '<style>.mantine-Notification-description{white-space:pre-line}'
    '@media(max-width:36em){div[style*="width: 20em"]{width:100vw!important}}</style>')


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the red, green and blue of a colour such as ``#d55e00``, each from 0 to 255."""
    return tuple(int(colour[k:k + 2], 16) for k in (1, 3, 5))  # type: ignore[return-value]


def point_colours(evaluation: Evaluation, colouring: str, camera: int) -> np.ndarray:
    """
    Return the colour of each of the N points of the room, in the engine's order: (N, 3) uint8.

    :param colouring: one of :data:`COLOURINGS`.
    :param camera: number of the selected camera.
    """
    counts = evaluation.camera_counts
    # The index of each point's entry in ``LEGENDS[colouring]``. The numbers 0 to 3 below are such
    # indices too.
    indices = np.minimum(counts, len(COUNT_COLOURS) - 1)
    if colouring == COLOURINGS.by_requirement:
        indices = (counts < evaluation.problem.rig.seen_by).astype(np.uint8)
        indices[evaluation.unseen_required_points()] = 2
    elif colouring == COLOURINGS.by_camera:
        seen_by_camera = evaluation.points_seen_by(camera)
        indices = np.where(seen_by_camera, np.where(counts > 1, 2, 3), np.where(counts > 0, 0, 1))
    colours = np.array([rgb(colour) for _, colour in LEGENDS[colouring]], dtype=np.uint8)
    return colours[indices]


def legend(colouring: str) -> str:
    """Return the legend of a colouring of the points, one of :data:`COLOURINGS`."""
    return styled(''.join(
        f'<div><span style="display:inline-block;width:1em;height:1em;background:{colour};'
        f'border:1px solid #777;vertical-align:middle"></span> {escape(name)}</div>'
        for name, colour in LEGENDS[colouring]))


def figures_of(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Return the labels and values of the key figures, written as ``ocp score`` does."""
    scores = evaluation.rig_scores
    return [*((figure.label, f'{figure.value} ({figure.remark})')
              for figure in facts.score_figures(scores, evaluation.expected_error)),
            ('objective value', f'{scores["loss"]:.4f}')]


def region_table(evaluation: Evaluation) -> str:
    """Return the tables of regions and requirements as HTML; empty without both."""
    scores = evaluation.rig_scores
    return ''.join(table(rows, head=columns) for rows, columns in (
        (facts.region_rows(scores), facts.REGION_COLUMNS),
        (facts.requirement_rows(scores), facts.REQUIREMENT_COLUMNS)) if rows)


def room_table(evaluation: Evaluation) -> str:
    """Return the table of the rooms of a floor as HTML; empty for one room."""
    rows = facts.room_rows(evaluation.rig_scores)
    return table(*zip(*rows), head=facts.ROOM_COLUMNS) if rows else ''


def summary(evaluation: Evaluation) -> str:
    """Return the most important figures, and the constraints that poses violate, as HTML."""
    # In the order of :func:`.facts.score_figures`; the expected depth error is left out.
    depth_error, _, seen_share, *_ = figures_of(evaluation)
    return styled(table([depth_error, seen_share]) + region_table(evaluation)
                  + room_table(evaluation) + _sentence_list(evaluation.violations))


def all_figures(evaluation: Evaluation, certificate: Certificate | None,
                kept: Evaluation | None = None) -> str:
    """
    Return all figures of a placement as HTML.

    :param evaluation: of the placement.
    :param certificate: lower bound that holds for its rig; None if no lower bound is known.
    :param kept: another placement to compare with; None for no comparison.
    """
    rows = _figure_rows(evaluation)
    head: Sequence[str] = ()
    if kept is not None:
        kept_values = dict(_figure_rows(kept))
        rows = [(*row, kept_values.get(row[0], '-')) for row in rows]
        head = ('', 'now', 'A')
    optimality = (NO_CERTIFICATE if certificate is None
                  else certificate_data(certificate)['sentence'])
    links = evaluation.scores.get('calibratable')
    cameras = [(camera['name'], f'{camera["depth_error"]:.2f} m', facts.percent(camera['only']))
               for camera in evaluation.scores['cameras']]
    return styled(
        table(rows, head=head) + region_table(evaluation) + room_table(evaluation)
        + f'<p>{escape(optimality)}</p>'
        + (f'<p>{escape(facts.links_line(links))}</p>' if links else '')
        + table(cameras, head=('camera', 'error reduction', 'seen by it only'))
        + (_sentence_list(evaluation.all_violations) or '<p>All constraints are satisfied.</p>'))


def _figure_rows(evaluation: Evaluation) -> list[Sequence[str]]:
    """Return labels and values: the key figures, and the shares of points by camera count."""
    scores = evaluation.scores
    return [*figures_of(evaluation),
            *((f'seen by {count}', facts.percent(points / scores['points']))
              for count, points in scores['overlap'].items())]


def message(text: str) -> str:
    """Return a sentence for a person as HTML; empty if the text is."""
    return styled(f'<p>{escape(text)}</p>') if text else ''


def table(rows: Sequence[Sequence[str]], is_good: Sequence[bool] = (),
          head: Sequence[str] = ()) -> str:
    """
    Return a table as HTML; all cells are escaped.

    :param is_good: for each row whether it is as it should be, the others are red; empty for all.
    """
    body = ''.join(f'<tr{"" if good else BAD_STYLE}>'
                   f'{"".join(f"<td>{escape(cell)}</td>" for cell in row)}</tr>'
                   for row, good in zip(rows, is_good or repeat(True)))
    # Names may be broken anywhere, the words of the head may not.
    head_cells = ''.join(f'<th style="overflow-wrap:normal">{escape(cell)}</th>' for cell in head)
    return ('<table style="width:100%;text-align:left;border-spacing:0 0.15em">'
            f'<tr>{head_cells}</tr>{body}</table>')


def camera_rgb(number: int) -> tuple[int, int, int]:
    """Return the red, green and blue of a camera: each from 0 to 255. Numbers begin at 0."""
    return rgb(camera_colour(number))


def _sentence_list(sentences: Sequence[str]) -> str:
    """Return sentences on violated constraints as an HTML list; empty if there are none."""
    items = ''.join(f'<li>{escape(sentence)}</li>' for sentence in sentences)
    return f'<ul style="color:#a33f00;padding-left:1.2em">{items}</ul>' if sentences else ''


def styled(html: str) -> str:
    """Return HTML in the style of the page."""
    return ('<div style="font-size:0.85em;line-height:1.35;padding:0.2em 0.6em;'
            f'overflow-wrap:anywhere">{html}</div>')
