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

"""An interactive 3D page of a room and a placement, which needs no server."""

from base64 import b64encode
from collections.abc import Iterator, Sequence
from html import escape
from itertools import repeat
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.report import fill_template
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.bill import BILL_COLUMNS, bill_rows
from ocp_ros.report.drawing.assessment_pictures import COUNT_COLOURS, COUNT_NAMES, ERROR_COLOURS
from ocp_ros.report.drawing.plan_drawing import (
    camera_colour,
    chained,
    corners_of,
    edges,
    STYLES,
    zones_of,
)
from ocp_ros.report.drawing.room_drawing import (
    choose_indices,
    HEIGHT_COLOURS,
    heights_of,
    INK,
    PALE_INK,
    PLAIN_COLOUR,
    room_of,
)
from ocp_ros.report.facts import (
    count_sentence,
    FRONT_COLUMNS,
    front_rows,
    page_facts_of,
    REGION_COLUMNS,
    REQUIREMENT_COLUMNS,
)
from ocp_ros.rig.zones import Zone
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.files import write_atomically
import plotly.graph_objects as go

#: Largest number of points on the page: with more points the page rotates slowly.
SHOWN = 40000
#: Decimals of positions in metres on the page, which limit its size.
DECIMALS = 3


class Layer(NamedTuple):
    """
    A part of the picture that can be switched on and off.

    :ivar name: label of the switch.
    :ivar traces: plotly traces, which are the drawn objects.
    :ivar shown: whether the layer is visible at first.
    """

    name: str
    traces: list[Any]
    shown: bool = True


class Paint(NamedTuple):
    """
    A way to colour the points.

    :ivar name: label of the switch.
    :ivar values: (N,) from 0 to 1, for the N points of the scene.
    :ivar scale: plotly colour scale: pairs of a value from 0 to 1 and a colour.
    :ivar legend: pairs of a name and its colour; empty for a scale from low to high.
    :ivar end_labels: labels of the values 0 and 1, if there is no legend.
    """

    name: str
    values: np.ndarray
    scale: list[list[Any]]
    legend: tuple[tuple[str, str], ...] = ()
    end_labels: tuple[str, str] = ('', '')


def write_view(path: str | Path, scene: Scene, assessed: Assessment | None = None) -> None:
    """
    Write a room as a self-contained HTML page.

    :param path: file to write; its folder is created.
    :param scene: the room.
    :param assessed: a placement in the room to show; None for the room alone.
    """
    points = scene.points.astype(np.float64)
    indices = choose_indices(len(points), SHOWN)
    groups, facing = groups_of(points[indices])
    # From here on, groups have indices of the scene's points. The last group is the ceiling, a
    # layer that is invisible at first.
    *groups, ceiling = (indices[group] for group in groups)
    paints = paints_of(scene, assessed)
    layers = [Layer('ceiling', [_point_trace(points[ceiling], '#a3aeb6')], shown=False)]
    layers += [layer for layer in layers_of(assessed) if layer.traces] if assessed else []
    figure = go.Figure([_point_trace(points[group], PALE_INK) for group in groups])
    # Of each layer, the numbers of its traces in the figure, for the switch of the layer.
    trace_numbers = []
    for layer in layers:
        trace_numbers.append(list(range(len(figure.data), len(figure.data) + len(layer.traces))))
        figure.add_traces([trace.update(visible=layer.shown) for trace in layer.traces])
    _set_axes(figure, scene)
    plot = figure.to_html(full_html=False, include_plotlyjs=True, div_id='view',
                          config={'displaylogo': False, 'responsive': True})
    # The data of the script in the page.
    data = {'facing': facing, 'paints': [
        {'scale': paint.scale, 'values': [_base64_of(paint.values[group]) for group in groups]}
        for paint in paints]}
    title, subtitle = _title_lines(scene, assessed)
    write_atomically(path, fill_template(
        'viewer.html', title=escape(title), subtitle=escape(subtitle),
        paints='\n'.join(map(_paint_switch, paints, range(len(paints)))),
        layers='\n'.join(map(_layer_switch, layers, trace_numbers)), plot=plot,
        data=json.dumps(data), tables='' if assessed is None else '\n'.join(tables_of(assessed))))


def _set_axes(figure: go.Figure, scene: Scene) -> None:
    """Set the axes to the room, in metres, and the viewer above a corner."""
    low, high = scene.bounds
    margin = 0.03 * float((high - low).max())
    # With a constant ``uirevision``, plotly keeps the user's view when the picture changes.
    figure.update_layout(
        template='plotly_white', margin={'l': 0, 'r': 0, 'b': 0, 't': 0}, showlegend=False,
        uirevision='kept', scene={
            'aspectmode': 'data', 'camera': {'eye': {'x': -1.0, 'y': -1.35, 'z': 1.35}},
            **{f'{axis}axis': {'title': {'text': f'{axis} (m)'}, 'color': PALE_INK,
                               'range': [low[k] - margin, high[k] + margin]}
               for k, axis in enumerate('xyz')}})


def groups_of(points: np.ndarray) -> tuple[list[np.ndarray], list[list[float]]]:
    """
    Group points by the wall of the room that must be hidden for a view inside.

    :param points: (N, 3) metres.
    :returns: six arrays of indices: the points that are always visible, those of the walls that
        face each of four directions, and the ceiling; and these four directions, x and y.
    """
    # The numbers of the points take the place of their colours, to see which points are left.
    room = room_of(points, np.arange(len(points))[:, None])
    directions = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]
    # The length of each point's inward vector along each direction: longer is more certain.
    lengths = room.inward[:, :2] @ np.array(directions).T
    # The number of the direction that the wall of each point faces. Points with less than 0.3
    # along every direction belong to no wall: -1, always visible.
    wall = np.where(lengths.max(axis=1) > 0.3, lengths.argmax(axis=1), -1)
    indices = room.colours[:, 0]
    groups = [indices[wall == k] for k in range(-1, 4)]
    # The ceiling is the points that ``room_of`` has removed.
    return [*groups, np.setdiff1d(np.arange(len(points)), indices)], directions


def paints_of(scene: Scene, assessed: Assessment | None) -> list[Paint]:
    """Return the ways to colour the points of a scene; the page opens with the first way."""
    low, high = np.percentile(scene.points[:, 2], [2.0, 98.0])
    # Adding 0 turns -0.0 into 0.0.
    height_labels = tuple(f'{value + 0.0:.1f} m' for value in np.round([low, high], 1))
    height = Paint('height', heights_of(scene.points), _colour_scale(HEIGHT_COLOURS),
                   end_labels=height_labels)
    if assessed is None:
        return [height]
    bands = len(COUNT_COLOURS)
    # The middle of the band of each count; see :func:`_banded_paint`.
    counts = (np.minimum(assessed.counts, bands - 1) + 0.5) / bands
    errors = 1000.0 * assessed.error_by_point
    high_error = float(np.percentile(errors[errors > 0.0], 98.0)) if (errors > 0.0).any() else 1.0
    # Points without any error have the plain colour. The colours of errors begin at 0.004, about
    # one step of the values, which the page has as bytes.
    error_scale = [[0.0, PLAIN_COLOUR], *([max(share, 0.004), colour]
                                          for share, colour in _colour_scale(ERROR_COLOURS))]
    return [_banded_paint('seen by how many cameras', counts,
                          tuple(zip(COUNT_NAMES, COUNT_COLOURS))),
            _banded_paint('what is missed', assessed.missed_points.astype(float),
                          (('seen', PLAIN_COLOUR), ('missed', COUNT_COLOURS[0]))),
            # The square root spreads the small errors.
            Paint('depth error', np.sqrt(np.minimum(errors / high_error, 1.0)), error_scale,
                  end_labels=('0', f'{high_error:.2g} mm or more at a point')), height]


def _banded_paint(name: str, values: np.ndarray, legend: tuple[tuple[str, str], ...]) -> Paint:
    """Return a way to colour points by a legend, whose colours are equal parts of 0 to 1."""
    scale = [[(k + edge) / len(legend), colour] for k, (_, colour) in enumerate(legend)
             for edge in (0, 1)]
    return Paint(name, values, scale, legend)


def _base64_of(shares: np.ndarray) -> str:
    """Return shares (N,) from 0 to 1 as base64 text with a byte for each."""
    return b64encode(np.rint(255.0 * shares).astype(np.uint8).tobytes()).decode()


def layers_of(assessed: Assessment) -> Iterator[Layer]:
    """
    Yield the layers: cameras, fields of view, ranges, zones of the rig, one more camera.

    A layer for which there is nothing to draw has no traces.
    """
    cameras, scene = assessed.placement.cameras, assessed.scene
    yield Layer('cameras', [_camera_trace(assessed)])
    diagonal = float(np.linalg.norm(scene.size))

    def frusta(max_length: float) -> list[go.Scatter3d]:
        return [_line_trace(edges(model, placed.pose, min(model.max_range, max_length)),
                            camera_colour(number), f'camera {number + 1}')
                for number, placed in enumerate(cameras)
                if not (model := placed.camera.model).omnidirectional]
    yield Layer('fields of view', frusta(0.12 * diagonal))
    spheres = [_range_trace(placed.position, placed.camera.model.max_range, camera_colour(number))
               for number, placed in enumerate(cameras) if placed.camera.model.omnidirectional]
    # Several frusta with their full range would hide the room, so they are invisible at first.
    yield Layer('ranges', [*spheres, *frusta(diagonal)], shown=len(spheres) == len(cameras))
    zones = zones_of(assessed.objective.rig)
    for kind, style in STYLES.items():
        yield Layer(f'{kind}s', [
            _line_trace(_zone_edges(zone, scene, assessed.floors.height), style['edgecolor'], name)
            for zone_kind, name, zone in zones if zone_kind == kind])
    one_more = assessed.found.get('one_more')
    yield Layer('one more camera', [go.Scatter3d(
        x=[one_more['position'][0]], y=[one_more['position'][1]], z=[one_more['position'][2]],
        mode='markers', hovertemplate=f'one more {escape(one_more["sensor"])}: x %{{x:.2f}}, '
        f'y %{{y:.2f}}, z %{{z:.2f}} m, {one_more["gain"]:.3f} m less error<extra></extra>',
        marker={'size': 9, 'color': '#e69f00', 'symbol': 'diamond',
                'line': {'color': INK, 'width': 2}})] if one_more else [], shown=False)


def _colour_scale(colours: Any) -> list[list[Any]]:
    """Return a matplotlib colour map as a plotly colour scale."""
    return [[share, 'rgb({:.0f},{:.0f},{:.0f})'.format(*(255 * value for value in
                                                         colours(share)[:3]))]
            for share in np.linspace(0.0, 1.0, 12).tolist()]


def _point_trace(points: np.ndarray, colour: str) -> go.Scatter3d:
    """Return the trace of N points (N, 3), metres, in a colour."""
    x, y, z = np.round(points, DECIMALS).astype(np.float32).T
    return go.Scatter3d(x=x.copy(), y=y.copy(), z=z.copy(), mode='markers', hoverinfo='skip',
                        marker={'size': 2.8, 'color': colour, 'line': {'width': 0}})


def _camera_trace(assessed: Assessment) -> go.Scatter3d:
    """Return the trace of the cameras: numbers, and mounting instructions under the pointer."""
    x, y, z = assessed.positions.T
    numbers = range(len(assessed.positions))
    instructions = [' <br>'.join(map(escape, texts)) for texts in assessed.instructions]
    return go.Scatter3d(
        x=x, y=y, z=z, mode='markers+text', text=[f'<b>{k + 1}</b>' for k in numbers],
        textposition='top center', textfont={'size': 15, 'color': INK}, customdata=instructions,
        hovertemplate='camera %{text}: x %{x:.2f}, y %{y:.2f}, z %{z:.2f} m<br>%{customdata}'
        '<extra></extra>',
        marker={'size': 9, 'color': [camera_colour(k) for k in numbers],
                'line': {'color': 'white', 'width': 2}})


def _line_trace(points: np.ndarray, colour: str, label: str) -> go.Scatter3d:
    """Return the trace of lines: (M, 3) metres, corners of lines with rows of NaN between."""
    x, y, z = np.round(points, DECIMALS).T
    return go.Scatter3d(x=x, y=y, z=z, mode='lines', line={'color': colour, 'width': 3},
                        hovertemplate=f'{escape(label)}<extra></extra>')


def _range_trace(centre: Sequence[float], radius: float, colour: str) -> go.Mesh3d:
    """Return the trace of an omnidirectional camera's range, a sphere."""
    # Points every ten degrees; with ``alphahull=0`` plotly draws their convex hull.
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 37),
                                     np.linspace(-np.pi / 2, np.pi / 2, 19))
    cosine = np.cos(elevation)
    directions = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(elevation)],
                          axis=-1).reshape(-1, 3)
    x, y, z = np.round(np.asarray(centre) + radius * directions, DECIMALS).T
    return go.Mesh3d(x=x, y=y, z=z, alphahull=0, color=colour, opacity=0.05, hoverinfo='skip')


def _zone_edges(zone: Zone, scene: Scene, floor: float) -> np.ndarray:
    """Return the edges of a zone as lines (M, 3) for :func:`_line_trace`, within the room."""
    base = floor if zone.above_floor else 0.0
    bottom, top = np.clip([zone.low[2] + base, zone.high[2] + base], *scene.bounds[:, 2])
    corners = corners_of(zone)
    rings = [np.column_stack([np.concatenate([corners, corners[:1]]),
                              np.full(len(corners) + 1, z)]) for z in (bottom, top)]
    verticals = [np.array([[x, y, bottom], [x, y, top]]) for x, y in corners]
    return chained([*rings, *verticals])


def _title_lines(scene: Scene, assessed: Assessment | None) -> tuple[str, str]:
    """Return the title and the subtitle of the page."""
    if assessed is None:
        size = ' x '.join(f'{edge:.1f}' for edge in scene.size)
        title = scene.name
        subtitle = f'{size} m, {len(scene):,} points'
    else:
        facts = page_facts_of(assessed)
        title, subtitle = facts.title, facts.subtitle
    return title, subtitle + (f'; {SHOWN:,} points are shown' if len(scene) > SHOWN else '')


def _paint_switch(paint: Paint, number: int) -> str:
    """Return the HTML of the switch of a way to colour the points, with its legend."""
    legend = ''.join(f'<i style="background:{colour}"></i>{escape(name)} '
                     for name, colour in paint.legend)
    if not paint.legend:
        stops = ', '.join(f'{colour} {100 * share:.0f}%' for share, colour in paint.scale)
        low, high = map(escape, paint.end_labels)
        legend = f'{low} <b style="background:linear-gradient(to right, {stops})"></b> {high}'
    return (f'<label><input type="radio" name="paint" value="{number}"'
            f'{"" if number else " checked"}> {escape(paint.name)}</label><small>{legend}</small>')


def _layer_switch(layer: Layer, numbers: list[int]) -> str:
    """Return the HTML of the switch of a layer with the numbers of its traces."""
    return (f'<label><input type="checkbox" data-traces="{numbers}"'
            f'{" checked" if layer.shown else ""}> {escape(layer.name)}</label>')


def tables_of(assessed: Assessment) -> Iterator[str]:
    """Yield the parts of HTML beside the room: verdict, doubts, tables and notes."""
    facts = page_facts_of(assessed)
    yield f'<p class="{"good" if facts.satisfied else "bad"}">{escape(facts.verdict)}</p>'
    yield from _html_list(assessed.found['broken'])
    if facts.doubts:
        yield '<p class="bad">Check first:</p>'
        yield from _html_list(facts.doubts)
    yield _html_table(('', '', ''), facts.figures)
    yield from _html_paragraphs(facts.certificate)
    if 'count' in assessed.found:
        yield from _html_paragraphs(count_sentence(assessed.found['count']))
    yield '<h2>How to mount the cameras</h2>'
    rows = []
    for number, (texts, camera) in enumerate(zip(assessed.instructions, facts.cameras), start=1):
        # The sensor is left out if the name of the camera begins with it.
        sensor = '' if texts.name.startswith(texts.sensor) else f' ({texts.sensor})'
        mounting = '; '.join((texts.place, texts.height, texts.pan, texts.tilt))
        rows.append((str(number), f'{texts.name}{sensor}: {mounting}', texts.coordinates,
                     camera.reduction, camera.only))
    columns = ('', 'camera', 'x, y, z', 'error reduction', 'seen by this camera only')
    yield _html_table(columns, rows)
    yield from _html_paragraphs(f'Walls: {facts.walls}; A faces +y most, then clockwise. x, y and '
                                f'z are {facts.frame}.')
    if facts.regions:
        yield '<h2>Regions</h2>' + _html_table(REGION_COLUMNS, facts.regions)
    if facts.rooms:
        yield '<h2>Rooms</h2>' + _html_table(facts.room_columns, *zip(*facts.rooms))
    if facts.requirements:
        yield '<h2>Requirements</h2>' + _html_table(REQUIREMENT_COLUMNS, facts.requirements)
    if rows := front_rows(assessed.found):
        yield '<h2>Price</h2>' + _html_table(FRONT_COLUMNS, rows)
    yield '<h2>Bill of materials</h2>' + _html_table(
        BILL_COLUMNS, bill_rows(assessed.found['bill']))
    yield from _html_paragraphs(facts.links, facts.origin, facts.meaning)


def _html_paragraphs(*texts: str) -> Iterator[str]:
    """Return the texts that are not empty as paragraphs of HTML."""
    return (f'<p>{escape(text)}</p>' for text in texts if text)


def _html_list(texts: Sequence[str]) -> Iterator[str]:
    """Yield a list of texts as HTML, or nothing without texts."""
    if texts:
        yield '<ul>' + ''.join(f'<li>{escape(text)}</li>' for text in texts) + '</ul>'


def _html_table(columns: Sequence[str], rows: Sequence[Sequence[str]],
                is_good: Sequence[bool] = ()) -> str:
    """
    Return a table as HTML; without a head if the names of all columns are empty.

    :param is_good: for each row whether it is as it should be, the others are red; empty for all.
    """
    lines = [f'<tr{"" if good else " class=bad"}>'
             f'{"".join(f"<td>{escape(cell)}</td>" for cell in row)}</tr>'
             for row, good in zip(rows, is_good or repeat(True))]
    if any(columns):
        lines.insert(0, f'<tr>{"".join(f"<th>{escape(name)}</th>" for name in columns)}</tr>')
    return f'<table>{"".join(lines)}</table>'
