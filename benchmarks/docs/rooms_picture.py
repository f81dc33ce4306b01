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

"""Draw twelve generated rooms for the documentation."""

import argparse
from pathlib import Path
import sys

from benchmarks.results import ROOT
from ocp_ros.report.drawing.room_pictures import draw_rooms
from ocp_ros.rooms.generator import generate_room, plan_of
from ocp_ros.scenes.scene import Scene

#: Two of each kind, as they come.
SHOWN = (3, 11, 8, 12, 1, 19, 0, 7, 21, 40, 5, 17)


def titled_room(seed: int) -> tuple[str, Scene]:
    """Return a generated room, and a title with its kind and size."""
    plan = plan_of(seed)
    width, depth, height = plan.size
    return (f'{seed}: {plan.kind.replace("_", " ")}, {width:.1f} x {depth:.1f} x {height:.1f} m',
            generate_room(seed, 40000))


def main() -> int:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--out', type=Path, default=ROOT / 'docs' / 'rooms.png',
                        help='picture to write')
    draw_rooms(parser.parse_args().out, [titled_room(seed) for seed in SHOWN])
    return 0


if __name__ == '__main__':
    sys.exit(main())
