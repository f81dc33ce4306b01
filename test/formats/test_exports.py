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

"""What is exported, as programs of others read it."""

from dataclasses import replace
import io
import json
from types import SimpleNamespace
import xml.etree.ElementTree as ElementTree

from conftest import box_room, refused_in_one_sentence
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.formats.building_models import ifc_of
from ocp_ros.formats.exported import Exported, pose_matrix
from ocp_ros.formats.floor_plans import dxf_of
from ocp_ros.formats.photogrammetry import colmap_of, metropolis_of, nerfstudio_of
from ocp_ros.formats.ros_files import sdf_of, xacro_of
from ocp_ros.formats.scene_models import field_of_view_body, gltf_of, usd_of
from ocp_ros.geometry.cameras import PINHOLE
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import assess
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.scene_source import room_named
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.source_frame import map_from_file, SourceFrame
import pytest

POSES = np.array([[2.0, 2.0, 2.2, 0.3, 0.4, 0.1], [1.0, 3.0, 1.7, 3.5, -0.5, 0.0]])
#: From the axes of OpenGL to those of the picture: x right, y down, z ahead.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture
def exported():
    """Return two cameras whose pixels are not square."""
    return Exported(placement_of(rig_of(2, 'azure_kinect_nfov'), POSES))


@pytest.fixture(scope='module')
def in_a_room():
    """Return two cameras on the walls of a room of 6 x 4 m, 2.8 m high, whose floor is at 1 m."""
    scene = box_room()
    room = Scene(scene.points + np.array([0.0, 0.0, 1.0], dtype='f4'), 'hall')
    rig = rig_of(2, 'd455', mount={'on': 'walls'}, keep_out=[{'box': [[0, 0, 0], [1, 1, 3]]}])
    poses = np.array([[0.1, 2.0, 3.0, 0.2, 0.4, 0.0], [3.0, 3.9, 3.2, -1.5, 0.5, 0.0]])
    engine = EngineConfig(preset='fast', error_rows=32)
    assessed = assess(room, placement_of(rig, poses, engine=engine), {'sha256': ''}, 'ocp score')
    return Exported(assessed.placement, assessed=assessed)


def check_pose(world_from_optical, placed):
    """Assert that a camera that looks along z, with x right, is where it was placed."""
    np.testing.assert_allclose(world_from_optical, pose_matrix(placed, 'optical'), atol=1e-5)


def check_pinhole(size, focal, centre, model):
    """Assert that an image has the field of view of a camera."""
    assert tuple(size) == model.resolution
    fov = 2.0 * np.arctan(np.array(size) / (2.0 * np.array(focal)))
    assert fov == pytest.approx([model.horizontal_fov, model.vertical_fov])
    assert list(centre) == [0.5 * size[0], 0.5 * size[1]]


def test_nerfstudio_has_the_cameras_in_the_axes_of_opengl(exported):
    content = json.loads(nerfstudio_of(exported))
    for frame, placed in zip(content['frames'], exported.placement.cameras, strict=True):
        check_pose(np.array(frame['transform_matrix']) @ FLIP, placed)
        check_pinhole((frame['w'], frame['h']), (frame['fl_x'], frame['fl_y']),
                      (frame['cx'], frame['cy']), placed.camera.model)


def test_colmap_reads_the_cameras(exported, tmp_path):
    pycolmap = pytest.importorskip('pycolmap', reason='pycolmap reads COLMAP files')
    for name, text in zip(('cameras', 'images', 'points3D'), colmap_of(exported), strict=True):
        (tmp_path / f'{name}.txt').write_text(text)
    read = pycolmap.Reconstruction(tmp_path)
    assert len(read.images) == 2
    for number, placed in enumerate(exported.placement.cameras, start=1):
        image = read.images[number]
        from_world = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        check_pose(np.linalg.inv(from_world), placed)
        camera = read.cameras[image.camera_id]
        check_pinhole((camera.width, camera.height), camera.params[:2], camera.params[2:],
                      placed.camera.model)
        # A point in the middle of the picture is straight ahead.
        ahead = pose_matrix(placed)[:3] @ [2.0, 0.0, 0.0, 1.0]
        assert image.project_point(ahead) == pytest.approx(camera.params[2:])


def test_metropolis_maps_the_floor_to_pixels(exported):
    content = json.loads(metropolis_of(exported))
    assert content['calibrationType'] == 'cartesian'
    for sensor, placed in zip(content['sensors'], exported.placement.cameras, strict=True):
        intrinsic, extrinsic, matrix, homography = (
            np.array(sensor[f'{name}Matrix']) if name else np.array(sensor['homography'])
            for name in ('intrinsic', 'extrinsic', 'camera', ''))
        check_pose(np.linalg.inv(np.vstack([extrinsic, [0.0, 0.0, 0.0, 1.0]])), placed)
        np.testing.assert_allclose(intrinsic @ extrinsic, matrix)
        np.testing.assert_allclose(homography, matrix[:, [0, 1, 3]])
        for pixel, place in zip(sensor['imageCoordinates'], sensor['globalCoordinates']):
            seen = homography @ [place['x'], place['y'], 1.0]
            assert seen[:2] / seen[2] == pytest.approx([pixel['x'], pixel['y']])
    # The second camera looks up: it sees no floor.
    assert [bool(sensor['globalCoordinates']) for sensor in content['sensors']] == [True, False]


def test_a_usd_stage_has_the_cameras(exported, tmp_path):
    pxr = pytest.importorskip('pxr', reason='usd-core reads USD stages')
    from pxr import Gf, Usd, UsdGeom
    assert pxr
    (tmp_path / 'cameras.usda').write_text(usd_of(exported))
    stage = Usd.Stage.Open(str(tmp_path / 'cameras.usda'))
    assert UsdGeom.GetStageUpAxis(stage) == 'Z' and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    for number, placed in enumerate(exported.placement.cameras):
        camera = UsdGeom.Camera(stage.GetPrimAtPath(f'/Cameras/camera_{number}')).GetCamera(0.0)
        check_pose(np.array(camera.transform).T @ FLIP, placed)
        model = placed.camera.model
        fov = [camera.GetFieldOfView(axis)
               for axis in (Gf.Camera.FOVHorizontal, Gf.Camera.FOVVertical)]
        assert np.deg2rad(fov) == pytest.approx([model.horizontal_fov, model.vertical_fov])
        span = camera.clippingRange
        assert (span.min, span.max) == pytest.approx((model.min_range, model.max_range))


def check_body(body, model):
    """Assert that a body is closed and has the volume of the rays of a camera up to its range."""
    assert body.is_watertight
    # The solid angle of a rectangle on an image plane, or between azimuths and elevations.
    a, b = model.lens.half_horizontal, model.lens.half_vertical
    angle = 4.0 * np.arcsin(a * b / np.sqrt((1.0 + a * a) * (1.0 + b * b))) if (
        model.lens.kind == PINHOLE) else 4.0 * a * np.sin(b)
    assert body.volume == pytest.approx(angle / 3.0 * model.max_range ** 3, rel=0.04)


def test_gltf_has_the_cameras_and_what_they_see(exported, tmp_path):
    trimesh = pytest.importorskip('trimesh', reason='trimesh reads glTF')
    path = tmp_path / 'cameras.gltf'
    path.write_text(gltf_of(exported))
    content, scene = json.loads(path.read_text()), trimesh.load_scene(path)
    z_up = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0],
                     [0.0, 0.0, 0.0, 1.0]])
    for number, placed in enumerate(exported.placement.cameras):
        model = placed.camera.model
        matrix, name = scene.graph[f'camera_{number}_field_of_view']
        check_pose(z_up @ matrix @ FLIP, placed)
        body = scene.geometry[name]
        check_body(body, model)
        lens = content['cameras'][number]['perspective']
        assert lens['yfov'] == pytest.approx(model.vertical_fov)
        across = 2.0 * np.arctan(lens['aspectRatio'] * np.tan(0.5 * lens['yfov']))
        assert across == pytest.approx(model.horizontal_fov)


@pytest.mark.parametrize('sensor', ['realsense_d455', 'velodyne_vlp16', 'omnidirectional'])
def test_the_body_of_a_field_of_view_is_closed_and_has_its_volume(sensor):
    trimesh = pytest.importorskip('trimesh', reason='trimesh measures bodies')
    model = rig_of(1, sensor).cameras[0].model
    check_body(trimesh.Trimesh(*field_of_view_body(model)), model)


def test_gazebo_simulates_the_sensors(exported):
    macro, = ElementTree.fromstring(xacro_of(exported))
    sdf = ElementTree.fromstring(sdf_of(exported))
    for root in (macro, sdf):
        sensors = list(root.iter('sensor'))
        for sensor, placed in zip(sensors, exported.placement.cameras, strict=True):
            model = placed.camera.model
            assert sensor.get('type') == 'rgbd_camera'
            values = {name: float(sensor.find(f'camera/{name}').text) for name in (
                'horizontal_fov', 'clip/near', 'clip/far', 'lens/intrinsics/fy', 'image/height',
                'image/width')}
            assert values['horizontal_fov'] == pytest.approx(model.horizontal_fov)
            assert values['clip/far'] == model.max_range
            assert 2.0 * np.arctan(values['image/height'] / (
                2.0 * values['lens/intrinsics/fy'])) == pytest.approx(model.vertical_fov)
    for link, placed in zip(sdf.iter('link'), exported.placement.cameras, strict=True):
        *position, roll, pitch, yaw = map(float, link.find('pose').text.split())
        assert position == pytest.approx(placed.position)
        assert np.rad2deg([yaw, pitch, roll]) == pytest.approx(placed.angles)
    lidar, = ElementTree.fromstring(sdf_of(Exported(placement_of(
        rig_of(1, 'vlp16'), POSES[:1])))).iter('sensor')
    assert lidar.get('type') == 'gpu_lidar'
    assert lidar.find('lidar/scan/vertical/samples').text == '16'


def test_cameras_without_an_image_plane_are_left_out_or_refused():
    rig = rig_of(1, 'd455', fixed=[{'sensor': 'velodyne_vlp16', 'position': [1.0, 1.0, 1.0]}])
    with pytest.warns(UserWarning, match='COLMAP: found velodyne_vlp16'):
        cameras, *_ = colmap_of(Exported(placement_of(rig, POSES[:1])))
    assert cameras.count('PINHOLE') == 1
    with refused_in_one_sentence('nerfstudio: found omnidirectional_1, omnidirectional_2'):
        nerfstudio_of(Exported(placement_of(rig_of(2), POSES)))


def test_a_placement_is_exported_without_its_room(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'placement.yaml').write_text(
        'cameras:\n  - {sensor: realsense_d455, position: [2.0, 2.0, 1.9], yaw: 45, name: door}\n')
    command = ['export', 'placement.yaml', '--to', 'colmap,usd', '--frame-prefix', 'a_']
    assert main(command) == 0 and 'cameras.usda' in capsys.readouterr().out
    assert {path.name for path in (tmp_path / 'out' / 'export').iterdir()} == {
        'placement.yaml', 'placement.json', 'cameras.txt', 'images.txt', 'points3D.txt',
        'cameras.usda'}
    assert 'a_camera_0' in (tmp_path / 'out' / 'export' / 'cameras.usda').read_text()
    for option, words in (('colmpa', "did you mean 'colmap'"), ('installer', 'name it by --room')):
        assert main(['export', 'placement.yaml', '--to', option]) == 2
        assert words in capsys.readouterr().err


def test_a_drawing_has_walls_cameras_fields_of_view_and_sizes(in_a_room):
    ezdxf = pytest.importorskip('ezdxf', reason='ezdxf reads DXF files')
    drawing = ezdxf.read(io.StringIO(dxf_of(in_a_room)))
    assert drawing.units == ezdxf.units.M and not drawing.audit().errors
    space = drawing.modelspace()
    cameras = list(space.query('INSERT[layer=="CAMERAS"]'))
    outlines = list(space.query('LWPOLYLINE[layer=="FIELD_OF_VIEW"]'))
    for camera, outline, placed in zip(cameras, outlines, in_a_room.placement.cameras,
                                       strict=True):
        assert tuple(camera.dxf.insert) == pytest.approx(placed.position)
        assert camera.dxf.rotation == pytest.approx(placed.angles[0])
        told = {attribute.dxf.tag: attribute.dxf.text for attribute in camera.attribs}
        assert told['NAME'] == placed.camera.name and float(told['PITCH']) == placed.angles[1]
        # What is seen lies ahead: within the field of view, seen from above, about the heading.
        offsets = np.array([point[:2] for point in outline]) - placed.position[:2]
        offsets = offsets[np.linalg.norm(offsets, axis=1) > 0.01]
        turned = np.arctan2(offsets[:, 1], offsets[:, 0]) - np.deg2rad(placed.angles[0])
        turned = np.abs((turned + np.pi) % (2.0 * np.pi) - np.pi)
        assert 0.5 * placed.camera.model.horizontal_fov <= turned.max() + 0.01 < 0.5 * np.pi
        assert np.linalg.norm(offsets, axis=1).max() <= placed.camera.model.max_range
    lengths = sorted((line.dxf.end - line.dxf.start).magnitude
                     for line in space.query('LINE[layer=="WALLS"]'))
    assert lengths == pytest.approx([4.0, 4.0, 6.0, 6.0], abs=0.12)
    # The sides of the room, and the distances of each camera from two walls.
    sizes = sorted(one.get_measurement() for one in space.query('DIMENSION[layer=="DIMENSIONS"]'))
    assert sizes == pytest.approx([0.1, 0.1, 2.0, 3.0, 4.0, 4.0, 6.0, 6.0], abs=0.03)
    assert len(space.query('LWPOLYLINE[layer=="ZONES"]')) == 1


def test_a_drawing_is_a_room_of_the_same_size(in_a_room, tmp_path):
    pytest.importorskip('ezdxf', reason='ezdxf reads DXF files')
    (tmp_path / 'plan.dxf').write_text(dxf_of(in_a_room))
    room, _ = room_named(str(tmp_path / 'plan.dxf'), 4000, height=2.8)
    assert room.size == pytest.approx([6.0, 4.0, 2.8], abs=0.12)


def test_a_building_model_has_the_cameras_in_its_storey(in_a_room, tmp_path):
    ifcopenshell = pytest.importorskip('ifcopenshell', reason='ifcopenshell reads IFC files')
    from ifcopenshell.util import element, placement, unit
    (tmp_path / 'cameras.ifc').write_text(ifc_of(in_a_room))
    model = ifcopenshell.open(tmp_path / 'cameras.ifc')
    assert unit.calculate_unit_scale(model) == 1.0
    storey, = model.by_type('IfcBuildingStorey')
    assert storey.Elevation == pytest.approx(1.0, abs=0.01)
    sensors = model.by_type('IfcSensor')
    for sensor, placed in zip(sensors, in_a_room.placement.cameras, strict=True):
        assert element.get_container(sensor) == storey and sensor.Name == placed.camera.name
        np.testing.assert_allclose(placement.get_local_placement(sensor.ObjectPlacement),
                                   pose_matrix(placed), atol=1e-6)
        told = element.get_psets(sensor)['Ocp_DepthCamera']
        assert told['HorizontalFieldOfView'] == pytest.approx(placed.camera.model.horizontal_fov)
        assert told['MaxRange'] == placed.camera.model.max_range
        settings = ifcopenshell.geom.settings()
        body = ifcopenshell.geom.create_shape(settings, sensor).geometry
        assert np.ptp(np.array(body.verts).reshape(-1, 3), axis=0).max() < 0.2
        kinds = [one.RepresentationIdentifier for one in sensor.Representation.Representations]
        assert kinds == ['Body', 'Clearance']
    # A room that is a building model gets the cameras in its own units, axes and storeys.
    text = (tmp_path / 'cameras.ifc').read_text()
    millimetres = text.replace('IFCSIUNIT(*,.LENGTHUNIT.,$,.METRE.)',
                               'IFCSIUNIT(*,.LENGTHUNIT.,.MILLI.,.METRE.)')
    assert millimetres != text
    path = tmp_path / 'house.ifc'
    path.write_text(millimetres)
    matrix = np.diag([1000.0, 1000.0, 1000.0, 1.0])
    matrix[0, 3] = 5000.0
    moved = replace(in_a_room.original, room={'file': str(path),
                                              'source_from_map': matrix.tolist()})
    path.write_text(ifc_of(Exported(moved)))
    sensors = ifcopenshell.open(path).by_type('IfcSensor')
    assert len(sensors) == 4
    found = placement.get_local_placement(sensors[2].ObjectPlacement)[:3, 3]
    there = np.array(moved.cameras[0].position) + [5.0, 0.0, 0.0]
    assert found == pytest.approx(1000.0 * there)


@pytest.mark.parametrize('schema', ['IFC2X3', 'IFC4X3'])
def test_a_building_on_a_hill_has_the_cameras_in_their_storey(exported, schema, tmp_path):
    ifcopenshell = pytest.importorskip('ifcopenshell', reason='ifcopenshell reads IFC files')
    from ifcopenshell.api import run
    from ifcopenshell.util import element, placement
    model = run('project.create_file', version=schema)
    run('owner.add_application', model, application_developer=run('owner.add_organisation', model))
    run('owner.add_person_and_organisation', model, person=run('owner.add_person', model),
        organisation=model.by_type('IfcOrganization')[0])
    above = run('root.create_entity', model, ifc_class='IfcProject')
    run('unit.assign_unit', model, length={'is_metric': True, 'raw': 'METERS'})
    run('context.add_context', model, context_type='Model')
    for kind, name, z in (('IfcBuilding', 'house', 98.0), ('IfcBuildingStorey', 'lower', 98.0),
                          ('IfcBuildingStorey', 'upper', 101.0)):
        inner = run('root.create_entity', model, ifc_class=kind, name=name)
        run('aggregate.assign_object', model, products=[inner], relating_object=above)
        matrix = np.eye(4)
        matrix[2, 3] = z
        run('geometry.edit_object_placement', model, product=inner, matrix=matrix)
        if kind == 'IfcBuilding':
            above = inner
        else:
            # The elevation is that above the floor of the building.
            inner.Elevation = z - 98.0
    path, up = tmp_path / 'house.ifc', np.eye(4)
    up[2, 3] = 98.0
    model.write(str(path))
    path.write_text(ifc_of(Exported(replace(
        exported.original, room={'file': str(path), 'source_from_map': up.tolist()}))))
    read = ifcopenshell.open(path)
    for sensor, placed in zip(read.by_type('IfcDistributionControlElement'),
                              exported.placement.cameras, strict=True):
        assert (sensor.Name, sensor.ObjectType) == (placed.camera.name, 'DEPTH_CAMERA')
        assert element.get_container(sensor).Name == 'lower'
        np.testing.assert_allclose(placement.get_local_placement(sensor.ObjectPlacement),
                                   up @ pose_matrix(placed), atol=1e-6)
        settings = ifcopenshell.geom.settings()
        body = ifcopenshell.geom.create_shape(settings, sensor).geometry
        assert np.ptp(np.array(body.verts).reshape(-1, 3), axis=0).max() < 0.2


@pytest.mark.parametrize(('text_of', 'name'), [
    (usd_of, 'usd'), (gltf_of, 'gltf'), (metropolis_of, 'metropolis'), (dxf_of, 'dxf'),
    (ifc_of, 'ifc')])
def test_formats_with_z_up_refuse_the_axes_of_a_scan_with_y_up(exported, text_of, name):
    pytest.importorskip('ezdxf')
    pytest.importorskip('ifcopenshell')
    frame = SourceFrame(rotation=map_from_file('y'))
    room = SimpleNamespace(scene=SimpleNamespace(source=frame), data_frame=frame)
    with refused_in_one_sentence(f'{name}: ', 'leave out --frame source'):
        text_of(replace(exported, assessed=room))
