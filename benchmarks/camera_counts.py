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
How many cameras are needed: counted up from plan to plan, against each number planned anew.

    python -m benchmarks.camera_counts --rooms 5,8,12,21,40 --evaluations 20000
"""

import argparse
from collections.abc import Sequence
import sys

from benchmarks import results
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_file import rig_of, with_count
from ocp_ros.rooms.scene_source import make_room
from ocp_ros.search.budget import Budget
from ocp_ros.search.rig_plan import RigPlan, RigPlanner
from rich.console import Console
from rich.table import Table


def curves(room: str, sensor: str, evaluations: int, most: int, points: int, seed: int
           ) -> tuple[list[RigPlan], list[RigPlan]]:
    """
    Plan all numbers of cameras in a room both ways, at the same budget for each number.

    :returns: the plans for 1, 2, ... ``most`` cameras, each from the one before, and each anew.
    """
    scene, rig = make_room(room, 0.0, points), rig_of(1, sensor)
    planner = RigPlanner(scene, rig, EngineConfig(), Budget(evaluations=evaluations), seed)

    def counted(count: int):
        return with_count(rig, count)

    return (list(planner.count_up(counted, 1, most)),
            [planner.plan(counted(count)) for count in range(1, most + 1)])


def needed(plans: Sequence[RigPlan], by: str, target: float) -> int | None:
    """Return the least number of cameras that reaches a share; None where none does."""
    return next((len(plan.rig.cameras) for plan in plans if plan.reaches(by, target)), None)


def main(argv: Sequence[str] | None = None) -> int:
    """Print a table: for each room how many are needed by both ways, and the shares behind it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rooms', default='5,8,12,21,40')
    parser.add_argument('--sensor', default='omnidirectional')
    parser.add_argument('--evaluations', type=int, default=20000)
    parser.add_argument('--most', type=int, default=6)
    parser.add_argument('--points', type=int, default=8000)
    parser.add_argument('--target', type=float, default=0.95)
    parser.add_argument('--seed', type=int, default=0)
    results.add_record(parser, 'camera_counts')
    arguments = parser.parse_args(argv)
    table = Table('room', 'by', 'counted up', 'each anew', 'shares counted up', 'shares anew')
    rows = []
    for room in arguments.rooms.split(','):
        both = curves(room, arguments.sensor, arguments.evaluations, arguments.most,
                      arguments.points, arguments.seed)
        for by in ('seen', 'error'):
            counts = [needed(plans, by, arguments.target) for plans in both]
            shares = [[plan.shares[by] for plan in plans] for plans in both]
            table.add_row(room, by, *map(str, counts),
                          *(' '.join(f'{share:.3f}' for share in one) for one in shares))
            rows.append({'room': room, 'by': by, 'counted_up': counts[0], 'each_anew': counts[1],
                         'shares_counted_up': shares[0], 'shares_anew': shares[1]})
    Console(width=150).print(table)
    if arguments.record:
        results.write('camera_counts', {'target': arguments.target, 'rooms': rows},
                      results.command_of('camera_counts', argv))
    return 0


if __name__ == '__main__':
    sys.exit(main())
