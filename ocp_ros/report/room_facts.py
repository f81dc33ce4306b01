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

#: Rows of the depth maps for openings.
DEPTH_MAP_ROWS = 64
#: Half the side of a point's cube, in multiples of the edge of the point's square.
CUBE_SCALE = 0.75
#: Elevation from which on a direction counts as above or below, degrees.
STEEP_DEGREES = 30.0
#: Directions of openings.
SIDES = ('+x', '+y', '-x', '-y', 'above', 'below')
#: Smallest open share of a side that is printed.
LEAST_OPENING = 0.005
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
    maps = DepthError(scene.points, CUBE_SCALE * scene.pitch, scene.diameter, places,
                      DEPTH_MAP_ROWS)
    rows, columns = maps.shape
    # As in cell_of, row 0 is straight down, and column 0 begins at the direction -x.
    elevation = (np.arange(rows) + 0.5) * 180.0 / rows - 90.0
    azimuth = (np.arange(columns) + 0.5) * 360.0 / columns - 180.0
    side = np.empty((rows, columns), dtype=int)
    side[:] = np.round(azimuth / 90.0).astype(int) % 4
    side[elevation > STEEP_DEGREES] = SIDES.index('above')
    side[elevation < -STEEP_DEGREES] = SIDES.index('below')
    weights = np.repeat(np.cos(np.deg2rad(elevation)), columns)
    empty = np.mean([maps.depth_map(k) >= maps.far for k in range(len(places))], axis=0)
    open_, whole = (np.bincount(side.ravel(), values, len(SIDES))
                    for values in (weights * empty.ravel(), weights))
    return {'all': float(open_.sum() / whole.sum()),
            **dict(zip(SIDES, (open_ / whole).tolist()))}


def room_rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the facts of a room in words: name and value of each."""
    low, high = found['bounds']
    floor, ceiling, openings, source = (
        found[key] for key in ('floor', 'ceiling', 'openings', 'source'))
    unit = UNITS.get(source['metres_per_unit'], f'{source["metres_per_unit"]:g} m')
    open_sides = ', '.join(f'{side} {100.0 * openings[side]:.0f} %' for side in SIDES
                           if openings.get(side, 0.0) >= LEAST_OPENING)
    return [
        ('points', f'{found["points"]:,}, median spacing {found["spacing"]:.3f} m'),
        ('size', ' x '.join(f'{edge:.2f}' for edge in found['size']) + ' m'),
        ('bounds', ', '.join(f'{axis} {first:.2f} to {last:.2f}' for axis, first, last
                             in zip('xyz', low, high)) + ' m'),
        # Adding 0 turns -0.0 into 0.0.
        ('floor', f'z = {round(floor, 2) + 0.0:.2f} m, {found["floor_area"]:.1f} m²'),
        ('ceiling', 'not found' if ceiling is None else
         f'z = {ceiling:.2f} m, {ceiling - floor:.2f} m above the floor'),
        ('openings', 'no inside was found' if not openings else
         f'{100.0 * openings["all"]:.0f} % of the view from inside meets no surface '
         f'({open_sides or "no side is open"})'),
        ('file', f'unit: {unit}; up: {source["up"]}' + (
            f'; moved by {", ".join(f"{-value:.0f}" for value in source["shift"])} m'
            if any(source['shift']) else ''))]
