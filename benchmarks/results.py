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

"""Files of results: ``docs/results/NAME.json`` has figures with their command, commit and date."""

import argparse
from collections.abc import Mapping, Sequence
from datetime import date
import json
from pathlib import Path
import shlex
import subprocess
import sys
from typing import Any

from ocp_ros.rooms.room_sets import SETS
from ocp_ros.util.files import write_atomically

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / 'docs' / 'results'


def command_of(module: str, argv: Sequence[str] | None) -> str:
    """Return the command that runs a module of ``benchmarks`` with some arguments."""
    arguments = sys.argv[1:] if argv is None else argv
    return shlex.join(['python', '-m', f'benchmarks.{module}', *arguments])


def commit() -> str:
    """Return the commit of these sources, short."""
    return subprocess.run(['git', 'rev-parse', '--short', 'HEAD'], cwd=ROOT, text=True,
                          capture_output=True).stdout.strip() or 'unknown'


def stamped(figures: Mapping[str, Any], command: str) -> dict[str, Any]:
    """Return figures behind the command that measured them, the commit and the date."""
    return {'command': command, 'commit': commit(), 'date': date.today().isoformat(),
            **figures}


def write(name: str, figures: Mapping[str, Any], command: str, part: str = '') -> None:
    """
    Write ``docs/results/NAME.json``, and print that it was written.

    :param figures: plain data; a key ``date`` replaces the date of today.
    :param command: that measures them again.
    :param part: key of the figures in the file, whose other keys stay; if empty, only parts stay,
        which other commands have measured.
    """
    path = FOLDER / f'{name}.json'
    content = stamped(figures, command)
    known = json.loads(path.read_bytes()) if path.exists() else {}
    if part:
        content = {**known, part: content}
    else:
        content |= {key: value for key, value in known.items() if key not in content
                    and isinstance(value, dict) and 'command' in value}
    write_atomically(path, json.dumps(content, indent=1, ensure_ascii=False) + '\n')
    print(f'wrote {path}')


def add_rooms(parser: argparse.ArgumentParser) -> None:
    """Add which generated rooms are measured; see :func:`rooms_of`."""
    parser.add_argument('--set', choices=tuple(SETS), default='test', help='of rooms')
    parser.add_argument('--rooms', type=int, default=10, help='how many of them')


def rooms_of(options: argparse.Namespace) -> list[int]:
    """Return the seeds of the rooms that a command line names."""
    return list(SETS[options.set])[:options.rooms]


def add_record(parser: argparse.ArgumentParser, name: str) -> None:
    """Add that figures are kept."""
    parser.add_argument('--record', action='store_true',
                        help=f'write the figures to docs/results/{name}.json')
