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

"""A page without a server: rooms to turn around, and what each planner made of them."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from ocp_ros.report.drawing.plan_marks import CAMERA_COLOURS
from ocp_ros.report.drawing.room_drawing import HEIGHT_COLOURS, heights_of, room_of
from ocp_ros.report.drawing.room_pictures import UNOBSERVED
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.files import write_atomically
import plotly.graph_objects as go

#: Points that are drawn of a room, and of what a placement misses.
MOST = 6000


def write_page(path: Path, title: str,
               rooms: Mapping[str, tuple[Simulator, Mapping[str, np.ndarray]]]) -> None:
    """
    Write an HTML page with a menu of rooms and planners.

    :param path: file to write; it contains all it needs.
    :param title: headline.
    :param rooms: by name, the engine of each and its placements (K, 3) by planner.
    """
    figure, choices = go.Figure(), []
    for room, (simulator, placements) in rooms.items():
        points = simulator.scene.points
        # Without the ceiling one can look into the room.
        base = room_of(points, HEIGHT_COLOURS(heights_of(points))[:, :3])
        shown = _some(len(base.points))
        whole = len(figure.data)
        figure.add_trace(_cloud(base.points[shown], _colours(base.colours[shown]), 'room'))
        for planner, placement in placements.items():
            result = simulator.evaluate(placement)
            missed = points[~result.visible]
            share = 100.0 * len(missed) / len(points)
            missed = missed[missed[:, 2] <= base.points[:, 2].max()]
            first = len(figure.data)
            figure.add_trace(_cloud(missed[_some(len(missed))], UNOBSERVED,
                                    f'not seen ({share:.1f} %)'))
            figure.add_trace(_cameras(placement))
            choices.append((f'{escape(room)}: {planner}, depth error {result.depth_error:.2f} m',
                            {whole, first, first + 1}))
    buttons = [{'label': label, 'method': 'update',
                'args': [{'visible': [k in shown for k in range(len(figure.data))]}]}
               for label, shown in choices]
    for k, trace in enumerate(figure.data):
        trace.visible = bool(choices) and k in choices[0][1]
    figure.update_layout(
        title=title, template='plotly_white', margin={'l': 0, 'r': 0, 'b': 0, 't': 60},
        updatemenus=[{'buttons': buttons, 'x': 0.01, 'y': 0.99, 'xanchor': 'left',
                      'yanchor': 'top'}],
        scene={'aspectmode': 'data', 'xaxis_title': 'x (m)', 'yaxis_title': 'y (m)',
               'zaxis_title': 'z (m)'})
    write_atomically(path, figure.to_html(include_plotlyjs=True, full_html=True))


def _some(count: int) -> np.ndarray:
    """Choose which of many points to draw."""
    if count <= MOST:
        return np.arange(count)
    return np.random.default_rng(0).choice(count, MOST, replace=False)


def _colours(colours: np.ndarray) -> list[str]:
    """Return RGB colours (N, 3) as plotly writes them."""
    return [f'rgb({r},{g},{b})' for r, g, b in (255 * colours).astype(int)]


def _cloud(points: np.ndarray, colour: Any, name: str) -> go.Scatter3d:
    """Draw points."""
    x, y, z = np.round(points, 3).T
    return go.Scatter3d(x=x, y=y, z=z, mode='markers', name=name, hoverinfo='skip',
                        marker={'size': 2.5, 'color': colour})


def _cameras(placement: np.ndarray) -> go.Scatter3d:
    """Draw cameras with their numbers and where they are."""
    x, y, z = np.round(placement, 3).T
    colours = [CAMERA_COLOURS[k % len(CAMERA_COLOURS)] for k in range(len(placement))]
    return go.Scatter3d(
        x=x, y=y, z=z, mode='markers+text', name='cameras',
        text=[str(k + 1) for k in range(len(placement))],
        hovertemplate='camera %{text}: x %{x:.2f}, y %{y:.2f}, z %{z:.2f} m<extra></extra>',
        marker={'size': 9, 'color': colours, 'line': {'color': 'white', 'width': 2}})
