# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scans that are fused of a depth camera's frames, and what is seen in them."""

from conftest import made_room
import numpy as np
import pytest

from benchmarks.engine_bench import agreement, confusion, free_places
from benchmarks.fused_bench import LENS, looks, view_of
from benchmarks.fused_scan import (
    CAMERA,
    exact_depth,
    FOCAL,
    fuse,
    hand_held_path,
    HEIGHT,
    measured,
    NOISE,
    pixel_rays,
    scan_by_hand,
    WIDTH,
)
from ocp_ros.geometry.cameras import CameraModel, LEVEL, Pose, rotation_matrix
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.geometry.visibility import PRESETS, SurfelVisibility
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.ray_casting import RayCaster
from ocp_ros.scenes.scene import Mesh, Scene
from ocp_ros.scenes.synthetic.generator import mesh_of, plan_of

NOWHERE = np.empty((0, 3), np.float32)


def wall(distance):
    """Return a wall of 8 x 8 m across the x axis."""
    corners = [[distance, y, z] for y in (-4.0, 4.0) for z in (-4.0, 4.0)]
    return Mesh(np.array(corners, np.float32), np.array([[0, 1, 2], [1, 3, 2]], np.int32))


def test_a_frame_holds_the_depth_of_the_mesh():
    scene, pose = made_room(8, 2000), Pose(np.array([4.0, 4.0, 1.6]), rotation_matrix(0.7, 0.2))
    depth = exact_depth(MeshRays(scene.mesh), pose, pixel_rays())
    assert depth.shape == (HEIGHT, WIDTH)
    unit = pixel_rays() / np.linalg.norm(pixel_rays(), axis=-1, keepdims=True)
    distance = RayCaster(scene.mesh).distance(pose.position, unit @ pose.rotation.T)
    np.testing.assert_allclose(depth, distance * unit[..., 0], rtol=1e-4)
    # The depth of a wall that faces the camera is the same in the corners of the image.
    level = exact_depth(MeshRays(wall(2.0)), Pose(np.zeros(3), LEVEL), pixel_rays())
    np.testing.assert_allclose(level, 2.0, rtol=1e-6)


def test_the_first_pixel_is_the_upper_left_one():
    first, last = pixel_rays()[0, 0], pixel_rays()[-1, -1]
    assert first[1] > 0.0 and first[2] > 0.0 and np.allclose(first[1:], -last[1:])
    assert first[1] == pytest.approx(LENS.half_horizontal - 0.5 / FOCAL)


@pytest.mark.parametrize('distance', [1.0, 2.0, 4.0])
def test_noise_and_steps_grow_with_the_square_of_the_depth(distance):
    exact = np.full((HEIGHT, WIDTH), distance, np.float32)
    found = measured(exact, np.random.default_rng(0))
    # A step of 2 s rounds with an error of 2 s / sqrt(12) in addition.
    spread = NOISE * distance ** 2 * np.sqrt(1.0 + 4.0 / 12.0)
    assert found.std() == pytest.approx(spread, rel=0.15)
    assert found.mean() == pytest.approx(distance, abs=spread)
    assert len(np.unique(found)) < 20


def test_what_is_out_of_range_is_not_measured():
    depth = np.array([[0.1, CAMERA.min_range, 1.0, CAMERA.max_range, 5.0, np.inf]], np.float32)
    found = measured(depth, np.random.default_rng(0)) > 0.0
    assert found[0, 2] and not found[0, [0, 4, 5]].any()


def test_frames_of_a_wall_fuse_to_the_wall():
    """Without noise, seen from places beside each other: the image is not mirrored or shifted."""
    frames, rays = [], MeshRays(wall(2.0))
    for across in (-0.3, 0.0, 0.3, 0.5):
        pose = Pose(np.array([0.0, across, 0.1]), rotation_matrix(0.2, 0.1, 0.05))
        frames.append((exact_depth(rays, pose, pixel_rays()), pose))
    scan = fuse(frames)
    assert len(scan.points) > 1000 and np.abs(scan.points[:, 0] - 2.0).max() < 0.02
    assert scan.points[:, 1].mean() > 0.3 and scan.mesh.triangles.max() < len(scan.points)


def test_a_floor_fuses_where_it_is():
    """Half a pixel would shift what is seen at a slant by a centimetre."""
    corners = np.array([[x, y, 0.0] for x in (-1.0, 8.0) for y in (-6.0, 6.0)], np.float32)
    rays = MeshRays(Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]], np.int32)))
    frames = []
    for across in (-0.2, 0.0, 0.2, 0.4):
        pose = Pose(np.array([0.0, across, 1.5]), rotation_matrix(0.1 * across, 0.5))
        frames.append((exact_depth(rays, pose, pixel_rays()), pose))
    assert abs(np.median(fuse(frames).points[:, 2])) < 0.004


def test_frames_that_do_not_overlap_are_refused():
    pose = Pose(np.zeros(3), LEVEL)
    frame = exact_depth(MeshRays(wall(2.0)), pose, pixel_rays())
    with pytest.raises(ValueError, match='expected frames that overlap'):
        fuse([(frame, pose)] * 2)


def test_the_same_seed_gives_the_same_scan_and_the_room_is_in_it():
    one, other = scan_by_hand(503, 24), scan_by_hand(503, 24)
    assert np.array_equal(one.points, other.points)
    assert np.array_equal(one.mesh.vertices, other.mesh.vertices)
    size = plan_of(503).size
    assert (one.points > -0.3).all() and (one.points < size + 0.3).all()
    thin = one.thinned(3000)
    assert 2000 < len(thin) <= 3000


def test_a_path_stays_in_the_air_of_the_room():
    plan = plan_of(503)
    poses = list(hand_held_path(plan, 60, np.random.default_rng(0)))
    places = np.array([pose.position for pose in poses])
    assert len(poses) > 20 and (places[:, :2] > 0.2).all()
    assert (places[:, :2] < plan.size[:2] - 0.2).all()
    assert places[:, 2].min() >= 1.4 and places[:, 2].max() <= 1.7
    headings = np.arctan2(*np.array([pose.rotation[1::-1, 0] for pose in poses]).T)
    assert np.histogram(headings, 4, (-np.pi, np.pi))[0].min() > 0


def test_a_frame_sees_what_no_surface_hides():
    points = np.array([[2.02, 0.0, 0.0], [2.2, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.9, 0.0],
                       [-1.0, 0.0, 0.0], [0.1, 0.0, 0.0], [1.9, 0.5, 0.5]], np.float32)
    view = view_of(points, MeshRays(wall(2.0)), Pose(np.zeros(3), LEVEL))
    assert view.within.tolist() == [True, True, True, False, False, False, True]
    assert view.truth.tolist() == [True, False, True, False, False, False, True]


def f1_of_fast(scenes, position):
    """Return F1 of ``fast`` in versions of one room, against ray casting."""
    scores = []
    for scene in scenes:
        engine = SurfelVisibility(scene.points, scene.normals_or_estimate, scene.pitch, NOWHERE,
                                  PRESETS['fast'])
        seen = Subset.none(engine.order)
        engine.look(Pose.of(position), CameraModel(0.0, 6.0).lens, seen.bits)
        truth = RayCaster(scene.mesh).visible(scene.points, position, 6.0)
        scores.append(confusion(seen.mask, truth))
    return np.array(scores)


def test_fast_does_not_get_worse_with_more_points():
    total = np.zeros((3, 3))
    for seed in (509, 517):
        scenes = [made_room(seed, points) for points in (10_000, 25_000, 60_000)]
        for position in free_places(scenes[0], 1.9, 2, np.random.default_rng(seed)):
            total += f1_of_fast(scenes, position)
    few, more, many = (agreement(counts)['f1'] for counts in total)
    assert more > few - 0.003 and many > more - 0.003


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
        visibility.by(settings).look(Pose(np.zeros(3), LEVEL), CameraModel(0.0, 6.0).lens,
                                     seen.bits)
        shares.append(seen.mask.mean())
    assert shares[0] > 0.9 and shares[0] > shares[1] + 0.05


@pytest.mark.system
def test_the_density_of_a_fused_scan_does_not_harm_fast():
    scan, plan = scan_by_hand(503, 160), plan_of(503)
    rays = MeshRays(mesh_of(plan))
    poses = list(hand_held_path(plan, 8, np.random.default_rng([503, 3])))
    scores = []
    for most in (10_000, 30_000, 90_000):
        scene = scan.thinned(most)
        look = looks(scene)['fast']
        views = [view_of(scene.points, rays, pose) for pose in poses]
        scores.append(agreement(sum(confusion(look(view.pose) & view.within, view.truth)
                                    for view in views))['f1'])
    assert scores[1] > scores[0] - 0.005 and scores[2] > scores[1] - 0.005
