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

"""
Take the pictures of the studio for the documentation, in a browser.

    python -m benchmarks.docs.studio_pictures
"""

from collections.abc import Callable
from pathlib import Path
import re
import tempfile

from benchmarks.results import ROOT
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.scene_source import room_named
from ocp_ros.studio.folder import Folder
from ocp_ros.studio.model import Studio
from ocp_ros.studio.page import Page
from ocp_ros.studio.server import start_server
from ocp_ros.studio.tasks import Progress, search_work, Task
from playwright.sync_api import Page as Tab
from playwright.sync_api import sync_playwright

#: A generated room and its number of points.
ROOM, POINTS = '3', 25_000
#: Sizes of a desk's and a phone's screen, pixels, and seconds of the search.
DESK, PHONE, SECONDS = (1280, 800), (390, 844), 20.0
#: Milliseconds until everything is drawn, also by software.
DRAWN = 12_000


def main() -> None:
    """Take a picture of the start, of a comparison and of a phone."""
    scene, room = room_named(ROOM, POINTS)
    server, url = start_server(port=0)
    studio = Studio(scene, room, rig_of(4, 'realsense_d455', mount={'on': 'walls'}))
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page = Page(server, studio, Folder(Path(folder)))
        browser = playwright.chromium.launch(executable_path='/usr/bin/chromium', args=[
            '--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader',
            '--enable-unsafe-swiftshader'])

        def take(name: str, size: tuple[int, int], show: Callable[[Tab], None]) -> None:
            tab = browser.new_page(viewport={'width': size[0], 'height': size[1]})
            tab.set_default_timeout(120_000)
            tab.goto(url)
            tab.get_by_text(re.compile(r'^[\d.]+ m \(.* without')).first.wait_for()
            tab.wait_for_timeout(DRAWN)
            for button in tab.locator('.mantine-Notification-closeButton').all():
                button.click()
            show(tab)
            tab.wait_for_timeout(DRAWN // 4)
            path = ROOT / 'docs' / f'{name}.png'
            tab.screenshot(path=path)
            tab.close()
            print(f'wrote {path}')

        take('studio', DESK, lambda tab: None)
        page.enqueue(lambda: page.panel.compare(page.evaluation))

        def take_over(news: Progress) -> None:
            if news.poses is not None:
                poses = news.poses
                page.enqueue(lambda: studio.set_placement(studio.state.rig, poses))

        Task(search_work(studio, studio.state), SECONDS, take_over).join()
        take('studio_compared', DESK, lambda tab: tab.get_by_role('tab', name='Numbers').click())
        page.enqueue(lambda: page.panel.compare(None))
        take('studio_phone', PHONE, lambda tab: None)
        page.close()


if __name__ == '__main__':
    main()
