# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What there is to say about a judged placement, as HTML tables."""

from collections.abc import Iterator, Sequence
from html import escape

from ocp_ros.report.assessment import Assessment
from ocp_ros.report.camera_words import Words
from ocp_ros.report.installer import frame_named
from ocp_ros.report.key_figures import figures_of, percent
from ocp_ros.report.verdict_tables import links_line


def tables_of(judged: Assessment) -> Iterator[str]:
    """Return the tables beside the room as HTML."""
    found, figures = judged.found, figures_of(judged)
    yield f'<p class="{"good" if figures.kept else "bad"}">{escape(figures.verdict)}</p>'
    if found['broken']:
        yield '<ul>' + ''.join(f'<li>{escape(line)}</li>' for line in found['broken']) + '</ul>'
    if figures.doubts:
        yield '<p class="bad">Check first:</p><ul>' + ''.join(
            f'<li>{escape(line)}</li>' for line in figures.doubts) + '</ul>'
    yield _table(('', '', ''), figures.cards)
    if 'search' in found:
        yield f'<p>{escape(found["search"]["certificate"]["sentence"])}</p>'
    yield '<h2>How to mount the cameras</h2>'
    rows = [(str(number), f'{_named(words)}: {words.place}; {words.height}; '
             f'{words.pan}; {words.tilt}', words.coordinates, f'{added["depth_error"]:.3f} m',
             percent(added['only'])) for number, (words, added) in enumerate(zip(
                 judged.words, found['scores']['cameras']), start=1)]
    yield _table(('', 'camera', 'x, y, z', 'error reduction', 'seen by this camera only'), rows)
    yield '<p>' + escape('Walls: ' + ', '.join(
        wall.said for wall in judged.walls) + '; A faces +y most, then clockwise. x, y and z are '
        + frame_named(judged) + '.') + '</p>'
    if found['scores']['regions']:
        yield '<h2>Regions</h2>' + _table(('region', 'seen', 'required', 'satisfied'), [
            (region['name'], percent(region['seen']), percent(region['must_see']),
             'yes' if region['met'] else 'no') for region in found['scores']['regions']])
    if 'calibratable' in found['scores']:
        yield f'<p>{escape(links_line(found["scores"]["calibratable"]))}</p>'
    yield from (f'<p>{escape(line)}</p>' for line in figures.foot)


def _named(words: Words) -> str:
    """Return a camera's name, and its sensor where the name does not say."""
    return words.name if words.name.startswith(words.sensor) else f'{words.name} ({words.sensor})'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML."""
    lines = [f'<tr>{"".join(f"<td>{escape(cell)}</td>" for cell in row)}</tr>' for row in rows]
    top = f'<tr>{"".join(f"<th>{escape(cell)}</th>" for cell in head)}</tr>' if any(head) else ''
    return f'<table>{top}{"".join(lines)}</table>'
