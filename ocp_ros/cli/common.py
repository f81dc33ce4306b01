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

"""What all commands of ``ocp`` have in common: contents, examples, JSON and errors."""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext, redirect_stdout
import errno
import io
import json
import math
import os
from pathlib import Path
import shlex
import sys
from typing import Any, NoReturn
import warnings

from ocp_ros.cli.arguments import joined
from ocp_ros.cli.start import STOPPED
from ocp_ros.util.files import complete_set, file_to_write
from ocp_ros.util.settings import ConfigurationError, UserError
from ocp_ros.util.terminal_text import printable

#: What one may want, as ``ocp --help`` lists it.
PLAN, JUDGE, LOOK, LEARN, COMPARE, REPLAY = TITLES = (
    'find a placement', 'evaluate a placement', 'look at rooms and placements', 'train a policy',
    'compare planners', 'feed the nodes')
#: What a command found, as plain data.
Found = dict[str, Any]
#: Arguments that name what a command reads.
READ = ('room', 'rooms', 'placement', 'rig', 'config')
#: The folder of results in the folder where ocp was started: files there are replaced without
#: ``--overwrite``, for the default outputs are there.
RESULTS = Path('out')
#: Errors of a disk that is full, or on which one may not write more.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Exit code of wrong use.
WRONG = 2


class UsageError(Exception):
    """A command line that cannot be read, and the parser that says how it should be."""

    def __init__(self, parser: argparse.ArgumentParser, message: str) -> None:
        super().__init__(message)
        self.parser = parser


class Parser(argparse.ArgumentParser):
    """A parser that leaves it to :func:`run` how to say what is wrong."""

    def __init__(self, **options: Any) -> None:
        # Whoever looks for an option in the command line finds it only where it is written out.
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise what is wrong."""
        raise UsageError(self, message)


class Commands:
    """
    The commands of a program, under what one may want.

    :param program: its name.
    :param description: what it is for.
    """

    def __init__(self, program: str, description: str) -> None:
        self.parser = Parser(prog=program, usage=f'{program} COMMAND ...', description=description,
                             formatter_class=argparse.RawDescriptionHelpFormatter)
        self._added = self.parser.add_subparsers(prog=program, required=True, metavar='COMMAND',
                                                 help=argparse.SUPPRESS)
        self._contents: dict[str, list[tuple[str, str]]] = {
            title: [] for title in TITLES}
        #: An example of each command, as one types it.
        self.examples: list[str] = []

    def add(self, group: str, name: str, about: str, example: str = '') -> Parser:
        """
        Add a command.

        :param group: what one may want it for.
        :param about: what it does, in a few words.
        :param example: a command line; a command that only has others has none.
        """
        self._contents[group].append((name, about))
        self.parser.epilog = self._table()
        return self.put(self._added, name, about, example)

    def put(self, parsers: Any, name: str, about: str, example: str) -> Parser:
        """Add a command to others, with its example and ``--json``."""
        made = parsers.add_parser(
            name, help=about, description=f'{about[0].upper()}{about[1:]}.',
            epilog=f'example:\n  {example}' if example else None,
            formatter_class=argparse.RawDescriptionHelpFormatter)
        if example:
            self.examples.append(example)
            made.add_argument('--json', action='store_true',
                              help='print one JSON document and nothing else, also for errors')
        return made

    def _table(self) -> str:
        """Return the table of contents."""
        lines = []
        for title, commands in self._contents.items():
            if commands:
                lines += [f'{title}:', *(f'  {name:<12}{about}' for name, about in commands), '']
        more = f'{self.parser.prog} COMMAND --help says more, with an example.'
        return '\n'.join([*lines, more])


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """
    Run one command: its ``run`` returns plain data, which its ``show`` prints, or ``--json``.

    Bad input gets one sentence, or with ``--json`` a document with the key ``error``, which what
    was found may have as well.

    :returns: the exit code.
    """
    as_json = '--json' in argv
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Letters that a terminal or a pipe cannot take are shown as escapes.
        sys.stdout.reconfigure(errors='backslashreplace')
    try:
        _check_folder()
        arguments = parser.parse_args(joined(argv))
        arguments.argv = list(argv)
        with warnings.catch_warnings(), redirect_stdout(sys.stderr) if as_json else nullcontext():
            warnings.showwarning = _warn
            found = arguments.run(arguments)
        if as_json:
            print(document(found))
        else:
            arguments.show(found)
        sys.stdout.flush()
        if 'error' in found:
            return WRONG if as_json else _refuse(found['error'], as_json)
    except UsageError as error:
        if not as_json:
            error.parser.print_usage(sys.stderr)
            error.parser.exit(
                WRONG, f'{error.parser.prog}: error: {printable(str(error))}\n')
        return _refuse(str(error), as_json)
    except BrokenPipeError:
        # Whoever reads has seen enough, such as head; nobody is left to be told.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (UserError, OSError) as error:
        return _refuse(_said_of(error), as_json)
    except MemoryError:
        return _refuse('memory: found less than this needs; expected enough; use fewer points, '
                       'cameras or rows, or smaller networks and buffers', as_json)
    except KeyboardInterrupt:
        return STOPPED
    return 0


def _check_folder() -> None:
    """Refuse to work in a folder that was removed: no path that is relative leads anywhere."""
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise ConfigurationError(
            'the folder in which ocp was started: found that it no longer exists; expected an '
            'existing folder; change to another folder (cd) and start again') from error


def _warn(message: Warning | str, *_: Any) -> None:
    """Say what may be wrong, in one line and without the code that noticed it."""
    print(f'ocp: warning: {printable(str(message))}', file=sys.stderr)


def _said_of(error: Exception) -> str:
    """Return what is wrong in one sentence."""
    if isinstance(error, OSError) and error.errno in FULL:
        return (f'{error.filename}: found no room to write it ({error.strerror}); expected some; '
                'what was there before is whole: make room, or name another place, and start '
                'again')
    return str(error)


def _refuse(sentence: str, as_json: bool) -> int:
    """Say what is wrong, and return the exit code."""
    if as_json:
        print(document({'error': sentence}))
    else:
        print(f'ocp: {printable(sentence)}', file=sys.stderr)
    return WRONG


def document(found: Any) -> str:
    """Return plain data as JSON: paths are texts, and what is not finite is null."""
    return json.dumps(_plain(found), indent=1, allow_nan=False)


def _plain(value: Any) -> Any:
    """Return a value as JSON knows it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if hasattr(value, 'tolist'):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def show_written(found: Found) -> None:
    """Print which files were written."""
    for path in found['written']:
        print(f'wrote {printable(str(path))}')


def command_of(argv: Sequence[str]) -> str:
    """Return a command line as one types it."""
    return shlex.join(['ocp', *argv])


def inputs_of(arguments: argparse.Namespace) -> list[Path]:
    """Return the files and folders that a command line reads, which it must not replace."""
    named: list[Any] = []
    for name in READ:
        value = getattr(arguments, name, None)
        named += value if isinstance(value, list) else [value] if value else []
    return [Path(name) for name in named]


def claim_file(arguments: argparse.Namespace, path: Path, what: str, option: str = '--out'
               ) -> None:
    """
    Check that a file may be written before any work is done for it.

    :param path: of the file.
    :param what: the file is, for the message.
    :param option: which names it.
    :raises ConfigurationError: if it cannot be written, is an input, or exists and may not be
        replaced.
    """
    file_to_write(path, what, option)
    _check_inputs([path], inputs_of(arguments), option)
    if (path.exists() or path.is_symlink()) and not _may_replace(arguments, path):
        raise ConfigurationError(
            f'{option}: found {path}, which exists already; expected a new file; name another '
            'one, or add --overwrite to replace this one')


def claim_folder(arguments: argparse.Namespace, folder: Path, names: Iterable[str], mark: str,
                 read: Iterable[str | Path] = (), option: str = '--out') -> None:
    """
    Check that files may be written to a folder before any work is done for them.

    The folder is new or empty, or an earlier run has left its mark there.

    :param names: of the files that are written, or removed if an earlier run has left them.
    :param mark: name of a file that every run leaves there, perhaps with ``*``.
    :param read: inputs beside those that the command line always names.
    :param option: which names the folder.
    :raises ConfigurationError: if an input would be replaced, or other files are there.
    """
    names = list(names)
    _check_inputs([folder / name for name in names], [*inputs_of(arguments), *read], option)
    if taken := [name for name in names if (folder / name).is_dir()]:
        raise ConfigurationError(
            f'{option}: found the folder {folder / taken[0]}; expected a file there, or nothing; '
            'name another folder, or move that one')
    if not folder.is_dir() or _may_replace(arguments, folder) or any(folder.glob(mark)) or (
            complete_set(folder, names, mark)):
        return
    others = sorted(path.name for path in folder.iterdir() if not path.name.startswith('.'))
    if others:
        raise ConfigurationError(
            f'{option}: found {folder / others[0]}, and no {mark} of an earlier run; expected a '
            'new or empty folder, or that of an earlier run; name another one, or add --overwrite '
            'to write to this one')


def _may_replace(arguments: argparse.Namespace, path: Path) -> bool:
    """Return whether files of a path, or in it, may be replaced."""
    return arguments.overwrite or path.resolve().is_relative_to(RESULTS.resolve())


def _check_inputs(paths: Iterable[Path], inputs: Iterable[str | Path], option: str) -> None:
    """Refuse to replace an input, with ``--overwrite`` too."""
    read = [path for path in map(Path, inputs) if path.exists()]
    for path in paths:
        if path.exists() and any(path.samefile(one) for one in read):
            raise ConfigurationError(
                f'{option}: found {path}, which is an input of this command and would be '
                'replaced; expected an output that replaces no input; name another one')
