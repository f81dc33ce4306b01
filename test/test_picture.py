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

"""The pictures: they are written, to size, with what they are to show."""

from matplotlib.image import imread
import numpy as np
from ocp_ros.report.drawing.room_drawing import _ceiling, _surface
from ocp_ros.report.drawing.room_pictures import draw_placement
from ocp_ros.rooms.generator import generate_room
import pytest

POINTS = generate_room(1, 3000).points
CENTRE = np.append(POINTS.mean(axis=0)[:2], 1.9)


def _paths(turns: int, cameras: int) -> np.ndarray:
    """Spread cameras from the centre: (turns, cameras, 3)."""
    angle = 2.0 * np.pi * np.arange(cameras) / cameras
    way = np.stack([np.cos(angle), np.sin(angle), np.zeros(cameras)], axis=1)
    return CENTRE + np.linspace(0.1, 2.0, turns)[:, None, None] * way


def _colours(path) -> int:
    """Count the distinct colours of a picture of 1800 x 950 pixels."""
    image = imread(path)
    assert image.shape[:2] == (950, 1800)
    red, green, blue = (np.rint(255.0 * image[..., i]).astype(int) for i in range(3))
    return len(np.unique((red * 256 + green) * 256 + blue))


def test_picture_is_written_with_its_folder(tmp_path):
    path = tmp_path / 'new' / 'folder' / 'room.png'
    observed = np.arange(len(POINTS)) % 3 > 0
    draw_placement(path, POINTS, observed, _paths(5, 4), 4.0, 'room-1', '4 cameras')
    assert _colours(path) > 1000


@pytest.mark.parametrize('turns, cameras', [(1, 1), (3, 16)])
def test_any_number_of_turns_and_cameras(tmp_path, turns, cameras):
    draw_placement(tmp_path / 'a.png', POINTS, None, _paths(turns, cameras), 2.0, 'room-1')
    assert _colours(tmp_path / 'a.png') > 1000


def test_unobserved_points_are_red(tmp_path):
    red = {}
    for name, observed in (('all', np.ones(len(POINTS), bool)), ('none', np.zeros(len(POINTS)))):
        draw_placement(tmp_path / 'a.png', POINTS, observed, _paths(1, 1), 2.0, '')
        image = imread(tmp_path / 'a.png')
        red[name] = np.count_nonzero(image[..., 0] > image[..., 2] + 0.15)
    assert red['none'] > 20 * red['all']


@pytest.mark.parametrize('change, message', [
    ({'points': POINTS[:, :2]}, r'points: found shape \(\d+, 2\)'),
    ({'observed': np.ones(5, bool)}, r'observed: found shape \(5,\)'),
    ({'trajectories': _paths(3, 2)[0]}, r'trajectories: found shape \(2, 3\)'),
    ({'trajectories': _paths(3, 2)[:0]}, r'trajectories: found shape \(0, 2, 3\)'),
    ({'max_range': 0.0}, 'max_range: found 0.0')])
def test_wrong_input_is_refused(tmp_path, change, message):
    arguments = {'points': POINTS, 'observed': None, 'trajectories': _paths(3, 2),
                 'max_range': 4.0, 'title': ''} | change
    with pytest.raises(ValueError, match=message):
        draw_placement(tmp_path / 'a.png', **arguments)
    assert not (tmp_path / 'a.png').exists()


def test_only_the_ceiling_is_taken_off():
    points = generate_room(1, 8000).points.astype(np.float64)
    normals, radius = _surface(points)
    height = points[:, 2].max()
    hidden = _ceiling(points, normals, 2.5 * np.median(radius))
    assert hidden[points[:, 2] > height - 0.01].all()
    assert not hidden[points[:, 2] < height - 0.2].any()


def test_a_room_without_ceiling_keeps_its_furniture():
    points = generate_room(1, 8000).points.astype(np.float64)
    points = points[points[:, 2] < points[:, 2].max() - 0.1]
    normals, radius = _surface(points)
    assert not _ceiling(points, normals, 2.5 * np.median(radius)).any()
