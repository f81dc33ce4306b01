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

"""Frames and simulated sensors of a placement for ROS 2, RViz and Gazebo."""

from collections.abc import Iterator
import json
from xml.sax.saxutils import quoteattr

import numpy as np
from ocp_ros.formats.drivers import started_drivers
from ocp_ros.formats.exported import Exported, image_size, Link
from ocp_ros.geometry.cameras import CameraModel, PINHOLE
from ocp_ros.report import fill_template

#: Link and joint of a frame: link, joint name, parent in quotes, child, xyz in metres, rpy in rad.
JOINT_TEMPLATE = """    <link name="%s"/>
    <joint name="%s_joint" type="fixed">
      <parent link=%s/>
      <child link="%s"/>
      <origin xyz="%s" rpy="%s"/>
    </joint>
"""
#: The least near clipping distance of a simulated camera, metres.
MIN_CLIP_M = 0.01


def camera_links(exported: Exported) -> Iterator[Link]:
    """Yield the transforms of the frames camera_<i> and camera_<i>_optical of camera i, from 0."""
    for number, placed in exported.cameras():
        body = exported.frame(number)
        # Rotations about the fixed axes x, y, z, as in ROS.
        yaw, pitch, roll = np.deg2rad(placed.angles).tolist()
        yield Link(exported.placement.frame, body, placed.position, (roll, pitch, yaw))
        # From x forward, y left, z up to z forward, x right, y down (REP-103).
        optical_rpy = (-0.5 * np.pi, 0.0, -0.5 * np.pi)
        yield Link(body, f'{body}_optical', (0.0, 0.0, 0.0), optical_rpy)


def launch_of(exported: Exported) -> str:
    """
    Return a ROS 2 launch file that publishes the frames of :func:`camera_links`.

    It also starts the drivers that cameras have, and joins their frames to these. If all cameras
    have a driver, it starts ``policy_node`` with their topics.
    """
    drivers = list(started_drivers(exported))
    # The launch file is Python, so each transform is written as a tuple of Python.
    lines = [(link.parent, link.child, *map(float, link.position),
              *(round(angle, 9) for angle in link.angles))
             for link in (*exported.links, *camera_links(exported),
                          *(driver.link for driver in drivers))]
    nodes = [tuple(driver[:5]) for driver in drivers]
    bodies = [exported.frame(number) for number, _ in exported.cameras()]
    if len(drivers) == len(bodies):
        nodes.append(('ocp_ros', 'policy_node', '', 'policy_node', {
            'cloud_topics': ','.join(driver.topic for driver in drivers),
            'camera_frames': ','.join(bodies), 'fixed_frame': exported.placement.frame}))
    return fill_template('cameras.launch.py.in',
                         frames=''.join(f'    {line!r},\n' for line in lines),
                         nodes=''.join(f'    {node!r},\n' for node in nodes))


def xacro_of(exported: Exported) -> str:
    """
    Return a xacro macro with links and joints for the same frames as :func:`launch_of`.

    With its parameter ``gazebo`` the macro also has a simulated sensor for each camera.
    """
    joints = ''
    for link in (*exported.links, *camera_links(exported)):
        # The caller of the macro gives the name of the root frame as its parameter.
        root = link.parent == exported.placement.frame
        parent = quoteattr('${parent}' if root else link.parent)
        xyz, rpy = (' '.join(f'{value:.12g}' for value in values)
                    for values in (link.position, link.angles))
        joints += JOINT_TEMPLATE % (link.child, link.child, parent, link.child, xyz, rpy)
    sensors = ''.join(
        f'      <gazebo reference="{exported.frame(number)}">\n'
        f'{sensor_xml(exported.frame(number), placed.camera.model)}      </gazebo>\n'
        for number, placed in exported.cameras())
    return fill_template('cameras.urdf.xacro', parent=quoteattr(exported.placement.frame),
                         joints=joints, sensors=sensors)


def sdf_of(exported: Exported) -> str:
    """Return a static model in SDF, with a link and a simulated sensor for each camera."""
    links = ''
    for number, placed in exported.cameras():
        yaw, pitch, roll = np.deg2rad(placed.angles).tolist()
        pose = ' '.join(f'{value:.12g}' for value in (*placed.position, roll, pitch, yaw))
        links += (f'    <link name="{exported.frame(number)}">\n      <pose>{pose}</pose>\n'
                  f'{sensor_xml(exported.frame(number), placed.camera.model)}    </link>\n')
    return (f'<?xml version="1.0"?>\n<sdf version="1.9">\n'
            f'  <model name="{exported.prefix.replace("/", "_")}ocp_cameras">\n'
            f'    <static>true</static>\n{links}  </model>\n</sdf>\n')


def sensor_xml(frame: str, model: CameraModel) -> str:
    """
    Return a simulated sensor for Gazebo: a depth camera, or a lidar without image plane.

    :param frame: name of the body frame, along whose x axis the sensor looks; also the topic.
    """
    near, far = max(model.min_range, MIN_CLIP_M), model.max_range
    head = (f'        <update_rate>30</update_rate>\n        <topic>{frame}</topic>\n'
            f'        <gz_frame_id>{frame}</gz_frame_id>\n')
    lens = model.lens
    if lens.kind == PINHOLE:
        width, height = image_size(model)
        focal = 0.5 * width / lens.half_horizontal, 0.5 * height / lens.half_vertical
        return (
            f'      <sensor name="{frame}" type="rgbd_camera">\n{head}        <camera>\n'
            f'          <optical_frame_id>{frame}_optical</optical_frame_id>\n'
            f'          <horizontal_fov>{model.horizontal_fov:.12g}</horizontal_fov>\n'
            f'          <image><width>{width}</width><height>{height}</height></image>\n'
            # Without focal lengths, Gazebo assumes square pixels.
            f'          <lens><intrinsics><fx>{focal[0]:.9g}</fx><fy>{focal[1]:.9g}</fy>'
            f'<cx>{0.5 * width:g}</cx><cy>{0.5 * height:g}</cy><s>0</s></intrinsics></lens>\n'
            f'          <clip><near>{near:g}</near><far>{far:g}</far></clip>\n'
            '        </camera>\n      </sensor>\n')
    # Without a resolution, a lidar has a ray for each degree.
    samples = model.resolution or [round(np.rad2deg(fov)) for fov in (
        model.horizontal_fov, model.vertical_fov)]
    scans = ''.join(
        f'<{axis}><samples>{count}</samples><min_angle>{-0.5 * fov:.9g}</min_angle>'
        f'<max_angle>{0.5 * fov:.9g}</max_angle></{axis}>' for axis, count, fov in (
            ('horizontal', samples[0], model.horizontal_fov),
            ('vertical', samples[1], model.vertical_fov)))
    return (f'      <sensor name="{frame}" type="gpu_lidar">\n{head}'
            f'        <lidar><scan>{scans}</scan>'
            f'<range><min>{near:g}</min><max>{far:g}</max></range></lidar>\n'
            '      </sensor>\n')


def rviz_of(exported: Exported) -> str:
    """Return an RViz configuration that shows the frames of the launch file."""
    x, y, z = np.mean([placed.position for _, placed in exported.cameras()], axis=0).round(2)
    return fill_template('cameras.rviz', frame=json.dumps(exported.placement.frame), x=x, y=y, z=z)
