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

"""Generated rooms: furnished like offices, scanned like rooms, and the same for the same seed."""

import os
import subprocess
import sys

from conftest import for_any, made_room, refused
from hypothesis import strategies
from matplotlib.image import imread
import numpy as np
from ocp_ros.cli import main as cli
from ocp_ros.geometry.depth_error import DepthError
from ocp_ros.rooms import generator
from ocp_ros.rooms.furniture import make_solid, moved_piece, SOLID_KINDS
from ocp_ros.rooms.generator import generate_room, mesh_of
from ocp_ros.rooms.room_kinds import draw_plan, ROOM_KINDS
from ocp_ros.rooms.room_plan import mirrored_plan, RoomPlan
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.simulation.viewpoints import viewpoints_of
from plyfile import PlyData
import pytest

SEEDS = strategies.integers(0, 1 << 31)


def plan_of(seed):
    return draw_plan(np.random.default_rng(seed))


def depth_in(points, part):
    """Return how deep points (N, 3) are inside a solid, metres; negative outside."""
    c, s = np.cos(part.yaw), np.sin(part.yaw)
    local = (points - part.centre) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return (0.5 * part.size - np.abs(local)).min(axis=1)


def box_plan(*solids, size=(6.0, 5.0, 3.0)):
    return RoomPlan('office', np.array(size), np.random.default_rng(0), list(solids))


def test_the_same_seed_gives_the_same_room_with_however_many_points():
    first, again, more = made_room(5, 3000), generate_room(5, 3000), generate_room(5, 8000)
    np.testing.assert_array_equal(first.points, again.points)
    for other in (again, more):
        np.testing.assert_array_equal(first.mesh.corners, other.mesh.corners)
    assert len(first) < len(more)


def test_other_seeds_give_other_rooms_of_all_kinds():
    plans = [plan_of(seed) for seed in range(40)]
    assert len({tuple(plan.size) for plan in plans}) == 40
    assert {plan.kind for plan in plans} == set(ROOM_KINDS)


@for_any(5, seed=SEEDS)
def test_a_generated_room_is_a_furnished_room(seed):
    plan, scene = plan_of(seed), generate_room(seed, 6000)
    assert (plan.size >= [1.8, 3.5, 2.5]).all() and (plan.size <= [15.0, 15.0, 3.5]).all()
    assert abs(len(scene) / 6000 - 1.0) < 0.1
    assert len(plan.solids) >= 3 and {part.kind for part in plan.solids} <= set(SOLID_KINDS)
    corners = mesh_of(plan).vertices
    assert (corners >= -0.5).all() and (corners <= plan.size + 0.5).all()
    # Nothing was scanned inside of anything, beyond the noise.
    for part in plan.solids:
        assert depth_in(scene.points, part).max() < 0.06


@pytest.mark.parametrize('seed', range(2))
def test_points_lie_on_the_mesh_exactly_or_with_the_noise_of_a_scan(seed):
    open3d = pytest.importorskip('open3d')
    exact, scanned = generate_room(seed, 4000, scanned=False), made_room(seed, 4000)
    rays = open3d.t.geometry.RaycastingScene()
    rays.add_triangles(exact.mesh.vertices, exact.mesh.triangles.astype(np.uint32))
    assert rays.compute_distance(exact.points).numpy().max() < 1e-3
    off = rays.compute_distance(scanned.points).numpy()
    assert 0.0005 < off.mean() < 0.01 and off.max() < 0.06


def test_exact_points_are_evenly_spread():
    spacing = generate_room(1, 8000, scanned=False).spacing
    assert np.percentile(spacing, 99) < 3.0 * np.median(spacing)
    assert np.percentile(spacing, 5) > 0.2 * np.median(spacing)


def test_scans_are_thinner_where_they_look_askance_and_have_holes():
    plan = plan_of(1)
    surface = generator.surface_of(plan, 0.1, np.random.default_rng(0))
    points, _ = generator.scan(plan, len(surface.points), np.random.default_rng(0))
    # Columns of the floor, all of which have as many points before the scan.
    counts = np.histogram2d(*points[points[:, 2] < 0.05, :2].T, bins=(20, 12))[0]
    assert (counts == 0).sum() > 5
    assert np.percentile(counts[counts > 0], 90) > 1.5 * np.percentile(counts[counts > 0], 20)


def test_what_no_tripod_sees_is_not_scanned():
    plan = box_plan(make_solid('wall', (3.0, 0.0, 0.0), (3.1, 4.0, 3.0)))
    points = np.array([[5.9, 1.0, 1.0], [5.9, 4.9, 1.0], [1.0, 1.0, 0.0], [3.0, 2.0, 1.0],
                       [3.1, 2.0, 1.0]])
    normals = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1.0, 0, 0], [1.0, 0, 0]])
    tripod = np.array([[2.0, 4.5, 1.5]])
    seen = generator.sampling_densities(points, normals, tripod, *generator.boxes_of(plan)) > 0.0
    np.testing.assert_array_equal(seen, [False, True, True, True, False])
    # A second one beyond the wall sees the rest, and the near one denser.
    tripods = np.vstack([tripod, [[5.0, 2.0, 1.5]]])
    both = generator.sampling_densities(points, normals, tripods, *generator.boxes_of(plan))
    assert (both[[0, 4]] > 0.0).all() and both[4] > 0.1


@for_any(20, seed=SEEDS)
def test_rays_are_blocked_as_sampled_ones_are(seed):
    """A twin that walks along each ray in small steps."""
    rng = np.random.default_rng(seed)
    box = make_solid('clutter', (-0.5, -0.3, 0.0), (0.5, 0.3, 1.2))
    plan = box_plan(*moved_piece([box], rng.uniform(1.5, 3.5, 2), rng.uniform(0.0, np.pi)))
    points = rng.uniform(0.0, [6.0, 5.0, 3.0], (60, 3))
    tripod = rng.uniform(0.0, [6.0, 5.0, 3.0], (1, 3))
    normals = points - tripod
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = generator.sampling_densities(points, normals, tripod, *generator.boxes_of(plan)) > 0.0
    steps = np.linspace(0.0, 1.0, 2000)[:, None]
    deepest = np.array([depth_in(tripod + steps * (point - tripod), plan.solids[0]).max()
                        for point in points])
    # Where a ray only grazes an edge the two may differ.
    clear = np.abs(deepest) > 0.02
    np.testing.assert_array_equal(seen[clear], deepest[clear] < 0.0)


def test_what_touches_is_not_exposed():
    table = make_solid('table', (1, 1, 0.7), (2, 2, 0.74))
    lying = make_solid('clutter', (1.2, 1.2, 0.74), (1.5, 1.5, 0.9))
    plan = box_plan(table, lying)
    boxes = generator.boxes_of(plan)
    points = np.array([[1.3, 1.3, 0.74], [1.8, 1.8, 0.74], [1.3, 1.3, 0.9], [3.0, 3.0, 0.0]])
    keep = generator.exposed_points(points, np.array([0, 0, 1, -1]), plan.size, *boxes, 0.03)
    np.testing.assert_array_equal(keep, [False, True, True, True])
    assert generator.is_position_free(np.array([3.0, 3.0, 1.5]), 0.3, *boxes)
    assert not generator.is_position_free(np.array([2.1, 1.5, 0.72]), 0.3, *boxes)


def test_windows_return_nothing():
    plan = box_plan(make_solid('clutter', (2, 2, 0), (3, 3, 1)))
    plan.windows.append(np.array([[-0.01, 1.0, 1.0], [0.01, 3.0, 2.0]]))
    points, kinds = generator.scan(plan, 12000, np.random.default_rng(0))
    low, high = [-0.05, 1.1, 1.1], [0.05, 2.9, 1.9]
    assert not ((points > low) & (points < high)).all(axis=1).any()
    assert {SOLID_KINDS[k] for k in np.unique(kinds)} == {'ceiling', 'floor', 'wall', 'clutter'}


@for_any(5, seed=SEEDS, flip=strategies.tuples(strategies.booleans(), strategies.booleans()))
def test_a_mirrored_room_is_the_room_in_a_mirror(seed, flip):
    plan = plan_of(seed)
    there = mesh_of(plan).vertices.reshape(-1, 8, 3)
    back = mesh_of(mirrored_plan(plan, np.array(flip))).vertices.reshape(-1, 8, 3)
    back[..., :2] = np.where(flip, plan.size[:2] - back[..., :2], back[..., :2])
    # Corners come in another order.
    apart = np.linalg.norm(there[:, :, None] - back[:, None], axis=3)
    assert apart.min(axis=1).max() < 1e-3 and apart.min(axis=2).max() < 1e-3


def test_rooms_are_listed_made_and_drawn(tmp_path, capsys):
    assert cli.main(['rooms', '4', '5']) == 0
    assert 'open office' in capsys.readouterr().out
    assert cli.main(['rooms', '30', '--points', '3000', '--out', str(tmp_path)]) == 0
    scene = load_scene(tmp_path / 'room-30.ply')
    np.testing.assert_array_equal(scene.points, made_room(30, 3000).points)
    mesh = PlyData.read(tmp_path / 'room-30_mesh.ply')
    assert len(mesh['face']) == len(made_room(30, 3000).mesh.triangles)
    assert cli.main(['info', str(tmp_path / 'room-30.ply'), '--out', str(tmp_path / 'a.png')]) == 0
    assert imread(tmp_path / 'a.png').shape == (315, 375, 4)


@pytest.mark.system
def test_generated_rooms_are_as_full_as_real_ones():
    kinds = np.concatenate([
        generator.scan(plan_of(seed), 3000, np.random.default_rng([seed, 1]))[1]
        for seed in range(12)])
    shares = dict(zip(SOLID_KINDS, np.bincount(kinds, minlength=len(SOLID_KINDS)) / len(kinds)))
    assert shares['floor'] + shares['ceiling'] + shares['wall'] < 0.85
    assert shares['bookcase'] > 0.02 and shares['clutter'] > 0.05
    scenes = [generate_room(seed, 4000) for seed in range(6)]
    assert 10.0 < np.median([np.prod(scene.size[:2]) for scene in scenes]) < 120.0
    heights = np.median([np.histogram(scene.points[:, 2], 10)[0] / len(scene)
                         for scene in scenes], axis=0)
    assert 0.15 < heights[0] < 0.35 and 0.15 < heights[-1] < 0.4
    errors = [DepthError(scene.points, scene.spacing, scene.diameter, viewpoints_of(scene), 32)
              for scene in scenes]
    assert np.median([(error.depth_map(0) < np.float32(error.far)).mean()
                      for error in errors]) > 0.9


@pytest.mark.parametrize(('arguments', 'words'), [
    (['info', '²', '--out', 'a.png'], '²'), (['info', '5', '--out', 'folder'], 'folder'),
    (['info', '5', '--out', 'file/a.png'], 'a.png'),
    (['rooms', '5', '--points', '1000', '--out', 'file'], 'file/room-5.ply')])
def test_what_cannot_be_drawn_or_written_is_refused(tmp_path, monkeypatch, capsys, arguments,
                                                    words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'file').write_text('')
    assert words in refused(capsys, *arguments)


@pytest.mark.parametrize('arguments', [['-3'], ['5', '--points', '10']])
def test_numbers_that_make_no_room_are_refused(capsys, arguments):
    with pytest.raises(SystemExit, match='2'):
        cli.main(['rooms', *arguments])
    assert arguments[-1] in capsys.readouterr().err


def test_nobody_is_told_of_a_pipe_that_was_closed(tmp_path):
    """As where ``head`` has seen enough."""
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, '-m', 'ocp_ros.cli.main', 'rooms', '3', '--points', '1000',
         '--out', str(tmp_path)], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert done.returncode == 0 and 'ipe' not in done.stderr
    assert list(tmp_path.glob('room-3*.ply'))
