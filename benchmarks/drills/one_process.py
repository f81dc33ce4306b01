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
Open the studio and plan many times in one process, and see that its memory stays flat.

In a session of the studio a client drags a camera, starts a search, and saves the placement; then
the page and its server are closed. Plans are those of :func:`ocp_ros.plan` in rooms and with rigs
that differ. Memory after the first fifth of the repetitions is compared with that at the end.
"""

import argparse
from collections.abc import Iterator, Sequence
import ctypes
import gc
import json
import os
from pathlib import Path
import sys
import tempfile
import time

from benchmarks import results
from benchmarks.drills.drill import grown, rss_of
from benchmarks.page_client import PageClient
from benchmarks.studio import HEIGHT, NAME, places
import numpy as np
from ocp_ros import generate_room, plan, rig_of
from ocp_ros.studio.folder import Folder
from ocp_ros.studio.model import Studio
from ocp_ros.studio.page import Page
from ocp_ros.studio.server import start_server
from ocp_ros.util.settings import UserError
from rich.console import Console
from rich.progress import track

#: Points of the rooms, movements of a session, and evaluations of a plan.
POINTS, MOVEMENTS, EVALUATIONS = 3000, 50, 50
#: Seeds of the rooms of the plans and their rigs, which are planned by turns.
ROOMS, RIGS = range(1, 4), tuple(
    {'cameras': count, 'sensor': sensor, 'mount': mount}
    for count, sensor, mount in ((2, 'omnidirectional', 'plane'), (4, 'realsense_d455', 'walls'),
                                 (3, 'kinect_v2', 'free')))
#: Seconds after which an answer of the page that has not come never comes.
PATIENCE = 600.0


def sessions(count: int) -> Iterator[None]:
    """Open and close the studio; yields after each session."""
    scene = generate_room(1, POINTS)
    for _ in range(count):
        server, url = start_server(port=0)
        with tempfile.TemporaryDirectory() as folder:
            page = Page(server, Studio(scene, {'seed': 1, 'points': POINTS}, rig_of(
                3, 'realsense_d455', mount={'on': 'walls'})), Folder(Path(folder)))
            with PageClient(url) as client:
                _play(client, page)
            page.close()
            if not list(Path(folder).iterdir()):
                raise RuntimeError('studio: found no file; expected a saved placement')
        yield


def _play(client: PageClient, page: Page) -> None:
    """Drag a camera, search for a second, and save."""
    def press(handle, value) -> None:
        client.send('GuiUpdateMessage', uuid=handle._impl.uuid, updates={'value': value})

    def until_shown(text: str) -> None:
        client.until(lambda message: text in str(message.get('updates', '')), PATIENCE)

    client.look()
    client.until(lambda message: (message['type'], message.get('name')) == (
        'TransformControlsMessage', f'/cameras/{NAME}'), PATIENCE)
    client.send('TransformControlsDragStartMessage', name=f'/cameras/{NAME}')
    centre = page.studio.scene.bounds.mean(axis=0).tolist()
    for place in places([*centre[:2], HEIGHT], MOVEMENTS):
        client.drag(f'/cameras/{NAME}', place)
        time.sleep(0.01)
    client.send('TransformControlsDragEndMessage', name=f'/cameras/{NAME}')
    press(page.panel.seconds, 1.0)
    press(page.panel.plan_buttons['Plan all'], True)
    until_shown('searching')
    until_shown('found')
    press(page.panel.save_buttons, 'Placement')
    until_shown('wrote')


def plans(count: int) -> Iterator[None]:
    """Plan; yields after each plan."""
    for number in range(count):
        try:
            plan(ROOMS[number % len(ROOMS)], **RIGS[number % len(RIGS)], points=POINTS,
                 evaluations=EVALUATIONS, seed=number)
        except UserError as error:
            raise RuntimeError(f'plan {number}: {error}') from error
        yield


def memory_of(repetitions: Iterator[None], count: int, name: str) -> dict[str, float]:
    """
    Repeat something, and return how much more memory this process holds at the end, MB.

    Medians of a fifth of the repetitions are compared: the second and the last. What could be
    freed is not counted.
    """
    began = time.monotonic()
    held = np.empty(count)
    for number, _ in enumerate(track(repetitions, name, total=count,
                                     console=Console(stderr=True))):
        # Pages and their clients refer to each other: Python frees them late by itself, and the
        # allocator keeps what is freed.
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
        held[number] = rss_of(os.getpid())
    fifth = max(count // 5, 1)
    first, last = (float(np.median(part)) for part in (held[fifth:2 * fifth], held[-fifth:]))
    return {'repetitions': count, 'seconds': round(time.monotonic() - began),
            'memory_mb': round(last, 1), 'memory_growth_mb': round(last - first, 1),
            'peak_above_first_mb': round(float(held.max()) - first, 1)}


def main(argv: Sequence[str] | None = None) -> int:
    """Run; 2 if memory has grown."""
    parser = argparse.ArgumentParser(prog='one_process', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--sessions', type=int, default=50, help='of the studio')
    parser.add_argument('--plans', type=int, default=300)
    results.add_record(parser, 'drills')
    options = parser.parse_args(argv)
    found = {name: memory_of(repeat(count), count, name) for name, repeat, count in (
        ('sessions', sessions, options.sessions), ('plans', plans, options.plans))}
    print(json.dumps(found, indent=1))
    faults = grown({name: figures['memory_growth_mb'] for name, figures in found.items()})
    print(*faults, sep='\n')
    if options.record and not faults:
        results.write('drills', found, results.command_of('drills.one_process', argv),
                      'one_process')
    return 2 if faults else 0


if __name__ == '__main__':
    sys.exit(main())
