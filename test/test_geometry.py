# SPDX-License-Identifier: Apache-2.0
"""The engine: kernels against their NumPy twins, ray casting, and properties that must hold."""

from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
import pytest
import twins

from ocp_ros.benchmark.truth import ray_cast
from ocp_ros.geometry import shadow_maps
from ocp_ros.geometry.cameras import CameraModel, rotation_matrix
from ocp_ros.geometry.clouds import fixed_size
from ocp_ros.geometry.coverage import coverage_grid, space_coverage
from ocp_ros.geometry.depth_error import DepthError, viewpoints
from ocp_ros.geometry.shadow_maps import DEFAULT, PAPER, Pose, project, Projection, splat, visible
from ocp_ros.scenes.rooms import generate_room
from ocp_ros.scenes.scene import Scene

NO_NORMALS = np.empty((0, 3), np.float32)
MODELS = {
    'omnidirectional': CameraModel(0.0, 4.0),
    'pinhole': CameraModel(0.3, 5.0, np.deg2rad(87), np.deg2rad(58)),
    'lidar': CameraModel(0.5, 6.0, 2 * np.pi, np.deg2rad(30)),
}
seeds = st.integers(0, 2 ** 32 - 1)


def cloud(seed, count=120, size=6.0):
    """Return random points, spacing and unit normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-size / 2, size / 2, (count, 3)).astype(np.float32)
    spacing = rng.uniform(0.0, 0.4, count).astype(np.float32)
    normals = rng.normal(size=(count, 3))
    return points, spacing, (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype('f4')


def look(points, spacing, normals, pose, model, settings):
    """Run the three kernels; return projection, shadow map and visible flags."""
    seen, where = np.zeros(len(points), dtype=bool), Projection.empty(len(points))
    shadow = np.empty((settings.rows, 2 * settings.rows), np.float32)
    project(points, normals, pose, model.lens, where)
    splat(where, spacing, settings.cube_scale, model.max_range, shadow)
    visible(where, spacing, settings, shadow, seen)
    return where, shadow, seen


@pytest.mark.parametrize('model', MODELS.values(), ids=MODELS)
@given(seed=seeds)
@budget(max_examples=15, deadline=None)
def test_project_agrees_with_its_twin(model, seed):
    points, _, normals = cloud(seed)
    rng = np.random.default_rng(seed)
    pose = Pose(rng.uniform(-1, 1, 3), rotation_matrix(*rng.uniform(-3, 3, 3)))
    where = Projection.empty(len(points))
    project(points, normals, pose, model.lens, where)
    distance, elevation, azimuth, cosine = twins.project(points, normals, *pose, model)
    assert np.array_equal(np.isfinite(where.distance), np.isfinite(distance))
    measured = np.isfinite(distance)
    np.testing.assert_allclose(where.distance[measured], distance[measured], rtol=1e-5)
    np.testing.assert_allclose(where.elevation, elevation, atol=1e-5)
    np.testing.assert_allclose(where.azimuth, azimuth, atol=1e-5)
    np.testing.assert_allclose(where.cosine[measured], cosine[measured], atol=1e-4)


@pytest.mark.parametrize('settings', [DEFAULT, PAPER], ids=['default', 'paper'])
@given(seed=seeds)
@budget(max_examples=10, deadline=None)
def test_splat_and_visibility_agree_with_their_twins(settings, seed):
    settings = settings._replace(rows=32)
    points, spacing, normals = cloud(seed)
    pose, model = Pose(np.zeros(3), np.eye(3)), MODELS['omnidirectional']
    where, shadow, seen = look(points, spacing, normals, pose, model, settings)
    # The twins get the kernel's own single-precision directions, so that cells agree exactly.
    parts = [np.asarray(part, dtype=np.float64) for part in where]
    half_sides = np.float64(settings.cube_scale) * spacing
    expected = twins.shadow_map(*parts[:3], half_sides, settings.rows, model.max_range)
    differs = ~np.isclose(shadow, expected, rtol=1e-6)
    # A cell whose centre lies on the rectangle's edge may fall to either side.
    assert differs.mean() < 2e-3
    twin = twins.visible(*parts, spacing, settings, shadow)
    assert np.array_equal(seen, twin)


def test_the_azimuth_seam_is_no_edge():
    settings = DEFAULT._replace(rows=32)
    where = Projection(*(np.array([v], np.float32) for v in (1.0, 0.0, np.pi - 1e-3, 1.0)))
    shadow = np.empty((32, 64), np.float32)
    splat(where, np.array([0.5], np.float32), settings.cube_scale, 4.0, shadow)
    row = shadow[16]
    assert row[0] == row[-1] == 1.0
    assert row[32] == 4.0
    covered_columns = np.flatnonzero(row == 1.0)
    assert len(covered_columns) == pytest.approx(0.75 / (np.pi / 32), abs=1.01)


@pytest.mark.parametrize('sign', [-1, 1])
def test_a_point_at_a_pole_covers_full_rows(sign):
    where = Projection.empty(1)
    points = np.array([[0.0, 0.0, sign * 2.0]], np.float32)
    pose = Pose(np.zeros(3), np.eye(3))
    project(points, NO_NORMALS, pose, MODELS['omnidirectional'].lens, where)
    shadow = np.empty((32, 64), np.float32)
    splat(where, np.array([0.4], np.float32), 1.0, 4.0, shadow)
    pole = shadow[-1] if sign > 0 else shadow[0]
    assert (pole == 2.0).all()
    assert (shadow[16] == 4.0).all()


def test_degenerate_points_do_no_harm():
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0], [9, 0, 0]], np.float32)
    spacing = np.array([1.0, 0.0, 0.0, 50.0, 1.0], np.float32)
    pose = Pose(np.zeros(3), np.eye(3))
    _, shadow, seen = look(points, spacing, NO_NORMALS, pose, MODELS['omnidirectional'], DEFAULT)
    assert np.isfinite(shadow).all()
    assert seen.tolist() == [False, True, True, True, False]


@given(seed=seeds, more=st.floats(0.1, 4.0))
@budget(max_examples=20, deadline=None)
def test_what_is_visible_stays_visible_with_more_range(seed, more):
    points, spacing, normals = cloud(seed)
    pose = Pose(np.zeros(3), np.eye(3))
    near, far = (look(points, spacing, normals, pose, CameraModel(0.0, r), DEFAULT)[2]
                 for r in (2.0, 2.0 + more))
    assert not (near & ~far).any()


@given(seed=seeds)
@budget(max_examples=20, deadline=None)
def test_taking_occluders_away_hides_nothing(seed):
    points, spacing, normals = cloud(seed)
    keep = np.random.default_rng(seed).random(len(points)) < 0.6
    pose, model = Pose(np.zeros(3), np.eye(3)), MODELS['omnidirectional']
    before = look(points, spacing, normals, pose, model, DEFAULT)[2]
    after = look(points[keep], spacing[keep], normals[keep], pose, model, DEFAULT)[2]
    assert not (before[keep] & ~after).any()


@given(seed=seeds, turns=st.integers(0, 511))
@budget(max_examples=20, deadline=None)
def test_turning_the_room_by_whole_cells_changes_next_to_nothing(seed, turns):
    points, spacing, normals = cloud(seed, count=400)
    angle = turns * 2 * np.pi / 512
    rotation = rotation_matrix(angle).astype(np.float32)
    settings, model = DEFAULT._replace(rows=256), MODELS['omnidirectional']
    pose = Pose(np.zeros(3), np.eye(3))
    one = look(points, spacing, normals, pose, model, settings)[2]
    other = look(np.ascontiguousarray(points @ rotation.T), spacing,
                 np.ascontiguousarray(normals @ rotation.T), pose, model, settings)[2]
    # Rounding moves a few points and edges of rectangles to the neighbouring cell.
    assert (one != other).mean() <= 0.01


def test_frusta_that_tile_the_horizon_see_what_an_omnidirectional_camera_sees():
    scene = generate_room(3, 6000)
    position = np.append(scene.bounds.mean(axis=0)[:2], 1.6)
    settings, wide = DEFAULT, CameraModel(0.0, 4.0)
    together = np.zeros(len(scene), dtype=bool)
    quarter = CameraModel(0.0, 4.0, np.pi / 2, np.pi)
    for k in range(4):
        pose = Pose(position, rotation_matrix(k * np.pi / 2))
        together |= look(scene.points, scene.spacing, scene.normals_or_estimate, pose, quarter,
                         settings)[2]
    whole = look(scene.points, scene.spacing, scene.normals_or_estimate,
                 Pose(position, np.eye(3)), wide, settings)[2]
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


@pytest.mark.parametrize(('preset', 'least'), [(DEFAULT, 0.91), (PAPER, 0.77)],
                         ids=['default', 'paper'])
def test_visibility_agrees_with_ray_casting(preset, least):
    pytest.importorskip('open3d', reason='ray casting needs open3d')
    right = wrong = missed = 0
    for seed in range(3):
        scene = generate_room(seed, 15000)
        rng = np.random.default_rng(seed)
        for _ in range(2):
            position = np.append(rng.uniform(scene.bounds[0, :2] + 0.5, scene.bounds[1, :2] - 0.5),
                                 1.9)
            truth = ray_cast(scene.mesh, scene.points, position, 6.0)
            seen = look(scene.points, scene.spacing, scene.normals_or_estimate,
                        Pose(position, np.eye(3)), CameraModel(0.0, 6.0), preset)[2]
            right += (seen & truth).sum()
            wrong += (seen & ~truth).sum()
            missed += (~seen & truth).sum()
    assert 2 * right / (2 * right + wrong + missed) >= least


def test_the_coverage_grid_fills_the_box():
    bounds = np.array([[-1.0, 0.0, 2.0], [2.3, 1.1, 4.0]])
    centres, volume = coverage_grid(bounds, 0.25)
    assert len(centres) == 13 * 4 * 8
    assert len(centres) * volume == pytest.approx(3.3 * 1.1 * 2.0)
    assert (centres > bounds[0]).all() and (centres < bounds[1]).all()
    assert space_coverage(np.ones(len(centres), bool), volume) == pytest.approx(3.3 * 1.1 * 2.0)
    with pytest.raises(ValueError, match='coverage cell'):
        coverage_grid(bounds, 0.0)


def test_viewpoints_are_where_the_paper_puts_them():
    found = viewpoints(np.array([[0.0, 0.0, 0.0], [6.0, 12.0, 3.0]]))
    assert found.tolist() == [[3, 6, 1.5], [1, 2, 1.5], [1, 10, 1.5], [5, 2, 1.5], [5, 10, 1.5]]


@pytest.fixture(scope='module')
def small():
    """Return a small room and its depth error at a low resolution."""
    scene = generate_room(2, 1500)
    settings = DEFAULT._replace(rows=24)
    return scene, settings, DepthError(scene.points, scene.spacing, scene.bounds, settings)


@given(seed=seeds, share=st.floats(0.0, 1.0))
@budget(max_examples=8, deadline=None)
def test_depth_error_agrees_with_its_twin(small, seed, share):
    scene, settings, error = small
    seen = np.random.default_rng(seed).random(len(scene)) < share
    expected = twins.depth_error(scene.points, scene.spacing, error.viewpoints, error.far,
                                 settings, seen)
    assert error(seen) == pytest.approx(expected, rel=2e-3, abs=2e-3)


@given(seed=seeds, share=st.floats(0.0, 1.0))
@budget(max_examples=30, deadline=None)
def test_depth_error_falls_or_stays_when_more_is_seen(small, seed, share):
    scene, _, error = small
    rng = np.random.default_rng(seed)
    some = rng.random(len(scene)) < share
    more = some | (rng.random(len(scene)) < 0.2)
    assert 0.0 <= error(more) <= error(some) <= error.worst


def test_depth_error_is_zero_when_all_is_seen(small):
    scene, _, error = small
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


def test_every_preset_is_selectable():
    assert shadow_maps.PRESETS['paper'].slope == 0.0
    assert set(shadow_maps.PRESETS) == {'default', 'paper'}


def test_an_isolated_scene_needs_no_normals():
    points, _, _ = cloud(1, 300)
    scene = Scene(points)
    assert scene.normals is None
    assert np.allclose(np.linalg.norm(scene.normals_or_estimate, axis=1), 1.0, atol=1e-5)
