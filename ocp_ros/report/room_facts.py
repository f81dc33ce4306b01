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

"""Facts of a room: size, floor, ceiling, openings and notes, before cameras are planned."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.plausibility import room_notes
from ocp_ros.rig.structure import Air, ceiling_of, floor_height
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.viewpoints import viewpoints_of
from rich.console import Console
from rich.table import Table

#: Rows of the depth maps for openings; half the side of a point's cube, in multiples of the edge
#: of the square that the point represents.
ROWS, CUBE = 64, 0.75
#: Elevation from which on a direction counts as above or below, degrees.
STEEP = 30.0
#: Directions of openings.
SIDES = ('+x', '+y', '-x', '-y', 'above', 'below')
#: Smallest open share of a side that is printed.
LITTLE = 0.005
#: Names of common units, by metres.
UNITS = {1.0: 'metres', 0.001: 'millimetres', 0.01: 'centimetres', 0.0254: 'inches',
         0.3048: 'feet'}


def facts_of(scene: Scene) -> dict[str, Any]:
    """
    Measure a room.

    :returns: plain data: ``name``, ``points`` and their median ``spacing``; ``bounds`` and
        ``size``, metres; ``floor`` and ``ceiling``, their heights in metres, None without a
        ceiling; ``floor_area``, square metres that are free for cameras; ``openings``, the share
        of directions from inside that meet no surface, by side; ``source``: unit, up direction and
        the transform from the map to the file; ``notes`` and ``remarks``.
    """
    floor, source = floor_height(scene), scene.source
    ceiling = ceiling_of(scene).points
    space = FreePlane.of(scene.points, float(scene.bounds[1, 2]), 1, 0.0, clearance=0.0)
    return {
        'name': scene.name, 'points': len(scene), 'spacing': float(np.median(scene.spacing)),
        'bounds': scene.bounds.tolist(), 'size': scene.size.tolist(), 'floor': floor,
        'ceiling': float(np.median(ceiling[:, 2])) if len(ceiling) else None,
        'floor_area': space.area, 'openings': openings_of(scene, Air(scene, space)),
        'source': {'metres_per_unit': source.scale, 'up': source.up,
                   'shift': source.shift.tolist(), 'source_from_map': source.matrix.tolist()},
        'notes': [*room_notes(scene), *scene.notes],
        'remarks': list(scene.remarks)}


def openings_of(scene: Scene, air: Air) -> dict[str, float]:
    """
    Measure the share of directions from inside a room that meet no surface.

    :param air: of the room.
    :returns: shares of the solid angle: ``all``, and one for each of the six ``SIDES``; empty if
        the room has no inside.
    """
    if len(air.cells(float(scene.bounds[:, 2].mean()))) == 0:
        return {}
    places = viewpoints_of(scene)
    maps = DepthError(scene.points, CUBE * scene.pitch, scene.diameter, places, ROWS)
    rows, columns = maps.shape
    # As in cell_of, row 0 is straight down, and column 0 begins at the direction -x.
    elevation = (np.arange(rows) + 0.5) * 180.0 / rows - 90.0
    azimuth = (np.arange(columns) + 0.5) * 360.0 / columns - 180.0
    side = np.empty((rows, columns), dtype=int)
    side[:] = np.round(azimuth / 90.0).astype(int) % 4
    side[elevation > STEEP], side[elevation < -STEEP] = SIDES.index('above'), SIDES.index('below')
    weights = np.repeat(np.cos(np.deg2rad(elevation)), columns)
    empty = np.mean([maps.depth_map(k) >= maps.far for k in range(len(places))], axis=0)
    open_, whole = (np.bincount(side.ravel(), values, len(SIDES))
                    for values in (weights * empty.ravel(), weights))
    return {'all': float(open_.sum() / whole.sum()),
            **dict(zip(SIDES, (open_ / whole).tolist()))}


def show_facts(console: Console, found: Mapping[str, Any]) -> None:
    """Print the facts of a room."""
    low, high = found['bounds']
    ceiling, openings, source = found['ceiling'], found['openings'], found['source']
    unit = UNITS.get(source['metres_per_unit'], f'{source["metres_per_unit"]:g} m')
    table = Table('room', found['name'], title_justify='left')
    table.add_row('points', f'{found["points"]:,}, median spacing {found["spacing"]:.3f} m')
    table.add_row('size', ' x '.join(f'{edge:.2f}' for edge in found['size']) + ' m')
    table.add_row('bounds', ', '.join(f'{axis} {first:.2f} to {last:.2f}' for axis, first, last
                                      in zip('xyz', low, high)) + ' m')
    # Adding 0 turns -0.0 into 0.0.
    floor = round(found['floor'], 2) + 0.0
    table.add_row('floor', f'z = {floor:.2f} m, {found["floor_area"]:.1f} m²')
    table.add_row('ceiling', 'not found' if ceiling is None else
                  f'z = {ceiling:.2f} m, {ceiling - found["floor"]:.2f} m above the floor')
    table.add_row('openings', 'no inside was found' if not openings else (
        f'{_percent(openings["all"])} of the view from inside meets no surface ('
        + (', '.join(f'{side} {_percent(openings[side])}' for side in SIDES
                     if openings[side] >= LITTLE) or 'no side is open') + ')'))
    table.add_row('file', f'unit: {unit}; up: {source["up"]}' + (
        f'; moved by {", ".join(f"{-value:.0f}" for value in source["shift"])} m'
        if any(source['shift']) else ''))
    console.print(table)
    show_notes(console, found)


def show_notes(console: Console, found: Mapping[str, Any]) -> None:
    """Print corrections of the scan, and doubts about a room or a result."""
    for remark in found.get('remarks', ()):
        console.print(remark, markup=False, highlight=False)
    for note in found['notes']:
        console.print(f'note: {note}', style='yellow', markup=False, highlight=False)


def _percent(share: float) -> str:
    """Return a share as per cent."""
    return f'{100.0 * share:.0f} %'
