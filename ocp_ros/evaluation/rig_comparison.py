# SPDX-License-Identifier: Apache-2.0
"""
What every planner finds for a rig in a room, on the same budget and under the same constraints.

    python -m ocp_ros.evaluation.rig_comparison --room 7 --evaluations 2000
"""

import argparse
from collections.abc import Sequence
import time

from rich.console import Console
from rich.table import Table

from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.planners.budget import Budget
from ocp_ros.planners.rig_methods import PLANNERS
from ocp_ros.planners.rig_plan import RigPlan, RigPlanner
from ocp_ros.rig.rig_file import Rig, rig_of
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.scene_source import make_room


def plans_of(scene: Scene, rig: Rig, planner: str, evaluations: int, seeds: int
             ) -> tuple[list[RigPlan], float]:
    """
    Plan a rig with every seed.

    :returns: the plans, and the seconds of processor time that each took.
    """
    began, plans = time.process_time(), []
    for seed in range(seeds):
        method = RigPlanner(scene, rig, EngineConfig(), Budget(evaluations=evaluations), seed,
                            planner=planner)
        plans.append(method.plan(rig))
    return plans, (time.process_time() - began) / seeds


def main(argv: Sequence[str] | None = None) -> None:
    """Print a table: for each planner and sensor the losses, and how long they took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--room', default='7')
    parser.add_argument('--sensors', default='d455,omnidirectional')
    parser.add_argument('--cameras', type=int, default=4)
    parser.add_argument('--planners', default=','.join(PLANNERS))
    parser.add_argument('--evaluations', type=int, default=2000)
    parser.add_argument('--points', type=int, default=25000)
    parser.add_argument('--seeds', type=int, default=3)
    arguments = parser.parse_args(argv)
    scene = make_room(arguments.room, 0.0, arguments.points)
    sensors = arguments.sensors.split(',')
    table = Table('planner', *(f'{sensor}, {title}' for sensor in sensors for title in (
        'mean loss (best, worst)', 's')))
    for planner in arguments.planners.split(','):
        row = []
        for sensor in sensors:
            plans, seconds = plans_of(scene, rig_of(arguments.cameras, sensor), planner,
                                      arguments.evaluations, arguments.seeds)
            losses = [plan.worth.loss for plan in plans]
            row += [f'{sum(losses) / len(losses):.4f} ({min(losses):.4f}, {max(losses):.4f})',
                    f'{seconds:.1f}']
        table.add_row(planner, *row)
    Console(width=120).print(table)


if __name__ == '__main__':
    main()
