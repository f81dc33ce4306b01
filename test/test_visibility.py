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

"""What cameras see: the kernels against NumPy and ray casting, and what must hold of them."""

from benchmarks.engine_bench import agreement, confusion, free_places
from benchmarks.numpy_twin import Twin
from conftest import box_sides, for_any, made_room, panel
from hypothesis import example
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, LEVEL, Pose, rotation_matrix
from ocp_ros.geometry.coverage import coverage_grid
from ocp_ros.geometry.packed_bits import no_bits, Subset
from ocp_ros.geometry.shadow_maps import footprints, mark_visible, projected, splat
from ocp_ros.geometry.surfels import (
    project_block,
    splat_surfels,
    Surfels,
    SurfelSettings,
    Workspace,
)
from ocp_ros.geometry.visibility import CubeVisibility, DISC_SCALE, PRESETS, SurfelVisibility
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene import Scene
import pytest
import twins
from twins import MODELS

HERE = Pose(np.zeros(3), LEVEL)
ALL_AROUND = MODELS['omnidirectional']
NOWHERE = np.empty((0, 3), np.float32)
#: The tests' clouds fit in one block.
ALL = np.zeros(1, np.uint32)
seeds = st.integers(0, 2 ** 32 - 1)


def cloud(seed, count=120, size=6.0):
    """Return random points, sizes in metres and unit normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-size / 2, size / 2, (count, 3)).astype(np.float32)
    sizes = rng.uniform(0.0, 0.4, count).astype(np.float32)
    normals = rng.normal(size=(count, 3))
    return points, sizes, (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype('f4')


def distances(inverse_map, rows):
    """Return a map from ``splat_surfels`` as (H, W) distances in metres."""
    return 1.0 / inverse_map.reshape(rows + 2, 2 * rows + 2)[1:-1, 1:-1]


def columns(points):
    """Return the coordinates of points (N, 3) in contiguous rows: (3, N)."""
    return np.ascontiguousarray(points.T)


def visibility(points, sizes, normals, preset, places=NOWHERE):
    """Return the visibility of one preset."""
    if preset == 'paper':
        return CubeVisibility(points, sizes, places, PRESETS[preset])
    return SurfelVisibility(points, normals, sizes, places, PRESETS[preset])


def look(points, sizes, normals, preset, pose=HERE, model=ALL_AROUND):
    """Return which points a camera sees."""
    engine = visibility(points, sizes, normals, preset)
    seen = Subset.none(engine.order)
    engine.look(pose, model.lens, seen.bits)
    return seen.mask


def look_at_scene(scene, pose, model, preset):
    """Return which points of a scene a camera sees."""
    sizes = scene.spacing if preset == 'paper' else scene.pitch
    return look(scene.points, sizes, scene.normals_or_estimate, preset, pose, model)


@pytest.mark.parametrize('model', MODELS.values(), ids=MODELS)
@for_any(8, seed=seeds)
def test_both_projections_agree_with_their_twin(model, seed):
    points, sizes, normals = cloud(seed)
    rng = np.random.default_rng(seed)
    pose = Pose(rng.uniform(-1, 1, 3), rotation_matrix(*rng.uniform(-3, 3, 3)))
    where, work = projected(columns(points), pose, model.lens), Workspace.of(64, len(points))
    settings = PRESETS['fast']._replace(setback=0.0)
    project_block(Surfels.of(points, normals, sizes), 0, pose.position, model.max_range, settings,
                  work)
    distance, elevation, azimuth = twins.project(points, *pose, model)
    measured = np.isfinite(distance)
    assert np.array_equal(np.isfinite(where.distance), measured)
    np.testing.assert_allclose(where.distance[measured], distance[measured], rtol=1e-5)
    np.testing.assert_allclose(where.elevation[measured], elevation[measured], atol=1e-5)
    np.testing.assert_allclose(where.azimuth[measured], azimuth[measured], atol=1e-5)
    # What is outside the cone or too near still hides what is behind it.
    apart = np.linalg.norm(points - pose.position, axis=1)
    reached = apart < model.max_range - 1e-4
    inverse, row, column = (field[:len(points)] for field in (work.inverse, work.row, work.column))
    np.testing.assert_allclose(inverse[reached], 1.0 / apart[reached], rtol=1e-4)
    assert (inverse[apart > model.max_range + 1e-4] == 0.0).all()
    np.testing.assert_allclose(row, (elevation + np.pi / 2) * 64 / np.pi, atol=2e-3)
    off = np.abs(column - (azimuth + np.pi) * 64 / np.pi)
    assert np.minimum(off, 128 - off).max() < 5e-3


@for_any(5, seed=seeds)
def test_cubes_agree_with_their_twins(seed):
    points, sizes, _ = cloud(seed, count=60)
    # At a pole and beside the other one, where a cube covers whole rows.
    points[:2], sizes[:2] = [[0.0, 0.0, 0.5], [0.1, 0.0, -0.5]], 0.3
    where = projected(columns(points), HERE, ALL_AROUND.lens)
    inverse_map = splat(where, footprints(where, sizes, 32, 64), 4.0, 32, 64)
    # The twins get the kernel's own single-precision directions, so that cells agree exactly.
    parts = [np.asarray(part, dtype=np.float64) for part in where[:3]]
    expected = twins.shadow_map(*parts, np.float64(sizes), 32, 4.0)
    # A cell whose centre lies on the rectangle's edge may fall to either side.
    assert (~np.isclose(1.0 / inverse_map, expected, rtol=1e-6)).mean() < 2e-3
    seen = Subset.none(np.arange(len(points)))
    mark_visible(where, 0.2, inverse_map, seen.bits)
    assert np.array_equal(seen.mask, twins.visible(*parts, 0.2, 1.0 / inverse_map))


@example(seed=15384)
@for_any(25, seed=seeds)
def test_a_surfel_is_a_disc_on_its_plane(seed):
    rng = np.random.default_rng(seed)
    settings = SurfelSettings(rows=128, base_tolerance=0.02, radius_tolerance=0.3,
                              single_limit=0.0, quad_limit=0.0)
    point, normal = rng.normal(size=3), rng.normal(size=3)
    point[2] *= 0.5
    point *= rng.uniform(1.5, 3.5) / np.linalg.norm(point)
    normal /= np.linalg.norm(normal)
    if abs(point @ normal) < 0.35 * np.linalg.norm(point):
        normal = point / np.linalg.norm(point)
    radius, work = np.array([rng.uniform(0.05, 0.2)], np.float32), Workspace.of(settings.rows, 1)
    splat_surfels(Surfels.of(point[None], normal[None], radius), ALL, np.zeros(3), 4.0, settings,
                  work)
    found = distances(work.inverse_map, settings.rows)
    plane, offset = twins.disc(point, normal, np.zeros(3), settings.rows)
    covered = found < 3.99
    if abs(point[2]) > np.sin(np.radians(65.0)) * np.linalg.norm(point):
        # Near a pole a disc is no ellipse of azimuth and elevation, but for its inner half.
        assert covered[offset < 0.5 * radius].all()
        # A disc smaller than a cell may lie between all rays.
        inner = offset < 0.8 * radius
        assert (inner & ~covered).sum() <= 0.15 * inner.sum()
        assert covered[offset > 1.3 * radius].sum() <= 0.15 * covered.sum() + 1
        return
    # Well inside the disc every cell is covered, well outside only the point's own.
    assert covered[offset < 0.8 * radius].all()
    assert covered[offset > 1.3 * radius].sum() <= 1
    inside = covered & (offset < radius)
    np.testing.assert_allclose(found[inside], plane[inside], rtol=0.04)


@pytest.mark.parametrize('preset', ['fine', 'fast'])
@for_any(6, seed=seeds)
def test_a_look_agrees_with_its_twin(preset, seed):
    points, sizes, normals = cloud(seed, count=300)
    twin = Twin(points, normals, DISC_SCALE * sizes, np.zeros(3), 4.0, PRESETS[preset])
    seen = look(points, sizes, normals, preset)
    # Single precision moves a few edges of discs to the neighbouring cell.
    assert (seen != twin.visible()).mean() <= 0.02


@pytest.mark.parametrize('preset', ['fine', 'fast'])
def test_a_look_at_a_room_agrees_with_its_twin(preset):
    scene = made_room(3, 6000)
    camera = np.append(scene.bounds.mean(axis=0)[:2], 1.6)
    twin = Twin(scene.points, scene.normals_or_estimate, DISC_SCALE * scene.pitch, camera, 4.0,
                PRESETS[preset])
    seen = look_at_scene(scene, Pose.of(camera), CameraModel(0.0, 4.0), preset)
    assert (seen != twin.visible()).mean() <= 0.001


def test_small_discs_fill_up_to_four_cells():
    settings = SurfelSettings(rows=64, base_tolerance=0.0, radius_tolerance=0.0,
                              single_limit=0.5, quad_limit=2.0)
    cell = np.pi / 64
    counts = []
    for size in (0.3, 0.9, 1.6):
        # Where four cells meet: each of the four has its centre half a cell away either way.
        point = 2.0 * np.array([[np.cos(1e-4), 0.0, np.sin(1e-4)]])
        radius, work = np.array([size * cell * 2.0], np.float32), Workspace.of(64, 1)
        splat_surfels(Surfels.of(point, point / 2.0, radius), ALL, np.zeros(3), 4.0, settings,
                      work)
        counts.append(int((distances(work.inverse_map, 64) < 3.0).sum()))
    assert counts == [1, 4, 4]


@pytest.mark.parametrize('preset', ['fine', 'fast'])
@pytest.mark.parametrize(('axis', 'sign'), [(0, -1), (2, -1), (2, 1)],
                         ids=['across the seam', 'below the camera', 'above the camera'])
def test_a_wall_hides_what_is_behind_it_across_the_seam_and_the_poles(preset, axis, sign):
    """No cell is missing there that could look like open space."""
    wall = panel(2.0 * sign, (-1, 1), (-1, 1))
    across = np.linspace([-0.5, 0.0], [0.5, 0.0], 21) if axis == 0 else (
        np.random.default_rng(0).uniform(-0.05, 0.05, (40, 2)))
    behind = np.insert(across, 0, 3.0 * sign, axis=1)
    points = np.roll(np.concatenate([wall, behind]), axis, axis=1).astype(np.float32)
    normals = np.tile(np.eye(3, dtype=np.float32)[axis], (len(points), 1))
    seen = look(points, np.full(len(points), 0.05, np.float32), normals, preset)
    assert seen[:len(wall)].all() and not seen[len(wall):].any()


@pytest.mark.parametrize('sign', [-1, 1])
@pytest.mark.parametrize(('off', 'size'), [(1.0, 2.0), (2.0, 3.0), (0.0, 4.0), (0.5, 20.0)])
def test_a_disc_that_reaches_over_a_pole_has_both_sides_of_it(sign, off, size):
    """In degrees; a disc that faces the camera."""
    point = np.array([np.sin(np.deg2rad(off)), 0.0, sign * np.cos(np.deg2rad(off))])
    radius, work = np.array([np.deg2rad(size)], np.float32), Workspace.of(160, 1)
    splat_surfels(Surfels.of(point[None], point[None], radius), ALL, np.zeros(3), 4.0,
                  PRESETS['fine'], work)
    found = distances(work.inverse_map, 160) < 2.0
    angle = np.rad2deg(np.arccos(np.clip(twins.directions(160) @ point, -1.0, 1.0)))
    assert found[angle < size - 1.2].all() and not found[angle > 1.3 * size + 1.2].any()


@pytest.mark.parametrize('preset', PRESETS)
def test_degenerate_points_do_no_harm(preset):
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0], [9, 0, 0], [0, 0, 1]], 'f4')
    sizes = np.array([1.0, 0.0, 0.0, 50.0, 1.0, 0.1], np.float32)
    normals = np.array([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 0, 0]], 'f4')
    lens, rules = ALL_AROUND.lens, PRESETS[preset]
    if preset == 'paper':
        where = projected(columns(points), HERE, lens)
        rows = rules.rows
        shadow = 1.0 / splat(where, footprints(where, sizes, rows, 2 * rows), lens.max_range,
                             rows, 2 * rows)
    else:
        work = Workspace.of(rules.rows, len(points))
        splat_surfels(Surfels.of(points, normals, sizes), ALL, HERE.position, lens.max_range,
                      rules, work)
        shadow = distances(work.inverse_map, rules.rows)
    assert np.isfinite(shadow).all()
    seen = look(points, sizes, normals, preset)
    # On the camera, twice in one place, as large as the room, out of range, without a normal.
    assert seen[[0, 1, 2, 3, 4]].tolist() == [False, True, True, True, False]


@pytest.mark.parametrize('preset', ['fine', 'fast'])
def test_what_is_too_near_is_not_measured_but_hides(preset):
    points = np.concatenate([panel(x, (-1, 1), (-1, 1)) for x in (0.4, 2.0)])
    normals = np.tile(np.array([1.0, 0, 0], np.float32), (len(points), 1))
    seen = look(points, np.full(len(points), 0.05, np.float32), normals, preset,
                model=CameraModel(1.5, 4.0))
    near, straight = points[:, 0] < 1.0, np.abs(points[:, 1:]).max(axis=1) < 0.8
    assert not seen[near].any() and not seen[~near & straight].any()


@pytest.mark.parametrize('preset', PRESETS)
@for_any(seed=seeds, more=st.floats(0.1, 4.0))
def test_what_is_visible_stays_visible_with_more_range(preset, seed, more):
    points, sizes, normals = cloud(seed)
    near, far = (look(points, sizes, normals, preset, model=CameraModel(0.0, r))
                 for r in (2.0, 2.0 + more))
    # Beyond the shorter range lies nothing that could hide anything nearer, but for discs that
    # reach across it.
    assert (near & ~far).mean() <= (0.0 if preset == 'paper' else 0.02)


@pytest.mark.parametrize('preset', PRESETS)
@for_any(seed=seeds)
def test_taking_occluders_away_hides_nothing(preset, seed):
    points, sizes, normals = cloud(seed)
    keep = np.random.default_rng(seed).random(len(points)) < 0.6
    before = look(points, sizes, normals, preset)
    after = look(points[keep], sizes[keep], normals[keep], preset)
    assert not (before[keep] & ~after).any()


@pytest.mark.parametrize('preset', PRESETS)
@for_any(seed=seeds, turns=st.integers(0, 127))
def test_turning_the_room_by_whole_cells_changes_next_to_nothing(preset, seed, turns):
    points, sizes, normals = cloud(seed, count=400)
    rotation = rotation_matrix(turns * np.pi / PRESETS[preset].rows).astype(np.float32)
    one = look(points, sizes, normals, preset)
    other = look(np.ascontiguousarray(points @ rotation.T), sizes,
                 np.ascontiguousarray(normals @ rotation.T), preset)
    # Rounding moves a few points and edges of footprints to the neighbouring cell.
    assert (one != other).mean() <= 0.015


@pytest.mark.parametrize(('preset', 'most'), [('fine', 0.0), ('fast', 0.0), ('paper', 0.01)])
def test_frusta_that_tile_the_sphere_see_what_an_omnidirectional_camera_sees(preset, most):
    scene = made_room(3, 6000)
    position = np.append(scene.bounds.mean(axis=0)[:2], 1.6)
    together = np.zeros(len(scene), dtype=bool)
    # The six faces of a cube around the camera.
    square = CameraModel(0.0, 4.0, np.pi / 2 + 1e-5, np.pi / 2 + 1e-5)
    for yaw, pitch in ((0, 0), (1, 0), (2, 0), (3, 0), (0, 1), (0, -1)):
        pose = Pose(position, rotation_matrix(yaw * np.pi / 2, pitch * np.pi / 2))
        together |= look_at_scene(scene, pose, square, preset)
    whole = look_at_scene(scene, Pose.of(position), CameraModel(0.0, 4.0), preset)
    assert not (whole & ~together).any()
    # With cubes an occluder beside the field of view hides nothing in it.
    assert (together & ~whole).mean() <= most


@pytest.mark.parametrize(('preset', 'least'), [('fine', 0.90), ('fast', 0.87), ('paper', 0.70)])
def test_visibility_agrees_with_ray_casting(preset, least):
    counts = []
    for seed in (1, 2):
        scene = made_room(seed, 15000)
        for position in free_places(scene, 1.9, 2, np.random.default_rng(seed)):
            truth = MeshRays(scene.mesh).visible(scene.points, position, 6.0)
            seen = look_at_scene(scene, Pose.of(position), CameraModel(0.0, 6.0), preset)
            counts.append(confusion(seen, truth))
    assert agreement(sum(counts))['f1'] >= least


@pytest.mark.parametrize('name', ['realsense_d455', 'azure_kinect_wfov', 'velodyne_vlp16'])
def test_a_real_sensor_agrees_with_ray_casting_in_its_cone(name):
    scene, model, counts = made_room(1, 15000), SENSORS[name].model, []
    for k, position in enumerate(free_places(scene, 1.9, 4, np.random.default_rng(1))):
        pose = Pose(position, rotation_matrix(1.7 * k, 0.4, 0.1))
        cone, _, _ = twins.project(scene.points, *pose, model)
        truth = MeshRays(scene.mesh).visible(scene.points, position, model.max_range)
        truth &= np.isfinite(cone)
        counts.append(confusion(look_at_scene(scene, pose, model, 'fine'), truth))
    assert sum(counts)[0] > 300 and agreement(sum(counts))['f1'] >= 0.86


@pytest.mark.parametrize('preset', PRESETS)
def test_a_place_in_the_air_is_covered_unless_something_is_in_front(preset):
    scene = made_room(4, 12000)
    camera = free_places(scene, 1.9, 1, np.random.default_rng(1))[0]
    places, _ = coverage_grid(scene.bounds, 0.5)
    sizes = scene.spacing if preset == 'paper' else scene.pitch
    engine = visibility(scene.points, sizes, scene.normals_or_estimate, preset, places)
    covered = Subset.none(engine.place_order)
    engine.look(Pose.of(camera), CameraModel(0.0, 6.0).lens, no_bits(len(scene)), covered.bits)
    truth = MeshRays(scene.mesh).visible(places, camera, 6.0)
    assert (covered.mask == truth).mean() > 0.95


@pytest.mark.parametrize(('preset', 'leak'), [('fine', 0.02), ('fast', 0.05)])
def test_a_camera_inside_a_pillar_sees_its_inside_alone(preset, leak):
    pillar = box_sides(np.array([0.6, 0.6, 3.0]), np.array([0.0, 0.0, 1.5]), 0.02)
    far = np.random.default_rng(0).uniform([2, -3, 0.2], [3, 3, 2.8], (500, 3))
    scene = Scene(np.concatenate([pillar, far]).astype(np.float32))
    seen = look_at_scene(scene, Pose.of([0.0, 0.0, 1.5]), CameraModel(0.0, 4.0), preset)
    assert seen[:len(seen) - 500].mean() > 0.9
    assert seen[-500:].mean() < leak


def test_fast_does_not_get_worse_with_more_points():
    scores, few = [], made_room(509, 10_000)
    positions = free_places(few, 1.9, 3, np.random.default_rng(0))
    for scene in (few, made_room(509, 40_000)):
        rays, counts = MeshRays(scene.mesh), np.zeros(3)
        for position in positions:
            counts += confusion(look_at_scene(scene, Pose.of(position), CameraModel(0.0, 6.0),
                                              'fast'),
                                rays.visible(scene.points, position, 6.0))
        scores.append(agreement(counts)['f1'])
    assert scores[1] > scores[0] - 0.003


def test_noise_costs_fast_little_where_points_are_dense():
    """Of many noisy discs in one cell, the nearest one hides no others."""
    across, up = (axis.ravel() for axis in np.meshgrid(np.arange(-2.0, 2.0, 0.02),
                                                       np.arange(-1.2, 1.2, 0.02)))
    rng = np.random.default_rng(0)
    # A wall along x, a metre beside the camera: seen at a slant.
    points = np.stack([across + 2.0, 1.0 + rng.normal(0.0, 0.008, len(up)), up], axis=1)
    scene = Scene(points.astype(np.float32))
    visibility = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch, NOWHERE,
                                  PRESETS['fast'])
    shares = []
    for settings in (PRESETS['fast'], PRESETS['fast']._replace(setback=0.0)):
        seen = Subset.none(visibility.order)
        visibility.by(settings).look(HERE, CameraModel(0.0, 6.0).lens, seen.bits)
        shares.append(seen.mask.mean())
    assert shares[0] > 0.9 and shares[0] > shares[1] + 0.05
