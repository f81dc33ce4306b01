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

"""The page to turn around: what it holds is what was found, in a file of a few megabytes."""

from base64 import b64decode
import json
import re
import shutil
import subprocess

from conftest import HUNG
import numpy as np
from ocp_ros.geometry.cameras import in_view, rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import assess
from ocp_ros.report.drawing.plan_drawing import edges, reach
from ocp_ros.report.viewer import groups_of, layers_of, paints_of, SHOWN, write_view
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_of, sensor_named, SENSORS
from ocp_ros.rooms.scene_source import room_named
import pytest


def judged_with(points, **more):
    """Judge two cameras in a room, at little cost."""
    scene, room = room_named('8', points)
    poses = np.zeros((2, 6))
    poses[:, :3] = scene.bounds.mean(axis=0) + [[1.0, 0.0, 0.3], [-1.0, 0.0, 0.3]]
    return assess(scene, placement_of(rig_of(2, 'd455', **more), poses,
                                      engine=EngineConfig('fast', 32, 0.5)), room, 'ocp score')


@pytest.fixture(scope='module')
def judged():
    """Return two cameras that are judged in a small room."""
    return judged_with(1500)


def test_the_page_of_a_large_room_is_small_and_says_what_the_engine_says(tmp_path):
    judged = judged_with(45000)
    assert len(judged.scene) > SHOWN
    path = tmp_path / 'new' / 'view.html'
    write_view(path, judged.scene, judged)
    page = path.read_text()
    assert path.stat().st_size < 6e6
    data = json.loads(re.search(r'const \{facing, paints\} = (\{.*\});', page).group(1))
    levels = np.concatenate([np.frombuffer(b64decode(text), np.uint8)
                             for text in data['paints'][0]['values']]) // 64
    shares = np.bincount(levels, minlength=4) / len(levels)
    # The ceiling and most of the points are left out, so the shares are alike and not the same.
    everything = np.bincount(np.minimum(judged.counts, 3), minlength=4) / len(judged.scene)
    assert np.abs(shares - everything).max() < 0.15 and SHOWN / 2 < len(levels) < SHOWN


def test_what_can_be_switched_is_what_the_rig_has(judged):
    asked = judged_with(1500, regions=[{'name': 'table', 'box': [[2, 2, 0], [5, 5, 1.5]]}],
                        keep_out=[{'polygon': [[0, 0], [1, 0], [1, 1]], 'height': [0, 9]}])
    names, plain = ({layer.name: len(layer.traces) for layer in layers_of(found) if layer.traces}
                    for found in (asked, judged))
    assert names == {'cameras': 1, 'fields of view': 2, 'ranges': 2,
                     'weighted regions': 1, 'keep-out zones': 1, 'one more camera': 1}
    assert not {'weighted regions', 'keep-out zones'} & set(plain)


def test_every_way_to_colour_points_has_a_share_for_each(judged):
    paints = {paint.name: paint.values for paint in paints_of(judged.scene, judged)}
    assert list(paints)[0] == 'seen by how many cameras' and len(paints) == 4
    for name, values in paints.items():
        assert values.shape == (len(judged.scene),), name
        assert (values >= 0.0).all() and (values <= 1.0).all(), name
    assert np.array_equal(paints['what is missed'] > 0.5, judged.missed_points)
    assert np.array_equal(paints['depth error'] > 0.0, judged.error_by_point > 0.0)


def test_walls_are_sorted_by_where_they_face():
    scene, _ = room_named('8', 6000)
    groups, ways = groups_of(scene.points.astype(np.float64))
    assert sorted(np.concatenate(groups)) == list(range(len(scene)))
    middle = scene.bounds.mean(axis=0)
    for group, way in zip(groups[1:5], ways):
        assert len(group) > 50
        # A wall that faces one way stands on the other side of the room.
        inward = (middle - scene.points[group])[:, :2] @ way
        assert np.mean(inward > 0.0) > 0.9


@pytest.mark.parametrize('name', SENSORS)
def test_a_cone_is_drawn_as_a_camera_sees(name):
    model = SENSORS[sensor_named(name)].model
    pose = np.array([1.0, 2.0, 1.5, 0.7, 0.3, 0.0])
    points = edges(model, pose, 2.0)
    ring = points[np.isfinite(points).all(axis=1)][:100] - pose[:3]
    assert np.linalg.norm(ring, axis=1) == pytest.approx(2.0)
    body = ring @ rotation_matrix(*pose[3:])
    # A little further in is inside, a little further out is not.
    if model.horizontal_fov < np.pi:
        assert all(in_view(*way, model.lens) for way in 0.99 * body + [0.02, 0.0, 0.0])
        assert not any(in_view(*way, model.lens) for way in body - [0.05, 0.0, 0.0])
    flat = reach(model, pose, (0.0, 3.0))
    assert np.linalg.norm(flat - pose[:2], axis=1).max() <= model.max_range + 1e-9


BROWSER = shutil.which('chromium') or shutil.which('google-chrome')


@pytest.mark.system
@pytest.mark.skipif(BROWSER is None, reason='there is no chromium to open the page with')
def test_a_browser_draws_the_page(judged, tmp_path):
    write_view(tmp_path / 'view.html', judged.scene, judged)
    done = subprocess.run(
        [BROWSER, '--headless=new', '--no-sandbox', '--use-angle=swiftshader', '--dump-dom',
         '--enable-unsafe-swiftshader', '--virtual-time-budget=15000', '--enable-logging=stderr',
         f'--user-data-dir={tmp_path / "profile"}', (tmp_path / 'view.html').as_uri()],
        capture_output=True, text=True, timeout=HUNG)
    assert 'Uncaught' not in done.stderr
    # What the page's own code has made: the canvas with the room.
    assert '<canvas width=' in done.stdout
    assert '<canvas width=' not in (tmp_path / 'view.html').read_text()
