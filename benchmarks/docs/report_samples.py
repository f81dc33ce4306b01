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

"""Plan generated rooms with 3, 8 and 40 cameras, and put their reports, made small, into docs/."""

import argparse
from pathlib import Path

from benchmarks.results import ROOT
from ocp_ros.cli.main import main as ocp
from ocp_ros.report.drawing.report_page import PAGE_FILES
from PIL import Image

#: Name of the picture, seed of the room, and cameras; seconds of each search.
SAMPLES, SECONDS = (('report', 16, 3), ('report_8', 16, 8), ('report_40', 5, 40)), 60
#: Pixels and colours that are left, so that a picture stays below 250 kB.
WIDTH, COLOURS = 1340, 240


def shrink(source: Path, target: Path) -> None:
    """Write a picture with fewer pixels and colours."""
    with Image.open(source) as page:
        size = (WIDTH, round(WIDTH * page.height / page.width))
        small = page.convert('RGB').resize(size, Image.Resampling.LANCZOS)
    small.quantize(COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)
    print(f'wrote {target} ({target.stat().st_size // 1000} kB)')


def main() -> None:
    """Make all samples."""
    parser = argparse.ArgumentParser(prog='report_samples', description=__doc__)
    parser.add_argument('--out', type=Path, default=ROOT / 'out' / 'report_samples',
                        help='folder of the plans')
    options = parser.parse_args()
    for name, seed, cameras in SAMPLES:
        folder = options.out / name
        code = ocp(['plan', str(seed), '--cameras', str(cameras), '--model', 'd455',
                    '--seconds', str(SECONDS), '--seed', '1', '--out', str(folder)])
        if code:
            raise SystemExit(code)
        shrink(folder / PAGE_FILES[0], ROOT / 'docs' / f'{name}.png')


if __name__ == '__main__':
    main()
