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
from ocp_ros.geometry.depth_error import DepthError, pixel_angles
from ocp_ros.rig.free_plane import CELL_M, FreePlane
from ocp_ros.rig.plausibility import room_notes
from ocp_ros.rig.structure import Air, ceiling_of, Floors, floors_of
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.viewpoints import viewpoints_of
from scipy.spatial import Delaunay

#: Directions of openings.
SIDES = ('+x', '+y', '-x', '-y', 'above', 'below')


def facts_of(scene: Scene) -> dict[str, Any]:
    """
    Return the measurements of a room as plain data.

    :returns: ``name``, ``points`` (their number) and their median ``spacing``; ``bounds`` and
        ``size``, metres; ``floor`` and ``ceiling``, their heights in metres, None without a
        ceiling; ``floors``: height and area of each floor, the largest of which is ``floor``;
        ``camera_area``, square metres above which cameras may be; ``openings`` of
        :func:`openings_of`; ``source``: unit, up direction and the transform from the map to the
        file; ``notes``: doubts, and ``remarks``: corrections of the scan.
    """
    floors, source = floors_of(scene), scene.source
    ceiling = ceiling_of(scene.surveyed).points
    # The positions over the floor, without margin and clearance. The height is that of the top of
    # the room, so that furniture counts as well as floor. The number of cameras does not matter.
    space = FreePlane.of(scene.points, float(scene.bounds[1, 2]), 1, 0.0, clearance=0.0)
    return {
        'name': scene.name, 'points': len(scene), 'spacing': float(np.median(scene.spacing)),
        'bounds': scene.bounds.tolist(), 'size': scene.size.tolist(), 'floor': floors.height,
        'ceiling': float(np.median(ceiling[:, 2])) if len(ceiling) else None,
        'floors': [{'z': z, 'area': area} for z, area in _floor_areas(scene, space, floors)],
        'camera_area': space.area, 'openings': openings_of(scene, Air(scene, space)),
        'source': {'metres_per_unit': source.scale or source.scales.tolist(),
                   'unit': source.unit, 'up': source.up, 'shift': source.shift.tolist(),
                   'source_from_map': source.matrix.tolist()},
        'notes': [*room_notes(scene), *scene.notes],
        'remarks': list(scene.remarks)}


def _floor_areas(scene: Scene, space: FreePlane, floors: Floors) -> list[tuple[float, float]]:
    """Return z, metres, and the area below furniture included, square metres, of each floor."""
    plan = np.unique(np.round(scene.points[:, :2].astype(np.float64), 2), axis=0)
    triangles = plan[Delaunay(plan).simplices]
    edges = triangles[:, 1:] - triangles[:, :1]
    areas = 0.5 * np.abs(np.linalg.det(edges))
    centres = triangles.mean(axis=1)
    # The free floor ends a cell before the walls.
    areas[np.linalg.norm(space.inside(centres) - centres, axis=1) > CELL_M] = 0.0
    under = floors.under(centres)
    return [(z, float(areas[under == z].sum())) for z, _ in floors.levels]


def openings_of(scene: Scene, air: Air) -> dict[str, float]:
    """
    Return the share of the directions from inside a room that meet no surface, by side.

    :param scene: the room.
    :param air: the air in the room.
    :returns: shares of the solid angle: ``all``, and one for each of the six ``SIDES``; empty if
        there is no air at half the height of the room.
    """
    if len(air.cells(float(scene.bounds[:, 2].mean()))) == 0:
        return {}
    # Depth maps from viewpoints inside the room.
    places = viewpoints_of(scene)
    # In these depth maps of 64 rows a point is a cube, whose half side is 0.75 of its pitch.
    maps = DepthError(scene.points, 0.75 * scene.pitch, scene.diameter, places, 64)
    elevation, azimuth = pixel_angles(*maps.shape)
    side = np.empty(maps.shape, dtype=int)
    # The first four sides are quarters of a turn, around the azimuths 0, 90, 180 and 270 degrees.
    side[:] = np.round(azimuth / (0.5 * np.pi)).astype(int) % 4
    # From this elevation on a direction counts as above or below.
    steep = np.deg2rad(30.0)
    side[elevation > steep] = SIDES.index('above')
    side[elevation < -steep] = SIDES.index('below')
    # The solid angle of a pixel is proportional to the cosine of its elevation.
    weights = np.repeat(np.cos(elevation), maps.shape[1])
    # The share of the maps in which a pixel is empty; an empty pixel has the depth ``far``.
    open_shares = np.mean([maps.depth_map(k) >= maps.far for k in range(len(places))], axis=0)
    # For each side, the sum of the solid angles that are open, and of all.
    open_angles, totals = (np.bincount(side.ravel(), angles, len(SIDES))
                           for angles in (weights * open_shares.ravel(), weights))
    return {'all': float(open_angles.sum() / totals.sum()),
            **dict(zip(SIDES, (open_angles / totals).tolist()))}


def room_rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the name and the value in words of each fact in data of :func:`facts_of`."""
    # A smaller share would be written as 0 %.
    min_open_share = 0.005
    low, high = facts['bounds']
    floors, ceiling, openings, source = (
        facts[key] for key in ('floors', 'ceiling', 'openings', 'source'))
    open_sides = ', '.join(f'{side} {100.0 * openings[side]:.0f} %' for side in SIDES
                           if openings.get(side, 0.0) >= min_open_share)
    return [
        ('points', f'{facts["points"]:,}, median spacing {facts["spacing"]:.3f} m'),
        ('size', ' x '.join(f'{edge:.2f}' for edge in facts['size']) + ' m'),
        ('bounds', ', '.join(f'{axis} {first:.2f} to {last:.2f}' for axis, first, last
                             in zip('xyz', low, high)) + ' m'),
        # Adding 0 turns -0.0 into 0.0.
        *(('floor', f'z = {round(floor["z"], 2) + 0.0:.2f} m, {floor["area"]:.1f} m²')
          for floor in floors),
        ('room for cameras', f'{facts["camera_area"]:.1f} m² of the floor'),
        ('ceiling', 'not found' if ceiling is None else f'z = {ceiling:.2f} m, ' + ' and '.join(
            f'{ceiling - floor["z"]:.2f} m' for floor in floors) + ' above the floor'),
        ('openings', 'no inside was found' if not openings else
         f'{100.0 * openings["all"]:.0f} % of the view from inside meets no surface '
         f'({open_sides or "no side is open"})'),
        # The shift is subtracted from the coordinates of the file.
        ('file', f'unit: {source["unit"]}; up: {source["up"]}' + (
            f'; moved by {", ".join(f"{-value:.0f}" for value in source["shift"])} m'
            if any(source['shift']) else ''))]
