# SPDX-License-Identifier: Apache-2.0
"""A placement for those who carry it out: files for people, spreadsheets and ROS 2."""

from collections.abc import Iterator
import csv
import io
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

from ocp_ros.report.drawing.floor_plan import draw_plan
from ocp_ros.report.installer import instructions
from ocp_ros.rig.placement_file import numbers_of, Placed, Placement, save_placement
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.files import write_atomically

#: Files of a placement that are read again, and all that :func:`export` writes.
PLACEMENTS = ('placement.yaml', 'placement.json')
FORMS = (*PLACEMENTS, 'cameras.csv', 'cameras.launch.py', 'cameras.urdf.xacro', 'cameras.rviz',
         'installer.md', 'plan.png')
#: From a camera's body (x forward, y left, z up) to its picture (z forward, x right, y down):
#: roll, pitch, yaw in radians, REP-103.
OPTICAL = (-0.5 * np.pi, 0.0, -0.5 * np.pi)
COLUMNS = ('number', 'name', 'sensor', 'frame', 'link', 'x', 'y', 'z', 'yaw', 'pitch', 'roll',
           'mount', 'horizontal_fov', 'vertical_fov', 'min_range', 'max_range')
LAUNCH = '''"""Where the cameras hang, as static transforms: ros2 launch ./cameras.launch.py."""

from launch import LaunchDescription
from launch_ros.actions import Node

# Parent, child, x, y, z in metres, roll, pitch, yaw in radians.
FRAMES = [
%s]
OPTIONS = ('--frame-id', '--child-frame-id', '--x', '--y', '--z', '--roll', '--pitch', '--yaw')


def generate_launch_description():
    """Publish all frames."""
    return LaunchDescription([
        Node(package='tf2_ros', executable='static_transform_publisher', name=f'{frame[1]}_frame',
             arguments=[word for pair in zip(OPTIONS, map(str, frame)) for word in pair])
        for frame in FRAMES])
'''
XACRO = """<?xml version="1.0"?>
<!-- Include this file in a robot and write <xacro:ocp_cameras parent=%s/> -->
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="ocp_cameras" params="parent">
%s  </xacro:macro>
</robot>
"""
JOINT = """    <link name="%s"/>
    <joint name="%s_joint" type="fixed">
      <parent link=%s/>
      <child link="%s"/>
      <origin xyz="%s" rpy="%s"/>
    </joint>
"""


def export(folder: Path, scene: Scene, placement: Placement) -> Iterator[Path]:
    """
    Write a placement in all forms, the files of :data:`FORMS`, and yield each that is written.

    :param folder: it is made where it is not there.
    :raises OSError: if one cannot be written.
    """
    for name in PLACEMENTS:
        save_placement(folder / name, placement)
        yield folder / name
    texts = {'cameras.csv': table_of(placement), 'cameras.launch.py': launch_of(placement),
             'cameras.urdf.xacro': xacro_of(placement), 'cameras.rviz': rviz_of(placement),
             'installer.md': instructions(scene, placement, 'plan.png')}
    for name, text in texts.items():
        write_atomically(folder / name, text)
        yield folder / name
    draw_plan(folder / 'plan.png', scene, placement)
    yield folder / 'plan.png'


def link_of(number: int) -> str:
    """Name the frame of a camera's body, as the nodes do: the first camera is number 0."""
    return f'camera_{number}'


def table_of(placement: Placement) -> str:
    """Return the cameras as CSV: metres, degrees, one row each."""
    file = io.StringIO()
    rows = csv.DictWriter(file, COLUMNS, extrasaction='ignore', lineterminator='\n')
    rows.writeheader()
    for number, placed in enumerate(placement.cameras, start=1):
        rows.writerow({
            'number': number, 'name': placed.camera.name, 'frame': placement.frame,
            'link': link_of(number - 1), 'mount': placed.mount, **numbers_of(placed.camera),
            **dict(zip('xyz', placed.position)),
            **dict(zip(('yaw', 'pitch', 'roll'), placed.angles))})
    return file.getvalue()


def _angles(placed: Placed) -> tuple[float, float, float]:
    """Return roll, pitch, yaw in radians: turns about the fixed axes x, y, z, as ROS has them."""
    yaw, pitch, roll = np.deg2rad(placed.angles)
    return float(roll), float(pitch), float(yaw)


def launch_of(placement: Placement) -> str:
    """Return a ROS 2 launch file that publishes camera_<i> and camera_<i>_optical, i from 0."""
    lines = []
    for number, placed in enumerate(placement.cameras):
        body = link_of(number)
        position, angles = map(float, placed.position), _angles(placed)
        lines += [(placement.frame, body, *position, *(round(angle, 9) for angle in angles)),
                  (body, f'{body}_optical', 0.0, 0.0, 0.0,
                   *(round(angle, 9) for angle in OPTICAL))]
    return LAUNCH % ''.join(f'    {line!r},\n' for line in lines)


def xacro_of(placement: Placement) -> str:
    """Return a xacro macro with links and joints for the same frames as :func:`launch_of`."""
    joints = []
    for number, placed in enumerate(placement.cameras):
        body = link_of(number)
        for parent, child, position, angles in (
                ('${parent}', body, placed.position, _angles(placed)),
                (body, f'{body}_optical', (0.0, 0.0, 0.0), OPTICAL)):
            xyz, rpy = (' '.join(f'{value:.9g}' for value in values)
                        for values in (position, angles))
            joints.append(JOINT % (child, child, quoteattr(parent), child, xyz, rpy))
    return XACRO % (quoteattr(placement.frame), ''.join(joints))


def rviz_of(placement: Placement) -> str:
    """Return an RViz configuration that shows the frames of the launch file."""
    position = np.mean([placed.position for placed in placement.cameras], axis=0).round(2)
    kind = 'rviz_default_plugins'
    return yaml.safe_dump({
        'Panels': [{'Class': 'rviz_common/Displays', 'Name': 'Displays'}],
        'Visualization Manager': {
            'Class': '',
            'Displays': [
                {'Class': f'{kind}/Grid', 'Name': 'Grid', 'Enabled': True, 'Cell Size': 1},
                {'Class': f'{kind}/TF', 'Name': 'TF', 'Enabled': True, 'Show Names': True,
                 'Show Axes': True, 'Show Arrows': False, 'Marker Scale': 1}],
            'Global Options': {'Fixed Frame': placement.frame, 'Frame Rate': 30},
            'Tools': [{'Class': f'{kind}/MoveCamera'}, {'Class': f'{kind}/Measure'}],
            'Views': {'Current': {'Class': f'{kind}/Orbit', 'Distance': 12, 'Pitch': 0.8,
                                  'Yaw': 4.0, 'Focal Point': dict(
                                      zip('XYZ', position.tolist()))}}}}, sort_keys=False)
