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
Measure the nodes: how soon live cameras get a command, big clouds, placements, training over ROS.

    python -m benchmarks.drills.node_bench --seconds 0 --record

A simulated rig in this process moves at some speed and publishes clouds, whose points are found by
ray casting in the room; ``policy_node`` runs in a process of its own. The time of a turn is that
from the newest cloud that a command uses to the command, and what the node takes of the processor
meanwhile.
"""

import argparse
from collections.abc import Iterable
import json
import os
from pathlib import Path
import tempfile
import time
from typing import Any, NamedTuple

from benchmarks import results
from benchmarks.drills.drill import rss_of
from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.compare.protocol import JudgedRoom
from ocp_ros.demo.train_demo import start_nodes
from ocp_ros.demo.watched_nodes import (
    end_on_signals,
    free_domain,
    NodeProcess,
    stopped_at_the_end,
    Watch,
)
from ocp_ros.geometry.cameras import heading_of, rotation_matrix
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.rig.motion import towards, turned_towards
from ocp_ros.rig.rig_file import MOVING
from ocp_ros.rooms.room_sets import VALIDATION
from ocp_ros.ros.interface import qos, topics
from ocp_ros.ros.interface.conversions import (
    cloud_to_msg,
    msg_to_poses,
    ns_to_stamp,
    positions_to_msg,
    stamp_to_ns,
)
from ocp_ros.ros.runtime.node_main import LOCALHOST_ENVIRONMENT
from ocp_ros.scenes.source_frame import BY_FILE
from ocp_ros.search.budget import Budget
from ocp_ros.search.plan import plan
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.util.threads import cores
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

#: Numbers of pairs of sim and policy; transitions before a training is measured; longest wait, s.
PAIRS, STARTS, PATIENCE = (1, 2, 4), 100, 600.0
AROUND = 'cameras: [{{sensor: omnidirectional, max_range: 4.0, count: {}}}]\n' \
    'mount: {{on: plane, height: 1.9}}\n'
#: Points of a scan and of that of the judge.
POINTS, JUDGE_POINTS = 60_000, 90_000
#: Evaluations of a search that knows the scan, seconds between two poses.
EVALUATIONS, POSE_S = 1000, 0.02
#: How often a room is played whose placement is judged.
RUNS = 3
#: Standard deviations of measured poses: metres and radians.
NOISE = 0.01, np.deg2rad(1.0)


class Case(NamedTuple):
    """
    A rig in some rooms.

    :ivar rig: text of a rig file, or the path of one.
    :ivar rooms: seeds of generated rooms.
    :ivar speed: of the cameras, m/s and rad/s.
    :ivar pixels: width and height of each camera's clouds.
    :ivar rate: clouds of a camera in a second.
    :ivar parameters: of ``policy_node``.
    """

    rig: str
    rooms: tuple[int, ...]
    speed: float
    pixels: tuple[int, int] = (160, 120)
    rate: float = 10.0
    parameters: dict[str, Any] = {}


class MovingRig(Node):
    """
    Cameras that move to where they are sent, and publish poses with noise and clouds.

    :param problem: the rig in a room; it says which points each pose sees.
    :param placement: (K, 6) metres and radians, where the cameras begin.
    :param case: see :class:`Case`.
    :ivar latencies: of each turn: seconds, and seconds of the processor.
    :ivar commanded: (K, 3) of each turn, metres.
    """

    def __init__(self, problem: Problem, placement: np.ndarray, case: Case, **kwargs) -> None:
        super().__init__('rig', **kwargs)
        self._problem, self._case = problem, case
        self.placement, self._goal = placement.copy(), placement.copy()
        self._rng = np.random.default_rng(0)
        #: For each camera the pose of its last view, and the serialised cloud from there.
        self._views: list[tuple[bytes, bytearray]] = [(b'', bytearray())] * len(placement)
        #: By stamp of a cloud: when it was published, and the processor time of the node then.
        self._sent: dict[int, tuple[float, float]] = {}
        self.latencies: list[tuple[float, float]] = []
        self.commanded: list[np.ndarray] = []
        self.clouds, self.pid = 0, 0
        self._answered, self._is_moving = 0, False
        self._poses = self.create_publisher(PoseArray, topics.CAMERA_POSES, qos.LOOP)
        self._clouds = [self.create_publisher(PointCloud2, f'points_{camera}', qos.LOOP)
                        for camera in range(len(placement))]
        self.create_subscription(PoseArray, topics.CAMERA_COMMANDS, self._on_command, qos.LOOP)
        self.create_timer(POSE_S, self._move)
        self._last_move = time.monotonic()
        self.create_timer(1.0 / case.rate, self._send_clouds)

    def _on_command(self, message: PoseArray) -> None:
        """Go where the cameras are sent; a command that came before is repeated."""
        now, stamp = time.monotonic(), stamp_to_ns(message.header.stamp)
        poses = msg_to_poses(message)
        self._goal = np.array([[*pose.position, *heading_of(pose.rotation)] for pose in poses])
        if stamp > self._answered and stamp in self._sent:
            sent, processor = self._sent[stamp]
            self.latencies.append((now - sent, processor_of(self.pid) - processor))
            self.commanded.append(self._goal[:, :3])
            self._answered = stamp

    def _move(self) -> None:
        """Move and rotate the cameras, and publish where they are."""
        now = time.monotonic()
        way, self._last_move = self._case.speed * (now - self._last_move), now
        placement, goal, before = self.placement, self._goal, self.placement.copy()
        placement[:, :2] = towards(placement[:, :2], goal[:, :2], way)
        placement[:, 2] += np.clip(goal[:, 2] - placement[:, 2], -way, way)
        placement[:, 3:] = turned_towards(placement[:, 3:], goal[:, 3:], way)
        self._is_moving = not np.allclose(placement, before, atol=1e-4)
        metres, radians = NOISE
        measured = placement + self._rng.normal(0.0, 1.0, placement.shape) * (
            [metres] * 3 + [radians] * 3)
        self._poses.publish(positions_to_msg(
            measured[:, :3], Header(stamp=ns_to_stamp(time.time_ns()), frame_id='map'),
            measured[:, 3:]))

    def _send_clouds(self) -> None:
        """Publish a cloud of each camera; while the cameras move, that of before once more."""
        for camera, (publisher, pose) in enumerate(zip(self._clouds, self.placement, strict=True)):
            seen_from, content = self._views[camera]
            if not content or not self._is_moving:
                if seen_from != pose.tobytes():
                    content = bytearray(serialize_message(self._cloud(camera, pose)))
                    self._views[camera] = pose.tobytes(), content
                stamp = time.time_ns()
                # The header begins behind four bytes: seconds, then nanoseconds.
                content[4:12] = np.array(divmod(stamp, 10 ** 9), np.uint32).tobytes()
                self._sent[stamp] = time.monotonic(), processor_of(self.pid)
            publisher.publish(bytes(content))
            self.clouds += 1

    def _cloud(self, camera: int, pose: np.ndarray) -> PointCloud2:
        """Return a cloud of what a camera sees, with as many points as it has pixels."""
        simulator = self._problem.simulator
        seen = simulator.look(pose, camera).seen
        points = simulator.scene.points[Subset(seen, simulator.visibility.order).mask]
        width, height = self._case.pixels
        points = (points - pose[:3]) @ rotation_matrix(*pose[3:])
        # Every point several times, or some points, evenly.
        count = width * height
        points = points[np.arange(count) * len(points) // count]
        message = cloud_to_msg(points.astype(np.float32), Header(frame_id=f'camera_{camera}'))
        message.width, message.height = width, height
        message.row_step = width * message.point_step
        return message


def processor_of(pid: int) -> float:
    """Return the seconds of the processor that all threads of a process have taken."""
    nanoseconds = 0
    for path in Path(f'/proc/{pid}/task').glob('*/schedstat') if pid else ():
        try:
            nanoseconds += int(path.read_text().split()[0])
        except OSError:  # The thread has just ended.
            continue
    return 1e-9 * nanoseconds


def play(case: Case, seed: int, folder: Path) -> dict[str, Any]:
    """
    Play a room with a node process.

    :returns: ``latencies`` of the turns, figures of the clouds, the ``room``, the ``final``
        placement and the ``targets`` (T, 3) of all turns, metres.
    """
    path = Path(case.rig)
    if not case.rig.endswith('.yaml'):
        path = folder / 'rig.yaml'
        path.write_text(case.rig)
    settings = SimulationConfig(engine=PROMISING, rig_file=str(path))
    # No cached room: the rig files of all cases have one name.
    room = JudgedRoom(str(seed), 0.0, settings, POINTS, JUDGE_POINTS, 0.0, BY_FILE, 0)
    start = Episode(room.search_problem, np.random.default_rng(seed),
                    config=EpisodeConfig()).placement
    domain, holder = free_domain()
    processes: list[NodeProcess] = []
    with holder, Watch(domain) as watch, stopped_at_the_end(processes):
        rig = MovingRig(room.ray_problem, start, case, context=watch.context)
        watch.executor.add_node(rig)
        try:
            node = NodeProcess('policy_node', domain, folder / f'{seed}.log', {
                'cloud_topics': ','.join(f'points_{camera}' for camera in range(len(start))),
                'rig_file': str(path), **case.parameters})
            processes.append(node)
            rig.pid = node.process.pid
            watch.spin_until(lambda: bool(rig.latencies), PATIENCE, 'command', processes, 0.01)
            began, clouds, processor = time.monotonic(), rig.clouds, processor_of(rig.pid)
            watch.spin_until(lambda: watch.node.placement is not None, PATIENCE, 'placement',
                             processes, 0.01)
            took, memory = time.monotonic() - began, rss_of(rig.pid)
            processor = processor_of(rig.pid) - processor
            clouds = rig.clouds - clouds
            counts = watch.node.diagnostics['policy_node']
            watch.spin_until(lambda: watch.node.diagnostics['policy_node'] is not counts, PATIENCE,
                             'last word', processes)
            turns = watch.node.diagnostics['policy_node']['turns_with_clouds']
        finally:
            watch.executor.remove_node(rig)
            rig.destroy_node()
    shares = [share_of(text) for text in turns.split(', ')]
    return {
        'latencies': rig.latencies[:-1], 'turns_with_all_cameras': min(shares),
        'clouds_per_s_of_a_camera': clouds / took / len(start), 'cores': processor / took,
        'memory_mb': memory, 'room': room, 'final': rig.placement,
        'targets': np.concatenate(rig.commanded)}


def share_of(text: str) -> float:
    """Return the number behind ``points_0 11/12``."""
    count, total = text.rsplit(' ', 1)[1].split('/')
    return int(count) / max(int(total), 1)


def over_furniture(targets: np.ndarray, points: np.ndarray) -> int:
    """Return how many of T targets (T, 3) have points (N, 3) under them, above the floor."""
    floor = np.percentile(points[:, 2], 1)
    inside = points[(points[:, 2] > floor + 0.15) & (points[:, 2] < targets[0, 2] - 0.1), :2]
    return sum(bool((np.linalg.norm(inside - target[:2], axis=1) < 0.05).any())
               for target in targets)


def percentiles(played: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the median and the 99th percentile of all turns of some rooms."""
    seconds = np.array([row for room in played for row in room['latencies']])
    wall, processor = np.round(np.percentile(seconds, [50, 99], axis=0), 3).T.tolist()
    return {'wall_s': wall, 'processor_s': processor, 'turns': len(seconds)}


def rounded(played: list[dict[str, Any]], names: Iterable[str]) -> list[dict[str, float]]:
    """Return some figures of each room."""
    return [{name: round(float(room[name]), 3) for name in names} for room in played]


def judged(runs: list[dict[str, Any]]) -> dict[str, float]:
    """
    Compare the final placements of some runs of a room with that of a search that knows it.

    :param runs: of :func:`play`; what the cameras see in a turn differs between them.
    :returns: the geometric mean of the ratios of the errors, the worst, and figures of all runs.
    """
    room = runs[0]['room']
    known = plan(room.search_problem, Budget(evaluations=EVALUATIONS)).poses
    known_error, *errors = [room.judge(np.asarray(poses))['depth_error']
                            for poses in (known, *(run['final'] for run in runs))]
    ratios = np.array(errors) / known_error
    print('ratios', np.round(ratios, 3).tolist(), flush=True)
    targets = np.concatenate([run['targets'] for run in runs])
    return {'known_error_m': known_error, 'ratio': np.exp(np.log(ratios).mean()),
            'ratio_worst': ratios.max(), 'targets': len(targets),
            'targets_over_furniture': over_furniture(targets, room.judge_scene.points),
            'turns_with_all_cameras': min(run['turns_with_all_cameras'] for run in runs)}


def latency_cases(rooms: int) -> dict[str, Case]:
    """Return the cases of :func:`percentiles` by name."""
    rigs = {'around': AROUND.format(4), 'four_d455': 'config/rig/four_d455.yaml'}
    speeds = {'faster_than_thinking': (3.0, {}), 'slower_than_thinking': (0.3, {}),
              'faster_and_waiting_for_plans': (3.0, {'think_seconds': 0.0})}
    return {f'{rig}.{name}': Case(text, VALIDATION[:rooms], speed, parameters=parameters)
            for rig, text in rigs.items() for name, (speed, parameters) in speeds.items()}


def cloud_cases() -> dict[str, Case]:
    """Return the cases of big clouds by name."""
    return {f'{width}x{height}.{rate}': Case(
        AROUND.format(6), VALIDATION[:1], 1.0, (width, height), rate, {'turns': 6})
        for width, height in ((640, 480), (1280, 720)) for rate in (5, 15)}


def cpu_of(pids: Iterable[int]) -> float:
    """Return the seconds of the processor that processes have taken."""
    ticks = 0
    for pid in pids:
        # The name, in parentheses, may hold anything.
        fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf('SC_CLK_TCK')


def training(pairs: int, seconds: float, out: Path) -> dict[str, Any]:
    """
    Measure how fast a trainer learns from pairs of sim and policy.

    :param pairs: how many.
    :param seconds: to measure for.
    :param out: folder of the trainer.
    :returns: interactions per second, each with its gradient step, and the milliseconds of the
        processor that one takes in all processes together.
    """
    options = argparse.Namespace(pairs=pairs, out=out, seed=1, model='actor')
    domain, holder = free_domain()
    processes: list[NodeProcess] = []
    with holder, Watch(domain) as watch, stopped_at_the_end(processes):
        def said(name: str) -> int:
            return int(watch.node.diagnostics.get('trainer_node', {}).get(name, 0))

        start_nodes(options, domain, processes)
        watch.spin_until(lambda: said('transitions') >= 2 * STARTS, PATIENCE, 'transitions',
                         processes)
        pids = [process.process.pid for process in processes]
        began, first, cpu = time.monotonic(), said('transitions'), cpu_of(pids)
        watch.spin_until(lambda: time.monotonic() - began >= seconds, PATIENCE, 'end', processes)
        diagnostics = watch.node.diagnostics
        before = diagnostics['trainer_node']
        watch.spin_until(lambda: diagnostics['trainer_node'] is not before, PATIENCE,
                         'last word', processes)
        if said('inconsistent') or said('dropped'):
            raise RuntimeError(f'found {diagnostics["trainer_node"]}; expected that nothing '
                               'is dropped')
        count, took = said('transitions') - first, time.monotonic() - began
        return {'pairs': pairs, 'interactions_per_s': count / took,
                'cpu_ms': 1e3 * (cpu_of(pids) - cpu) / max(count, 1),
                'load_average': os.getloadavg()[0]}


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='node_bench', description=__doc__,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument('--parts', nargs='*', default=('latency', 'clouds', 'rooms'),
                     choices=('latency', 'clouds', 'rooms'), help='what to measure; with --record '
                     'the figures of other parts stay')
    top.add_argument('--rooms', type=int, default=2, help='for each case of latency')
    top.add_argument('--judged', type=int, default=3, help='rooms whose placements are judged')
    top.add_argument('--pairs', type=int, nargs='+', default=PAIRS,
                     help='of sim and policy, to measure training with')
    top.add_argument('--seconds', type=float, default=60.0,
                     help='to measure training for, with each number of pairs; 0 for not')
    results.add_record(top, 'node_bench')
    return top


def main(args: list[str] | None = None) -> int:
    """Measure, and print the figures."""
    options = parser().parse_args(args)
    end_on_signals()
    os.environ.update(LOCALHOST_ENVIRONMENT)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if 'latency' in options.parts:
            found['value'] = {}
            for case_name, case in latency_cases(options.rooms).items():
                found['value'][case_name] = percentiles(
                    [play(case, seed, folder) for seed in case.rooms])
                print(case_name, found['value'][case_name], flush=True)
        if 'clouds' in options.parts:
            found['clouds'] = {}
            for case_name, case in cloud_cases().items():
                (found['clouds'][case_name],) = rounded(
                    [play(case, seed, folder) for seed in case.rooms],
                    ('turns_with_all_cameras', 'clouds_per_s_of_a_camera', 'cores', 'memory_mb'))
                print(case_name, found['clouds'][case_name], flush=True)
        if 'rooms' in options.parts:
            case = Case(AROUND.format(4), VALIDATION[:options.judged], 1.0, (640, 480), 5.0)
            found['rooms'] = rounded([
                judged([play(case, seed, folder) for _ in range(RUNS)])
                for seed in case.rooms], (
                    'known_error_m', 'ratio', 'ratio_worst', 'targets', 'targets_over_furniture',
                    'turns_with_all_cameras'))
            print(json.dumps(found['rooms']), flush=True)
        if options.seconds:
            found['training'] = []
            for pairs in options.pairs:
                found['training'].append(training(pairs, options.seconds, folder / str(pairs)))
                print(json.dumps(found['training'][-1]), flush=True)
    if options.record:
        path = results.FOLDER / 'nodes.json'
        before = json.loads(path.read_text()) if path.exists() else {}
        # The stamp is that of the newest part.
        kept = {key: before[key] for key in ('value', 'clouds', 'rooms', 'training')
                if key in before}
        results.write('nodes', {
            'unit': 'seconds from the newest cloud to the command, median and 99 %; turns of '
                    f'{MOVING["max_step"]} m',
            **kept, **found, 'load_average': os.getloadavg()[1], 'cores': cores()},
            results.command_of('drills.node_bench', args))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
