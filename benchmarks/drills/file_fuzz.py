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
Read files with errors in them, and see that each is read or refused in one sentence.

Files are read in a process that may be lost: who crashes, hangs or takes too much memory is
counted, and the next file is read by a new one.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
import json
import os
from pathlib import Path
import queue
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings

from benchmarks import results
from benchmarks.drills.spoilt_files import good_files, spoilt
import numpy as np
from ocp_ros.util import guarded_process
from ocp_ros.util.settings import UserError

#: What may come of a file; the last three must not.
OUTCOMES = ('read', 'refused', 'wrong', 'crashed', 'hung')
#: Seconds after which a file hangs, and until a process is ready.
PATIENCE, START = 60.0, 120.0
#: Bytes of address space of the process that reads, and characters of a sentence.
MOST, SENTENCE = 4_000_000_000, 2500


class ForkedProcesses:
    """What :mod:`subprocess` does, for readers of files that are loaded already."""

    DEVNULL, PIPE, TimeoutExpired = subprocess.DEVNULL, subprocess.PIPE, subprocess.TimeoutExpired

    def __init__(self) -> None:
        # What takes long to import is imported once.
        import laspy  # noqa: F401
        import open3d  # noqa: F401
        self.memory = 0

    def Popen(self, command: list[str], stderr, **_) -> 'ForkedProcess':  # noqa: N802
        """Run a reader in a copy of this process."""
        return ForkedProcess(self, import_module(command[3]).main, command[4:], stderr)


class ForkedProcess:
    """
    A copy of this process that runs a reader.

    :param family: notes the memory that it took.
    :param stderr: where it says what is wrong.
    """

    def __init__(self, family: ForkedProcesses, run: Callable[[list[str]], int],
                 arguments: list[str], stderr) -> None:
        self._family, self._code = family, None
        asked, asking = os.pipe()
        answers, answering = os.pipe()
        self._child = os.fork()
        if self._child == 0:
            # Whatever happens, the copy must not go on as the original does.
            try:
                os.close(asking)
                os.close(answers)
                sys.stdin = os.fdopen(asked)
                os.dup2(answering, 1)
                os.dup2(stderr.fileno(), 2)
                os.close(answering)
                code = run(arguments)
            except BaseException:
                code = 1
            finally:
                os._exit(code)
        os.close(asked)
        os.close(answering)
        self.stdin, self.stdout = os.fdopen(asking, 'wb'), os.fdopen(answers, 'rb')

    def kill(self) -> None:
        """Kill it."""
        if self._code is None:
            os.kill(self._child, signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """Return the code that it ended with."""
        if self._code is None:
            _, status, used = os.wait4(self._child, 0)
            self._family.memory = max(self._family.memory, used.ru_maxrss)
            self._code = os.waitstatus_to_exitcode(status)
        return self._code


def read_one(reader, path: Path) -> tuple[str, str]:
    """Read a file; returns one of ``OUTCOMES`` and what was said."""
    try:
        reader(path)
    except UserError as error:
        said = str(error)
        plain = path.name in said and '\n' not in said and len(said) < SENTENCE
        return ('refused' if plain else 'wrong'), said
    except Exception as error:
        return 'wrong', f'{type(error).__name__}: {error}'
    return 'read', ''


def work(name: str, seed: int, start: int, stop: int) -> None:
    """Read the spoilt files of a format, and print a line about each, before and after."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST, MOST))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter('ignore')
    guarded_process.subprocess = forked = ForkedProcesses()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        reader = good_files(folder)[name]
        content = (folder / name).read_bytes()
        outcome, said = read_one(reader, folder / name)
        print(json.dumps(['good', outcome, said]), flush=True)
        for number in range(start, stop):
            path = folder / f'spoilt_{name}'
            path.write_bytes(spoilt(np.random.default_rng([seed, number]), content))
            Path('/proc/self/clear_refs').write_text('5')
            forked.memory = 0
            print(json.dumps(['begin', number]), flush=True)
            began = time.monotonic()
            outcome, said = read_one(reader, path)
            seconds = time.monotonic() - began
            peak = int(Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])
            memory = max(peak, forked.memory) / 1024
            print(json.dumps(['end', number, outcome, said, seconds, memory]), flush=True)


class FormatTrial:
    """
    All spoilt files of a format.

    :ivar counts: how many came to what.
    :ivar seconds: of each file.
    :ivar memory: largest resident memory, MB.
    :ivar bad: number, outcome and words of files that were neither read nor refused well.
    """

    def __init__(self, name: str, mutations: int, seed: int) -> None:
        self.name, self.mutations, self.seed = name, mutations, seed
        self.counts: Counter = Counter()
        self.seconds: list[float] = []
        self.memory, self.bad = 0.0, []

    def run(self) -> 'FormatTrial':
        """Read them all, with as many processes as it takes."""
        done = 0
        while done < self.mutations:
            done = self._one_process(done)
        return self

    def _one_process(self, start: int) -> int:
        """Read with a new process, as long as it lives; returns the next file's number."""
        command = [sys.executable, '-m', 'benchmarks.drills.file_fuzz', '--work', self.name,
                   str(self.seed), str(start), str(self.mutations)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                              text=True, cwd=results.ROOT) as process:
            lines: queue.Queue = queue.Queue()

            def listen() -> None:
                for line in process.stdout:
                    lines.put(line)
                lines.put('')

            listener = threading.Thread(target=listen)
            listener.start()
            try:
                return self._follow(process, lines)
            finally:
                process.kill()
                listener.join()

    def _follow(self, process: subprocess.Popen, lines: queue.Queue) -> int:
        """Note what a process says about its files, until it ends or says nothing for long."""
        current, patience = None, START
        while True:
            try:
                line = lines.get(timeout=patience)
            except queue.Empty:
                return self._lost(current, 'hung', '')
            if not line:
                return self._ended(process, current)
            kind, *values = json.loads(line)
            if kind == 'begin':
                current, patience = values[0], PATIENCE
            elif kind == 'end':
                self._note(*values)
                current, patience = None, START
            elif values[0] != 'read':
                raise RuntimeError(f'{self.name}: a good file is not read: {values}')

    def _ended(self, process: subprocess.Popen, current: int | None) -> int:
        """Return the next file's number once a process has ended."""
        code = process.wait()
        if current is None:
            if code:
                raise RuntimeError(f'{self.name}: the process that reads ended with {code}')
            return self.mutations
        return self._lost(current, 'crashed', f'ended with {code}')

    def _lost(self, number: int, outcome: str, said: str) -> int:
        """Note a file that took its process with it."""
        self.counts[outcome] += 1
        self.bad.append([number, outcome, said])
        return number + 1

    def _note(self, number: int, outcome: str, said: str, seconds: float, memory: float) -> None:
        """Note what came of a file."""
        self.counts[outcome] += 1
        self.seconds.append(seconds)
        self.memory = max(self.memory, memory)
        if outcome == 'wrong':
            self.bad.append([number, outcome, said[:300]])

    def figures(self) -> dict:
        """Return what was found."""
        return {'format': self.name, 'mutations': self.mutations,
                **{outcome: self.counts[outcome] for outcome in OUTCOMES},
                'longest_seconds': round(max(self.seconds, default=0.0), 2),
                'peak_mb': round(self.memory), 'bad': self.bad[:40]}


def parser() -> argparse.ArgumentParser:
    """Build the parser."""
    top = argparse.ArgumentParser(prog='file_fuzz', description=__doc__)
    top.add_argument('--mutations', type=int, default=2000, help='spoilt files of each format')
    top.add_argument('--seed', type=int, default=0, help='of the errors')
    top.add_argument('--formats', nargs='*', help='names such as las.las; all unless named')
    top.add_argument('--jobs', type=int, default=1, help='formats at once')
    top.add_argument('--out', type=Path, default=Path('out'), help='folder for the results')
    results.add_record(top, 'file_fuzz')
    return top


def main(args: list[str] | None = None) -> int:
    """Run; 2 if a file did what it must not."""
    args = sys.argv[1:] if args is None else args
    if args[:1] == ['--work']:
        work(args[1], *map(int, args[2:]))
        return 0
    options = parser().parse_args(args)
    with tempfile.TemporaryDirectory() as folder:
        names = options.formats or list(good_files(Path(folder)))
    found = []
    with ThreadPoolExecutor(options.jobs) as pool:
        trials = [FormatTrial(name, options.mutations, options.seed) for name in names]
        for trial in pool.map(FormatTrial.run, trials):
            found.append(trial.figures())
            print({key: value for key, value in found[-1].items() if key != 'bad'}, flush=True)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / 'file_fuzz.json').write_text(json.dumps(found, indent=1) + '\n')
    if options.record:
        results.write('file_fuzz', {'formats': found},
                      results.command_of('drills.file_fuzz', args))
    return 2 if any(one[outcome] for one in found for outcome in OUTCOMES[2:]) else 0


if __name__ == '__main__':
    sys.exit(main())
