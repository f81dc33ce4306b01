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

"""Compare generated rooms with real ones, and draw twelve of them."""

import argparse
from collections.abc import Sequence
from pathlib import Path
import sys
from typing import Any

from benchmarks import results
from benchmarks.room_likeness import generated, likeness, S3DIS_POINTS, shares_of_kinds, summary
import numpy as np
from ocp_ros.compare.protocol import rooms_in, rooms_of_s3dis
from ocp_ros.report.drawing.room_pictures import draw_rooms, titled_room
from ocp_ros.rooms.furniture import SOLID_KINDS
from ocp_ros.scenes.scene import SceneError
from ocp_ros.scenes.scene_cache import load_cached
from ocp_ros.util.terminal_text import printable
from rich.console import Console
from rich.table import Table

#: Two of each kind, as they come.
SHOWN = (3, 11, 8, 12, 1, 19, 0, 7, 21, 40, 5, 17)
#: Seeds that are measured, and points of each room.
MEASURED, POINTS = range(4000, 4200), 15000


def measured(scans: Sequence[str]) -> dict[str, Any]:
    """
    Measure generated rooms beside real ones.

    :param scans: files of real ones.
    :returns: the 10th, 50th and 90th percentile of each figure of ``generated`` rooms, the figures
        of each ``real`` one, and the shares of ``kinds`` of surfaces in generated ones and in
        S3DIS (``s3dis``), per cent.
    """
    scenes = [load_cached(name, max_points=POINTS) for name in scans]
    real = {scene.name: summary([likeness(scene)]) for scene in scenes}
    shares, published = 100.0 * shares_of_kinds(MEASURED, POINTS), np.array(S3DIS_POINTS)
    return {'generated': summary(generated(MEASURED, POINTS)),
            'real': {name: {figure: values[1] for figure, values in figures.items()}
                     for name, figures in real.items()},
            'kinds': dict(zip(SOLID_KINDS, shares.tolist())),
            's3dis': dict(zip(SOLID_KINDS, (100.0 * published / published.sum()).tolist()))}


def show(found: dict[str, Any]) -> None:
    """Print the figures of generated rooms beside those of real ones, and the shares of kinds."""
    table = Table('figure', 'generated: 10 %, median, 90 %', *map(printable, found['real']))
    for figure, values in found['generated'].items():
        table.add_row(figure, ', '.join(f'{value:.1f}' for value in values),
                      *(f'{figures[figure]:.1f}' for figures in found['real'].values()))
    kinds = Table('class', 'S3DIS (% of points)', 'generated (% of points)')
    for kind, share in found['kinds'].items():
        kinds.add_row(kind, f'{found["s3dis"][kind]:.1f}', f'{share:.1f}')
    Console(width=110).print(table, kinds)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure generated rooms beside real ones, and draw some of them."""
    parser = argparse.ArgumentParser(prog='room_sheet', description=__doc__)
    parser.add_argument('--out', type=Path, default=results.ROOT / 'docs' / 'rooms.png',
                        help='picture to write')
    parser.add_argument('--scans', type=Path, help='folder of real scans to compare with')
    results.add_record(parser, 'rooms')
    options = parser.parse_args(argv)
    try:
        scans = rooms_in(options.scans) if options.scans else []
        found = measured([*scans, *rooms_of_s3dis()])
        draw_rooms(options.out, [titled_room(seed, 40000) for seed in SHOWN])
    except (SceneError, OSError) as error:
        print(f'room_sheet: {error}', file=sys.stderr)
        return 2
    show(found)
    print(f'wrote {options.out}')
    if options.record:
        # Whoever has scans keeps them somewhere else.
        command = 'python -m benchmarks.room_sheet --record' + (
            ' --scans FOLDER' if options.scans else '')
        results.write('rooms', found, command)
    return 0


if __name__ == '__main__':
    sys.exit(main())
