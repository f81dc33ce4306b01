# SPDX-License-Identifier: Apache-2.0
"""The engine: kernels against their NumPy twins, ray casting, and properties that must hold."""

from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
import pytest
import twins

from ocp_ros.benchmark.engine import free_places
from ocp_ros.benchmark.truth import RayCaster
from ocp_ros.geometry.cameras import CameraModel, rotation_matrix
from ocp_ros.geometry.clouds import fixed_size
from ocp_ros.geometry.coverage import coverage_grid, space_coverage
from ocp_ros.geometry.depth_error import DepthError, viewpoints
from ocp_ros.geometry.shadow_maps import Pose, project, Projection, splat, visible
from ocp_ros.geometry.surfels import (
    BLOCK,
    block_bounds,
    blocks_in_range,
    distances,
    project_surfels,
    spatial_order,
    splat_surfels,
    Surfels,
    SurfelSettings,
    SurfelView,
    visible_surfels,
)
from ocp_ros.geometry.visibility import CubeVisibility, PRESETS, SurfelVisibility
from ocp_ros.scenes.rooms import generate_room
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator

MODELS = {
    'omnidirectional': CameraModel(0.0, 4.0),
    'pinhole': CameraModel(0.3, 5.0, np.deg2rad(87), np.deg2rad(58)),
    'lidar': CameraModel(0.5, 6.0, 2 * np.pi, np.deg2rad(30)),
}
HERE = Pose(np.zeros(3), np.eye(3))
NOWHERE = np.empty((0, 3), np.float32)
#: The tests' clouds fit in one block.
ALL = np.array([0])
seeds = st.integers(0, 2 ** 32 - 1)


def cloud(seed, count=120, size=6.0):
    """Return random points, sizes in metres and unit normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-size / 2, size / 2, (count, 3)).astype(np.float32)
    sizes = rng.uniform(0.0, 0.4, count).astype(np.float32)
    normals = rng.normal(size=(count, 3))
    return points, sizes, (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype('f4')


def visibility(points, sizes, normals, model, preset, places=NOWHERE):
    """Return the visibility of one preset."""
    settings = PRESETS[preset]
    if preset == 'paper':
        return CubeVisibility(points, sizes, places, model.lens, settings)
    return SurfelVisibility(points, normals, sizes, places, model.lens, settings)


def look(points, sizes, normals, pose, model, preset):
    """Return which points a camera sees."""
    seen = np.zeros(len(points), dtype=bool)
    visibility(points, sizes, normals, model, preset).look(pose, seen)
    return seen


def look_at_scene(scene, pose, model, preset):
    """Return which points of a scene a camera sees."""
    sizes = scene.spacing if preset == 'paper' else scene.pitch
    return look(scene.points, sizes, scene.normals_or_estimate, pose, model, preset)


@pytest.mark.parametrize('model', MODELS.values(), ids=MODELS)
@given(seed=seeds)
@budget(max_examples=15, deadline=None)
def test_both_projections_agree_with_their_twin(model, seed):
    points, sizes, normals = cloud(seed)
    rng = np.random.default_rng(seed)
    pose = Pose(rng.uniform(-1, 1, 3), rotation_matrix(*rng.uniform(-3, 3, 3)))
    where, view = Projection.empty(len(points)), SurfelView.empty(len(points))
    project(points, pose, model.lens, where)
    project_surfels(Surfels.of(points, normals, sizes), ALL, pose, model.lens, 64, view)
    distance, elevation, azimuth = twins.project(points, *pose, model)
    measured = np.isfinite(distance)
    assert np.array_equal(np.isfinite(where.distance), measured)
    np.testing.assert_allclose(where.distance[measured], distance[measured], rtol=1e-5)
    np.testing.assert_allclose(where.elevation, elevation, atol=1e-5)
    np.testing.assert_allclose(where.azimuth, azimuth, atol=1e-5)
    # Single precision may decide otherwise on the very edge of a range or of the field of view.
    same = (view.inverse > 0) == measured
    assert same.mean() > 0.98
    both = same & measured
    np.testing.assert_allclose(view.inverse[both], 1.0 / distance[both], rtol=1e-4)
    np.testing.assert_allclose(view.row, (elevation + np.pi / 2) * 64 / np.pi, atol=2e-3)
    off = np.abs(view.column - (azimuth + np.pi) * 64 / np.pi)
    assert np.minimum(off, 128 - off).max() < 5e-3


@given(seed=seeds)
@budget(max_examples=10, deadline=None)
def test_cubes_agree_with_their_twins(seed):
    points, sizes, _ = cloud(seed)
    where, shadow = Projection.empty(len(points)), np.empty((32, 64), np.float32)
    project(points, HERE, MODELS['omnidirectional'].lens, where)
    splat(where, sizes, 0.75, 4.0, shadow)
    # The twins get the kernel's own single-precision directions, so that cells agree exactly.
    parts = [np.asarray(part, dtype=np.float64) for part in where]
    expected = twins.shadow_map(*parts, 0.75 * np.float64(sizes), 32, 4.0)
    # A cell whose centre lies on the rectangle's edge may fall to either side.
    assert (~np.isclose(shadow, expected, rtol=1e-6)).mean() < 2e-3
    seen = np.zeros(len(points), dtype=bool)
    visible(where, 0.2, shadow, seen)
    assert np.array_equal(seen, twins.visible(*parts, 0.2, shadow))


@given(seed=seeds)
@budget(max_examples=40, deadline=None)
def test_a_surfel_is_a_disc_on_its_plane(seed):
    rng = np.random.default_rng(seed)
    settings = SurfelSettings(rows=128, base=0.02, share=0.3, single=0.0, quad=0.0)
    point, normal = rng.normal(size=3), rng.normal(size=3)
    point[2] *= 0.5
    point *= rng.uniform(1.5, 3.5) / np.linalg.norm(point)
    normal /= np.linalg.norm(normal)
    if abs(point @ normal) < 0.35 * np.linalg.norm(point):
        normal = point / np.linalg.norm(point)
    radius, view = np.array([rng.uniform(0.05, 0.2)], np.float32), SurfelView.empty(1)
    project_surfels(Surfels.of(point[None], normal[None], radius), ALL, HERE,
                    MODELS['omnidirectional'].lens, settings.rows, view)
    inverse = np.empty(130 * 258, np.float32)
    splat_surfels(view, radius, ALL, 4.0, settings, inverse)
    found = distances(inverse, settings.rows)
    plane, offset = twins.disc(point, normal, np.zeros(3), settings.rows)
    covered = found < 3.99
    # Well inside the disc every cell is covered, well outside only the point's own.
    assert covered[offset < 0.8 * radius].all()
    assert covered[offset > 1.3 * radius].sum() <= 1
    inside = covered & (offset < radius)
    np.testing.assert_allclose(found[inside], plane[inside], rtol=0.02)


@given(seed=seeds)
@budget(max_examples=10, deadline=None)
def test_the_visibility_of_surfels_agrees_with_its_twin(seed):
    points, sizes, normals = cloud(seed)
    keep = np.abs((points * normals).sum(1)) > 0.3 * np.linalg.norm(points, axis=1)
    points, sizes, normals = points[keep], 0.5 * sizes[keep], normals[keep]
    points = points[np.linalg.norm(points, axis=1) < 3.9]
    sizes, normals = sizes[:len(points)], normals[:len(points)]
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    settings, view = PRESETS['fine'], SurfelView.empty(len(points))
    surfels = Surfels.of(points, normals, sizes)
    project_surfels(surfels, ALL, HERE, MODELS['omnidirectional'].lens, settings.rows, view)
    inverse = np.empty((settings.rows + 2) * (2 * settings.rows + 2), np.float32)
    splat_surfels(view, surfels.radius, ALL, 4.0, settings, inverse)
    seen = np.zeros(len(points), dtype=bool)
    visible_surfels(view, surfels.radius, ALL, np.arange(len(points)), settings, inverse, seen)
    expected = twins.visible_surfels(points, normals, sizes, np.zeros(3), settings,
                                     distances(inverse, settings.rows))
    assert (seen != expected).mean() <= 0.02


@given(seed=seeds, count=st.integers(1, 2000), reach=st.floats(0.1, 5.0))
@budget(max_examples=30, deadline=None)
def test_no_block_with_a_point_in_range_is_passed_over(seed, count, reach):
    points = cloud(seed, count)[0]
    order = spatial_order(points)
    assert np.array_equal(np.sort(order), np.arange(count))
    position = np.random.default_rng(seed).uniform(-4, 4, 3).astype(np.float32)
    found = blocks_in_range(block_bounds(points[order]), position, np.float32(reach))
    near = np.flatnonzero(np.linalg.norm(points[order] - position, axis=1) < reach - 1e-4)
    assert set(near // BLOCK) <= set(found)


def test_small_discs_fill_up_to_four_cells():
    settings = SurfelSettings(rows=64, base=0.0, share=0.0, single=0.5, quad=2.0)
    cell = np.pi / 64
    counts = []
    for size in (0.3, 0.9, 1.6):
        # Where four cells meet: each of the four has its centre half a cell away either way.
        point = 2.0 * np.array([[np.cos(1e-4), 0.0, np.sin(1e-4)]])
        radius, view = np.array([size * cell * 2.0], np.float32), SurfelView.empty(1)
        project_surfels(Surfels.of(point, point / 2.0, radius), ALL, HERE,
                        MODELS['omnidirectional'].lens, 64, view)
        inverse = np.empty(66 * 130, np.float32)
        splat_surfels(view, radius, ALL, 4.0, settings, inverse)
        counts.append(int((distances(inverse, 64) < 3.0).sum()))
    assert counts == [1, 4, 4]


@pytest.mark.parametrize('preset', ['fine', 'fast'])
def test_the_seam_of_a_surfel_map_is_no_edge(preset):
    """A wall across the seam hides what is behind it on both sides."""
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-1, 1, 0.05), np.arange(-1, 1, 0.05)))
    wall = np.stack([np.full_like(y, -2.0), y, z], axis=1)
    behind = np.array([[-3.0, a, 0.0] for a in np.linspace(-0.5, 0.5, 21)])
    points = np.concatenate([wall, behind]).astype(np.float32)
    normals = np.tile(np.array([1.0, 0, 0], np.float32), (len(points), 1))
    seen = look(points, np.full(len(points), 0.05, np.float32), normals, HERE,
                MODELS['omnidirectional'], preset)
    assert seen[:len(wall)].all() and not seen[len(wall):].any()


def test_the_azimuth_seam_is_no_edge():
    where = Projection(*(np.array([v], np.float32) for v in (1.0, 0.0, np.pi - 1e-3)))
    shadow = np.empty((32, 64), np.float32)
    splat(where, np.array([0.5], np.float32), 0.75, 4.0, shadow)
    row = shadow[16]
    assert row[0] == row[-1] == 1.0
    assert row[32] == 4.0
    covered_columns = np.flatnonzero(row == 1.0)
    assert len(covered_columns) == pytest.approx(0.75 / (np.pi / 32), abs=1.01)


@pytest.mark.parametrize('sign', [-1, 1])
def test_a_point_at_a_pole_covers_full_rows(sign):
    where = Projection.empty(1)
    points = np.array([[0.0, 0.0, sign * 2.0]], np.float32)
    project(points, HERE, MODELS['omnidirectional'].lens, where)
    shadow = np.empty((32, 64), np.float32)
    splat(where, np.array([0.4], np.float32), 1.0, 4.0, shadow)
    pole = shadow[-1] if sign > 0 else shadow[0]
    assert (pole == 2.0).all()
    assert (shadow[16] == 4.0).all()


@pytest.mark.parametrize('preset', PRESETS)
def test_degenerate_points_do_no_harm(preset):
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0], [9, 0, 0], [0, 0, 1]], 'f4')
    sizes = np.array([1.0, 0.0, 0.0, 50.0, 1.0, 0.1], np.float32)
    normals = np.array([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 0, 0]], 'f4')
    engine = visibility(points, sizes, normals, MODELS['omnidirectional'], preset)
    seen = np.zeros(len(points), dtype=bool)
    engine.look(HERE, seen)
    assert np.isfinite(engine.shadow_map()).all()
    # On the camera, twice in one place, as large as the room, out of range, without a normal.
    assert seen[[0, 1, 2, 3, 4]].tolist() == [False, True, True, True, False]


@pytest.mark.parametrize('preset', PRESETS)
@given(seed=seeds, more=st.floats(0.1, 4.0))
@budget(max_examples=15, deadline=None)
def test_what_is_visible_stays_visible_with_more_range(preset, seed, more):
    points, sizes, normals = cloud(seed)
    near, far = (look(points, sizes, normals, HERE, CameraModel(0.0, r), preset)
                 for r in (2.0, 2.0 + more))
    # Beyond the shorter range lies nothing that could hide anything nearer, but for discs that
    # reach across it.
    assert (near & ~far).mean() <= (0.0 if preset == 'paper' else 0.02)


@pytest.mark.parametrize('preset', PRESETS)
@given(seed=seeds)
@budget(max_examples=15, deadline=None)
def test_taking_occluders_away_hides_nothing(preset, seed):
    points, sizes, normals = cloud(seed)
    keep = np.random.default_rng(seed).random(len(points)) < 0.6
    before = look(points, sizes, normals, HERE, MODELS['omnidirectional'], preset)
    after = look(points[keep], sizes[keep], normals[keep], HERE, MODELS['omnidirectional'], preset)
    assert not (before[keep] & ~after).any()


@pytest.mark.parametrize('preset', PRESETS)
@given(seed=seeds, turns=st.integers(0, 127))
@budget(max_examples=15, deadline=None)
def test_turning_the_room_by_whole_cells_changes_next_to_nothing(preset, seed, turns):
    points, sizes, normals = cloud(seed, count=400)
    rotation = rotation_matrix(turns * 2 * np.pi / 128).astype(np.float32)
    one = look(points, sizes, normals, HERE, MODELS['omnidirectional'], preset)
    other = look(np.ascontiguousarray(points @ rotation.T), sizes,
                 np.ascontiguousarray(normals @ rotation.T), HERE, MODELS['omnidirectional'],
                 preset)
    # Rounding moves a few points and edges of footprints to the neighbouring cell; and where the
    # angle is no whole number of cells, each footprint falls on others.
    assert (one != other).mean() <= 0.04


@pytest.mark.parametrize('preset', PRESETS)
def test_frusta_that_tile_the_horizon_see_what_an_omnidirectional_camera_sees(preset):
    scene = generate_room(3, 6000)
    position = np.append(scene.bounds.mean(axis=0)[:2], 1.6)
    together = np.zeros(len(scene), dtype=bool)
    for k in range(4):
        pose = Pose(position, rotation_matrix(k * np.pi / 2))
        together |= look_at_scene(scene, pose, CameraModel(0.0, 4.0, np.pi / 2, np.pi), preset)
    whole = look_at_scene(scene, Pose(position, np.eye(3)), CameraModel(0.0, 4.0), preset)
    # An occluder on the seam belongs to one frustum and hides nothing from its neighbour.
    assert not (whole & ~together).any()
    assert (together & ~whole).mean() < 0.01


def test_rotation_matrix_points_the_camera():
    forward = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(rotation_matrix(np.pi / 2) @ forward, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(0, np.pi / 2) @ forward, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(0.3, 0.2, 0.1) @ rotation_matrix(0.3, 0.2, 0.1).T,
                               np.eye(3), atol=1e-12)


@pytest.mark.parametrize('arguments', [
    (-1.0, 4.0), (4.0, 4.0), (0.0, np.inf), (0.0, 4.0, 0.0), (0.0, 4.0, 7.0),
    (0.0, 4.0, 1.0, 4.0)])
def test_a_camera_that_makes_no_sense_is_refused(arguments):
    with pytest.raises(ValueError, match='camera .*found .*expected'):
        CameraModel(*arguments)


@pytest.mark.parametrize(('preset', 'least'), [('fine', 0.955), ('fast', 0.93), ('paper', 0.75)])
def test_visibility_agrees_with_ray_casting(preset, least):
    right = wrong = missed = 0
    for seed in range(3):
        scene = generate_room(seed, 15000)
        for position in free_places(scene, 1.9, 2, np.random.default_rng(seed)):
            truth = RayCaster(scene.mesh).visible(scene.points, position, 6.0)
            seen = look_at_scene(scene, Pose(position, np.eye(3)), CameraModel(0.0, 6.0), preset)
            right += (seen & truth).sum()
            wrong += (seen & ~truth).sum()
            missed += (~seen & truth).sum()
    assert 2 * right / (2 * right + wrong + missed) >= least


@pytest.mark.parametrize('preset', PRESETS)
def test_a_place_in_the_air_is_covered_unless_something_is_in_front(preset):
    scene = generate_room(4, 12000)
    camera = free_places(scene, 1.9, 1, np.random.default_rng(1))[0]
    places, _ = coverage_grid(scene.bounds, 0.5)
    sizes = scene.spacing if preset == 'paper' else scene.pitch
    engine = visibility(scene.points, sizes, scene.normals_or_estimate, CameraModel(0.0, 6.0),
                        preset, places)
    covered = np.zeros(len(places), dtype=bool)
    engine.look(Pose(camera, np.eye(3)), np.zeros(len(scene), dtype=bool))
    engine.cover(Pose(camera, np.eye(3)), covered)
    truth = RayCaster(scene.mesh).visible(places, camera, 6.0)
    assert (covered == truth).mean() > 0.95


def test_the_coverage_grid_fills_the_box():
    bounds = np.array([[-1.0, 0.0, 2.0], [2.3, 1.1, 4.0]])
    centres, volume = coverage_grid(bounds, 0.25)
    assert len(centres) == 13 * 4 * 8
    assert len(centres) * volume == pytest.approx(3.3 * 1.1 * 2.0)
    assert (centres > bounds[0]).all() and (centres < bounds[1]).all()
    assert space_coverage(np.ones(len(centres), bool), volume) == pytest.approx(3.3 * 1.1 * 2.0)
    with pytest.raises(ValueError, match='coverage cell'):
        coverage_grid(bounds, 0.0)
    with pytest.raises(ValueError, match='use larger cells'):
        coverage_grid(1000.0 * bounds, 0.25)


def test_viewpoints_are_where_the_paper_puts_them():
    found = viewpoints(np.array([[0.0, 0.0, 0.0], [6.0, 12.0, 3.0]]))
    assert found.tolist() == [[3, 6, 1.5], [1, 2, 1.5], [1, 10, 1.5], [5, 2, 1.5], [5, 10, 1.5]]


@pytest.fixture(scope='module')
def small():
    """Return a small room and its depth error at a low resolution."""
    scene = generate_room(2, 1500)
    return scene, DepthError(scene.points, scene.spacing, scene.bounds, 24, 0.75)


@given(seed=seeds, share=st.floats(0.0, 1.0))
@budget(max_examples=8, deadline=None)
def test_depth_error_agrees_with_its_twin(small, seed, share):
    scene, error = small
    seen = np.random.default_rng(seed).random(len(scene)) < share
    expected = twins.depth_error(scene.points, 0.75 * scene.spacing, error.viewpoints, error.far,
                                 24, seen)
    assert error(seen) == pytest.approx(expected, rel=2e-3, abs=2e-3)


@given(seed=seeds, share=st.floats(0.0, 1.0))
@budget(max_examples=30, deadline=None)
def test_depth_error_falls_or_stays_when_more_is_seen(small, seed, share):
    scene, error = small
    rng = np.random.default_rng(seed)
    some = rng.random(len(scene)) < share
    more = some | (rng.random(len(scene)) < 0.2)
    assert 0.0 <= error(more) <= error(some) <= error.worst


def test_depth_maps_agree_with_ray_casting():
    scene = generate_room(0, 15000)
    engine = Simulator(scene, SimulationConfig()).depth_error
    caster = RayCaster(scene.mesh)
    rays = twins.directions(engine.shape[0]).reshape(-1, 3)
    off = [np.abs(engine.depth_map(k).ravel() - caster.distance(engine.viewpoints[k], rays)).mean()
           for k in range(5)]
    # Cubes reach a little beyond what they stand for; holes would cost metres.
    assert sum(off) < 0.6
    assert (engine.depth_map(0) == np.float32(engine.far)).mean() < 0.01


def test_depth_error_is_zero_when_all_is_seen(small):
    scene, error = small
    assert error(np.ones(len(scene), dtype=bool)) == 0.0
    assert error.worst > 1.0
    assert error.depth_map(0).shape == (24, 48)


@given(count=st.integers(1, 3000), wanted=st.integers(1, 600))
@budget(max_examples=40, deadline=None)
def test_a_cloud_of_fixed_size_is_spread_over_the_whole(count, wanted):
    points = np.arange(count * 3, dtype=np.float32).reshape(-1, 3)
    taken = fixed_size(points, wanted)
    rows = (taken[:, 0] / 3).astype(int)
    assert taken.shape == (wanted, 3) and rows[0] == 0
    assert np.all(np.diff(rows) >= 0) and np.all(np.diff(rows) <= -(-count // wanted))
    if wanted <= count:
        assert len(np.unique(rows)) == wanted


def test_normals_are_sharp_at_edges():
    """On two faces of a box every point but a few has the normal of its own face."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0.0, 2.0, (2, 3000))
    floor = np.stack([u[:1500], v[:1500], np.zeros(1500)], axis=1)
    wall = np.stack([np.zeros(1500), u[1500:], v[1500:]], axis=1)
    scene = Scene(np.concatenate([floor, wall]))
    normals = np.abs(scene.normals_or_estimate)
    assert (normals[:1500, 2] > 0.98).mean() > 0.97
    assert (normals[1500:, 0] > 0.98).mean() > 0.97


def test_an_isolated_point_hides_no_wall():
    room = generate_room(5, 8000)
    stray = room.bounds.mean(axis=0)[None].astype(np.float32)
    scene = Scene(np.concatenate([room.points, stray]))
    assert scene.pitch[-1] <= 4.0 * np.median(scene.pitch) < 1.0


@pytest.mark.parametrize(('preset', 'leak'), [('fine', 0.02), ('fast', 0.05)])
def test_a_camera_inside_a_pillar_sees_its_inside_alone(preset, leak):
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(-0.3, 0.3, 0.02),
                                                 np.arange(0.0, 3.0, 0.02)))
    faces = [np.stack([np.full_like(u, s), u, v], 1) for s in (-0.3, 0.3)]
    faces += [np.stack([u, np.full_like(u, s), v], 1) for s in (-0.3, 0.3)]
    far = np.random.default_rng(0).uniform([2, -3, 0.2], [3, 3, 2.8], (500, 3))
    scene = Scene(np.concatenate([*faces, far]).astype(np.float32))
    seen = look_at_scene(scene, Pose(np.array([0.0, 0.0, 1.5]), np.eye(3)),
                         CameraModel(0.0, 4.0), preset)
    assert seen[:len(seen) - 500].mean() > 0.9
    assert seen[-500:].mean() < leak


def test_the_pitch_is_that_of_a_grid():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 4, 0.1), np.arange(0, 4, 0.1)))
    scene = Scene(np.stack([x, y, 0.05 * np.sin(x)], axis=1))
    assert np.median(scene.pitch) == pytest.approx(0.1, rel=0.4)
    assert np.median(scene.spacing) == pytest.approx(0.1, rel=0.02)


def test_an_isolated_scene_needs_no_normals():
    points, _, _ = cloud(1, 300)
    scene = Scene(points)
    assert scene.normals is None
    assert np.allclose(np.linalg.norm(scene.normals_or_estimate, axis=1), 1.0, atol=1e-5)
