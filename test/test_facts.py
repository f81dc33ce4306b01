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

"""Facts of a placement: every renderer shows the same numbers and sentences."""

from html import unescape

from matplotlib.text import Text
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import judge
from ocp_ros.report.drawing import report_page
from ocp_ros.report.facts import facts_of, page_facts_of
from ocp_ros.report.installer import installer_page
from ocp_ros.report.terminal import as_text, print_table, show_score
from ocp_ros.report.viewer import tables_of
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.scene_source import room_named
import pytest
from rich.console import Console


@pytest.fixture(scope='module')
def judged():
    """Judge two cameras with a region and a link between them."""
    scene, room = room_named('8', 1500)
    poses = np.zeros((2, 6))
    poses[:, :3] = scene.bounds.mean(axis=0) + [[1.0, 0.0, 0.3], [-1.0, 0.0, 0.3]]
    rig = rig_of(2, 'd455', calibratable={'overlap': 0.1}, regions=[
        {'name': 'table', 'box': [[2, 2, 0], [5, 5, 1.5]], 'must_see': 0.99}])
    return judge(scene, placement_of(rig, poses, engine=EngineConfig('fast', 32, 0.5)), room,
                 'ocp score')


def test_terminal_page_and_sheet_show_the_same_key_figures(judged):
    facts = facts_of(judged.found)
    with_room = page_facts_of(judged)
    assert {name: getattr(with_room, name) for name in vars(facts)} == vars(facts)
    figure = next(report_page.figures_of_pages(judged))
    texts = {'terminal': as_text(show_score, judged.found),
             'page': unescape(' '.join(tables_of(judged))),
             'sheet': ' '.join(text.get_text() for text in figure.findobj(Text))}
    assert [figure.label for figure in facts.figures] == [
        'depth error', 'expected (9 of 10 rooms)', 'seen', 'seen twice', 'space coverage',
        'missed', 'regions', 'overlap', 'one more camera']
    for name, text in texts.items():
        for label, value, _ in facts.figures:
            assert label in text and value in text, (name, label)
        assert facts.verdict in text and facts.cameras[0].reduction in text, name
    for name in ('terminal', 'page'):
        for cells in facts.regions:
            assert all(cell in texts[name] for cell in cells), name
    page = installer_page(judged, 'plan.png')
    assert all(value in page for _, value, _ in facts.figures[:3])


def test_a_table_shows_names_and_does_not_obey_them():
    def show(console: Console, found):
        print_table(console, found['title'], ('camera', ''), [('[red]x[/red]', 'a\x1bb')])
    text = as_text(show, {'title': '[b]'})
    assert '[red]x[/red]' in text and '[b]' in text and '\x1b' not in text
