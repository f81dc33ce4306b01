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

"""What is measured of a room is what the room is like: of boxes, and of small rooms of users."""

from functools import cache
from pathlib import Path
import warnings

from conftest import box_sides, made_room, printed, ROOT
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.report.facts import score_figures
from ocp_ros.report.findings import evaluate_placement, expected, gaps_of
from ocp_ros.report.room_facts import facts_of, SIDES
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_files import load_scene, SceneWarning
from ocp_ros.scenes.source_frame import map_from_file
from ocp_ros.simulation.problem import Problem
import pytest

SIZE = np.array([5.0, 4.0, 2.5])


def box() -> Scene:
    """Make a room of six faces."""
    return Scene(box_sides(SIZE, SIZE / 2.0, 0.05), 'box')


def test_a_closed_box_is_measured():
    found = facts_of(box())
    assert found['floor'] == pytest.approx(0.0, abs=0.01)
    assert found['ceiling'] == pytest.approx(2.5, abs=0.01)
    assert found['size'] == pytest.approx(SIZE, abs=0.06)
    assert found['spacing'] == pytest.approx(0.05, rel=0.01)
    floor, = found['floors']
    assert floor['area'] == pytest.approx(20.0, rel=0.01) and 15 < found['camera_area'] < 20
    assert found['openings']['all'] < 0.01 and found['notes'] == []


def test_each_floor_of_a_split_level_is_named(capsys, tmp_path, monkeypatch):
    points = box().points.copy()
    points[(points[:, 2] == 0.0) & (points[:, 0] > 3.0), 2] = 0.8
    points = points[(points[:, 0] <= 3.0) | (points[:, 2] >= 0.8)]
    floors = facts_of(Scene(points, 'split'))['floors']
    assert [floor['z'] for floor in floors] == pytest.approx([0.0, 0.8], abs=0.01)
    assert [floor['area'] for floor in floors] == pytest.approx([12.0, 8.0], rel=0.05)
    monkeypatch.chdir(tmp_path)
    np.save('split.npy', points)
    assert main(['info', 'split.npy']) == 0
    text = capsys.readouterr().out
    assert all(words in text for words in ('0.00 m', '0.80 m', '2.50 m and 1.70 m above'))


@pytest.mark.parametrize(('axis', 'end', 'side'), [
    (0, 1, '+x'), (0, 0, '-x'), (1, 1, '+y'), (1, 0, '-y'), (2, 1, 'above')])
def test_a_face_that_is_missing_is_an_opening_on_its_side(axis, end, side):
    points = box().points
    facts = facts_of(Scene(points[points[:, axis] != end * SIZE[axis]], 'box'))
    found = facts['openings']
    others = max(found[other] for other in SIDES if other != side)
    assert found[side] > 0.4 and found[side] > 2.0 * others
    assert (facts['ceiling'] is None) == (side == 'above')
    assert any('ceiling' in note for note in facts['notes']) == (side == 'above')


def test_the_command_prints_measures_and_draws(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save('room.npy', 1000.0 * box().points.astype(np.float64) @ map_from_file('y'))
    command = ['info', 'room.npy', '--scale', '0.001', '--up', 'y', '--points', '5000']
    assert main(command) == 0
    text = capsys.readouterr().out
    assert all(words in text for words in ('millimetres', 'up: y', '2.50 m', 'out/info'))
    assert Path('out/info.png').read_bytes().startswith(b'\x89PNG')
    found = printed(capsys, *command)
    assert found['source']['up'] == found['room']['up'] == 'y'
    # The matrix leads back to the file.
    matrix = np.array(found['source']['source_from_map'])
    assert (matrix @ [0.0, 0.0, 1.0, 1.0])[:3] == pytest.approx([0, 1000, 0])


CASES = ROOT.parent / 'shared' / 'data' / 'cases'
BOX = (6.0, 4.5, 2.7)
#: Floor and ceiling, metres, and size, of rooms as users have them; the right answer is known.
ROOMS = {
    'slab_0.2.ply': (0.0, 2.7, BOX), 'bim.obj': (0.0, 2.7, None),
    'studio.obj': (0.0, 4.0, (8.0, 8.0, 4.0)),
    'cell_m.stl': (0.0, 3.2, None), 'box.stl': (0.0, 2.5, (6.0, 4.0, 2.5)),
    'yup_corridor.glb': (0.0, 2.6, (8.0, 1.6, 2.6)), 'class7.las': (0.0, 2.7, BOX),
    'feet_wkt.las': (0.0, 2.7, BOX), 'geokeys_m_ft.las': (0.0, 2.7, BOX),
    'quantized.glb': (0.0, 2.7, BOX), 'viewpoint.pcd': (0.0, 2.7, None),
    'elevated_1.5m_room.obj': (1.5, 3.9, (6.0, 4.5, 2.4)), 'mirror.ply': (0.0, 2.7, BOX)}


@cache
def read(name):
    """Read a room as users have them, once; skip the test where it is absent."""
    if not CASES.is_dir():
        pytest.skip(f'{CASES} is not there')
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', SceneWarning)
        return load_scene(CASES / name, max_points=30_000)


@pytest.mark.parametrize('name', [*ROOMS, 'attic_1.8.ply', 'lecture_ramp.ply'])
def test_floor_ceiling_and_size_are_those_of_the_room_and_nothing_is_said_but_what_is_so(name):
    scene = read(name)
    facts = facts_of(scene)
    words = {'mirror.ply': 'mirror', 'lecture_ramp.ply': 'slopes',
             'slab_0.2.ply': 'solid model'}.get(name)
    notes = facts['notes']
    assert len(notes) == (words is not None) and all(words in note for note in notes), notes
    floor, ceiling, size = ROOMS.get(name, (None, None, None))
    if floor is not None:
        assert facts['floor'] == pytest.approx(floor, abs=0.011)
        assert facts['ceiling'] == pytest.approx(ceiling, abs=0.011)
    if size is not None:
        # Of points that were taken from a slab a few may be left at its outside.
        span = np.subtract(*np.percentile(scene.points, [99.5, 0.5], axis=0))
        np.testing.assert_allclose(span, size, atol=0.06)


@pytest.mark.parametrize('name, mount', [
    ('mirror.ply', 'walls'), ('mirror.ply', 'ceiling'), ('cell_m.stl', 'ceiling'),
    ('bim.obj', 'walls')])
def test_cameras_hang_inside(name, mount):
    scene = read(name)
    problem = Problem.of(scene, rig_of(2, 'realsense_d455', mount={'on': mount}))
    places, _ = problem.region.places(problem.rig.models[0], 300)
    low, high = scene.bounds
    assert ((places.positions > low) & (places.positions < high)).all()


def test_an_extended_header_of_pcd_is_named():
    with pytest.raises(SceneError, match='HEADER_EXT'):
        read('ext3.pcd')


def test_a_share_of_what_was_not_scanned_counts_as_missed():
    def found_in(points):
        problem = Problem.of(Scene(points, 'box'), rig_of(1, mount={'on': 'ceiling'}))
        return evaluate_placement(problem, np.array([[2.5, 2.0, 2.3, 0.0, 0.0, 0.0]]))

    points = box().points
    x, y, z = points.T
    # A corner behind a cupboard: no floor, and no walls.
    is_hidden = (x < 2.5) & (y < 2.5) & (z < 2.0)
    whole, partial = found_in(points), found_in(points[~is_hidden])
    assert whole['scores']['unscanned'] == whole['scores']['unscanned_error'] == 0.0
    assert not any('nothing scanned' in note for note in whole['notes'])
    assert 0.05 < partial['scores']['unscanned'] < 0.3
    note, = [note for note in partial['notes'] if 'nothing scanned' in note]
    at = [float(value) for value in note.split('(')[1].split(')')[0].split(',')]
    assert (np.array(at) < 2.6).all()
    missed, worst, error = (partial['scores'][key] for key in (
        'unscanned_error', 'depth_error_of_nothing', 'validation_error'))
    assert partial['expected'] == expected(error, worst, unscanned=missed, under_ceiling=True)
    without = expected(error, worst, under_ceiling=True)
    # Errors near 0, as this one, are expected with another ratio.
    less, more = (expected(5.0, worst, unscanned=some, under_ceiling=True)['depth_error']
                  for some in (0.0, missed))
    assert 0.4 * missed < more - less < missed
    assert partial['expected']['low'] > without['low']


#: Of a placement in any room.
SCORES = {'depth_error': 1.0, 'depth_error_of_nothing': 40.0, 'seen_by': 1, 'seen': 0.5,
          'overlap': {'0': 1, '1': 1}, 'points': 2, 'space_coverage': 1.0, 'volume': 2.0}


def test_a_sparse_scan_widens_what_is_expected():
    sparse, dense = made_room(8, 2000), made_room(8, 15_000)
    assert gaps_of(sparse) == ('sparse',) and gaps_of(dense) == ()
    for error in (1.0, 5.0, 12.0):
        narrow, wide = (expected(error, 40.0, gaps_of(scene)) for scene in (dense, sparse))
        assert wide['low'] <= narrow['low'] and wide['high'] >= narrow['high']
        assert wide['low'] <= wide['depth_error'] <= wide['high']
        remarks = [score_figures(SCORES, one)[1].remark for one in (narrow, wide)]
        assert ['scan more densely' in remark for remark in remarks] == [False, True]
    assert wide['high'] > 1.1 * narrow['high']


def test_cameras_under_the_ceiling_deliver_more_of_what_is_promised():
    for error in (1.0, 5.0, 12.0):
        others, under = (expected(error, 40.0, under_ceiling=below) for below in (False, True))
        assert under['depth_error'] < others['depth_error'] and under['low'] <= others['low']
        # One or two cameras there may miss as much as others do.
        assert under['high'] == others['high']
