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

"""Frames, drivers and simulated sensors of a placement for ROS 2, RViz and Gazebo."""

from collections.abc import Iterator
import json
import re
from typing import Any, NamedTuple
import warnings
from xml.sax.saxutils import quoteattr

import numpy as np
from ocp_ros.formats.exported import Exported, image_size, Link, link_between
from ocp_ros.geometry.cameras import CameraModel, PINHOLE, rotation_matrix, TO_BODY
from ocp_ros.report import fill_template
from ocp_ros.rig.rig_file import Camera

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


class Driver(NamedTuple):
    """
    A driver; ``{name}`` in its texts is the name of the camera in ROS.

    :ivar package: its package.
    :ivar executable: its program.
    :ivar serial: the parameter for the serial number, with ``{serial}`` in its value.
    :ivar parameters: all other parameters.
    :ivar below_node: whether its topics are below the name of the node; otherwise they are in the
        namespace of the node.
    :ivar topic: the topic of clouds or depth images.
    :ivar root: the frame that the driver does not give a parent, so that a launch file has to.
    :ivar root_in_optical: (4, 4) from ``root`` to the optical frame of the depth image.
    """

    package: str
    executable: str
    serial: tuple[str, str]
    parameters: dict[str, Any]
    below_node: bool
    topic: str
    root: str
    root_in_optical: np.ndarray


#: From x forward, y left, z up to z forward, x right, y down: (4, 4).
OPTICAL_FROM_BODY = np.eye(4)
OPTICAL_FROM_BODY[:3, :3] = TO_BODY['optical'].T


def _optical_from_kinect_base(tilt_degrees: float) -> np.ndarray:
    """
    Return the transform (4, 4) from ``camera_base`` of an Azure Kinect to its depth image.

    The driver publishes its inverse: the depth camera is 1.8 mm above the base, and looks down by
    an angle. Source: Azure_Kinect_ROS_Driver, k4a_calibration_transform_data.cpp.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = TO_BODY['optical'] @ rotation_matrix(roll=-np.deg2rad(tilt_degrees))
    matrix[:3, 3] = 0.0, 0.0, 0.0018
    return np.linalg.inv(matrix)


#: The drivers by their names in rig files.
DRIVERS = {
    'realsense2_camera': Driver(
        # The driver removes the underscore, which keeps the number a text.
        'realsense2_camera', 'realsense2_camera_node', ('serial_no', '_{serial}'),
        {'camera_name': '{name}', 'pointcloud.enable': True}, True, 'depth/color/points',
        '{name}_link', OPTICAL_FROM_BODY),
    'orbbec_camera': Driver(
        'orbbec_camera', 'orbbec_camera_node', ('serial_number', '{serial}'),
        {'camera_name': '{name}', 'enable_point_cloud': True}, False, 'depth/points',
        '{name}_link', OPTICAL_FROM_BODY),
    'depthai_ros_driver': Driver(
        'depthai_ros_driver', 'camera_node', ('camera.i_mx_id', '{serial}'),
        {'camera.i_pipeline_type': 'RGBD', 'camera.i_nn_type': 'none',
         'camera.i_publish_tf_from_calibration': False, 'stereo.i_align_depth': True}, True,
        'stereo/image_raw', '{name}_rgb_camera_optical_frame', np.eye(4)),
    'azure_kinect': Driver(
        'azure_kinect_ros_driver', 'node', ('sensor_sn', '{serial}'),
        {'tf_prefix': '{name}_', 'depth_mode': 'NFOV_UNBINNED', 'color_enabled': False,
         'point_cloud': True, 'rgb_point_cloud': False, 'point_cloud_in_depth_frame': True},
        False, 'points2', '{name}_camera_base', _optical_from_kinect_base(6.0))}


class StartedDriver(NamedTuple):
    """
    A driver of one camera, as a launch file starts it.

    :ivar package: its package.
    :ivar executable: its program.
    :ivar namespace: of the node.
    :ivar name: of the node.
    :ivar parameters: of the node.
    :ivar topic: of the clouds or depth images, with a slash at the beginning.
    :ivar link: the transform that joins the frames of the driver to those of the camera.
    """

    package: str
    executable: str
    namespace: str
    name: str
    parameters: dict[str, Any]
    topic: str
    link: Link


def started_drivers(exported: Exported) -> Iterator[StartedDriver]:
    """Yield the drivers of the cameras for which the rig or the placement names one."""
    cameras = [(number, placed.camera) for number, placed in exported.cameras()
               if placed.camera.device.driver]
    packages = [camera.device.driver for _, camera in cameras]
    for number, camera in cameras:
        if not camera.device.serial and packages.count(camera.device.driver) > 1:
            warnings.warn(f'{camera.name}: found no serial number and several cameras of its '
                          'driver, which takes any of them; expected one; add serial to the rig '
                          'or the placement', stacklevel=2)
        yield _started(exported, number, camera)


def _started(exported: Exported, number: int, camera: Camera) -> StartedDriver:
    """Return the driver of a camera, by its number from 0."""
    driver, device = DRIVERS[camera.device.driver], camera.device
    name = re.sub(r'\W', '_', f'{exported.prefix}{camera.name}')
    # Names in ROS begin with a letter; different names stay different.
    others = [re.sub(r'\W', '_', placed.camera.name) for _, placed in exported.cameras()]
    if not name[0].isalpha() or others.count(re.sub(r'\W', '_', camera.name)) > 1:
        name = f'camera_{number}_{name}'
    parameters = {key: value.format(name=name) if isinstance(value, str) else value
                  for key, value in driver.parameters.items()}
    optical = driver.root_in_optical
    if camera.sensor.endswith('wfov') and device.driver == 'azure_kinect':
        parameters['depth_mode'], optical = 'WFOV_2X2BINNED', _optical_from_kinect_base(7.3)
    if device.driver == 'orbbec_camera':
        # The resolution of a Femto selects its field of view. Source: OrbbecSDK_ROS2, README.
        if camera.sensor.startswith('femto'):
            for image in ('depth', 'ir'):
                size = image_size(camera.model)
                parameters |= {f'{image}_width': size[0], f'{image}_height': size[1]}
        # With one device, version 1 takes any. Source: ob_camera_node_driver.cpp, selectDevice.
        if device.serial:
            parameters['device_num'] = max(2, sum(
                placed.camera.device.driver == device.driver for _, placed in exported.cameras()))
    if device.serial:
        parameters[driver.serial[0]] = driver.serial[1].format(serial=device.serial)
    folder = '/' + '/'.join(filter(None, (device.namespace, name)))
    link = link_between(f'{exported.frame(number)}_optical', driver.root.format(name=name),
                        optical[:3, :3], optical[:3, 3])
    # All topics are NAMESPACE/NAME/TOPIC.
    namespace = folder.rpartition('/')[0] if driver.below_node else folder
    return StartedDriver(driver.package, driver.executable, namespace, name, parameters,
                         f'{folder}/{driver.topic}', link)
