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

from collections.abc import Collection, Iterator, Sequence
import csv
from dataclasses import replace
import io
from itertools import chain
import json
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from ocp_ros.geometry.cameras import heading_of, rotation_matrix
from ocp_ros.report.assessment import Assessment
from ocp_ros.report.installer import instructions
from ocp_ros.report.templates import fill_template
from ocp_ros.rig.placement_file import FRAME, numbers_of, Placement, save_placement
from ocp_ros.scenes.source_frame import SourceFrame
from ocp_ros.util.files import FileSet, write_atomically

#: Placement files, which can be read again.
PLACEMENTS = ('placement.yaml', 'placement.json')
#: The file that is always written.
MARK = 'placement.json'
#: All files of a placement; ``curve.png`` is the one that counting cameras adds.
WRITTEN = (*PLACEMENTS, 'cameras.csv', 'cameras.launch.py', 'cameras.urdf.xacro', 'cameras.rviz',
           'installer.md', 'plan.png', 'report.png', 'report_2.png', 'report.html', 'curve.png')
#: Rotation from a camera's body frame (x forward, y left, z up) to its optical frame (z forward,
#: x right, y down): roll, pitch, yaw in radians, REP-103.
OPTICAL = (-0.5 * np.pi, 0.0, -0.5 * np.pi)
#: Name of the frame of the room's scan, in metres.
SCAN = 'scan'
#: Columns of ``cameras.csv``: metres and degrees.
CSV_COLUMNS = ('number', 'name', 'sensor', 'frame', 'link', 'x', 'y', 'z', 'yaw', 'pitch', 'roll',
               'mount', 'horizontal_fov', 'vertical_fov', 'min_range', 'max_range')
JOINT = """    <link name="%s"/>
    <joint name="%s_joint" type="fixed">
      <parent link=%s/>
      <child link="%s"/>
      <origin xyz="%s" rpy="%s"/>
    </joint>
"""


def written_to(files: FileSet, assessed: Assessment, prefix: str = '', brief: bool = False
               ) -> dict[str, Any]:
    """
    Write a placement in all file formats, and its reports.

    :param files: the files to write.
    :param prefix: of the names of frames, so that the frames of two rigs have different names.
    :param brief: whether to leave out the reports, which take seconds to draw.
    :returns: ``written``; also ``error`` if some files could not be written.
    """
    paths: list[str] = []
    try:
        for path in chain(export(files.aside, assessed, prefix),
                          () if brief else reports(files.aside, assessed)):
            paths.append(str(files.folder / path.name))
    except OSError as error:
        return {'written': paths, 'error': (
            f'--out: found {files.folder}, where not all could be written '
            f'({error.strerror or error}); expected room for it; use what is printed, or make '
            'room and do it again')}
    return {'written': paths}


def export(folder: Path, assessed: Assessment, prefix: str = '') -> Iterator[Path]:
    """
    Write a placement as files for programs and installers, and yield the path of each.

    Placement files are in the map frame, in which scores are computed, and contain the transform
    to the frame of the scan. The frame of the other files is
    :attr:`~ocp_ros.report.assessment.Assessment.data_frame`.

    :param folder: it is created if it does not exist.
    :param prefix: of the names of frames.
    :raises OSError: if a file cannot be written.
    """
    placement = assessed.placement
    source = assessed.scene.source
    for name in PLACEMENTS:
        save_placement(folder / name, placement)
        yield folder / name
    shown = placement
    link = link_between(FRAME, SCAN, source.rotation, -source.shift)
    if not assessed.data_frame.is_map:
        shown = placement_in(placement, source)
        link = link_between(SCAN, FRAME, source.rotation.T, source.rotation.T @ source.shift)
    links = [] if source.is_map else [link]
    texts = {'cameras.csv': table_of(shown, assessed.data_frame.scale, prefix),
             'cameras.launch.py': launch_of(shown, links, prefix),
             'cameras.urdf.xacro': xacro_of(shown, links, prefix),
             'cameras.rviz': rviz_of(shown),
             'installer.md': instructions(assessed, 'plan.png')}
    for name, text in texts.items():
        write_atomically(folder / name, text)
        yield folder / name
    # The import of the drawing modules is slow, so other commands do not import them.
    from ocp_ros.report.drawing.assessment_pictures import draw_floor_plan
    draw_floor_plan(folder / 'plan.png', assessed)
    yield folder / 'plan.png'


def reports(folder: Path, assessed: Assessment) -> Iterator[Path]:
    """Write the PNG sheet, the HTML page and the curve of counted cameras; yield their paths."""
    from ocp_ros.report.drawing import assessment_pictures, report_page
    from ocp_ros.report.viewer import write_view
    yield from report_page.draw(folder, assessed)
    write_view(folder / 'report.html', assessed.scene, assessed)
    yield folder / 'report.html'
    if 'curve' in assessed.found:
        assessment_pictures.draw_curve(folder / 'curve.png', assessed.found)
        yield folder / 'curve.png'


class Link(NamedTuple):
    """
    A transform between frames of a placement.

    :ivar parent: parent frame.
    :ivar child: child frame.
    :ivar position: of the child in the parent, metres.
    :ivar angles: of the child in the parent: roll, pitch, yaw in radians.
    """

    parent: str
    child: str
    position: tuple[float, float, float]
    angles: tuple[float, float, float]


def link_between(parent: str, child: str, rotation: np.ndarray, position: np.ndarray) -> Link:
    """Return the transform of a frame from its rotation (3, 3) and its position in metres."""
    yaw, pitch, roll = heading_of(rotation).tolist()
    return Link(parent, child, tuple(position.tolist()), (roll, pitch, yaw))


def placement_in(placement: Placement, source: SourceFrame) -> Placement:
    """Return a placement in the axes of a scan, in metres."""
    cameras = []
    for placed in placement.cameras:
        angles = heading_of(source.rotation.T @ rotation_matrix(*np.deg2rad(placed.angles)))
        cameras.append(placed._replace(
            position=tuple((source.scale * source.to_source(placed.position)).tolist()),
            angles=tuple(np.round(np.rad2deg(angles), 6).tolist())))
    return replace(placement, cameras=tuple(cameras), frame=SCAN)


def link_of(number: int) -> str:
    """Return the name of a camera's body frame, as in the nodes: the first camera is number 0."""
    return f'camera_{number}'


def table_of(placement: Placement, scale: float = 1.0, prefix: str = '') -> str:
    """
    Return the cameras as CSV: degrees, one row each.

    :param scale: metres per unit of the positions.
    :param prefix: of the names of frames.
    """
    file = io.StringIO()
    rows = csv.DictWriter(file, CSV_COLUMNS, extrasaction='ignore', lineterminator='\n')
    rows.writeheader()
    for number, placed in enumerate(placement.cameras, start=1):
        rows.writerow({
            'number': number, 'name': placed.camera.name, 'frame': placement.frame,
            'link': prefix + link_of(number - 1), 'mount': placed.mount,
            **numbers_of(placed.camera),
            **dict(zip('xyz', (value / scale for value in placed.position))),
            **dict(zip(('yaw', 'pitch', 'roll'), placed.angles))})
    return file.getvalue()


def links_of(placement: Placement, prefix: str = '', without: Collection[str] = ()
             ) -> Iterator[Link]:
    """
    Yield the transforms of camera_<i> and camera_<i>_optical, i from 0.

    :param prefix: of the names of frames.
    :param without: names of cameras to leave out.
    """
    for number, placed in enumerate(placement.cameras):
        if placed.camera.name not in without:
            body = prefix + link_of(number)
            # Rotations about the fixed axes x, y, z, as in ROS.
            yaw, pitch, roll = np.deg2rad(placed.angles).tolist()
            yield Link(placement.frame, body, placed.position, (roll, pitch, yaw))
            yield Link(body, f'{body}_optical', (0.0, 0.0, 0.0), OPTICAL)


def launch_of(placement: Placement, links: Sequence[Link] = (), prefix: str = '',
              without: Collection[str] = ()) -> str:
    """
    Return a ROS 2 launch file that publishes the frames of :func:`links_of`.

    :param links: other transforms to publish.
    :param prefix: of the names of frames.
    :param without: names of cameras to leave out.
    """
    lines = [(link.parent, link.child, *map(float, link.position),
              *(round(angle, 9) for angle in link.angles))
             for link in (*links, *links_of(placement, prefix, without))]
    return fill_template('cameras.launch.py.in',
                         frames=''.join(f'    {line!r},\n' for line in lines))


def xacro_of(placement: Placement, links: Sequence[Link] = (), prefix: str = '') -> str:
    """Return a xacro macro with links and joints for the same frames as :func:`launch_of`."""
    root, joints = '${parent}', ''
    for link in (*(link._replace(parent=root) for link in links),
                 *links_of(replace(placement, frame=root), prefix)):
        xyz, rpy = (' '.join(f'{value:.12g}' for value in values)
                    for values in (link.position, link.angles))
        joints += JOINT % (link.child, link.child, quoteattr(link.parent), link.child, xyz, rpy)
    return fill_template('cameras.urdf.xacro', parent=quoteattr(placement.frame), joints=joints)


def rviz_of(placement: Placement) -> str:
    """Return an RViz configuration that shows the frames of the launch file."""
    x, y, z = np.mean([placed.position for placed in placement.cameras], axis=0).round(2)
    return fill_template('cameras.rviz', frame=json.dumps(placement.frame), x=x, y=y, z=z)
