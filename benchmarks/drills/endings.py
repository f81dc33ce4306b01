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
End nodes again and again, in every way that users do, and count those that crash.

A round starts sim_node, policy_node and trainer_node in a ROS domain of their own, waits until
they play, with clouds of 25,000 points on the way, and ends them at a random moment:

- alone: one of them by Ctrl-C while the others go on, then the next, then the last
- together: all at once by Ctrl-C, as in one terminal
- terminated: all at once by SIGTERM, as a launch file or a service manager does
- impatient: all at once by Ctrl-C, three times within a tenth of a second
- bereaved: one is killed by SIGKILL, and the others are told to end at the same moment

Nodes are forked from a process that has imported everything but started nothing, so that a node
starts in a fraction of a second; from there on each is a process like any other, and ends as one.
A node that crashes leaves its core dump, its output and, where gdb is installed, the native stack
of each thread beside it. Other processes keep the processor busy meanwhile.
"""

import argparse
from collections import Counter
from contextlib import contextmanager
import faulthandler
import gc
import json
import logging
import multiprocessing
import os
from pathlib import Path
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback

from benchmarks import results
import numpy as np
from ocp_ros.demo.watched_nodes import free_domain
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.rooms.generator import generate_room
from ocp_ros.ros import policy_node, sim_node, trainer_node
from ocp_ros.ros.interface.conversions import msg_to_positions, ns_to_stamp, positions_to_msg
from ocp_ros.ros.policy.decider import Decider
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.runtime.node_main import LOCALHOST_ENVIRONMENT, USER_VARIABLES
from ocp_ros.scenes.scene_files import save_scene
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.resources import find_model
from ocp_ros.util.threads import set_threads
from rich.console import Console
from rich.progress import Progress
from std_msgs.msg import Header
import torch

MAINS = {'sim_node': sim_node.main, 'policy_node': policy_node.main,
         'trainer_node': trainer_node.main}
#: What a node says when it runs.
READY = {'sim_node': 'cameras', 'policy_node': 'weights', 'trainer_node': 'updates so far'}
KINDS = ('alone', 'together', 'terminated', 'impatient', 'bereaved')
#: Seconds after which a node that has not started or ended is given up: it hangs.
PATIENCE = 300.0
#: Most seconds of play before the end, and points of the room.
PLAY, POINTS = 1.0, 25_000


def warm_up(scene):
    """Run what nodes run once, so that kernels are loaded before nodes are forked."""
    torch.set_num_threads(1)
    set_threads(1)
    simulator = Simulator(scene, SimulationConfig(engine=EngineConfig(preset='fast')))
    episode = Episode(PlaneProblem(simulator), np.random.default_rng(0))
    header = Header(stamp=ns_to_stamp(1), frame_id='map')
    for explore in (True, False):
        config = PolicyNodeConfig(explore=explore, threads=1)
        decider = Decider(config, Checkpoint.load(find_model('actor')),
                          logging.getLogger('warm_up'))
        for turn in range(2):
            poses = positions_to_msg(episode.turn.positions, header, episode.turn.headings)
            target = msg_to_positions(decider.decide(episode.observed_cloud, poses, turn))
            episode.move((target - episode.turn.positions)[:, :2], episode.turn.headings)


def parameters(name, folder):
    """Return the arguments of a node."""
    values = {
        # Sent again and again, so that clouds are on their way at any moment.
        'sim_node': {'scene.file': str(folder.parent / 'room.ply'), 'engine.preset': 'fast',
                     'resend_period': 0.02, 'auto_reset': True},
        'policy_node': {'model': 'actor', 'explore': True, 'threads': 1},
        'trainer_node': {'model': 'actor', 'folder': str(folder / 'trainer'),
                         'updates_per_turn': 1.0, 'sac.learning_starts': 4,
                         'sac.batch_size': 4, 'sac.buffer_size': 100,
                         'save_seconds': 0.0, 'publish_every': 1}}[name]
    pairs = [f'{key}:={json.dumps(value)}' for key, value in values.items()]
    return ['--ros-args', *(word for pair in pairs for word in ('-p', pair))]


def be_node(name, folder, domain, shared_memory):
    """Become a node in a new process; never returns."""
    code = 1
    try:
        home = folder / name
        home.mkdir()
        os.chdir(home)
        output = os.open('output', os.O_WRONLY | os.O_CREAT)
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_CORE, (resource.RLIM_INFINITY,) * 2)
        faulthandler.enable()
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        for asked in USER_VARIABLES:
            os.environ.pop(asked, None)
        if shared_memory:
            os.environ.update(LOCALHOST_ENVIRONMENT)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT
                          else signal.SIG_DFL)
        sys.argv = [name]
        code = MAINS[name](parameters(name, folder))
    except BaseException:
        traceback.print_exc()
    # The way out of every Python program: what main leaves behind is taken down here.
    sys.exit(code)


class Ended(Exception):
    """A node ended before it was told to."""


class Round:
    """The nodes of one round."""

    def __init__(self, folder, domain, shared_memory):
        self.folder, self.pids, self.codes = folder, {}, {}
        folder.mkdir(parents=True)
        for name in MAINS:
            pid = os.fork()
            if not pid:
                be_node(name, folder, domain, shared_memory)
            self.pids[name] = pid

    def output(self, name):
        """Return what a node has said."""
        path = self.folder / name / 'output'
        return path.read_text(errors='replace') if path.exists() else ''

    def reap(self):
        """Note the exit codes of those that have ended."""
        for name, pid in self.pids.items():
            if name not in self.codes:
                done, status = os.waitpid(pid, os.WNOHANG)
                if done:
                    self.codes[name] = os.waitstatus_to_exitcode(status)

    def until(self, predicate, what):
        """Wait until something has happened; not for ever."""
        deadline = time.monotonic() + PATIENCE
        while True:
            self.reap()
            if predicate():
                return
            if time.monotonic() > deadline:
                raise Ended(f'{self.folder}: found no {what} within {PATIENCE:.0f} s')
            time.sleep(0.01)

    def living(self):
        """Return the names of those that have not ended."""
        return [name for name in self.pids if name not in self.codes]

    def send(self, name, number):
        """Send a node a signal."""
        if name not in self.codes:
            os.kill(self.pids[name], number)

    def ready(self):
        """Wait until all play."""
        self.until(lambda: self.codes or all(
            word in self.output(name) for name, word in READY.items()), 'start')
        if self.codes:
            raise Ended(f'{self.folder}: found that nodes ended at their start: {self.codes}')

    def end(self, kind, rng):
        """End all in one of the ways; returns the names of those that had to end well."""
        names = list(rng.permutation(list(self.pids)))
        if kind == 'alone':
            for name in names:
                self.send(name, signal.SIGINT)
                self.until(lambda name=name: name in self.codes, f'end of {name}')
            return names
        if kind == 'bereaved':
            self.send(names.pop(), signal.SIGKILL)
        number = signal.SIGTERM if kind == 'terminated' else signal.SIGINT
        for _ in range(3 if kind == 'impatient' else 1):
            for name in names:
                self.send(name, number)
            if kind == 'impatient':
                time.sleep(rng.uniform(0.0, 0.03))
        self.until(lambda: not self.living(), 'end')
        return names


def native_stacks(home):
    """Write the native stack of every thread of a core dump beside it."""
    core = next(home.glob('core*'), None)
    if core is None or not shutil.which('gdb'):
        return
    with open(home / 'stacks', 'wb') as file:
        subprocess.run(['gdb', '-batch', '-ex', 'bt 60', '-ex', 'info threads', '-ex',
                        'thread apply all bt 40', sys.executable, str(core)],
                       stdout=file, stderr=subprocess.STDOUT, check=False)


def play(number, kind, options, counts):
    """Play one round; ``counts`` gets (kind, exit code) of each node, and faults."""
    rng = np.random.default_rng([options.seed, number, KINDS.index(kind)])
    folder = options.out / f'{kind}_{number}'
    domain, holder = free_domain()
    with holder:
        nodes = Round(folder, domain, options.shared_memory)
        try:
            nodes.ready()
            time.sleep(rng.uniform(0.0, PLAY))
            ended = nodes.end(kind, rng)
        except Ended as fault:
            counts['faults'].append(str(fault))
            for name in nodes.living():
                nodes.send(name, signal.SIGKILL)
            nodes.until(lambda: not nodes.living(), 'end')
            return
    wrong = [name for name in ended if nodes.codes[name]]
    counts['codes'].update((kind, nodes.codes[name]) for name in ended)
    for name in wrong:
        native_stacks(folder / name)
    if not wrong:
        shutil.rmtree(folder)


def rounds_of(kind, endings):
    """Return the rounds of a kind that have so many endings; who is killed does not count."""
    return -(-endings // (len(MAINS) - (kind == 'bereaved')))


def work(kinds, share, options, pipe):
    """Play every round that falls to one worker; a line of JSON for each goes into the pipe."""
    for number in range(share, options.endings, options.jobs):
        for kind in kinds:
            if number >= rounds_of(kind, options.endings):
                continue
            counts: dict = {'codes': Counter(), 'faults': []}
            play(number, kind, options, counts)
            line = [[[*key, n] for key, n in counts['codes'].items()], counts['faults']]
            os.write(pipe, json.dumps(line).encode() + b'\n')


def start_workers(kinds, options):
    """
    Fork the workers, plainly: what they fork in turn ends as a program does, finalisers and all.

    :returns: the lines that they write.
    """
    reading, writing = os.pipe()
    for share in range(options.jobs):
        if not os.fork():
            os.close(reading)
            work(kinds, share, options, writing)
            sys.exit()
    os.close(writing)
    return os.fdopen(reading)


@contextmanager
def busy(count):
    """Keep so many processors busy."""
    def spin():
        while True:
            pass

    spinners = [multiprocessing.Process(target=spin, daemon=True) for _ in range(count)]
    for spinner in spinners:
        spinner.start()
    try:
        yield
    finally:
        for spinner in spinners:
            spinner.kill()


def parser():
    """Build the parser."""
    top = argparse.ArgumentParser(
        prog='endings', description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument('--endings', type=int, default=500, help='of nodes, for each kind of ending')
    top.add_argument('--kinds', default=','.join(KINDS), help='with commas between')
    top.add_argument('--jobs', type=int, default=3, help='rounds that are played at once')
    top.add_argument('--busy', type=int, default=2, help='processes that only keep cores busy')
    top.add_argument('--shared-memory', action='store_true',
                     help='where UDP is what nodes choose when nobody has said anything')
    top.add_argument('--seed', type=int, default=0, help='of the moments and the order')
    top.add_argument('--out', type=Path, default=Path('out/endings'),
                     help='folder for endings.json and for what crashed nodes leave; made anew')
    results.add_record(top, 'drills')
    return top


def main(args: list[str] | None = None) -> int:
    """Run; 1 if a node crashed or hung."""
    options = parser().parse_args(args)
    kinds, options.out = options.kinds.split(','), options.out.resolve()
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    scene = generate_room(1, POINTS)
    save_scene(scene, options.out / 'room.ply')
    warm_up(scene)
    codes, faults = Counter(), []
    gc.freeze()
    lines, began = start_workers(kinds, options), time.monotonic()
    with busy(options.busy), Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task('ending nodes', total=sum(
            rounds_of(kind, options.endings) for kind in kinds))
        for line in lines:
            found, wrong = json.loads(line)
            for kind, code, count in found:
                codes[kind, code] += count
            faults += wrong
            crashed = sum(count for (_, code), count in codes.items() if code)
            progress.update(task, advance=1, description=f'{crashed} crashed')
    result = {'kinds': {kind: {'endings': sum(n for (k, _), n in codes.items() if k == kind),
                               'codes': {str(c): n for (k, c), n in codes.items() if k == kind}}
                        for kind in kinds},
              'faults': faults, 'seconds': round(time.monotonic() - began), 'busy': options.busy,
              'shared_memory': options.shared_memory, 'jobs': options.jobs, 'seed': options.seed}
    (options.out / 'endings.json').write_text(json.dumps(result, indent=2) + '\n')
    print(json.dumps(result, indent=2))
    if options.record:
        results.write('drills', result, results.command_of('drills.endings', args), 'endings')
    return int(bool(faults) or any(code for _, code in codes))


if __name__ == '__main__':
    sys.exit(main())
