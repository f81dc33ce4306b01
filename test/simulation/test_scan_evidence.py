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

"""What a scan proves: nothing is seen from behind, nor through what no scanner has seen."""

from dataclasses import replace

from benchmarks.drills import file_fuzz as files
from conftest import box_sides
import numpy as np
from ocp_ros.geometry.packed_bits import pack, unpack
from ocp_ros.report.facts import region_rows
from ocp_ros.report.findings import scores_of
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.scenes.scene import rotation_matrix, Scan, Scene, turned
from ocp_ros.scenes.scene_files import load_scene
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.scan_evidence import cross_cells, proved_bits
import pytest

#: A cabinet in the middle of a room of 6 x 4 x 2.8 m. A scanner at the side of x = 0 does not see
#: its back.
LOW, HIGH = np.array([2.8, 1.2, 0.0]), np.array([3.3, 2.8, 1.8])
BEHIND = np.array([[5.2, 2.0, 1.6, np.pi, 0.0, 0.0]])


def scanned(points, stations, low=LOW, high=HIGH):
    """Return the room with the points that are visible from stations past a box."""
    def is_visible(station):
        ends = np.stack([low + 0.01 - station, high - 0.01 - station])[:, None] / (
            points - station + 1e-9)
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        return (enter > leave) | (enter > 1.0) | (leave < 0.0)
    seen = [is_visible(station) for station in np.array(stations)]
    return Scene(points[np.any(seen, axis=0)].astype(np.float32), 'cabinet', scans=tuple(
        Scan(station, points[own]) for station, own in zip(np.array(stations), seen)))


@pytest.fixture(scope='module', params=[0.0, 35.0])
def scene(request):
    """Return a room with a cabinet, scanned from two stations."""
    cabinet = box_sides(HIGH - LOW, 0.5 * (LOW + HIGH), 0.04)
    is_back = (cabinet[:, 0] > HIGH[0] - 0.01) & (cabinet[:, 2] < HIGH[2] - 0.01)
    points = np.concatenate([box_sides((6.0, 4.0, 2.8), (3.0, 2.0, 1.4), 0.06), cabinet[~is_back]])
    # Nor is the floor in the shadow of the cabinet scanned.
    is_shadow = (points[:, 0] > HIGH[0] + 0.01) & (abs(points[:, 1] - 2.0) < 1.2) & (
        points[:, 2] < 0.01)
    made = scanned(points[~is_shadow], [[1.0, 1.0, 2.5], [1.0, 3.2, 2.5]])
    return turned(made, request.param)


def degrees_of(scene):
    """Return by how much a room is turned."""
    return float(scene.name.split('@')[1]) if '@' in scene.name else 0.0


def placed(scene, poses):
    """Return poses (K, 6) of the room that is not turned, in a turned room."""
    angle = np.deg2rad(degrees_of(scene))
    return np.column_stack([poses[:, :3] @ rotation_matrix(angle).T, poses[:, 3] + angle,
                            poses[:, 4:]])


def test_what_stands_behind_an_unscanned_back_is_not_seen_through_it(scene):
    problem = Problem.of(scene, rig_of(1, 'omnidirectional'))
    objective = problem.objective
    views = objective.look(placed(scene, BEHIND))
    seen = objective.evaluate_views(views).seen.mask
    proved = objective.validation.evaluate_views(views).seen.mask
    back = turned(replace(scene, scans=()), -degrees_of(scene)).points.astype(float)
    is_front = (abs(back[:, 0] - LOW[0]) < 0.01) & (abs(back[:, 1] - 2.0) < 0.7) & (
        abs(back[:, 2] - 0.9) < 0.8)
    assert seen[is_front].mean() > 0.5 and proved[is_front].mean() < 0.02
    assert not (proved & ~seen).any()
    # What is seen from where the scanner was stays, such as the wall that both see.
    is_wall = (back[:, 1] < 0.01) & (back[:, 0] > 2.0) & (back[:, 2] > 0.3)
    assert proved[is_wall].mean() > 0.9 * seen[is_wall].mean() > 0.8
    # The promise is larger by what is not proved.
    assert objective.validation.depth_error(views) > replace_evidence(objective).depth_error(views)


def test_cameras_are_linked_by_what_the_scan_proves(scene):
    # One camera before the cabinet, and one behind it, which seems to see its front.
    poses = placed(scene, np.array([[1.0, 2.0, 0.9, 0.0, 0.0, 0.0],
                                    [5.2, 2.0, 0.9, np.pi, 0.0, 0.0]]))
    rig = rig_of(2, 'd455', calibratable={'overlap': 0.3, 'angle': 180})
    objective = Problem.of(scene, rig).objective
    views = objective.look(poses)
    links = scores_of(objective, views)['calibratable']
    assert objective.evaluate_views(views).connected and not objective.connects(views)
    assert len(links['groups']) == 2 and links['pairs'][0]['overlap'] < 0.1


def test_a_region_says_how_much_of_its_surface_was_not_scanned(scene):
    angle = degrees_of(scene)
    corners = placed(scene, np.pad(box_sides(2.0 * (HIGH - LOW), 0.5 * (LOW + HIGH), 9.0),
                                   [(0, 0), (0, 3)]))[[0, 2, 6, 4], :2]
    region = {'name': 'cabinet', 'polygon': corners.tolist(), 'height': [0.02, 2.0]}

    def found_in(scan):
        problem = Problem.of(scan, rig_of(1, 'omnidirectional', regions=[region]))
        (found,) = scores_of(problem.objective, problem.objective.look(BEHIND))['regions']
        return found, region_rows({'regions': [found]})[0][1]

    size = HIGH - LOW
    back, others = size[1] * size[2], size[1] * size[2] + 2 * size[0] * size[2] + size[0] * size[1]
    found, text = found_in(scene)
    assert found['unscanned'] == pytest.approx(back / (back + others), abs=0.05)
    assert f'{100 * found["unscanned"]:.1f} % of its surface or more was not scanned' in text
    # Scanned from all sides, it has no such back.
    points = np.concatenate([box_sides((6.0, 4.0, 2.8), (3.0, 2.0, 1.4), 0.06),
                             box_sides(size, 0.5 * (LOW + HIGH), 0.04)])
    whole = turned(scanned(points, [[1.0, 1.0, 2.5], [1.0, 3.2, 2.5], [5.0, 1.0, 1.5],
                                    [5.0, 3.0, 1.5]]), angle)
    found, text = found_in(whole)
    assert found['unscanned'] < 0.03 and 'not scanned' not in text


def replace_evidence(objective):
    """Return the objective on validation viewpoints by which all views count."""
    simulator = objective.simulator.with_validation()
    simulator.evidence = None
    other = objective.validation
    lax = type(other).__new__(type(other))
    lax.__dict__.update(other.__dict__, simulator=simulator)
    return lax


def test_stations_are_found_if_the_file_does_not_say_them(scene):
    evidence = Problem.of(replace(scene, scans=()), rig_of(1, 'omnidirectional')
                          ).objective.validation.simulator.evidence
    assert 1 <= len(evidence.stations) <= 6
    assert 0.3 < evidence.is_crossed.mean() < 0.95


def test_a_sparse_scan_of_an_empty_room_proves_most_views():
    # Rays to points 0.3 m apart leave gaps that are wider than 0.1 m.
    room = Scene(box_sides((12.0, 8.0, 4.0), (6.0, 4.0, 2.0), 0.3).astype(np.float32), 'hall')
    objective = Problem.of(room, rig_of(1, 'helios2', mount={'on': 'ceiling'})).objective
    views = objective.look(np.array([[0.5, 4.0, 3.8, 0.0, 0.5, 0.0]]))
    seen, proved = (one.evaluate_views(views).seen.mask.sum() for one in (
        objective, objective.validation))
    assert proved > 0.8 * seen > 200


def test_a_view_from_an_aisle_that_was_not_scanned_proves_nothing():
    # A shelf of the height of the room but for a slit; behind it nothing was scanned.
    points = box_sides((6.0, 4.0, 2.8), (3.0, 2.0, 1.4), 0.06)
    shelf = box_sides((0.02, 4.0, 2.4), (4.8, 2.0, 1.2), 0.06)
    points = np.concatenate([points[points[:, 0] < 4.8], shelf[shelf[:, 0] < 4.8]])
    scene = Scene(points.astype(np.float32), 'aisle')
    objective = Problem.of(scene, rig_of(1, 'omnidirectional')).objective
    in_aisle, before = (objective.validation.evaluate_views(objective.look(
        np.array([[x, 2.0, 2.6, np.pi, 0.0, 0.0]]))).seen.mask.mean() for x in (5.4, 3.0))
    assert in_aisle == 0.0 and before > 0.8


def test_scans_tell_the_two_sides_of_a_thin_board():
    low, high = np.array([2.985, 1.0, 0.0]), np.array([3.015, 4.0, 2.8])
    rng = np.random.default_rng(0)
    board = rng.uniform(low, high, (800, 3))
    board[:, 0] = np.where(rng.random(800) < 0.5, low[0], high[0])
    points = np.concatenate([box_sides((6.0, 4.0, 2.8), (3.0, 2.0, 1.4), 0.12), board])
    scene = scanned(points, [[1.0, 2.0, 1.5], [5.0, 2.0, 1.5]], low, high)
    is_far = scene.points[:, 0] == high[0].astype(np.float32)

    def far_share(scene):
        objective = Problem.of(scene, rig_of(1, 'omnidirectional')).objective
        views = objective.look(np.array([[1.5, 2.5, 1.0, 0.0, 0.0, 0.0]]))
        return objective.validation.evaluate_views(views).seen.mask[is_far].mean()

    assert far_share(scene) < 0.05 < 0.2 < far_share(replace(scene, scans=()))


def test_rays_cross_cells_and_prove_views_as_a_slow_twin_says():
    rng, edge = np.random.default_rng(0), 0.1
    low, points = np.zeros(3), rng.uniform(0.1, 1.9, (60, 3))
    station, position = np.array([0.3, 1.0, 1.1]), np.array([1.7, 1.0, 0.9])
    is_crossed = np.zeros((20, 20, 20), dtype=bool)
    cross_cells(station, points[:30], low, edge, is_crossed)

    def cells(start, end, margin):
        """Return the cells of the way to a point, two places in each."""
        length = np.linalg.norm(end - start)
        shares = 0.5 * edge * np.arange(int(2.0 * (length - margin * edge) / edge)) / length
        return np.floor((start + shares[:, None] * (end - start)) / edge).astype(int)

    twin = np.zeros_like(is_crossed)
    for point in points[:30]:
        twin[tuple(cells(station, point, 1.0).T)] = True
    assert np.array_equal(is_crossed, twin) and twin.any()
    normals = rng.normal(size=(60, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    sides, seen = rng.integers(-1, 2, 60).astype(np.int8), rng.random(60) < 0.8
    kept = unpack(proved_bits(pack(seen), position, points.astype(np.float32), normals, sides, low,
                              edge, is_crossed, 0.4), 60)
    for k, point in enumerate(points.astype(np.float32).astype(float)):
        way = cells(position, point, 1.5)
        cosine = (position - point) @ normals[k] / np.linalg.norm(position - point)
        unknown = 0.5 * edge * np.count_nonzero(~twin[tuple(way.T)])
        if abs(unknown - 0.4) > 1e-6:
            assert kept[k] == (seen[k] and sides[k] * cosine >= -0.03 and unknown <= 0.4)
    assert 0 < kept.sum() < seen.sum()


def test_ptx_and_e57_files_say_where_the_scanner_stood(tmp_path):
    rng = np.random.default_rng(0)
    room = box_sides((6.0, 4.0, 2.8), (3.0, 2.0, 1.4), 0.2)
    places = np.array([[1.0, 1.5, 1.6], [4.5, 2.0, 1.4]])
    text = ''
    for place in places:
        axes = '1 0 0\n0 1 0\n0 0 1\n'
        matrix = f'1 0 0 0\n0 1 0 0\n0 0 1 0\n{" ".join(map(str, place))} 1\n'
        own = room[rng.random(len(room)) < 0.5] - place
        text += f'{len(own)}\n1\n0 0 0\n{axes}{matrix}' + ''.join(
            '{:.4f} {:.4f} {:.4f} 0.5\n'.format(*point) for point in own)
    (tmp_path / 'room.ptx').write_text(text)
    scene = load_scene(tmp_path / 'room.ptx')
    np.testing.assert_allclose([scan.station for scan in scene.scans], places)
    evidence = Problem.of(scene, rig_of(1, 'omnidirectional')).objective.validation.simulator
    np.testing.assert_allclose(evidence.evidence.stations, places)
    pytest.importorskip('pye57')
    files.write_e57(tmp_path / 'room.e57', room, poses=[
        (1.0, 0.0, 0.0, 0.0, *place) for place in places])
    scans = load_scene(tmp_path / 'room.e57').scans
    np.testing.assert_allclose([scan.station for scan in scans], places)
    assert [len(scan.points) for scan in scans] == 2 * [len(room) // 2]
