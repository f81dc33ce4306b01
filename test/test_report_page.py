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

"""Pictures and the one-page report: all on the page, nothing on top of each other."""

from dataclasses import replace
from itertools import combinations

from conftest import made_room
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
from matplotlib import rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from matplotlib.text import Text
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import judge
from ocp_ros.report.drawing import assessment_pictures, report_page, saved_pictures
from ocp_ros.report.drawing.plan_marks import move_apart
from ocp_ros.report.drawing.room_drawing import room_of
from ocp_ros.report.drawing.room_pictures import draw_placement
from ocp_ros.report.drawing.saved_pictures import shortened, width_of
from ocp_ros.report.facts import count_text, metres
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_from, rig_of
from ocp_ros.rooms.scene_source import room_named
from ocp_ros.util.yaml_files import Document
import pytest

LONG = 'the camera over the door to the storage room, left of the $ sign of the bank'
ENGINE = EngineConfig('fast', 32, 0.5)


@pytest.fixture(scope='module')
def rooms():
    """Return an L-shaped room, a long one and one that stands askew, and what each is."""
    return [room_named(seed, 1500) for seed in ('16', '7', '8')]


def judged_in(room, rig, poses):
    """Judge a placement in a room at little cost."""
    return judge(room[0], placement_of(rig, poses, engine=ENGINE), room[1], 'ocp score 1 p.yaml')


def texts_of(figure):
    """Draw a figure and return what is written in it, and where: pixels."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    written = [text for text in figure.findobj(Text) if text.get_visible()
               and text.get_text().strip() and (text.axes is None or text.axes.axison)]
    return [(text.get_text(), text.get_window_extent(renderer)) for text in written]


def check_apart(texts):
    """Assert that no text is on another one; letters are rounded to a pixel more or less."""
    for (one, a), (other, b) in combinations(texts, 2):
        assert (min(a.x1, b.x1) - max(a.x0, b.x0) <= 1.5
                or min(a.y1, b.y1) - max(a.y0, b.y0) <= 1.5), (one, other)


def middle_of(scene):
    """Return the pose of a camera in the middle of a room."""
    return np.array([[*scene.bounds.mean(axis=0)[:2], 1.9, 0.0, 0.3, 0.0]])


@pytest.mark.parametrize('count, number, named, together', [
    (1, 0, False, False), (9, 0, True, True), (20, 1, False, True), (40, 2, True, False)])
def test_all_labels_are_on_the_page_and_none_is_on_another(rooms, count, number, named, together):
    rng, room = np.random.default_rng(count), rooms[number]
    low, high = room[0].bounds
    poses = rng.uniform([*low, -3.0, 0.0, -1.0], [*high, 3.0, 1.2, 1.0], (count, 6))
    if together:
        poses[:, :3] = poses[0, :3]
    cameras = [{'sensor': 'realsense_d455', 'count': count, **({'name': LONG} if named else {})}]
    judged = judged_in(room, rig_from(Document('rig', {'cameras': cameras})), poses)
    pages = list(report_page.figures_of_pages(judged))
    assert len(pages) == (1 if count <= report_page.MAX_ROWS else 2)
    for figure in pages:
        texts = texts_of(figure)
        width, height = figure.get_size_inches() * figure.dpi
        for text, box in texts:
            assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height, text
        check_apart(texts)
    # The last page has the table, with a row for every camera.
    assert {f'{added["depth_error"]:.3f} m' for added in judged.found['scores']['cameras']} <= {
        text for text, _ in texts}


@pytest.mark.parametrize('number', range(3))
def test_numbers_in_the_plan_hide_neither_each_other_nor_the_walls(rooms, number):
    scene = rooms[number][0]
    poses = np.zeros((7, 6))
    poses[:, :3] = scene.bounds.mean(axis=0)
    poses[4:, :2] = scene.bounds[1, :2]
    figure = assessment_pictures.floor_plan_of(judged_in(rooms[number], rig_of(7, 'd455'), poses))
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    texts = [text for text in figure.axes[0].texts if text.get_text()]
    assert {*'1234567ABCD'} <= {text.get_text() for text in texts}
    check_apart([(text.get_text(), text.get_window_extent(renderer)) for text in texts])


def test_the_page_is_a4_on_its_side_and_shows_what_nobody_sees(rooms, tmp_path, recwarn):
    # Letters that no font has are no reason to complain.
    scene = replace(rooms[2][0], name='\ue000')
    judged = judged_in((scene, rooms[2][1]), rig_of(1, 'd455'), middle_of(scene))
    list(report_page.draw_pages(tmp_path / 'new', judged))
    assert not recwarn.list
    image = imread(tmp_path / 'new' / 'report.png')
    assert image.shape[1] / image.shape[0] == pytest.approx(297 / 210, rel=0.01)
    assert image.shape[1] >= 1700
    none = np.abs(image[..., :3] - to_rgb(assessment_pictures.COUNT_COLOURS[0])).max(axis=2) < 0.1
    assert none.mean() > 0.02


def test_what_is_shown_of_a_placement_is_what_the_engine_says(rooms):
    scene, _ = rooms[0]
    rig = rig_of(2, fixed=[{'position': [1, 1, 1.9],
                            'sensor': 'realsense_d455'}])
    poses = np.zeros((2, 6))
    poses[:, :3] = scene.bounds.mean(axis=0) + [[0.5, 0, 0], [-0.5, 0, 0]]
    judged = judged_in(rooms[0], rig, poses)
    overlap = judged.found['scores']['overlap']
    counts = np.bincount(np.minimum(judged.counts, 3), minlength=4)
    assert counts.tolist() == list(overlap.values())
    error = judged.found['scores']['depth_error']
    assert judged.error_by_point.sum() == pytest.approx(error, rel=1e-4)
    assert not judged.error_by_point[~judged.missed_points].any()


def test_the_page_says_what_was_found_and_explains_zones_but_names_no_folder(rooms):
    low, high = rooms[2][0].bounds.tolist()
    rig = rig_of(1, 'd455', pitch=[30, 60],
                 keep_out=[{'box': [low, [low[0] + 1.0, low[1] + 1.0, high[2]]]}],
                 regions=[{'name': 'table', 'box': [low, high], 'weight': 2.0},
                          {'name': 'door', 'box': [low, high], 'must_see': 0.1}])
    placement = placement_of(rig, middle_of(rooms[2][0]), engine=ENGINE)
    judged = judge(rooms[2][0], placement, rooms[2][1],
                   'ocp score /home/me/a.ply --rig=sub/rig.yaml')
    page, plan = next(report_page.figures_of_pages(judged)), assessment_pictures.floor_plan_of(
        judged)
    kinds = {'keep-out zone', 'weighted region', 'must-see region'}
    texts = {drawn: [text for text, _ in texts_of(drawn)] for drawn in (page, plan)}
    for drawn, written in texts.items():
        assert kinds <= {patch.get_label() for patch in drawn.axes[0].patches}
        assert kinds <= set(written)
    said, scores = ' '.join(texts[page]), judged.found['scores']
    assert judged.found['broken']
    for words in ('room-8: 1 camera', metres(scores['depth_error']),
                  f'{100 * scores["seen"]:.1f} %', 'mm/m²',
                  f'{count_text(len(judged.found["broken"]), "constraint")} violated',
                  'ocp score', 'a.ply --rig=rig.yaml', judged.instructions[0].place):
        assert words in said, words
    assert '/home' not in said and 'sub/' not in said


@given(places=st.integers(1, 30), seed=st.integers(0, 99))
@budget(max_examples=8, deadline=None)
def test_numbers_of_cameras_in_one_place_are_pushed_apart(places, seed):
    at = np.random.default_rng(seed).uniform(0.0, 1.0, (places, 2))
    moved = move_apart(at, 0.3, np.array([[0.5, 0.5]]))
    both = np.concatenate([moved, [[0.5, 0.5]]])
    distance = np.linalg.norm(both[:, None] - both[None], axis=2)
    assert distance[np.triu_indices(len(both), 1)].min() > 0.27


def test_letters_that_the_usual_font_lacks_are_those_of_an_installed_one(monkeypatch):
    # A font that comes with matplotlib, and a wide letter of it.
    monkeypatch.setattr(saved_pictures, 'FALLBACK_FONTS', ('no such font', 'STIXGeneral'))
    letter = '\u2b33'
    assert saved_pictures.font_families() == [*rcParams['font.family'], 'STIXGeneral']
    width_of.cache_clear()
    with saved_pictures.fonts_for_all_letters():
        wide, usual = width_of(letter, 72.0), width_of('room', 72.0)
    width_of.cache_clear()
    with pytest.warns(UserWarning, match='missing from font'):
        assert width_of(letter, 72.0) < 0.9 * wide
    assert width_of('room', 72.0) == usual
    width_of.cache_clear()


@given(text=st.text(st.characters(min_codepoint=32, max_codepoint=0x17f), max_size=60),
       width=st.floats(0.3, 3.0), bold=st.booleans())
@budget(max_examples=40, deadline=None)
def test_a_shortened_text_is_no_wider_than_allowed(text, width, bold):
    short = shortened(text, width, 8.0, bold)
    assert width_of(short, 8.0, bold) <= width + 1e-6
    assert short.endswith('...') or short.split() == ''.join(
        letter if letter.isprintable() else ' ' for letter in text).replace('$', r'\$').split()


POINTS = made_room(1, 3000).points
CENTRE = np.append(POINTS.mean(axis=0)[:2], 1.9)


def paths(turns: int, cameras: int) -> np.ndarray:
    """Spread cameras from the centre: (turns, cameras, 3)."""
    angle = 2.0 * np.pi * np.arange(cameras) / cameras
    way = np.stack([np.cos(angle), np.sin(angle), np.zeros(cameras)], axis=1)
    return CENTRE + np.linspace(0.1, 2.0, turns)[:, None, None] * way


@pytest.mark.parametrize('turns, cameras', [(1, 1), (3, 16)])
def test_any_number_of_turns_and_cameras_is_drawn_into_a_new_folder(tmp_path, turns, cameras):
    path = tmp_path / 'new' / 'folder' / 'room.png'
    observed = np.arange(len(POINTS)) % 3 > 0
    draw_placement(path, POINTS, observed, paths(turns, cameras), 4.0, 'room-1', '4 cameras')
    image = imread(path)
    assert image.shape[:2] == (950, 1800)
    assert len(np.unique(np.round(255.0 * image).astype(np.uint8).view(np.uint32))) > 1000


def test_unobserved_points_are_red(tmp_path):
    red = {}
    for name, observed in (('all', np.ones(len(POINTS), bool)), ('none', np.zeros(len(POINTS)))):
        draw_placement(tmp_path / 'a.png', POINTS, observed, paths(1, 1), 2.0, '')
        image = imread(tmp_path / 'a.png')
        red[name] = np.count_nonzero(image[..., 0] > image[..., 2] + 0.15)
    assert red['none'] > 20 * red['all']


@pytest.mark.parametrize('change', [
    {'points': POINTS[:, :2]}, {'observed': np.ones(5, bool)}, {'trajectories': paths(3, 2)[0]},
    {'trajectories': paths(3, 2)[:0]}, {'max_range': 0.0}])
def test_wrong_input_is_refused(tmp_path, change):
    arguments = {'points': POINTS, 'observed': None, 'trajectories': paths(3, 2),
                 'max_range': 4.0, 'title': ''} | change
    with pytest.raises(ValueError, match=f'{next(iter(change))}: found'):
        draw_placement(tmp_path / 'a.png', **arguments)
    assert not (tmp_path / 'a.png').exists()


def test_only_the_ceiling_is_taken_off():
    points = made_room(1, 8000).points.astype(np.float64)
    height = points[:, 2].max()
    kept = room_of(points, points).points[:, 2]
    assert kept.max() <= height - 0.01
    assert np.sum(kept < height - 0.2) == np.sum(points[:, 2] < height - 0.2)
    # A room without a ceiling keeps its furniture.
    open_room = points[points[:, 2] < height - 0.1]
    assert len(room_of(open_room, open_room).points) == len(open_room)
