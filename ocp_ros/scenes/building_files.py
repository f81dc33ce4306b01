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

"""
Rooms from occupancy maps of robots, DXF floor plans and IFC building models.

The functions that need a library run in the separate process of
:mod:`ocp_ros.scenes.guarded_reading`. The first row that they yield describes the frame of the
file: metres per unit, and the number of the axis that points up. All others are the corners of
triangles.
"""

from collections.abc import Iterable, Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.util import yaml_files as schema
from ocp_ros.util.files import read_regular
from ocp_ros.util.yaml_files import Document

#: Layers of walls in floor plans, in some languages.
WALL_LAYER = re.compile('wall|wand|wänd|mur|pared|muur|vägg|seina|stena', re.IGNORECASE)
#: Parts of building models through which cameras see, or that are nothing to see.
TRANSPARENT = ('IfcWindow', 'IfcOpeningElement', 'IfcSpace', 'IfcSite', 'IfcAnnotation', 'IfcGrid')
#: Metres: what a storey or a space has around it, such as slabs and walls.
AROUND_STOREY_M, AROUND_SPACE_M = 0.6, 0.35
#: The largest number of cells of a map, of rectangles of its floor, and of pieces of its walls.
MAX_MAP_CELLS, MAX_MAP_PARTS = 50_000_000, 200_000
MAP = schema.mapping(
    'a map with the keys image, resolution and origin',
    {'image': 'map.pgm', 'resolution': 0.05, 'origin': [0, 0, 0]},
    ('image', 'resolution', 'origin'),
    image=schema.text('the name of an image in the folder of this file', 'map.pgm'),
    resolution=schema.number('metres per pixel, from 0.005 to 0.5', 0.05, minimum=0.005,
                             maximum=0.5),
    origin=schema.many('x and y of the lower left pixel in metres, and yaw in radians',
                       {'type': 'number'}, [0, 0, 0], 2, 3),
    occupied_thresh=schema.number('a share from 0 to 1', 0.65, minimum=0, maximum=1),
    free_thresh=schema.number('a share from 0 to 1', 0.25, minimum=0, maximum=1),
    negate={'description': '0 or 1', 'enum': [0, 1, False, True], 'examples': [0]},
    mode=schema.one_of(('trinary', 'scale', 'raw'), 'trinary'))


class Building(NamedTuple):
    """
    What is read of a file that does not describe one room alone.

    :ivar height: metres, of the walls of a map or floor plan; 0 if it is not given.
    :ivar layers: names of the layers of walls in a DXF file, with commas; empty for those that
        are named like walls, and neither off nor frozen.
    :ivar storey: name of a storey of an IFC model; empty for all of them.
    :ivar space: name or number of a space of an IFC model; empty for all of them.
    :ivar open_doors: leave out the doors of an IFC model.
    """

    height: float = 0.0
    layers: str = ''
    storey: str = ''
    space: str = ''
    open_doors: bool = False


EVERYTHING = Building()


def read_map(document: Document, folder: Path, height: float) -> np.ndarray:
    """
    Read an occupancy map of ROS (map_server, slam_toolbox) as walls between a floor and a ceiling.

    :param document: a map that is valid under the schema :data:`MAP`.
    :param folder: of its file.
    :param height: metres from the floor, z = 0, to the ceiling.
    :returns: (T, 9) the corners of triangles, metres, in the frame of the map.
    :raises ConfigurationError: if the image cannot be used.
    """
    data = document.data
    occupied, free = _map_cells(document, folder)
    # The image begins at the top, the map at the bottom; the first axis becomes x.
    occupied, free = occupied[::-1].T, free[::-1].T
    if not free.any() or not occupied.any():
        raise document.error(
            ('image',), f'{free.sum()} free and {occupied.sum()} occupied pixels',
            'both: white floor and black walls', 'correct the thresholds or negate')
    rectangles, edges = (list(islice(parts, MAX_MAP_PARTS + 1))
                         for parts in (_rectangles(free), _edges_between(free, occupied)))
    if max(len(rectangles), len(edges)) > MAX_MAP_PARTS:
        raise document.error(('image',), f'more than {MAX_MAP_PARTS:,} pieces of floor or walls',
                             'rooms with straight walls', 'remove the noise')
    quads = []
    for low, high in rectangles:
        (x, y), (far_x, far_y) = low, high
        plan = np.array([(x, y), (far_x, y), (far_x, far_y), (x, far_y)], dtype=np.float64)
        quads += [np.insert(plan, 2, level, axis=1) for level in (0.0, 1.0)]
    for start, end in edges:
        quads.append(np.array([(*start, 0.0), (*end, 0.0), (*end, 1.0), (*start, 1.0)]))
    x, y, *yaw = data['origin']
    corners = np.array(quads) * (data['resolution'], data['resolution'], height)
    return triangles_of(corners @ rotation_matrix(*yaw).T + (x, y, 0.0))


def triangles_of(quads: np.ndarray) -> np.ndarray:
    """Divide quadrilaterals (Q, 4, 3) by a diagonal: (2 Q, 9) the corners of triangles."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 9)


def _map_cells(document: Document, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """
    Return which pixels (H, W) of a map are occupied, and which are free.

    Source: nav2_map_server, map_io.cpp. Transparent pixels are unknown.
    """
    from PIL import Image
    data = document.data
    name = data['image']
    if Path(name).name != name:
        raise document.error(('image',), repr(name), 'a file in the same folder',
                             'move the image there, and correct its name')
    try:
        content = BytesIO(read_regular(folder / name))
        with Image.open(content, formats=('PPM', 'PNG', 'BMP')) as image:
            if image.width * image.height > MAX_MAP_CELLS:
                raise document.error(
                    ('image',), f'{image.width} x {image.height} pixels',
                    f'at most {MAX_MAP_CELLS:,}', 'cut out the rooms that are needed')
            pixels = np.asarray(image.convert('RGBA'))
    except (OSError, SyntaxError, ValueError) as error:
        raise document.error(('image',), f'{name}, which cannot be read ({error})',
                             'a .pgm, .png or .bmp image', 'correct its name') from error
    values, known = pixels[..., :3].mean(axis=2), pixels[..., 3] == 255
    if data.get('mode') == 'raw':
        # Pixels are percentages; others are unknown.
        occupancy, known = values / 100.0, known & (values <= 100.0)
    else:
        occupancy = values / 255.0 if data.get('negate', 0) else 1.0 - values / 255.0
    return (known & (occupancy > data.get('occupied_thresh', 0.65)),
            known & (occupancy < data.get('free_thresh', 0.25)))


def _rectangles(mask: np.ndarray) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield rectangles that cover the cells of a mask (X, Y): their lowest and highest corners."""
    open_runs: dict[tuple[int, int], int] = {}
    for x in range(len(mask) + 1):
        column = mask[x] if x < len(mask) else np.zeros(mask.shape[1], dtype=bool)
        runs = set(_runs(column))
        for run in set(open_runs) - runs:
            yield (open_runs.pop(run), run[0]), (x, run[1])
        for run in runs - set(open_runs):
            open_runs[run] = x


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the first index of each run of a mask (N,), and the one after its end."""
    steps = np.flatnonzero(np.diff(np.r_[0, mask.astype(np.int8), 0]))
    return list(zip(steps[::2].tolist(), steps[1::2].tolist()))


def _edges_between(free: np.ndarray, occupied: np.ndarray
                   ) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield the straight lines between free and occupied cells (X, Y): their ends."""
    for axis in (0, 1):
        a, b = (free, occupied) if axis == 0 else (free.T, occupied.T)
        border = (a[1:] & b[:-1]) | (a[:-1] & b[1:])
        for number, row in enumerate(border, start=1):
            for start, end in _runs(row):
                line = (number, start), (number, end)
                yield line if axis == 0 else (line[0][::-1], line[1][::-1])


def dxf_rows(path: str, height: str, layers: str, scale: str) -> Iterator[np.ndarray]:
    """
    Yield the walls of a floor plan, with a floor and a ceiling: a row of its frame, and triangles.

    :param height: metres.
    :param layers: see :class:`Building`.
    :param scale: metres per unit; 0 for the unit of the file.
    """
    import ezdxf
    from ezdxf import units
    plan = ezdxf.readfile(path)
    unit = plan.header.get('$INSUNITS', 0)
    metres = float(scale) or (units.conversion_factor(unit, units.M) if unit else 1.0)
    wanted = {name.strip().lower() for name in layers.split(',') if name.strip()}
    hidden = {layer.dxf.name for layer in plan.layers if layer.is_frozen() or layer.is_off()}
    lines, found = [], set()
    for layer, points in _polylines(plan.modelspace(), '0', 0.02 / metres):
        found.add(layer)
        if layer.lower() in wanted if wanted else (
                WALL_LAYER.search(layer) and layer not in hidden):
            lines.append(np.stack([points[:-1], points[1:]], axis=1))
    if not lines:
        raise ValueError(f'found lines on the layers {", ".join(sorted(found)[:20]) or "(none)"}; '
                         f'expected {layers or "one that is named like walls"}; name those of '
                         'walls (--layers)')
    ends = np.concatenate(lines)
    top = float(height) / metres
    low, high = ends.min(axis=(0, 1)), ends.max(axis=(0, 1))
    plan_corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    quads = [np.insert(plan_corners, 2, z, axis=1)[None] for z in (0.0, top)]
    # A wall goes from the start of a line to its end, and back at the top.
    walls = np.insert(ends[:, [0, 1, 1, 0]], 2, 0.0, axis=2)
    walls[:, 2:, 2] = top
    yield frame_row(metres, 2)
    yield triangles_of(np.concatenate([*quads, walls]))


def _polylines(entities: Any, parent_layer: str, step: float
               ) -> Iterator[tuple[str, np.ndarray]]:
    """
    Yield the layer and the points (N, 2) of each line and curve, also in blocks.

    :param parent_layer: the layer of what is on layer 0 of a block.
    :param step: the largest distance of a curve from its straight parts.
    """
    from ezdxf.path import make_path
    for entity in entities:
        layer = entity.dxf.get('layer', '0')
        layer = parent_layer if layer == '0' else layer
        if entity.dxftype() == 'INSERT':
            for one in entity.multi_insert() if entity.mcount > 1 else (entity,):
                yield from _polylines(one.virtual_entities(), layer, step)
            continue
        try:
            path = make_path(entity)
        except TypeError:
            # Texts, dimensions and hatches.
            continue
        points = np.array([(point.x, point.y) for point in path.flattening(step)])
        if len(points) > 1:
            yield layer, points


def ifc_rows(path: str, storey: str, space: str, open_doors: str) -> Iterator[np.ndarray]:
    """
    Yield the parts of a building model: a row of its frame, and triangles.

    :param storey: see :class:`Building`, as for ``space``.
    :param open_doors: any text to leave out doors, otherwise an empty one.
    """
    import ifcopenshell
    from ifcopenshell import geom
    from ifcopenshell.util.unit import calculate_unit_scale
    model = ifcopenshell.open(path)
    metres = float(calculate_unit_scale(model))
    settings = geom.settings()
    settings.set('use-world-coords', True)
    # All lengths in the unit of the file.
    settings.set('convert-back-units', True)
    low, high = _bounds_in_model(model, geom, settings, storey, space, metres)
    yield frame_row(metres, 2)
    hidden = (*TRANSPARENT, *(['IfcDoor'] if open_doors else []))
    shapes = geom.iterator(settings, model, 1, exclude=_of_kinds(model, hidden))
    is_any = shapes.initialize()
    while is_any:
        corners = _clipped(_corners_of(shapes.get().geometry), low, high)
        if len(corners):
            yield corners.reshape(-1, 9)
        is_any = shapes.next()


def _of_kinds(model: Any, kinds: Iterable[str]) -> list[Any]:
    """Return the elements of some kinds, and the panes of curtain walls."""
    from ifcopenshell.util.element import get_predefined_type
    elements = [element for kind in kinds for element in model.by_type(kind)]
    panes = [plate for plate in model.by_type('IfcPlate')
             if get_predefined_type(plate) == 'CURTAIN_PANEL']
    return elements + panes


def _corners_of(geometry: Any) -> np.ndarray:
    """Return the triangles (T, 3, 3) of a shape of a building model."""
    vertices = np.array(geometry.verts, dtype=np.float64).reshape(-1, 3)
    return vertices[np.array(geometry.faces, dtype=np.int64).reshape(-1, 3)]


def _bounds_in_model(model: Any, geom: Any, settings: Any, storey: str, space: str, metres: float
                     ) -> tuple[np.ndarray, np.ndarray]:
    """Return two opposite corners (3,) of what is read, in the unit of the file."""
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    if storey:
        storeys = storey_levels(model)
        chosen = _named([one for _, one in storeys], storey, 'storey')
        level = next(z for z, one in storeys if one == chosen)
        above = [z for z, _ in storeys if z > level]
        low[2] = level - AROUND_STOREY_M / metres
        high[2] = min(above, default=np.inf) + AROUND_STOREY_M / metres
    if space:
        chosen = _named(model.by_type('IfcSpace'), space, 'space')
        vertices = _corners_of(geom.create_shape(settings, chosen).geometry).reshape(-1, 3)
        low = np.maximum(low, vertices.min(axis=0) - AROUND_SPACE_M / metres)
        high = np.minimum(high, vertices.max(axis=0) + AROUND_SPACE_M / metres)
    return low, high


def storey_levels(model: Any) -> list[tuple[float, Any]]:
    """Return z of each storey of a building model, in its unit, and the storey; lowest first."""
    from ifcopenshell.util.placement import get_storey_elevation
    storeys = model.by_type('IfcBuildingStorey')
    levels = [float(get_storey_elevation(storey)) for storey in storeys]
    # Some programs place all storeys at one level, and write only their elevations.
    if len(levels) > 1 and len(set(levels)) == 1:
        levels = [level + (one.Elevation or 0.0) for level, one in zip(levels, storeys)]
    return sorted(zip(levels, storeys), key=lambda item: item[0])


def _named(items: list[Any], name: str, what: str) -> Any:
    """Return the element with a name, or a long name."""
    names = [(item.Name or '', item.LongName or '') for item in items]
    matches = [item for item, own in zip(items, names)
               if name.lower() in map(str.lower, own)]
    if not matches:
        listed = ', '.join(' '.join(own).strip() for own in names[:30]) or 'none'
        raise ValueError(f'found no {what} {name!r}; expected one of {listed}; correct --{what}')
    return matches[0]


def _clipped(corners: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """
    Cut triangles off at the sides of a box.

    :param corners: (T, 3, 3).
    :param low: (3,) one corner of the box; ``high`` is the opposite one. Both may be infinite.
    :returns: (U, 3, 3), the triangles inside of the box.
    """
    for axis in range(3):
        for limit, sign in ((low[axis], 1.0), (high[axis], -1.0)):
            if np.isinf(limit) or not len(corners):
                continue
            depths = sign * (corners[:, :, axis] - limit)
            counts = (depths >= 0.0).sum(axis=1)
            parts = [corners[counts == 3]]
            for count in (1, 2):
                # The corner that is alone on its side comes first.
                cut, own = corners[counts == count], depths[counts == count]
                alone = ((own >= 0.0) == (count == 1)).argmax(axis=1)
                order = (alone[:, None] + np.arange(3)) % 3
                cut = np.take_along_axis(cut, order[..., None], axis=1)
                own = np.take_along_axis(own, order, axis=1)
                shares = own[:, :1] / (own[:, :1] - own[:, 1:])
                first, second = (cut[:, 0] + shares[:, k:k + 1] * (cut[:, k + 1] - cut[:, 0])
                                 for k in (0, 1))
                parts += ([np.stack([cut[:, 0], first, second], axis=1)] if count == 1 else
                          [np.stack([first, cut[:, 1], cut[:, 2]], axis=1),
                           np.stack([first, cut[:, 2], second], axis=1)])
            corners = np.concatenate(parts)
    return corners


def frame_row(metres: float, up: int) -> np.ndarray:
    """Return the row (1, 9) of the frame of a file."""
    return np.array([[metres, up, 0, 0, 0, 0, 0, 0, 0]], dtype=np.float64)
