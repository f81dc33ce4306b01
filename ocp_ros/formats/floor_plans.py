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

"""The floor plan with cameras as DXF (ezdxf): walls, cameras as blocks, fields of view, sizes."""

import io
from typing import Any

import numpy as np
from ocp_ros.formats.exported import Exported
from ocp_ros.rig.placement_file import numbers_of

#: Layers of the drawing and their colours, by the index of AutoCAD.
LAYERS = {'WALLS': 7, 'CAMERAS': 1, 'FIELD_OF_VIEW': 5, 'DIMENSIONS': 8, 'ZONES': 3}
#: Height of texts, metres: 2.5 mm on a plan 1 : 50.
TEXT_M = 0.125


def dxf_of(exported: Exported) -> str:
    """
    Return a floor plan as DXF R2010, in metres.

    The block ``CAMERA`` looks along x; each camera is an insertion with the height, rotation and
    attributes of the camera. Closed lines show what each camera would see if nothing hid anything.

    :raises ConfigurationError: if z of the files is not up.
    """
    import ezdxf
    assessed = exported.assessed
    exported.check_z_up('dxf')
    drawing = ezdxf.new('R2010', setup=True)
    drawing.header['$INSUNITS'], drawing.header['$MEASUREMENT'] = 6, 1
    for layer, colour in LAYERS.items():
        drawing.layers.add(layer, color=colour)
    _add_block(drawing)
    space = drawing.modelspace()

    def flat(places: np.ndarray) -> np.ndarray:
        """Return places (M, 2) in the map as places (M, 2) in the frame of the file."""
        return exported.to_file(np.insert(places, 2, 0.0, axis=1))[:, :2]

    _add_room(space, exported, flat)
    # This import is slow.
    from ocp_ros.report.drawing.plan_drawing import reach
    heights = assessed.scene.bounds[:, 2].tolist()
    for number, placed in exported.cameras():
        camera, original = placed.camera, exported.original.cameras[number]
        seen = flat(reach(camera.model, original.pose, heights))
        space.add_lwpolyline(seen.tolist(), close=True, dxfattribs={'layer': 'FIELD_OF_VIEW'})
        inserted = space.add_blockref('CAMERA', placed.position, dxfattribs={
            'layer': 'CAMERAS', 'rotation': placed.angles[0]})
        numbers = numbers_of(camera)
        inserted.add_auto_attribs({
            'NAME': camera.name, 'FRAME': exported.frame(number),
            'SENSOR': camera.sensor or 'own', 'MOUNT': placed.mount,
            **dict(zip(('YAW', 'PITCH', 'ROLL'), map(repr, placed.angles))),
            **{name: repr(numbers[key]) for name, key in (
                ('HFOV', 'horizontal_fov'), ('VFOV', 'vertical_fov'), ('MIN_RANGE', 'min_range'),
                ('MAX_RANGE', 'max_range'))}})
        for distance in assessed.references.distances[number]:
            ends = flat(np.array([original.position[:2], distance.foot]))
            _add_dimension(space, ends, 0.0)
    file = io.StringIO()
    drawing.write(file)
    return file.getvalue()


def _add_block(drawing: Any) -> None:
    """Add the block of a camera, which looks along x, with its attributes."""
    block = drawing.blocks.new('CAMERA')
    size = 0.1
    block.add_lwpolyline([(-size, -0.5 * size), (0.0, -0.5 * size), (0.0, 0.5 * size),
                          (-size, 0.5 * size)], close=True)
    block.add_lwpolyline([(0.0, 0.0), (size, 0.6 * size), (size, -0.6 * size)], close=True)
    for line, tag in enumerate(('NAME', 'FRAME', 'SENSOR', 'MOUNT', 'YAW', 'PITCH', 'ROLL', 'HFOV',
                                'VFOV', 'MIN_RANGE', 'MAX_RANGE')):
        # Only the name is visible.
        block.add_attdef(tag, (size, -(line + 1.0) * TEXT_M), height=TEXT_M,
                         dxfattribs={'flags': 0 if tag == 'NAME' else 1})


def _add_room(space: Any, exported: Exported, flat: Any) -> None:
    """Add walls, the sizes of the room, and the zones of the rig."""
    from ocp_ros.report.drawing.plan_drawing import corners_of, zones_of
    from ocp_ros.report.wall_lines import wall_lines
    assessed = exported.assessed
    for line in wall_lines(assessed.scene):
        space.add_line(*flat(line).tolist(), dxfattribs={'layer': 'WALLS'})
    sides = assessed.walls
    for before, side, after in zip((sides[3], *sides[:3]), sides, (*sides[1:], sides[0])):
        # The ends of a side are the corners with its neighbours, which are at right angles to it.
        ends = [side.offset * side.outward + other.offset * other.outward
                for other in (before, after)]
        _add_dimension(space, flat(np.array(ends)), 0.5)
    for kind, name, zone in zones_of(assessed.objective.rig):
        space.add_lwpolyline(flat(corners_of(zone)).tolist(), close=True,
                             dxfattribs={'layer': 'ZONES'})
        space.add_text(f'{kind} {name}', height=TEXT_M, dxfattribs={
            'layer': 'ZONES', 'insert': flat(corners_of(zone)).mean(axis=0).tolist()})


def _add_dimension(space: Any, ends: np.ndarray, distance: float) -> None:
    """Add the dimension of a line (2, 2), metres, ``distance`` metres to its left."""
    if np.linalg.norm(ends[1] - ends[0]) < 0.01:
        return
    space.add_aligned_dim(*ends.tolist(), distance=distance, override={
        'dimtxt': TEXT_M, 'dimasz': 0.8 * TEXT_M, 'dimexe': 0.4 * TEXT_M, 'dimexo': 0.4 * TEXT_M,
        'dimgap': 0.3 * TEXT_M, 'dimdec': 2, 'dimlfac': 1.0, 'dimblk': '', 'dimtad': 1},
        dxfattribs={'layer': 'DIMENSIONS'}).render()
