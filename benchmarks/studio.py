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
Measure the page of the studio: time from an event to new colours, memory, and bytes sent.

A client without a browser drags a camera by its handle and waits for the colours, in a process of
its own, so that it does not share Python's lock with the server.
"""

import argparse
from collections.abc import Iterator, Sequence
import json
import math
from multiprocessing import get_context
from pathlib import Path
import resource
import sys
import tempfile
import time
from typing import Any

from benchmarks.page_client import PageClient, paints
from benchmarks.results import add_record, command_of, write
import numpy as np
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rooms.generator import generate_room
from ocp_ros.studio.folder import Folder
from ocp_ros.studio.model import Studio
from ocp_ros.studio.page import Page
from ocp_ros.studio.server import start_server

#: Points and cameras of each measurement, and the seed of the room.
SIZES, SEED = ((25_000, 4), (100_000, 8)), 7
#: Movements that are measured, those of the measurement of memory, and reconnections.
MOVEMENTS, MANY, RECONNECTIONS = 200, 1000, 20
#: Movements before the measurement, and seconds between two of them: as a person moves a mouse.
WARM, APART = 20, 0.1
#: Height of the dragged camera, metres, and its name.
HEIGHT = 2.0
#: Seconds after which colours that have not come never come.
PATIENCE = 30.0
NAME = 'realsense_d455_1'


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print and perhaps record the figures."""
    parser = argparse.ArgumentParser(prog='benchmarks.studio', description=__doc__)
    parser.add_argument('--movements', type=int, default=MOVEMENTS)
    parser.add_argument('--many', type=int, default=MANY)
    add_record(parser, 'studio')
    arguments = parser.parse_args(argv)
    rows = [measured(points, cameras, arguments.movements, arguments.many)
            for points, cameras in SIZES]
    figures = {'room': f'generated room {SEED}', 'movements': arguments.movements,
               'many_movements': arguments.many, 'reconnections': RECONNECTIONS, 'sizes': rows}
    print(json.dumps(figures, indent=1))
    if arguments.record:
        write('studio', figures, command_of('studio', argv))
    return 0


def measured(points: int, cameras: int, movements: int, many: int) -> dict[str, Any]:
    """Return the figures for a number of points and cameras."""
    scene = generate_room(SEED, points)
    rig = rig_of(cameras, 'realsense_d455', mount={'on': 'walls'})
    server, url = start_server(port=0)
    with tempfile.TemporaryDirectory() as folder:
        page = Page(server, Studio(scene, {'seed': SEED, 'points': points}, rig),
                    Folder(Path(folder)))
        # In the middle each movement changes what the camera sees.
        pose = [*scene.bounds.mean(axis=0)[:2].tolist(), HEIGHT]
        with get_context('spawn').Pool(1) as pool:
            times, size = pool.apply(dragged, (url, pose, movements))
            before = memory()
            pool.apply(dragged, (url, pose, many, 0.0))
            after = memory()
            pool.apply(reconnected, (url, RECONNECTIONS))
            again = memory()
        page.close()
    milliseconds = 1000.0 * np.array(times)
    found = {'points': len(scene), 'cameras': cameras,
             'event_to_colours_ms': {
                 'p50': round(float(np.percentile(milliseconds, 50)), 1),
                 'p99': round(float(np.percentile(milliseconds, 99)), 1)},
             'bytes_per_movement': round(size / movements),
             'memory_growth_mb': {'movements': round(after - before, 1),
                                  'reconnections': round(again - after, 1)}}
    print(json.dumps(found), flush=True)
    return found


def memory() -> float:
    """Return the resident memory of this process, megabytes."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def places(pose: Sequence[float], count: int) -> Iterator[tuple[float, ...]]:
    """Yield positions around a pose, each different from the last."""
    for k in range(count):
        turn = 2.0 * math.pi * k / 50.0
        yield (pose[0] + 0.3 * math.cos(turn), pose[1] + 0.3 * math.sin(turn), pose[2])


def dragged(url: str, pose: Sequence[float], count: int, apart: float = APART
            ) -> tuple[list[float], int]:
    """Drag a camera; return the seconds until the colours came, and the bytes received."""
    with PageClient(url) as client:
        client.look()
        client.until(lambda message: (message['type'], message.get('name')) == (
            'TransformControlsMessage', f'/cameras/{NAME}'))
        client.send('TransformControlsDragStartMessage', name=f'/cameras/{NAME}')
        times, first = [], 0
        for k, place in enumerate(places(pose, count + WARM)):
            if k == WARM:
                first = client.received
            began = time.perf_counter()
            client.drag(f'/cameras/{NAME}', place)
            client.until(paints, PATIENCE)
            times.append(time.perf_counter() - began)
            time.sleep(apart)
        return times[WARM:], client.received - first


def reconnected(url: str, count: int) -> None:
    """Connect and disconnect some times."""
    for _ in range(count):
        with PageClient(url) as client:
            client.look()
            client.until(lambda message: message['type'] == 'ReplayDoneMessage')


if __name__ == '__main__':
    sys.exit(main())
