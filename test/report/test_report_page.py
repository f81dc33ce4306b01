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

"""The report: all on the page, nothing on top of each other, and the same facts everywhere."""

from dataclasses import replace
from html import unescape
from itertools import combinations

from conftest import for_any, made_room
from hypothesis import strategies as st
from matplotlib import rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from matplotlib.text import Text
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import assess
from ocp_ros.report.drawing import assessment_pictures, report_page, saved_pictures
from ocp_ros.report.drawing.plan_drawing import move_apart
from ocp_ros.report.drawing.room_drawing import room_of
from ocp_ros.report.drawing.room_pictures import draw_placement
from ocp_ros.report.drawing.saved_pictures import shortened, width_of
from ocp_ros.report.facts import count_text, facts_of, metres, page_facts_of
from ocp_ros.report.installer_page import installer_page
from ocp_ros.report.terminal import as_text, print_table, show_score
from ocp_ros.report.viewer import tables_of
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
    return assess(room[0], placement_of(rig, poses, engine=ENGINE), room[1], 'ocp score 1 p.yaml')


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
    (9, 0, True, True), (20, 1, False, True), (40, 2, True, False)])
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
        check_apart(texts)
        width, height = figure.get_size_inches() * figure.dpi
        for text, box in texts:
            assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height, text
    # The last page has the table, with a row for every camera.
    assert {f'{added["depth_error"]:.3f} m' for added in judged.found['scores']['cameras']} <= {
        text for text, _ in texts}


def test_many_figures_fit_their_tiles(rooms):
    rig = rig_of(2, 'd455', calibratable={}, regions=[
        {'name': 'machine', 'box': rooms[0][0].bounds.tolist(), 'must_see': 0.9}])
    poses = np.repeat(middle_of(rooms[0][0]), 2, axis=0)
    judged = judged_in(rooms[0], rig, poses)
    judged.found['search'] = {
        'certificate': {'gap': 0.0704, 'bound': 4.5, 'step': 1.46, 'sentence': ''}}
    assert len(page_facts_of(judged).figures) == 10
    page, = report_page.figures_of_pages(judged)
    shown = ' '.join(text for text, _ in texts_of(page))
    for label, value, remark in page_facts_of(judged).figures:
        assert f'{label} {value} {remark}' in shown


@pytest.mark.parametrize('number', range(3))
def test_numbers_in_the_plan_hide_neither_each_other_nor_the_walls(rooms, number):
    scene = rooms[number][0]
    poses = np.zeros((7, 6))
    poses[:, :3] = scene.bounds.mean(axis=0)
    poses[4:, :2] = scene.bounds[1, :2]
    texts = texts_of(assessment_pictures.floor_plan_of(
        judged_in(rooms[number], rig_of(7, 'd455'), poses)))
    assert {*'1234567ABCD'} <= {text for text, _ in texts}
    check_apart(texts)


def test_the_page_is_a4_on_its_side_and_shows_what_nobody_sees(rooms, tmp_path, recwarn):
    # Letters that no font has are no reason to complain.
    scene = replace(rooms[2][0], name='\ue000')
    judged = judged_in((scene, rooms[2][1]), rig_of(1, 'd455'), middle_of(scene))
    list(report_page.draw_pages(tmp_path / 'new', judged))
    assert not recwarn.list
    image = imread(tmp_path / 'new' / 'report.png')
    height, width, _ = image.shape
    assert width >= 1700 and width / height == pytest.approx(297 / 210, rel=0.01)
    none = np.abs(image[..., :3] - to_rgb(assessment_pictures.COUNT_COLOURS[0])).max(axis=2) < 0.1
    assert none.mean() > 0.02


def test_the_page_says_what_was_found_and_explains_zones_but_names_no_folder(rooms):
    scene, room = rooms[2]
    low, high = scene.bounds.tolist()
    rig = rig_of(1, 'd455', pitch=[30, 60],
                 keep_out=[{'box': [low, [low[0] + 1.0, low[1] + 1.0, high[2]]]}],
                 fixed=[{'position': [1, 1, 1.9], 'sensor': 'realsense_d455'}],
                 regions=[{'name': 'table', 'box': [low, high], 'weight': 2.0},
                          {'name': 'door', 'box': [low, high], 'must_see': 0.1}])
    judged = assess(scene, placement_of(rig, middle_of(scene), engine=ENGINE), room,
                    'ocp score /home/me/a.ply --rig=sub/rig.yaml')
    kinds = {'keep-out zone', 'weighted region', 'must-see region'}
    for drawn in (assessment_pictures.floor_plan_of(judged),
                  next(report_page.figures_of_pages(judged))):
        texts = [text for text, _ in texts_of(drawn)]
        assert kinds <= {patch.get_label() for patch in drawn.axes[0].patches}
        assert kinds <= set(texts)
    # The last of them is the page.
    said, scores = ' '.join(texts), judged.found['scores']
    assert judged.found['broken']
    for words in ('room-8: 2 cameras', metres(scores['depth_error']),
                  f'{100 * scores["seen"]:.1f} %', 'mm/m²',
                  f'{count_text(len(judged.found["broken"]), "constraint")} violated',
                  'ocp score', 'a.ply --rig=rig.yaml', judged.instructions[0].place):
        assert words in said, words
    assert '/home' not in said and 'sub/' not in said
    # What pictures show of a placement is what the engine says.
    counts = np.bincount(np.minimum(judged.counts, 3), minlength=4)
    assert counts.tolist() == list(scores['overlap'].values())
    assert judged.error_by_point.sum() == pytest.approx(scores['depth_error'], rel=1e-4)
    assert not judged.error_by_point[~judged.missed_points].any()


def test_terminal_page_and_sheet_show_the_same_key_figures(rooms):
    poses = rooms[2][0].bounds.mean(axis=0) + [[1.0, 0.0, 0.3], [-1.0, 0.0, 0.3]]
    judged = judged_in(rooms[2], rig_of(2, 'd455', calibratable={'overlap': 0.1}, regions=[
        {'name': 'table', 'box': [[2, 2, 0], [5, 5, 1.5]], 'must_see': 0.99}]), poses)
    facts, with_room = facts_of(judged.found), page_facts_of(judged)
    assert {name: getattr(with_room, name) for name in vars(facts)} == vars(facts)
    assert [figure.label for figure in facts.figures] == [
        'depth error', 'expected (9 of 10 rooms)', 'seen', 'seen twice', 'space coverage',
        'missed', 'regions', 'overlap', 'one more camera']
    sheet = texts_of(next(report_page.figures_of_pages(judged)))
    texts = {'terminal': as_text(show_score, judged.found),
             'page': unescape(' '.join(tables_of(judged))),
             'sheet': ' '.join(text for text, _ in sheet)}
    for name, text in texts.items():
        for label, value, _ in facts.figures:
            assert label in text and value in text, (name, label)
        assert facts.verdict in text and facts.cameras[0].reduction in text, name
    for cells in facts.regions:
        assert all(cell in texts[name] for name in ('terminal', 'page') for cell in cells), cells
    page = installer_page(judged, 'plan.png')
    assert all(value in page for _, value, _ in facts.figures[:3])


def test_a_table_shows_names_and_does_not_obey_them():
    def show(console, found):
        print_table(console, found['title'], ('camera', ''), [('[red]x[/red]', 'a\x1bb')])
    text = as_text(show, {'title': '[b]'})
    assert '[red]x[/red]' in text and '[b]' in text and '\x1b' not in text


@for_any(8, places=st.integers(1, 30), seed=st.integers(0, 99))
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


@for_any(40, text=st.text(st.characters(min_codepoint=32, max_codepoint=0x17f), max_size=60),
         width=st.floats(0.3, 3.0), bold=st.booleans())
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


def test_unobserved_points_are_red_in_a_picture_in_a_new_folder(tmp_path):
    path, red = tmp_path / 'new' / 'folder' / 'room.png', []
    everything, some = np.ones(len(POINTS), bool), np.arange(len(POINTS)) % 3 > 0
    for observed, way in ((everything, paths(1, 1)), (~everything, paths(1, 1)),
                          (some, paths(3, 16))):
        draw_placement(path, POINTS, observed, way, 2.0, 'room-1', '4 cameras')
        image = imread(path)
        assert image.shape[:2] == (950, 1800)
        assert len(np.unique(np.round(255.0 * image).astype(np.uint8).view(np.uint32))) > 1000
        red.append(np.count_nonzero(image[..., 0] > image[..., 2] + 0.15))
    assert red[1] > 20 * red[0]


def test_only_the_ceiling_is_taken_off():
    points = made_room(1, 8000).points.astype(np.float64)
    height, kept = points[:, 2].max(), room_of(points, points).points[:, 2]
    assert kept.max() <= height - 0.01
    assert np.sum(kept < height - 0.2) == np.sum(points[:, 2] < height - 0.2)
    # A room without a ceiling keeps its furniture.
    open_room = points[points[:, 2] < height - 0.1]
    assert len(room_of(open_room, open_room).points) == len(open_room)
