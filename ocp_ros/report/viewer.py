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
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.drawing.assessment_pictures import COUNT_COLOURS, COUNT_NAMES, ERROR_COLOURS
from ocp_ros.report.drawing.frustum_drawing import chained, edges
from ocp_ros.report.drawing.plan_marks import camera_colour, corners_of, STYLES, zones_of
from ocp_ros.report.drawing.room_drawing import (
    HEIGHTS,
    heights_of,
    INK,
    PALE_INK,
    room_of,
    some_of,
)
from ocp_ros.report.facts import page_facts_of, REGION_COLUMNS
from ocp_ros.report.templates import fill_template
from ocp_ros.rig.zones import Zone
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.files import write_atomically
import plotly.graph_objects as go

#: Largest number of points on the page: more points make the rotation slow.
SHOWN = 40000
#: Decimals of positions in metres on the page, which limit its size.
DECIMALS = 3
#: Colour of seen points and of points without error.
PLAIN = '#dcdcd6'
#: Smallest share of a wall's votes for a side.
LEAST_VOTES = 0.3
#: Length of a drawn frustum, as a share of the room's diagonal.
FRUSTUM_SHARE = 0.12


class Layer(NamedTuple):
    """
    A part of the picture that can be switched on and off.

    :ivar name: label of the switch.
    :ivar traces: plotly traces.
    :ivar shown: whether it is visible at first.
    """

    name: str
    traces: list[Any]
    shown: bool = True


class Paint(NamedTuple):
    """
    A way to colour the points.

    :ivar name: label of the switch.
    :ivar values: (N,) from 0 to 1, of all points of the scene.
    :ivar scale: plotly colour scale of the values.
    :ivar legend: names and their colours; empty for a scale from low to high.
    :ivar ends: labels of 0 and 1, if there is no legend.
    """

    name: str
    values: np.ndarray
    scale: list[list[Any]]
    legend: tuple[tuple[str, str], ...] = ()
    ends: tuple[str, str] = ('', '')


def write_view(path: str | Path, scene: Scene, assessed: Assessment | None = None) -> None:
    """
    Write a room as a self-contained HTML page.

    :param path: file to write; its folder is created.
    :param assessed: a placement in the room to show; None for the room alone.
    """
    points = scene.points.astype(np.float64)
    some = some_of(len(points), SHOWN)
    groups, facing = groups_of(points[some])
    groups = [some[group] for group in groups]
    paints = paints_of(scene, assessed)
    layers = [Layer('ceiling', [_cloud(points[groups.pop()], '#a3aeb6')], False)]
    layers += [layer for layer in layers_of(assessed) if layer.traces] if assessed else []
    figure = go.Figure([_cloud(points[group], PALE_INK) for group in groups])
    numbers = []
    for layer in layers:
        numbers.append(list(range(len(figure.data), len(figure.data) + len(layer.traces))))
        figure.add_traces([trace.update(visible=layer.shown) for trace in layer.traces])
    _lay_out(figure, scene)
    plot = figure.to_html(full_html=False, include_plotlyjs=True, div_id='view',
                          config={'displaylogo': False, 'responsive': True})
    data = {'facing': facing, 'paints': [
        {'scale': paint.scale, 'values': [_bytes_of(paint.values[group]) for group in groups]}
        for paint in paints]}
    title, subtitle = _head(scene, assessed)
    write_atomically(path, fill_template(
        'viewer.html', title=escape(title), subtitle=escape(subtitle),
        paints='\n'.join(map(_paint_switch, paints, range(len(paints)))),
        layers='\n'.join(map(_layer_switch, layers, numbers)), plot=plot, data=json.dumps(data),
        tables='' if assessed is None else '\n'.join(tables_of(assessed))))


def _lay_out(figure: go.Figure, scene: Scene) -> None:
    """Set the axes to the room, in metres, seen from above one corner."""
    low, high = scene.bounds
    margin = 0.03 * float((high - low).max())
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
    :returns: indices of the points that are always visible, of the walls that face each of four
        directions, and of the ceiling; and these four directions, x and y.
    """
    room = room_of(points, np.arange(len(points))[:, None])
    ways = [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]
    along = room.inward[:, :2] @ np.array(ways).T
    side = np.where(along.max(axis=1) > LEAST_VOTES, along.argmax(axis=1), -1)
    shown = room.colours[:, 0]
    groups = [shown[side == k] for k in range(-1, 4)]
    return [*groups, np.setdiff1d(np.arange(len(points)), shown)], ways


def paints_of(scene: Scene, assessed: Assessment | None) -> list[Paint]:
    """Return the ways to colour the points; the first one is shown first."""
    low, high = np.percentile(scene.points[:, 2], [2.0, 98.0])
    height = Paint('height', heights_of(scene.points), _scale(HEIGHTS), (),
                   tuple(f'{value + 0.0:.1f} m' for value in np.round([low, high], 1)))
    if assessed is None:
        return [height]
    kinds = len(COUNT_COLOURS)
    counts = (np.minimum(assessed.counts, kinds - 1) + 0.5) / kinds
    errors = 1000.0 * assessed.error_by_point
    most = float(np.percentile(errors[errors > 0.0], 98.0)) if (errors > 0.0).any() else 1.0
    return [_banded('seen by how many cameras', counts, tuple(zip(COUNT_NAMES, COUNT_COLOURS))),
            _banded('what is missed', assessed.missed.astype(float),
                    (('seen', PLAIN), ('missed', COUNT_COLOURS[0]))),
            Paint('depth error', np.sqrt(np.minimum(errors / most, 1.0)),
                  [[0.0, PLAIN], *([max(share, 0.004), colour]
                                   for share, colour in _scale(ERROR_COLOURS))], (),
                  ('0', f'{most:.2g} mm or more at a point')), height]


def _banded(name: str, values: np.ndarray, legend: tuple[tuple[str, str], ...]) -> Paint:
    """Return a way to colour points by a legend; its colours divide 0 to 1 into equal parts."""
    bands = [[(k + edge) / len(legend), colour] for k, (_, colour) in enumerate(legend)
             for edge in (0, 1)]
    return Paint(name, values, bands, legend)


def _bytes_of(shares: np.ndarray) -> str:
    """Return shares from 0 to 1 as base64 with one byte for each."""
    return b64encode(np.rint(255.0 * shares).astype(np.uint8).tobytes()).decode()


def layers_of(assessed: Assessment) -> Iterator[Layer]:
    """Yield layers: cameras, fields of view, ranges, the rig's zones and one more camera."""
    placed, scene, rig = assessed.placement.cameras, assessed.scene, assessed.objective.rig
    yield Layer('cameras', [_cameras(assessed)])
    longest = float(np.linalg.norm(scene.size))

    def frusta(part: float) -> list[go.Scatter3d]:
        return [_line(edges(one.camera.model, one.pose, min(one.camera.model.max_range,
                                                            part * longest)),
                      camera_colour(number), f'camera {number + 1}')
                for number, one in enumerate(placed) if not one.camera.model.omnidirectional]
    yield Layer('fields of view', frusta(FRUSTUM_SHARE))
    balls = [_ball(one.position, one.camera.model.max_range, camera_colour(number))
             for number, one in enumerate(placed) if one.camera.model.omnidirectional]
    # Several frusta with their full range would hide the room, so they are off at first.
    yield Layer('ranges', [*balls, *frusta(1.0)], len(balls) == len(placed))
    zones = zones_of(rig)
    for kind, style in STYLES.items():
        yield Layer(f'{kind}s', [
            _line(_outline(zone, scene, assessed.floor), style['edgecolor'], name)
            for other, name, zone in zones if other == kind])
    more = assessed.found.get('one_more')
    yield Layer('one more camera', [go.Scatter3d(
        x=[more['position'][0]], y=[more['position'][1]], z=[more['position'][2]],
        mode='markers', hovertemplate=f'one more {escape(more["sensor"])}: x %{{x:.2f}}, '
        f'y %{{y:.2f}}, z %{{z:.2f}} m, {more["gain"]:.3f} m less error<extra></extra>',
        marker={'size': 9, 'color': '#e69f00', 'symbol': 'diamond',
                'line': {'color': INK, 'width': 2}})] if more else [], False)


def _scale(colours: Any) -> list[list[Any]]:
    """Return a colour map as a plotly colour scale."""
    return [[share, 'rgb({:.0f},{:.0f},{:.0f})'.format(*(255 * value for value in
                                                         colours(share)[:3]))]
            for share in np.linspace(0.0, 1.0, 12).tolist()]


def _cloud(points: np.ndarray, colour: str) -> go.Scatter3d:
    """Return the trace of points (N, 3) in a colour."""
    x, y, z = np.round(points, DECIMALS).astype(np.float32).T
    return go.Scatter3d(x=x.copy(), y=y.copy(), z=z.copy(), mode='markers', hoverinfo='skip',
                        marker={'size': 2.8, 'color': colour, 'line': {'width': 0}})


def _cameras(assessed: Assessment) -> go.Scatter3d:
    """Return the trace of the cameras with numbers, and mounting instructions on hover."""
    x, y, z = assessed.positions.T
    numbers = range(len(assessed.positions))
    about = [' <br>'.join(escape(part) for part in words) for words in assessed.words]
    return go.Scatter3d(
        x=x, y=y, z=z, mode='markers+text', text=[f'<b>{k + 1}</b>' for k in numbers],
        textposition='top center', textfont={'size': 15, 'color': INK}, customdata=about,
        hovertemplate='camera %{text}: x %{x:.2f}, y %{y:.2f}, z %{z:.2f} m<br>%{customdata}'
        '<extra></extra>',
        marker={'size': 9, 'color': [camera_colour(k) for k in numbers],
                'line': {'color': 'white', 'width': 2}})


def _line(points: np.ndarray, colour: str, label: str) -> go.Scatter3d:
    """Return the trace of lines (M, 3), separated by rows of NaN."""
    x, y, z = np.round(points, DECIMALS).T
    return go.Scatter3d(x=x, y=y, z=z, mode='lines', line={'color': colour, 'width': 3},
                        hovertemplate=f'{escape(label)}<extra></extra>')


def _ball(centre: Sequence[float], radius: float, colour: str) -> go.Mesh3d:
    """Return the trace of an omnidirectional camera's range, a sphere."""
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 37),
                                     np.linspace(-np.pi / 2, np.pi / 2, 19))
    way = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                    np.sin(elevation)], axis=-1).reshape(-1, 3)
    x, y, z = np.round(np.asarray(centre) + radius * way, DECIMALS).T
    return go.Mesh3d(x=x, y=y, z=z, alphahull=0, color=colour, opacity=0.05, hoverinfo='skip')


def _outline(zone: Zone, scene: Scene, floor: float) -> np.ndarray:
    """Return the edges of a zone (M, 3), with its heights clipped to the room."""
    lift = floor if zone.above_floor else 0.0
    bottom, top = np.clip([zone.low[2] + lift, zone.high[2] + lift], *scene.bounds[:, 2])
    corners = corners_of(zone)
    rings = [np.column_stack([np.concatenate([corners, corners[:1]]),
                              np.full(len(corners) + 1, z)]) for z in (bottom, top)]
    posts = [np.array([[x, y, bottom], [x, y, top]]) for x, y in corners]
    return chained([*rings, *posts])


def _head(scene: Scene, assessed: Assessment | None) -> tuple[str, str]:
    """Return the headline and the line below it."""
    if assessed is None:
        size = ' x '.join(f'{edge:.1f}' for edge in scene.size)
        title, subtitle = scene.name, f'{size} m, {len(scene):,} points'
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
        low, high = map(escape, paint.ends)
        legend = f'{low} <b style="background:linear-gradient(to right, {stops})"></b> {high}'
    return (f'<label><input type="radio" name="paint" value="{number}"'
            f'{"" if number else " checked"}> {escape(paint.name)}</label><small>{legend}</small>')


def _layer_switch(layer: Layer, numbers: list[int]) -> str:
    """Return the HTML of the switch of a layer with the numbers of its traces."""
    return (f'<label><input type="checkbox" data-traces="{numbers}"'
            f'{" checked" if layer.shown else ""}> {escape(layer.name)}</label>')


def tables_of(assessed: Assessment) -> Iterator[str]:
    """Return the tables beside the room as HTML."""
    facts = page_facts_of(assessed)
    yield f'<p class="{"good" if facts.satisfied else "bad"}">{escape(facts.verdict)}</p>'
    yield from _list(assessed.found['broken'])
    if facts.doubts:
        yield '<p class="bad">Check first:</p>'
        yield from _list(facts.doubts)
    yield _table(('', '', ''), facts.figures)
    yield from _paragraphs(facts.certificate)
    yield '<h2>How to mount the cameras</h2>'
    rows = []
    for number, (words, camera) in enumerate(zip(assessed.words, facts.cameras), start=1):
        sensor = '' if words.name.startswith(words.sensor) else f' ({words.sensor})'
        mounting = '; '.join((words.place, words.height, words.pan, words.tilt))
        rows.append((str(number), f'{words.name}{sensor}: {mounting}', words.coordinates,
                     camera.reduction, camera.only))
    yield _table(('', 'camera', 'x, y, z', 'error reduction', 'seen by this camera only'), rows)
    yield from _paragraphs(f'Walls: {facts.walls}; A faces +y most, then clockwise. x, y and z '
                           f'are {facts.frame}.')
    if facts.regions:
        yield '<h2>Regions</h2>' + _table(REGION_COLUMNS, facts.regions)
    yield from _paragraphs(facts.links, facts.origin, facts.meaning)


def _paragraphs(*texts: str) -> Iterator[str]:
    """Yield texts as paragraphs of HTML, without empty ones."""
    return (f'<p>{escape(text)}</p>' for text in texts if text)


def _list(texts: Sequence[str]) -> Iterator[str]:
    """Yield a list of texts as HTML, if there are any."""
    if texts:
        yield '<ul>' + ''.join(f'<li>{escape(text)}</li>' for text in texts) + '</ul>'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML."""
    lines = [f'<tr>{"".join(f"<td>{escape(cell)}</td>" for cell in row)}</tr>' for row in rows]
    top = f'<tr>{"".join(f"<th>{escape(cell)}</th>" for cell in head)}</tr>' if any(head) else ''
    return f'<table>{top}{"".join(lines)}</table>'
