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

"""File formats of rooms and their readers, by file name suffix."""

from collections.abc import Callable
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.clouds import thinned_to
from ocp_ros.scenes.building_files import Building, MAP, read_map
from ocp_ros.scenes.cloud_files import (
    has_faces,
    read_e57_scans,
    read_pcd_fields,
    read_ply_fields,
)
from ocp_ros.scenes.guarded_reading import read_guarded
from ocp_ros.scenes.las_files import (
    FOOT,
    las_units,
    LengthUnit,
    METRE,
    read_las_points,
    SURVEY_FOOT,
)
from ocp_ros.scenes.measured_room import ROOM, solids_of, triangles_of
from ocp_ros.scenes.meshes import MESHES, read_mesh
from ocp_ros.scenes.scene import Scan, SceneError
from ocp_ros.scenes.text_tables import read_points, read_ptx_scans
from ocp_ros.util.files import printable
from ocp_ros.util.settings import need
from ocp_ros.util.yaml_files import check, read_plain

#: Suffixes of measured rooms and of maps.
MEASURED = ('.yaml', '.yml')
#: The kind of each suffix of floor plans and models of buildings, and the package that reads it.
BUILDINGS = {'.dxf': ('dxf', 'ezdxf'), '.ifc': ('ifc', 'ifcopenshell'),
             **dict.fromkeys(('.usd', '.usda', '.usdc', '.usdz'), ('usd', 'pxr'))}
#: The options of each kind; those of walls need the height.
BUILDING_OPTIONS = {'dxf': ('height', 'layers'), 'map': ('height',),
                    'ifc': ('storey', 'space', 'open_doors')}
TEXTS = ('.asc', '.csv', '.pts', '.txt', '.xyz')
#: Units of length by a pattern of their names in comments.
COMMENT_UNITS = {
    'mm|millimet(?:er|re)s?': LengthUnit('millimetre', 0.001),
    'cm|centimet(?:er|re)s?': LengthUnit('centimetre', 0.01),
    'dm|decimet(?:er|re)s?': LengthUnit('decimetre', 0.1), 'm|met(?:er|re)s?': METRE,
    'in|inch(?:es)?': LengthUnit('inch', 0.0254), 'ft|foot|feet': FOOT,
    r'(?:u\.?s\.?\s*)(?:survey\s*)?(?:ft|foot|feet)|ft_?us|sft|survey feet': SURVEY_FOOT,
    'yd|yards?': LengthUnit('yard', 0.9144)}
#: One of these names; ``in`` may begin other words.
UNIT_NAME = rf'(?P<unit>{"|".join(COMMENT_UNITS)})(?<!\bin(?=[^\S\n]+[a-z]))(?![a-z_])'
#: A comment about the unit, such as ``# File units = inches`` or ``comment 1 unit = 10 mm``.
COMMENT_ON_UNIT = re.compile(
    r'^[^\S\n]*(?:#|//|comment\b).*?(?:\b(?:units?|dimensions|coordinates|measure(?:d|ments)|'
    r'lengths?|values|exported)\b[^\w\n]*(?:(?:of|length|are|is|in|equals|scale)[^\w\n]+|'
    r'1[^\S\n]*=[^\S\n]*)*(?P<number>(?:\d+(?:\.\d*)?|\.\d+)[^\S\n]*)?|\buses[^\S\n]+)'
    + UNIT_NAME, re.IGNORECASE | re.MULTILINE)
#: The name of a column with its unit, such as ``x [mm]``, ``x_mm`` or ``Easting (ft)``.
COLUMN_WITH_UNIT = re.compile(
    r'^(?:.*[^a-z\n])??(?:x|e|east(?:ings?)?|rechts(?:wert)?)"?(?:[^\S\n]*[\[(]|_)' + UNIT_NAME,
    re.IGNORECASE | re.MULTILINE)
#: Columns of a PLY file of Gaussian splats, as those of Kerbl et al. 2023.
SPLAT_COLUMNS = (b' opacity', b' scale_0')


def _rows_from_fields(fields: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Return the points (N, 3), or points and normals (N, 6), from columns (N,) by name."""
    missing = [axis for axis in 'xyz' if axis not in fields]
    if missing:
        remedy = ('export the splats without compression' if 'packed_position' in fields else
                  'export the coordinates too')
        raise SceneError(f'{name}: found the fields {" ".join(fields) or "(none)"} and no '
                         f'{" ".join(missing)}; expected x, y and z; {remedy}')
    for axis in 'xyz':
        _check_rounding(np.ravel(fields[axis]), axis, name)
    name_sets = ('nx', 'ny', 'nz'), ('normal_x', 'normal_y', 'normal_z')
    normals = next((names for names in name_sets if all(field in fields for field in names)), ())
    return np.stack([np.ravel(fields[field]).astype(np.float64) for field in (*'xyz', *normals)],
                    axis=-1)


def _check_rounding(column: np.ndarray, axis: str, name: str) -> None:
    """Refuse float32 coordinates (N,) that are far from the origin, where float32 rounds them."""
    if column.dtype.kind != 'f' or column.dtype.itemsize > 4:
        return
    values = column[np.isfinite(column)].astype(np.float64)
    if len(values) == 0:
        return
    step = float(np.spacing(np.float32(np.abs(values).max())))
    # Steps of more than 2 mm for an extent of 10 m are too coarse.
    if step > 2e-4 * np.ptp(values) and np.ptp(values) > 0.0:
        raise SceneError(
            f'{name}: found {axis} of {values.max():.0f} as float32, which rounds it to steps of '
            f'{step:.3g}; expected coordinates that are not rounded; export them as float64 '
            '(double), or moved near the origin')


def _read_ply(path: Path) -> np.ndarray:
    """Read the faces (T, 9) of a PLY file if it has any, otherwise its vertices, (N, 3 or 6)."""
    if has_faces(path):
        return read_mesh(path)
    fields = read_ply_fields(path)
    if not fields:
        raise SceneError(f'{path.name}: found no vertices; expected the element vertex with x, y '
                         'and z; export the points, not only faces')
    return _rows_from_fields(fields, path.name)


def _read_npy(path: Path) -> np.ndarray:
    """Read a NumPy array of x y z and more columns, or of records with fields; never unpickle."""
    with path.open('rb') as file:
        array = np.lib.format.read_array(file, allow_pickle=False)
    if array.dtype.names:
        return _rows_from_fields({field: array[field] for field in array.dtype.names}, path.name)
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in 'fiu':
        raise SceneError(f'{path.name}: found {array.dtype} of shape {array.shape}; expected '
                         'numbers of shape (N, 3) or wider, one row x y z per point; save it so')
    return array[:, :3].astype(np.float64)


def _read_pcd(path: Path) -> np.ndarray:
    """Read a PCD file: ascii, binary or binary_compressed."""
    return _rows_from_fields(read_pcd_fields(path), path.name)


class Declared(NamedTuple):
    """
    The unit, the axes and the solids that a file declares.

    :ivar metres: metres per unit of the file, for each of its axes x, y and z.
    :ivar up: the axis direction of the file that points up.
    :ivar remark: a description of the declared unit or axis, if it is not metres or z.
    :ivar solids: (S, 2, 3) two opposite corners of each solid box; None if the file declares none.
    :ivar note: a problem with the unit, if the file has one.
    :ivar scans: those that the file has, thinned.
    """

    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)
    up: str = 'z'
    remark: str = ''
    solids: np.ndarray | None = None
    note: str = ''
    scans: tuple[Scan, ...] = ()


def declared_by(path: Path) -> Declared:
    """Return what a file declares; the default is metres, z up and no solids."""
    suffix = path.suffix.lower()
    if suffix in ('.glb', '.gltf'):
        return Declared(up='y', remark='up: y (glTF)')
    if suffix in ('.las', '.laz'):
        return _declared_units(*las_units(path))
    if suffix in ('.obj', '.off', '.ply', *TEXTS):
        with path.open('rb') as file:
            head = file.read(1 << 14)
        if suffix == '.ply' and all(column in head for column in SPLAT_COLUMNS):
            return Declared(note='found a file of splats, which has no scale; expected metres; '
                                 'measure one length, and divide it by the length in the file '
                                 '(--scale)')
        text = head.decode('latin-1')
        found = COMMENT_ON_UNIT.search(text)
        factor = float(found['number'] or 1.0) if found else 1.0
        if found := found or (COLUMN_WITH_UNIT.search(text) if suffix in TEXTS else None):
            unit = next(unit for pattern, unit in COMMENT_UNITS.items()
                        if re.fullmatch(pattern, found['unit'], re.IGNORECASE))
            return _declared_units(*2 * [unit if factor == 1.0 else LengthUnit(
                f'{factor:g} {unit.name}', factor * unit.metres)])
    return Declared()


def _declared_units(plan: LengthUnit, height: LengthUnit) -> Declared:
    """Return the declaration of the units of x and y, and of z."""
    names = plan.name if plan == height else f'{plan.name} in plan, {height.name} in height'
    return Declared((plan.metres, plan.metres, height.metres),
                    remark=f'unit: {printable(names)}, as the file says')


#: The reader of each suffix. A reader returns float64 points (N, 3), points and normals (N, 6),
#: triangle corners (T, 9), or a list of scans, in the unit and the axes of the file.
READERS: dict[str, Callable[[Path], np.ndarray | list[Scan]]] = {
    '.las': read_las_points, '.laz': read_las_points, '.npy': _read_npy, '.pcd': _read_pcd,
    '.ply': _read_ply, '.ptx': read_ptx_scans, '.e57': read_e57_scans,
    **dict.fromkeys(TEXTS, read_points), **dict.fromkeys(MESHES, read_mesh)}
SUFFIXES = (*READERS, *BUILDINGS, *MEASURED)
#: The most points that all scans of a file keep to tell what each of them measured.
SCAN_POINTS = 400_000


def read_file(path: Path, building: Building, scale: float) -> tuple[np.ndarray, Declared]:
    """
    Read a file with one of the ``SUFFIXES``.

    :param building: what is read of a map, a floor plan or a model of a building.
    :param scale: metres per unit of the file; 0 for the unit that it declares.
    :returns: (N, 3) points, (N, 6) points and normals, or (T, 9) the corners of triangles, in the
        unit and the axes of the file; and what the file declares.
    :raises Exception: almost any, if the file is broken.
    """
    suffix = path.suffix.lower()
    if suffix in MEASURED:
        document = read_plain(path)
        if isinstance(document.data, dict) and 'image' in document.data:
            check(document, MAP)
            _check_building(path, 'map', building)
            return read_map(document, path.parent, building.height), Declared()
        check(document, ROOM)
        _check_building(path, '', building)
        return triangles_of(document).reshape(-1, 9), Declared(solids=solids_of(document))
    kind, package = BUILDINGS.get(suffix, ('', ''))
    _check_building(path, kind, building)
    if not kind:
        found = READERS[suffix](path)
        if not isinstance(found, list):
            return found, declared_by(path)
        finite = [scan.points[np.isfinite(scan.points).all(axis=1)] for scan in found]
        return np.concatenate([scan.points for scan in found]), Declared(scans=tuple(
            Scan(scan.station, thinned_to(points, SCAN_POINTS // len(found)))
            for scan, points in zip(found, finite) if len(points)))
    need(path.name, package)
    arguments = {'dxf': (str(building.height), building.layers, str(scale)), 'usd': (),
                 'ifc': (building.storey, building.space, 'yes' if building.open_doors else '')}
    try:
        rows = read_guarded(kind, path, 9, max(path.stat().st_size, 5_000_000), arguments[kind])
    except ValueError as error:
        # A sentence of the reader itself, not an error of its library.
        if str(error).startswith('found '):
            raise SceneError(f'{path.name}: {error}') from error
        raise
    if len(rows) < 2:
        raise ValueError('no visible faces')
    # The first row is the frame.
    metres, up_name = float(rows[0, 0]), 'xyz'[int(rows[0, 1])]
    remark = ', '.join([*([f'unit: {metres:g} m'] if metres != 1.0 else []),
                        *([f'up: {up_name}'] if up_name != 'z' else [])])
    return rows[1:].copy(), Declared((metres,) * 3, up_name, f'{remark}, as the file says')


def _check_building(path: Path, kind: str, building: Building) -> None:
    """Refuse options that do not fit the kind of a file, and walls without a height."""
    allowed = BUILDING_OPTIONS.get(kind, ())
    for option, value in building._asdict().items():
        if value and option not in allowed:
            kinds = ' or '.join(name for name, names in BUILDING_OPTIONS.items()
                                if option in names)
            raise SceneError(f'{path.name}: found --{option.replace("_", "-")} with this file; '
                             f'expected it with a file of the kind {kinds}; leave it out')
    if 'height' in allowed and not 0.5 <= building.height <= 100.0:
        raise SceneError(f'{path.name}: found walls in plan, and a height of {building.height:g} '
                         'm; expected 0.5 to 100; give the height of the walls (--height 2.7)')
