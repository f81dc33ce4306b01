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

"""The page of the studio in a real browser: drag, plan, save, load, reload, on a phone too."""

from contextlib import closing
from pathlib import Path
import re

from conftest import HUNG, made_room, wait_until
import numpy as np
from ocp_ros.geometry.cameras import Pose, rotation_matrix
from ocp_ros.report.facts import metres
import pytest

CHROMIUM = Path('/usr/bin/chromium')
pytest.importorskip('viser', reason='viser is not installed: pip install "ocp_ros[studio]"')
sync_api = pytest.importorskip('playwright.sync_api', reason='playwright is not installed')
if not CHROMIUM.exists():
    pytest.skip(f'{CHROMIUM} is not installed: apt-get install chromium', allow_module_level=True)
from ocp_ros.studio.guide_page import BUTTONS, GuidePage  # noqa: E402, I100
from ocp_ros.studio.scene_nodes import rotation_of  # noqa: E402
from ocp_ros.studio.server import start_server  # noqa: E402

DESK, PHONE = (1440, 900), (390, 844)
#: Addresses that the pages have asked for.
REQUESTS: list[str] = []
#: The depth error as the page shows it.
DEPTH_ERROR = re.compile(r'^[\d.]+ m \(.* without')

# These take a browser without a graphics card through whole pages.
pytestmark = pytest.mark.system


@pytest.fixture(scope='module')
def browser():
    """Yield a browser without a screen."""
    with sync_api.sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=str(CHROMIUM), args=[
            '--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader',
            '--enable-unsafe-swiftshader'])


@pytest.fixture
def opened(browser, page):
    """Yield a function that opens the page, and returns its tab when it shows the numbers."""
    with closing(browser.new_context()) as context:
        def open_tab(size=DESK, url=page[1]):
            tab = context.new_page()
            tab.set_viewport_size(dict(zip(('width', 'height'), size)))
            tab.set_default_timeout(1000.0 * HUNG)
            tab.on('request', lambda request: REQUESTS.append(request.url))
            tab.goto(url)
            if url == page[1]:
                tab.get_by_text(DEPTH_ERROR).first.wait_for()
            return tab
        yield open_tab


def pixel_of(client, point):
    """Return where a client sees a point (3,), metres."""
    camera = client.camera
    x, y, z = rotation_of(camera.wxyz).T @ (point - camera.position)
    focal = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
    return 0.5 * camera.image_width + focal * x / z, 0.5 * camera.image_height + focal * y / z


def depth_error(tab):
    """Return the depth error that the page shows."""
    return tab.get_by_text(DEPTH_ERROR).first.inner_text()


def show_tab(tab, name):
    """Show a part of the panel."""
    tab.get_by_role('tab', name=name).click()


def test_a_camera_is_dragged_by_its_handle(opened, page):
    page, url = page
    REQUESTS.clear()
    tab = opened()
    wait_until(page.server.get_clients)
    client, = page.server.get_clients().values()
    pose, before = page.studio.state.poses[0], depth_error(tab)
    left = rotation_matrix(*pose[3:])[:, 1]
    wait_until(lambda: page._details_shown)
    # The handles have to be drawn before a person can take them.
    tab.wait_for_timeout(1000)
    start, end = (pixel_of(client, pose[:3] + away * left) for away in (0.4, 1.5))
    tab.mouse.move(*start)
    tab.mouse.down()
    tab.mouse.move(*end, steps=10)
    tab.mouse.up()
    wait_until(lambda: depth_error(tab) != before)
    moved = page.studio.state.poses[0] - pose
    assert moved[:3] @ left > 0.2 and np.abs(moved[3:]).max() < 1e-3
    assert all(address.startswith((url, f'blob:{url}', 'data:')) for address in REQUESTS)
    wait_until(lambda: page._details_shown)
    assert depth_error(tab).startswith(metres(page.evaluation.rig_evaluation.depth_error))


def test_a_placement_is_planned_saved_and_loaded_and_survives_a_reload(opened, page):
    page, _ = page
    tab = opened()
    before = page.evaluation.rig_evaluation.loss
    show_tab(tab, 'Plan')
    tab.get_by_label('Seconds').fill('3')
    tab.get_by_role('button', name='Plan all').click()
    wait_until(lambda: page.task is not None)
    wait_until(lambda: page.task is None)
    # The last of the searches may find nothing better.
    tab.get_by_text(re.compile('found (no better than )?the objective value')).wait_for()
    assert page.evaluation.rig_evaluation.loss < before
    show_tab(tab, 'Files')
    tab.get_by_role('textbox').fill('best')
    tab.get_by_role('button', name='Placement', exact=True).click()
    tab.get_by_text('wrote best.yaml').wait_for()
    poses = page.studio.state.poses
    page.enqueue(lambda: page.studio.move_camera(0, poses[0] + 0.1))
    wait_until(lambda: not np.array_equal(page.studio.state.poses, poses))
    tab.get_by_role('button', name='Load').click()
    wait_until(lambda: np.array_equal(page.studio.state.poses, poses))
    shown = metres(page.evaluation.rig_evaluation.depth_error)
    wait_until(lambda: depth_error(tab).startswith(shown))
    tab.reload()
    wait_until(lambda: depth_error(tab).startswith(shown))


def test_numbers_are_typed_and_steps_taken_back_by_keyboard_and_violations_mended(opened, page):
    page, _ = page
    tab = opened()
    wait_until(lambda: page._details_shown)
    poses = page.studio.state.poses
    yaw = tab.get_by_role('textbox').nth(3)
    yaw.fill('77')
    yaw.press('Tab')
    wait_until(lambda: np.rad2deg(page.studio.state.poses[0, 3]) == pytest.approx(77.0, abs=0.1))
    # Keys that are pressed in a field belong to the field.
    tab.mouse.click(100, 700)
    tab.keyboard.press('Control+Alt+z')
    wait_until(lambda: np.array_equal(page.studio.state.poses, poses))
    page.enqueue(lambda: page.studio.move_camera(0, poses[0] + [0.0, 0.0, 1.5, 0.0, 0.0, 0.0]))
    tab.get_by_text('mount.height').first.wait_for()
    tab.get_by_role('button', name='Move to the nearest allowed pose').click()
    wait_until(lambda: not page.evaluation.violations)


@pytest.mark.parametrize('size', [DESK, PHONE], ids=['desk', 'phone'])
def test_every_part_of_the_panel_fits(opened, page, size):
    page, _ = page
    page.enqueue(lambda: page.panel._add_zone('region'))
    # After an edit no help appears, which would go while the controls are looked at.
    wait_until(lambda: page.studio.history.past_states)
    tab = opened(size)
    for name in ('Cameras', 'View', 'Zones', 'Plan', 'Files', 'Numbers'):
        show_tab(tab, name)
        tab.wait_for_timeout(500)
        assert_fits(tab, size)
    if size == PHONE:
        header = tab.get_by_text('ocp studio').last
        assert header.bounding_box()['y'] < 0.6 * size[1]
        header.click()
        wait_until(lambda: header.bounding_box()['y'] > 0.9 * size[1])


def assert_fits(tab, size):
    """Assert that no control is cut off at the sides, and that scrolling reaches all of them."""
    assert tab.evaluate('document.documentElement.scrollWidth') <= size[0]
    for control in tab.locator('button:visible, input:visible, svg:visible').all():
        control.scroll_into_view_if_needed()
        box = control.bounding_box()
        assert box['x'] >= 0 and box['x'] + box['width'] <= size[0], control.inner_html()
        assert box['y'] >= 0 and box['y'] + box['height'] <= size[1], control.inner_html()


def test_a_search_is_started_and_stopped_by_keyboard(opened, page):
    page, _ = page
    tab = opened()
    tab.get_by_role('tab', name='Cameras').focus()
    for _ in range(3):
        tab.keyboard.press('ArrowRight')

    def press_button(name):
        for _ in range(20):
            if tab.evaluate('document.activeElement.textContent') == name:
                tab.keyboard.press('Enter')
                return
            tab.keyboard.press('Tab')
        raise AssertionError(name)

    tab.get_by_label('Seconds').fill('600')
    press_button('Plan all')
    wait_until(lambda: page.task is not None)
    tab.get_by_role('button', name='Stop').wait_for()
    press_button('Stop')
    wait_until(lambda: page.task is None)


def test_the_guide_fits_a_phone(opened):
    server, url = start_server(port=0)
    pressed = []
    guide = GuidePage(server, pressed.append)
    guide.set_cloud(made_room(3, 3000).points)
    guide.poses = [Pose.of(np.array([2.0, 3.0, 1.5, 0.5 * k, 0.1, 0.0])) for k in range(4)]
    guide.targets = [Pose.of(np.array([2.0 + k, 4.0, 1.8, 1.0, 0.2, 0.0])) for k in range(4)]
    guide.instructions = 'camera 3: 3.00 m →\nexpected: 5 % of what is missing is gone'
    guide.status = 'not final: turn 1 of 5'
    guide.show()
    tab = opened(PHONE, url)
    tab.get_by_text('camera 3: 3.00 m →').wait_for()
    tab.wait_for_timeout(1000)
    assert_fits(tab, PHONE)
    for number, label in enumerate(BUTTONS, 1):
        tab.get_by_role('button', name=label).click()
        # Of clicks within 50 ms, which no person makes, the page sends the first and the last.
        wait_until(lambda: pressed == list(BUTTONS[:number]))
    tab.close()
    server.stop()


def test_names_of_files_and_typed_names_are_text(opened, page, tmp_path):
    page, _ = page
    name = '<img src=x onerror=document.harmed=1>'
    (tmp_path / f'{name}.yaml').write_text('cameras: 3')
    page.enqueue(page.panel._list_files)
    tab = opened()
    show_tab(tab, 'Files')
    tab.get_by_role('button', name='Load').click()
    tab.get_by_text(f'{name}.yaml').first.wait_for()
    tab.get_by_role('textbox').first.fill(name)
    tab.get_by_role('button', name='Placement', exact=True).click()
    tab.get_by_text(f"name: found '{name}'").wait_for()
    assert tab.evaluate('document.harmed') is None
