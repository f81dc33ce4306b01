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

"""Kernels of geometry: cameras, points, packed bits, coverage, normals and the depth error."""

from conftest import for_any, made_room
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, Pose, rotation_matrix
from ocp_ros.geometry.clouds import fixed_size
from ocp_ros.geometry.coverage import coverable_cell, coverage_grid, space_coverage
from ocp_ros.geometry.depth_error import DepthError, five_viewpoints, MAX_HALF_SIDE
from ocp_ros.geometry.engine_config import EngineConfig
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
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.simulation.viewpoints import paper_viewpoints
import pytest
from scipy.spatial import cKDTree
import twins
from twins import MODELS

seeds = st.integers(0, 2 ** 32 - 1)


@pytest.mark.parametrize('name', SENSORS)
def test_a_sensor_sees_its_field_of_view_and_names_its_source(name):
    sensor = SENSORS[name]
    model = sensor.model
    assert len(sensor.source) > 20 and sensor.title
    # Directions just inside and just outside each edge, as the twin of the kernels judges them.
    middle = 0.5 * (model.min_range + model.max_range)
    for sign, inside in ((0.98, True), (1.02, False)):
        azimuth, elevation = sign * model.horizontal_fov / 2, sign * model.vertical_fov / 2
        rays = np.array([[np.cos(azimuth), np.sin(azimuth), 0.0],
                         [np.cos(elevation), 0.0, np.sin(elevation)]])[azimuth > np.pi:]
        distance, _, _ = twins.project(middle * rays, np.zeros(3), np.eye(3), model)
        assert (np.isfinite(distance) == inside).all()


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
    distance, _, _ = twins.project(points, *pose, model)
    # Single precision may round a point out of the very edge of its block.
    inside = np.isfinite(distance) & (distance < model.max_range - 1e-4)
    assert set(np.flatnonzero(inside) // POINTS_PER_BLOCK) <= set(found.tolist())


def test_a_narrow_camera_passes_over_most_blocks():
    points = np.random.default_rng(0).uniform(-4, 4, (50000, 3)).astype(np.float32)
    points = points[spatial_order(points)]
    seen = blocks_seen(points, 0.0, Pose.of(np.zeros(3)), SENSORS['realsense_d435'].model)
    assert 0 < len(seen) < 0.5 * len(points) / POINTS_PER_BLOCK


@for_any(60, flags=st.lists(st.booleans(), max_size=700))
def test_packed_bits_are_the_flags(flags):
    flags = np.array(flags, dtype=bool)
    words = pack(flags)
    assert len(words) * 64 % POINTS_PER_BLOCK == 0
    assert np.array_equal(unpack(words, len(flags)), flags)
    assert count_bits(words) == flags.sum()


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
    assert len(centres) * volume == pytest.approx(3.3 * 1.1 * 2.0)
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
    found, expected = edge_aware_normals(room.points, near), twins.edge_aware_normals(
        room.points, near)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-5)
    # The same planes; where two fit equally well, rounding may take the other.
    assert np.mean(np.abs((found * expected).sum(axis=1)) > 0.9999) > 0.995


#: Sides of cubes, in multiples of what they are in the engine.
SHARE = 0.75
#: Sums of single-precision depths, metres.
ROUNDING = 1e-5


@pytest.fixture(scope='module')
def small():
    """Return a small room and its depth error at a low resolution."""
    scene = made_room(2, 600)
    return scene, DepthError(scene.points, SHARE * scene.spacing, scene.diameter,
                             paper_viewpoints(scene), 24)


def drawn(scene, seed, *shares):
    """Return which points are seen, for shares of them: (N,) bool each."""
    rng = np.random.default_rng(seed)
    return [rng.random(len(scene)) < share for share in shares]


@for_any(5, seed=seeds, share=st.floats(0.0, 1.0))
def test_depth_error_agrees_with_its_twin(small, seed, share):
    scene, error = small
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


@for_any(15, seed=seeds, share=st.floats(0.0, 1.0))
def test_depth_error_falls_or_stays_when_more_is_seen(small, seed, share):
    scene, error = small
    some, others = drawn(scene, seed, share, 0.2)
    assert 0.0 <= error(pack(some | others)) <= error(pack(some)) + ROUNDING
    assert error(pack(some)) <= error.worst + ROUNDING
    assert error(pack(np.ones(len(scene), dtype=bool))) == 0.0
    assert error.worst == error(no_bits(len(scene))) > 1.0


@for_any(8, seed=seeds, share=st.floats(0.0, 1.0), more=st.floats(0.0, 1.0))
def test_what_is_settled_may_be_left_out(small, seed, share, more):
    scene, error = small
    seen, *views = map(pack, drawn(scene, seed, share, more, 0.1, 0.0))
    expected = [error(seen | view) for view in views]
    given_seen = error.given(seen)
    assert [given_seen(view) for view in views] == pytest.approx(expected, abs=ROUNDING)


def test_viewpoints_are_where_the_paper_puts_them():
    found = five_viewpoints(np.array([[0, 0], [0, 12], [6, 0], [6, 12]]), 1.5)
    assert found.tolist() == [[3, 6, 1.5], [1, 2, 1.5], [1, 10, 1.5], [5, 2, 1.5], [5, 10, 1.5]]


def test_depth_maps_agree_with_ray_casting():
    scene = generate_room(12, 15000, scanned=False)
    engine = Simulator(scene, SimulationConfig()).depth_error
    caster = MeshRays(scene.mesh)
    rays = twins.directions(engine.shape[0]).reshape(-1, 3)
    off = [np.abs(engine.depth_map(k).ravel() - caster.lengths(engine.viewpoints[k], rays)).mean()
           for k in range(5)]
    # Cubes reach a little beyond what they stand for; holes would cost metres.
    assert sum(off) < 0.8
    assert (engine.depth_map(0) == np.float32(engine.far)).mean() < 0.03


def test_a_room_that_turns_with_its_cameras_is_worth_the_same():
    """By quarters, so that the bounding box and its cells turn as well."""
    scene, config = made_room(5, 10_000), SimulationConfig(engine=EngineConfig(error_rows=64))
    placement = np.random.default_rng(0).uniform(*scene.bounds, (3, 3))
    one = Simulator(scene, config).evaluate(placement)
    for quarters in (1, 2, 3):
        turn = rotation_matrix(quarters * np.pi / 2)
        turned = Scene((scene.points @ turn.T).astype(np.float32),
                       normals=(scene.normals_or_estimate @ turn.T).astype(np.float32))
        other = Simulator(turned, config).evaluate(placement @ turn.T)
        assert (one.seen.mask != other.seen.mask).mean() <= 0.002
        assert other.depth_error == pytest.approx(one.depth_error, rel=0.02)
        assert other.space_coverage == pytest.approx(one.space_coverage, rel=0.02)
