# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The installer's page: how to hang up each camera, beside a plan with lettered walls."""

from ocp_ros.report.assessment import Assessment
from ocp_ros.report.markdown_text import in_markdown

#: What stands above the rows of an installer's table, but for the camera's number.
COLUMNS = ('camera', 'sensor', 'place', 'height', 'pan', 'tilt', 'x, y, z')


def rows_of(judged: Assessment) -> list[list[str]]:
    """Return what an installer is told of each camera, the names of :data:`COLUMNS` above it."""
    rows = []
    for number, (placed, words) in enumerate(zip(judged.placement.cameras, judged.words), start=1):
        name = f'{words.name} (fixed)' if placed.mount == 'fixed' else words.name
        rows.append([str(number), name, *words[1:]])
    return rows


def frame_named(judged: Assessment) -> str:
    """Say which frame coordinates are given in."""
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
    sizes = ', '.join(f'{wall.letter} {wall.length:.2f} m' + (
        '' if wall.stands else ' (no wall stands there)') for wall in references.sides)
    inner = '' if not references.inner else (
        f' Walls inside it: {", ".join(wall.letter for wall in references.inner)}.')
    lines = [f'# How to mount the cameras: {in_markdown(judged.scene.name)}', '',
             f'![Plan]({plan})', '', *(f'**Check first:** {in_markdown(note)}.\n'
                                       for note in judged.found.get('notes', ())),
             f'Walls are lettered as in the plan, clockwise seen from above: {sizes}. Where the '
             'room is not', f'a rectangle they are the sides of the rectangle around it.{inner} '
             'Distances are perpendicular to the wall, to',
             "the centre of the camera's front. Left and right are those of a person who stands "
             f'behind the camera. x, y and z are {frame_named(judged)}.', '',
             f'| | {" | ".join(COLUMNS)} |', '|---' * (len(COLUMNS) + 1) + '|']
    lines += ['| ' + ' | '.join(map(in_markdown, row)) + ' |' for row in rows_of(judged)]
    if 'planner' in placement.created:
        planner = in_markdown(placement.created['planner'])
        lines += ['', f'The placement was found by the planner {planner}.']
    if 'search' in judged.found:
        lines += ['', in_markdown(judged.found['search']['certificate']['sentence'])]
    return '\n'.join([*lines, ''])
