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

"""Export of a placement: files for installers, spreadsheets and ROS 2."""

from collections.abc import Collection, Iterable, Iterator, Sequence
import csv
from dataclasses import replace
from html import escape
import io
from itertools import chain
import json
from pathlib import Path
import re
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from ocp_ros.geometry.cameras import heading_of, rotation_matrix
from ocp_ros.report import fill_template
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.camera_words import INSTRUCTION_COLUMNS, lens_text
from ocp_ros.report.facts import page_facts_of
from ocp_ros.rig.placement_file import FRAME, numbers_of, Placement, save_placement
from ocp_ros.scenes.source_frame import SourceFrame
from ocp_ros.util.files import write_atomically
from ocp_ros.util.terminal_text import printable

#: Placement files, which can be read again.
PLACEMENT_FILES = ('placement.yaml', 'placement.json')
#: Name of the file that is always written.
MARK = 'placement.json'
#: All files of a placement; ``curve.png`` is written only if cameras were counted.
WRITTEN = (*PLACEMENT_FILES, 'cameras.csv', 'cameras.launch.py', 'cameras.urdf.xacro',
           'cameras.rviz', 'installer.md', 'plan.png', 'report.png', 'report_2.png', 'report.html',
           'curve.png')
#: Name of the frame with the axes of the room's scan, in metres.
SCAN_FRAME = 'scan'
#: Columns of ``cameras.csv``: degrees and metres; x, y, z are in the requested frame and its unit.
CSV_COLUMNS = ('number', 'name', 'sensor', 'frame', 'link', 'x', 'y', 'z', 'yaw', 'pitch', 'roll',
               'mount', 'horizontal_fov', 'vertical_fov', 'min_range', 'max_range')
#: Link and joint of a frame: link, joint name, parent in quotes, child, xyz in metres, rpy in rad.
JOINT_TEMPLATE = """    <link name="%s"/>
    <joint name="%s_joint" type="fixed">
      <parent link=%s/>
      <child link="%s"/>
      <origin xyz="%s" rpy="%s"/>
    </joint>
"""


def write_files(folder: Path, assessed: Assessment, prefix: str = '', brief: bool = False
                ) -> dict[str, Any]:
    """
    Write a placement in all file formats, and its reports.

    :param folder: the folder of an unfinished set of files, see
        :func:`~ocp_ros.util.files.file_set`.
    :param assessed: the placement in its room.
    :param prefix: prefix of frame names, so that the frames of two rigs have different names.
    :param brief: whether to leave out the reports, which take seconds to draw.
    :returns: ``written``: paths; also ``error`` if some files could not be written.
    """
    paths: list[str] = []
    try:
        for path in chain(export(folder, assessed, prefix),
                          () if brief else reports(folder, assessed)):
            # At the end the files are moved to the parent folder.
            paths.append(str(folder.parent / path.name))
    except OSError as error:
        return {'written': paths, 'error': (
            f'--out: found {folder.parent}, where not all could be written '
            f'({error.strerror or error}); expected room for it; use what is printed, or make '
            'room and do it again')}
    return {'written': paths}


def export(folder: Path, assessed: Assessment, prefix: str = '') -> Iterator[Path]:
    """
    Write a placement as files for programs and installers, and yield the path of each.

    Placement files are in the map frame, in which scores are computed, and contain the transform
    to the frame of the scan. The frame of the other files is
    :attr:`~ocp_ros.report.assessment.Assessment.data_frame`.

    :param folder: folder to write to, which is created if it does not exist.
    :param assessed: the placement in its room.
    :param prefix: prefix of frame names.
    :raises OSError: if a file cannot be written.
    """
    placement = assessed.placement
    source = assessed.scene.source
    for name in PLACEMENT_FILES:
        save_placement(folder / name, placement)
        yield folder / name
    # In metres, map = rotation @ scan - shift; a scan as parent frame needs the inverse.
    link = link_between(FRAME, SCAN_FRAME, source.rotation, -source.shift)
    if not assessed.data_frame.is_map:
        placement = placement_in_scan_axes(placement, source)
        link = link_between(SCAN_FRAME, FRAME, source.rotation.T, source.rotation.T @ source.shift)
    links = [] if source.is_map else [link]
    texts = {'cameras.csv': csv_of(placement, assessed.data_frame.scales, prefix),
             'cameras.launch.py': launch_of(placement, links, prefix),
             'cameras.urdf.xacro': xacro_of(placement, links, prefix),
             'cameras.rviz': rviz_of(placement),
             'installer.md': installer_page(assessed, 'plan.png')}
    for name, text in texts.items():
        write_atomically(folder / name, text)
        yield folder / name
    # The import of the drawing modules is slow, so other commands do not import them.
    from ocp_ros.report.drawing.assessment_pictures import draw_floor_plan
    draw_floor_plan(folder / 'plan.png', assessed)
    yield folder / 'plan.png'


def reports(folder: Path, assessed: Assessment) -> Iterator[Path]:
    """Write the PNG pages, the HTML page and, if cameras were counted, the curve; yield paths."""
    # These imports are slow, as in :func:`export`.
    from ocp_ros.report.drawing import assessment_pictures, report_page
    from ocp_ros.report.viewer import write_view
    yield from report_page.draw_pages(folder, assessed)
    write_view(folder / 'report.html', assessed.scene, assessed)
    yield folder / 'report.html'
    if 'curve' in assessed.found:
        assessment_pictures.draw_curve(folder / 'curve.png', assessed.found)
        yield folder / 'curve.png'


class Link(NamedTuple):
    """
    A transform between frames of a placement.

    :ivar parent: name of the parent frame.
    :ivar child: name of the child frame.
    :ivar position: origin of the child frame in the parent frame, metres.
    :ivar angles: rotation of the child frame in the parent frame: roll, pitch, yaw in radians.
    """

    parent: str
    child: str
    position: tuple[float, float, float]
    angles: tuple[float, float, float]


def link_between(parent: str, child: str, rotation: np.ndarray, position: np.ndarray) -> Link:
    """
    Return the transform between two frames.

    :param rotation: (3, 3) from child to parent.
    :param position: (3,) metres, origin of the child frame in the parent frame.
    """
    yaw, pitch, roll = heading_of(rotation).tolist()
    return Link(parent, child, tuple(position.tolist()), (roll, pitch, yaw))


def placement_in_scan_axes(placement: Placement, source: SourceFrame) -> Placement:
    """Return a placement with positions in metres and angles in the axes of the scan file."""
    cameras = []
    for placed in placement.cameras:
        angles = heading_of(source.rotation.T @ rotation_matrix(*np.deg2rad(placed.angles)))
        cameras.append(placed._replace(
            position=tuple((source.scales * source.to_source(placed.position)).tolist()),
            angles=tuple(np.round(np.rad2deg(angles), 6).tolist())))
    return replace(placement, cameras=tuple(cameras), frame=SCAN_FRAME)


def body_frame(number: int) -> str:
    """Return the name of the body frame of camera ``number``, from 0, as in the nodes."""
    return f'camera_{number}'


def csv_of(placement: Placement, scales: Iterable[float] = (1.0, 1.0, 1.0),
           prefix: str = '') -> str:
    """
    Return the cameras as CSV, one row for each camera; angles are in degrees.

    :param placement: poses of the cameras.
    :param scales: metres per unit of the written x, y and z.
    :param prefix: prefix of frame names.
    """
    file = io.StringIO()
    # ``numbers_of`` also has the resolution, which has no column and is ignored.
    writer = csv.DictWriter(file, CSV_COLUMNS, extrasaction='ignore', lineterminator='\n')
    writer.writeheader()
    for number, placed in enumerate(placement.cameras, start=1):
        writer.writerow({
            'number': number, 'name': placed.camera.name, 'frame': placement.frame,
            'link': prefix + body_frame(number - 1), 'mount': placed.mount,
            **numbers_of(placed.camera),
            **dict(zip('xyz', np.divide(placed.position, scales).tolist())),
            **dict(zip(('yaw', 'pitch', 'roll'), placed.angles))})
    return file.getvalue()


def camera_links(placement: Placement, prefix: str = '', omitted: Collection[str] = ()
                 ) -> Iterator[Link]:
    """
    Yield the transforms of the frames camera_<i> and camera_<i>_optical of camera i, from 0.

    :param placement: poses of the cameras.
    :param prefix: prefix of frame names.
    :param omitted: names of cameras to leave out, such as those whose calibration was refused.
    """
    for number, placed in enumerate(placement.cameras):
        if placed.camera.name not in omitted:
            body = prefix + body_frame(number)
            # Rotations about the fixed axes x, y, z, as in ROS.
            yaw, pitch, roll = np.deg2rad(placed.angles).tolist()
            yield Link(placement.frame, body, placed.position, (roll, pitch, yaw))
            # From x forward, y left, z up to z forward, x right, y down (REP-103).
            optical_rpy = (-0.5 * np.pi, 0.0, -0.5 * np.pi)
            yield Link(body, f'{body}_optical', (0.0, 0.0, 0.0), optical_rpy)


def launch_of(placement: Placement, links: Sequence[Link] = (), prefix: str = '',
              omitted: Collection[str] = ()) -> str:
    """
    Return a ROS 2 launch file that publishes the frames of :func:`camera_links`.

    :param placement: poses of the cameras.
    :param links: other transforms to publish.
    :param prefix: prefix of frame names.
    :param omitted: as in :func:`camera_links`.
    """
    # The launch file is Python, so each transform is written as a tuple of Python.
    lines = [(link.parent, link.child, *map(float, link.position),
              *(round(angle, 9) for angle in link.angles))
             for link in (*links, *camera_links(placement, prefix, omitted))]
    return fill_template('cameras.launch.py.in',
                         frames=''.join(f'    {line!r},\n' for line in lines))


def xacro_of(placement: Placement, links: Sequence[Link] = (), prefix: str = '') -> str:
    """Return a xacro macro with links and joints for the same frames as :func:`launch_of`."""
    # The caller of the macro gives the name of the root frame as its parameter.
    root = '${parent}'
    joints = ''
    for link in (*(link._replace(parent=root) for link in links),
                 *camera_links(replace(placement, frame=root), prefix)):
        xyz, rpy = (' '.join(f'{value:.12g}' for value in values)
                    for values in (link.position, link.angles))
        child, parent = link.child, quoteattr(link.parent)
        joints += JOINT_TEMPLATE % (child, child, parent, child, xyz, rpy)
    return fill_template('cameras.urdf.xacro', parent=quoteattr(placement.frame), joints=joints)


def rviz_of(placement: Placement) -> str:
    """Return an RViz configuration that shows the frames of the launch file."""
    x, y, z = np.mean([placed.position for placed in placement.cameras], axis=0).round(2)
    return fill_template('cameras.rviz', frame=json.dumps(placement.frame), x=x, y=y, z=z)


def escape_markdown(text: str) -> str:
    """Return a text, which may come from a file, as one line of Markdown without markup."""
    # Characters that begin or end markup within a line; an underscore between letters does not.
    # The colon of http://, the dot of www. and @ would make a link of the text around them.
    markup = r'[\\`*\[\]|~]|(?<![^\W_])_|_(?![^\W_])|:(?=//)|(?<=www)\.|@'
    return re.sub(markup, r'\\\g<0>', escape(printable(text), quote=False))


def installer_page(assessed: Assessment, plan: str) -> str:
    """
    Return the installer's page as Markdown: mounting instructions, and a plan with letters.

    :param assessed: the placement in its room.
    :param plan: file name of the plan's picture in the same folder.
    """
    facts = page_facts_of(assessed)
    cameras = assessed.placement.cameras
    rig = assessed.objective.rig
    floors = assessed.floors
    mounts = {'walls': 'on walls', 'ceiling': 'under the ceiling',
              'plane': 'on stands, poles or rods, all at one height',
              'free': 'on stands, poles or rods'}
    corner_position = assessed.frame.to_source(
        np.append(assessed.corner.position, floors.height)).round(2)
    # Optional sentences of the page.
    surfaces = ', '.join(
        wall.description(assessed.walls, float(floors.under(wall.position[None])[0]))
        for wall in assessed.references.inner)
    # A mount that the rig file does not give is not named.
    mount = '' if 'mount' not in rig.document.data else (
        f'**Mount.** The cameras are {mounts[rig.mount.on]}. The room is '
        f'{100.0 * (assessed.scene.bounds[1, 2] - floors.height):.0f} cm high.\n\n')
    advice = ' Unless the table gives a roll, keep the long side of the camera level, top side up.'
    table = [['', *INSTRUCTION_COLUMNS], ['---'] * (len(INSTRUCTION_COLUMNS) + 1),
             *(map(escape_markdown, row) for row in assessed.rows)]
    return fill_template(
        'installer.md', room=escape_markdown(assessed.scene.name), plan=plan, walls=facts.walls,
        doubts=''.join(f'**Check first:** {escape_markdown(doubt)}.\n\n'
                       for doubt in facts.doubts),
        inner_walls=f' Other surfaces to measure from: {surfaces}.' if surfaces else '',
        mount=mount,
        level='' if all(placed.camera.model.omnidirectional for placed in cameras) else advice,
        frame=facts.frame, corner=assessed.corner.letters,
        # Adding 0 turns -0.0 into 0.0.
        corner_at=', '.join(f'{value + 0.0:.2f}' for value in corner_position),
        table='\n'.join(f'| {" | ".join(row)} |' for row in table),
        lenses='\n'.join(f'- {escape_markdown(placed.camera.name)}: '
                         + '; '.join(filter(None, (lens_text(placed.camera.model), aim)))
                         for placed, aim in zip(cameras, assessed.aims)),
        # The first three, in the order of ``score_figures``: the depth error on the scan, the
        # expected one, and the share of seen points.
        figures='; '.join(f'{label} {value} ({remark})'
                          for label, value, remark in facts.figures[:3]),
        certificate=f' {escape_markdown(facts.certificate)}'.rstrip(),
        origin=escape_markdown(facts.origin))
