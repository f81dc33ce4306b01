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

"""What the documentation says is what there is."""

import ast
import re
import shlex

from benchmarks.docs.sensor_table import bandwidth_rows, rows, unverified_rows
from conftest import made_room, ROOT, yaml_example
from ocp_ros.cli import main as cli
from ocp_ros.formats.exports import FORMATS
from ocp_ros.rig import schemas
from ocp_ros.rig.placement_file import load_placement
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.scenes.file_formats import SUFFIXES
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.search.registry import OBSERVED, planner_names, SCORES
import pytest

DOCS = ROOT / 'docs'


def test_every_parameter_is_on_its_page_as_it_is():
    pytest.importorskip('rclpy', reason='node parameters need ROS 2 (rclpy)')
    from benchmarks.docs.parameter_table import FOLDER, NODES, page
    for node, cls in NODES.items():
        # Where they differ, python -m benchmarks.docs.parameter_table writes the page again.
        assert (FOLDER / f'parameters_{node}.md').read_text() == page(node, cls)


def test_every_sensor_and_planner_is_in_its_table():
    # Where they differ, python -m benchmarks.docs.sensor_table prints what belongs there.
    text = (DOCS / 'reference' / 'sensors.md').read_text()
    assert [line for line in text.splitlines() if line.startswith('| `')] == [
        *rows(), *unverified_rows(), *bandwidth_rows()]
    text = (DOCS / 'reference' / 'planners.md').read_text()
    assert re.findall(r'^\| `(\w+)` \|', text, re.M) == [*planner_names(SCORES, OBSERVED)]


def topic_names():
    """Return the names of all topics."""
    from ocp_ros.ros.interface import topics
    return {value for name, value in vars(topics).items()
            if name.isupper() and isinstance(value, str)}


def test_every_topic_and_field_is_documented():
    pytest.importorskip('rclpy', reason='topics need ROS 2 (rclpy)')
    from ocp_ros.ros.interface import topics
    text = (DOCS / 'reference' / 'topics.md').read_text()
    for name in (*topic_names(), *topics.REWARD_FIELDS, *topics.TRAINING_FIELDS):
        assert f'`{name}`' in text, name


def test_the_examples_of_files_can_be_read_and_all_their_keys_are_explained(tmp_path):
    path = tmp_path / 'example.yaml'
    path.write_text(yaml_example('docs/reference/rig.md', 'cameras:'))
    rig = load_rig(path)
    assert set(rig.document.data) == set(schemas.RIG['properties'])
    assert len(rig.all_cameras) == 5
    path.write_text(yaml_example('docs/reference/placement.md', 'cameras:'))
    assert load_placement(path).poses.shape == (2, 6)
    rig_page, page = ((DOCS / 'reference' / f'{name}.md').read_text()
                      for name in ('rig', 'placement'))
    require_page = (DOCS / 'reference' / 'requirements.md').read_text()
    assert all(f'`{level}`' in require_page for level in schemas.PIXEL_DENSITIES)
    for text, parts in ((rig_page, 'RIG CAMERA FIXED KEEP_OUT REGION'),
                        (require_page, 'REQUIRE'),
                        (page + rig_page, 'PLACEMENT PLACED ROOM ENGINE')):
        for part in parts.split():
            for key in getattr(schemas, part)['properties']:
                assert f'`{key}`' in text, key


PAGES = sorted(str(path.relative_to(ROOT)) for path in [
    *ROOT.glob('*.md'), *DOCS.rglob('*.md'), ROOT / 'models' / 'README.md'])


def anchors(text):
    """Return the anchors that a page's headings get."""
    headings = re.findall(r'^#+ (.*)$', text, re.M)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def absent(page):
    """Yield what a page names and what does not exist."""
    path, makefile = ROOT / page, (ROOT / 'Makefile').read_text()
    text = path.read_text()
    for target, anchor in re.findall(r'\]\((?!http)([^)#\s]*)#?([^)\s]*)\)', text):
        linked = path.parent / target if target else path
        if not linked.exists() or anchor and anchor not in anchors(linked.read_text()):
            yield f'{page}: {target}#{anchor}'
    for folder in re.findall(r'`(ocp_ros/\w+)`', text):
        if not (ROOT / folder).is_dir():
            yield f'{page}: {folder}'
    for module in re.findall(r'python -m\s(benchmarks[\w.]+)', text):
        if not (ROOT / module.replace('.', '/')).with_suffix('.py').exists():
            yield f'{page}: {module}'
    for target in re.findall(r'(?:`|^    )make ([a-z-]+)', text, re.M):
        if not re.search(rf'^{target}:', makefile, re.M):
            yield f'{page}: make {target}'


#: A test of each format; of those that are read, by a name of their kind.
PROOFS = {
    'scan (read)': 'test_every_format_gives_back_the_points_and_is_refused_where_it_is_spoilt',
    'mesh (read)': 'test_parts_of_a_scene_graph_stand_where_it_puts_them',
    'map (read)': 'test_every_way_to_write_a_map_has_the_same_walls',
    'measured room (read)': 'test_a_room_from_a_tape_measure_has_its_measures',
    'ifc (read)': 'test_building_model', 'dxf (read)': 'test_floor_plan_in_millimetres',
    'usd (read)': 'test_stage_in_centimetres_with_a_part_in_another_file',
    'bag (read)': 'test_each_camera_is_given_what_it_recorded_in_its_body_frame',
    'placement': 'test_a_placement_comes_back_with_the_same_scores',
    'csv': 'test_the_table_has_a_row_for_each_camera',
    'launch': 'test_each_driver_gets_its_camera_and_its_depth_image_is_where_the_camera_looks',
    'xacro': 'test_the_xacro_file_has_the_same_frames',
    'rviz': 'test_rviz_shows_the_frame_that_the_launch_file_publishes_in',
    'installer': 'test_the_installers_page_has_what_was_found_and_where_cameras_hang_and_look',
    'report': 'test_report_page.py', 'html': 'test_viewer.py',
    'pdf': 'test_plan_and_elevations_are_to_scale', 'pdf_a3': 'test_plan_sheets.py',
    'sdf': 'test_gazebo_simulates_the_sensors',
    'nerfstudio': 'test_nerfstudio_has_the_cameras_in_the_axes_of_opengl',
    'colmap': 'test_colmap_reads_the_cameras',
    'metropolis': 'test_metropolis_maps_the_floor_to_pixels',
    'usd': 'test_a_usd_stage_has_the_cameras',
    'gltf': 'test_gltf_has_the_cameras_and_what_they_see',
    'dxf': 'test_a_drawing_has_walls_cameras_fields_of_view_and_sizes',
    'ifc': 'test_a_building_model_has_the_cameras_in_its_storey'}


def test_every_format_is_in_the_table_and_has_a_test_that_there_is():
    text = (DOCS / 'reference' / 'formats.md').read_text()
    reading, writing = text.split('## Written files')
    assert {suffix for suffix in SUFFIXES if f'`{suffix}`' not in reading} == set()
    for name, one in FORMATS.items():
        row, = re.findall(rf'^\| .*`{name}`\*?[ ,].*$', writing, re.M)
        assert one.room == (f'`{name}`*' in row), name
        assert name == 'report' or all(f'`{file}`' in row for file in one.files), name
        assert name in PROOFS, name
    tests = {path.name: path.read_text() for path in (ROOT / 'test').rglob('test_*.py')}
    for name, proof in PROOFS.items():
        assert proof in tests or any(f'def {proof}(' in test for test in tests.values()), name


def test_links_folders_modules_and_targets_exist():
    assert not [fault for page in PAGES for fault in absent(page)]


def test_every_option_of_plan_is_explained():
    text = (DOCS / 'tasks' / 'plan.md').read_text()
    plan = next(action for action in cli.build_parser()._actions if action.choices).choices['plan']
    for option in (name for action in plan._actions for name in action.option_strings):
        assert option in ('-h', '--help') or f'`{option}`' in text, option


def commands():
    """Return every command line of ocp in the code blocks of the documentation, once."""
    lines = [line for page in PAGES for line in re.findall(
        r'^    (?:\$ )?(?:\.venv/bin/)?ocp (.*)', (ROOT / page).read_text(), re.M)]
    return [*dict.fromkeys(tuple(shlex.split(line, comments=True)) for line in lines)]


COMMANDS = commands()
#: What runs here in a second or two; the others are held against the parser.
CHEAP = {'score', 'view', 'rooms'}


def test_every_command_in_the_documentation_can_be_read():
    parser = cli.build_parser()
    for command in COMMANDS:
        parser.parse_args(command)
    assert {command[0] for command in COMMANDS} == {
        'plan', 'info', 'score', 'calibrate', 'export', 'view', 'room', 'rooms', 'train',
        'benchmark', 'replay', 'studio'}


@pytest.mark.system
@pytest.mark.parametrize('command', [command for command in COMMANDS if command[0] in CHEAP],
                         ids=' '.join)
def test_every_cheap_command_in_the_documentation_runs(command, tmp_path, monkeypatch, capsys):
    save_scene(made_room(8, 1500), tmp_path / 'room.ply')
    for folder in (tmp_path, tmp_path / 'out' / 'studio'):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / 'placement.yaml').write_text(
            yaml_example('docs/tutorials/scan.md', 'cameras:'))
    (tmp_path / 'rig.yaml').write_text(
        'cameras:\n  - {sensor: realsense_d455, count: 2}\nmount: {on: free, height: [1, 2.4]}\n')
    monkeypatch.chdir(tmp_path)
    # What earlier commands of the page have written.
    for folder in ('out/hang-up', 'out/built'):
        if f'{folder}/placement.yaml' in command:
            assert cli.main(['score', 'room.ply', 'placement.yaml', '--out', folder]) == 0
            capsys.readouterr()
    assert cli.main([*command]) == 0, capsys.readouterr().err
    assert capsys.readouterr().out.strip()


def test_every_sentence_of_the_troubleshooting_is_still_in_the_code():
    text = ''.join((DOCS / 'tasks' / page).read_text()
                   for page in ('troubleshooting.md', 'troubleshooting_nodes.md',
                                'troubleshooting_calibration.md'))
    quoted = re.findall(r'^\| `(.+?)` \|', text, re.M)
    assert len(quoted) > 15
    # Every text in the package's code, with dots for what is filled in.
    known = set()
    for path in (ROOT / 'ocp_ros').rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, (ast.JoinedStr, ast.Constant)):
                known.add(''.join(str(part.value) if isinstance(part, ast.Constant) else '...'
                                  for part in getattr(node, 'values', [node])))
    for sentence in quoted:
        parts = re.escape(sentence).replace(re.escape('...'), '.+')
        assert any(re.search(parts, template) for template in known), sentence


def test_no_page_has_comments_or_more_than_1500_words():
    for page in PAGES:
        text = (ROOT / page).read_text()
        # Numbers and addresses are no words.
        seen = re.sub(r'\]\([^)]*\)', ' ', text).replace('|', ' ')
        words = sum(bool(re.search(r'[^\W\d_]', part)) for part in seen.split())
        assert '<!--' not in text and words <= 1500, page


def test_the_index_lists_every_page():
    text = (DOCS / 'index.md').read_text()
    for path in DOCS.rglob('*.md'):
        page = path.relative_to(DOCS)
        assert page.name == 'index.md' or f'({page})' in text, page


def test_the_picture_of_the_architecture_shows_the_layers_and_topics_there_are():
    from benchmarks.docs import architecture_picture
    from test_architecture import LAYERS
    assert list(architecture_picture.LAYERS) == LAYERS
    shown = {topic for _, _, names, _ in architecture_picture.TOPICS for topic in names}
    assert shown == topic_names()
