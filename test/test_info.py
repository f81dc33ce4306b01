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

"""ocp info: what it measures of a room is what the room is like."""

import json
from pathlib import Path

import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.report.room_facts import facts_of, openings_of, SIDES
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.structure import Air
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.up_axis import map_from_file
import pytest

SIZE = np.array([5.0, 4.0, 2.5])


def box(without=(), step=0.05) -> Scene:
    """Make a room of six faces, without some of them: (axis, end)."""
    faces = []
    for axis in range(3):
        across = [np.arange(step / 2, SIZE[k], step) for k in range(3) if k != axis]
        flat = np.stack(np.meshgrid(*across), axis=-1).reshape(-1, 2)
        for end in (0, 1):
            if (axis, end) not in without:
                faces.append(np.insert(flat, axis, end * SIZE[axis], axis=1))
    return Scene(np.concatenate(faces), 'box')


def test_a_closed_box_is_measured():
    found = facts_of(box())
    assert found['floor'] == pytest.approx(0.0, abs=0.01)
    assert found['ceiling'] == pytest.approx(2.5, abs=0.01)
    assert found['size'] == pytest.approx(SIZE, abs=0.06)
    assert found['spacing'] == pytest.approx(0.05, rel=0.01)
    assert found['floor_area'] == pytest.approx(20.0, rel=0.15)
    assert found['openings']['all'] < 0.01 and found['notes'] == []


@pytest.mark.parametrize(('face', 'side'), [
    ((0, 1), '+x'), ((0, 0), '-x'), ((1, 1), '+y'), ((1, 0), '-y'), ((2, 1), 'above')])
def test_a_face_that_is_missing_is_an_opening_on_its_side(face, side):
    scene = box([face])
    space = FreePlane.of(scene.points, float(scene.bounds[1, 2]), 1, 0.0, clearance=0.0)
    found = openings_of(scene, Air(scene, space))
    others = max(found[other] for other in SIDES if other != side)
    assert found[side] > 0.4 and found[side] > 2.0 * others
    facts = facts_of(scene)
    assert (facts['ceiling'] is None) == any('ceiling' in note for note in facts['notes'])
    assert (facts['ceiling'] is None) == (side == 'above')


@pytest.mark.parametrize(('up', 'back'), [('y', [0, 1000, 0]), ('-z', [0, 0, -1000])])
def test_the_command_prints_measures_and_draws(tmp_path, monkeypatch, capsys, up, back):
    monkeypatch.chdir(tmp_path)
    np.save('room.npy', 1000.0 * box().points.astype(np.float64) @ map_from_file(up))
    command = ['info', 'room.npy', '--scale', '0.001', '--up', up, '--points', '5000']
    assert main(command) == 0
    printed = capsys.readouterr().out
    for words in ('millimetres', f'up: {up}', '2.50 m', 'out/info'):
        assert words in printed
    assert Path('out/info.png').read_bytes().startswith(b'\x89PNG')
    assert main([*command, '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['source']['up'] == found['room']['up'] == up
    # The matrix leads back to the file.
    matrix = np.array(found['source']['source_from_map'])
    assert (matrix @ [0.0, 0.0, 1.0, 1.0])[:3] == pytest.approx(back)
