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

"""Kernels of geometry and of what cameras see, against NumPy twins, ray casting and properties."""

from functools import cache

from benchmarks.engine import confusion, f1_of, free_places
from conftest import box_sides, for_any, made_room, panel
from hypothesis import example
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, LEVEL, Pose, rotation_matrix
from ocp_ros.geometry.clouds import fixed_size
from ocp_ros.geometry.coverage import coverable_cell, coverage_grid, space_coverage
from ocp_ros.geometry.depth_error import DepthError, five_viewpoints, MAX_HALF_SIDE
from ocp_ros.geometry.normals import edge_aware_normals
from ocp_ros.geometry.packed_bits import (
    block_bounds,
    count_bits,
    find_blocks_in_view,
    no_bits,
    pack,
    POINTS_PER_BLOCK,
    seen_by,
    spatial_order,
    Subset,
    unpack,
)
from ocp_ros.geometry.shadow_maps import footprints, mark_visible, projected, splat
from ocp_ros.geometry.surfels import project_block, splat_surfels, Surfels, Workspace
from ocp_ros.geometry.visibility import CubeVisibility, DISC_SCALE, PRESETS, SurfelVisibility
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.meshes import MeshRays
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.simulation.viewpoints import paper_viewpoints
import pytest
from scipy.spatial import cKDTree
import twins
from twins import MODELS, SurfelTwin

HERE = Pose(np.zeros(3), LEVEL)
ALL_AROUND = MODELS['omnidirectional']
NOWHERE = np.empty((0, 3), np.float32)
#: Sides of cubes, in multiples of what they are in the engine; sums of depths, metres.
SHARE, ROUNDING = 0.75, 1e-5
seeds = st.integers(0, 2 ** 32 - 1)


def test_a_pose_is_a_position_and_the_rotation_of_its_angles():
    forward = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(rotation_matrix(np.pi / 2) @ forward, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(0, np.pi / 2) @ forward, [0, 0, -1], atol=1e-12)
    rotation = rotation_matrix(0.3, 0.2, 0.1)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.array_equal(Pose.of([1, 2, 3]).rotation, np.eye(3))
    np.testing.assert_allclose(Pose.of([1, 2, 3, 0.3, 0.2, 0.1]).rotation, rotation)


@pytest.mark.parametrize(('make', 'arguments'), [
    (CameraModel, (-1.0, 4.0)), (CameraModel, (4.0, 4.0)), (CameraModel, (0.0, np.inf)),
    (CameraModel, (0.0, 4.0, 0.0)), (CameraModel, (0.0, 4.0, 7.0)),
    (CameraModel, (0.0, 4.0, 1.0, 4.0)), (CameraModel, (0.0, 4.0, 1.0, 1.0, (0, 480))),
    (Pose.of, ([1.0, 2.0],)), (Pose.of, ([1.0, 2.0, np.nan],)), (Pose.of, (np.zeros((2, 3)),)),
    (Pose.of, (np.zeros(7),))])
def test_a_camera_or_a_pose_that_makes_no_sense_is_refused(make, arguments):
    with pytest.raises(ValueError, match='camera .*found .*expected'):
        make(*arguments)


def blocks_seen(points, radius, pose, model):
    """Return the numbers of the blocks of points that a camera may see."""
    bounds = block_bounds(points, np.full(len(points), radius, np.float32))
    numbers = np.empty(len(bounds), dtype=np.uint32)
    return numbers[:find_blocks_in_view(bounds, pose, model.lens, numbers)]


@pytest.mark.parametrize('model', MODELS.values(), ids=MODELS)
@for_any(30, seed=seeds, count=st.integers(1, 2000), radius=st.floats(0.0, 0.3))
def test_no_block_with_a_point_in_view_is_passed_over(model, seed, count, radius):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (count, 3)).astype(np.float32)
    order = spatial_order(points)
    assert np.array_equal(np.sort(order), np.arange(count))
    points = points[order]
    pose = Pose(rng.uniform(-4, 4, 3), rotation_matrix(*rng.uniform(-3, 3, 3)))
    found = blocks_seen(points, radius, pose, model)
    distance = twins.project(points, *pose, model)[0]
    # Single precision may round a point out of the very edge of its block.
    inside = np.isfinite(distance) & (distance < model.max_range - 1e-4)
    assert set(np.flatnonzero(inside) // POINTS_PER_BLOCK) <= set(found.tolist())


def test_a_narrow_camera_passes_over_most_blocks():
    points = np.random.default_rng(0).uniform(-4, 4, (50000, 3)).astype(np.float32)
    seen = blocks_seen(points[spatial_order(points)], 0.0, Pose.of(np.zeros(3)),
                       SENSORS['realsense_d435'].model)
    assert 0 < len(seen) < 0.5 * len(points) / POINTS_PER_BLOCK


@for_any(60, flags=st.lists(st.booleans(), max_size=700))
def test_packed_bits_are_the_flags(flags):
    words = pack(np.array(flags, dtype=bool))
    assert len(words) * 64 % POINTS_PER_BLOCK == 0
    assert unpack(words, len(flags)).tolist() == flags
    assert count_bits(words) == sum(flags)


@for_any(30, seed=seeds, count=st.integers(1, 700))
def test_subsets_are_sets_of_the_callers_points(seed, count):
    rng = np.random.default_rng(seed)
    order = rng.permutation(count)
    one, other = (rng.random(count) < 0.5 for _ in range(2))
    subsets = [Subset(pack(flags[order]), order) for flags in (one, other)]
    both = subsets[0] | subsets[1]
    assert np.array_equal(subsets[0].mask, one) and np.array_equal(both.mask, one | other)
    assert len(both) == (one | other).sum() and len(Subset.none(order)) == 0
    assert both >= subsets[0] and (subsets[0] >= both) == np.array_equal(one, one | other)


@for_any(seed=seeds, count=st.integers(1, 600), views=st.integers(1, 6), most=st.integers(1, 4))
def test_points_seen_by_so_many_are_counted(seed, count, views, most):
    flags = np.random.default_rng(seed).uniform(size=(views, count)) < 0.4
    levels = seen_by([pack(row) for row in flags], most)
    for k, bits in enumerate(levels, start=1):
        assert np.array_equal(unpack(bits, count), flags.sum(axis=0) >= k)


def test_the_coverage_grid_fills_the_box():
    bounds = np.array([[-1.0, 0.0, 2.0], [2.3, 1.1, 4.0]])
    centres, volume = coverage_grid(bounds, 0.25)
    assert len(centres) == 13 * 4 * 8
    assert (centres > bounds[0]).all() and (centres < bounds[1]).all()
    everything = pack(np.ones(len(centres), dtype=bool))
    assert space_coverage(everything, volume) == pytest.approx(3.3 * 1.1 * 2.0)
    for box, cell in ((bounds, 0.0), (1000.0 * bounds, 0.25)):
        with pytest.raises(ValueError, match='cell'):
            coverage_grid(box, cell)
    assert coverable_cell(bounds, 0.25) == 0.25
    hall = np.array([[0.0, 0.0, 0.0], [250.0, 160.0, 8.0]])
    assert len(coverage_grid(hall, coverable_cell(hall, 0.25))[0]) == 500 * 320 * 16


@for_any(40, count=st.integers(1, 3000), wanted=st.integers(1, 600))
def test_a_cloud_of_fixed_size_is_spread_over_the_whole(count, wanted):
    points = np.arange(count * 3, dtype=np.float32).reshape(-1, 3)
    taken = fixed_size(points, wanted)
    rows = (taken[:, 0] / 3).astype(int)
    assert taken.shape == (wanted, 3) and rows[0] == 0
    assert np.all(np.diff(rows) >= 0) and np.all(np.diff(rows) <= -(-count // wanted))
    if wanted <= count:
        assert len(np.unique(rows)) == wanted


def test_normals_equal_their_twin_in_a_scanned_room(room):
    _, near = cKDTree(room.points).query(room.points, k=14)
    found = edge_aware_normals(room.points, near)
    expected = twins.edge_aware_normals(room.points, near)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-5)
    # The same planes; where two fit equally well, rounding may take the other.
    assert np.mean(np.abs((found * expected).sum(axis=1)) > 0.9999) > 0.995


@cache
def small(folds=1):
    """Return a small room and its depth error at a low resolution."""
    scene = made_room(2, 600)
    return scene, DepthError(scene.points, SHARE * scene.spacing, scene.diameter,
                             paper_viewpoints(scene), 24, folds)


def drawn(scene, seed, *shares):
    """Return which points are seen, for shares of them: (N,) bool each."""
    rng = np.random.default_rng(seed)
    return [rng.random(len(scene)) < share for share in shares]


@for_any(5, seed=seeds, share=st.floats(0.0, 1.0))
def test_depth_error_agrees_with_its_twin(seed, share):
    scene, error = small()
    seen, = drawn(scene, seed, share)
    half_sides = SHARE * np.minimum(scene.spacing, MAX_HALF_SIDE * np.median(scene.spacing))
    expected = twins.depth_error_by_point(scene.points, half_sides, error.viewpoints, error.far,
                                          24, seen)
    found = error.error_by_point(pack(seen))
    assert error(pack(seen)) == pytest.approx(expected.sum(), rel=2e-3, abs=2e-3)
    assert np.abs(found - expected).sum() <= 2e-3 * expected.sum() + ROUNDING
    # All of the error is somewhere, and none where points are seen.
    assert found.sum() == pytest.approx(error(pack(seen)), rel=1e-4, abs=ROUNDING)
    assert (found >= 0.0).all() and not found[seen].any()


@pytest.mark.parametrize('folds', [1, 3])
@for_any(15, seed=seeds, share=st.floats(0.0, 1.0), more=st.floats(0.0, 1.0))
def test_depth_error_falls_or_stays_when_more_is_seen(folds, seed, share, more):
    scene, error = small(folds)
    seen, *views = map(pack, drawn(scene, seed, share, more, 0.1, 0.0))
    errors = [error(seen | view) for view in views]
    assert min(errors) >= 0.0 and max(errors) <= error(seen) + ROUNDING
    assert error(seen) <= error.worst + ROUNDING
    assert error(pack(np.ones(len(scene), dtype=bool))) == 0.0
    assert error.worst == error(no_bits(len(scene))) > 1.0
    # What is settled may be left out.
    given_seen = error.given(seen)
    assert [given_seen(view) for view in views] == pytest.approx(errors, abs=ROUNDING)


def test_folds_change_what_single_points_save_and_not_what_nothing_and_all_cost():
    scene, plain = small()
    for folds in (2, 4):
        _, folded = small(folds)
        assert folded.worst == pytest.approx(plain.worst, rel=1e-5)
        assert folded.error_by_point(no_bits(len(scene))).sum() == pytest.approx(
            folded.worst, rel=1e-5)
        np.testing.assert_array_equal(folded.depth_map(0), plain.depth_map(0))
    # Every pixel's nearest points but a tenth of them: what is left hangs on single points.
    few, = drawn(scene, 0, 0.1)
    assert folded(pack(few)) > plain(pack(few))


def test_viewpoints_are_where_the_paper_puts_them():
    found = five_viewpoints(np.array([[0, 0], [0, 12], [6, 0], [6, 12]]), 1.5)
    assert found.tolist() == [[3, 6, 1.5], [1, 2, 1.5], [1, 10, 1.5], [5, 2, 1.5], [5, 10, 1.5]]


def test_depth_maps_agree_with_ray_casting():
    scene = generate_room(12, 15000, scanned=False)
    engine = Simulator(scene, SimulationConfig()).depth_error
    caster, rays = MeshRays(scene.mesh), twins.directions(engine.shape[0]).reshape(-1, 3)
    off = [np.abs(engine.depth_map(k).ravel() - caster.lengths(engine.viewpoints[k], rays)).mean()
           for k in range(5)]
    # Cubes reach a little beyond what they stand for; holes would cost metres.
    assert sum(off) < 0.8
    assert (engine.depth_map(0) == np.float32(engine.far)).mean() < 0.03


def cloud(seed, count=120, size=6.0):
    """Return random points, sizes in metres and unit normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-size / 2, size / 2, (count, 3)).astype(np.float32)
    sizes = rng.uniform(0.0, 0.4, count).astype(np.float32)
    normals = rng.normal(size=(count, 3))
    return points, sizes, (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype('f4')


def splatted(settings, points, normals, radii):
    """Return the map of few discs around a camera in the origin: (H, W) distances, metres."""
    rows, work = settings.rows, Workspace.of(settings.rows, len(points))
    splat_surfels(Surfels.of(points, normals, np.array(radii, np.float32)),
                  np.zeros(1, np.uint32), HERE.position, 4.0, settings, work)
    return 1.0 / work.inverse_map.reshape(rows + 2, 2 * rows + 2)[1:-1, 1:-1]


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
    where = projected(np.ascontiguousarray(points.T), pose, model.lens)
    work = Workspace.of(64, len(points))
    project_block(Surfels.of(points, normals, sizes), 0, pose.position, model.max_range,
                  PRESETS['fast']._replace(setback=0.0), work)
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
    where = projected(np.ascontiguousarray(points.T), HERE, ALL_AROUND.lens)
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
    settings = PRESETS['fine']._replace(rows=128, single_limit=0.0, quad_limit=0.0)
    point, normal = rng.normal(size=3), rng.normal(size=3)
    point[2] *= 0.5
    point *= rng.uniform(1.5, 3.5) / np.linalg.norm(point)
    normal /= np.linalg.norm(normal)
    if abs(point @ normal) < 0.35 * np.linalg.norm(point):
        normal = point / np.linalg.norm(point)
    radius = rng.uniform(0.05, 0.2)
    found = splatted(settings, point[None], normal[None], [radius])
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
    twin = SurfelTwin(points, normals, DISC_SCALE * sizes, np.zeros(3), 4.0, PRESETS[preset])
    # Single precision moves a few edges of discs to the neighbouring cell.
    assert (look(points, sizes, normals, preset) != twin.visible()).mean() <= 0.02


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
    found = splatted(PRESETS['fine'], point[None], point[None], [np.deg2rad(size)]) < 2.0
    angle = np.rad2deg(np.arccos(np.clip(twins.directions(160) @ point, -1.0, 1.0)))
    assert found[angle < size - 1.2].all() and not found[angle > 1.3 * size + 1.2].any()


@pytest.mark.parametrize('preset', PRESETS)
def test_degenerate_points_do_no_harm(preset):
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0], [9, 0, 0], [0, 0, 1]], 'f4')
    sizes = np.array([1.0, 0.0, 0.0, 50.0, 1.0, 0.1], np.float32)
    normals = np.array([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 0, 0]], 'f4')
    if preset == 'paper':
        where = projected(np.ascontiguousarray(points.T), HERE, ALL_AROUND.lens)
        shadow = 1.0 / splat(where, footprints(where, sizes, 128, 256), 4.0, 128, 256)
    else:
        shadow = splatted(PRESETS[preset], points, normals, sizes)
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
@for_any(seed=seeds, more=st.floats(0.1, 4.0), turns=st.integers(0, 127))
def test_more_range_fewer_occluders_and_turns_hide_nothing(preset, seed, more, turns):
    points, sizes, normals = cloud(seed)
    near, far = (look(points, sizes, normals, preset, model=CameraModel(0.0, r))
                 for r in (2.0, 2.0 + more))
    # Beyond the shorter range lies nothing that could hide anything nearer, but for discs that
    # reach across it.
    assert (near & ~far).mean() <= (0.0 if preset == 'paper' else 0.02)
    points, sizes, normals = cloud(seed, count=400)
    keep = np.random.default_rng(seed).random(len(points)) < 0.6
    one = look(points, sizes, normals, preset)
    after = look(points[keep], sizes[keep], normals[keep], preset)
    assert not (one[keep] & ~after).any()
    # By whole cells of the map.
    rotation = rotation_matrix(turns * np.pi / PRESETS[preset].rows).astype(np.float32)
    other = look(np.ascontiguousarray(points @ rotation.T), sizes,
                 np.ascontiguousarray(normals @ rotation.T), preset)
    # Rounding moves a few points and edges of footprints to the neighbouring cell.
    assert (one != other).mean() <= 0.015


@pytest.mark.parametrize(('preset', 'most'), [('fine', 0.0), ('fast', 0.0), ('paper', 0.01)])
def test_frusta_that_tile_the_sphere_see_what_its_twin_and_an_omnidirectional_camera_see(
        preset, most):
    scene = made_room(3, 6000)
    position = np.append(scene.bounds.mean(axis=0)[:2], 1.6)
    whole = look_at_scene(scene, Pose.of(position), ALL_AROUND, preset)
    if preset != 'paper':
        twin = SurfelTwin(scene.points, scene.normals_or_estimate, DISC_SCALE * scene.pitch,
                          position, 4.0, PRESETS[preset])
        assert (whole != twin.visible()).mean() <= 0.001
    together = np.zeros(len(scene), dtype=bool)
    # The six faces of a cube around the camera.
    square = CameraModel(0.0, 4.0, np.pi / 2 + 1e-5, np.pi / 2 + 1e-5)
    for yaw, pitch in ((0, 0), (1, 0), (2, 0), (3, 0), (0, 1), (0, -1)):
        pose = Pose(position, rotation_matrix(yaw * np.pi / 2, pitch * np.pi / 2))
        together |= look_at_scene(scene, pose, square, preset)
    assert not (whole & ~together).any()
    # With cubes an occluder beside the field of view hides nothing in it.
    assert (together & ~whole).mean() <= most


@pytest.mark.parametrize(('preset', 'least'), [('fine', 0.90), ('fast', 0.87), ('paper', 0.70)])
def test_visibility_agrees_with_ray_casting(preset, least):
    counts = []
    for seed, points in ((1, 15_000), (509, 40_000)):
        scene = made_room(seed, points)
        for position in free_places(scene, 1.9, 2, np.random.default_rng(seed)):
            truth = MeshRays(scene.mesh).visible(scene.points, position, 6.0)
            seen = look_at_scene(scene, Pose.of(position), CameraModel(0.0, 6.0), preset)
            counts.append(confusion(seen, truth))
    assert f1_of(sum(counts)) >= least


@pytest.mark.parametrize('preset', PRESETS)
def test_a_place_in_the_air_is_covered_unless_something_is_in_front(preset):
    scene = made_room(4, 12000)
    camera = free_places(scene, 1.9, 1, np.random.default_rng(1))[0]
    places, _ = coverage_grid(scene.bounds, 0.5)
    sizes = scene.spacing if preset == 'paper' else scene.pitch
    engine = visibility(scene.points, sizes, scene.normals_or_estimate, preset, places)
    covered, truth = Subset.none(engine.place_order), MeshRays(scene.mesh)
    engine.look(Pose.of(camera), CameraModel(0.0, 6.0).lens, no_bits(len(scene)), covered.bits)
    assert (covered.mask == truth.visible(places, camera, 6.0)).mean() > 0.95


@pytest.mark.parametrize(('preset', 'leak'), [('fine', 0.02), ('fast', 0.05)])
def test_a_camera_inside_a_pillar_sees_its_inside_alone(preset, leak):
    pillar = box_sides(np.array([0.6, 0.6, 3.0]), np.array([0.0, 0.0, 1.5]), 0.02)
    far = np.random.default_rng(0).uniform([2, -3, 0.2], [3, 3, 2.8], (500, 3))
    scene = Scene(np.concatenate([pillar, far]).astype(np.float32))
    seen = look_at_scene(scene, Pose.of([0.0, 0.0, 1.5]), ALL_AROUND, preset)
    assert seen[:len(seen) - 500].mean() > 0.9
    assert seen[-500:].mean() < leak


def test_noise_costs_fast_little_where_points_are_dense():
    """Of many noisy discs in one cell, the nearest one hides no others."""
    # A wall along x, a metre beside the camera: seen at a slant.
    across, up = (axis.ravel() for axis in np.meshgrid(np.arange(0.0, 4.0, 0.02),
                                                       np.arange(-1.2, 1.2, 0.02)))
    noise = np.random.default_rng(0).normal(0.0, 0.008, len(up))
    points = np.stack([across, 1.0 + noise, up], axis=1)
    scene, shares = Scene(points.astype(np.float32)), []
    for settings in (PRESETS['fast'], PRESETS['fast']._replace(setback=0.0)):
        engine = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch, NOWHERE,
                                  settings)
        seen = Subset.none(engine.order)
        engine.look(HERE, CameraModel(0.0, 6.0).lens, seen.bits)
        shares.append(seen.mask.mean())
    assert shares[0] > 0.9 and shares[0] > shares[1] + 0.05
