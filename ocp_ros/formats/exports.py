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

"""The files of a placement: one table of formats, and the writer of each."""

from collections.abc import Callable, Collection, Iterable
import csv
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ocp_ros.formats.building_models import ifc_of
from ocp_ros.formats.exported import Exported
from ocp_ros.formats.floor_plans import dxf_of
from ocp_ros.formats.photogrammetry import colmap_of, metropolis_of, nerfstudio_of
from ocp_ros.formats.ros_files import launch_of, rviz_of, sdf_of, xacro_of
from ocp_ros.formats.scene_models import gltf_of, usd_of
from ocp_ros.report.installer_page import installer_page
from ocp_ros.rig.placement_file import numbers_of, save_placement
from ocp_ros.util.files import file_set, write_atomically
from ocp_ros.util.settings import check_known, ConfigurationError, need

#: Placement files, which can be read again.
PLACEMENT_FILES = ('placement.yaml', 'placement.json')
#: Name of the file that is always written.
MARK = 'placement.json'
#: Columns of ``cameras.csv``: degrees and metres; x, y, z are in the requested frame and its unit.
CSV_COLUMNS = ('number', 'name', 'sensor', 'frame', 'link', 'x', 'y', 'z', 'yaw', 'pitch', 'roll',
               'mount', 'horizontal_fov', 'vertical_fov', 'min_range', 'max_range')


class Format(NamedTuple):
    """
    A format of files.

    :ivar files: the names of its files; some formats leave out the last ones.
    :ivar write: writes the files, given what is exported and the path of each.
    :ivar room: whether it needs the room of the placement.
    :ivar library: the package of the extra ``buildings`` that it needs; '' for none.
    """

    files: tuple[str, ...]
    write: Callable[..., None]
    room: bool = False
    library: str = ''


def texts(text_of: Callable[[Exported], str | Iterable[str]]) -> Callable[..., None]:
    """Return the writer of files of text, given the function that returns the texts."""
    def write(exported: Exported, *paths: Path) -> None:
        found = text_of(exported)
        for path, text in zip(paths, [found] if isinstance(found, str) else found):
            write_atomically(path, text)
    return write


def csv_of(exported: Exported) -> str:
    """Return the cameras as CSV, one row for each camera; angles are in degrees."""
    file = io.StringIO()
    # ``numbers_of`` also has the resolution, which has no column and is ignored.
    writer = csv.DictWriter(file, CSV_COLUMNS, extrasaction='ignore', lineterminator='\n')
    writer.writeheader()
    for number, placed in exported.cameras():
        writer.writerow({
            'number': number + 1, 'name': placed.camera.name, 'frame': exported.placement.frame,
            'link': exported.frame(number), 'mount': placed.mount, **numbers_of(placed.camera),
            **dict(zip('xyz', np.round(placed.position / exported.scales, 9).tolist())),
            **dict(zip(('yaw', 'pitch', 'roll'), placed.angles))})
    return file.getvalue()


def _write_placements(exported: Exported, *paths: Path) -> None:
    """Write the placement files, which are always in the map frame."""
    for path in paths:
        save_placement(path, exported.original)


# The import of the drawing modules is slow, so commands that do not draw do not import them.
def _write_installer_page(exported: Exported, page: Path, plan: Path) -> None:
    """Write the installer's page and its plan."""
    from ocp_ros.report.drawing.assessment_pictures import draw_floor_plan
    write_atomically(page, installer_page(exported.assessed, plan.name))
    draw_floor_plan(plan, exported.assessed)


def _write_report(exported: Exported, *paths: Path) -> None:
    """Write the PNG pages and, if cameras were counted, the curve and the Pareto front."""
    from ocp_ros.report.drawing import assessment_pictures, report_page
    *_, curve, front = paths
    for _ in report_page.draw_pages(curve.parent, exported.assessed):
        pass
    # Mixes have no curve, since their number of cameras rises and falls with the price.
    if 'mix' not in exported.assessed.found.get('count', {'mix': ''}):
        assessment_pictures.draw_curve(curve, exported.assessed.found)
    if exported.assessed.found.get('front'):
        assessment_pictures.draw_front(front, exported.assessed.found['front'])


def _write_page(exported: Exported, path: Path) -> None:
    """Write the page of the room in 3D."""
    from ocp_ros.report.viewer import write_view
    write_view(path, exported.assessed.scene, exported.assessed)


def _write_sheets(paper: str) -> Callable[..., None]:
    """Return the writer of the sheets for the installer on a paper, such as A4."""
    def write(exported: Exported, path: Path) -> None:
        from ocp_ros.report.drawing.plan_sheets import write_sheets
        write_sheets(path, exported.assessed, paper)
    return write


#: Reports, which take seconds to draw.
REPORTS = {'report': Format(('report.png', 'report_2.png', 'curve.png', 'front.png'),
                            _write_report, True),
           'html': Format(('report.html',), _write_page, True)}
#: Formats that are written unless others are asked for.
DEFAULT = {'placement': Format(PLACEMENT_FILES, _write_placements),
           'csv': Format(('cameras.csv',), texts(csv_of)),
           'launch': Format(('cameras.launch.py',), texts(launch_of)),
           'xacro': Format(('cameras.urdf.xacro',), texts(xacro_of)),
           'rviz': Format(('cameras.rviz',), texts(rviz_of)),
           'installer': Format(('installer.md', 'plan.png'), _write_installer_page, True),
           **REPORTS}
#: All formats by their names.
FORMATS = {**DEFAULT,
           'pdf': Format(('sheets_a4.pdf',), _write_sheets('A4'), True),
           'pdf_a3': Format(('sheets_a3.pdf',), _write_sheets('A3'), True),
           'sdf': Format(('cameras.sdf',), texts(sdf_of)),
           'nerfstudio': Format(('transforms.json',), texts(nerfstudio_of)),
           'colmap': Format(('cameras.txt', 'images.txt', 'points3D.txt'), texts(colmap_of)),
           'metropolis': Format(('metropolis_calibration.json',), texts(metropolis_of)),
           'usd': Format(('cameras.usda',), texts(usd_of)),
           'gltf': Format(('cameras.gltf',), texts(gltf_of)),
           'dxf': Format(('plan.dxf',), texts(dxf_of), True, 'ezdxf'),
           'ifc': Format(('cameras.ifc',), texts(ifc_of), False, 'ifcopenshell')}
#: The names of all files that a placement may have.
WRITTEN = tuple(name for one in FORMATS.values() for name in one.files)


def formats_named(names: Collection[str], option: str) -> list[str]:
    """
    Return names of formats, each once, with the placement file first.

    :param names: names in :data:`FORMATS`; ``default`` stands for those in :data:`DEFAULT`.
    :param option: the option that has the names, for the message.
    :raises ConfigurationError: for an unknown name, or a format whose library is not installed.
    """
    check_known(names, ('default', *FORMATS), option)
    full = [one for name in names for one in (DEFAULT if name == 'default' else [name])]
    for name in full:
        library = FORMATS[name].library
        if library:
            need(f'{option} {name}', library)
    return list(dict.fromkeys(['placement', *full]))


def export(folder: Path, exported: Exported, names: Iterable[str]) -> dict[str, Any]:
    """
    Write a placement in several formats.

    Placement files are in the map frame, in which scores are computed, and contain the transform
    to the frame of the scan. The frame of the other files is
    :attr:`~ocp_ros.report.assessment.Assessment.data_frame`.

    :param folder: the folder of an unfinished set of files, see
        :func:`~ocp_ros.util.files.file_set`.
    :param exported: with its room if one of the formats needs it.
    :param names: names in :data:`FORMATS`.
    :returns: ``written``: the paths that the files get at the end, in the parent folder; also
        ``error`` if some formats could not be written.
    """
    written: list[str] = []
    errors = []
    for name in names:
        paths = [folder / file for file in FORMATS[name].files]
        try:
            FORMATS[name].write(exported, *paths)
        except ConfigurationError as error:
            errors.append(str(error))
        except OSError as error:
            errors.append(f'--out: found {folder.parent}, where not all could be written '
                          f'({error.strerror or error}); expected room for it; use what is '
                          'printed, or make room and do it again')
        written += [str(folder.parent / path.name) for path in paths if path.exists()]
    return {'written': written, **({'error': errors[0]} if errors else {})}


def export_to(folder: Path, exported: Exported, names: Iterable[str]) -> dict[str, Any]:
    """Write a placement to a folder, whose files appear together; see :func:`export`."""
    with file_set(folder, WRITTEN, MARK) as unfinished:
        return export(unfinished, exported, names)
