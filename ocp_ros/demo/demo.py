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
Place cameras in a room over real ROS: a simulated rig and a policy, each in its own process.

The demo writes ``demo.json`` and ``demo.png`` to the output folder and prints a small table.
"""

import argparse
from pathlib import Path
import sys
from typing import Any

import numpy as np
from ocp_ros.demo.watched_nodes import NodeProcess, run_watched, stopped_at_the_end, Watch, Watcher
from ocp_ros.report.drawing.room_pictures import draw_placement
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.ros.policy.policy_config import PLANNERS, PolicyNodeConfig
from ocp_ros.ros.sim_node import SimNodeConfig
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.source_frame import UP_CHOICES
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import from_flat, to_nested
from ocp_ros.util.yaml_files import timestamp
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

#: Longest wait for the first turn, seconds: the first run on a machine compiles the kernels.
START_TIMEOUT_S = 180.0


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    defaults = SimNodeConfig()
    parser = argparse.ArgumentParser(prog='demo', description=__doc__)
    parser.add_argument('--room', type=Path, help='scan of the room; default: a generated room')
    parser.add_argument('--cameras', type=int, default=defaults.rig.cameras)
    parser.add_argument('--turns', type=int, default=defaults.episode.turns)
    parser.add_argument('--height', type=float, default=defaults.rig.height, help='metres')
    parser.add_argument('--seed', type=int, default=defaults.scene.seed,
                        help='seed of the generated room')
    parser.add_argument('--scale', type=float, default=defaults.scene.scale,
                        help='metres per unit of the scan, 0.001 for millimetres')
    parser.add_argument('--up', choices=UP_CHOICES, default=defaults.scene.up,
                        help='direction of the scan that points up, such as --up=-y; auto: guess')
    parser.add_argument('--drop-nonfinite', action='store_true',
                        help='leave out points with NaN or inf')
    parser.add_argument('--all-rooms', action='store_true',
                        help='keep what the scan shows of other rooms through openings')
    parser.add_argument('--planner', choices=PLANNERS, default=PolicyNodeConfig.planner,
                        help='planner of the moves')
    parser.add_argument('--model', default=PolicyNodeConfig.model, help='weights: path or name')
    parser.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    return parser


def sim_parameters(options: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of ``sim_node`` that the options set."""
    scene_file = {'scene.file': str(options.room.resolve())} if options.room else {}
    return {**scene_file, 'rig.cameras': options.cameras, 'episode.turns': options.turns,
            'rig.height': options.height, 'scene.seed': options.seed,
            'scene.scale': options.scale, 'scene.up': options.up,
            'scene.drop_nonfinite': options.drop_nonfinite, 'scene.all_rooms': options.all_rooms}


def policy_parameters(options: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of ``policy_node`` that the options set."""
    return {'planner': options.planner, 'model': options.model, 'turns': options.turns}


def run_episode(options: argparse.Namespace, domain: int, watch: Watch) -> None:
    """Start both nodes and wait until the placement is final; show the progress."""
    watcher = watch.node
    logs = options.out / 'logs'
    processes: list[NodeProcess] = []
    columns = (TextColumn('{task.description}'), BarColumn(), MofNCompleteColumn(),
               TextColumn('{task.fields[error]}'))
    with stopped_at_the_end(processes), \
            Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task('starting nodes', total=options.turns, error='')
        processes.append(
            NodeProcess('sim_node', domain, logs / 'sim_node.log', sim_parameters(options)))
        watch.spin_until(lambda: watcher.scene is not None and bool(watcher.turns()),
                         START_TIMEOUT_S, 'first turn of sim_node', processes)
        for warning in processes[0].warnings():
            progress.console.print(warning, markup=False)
        processes.append(NodeProcess(
            'policy_node', domain, logs / 'policy_node.log', policy_parameters(options)))
        # The first move waits for the start of policy_node, later moves do not.
        turn_timeout_s = START_TIMEOUT_S
        # Turn 0, before the first move.
        turns = watcher.turns()[:1]
        while watcher.final_turn() is None:
            watch.spin_until(
                lambda: len(watcher.turns()) > len(turns) or watcher.final_turn() is not None,
                turn_timeout_s, 'next turn', processes)
            turn_timeout_s = 60.0
            turns = watcher.turns()
            progress.update(task, description='placing cameras', completed=len(turns) - 1,
                            error=f'depth error {turns[-1][1]["depth_error"]:.2f} m')


def collect_result(options: argparse.Namespace, watcher: Watcher) -> dict[str, Any]:
    """Return the figures of the episode, as the nodes published them."""
    final_turn = watcher.final_turn()
    fields = [turn_fields for _, turn_fields in watcher.turns()[:final_turn + 1]]
    # The time from the start (0) to the first turn (1) includes the start of the policy.
    seconds = [later['received'] - earlier['received']
               for earlier, later in zip(fields[1:-1], fields[2:])]
    scores = {f'{name}_{end}': values[name] for name in ('depth_error', 'space_coverage')
              for end, values in (('start', fields[0]), ('end', fields[-1]))}
    return {
        'room': str(options.room.name if options.room else f'room-{options.seed}'),
        'points': len(watcher.scene), 'cameras': len(watcher.placement),
        'turns': final_turn, **scores,
        'seconds_per_turn': float(np.median(seconds)) if seconds else None,
        'positions': np.round(watcher.placement, 4).tolist(), 'planner': options.planner,
        'model': options.model, 'date': timestamp()}


def draw_result(options: argparse.Namespace, watcher: Watcher, result: dict[str, Any],
                path: Path) -> None:
    """Draw the room, the trajectories of the cameras and their final positions."""
    config = SimulationConfig(rig=RigConfig(cameras=result['cameras'], height=options.height))
    scene = Scene(watcher.scene, name=result['room'])
    visible = Simulator(scene, config).evaluate(watcher.placement).visible
    trajectories = np.stack([positions for positions, _ in watcher.turns()[:result['turns'] + 1]])
    draw_placement(
        path, scene.points, visible, trajectories, config.rig.max_range,
        f'{result["room"]}: {result["cameras"]} cameras placed in {result["turns"]} turns',
        f'depth error {result["depth_error_start"]:.2f} m → {result["depth_error_end"]:.2f} m, '
        f'space coverage {result["space_coverage_start"]:.0f} m³ → '
        f'{result["space_coverage_end"]:.0f} m³, {result["points"]:,} points')


def result_table(result: dict[str, Any]) -> Table:
    """Return the results as a table for the terminal."""
    table = Table(title=f'{result["room"]}: {result["points"]:,} points, '
                  f'{result["cameras"]} cameras, {result["turns"]} turns')
    for name in ('', 'start', 'end'):
        table.add_column(name, justify='left' if not name else 'right')
    for name, key, unit in (('depth error', 'depth_error', 'm'),
                            ('space coverage', 'space_coverage', 'm³')):
        table.add_row(name, *(f'{result[f"{key}_{end}"]:.2f} {unit}' for end in ('start', 'end')))
    for number, (x, y, z) in enumerate(result['positions'], start=1):
        table.add_row(f'camera {number}', '', f'x {x:.2f}  y {y:.2f}  z {z:.2f} m')
    if result['seconds_per_turn'] is not None:
        table.add_row('time per turn', '', f'{1e3 * result["seconds_per_turn"]:.0f} ms')
    return table


def run_demo(options: argparse.Namespace, domain: int, watch: Watch) -> dict[str, Any]:
    """Run an episode, draw its final placement, and return the results."""
    run_episode(options, domain, watch)
    result = collect_result(options, watch.node)
    draw_result(options, watch.node, result, options.out / 'demo.png')
    result['config'] = {
        'sim_node': to_nested(from_flat(SimNodeConfig, sim_parameters(options))),
        'policy_node': to_nested(from_flat(PolicyNodeConfig, policy_parameters(options)))}
    return result


def print_result(options: argparse.Namespace, result: dict[str, Any]) -> None:
    """Print the results as a table, and the names of the written files."""
    Console().print(result_table(result))
    if result['depth_error_end'] > result['depth_error_start']:
        print(f'{result["planner"]} left the cameras worse than it found them: a policy may when '
              'the room or the number of cameras is unlike those it was trained with.')
    print(f'wrote {options.out / "demo.json"} and {options.out / "demo.png"}')


def main(args: list[str] | None = None) -> int:
    """Run the demo; report bad input in one sentence with exit code 2."""
    options = build_parser().parse_args(args)
    return run_watched('demo', options.out, lambda domain, watch: run_demo(options, domain, watch),
                       lambda result: print_result(options, result), (RuntimeError, OSError))


if __name__ == '__main__':
    sys.exit(main())
