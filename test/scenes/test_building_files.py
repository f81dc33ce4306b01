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

"""Test rooms from occupancy maps, floor plans, models of buildings and stages."""

import os

import numpy as np
from ocp_ros.scenes.scene import SceneError
from ocp_ros.scenes.scene_files import load_scene
from PIL import Image
import pytest

#: Metres: a room, and a desk or column in it.
SIZE = np.array([6.0, 4.5, 2.7])
DESK = np.array([[2.0, 1.0, 0.0], [3.5, 1.8, 0.75]])


def check_room(scene, low=(0.0, 0.0, 0.0), high=SIZE, slack=0.02):
    """Assert that a scene is a room between two corners."""
    np.testing.assert_allclose(scene.points.min(axis=0), low, atol=slack)
    np.testing.assert_allclose(scene.points.max(axis=0), high, atol=slack)


def has_points_near(scene, point, distance=0.1):
    """Return whether a scene has points near a point (3,) in metres."""
    return bool((np.linalg.norm(scene.points - point, axis=1) < distance).any())


def write_map(folder, look=None, **changes):
    """
    Write an occupancy map with cells of 5 cm, unknown outside of the walls.

    :param look: returns the image of the map, given its pixels: 0, 205 or 254.
    """
    pixels = np.full((110, 140), 205, dtype=np.uint8)
    pixels[8:102, 8:132] = 0
    pixels[10:100, 10:130] = 254
    # A column, of which only the sides are known; the image begins at the top.
    pixels[64:80, 50:80] = 0
    pixels[66:78, 52:78] = 205
    Image.fromarray(pixels).save(folder / 'map.pgm')
    if look:
        look(pixels).save(folder / changes['image'])
    values = {'image': 'map.pgm', 'resolution': 0.05, 'origin': [-0.5, -0.5, 0.0], 'negate': 0,
              'occupied_thresh': 0.65, 'free_thresh': 0.196} | changes
    path = folder / 'map.yaml'
    path.write_text('\n'.join(f'{key}: {value}' for key, value in values.items()))
    return path


def test_occupancy_map_has_walls_of_the_given_height(tmp_path):
    scene = load_scene(write_map(tmp_path), height=2.5)
    check_room(scene, high=(6.0, 4.5, 2.5))
    # The side of the column towards the origin, at its full height; and no floor inside of it.
    assert has_points_near(scene, (2.0, 1.4, 2.4))
    assert not has_points_near(scene, (2.75, 1.4, 0.0), 0.3)
    turned = load_scene(write_map(tmp_path, origin=[-0.5, -0.5, np.pi / 2]), height=2.5)
    assert np.ptp(turned.points[:, 0]) == pytest.approx(4.5, abs=0.02)


@pytest.mark.parametrize(('look', 'changes'), [
    (lambda pixels: Image.fromarray(255 - pixels), {'image': 'map.bmp', 'negate': 'true'}),
    # map_saver writes what is unknown transparent, or as 255 in place of a percentage.
    (lambda pixels: Image.merge('LA', [
        Image.fromarray(np.where(pixels == 205, 0, pixels)),
        Image.fromarray(np.where(pixels == 205, 0, 255).astype(np.uint8))]),
     {'image': 'map.png', 'mode': 'scale'}),
    (lambda pixels: Image.fromarray(np.choose(
        np.searchsorted([0, 205, 254], pixels), [100, 255, 0]).astype(np.uint8)),
     {'image': 'map.png', 'mode': 'raw', 'negate': 1})], ids=['negate', 'scale', 'raw'])
def test_every_way_to_write_a_map_has_the_same_walls(tmp_path, look, changes):
    expected = load_scene(write_map(tmp_path), height=2.5)
    found = load_scene(write_map(tmp_path, look, **changes), height=2.5)
    np.testing.assert_array_equal(found.points, expected.points)


def test_maps_that_are_noise_or_wait_for_ever_are_refused(tmp_path):
    os.mkfifo(tmp_path / 'pipe.pgm')
    pixels = np.random.default_rng(0).integers(2, size=(1000, 1000), dtype=np.uint8)
    Image.fromarray(255 * pixels).save(tmp_path / 'noise.pgm')
    for image, words in (('pipe.pgm', 'a pipe'), ('noise.pgm', 'noise')):
        with pytest.raises(SceneError, match=words):
            load_scene(write_map(tmp_path, image=image), height=2.5)


@pytest.mark.parametrize('version', ['R2000', 'R2010'])
def test_floor_plan_in_millimetres(tmp_path, version):
    ezdxf = pytest.importorskip('ezdxf')
    # Texts of R2000 are in a code page of Windows.
    plan = ezdxf.new(version, units=ezdxf.units.MM)
    block = plan.blocks.new('OFFICE')
    for edge in (0, 150):
        block.add_lwpolyline([(-edge, -edge), (6000 + edge, -edge), (6000 + edge, 4500 + edge),
                              (-edge, 4500 + edge)], close=True)
    model = plan.modelspace()
    model.add_blockref('OFFICE', (0, 0), dxfattribs={'layer': 'A-WALL'})
    plan.blocks.new('COLUMN').add_circle((0, 0), 200)
    model.add_blockref('COLUMN', (4500, 1500), dxfattribs={
        'layer': 'Wände', 'row_count': 2, 'row_spacing': 1500})
    model.add_line((1000, 0), (1000, 4500), dxfattribs={'layer': 'GRID'})
    plan.layers.add('WALL-OLD').freeze()
    model.add_line((3000, 0), (3000, 4500), dxfattribs={'layer': 'WALL-OLD'})
    path = tmp_path / 'plan.dxf'
    plan.saveas(path)
    scene = load_scene(path, height=2.7)
    check_room(scene)
    assert has_points_near(scene, (4.3, 3.0, 1.5)) and has_points_near(scene, (4.3, 1.5, 1.5))
    assert not has_points_near(scene, (1, 2, 1.5)) and not has_points_near(scene, (3, 2, 1.5))
    assert has_points_near(load_scene(path, height=2.7, layers='a-wall,wall-old'), (3, 2, 1.5))
    with pytest.raises(SceneError, match=r'A-WALL, GRID, .*; expected FURNITURE.*--layers'):
        load_scene(path, height=2.7, layers='FURNITURE')


@pytest.fixture(scope='module')
def house(tmp_path_factory):
    """Write a model of two storeys with two rooms each, a door and a window."""
    run = pytest.importorskip('ifcopenshell.api').run
    model = run('project.create_file')
    entity = {kind: run('root.create_entity', model, ifc_class=kind, name=kind)
              for kind in ('IfcProject', 'IfcSite', 'IfcBuilding')}
    run('unit.assign_unit', model, length={'is_metric': True, 'raw': 'MILLIMETERS'})
    body = run('context.add_context', model, context_type='Model', target_view='MODEL_VIEW',
               context_identifier='Body',
               parent=run('context.add_context', model, context_type='Model'))
    run('aggregate.assign_object', model, products=[entity['IfcSite']],
        relating_object=entity['IfcProject'])
    run('aggregate.assign_object', model, products=[entity['IfcBuilding']],
        relating_object=entity['IfcSite'])

    def add(kind, low, high, storey, name=''):
        """Add an element that is a box."""
        element = run('root.create_entity', model, ifc_class=kind, name=name or kind)
        corners = [[float((low, high)[(i >> axis) & 1][axis]) for axis in range(3)]
                   for i in range(8)]
        faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2],
                 [1, 3, 7, 5]]
        run('geometry.assign_representation', model, product=element,
            representation=run('geometry.add_mesh_representation', model, context=body,
                               vertices=[corners], faces=[faces]))
        run('geometry.edit_object_placement', model, product=element, matrix=np.eye(4))
        if kind == 'IfcSpace':
            run('aggregate.assign_object', model, products=[element], relating_object=storey)
        else:
            run('spatial.assign_container', model, products=[element],
                relating_structure=storey)

    for name, z in (('Ground', 0.0), ('First', 3.0)):
        storey = run('root.create_entity', model, ifc_class='IfcBuildingStorey', name=name)
        storey.Elevation = 1000.0 * z
        run('aggregate.assign_object', model, products=[storey],
            relating_object=entity['IfcBuilding'])
        top = z + 2.7
        add('IfcSlab', (-0.2, -0.2, z - 0.3), (10.2, 4.7, z), storey)
        for low, high in (((-0.2, -0.2), (10.2, 0)), ((-0.2, 4.5), (10.2, 4.7)),
                          ((10, 0), (10.2, 4.5)), ((-0.2, 0), (0, 1.5)), ((-0.2, 3), (0, 4.5)),
                          ((6, 0), (6.1, 1.8)), ((6, 2.7), (6.1, 4.5))):
            add('IfcWall', (*low, z), (*high, top), storey)
        # Below and above the window, above the door.
        add('IfcWall', (-0.2, 1.5, z), (0, 3, z + 0.9), storey)
        add('IfcWall', (-0.2, 1.5, z + 2.1), (0, 3, top), storey)
        add('IfcWall', (6, 1.8, z + 2.1), (6.1, 2.7, top), storey)
        add('IfcWindow', (-0.12, 1.5, z + 0.9), (-0.08, 3, z + 2.1), storey)
        add('IfcDoor', (6.02, 1.8, z), (6.07, 2.7, z + 2.1), storey)
        add('IfcFurniture', *(DESK + (0, 0, z)), storey)
        add('IfcSpace', (0, 0, z), (6, 4.5, top), storey, f'Office {name}')
        add('IfcSpace', (6.1, 0, z), (10, 4.5, top), storey, f'Store {name}')
    add('IfcSlab', (-0.2, -0.2, 5.7), (10.2, 4.7, 6.0), storey)
    path = tmp_path_factory.mktemp('house') / 'house.ifc'
    model.write(str(path))
    return path


@pytest.mark.parametrize(('options', 'low', 'high'), [
    ({'space': 'Office First'}, (-0.2, 0, 3), (6.02, 4.5, 5.7)),
    ({'storey': 'Ground'}, (-0.2, 0, 0), (6.02, 4.5, 2.7)),
    ({'storey': 'Ground', 'open_doors': True, 'all_rooms': True}, (-0.2, 0, 0), (10, 4.5, 2.7)),
], ids=['space', 'storey', 'open doors'])
def test_building_model(house, options, low, high):
    scene = load_scene(house, **options)
    # The reveals of the door and of the window are surfaces too.
    check_room(scene, low, high, 0.07)
    assert has_points_near(scene, (2.7, 1.4, low[2] + 0.75))
    # Cameras do not see the pane of a window, but through it.
    assert not has_points_near(scene, (-0.08, 2.2, low[2] + 1.5), 0.05)


def test_storeys_of_a_building_on_a_hill(house, tmp_path):
    import ifcopenshell
    from ifcopenshell.api import run
    model = ifcopenshell.open(house)
    for product in model.by_type('IfcElement') + model.by_type('IfcBuildingStorey'):
        matrix = np.eye(4)
        matrix[2, 3] = 98.0 + 0.001 * getattr(product, 'Elevation', 0.0)
        run('geometry.edit_object_placement', model, product=product, matrix=matrix)
    model.write(str(tmp_path / 'hill.ifc'))
    check_room(load_scene(tmp_path / 'hill.ifc', storey='First'), (-0.2, 0, 101),
               (6.02, 4.5, 103.7), 0.07)


def test_building_model_without_the_named_storey(house):
    with pytest.raises(SceneError, match='Ground, First; correct --storey'):
        load_scene(house, storey='Attic')


def test_stage_in_centimetres_with_a_part_in_another_file(tmp_path):
    pxr = pytest.importorskip('pxr.UsdGeom') and pytest.importorskip('pxr')
    usd, geom = pxr.Usd, pxr.UsdGeom
    part = usd.Stage.CreateNew(str(tmp_path / 'box.usdc'))
    cube = geom.Cube.Define(part, '/cube')
    cube.GetSizeAttr().Set(1.0)
    part.SetDefaultPrim(cube.GetPrim())
    part.GetRootLayer().Save()
    stage = usd.Stage.CreateNew(str(tmp_path / 'room.usda'))
    geom.SetStageUpAxis(stage, geom.Tokens.y)
    geom.SetStageMetersPerUnit(stage, 0.01)
    for name, low, high in (('room', np.zeros(3), SIZE), ('desk', *DESK)):
        box = stage.DefinePrim(f'/{name}')
        box.GetReferences().AddReference('box.usdc')
        # y up: the y axis of the room points to -z of the stage.
        axes = [0, 2, 1]
        place = geom.Xformable(box)
        place.AddTranslateOp().Set(tuple(
            (50 * (low + high)[axes] * (1, 1, -1)).tolist()))
        place.AddScaleOp().Set(tuple((100 * (high - low)[axes]).tolist()))
    stage.GetRootLayer().Save()
    scene = load_scene(tmp_path / 'room.usda')
    check_room(scene)
    assert has_points_near(scene, (2.7, 1.4, 0.75))
    (tmp_path / 'box.usdc').unlink()
    with pytest.raises(SceneError, match='box.usdc.*copy them there'):
        load_scene(tmp_path / 'room.usda')


def test_stage_with_instances_movement_and_simple_solids(tmp_path):
    pxr = pytest.importorskip('pxr.UsdGeom') and pytest.importorskip('pxr')
    usd, geom, gf = pxr.Usd, pxr.UsdGeom, pxr.Gf
    stage = usd.Stage.CreateNew(str(tmp_path / 'room.usdc'))
    geom.SetStageUpAxis(stage, geom.Tokens.z)
    geom.SetStageMetersPerUnit(stage, 1.0)
    root = geom.Xform.Define(stage, '/room')
    walls = geom.Cube.Define(stage, '/room/walls')
    walls.CreateSizeAttr(1.0)
    walls.AddTranslateOp().Set(gf.Vec3d(*(0.5 * SIZE)))
    walls.AddScaleOp().Set(gf.Vec3f(*SIZE))
    column = geom.Cylinder.Define(stage, '/room/column')
    column.CreateRadiusAttr(0.2)
    column.CreateHeightAttr(SIZE[2])
    # The only values of this translation are those of two times.
    moved = column.AddTranslateOp()
    moved.Set(gf.Vec3d(5.0, 3.5, 0.5 * SIZE[2]), 1.0)
    moved.Set(gf.Vec3d(1.0, 3.5, 0.5 * SIZE[2]), 24.0)
    tables = geom.PointInstancer.Define(stage, '/room/tables')
    geom.Xform.Define(stage, '/room/tables/kinds').AddTranslateOp().Set(gf.Vec3d(0.0, 0.0, 9.0))
    geom.Cube.Define(stage, '/room/tables/kinds/table').CreateSizeAttr(0.6)
    tables.CreatePrototypesRel().AddTarget('/room/tables/kinds/table')
    tables.CreateProtoIndicesAttr([0, 0, 0])
    tables.CreatePositionsAttr([gf.Vec3f(x, 1.0, 0.3) for x in (1.5, 3.0, 4.5)])
    tables.CreateInvisibleIdsAttr([1])
    root.AddTranslateOp().Set(gf.Vec3d(2.0, 0.0, 0.0))
    stage.GetRootLayer().Save()
    scene = load_scene(tmp_path / 'room.usdc')
    check_room(scene, (2.0, 0.0, 0.0), SIZE + (2.0, 0.0, 0.0))
    shown = [has_points_near(scene, point) for point in (
        (6.8, 3.5, 1.4), (2.8, 3.5, 1.4), (3.5, 1.0, 0.6), (5.0, 1.0, 0.6), (6.5, 1.0, 0.6))]
    assert shown == [True, False, True, False, True]


@pytest.mark.parametrize(('changes', 'options', 'message'), [
    ({}, {}, r'height of 0 m; expected 0\.5 to 100.*--height'),
    ({}, {'height': 2.5, 'storey': 'First'}, 'found --storey with this file.*ifc; leave it out'),
    ({'image': '../map.pgm'}, {'height': 2.5}, 'expected a file in the same folder'),
    ({'image': 'other.pgm'}, {'height': 2.5}, 'other.pgm, which cannot be read'),
    ({'free_thresh': 0.0}, {'height': 2.5}, 'correct the thresholds or negate'),
    ({'resolution': 0}, {'height': 2.5}, 'line 2.*metres per pixel')])
def test_refused_maps(tmp_path, changes, options, message):
    with pytest.raises(SceneError, match=message):
        load_scene(write_map(tmp_path, **changes), **options)
