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

"""Common parts of all commands of ``ocp``: table of contents, examples, JSON and errors."""

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

#: Groups of commands in ``ocp --help``, named by their purpose.
PLAN, JUDGE, LOOK, LEARN, COMPARE, REPLAY = TITLES = (
    'find a placement', 'evaluate a placement', 'look at rooms and placements', 'train a policy',
    'compare planners', 'feed the nodes')
#: Result of a command as plain data.
Found = dict[str, Any]
#: Arguments that name input files and folders.
READ = ('room', 'rooms', 'placement', 'rig', 'config')
#: Folder of results, relative to the folder in which ocp was started. It has the default outputs,
#: so files there are replaced without ``--overwrite``.
RESULTS = Path('out')
#: Error numbers of a full disk, an exceeded quota, and a file that is too large.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: Exit code for wrong input.
WRONG = 2


class UsageError(Exception):
    """A command line that cannot be read, with the parser that prints the usage."""

    def __init__(self, parser: argparse.ArgumentParser, message: str) -> None:
        super().__init__(message)
        self.parser = parser


class Parser(argparse.ArgumentParser):
    """A parser that raises errors, so that :func:`run` prints them."""

    def __init__(self, **options: Any) -> None:
        # Options must be written in full: ``'--json' in argv`` would miss an abbreviation.
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise a UsageError."""
        raise UsageError(self, message)


class Commands:
    """
    The commands of a program, in groups by purpose.

    :param program: its name.
    :param description: its purpose.
    """

    def __init__(self, program: str, description: str) -> None:
        self.parser = Parser(prog=program, usage=f'{program} COMMAND ...', description=description,
                             formatter_class=argparse.RawDescriptionHelpFormatter)
        self._added = self.parser.add_subparsers(prog=program, required=True, metavar='COMMAND',
                                                 help=argparse.SUPPRESS)
        self._contents: dict[str, list[tuple[str, str]]] = {
            title: [] for title in TITLES}
        #: An example of each command, as a user types it.
        self.examples: list[str] = []

    def add(self, group: str, name: str, about: str, example: str = '') -> Parser:
        """
        Add a command.

        :param group: title of its group, one of ``TITLES``.
        :param about: what the command does, in a few words.
        :param example: a command line; empty for a command that only has subcommands.
        """
        self._contents[group].append((name, about))
        self.parser.epilog = self._table()
        return self.put(self._added, name, about, example)

    def put(self, parsers: Any, name: str, about: str, example: str) -> Parser:
        """Add a command to subparsers, with its example and ``--json``."""
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
    Run one command, and print the plain data that it returns, with its ``show`` or as JSON.

    Bad input is reported in one sentence, or with ``--json`` in a document with the key ``error``.
    A result may have the key ``error`` too.

    :returns: the exit code.
    """
    as_json = '--json' in argv
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Characters that a terminal or a pipe cannot encode are printed as escapes.
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
        # The reader, such as head, has closed the pipe: discard the rest of the output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (UserError, OSError) as error:
        return _refuse(_sentence_of(error), as_json)
    except MemoryError:
        return _refuse('memory: found less than this needs; expected enough; use fewer points, '
                       'cameras or rows, or smaller networks and buffers', as_json)
    except KeyboardInterrupt:
        return STOPPED
    return 0


def _check_folder() -> None:
    """Refuse to work in a folder that was removed: relative paths are invalid there."""
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise ConfigurationError(
            'the folder in which ocp was started: found that it no longer exists; expected an '
            'existing folder; change to another folder (cd) and start again') from error


def _warn(message: Warning | str, *_: Any) -> None:
    """Print a warning in one line, without its place in the code."""
    print(f'ocp: warning: {printable(str(message))}', file=sys.stderr)


def _sentence_of(error: Exception) -> str:
    """Return an error as one sentence."""
    if isinstance(error, OSError) and error.errno in FULL:
        return (f'{error.filename}: found no room to write it ({error.strerror}); expected some; '
                'what was there before is whole: make room, or name another place, and start '
                'again')
    return str(error)


def _refuse(sentence: str, as_json: bool) -> int:
    """Print an error, and return the exit code."""
    if as_json:
        print(document({'error': sentence}))
    else:
        print(f'ocp: {printable(sentence)}', file=sys.stderr)
    return WRONG


def document(found: Any) -> str:
    """Return plain data as JSON: paths become texts, and numbers that are not finite null."""
    return json.dumps(_plain(found), indent=1, allow_nan=False)


def _plain(value: Any) -> Any:
    """Return a value converted to the types of JSON."""
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
    """Print the names of the written files, and a placement if some of its files are missing."""
    for path in found.get('written', ()):
        print(f'wrote {printable(str(path))}')
    if 'error' in found:
        from ocp_ros.util.yaml_files import written
        print(written({'cameras': found['cameras']}, '.yaml'), end='')


def no_ros(asked: str, error: ImportError) -> ConfigurationError:
    """Return the error of a command or an option that needs ROS 2, which is not installed."""
    return ConfigurationError(f'{asked}: found no ROS 2 ({error}); expected rclpy and its '
                              'messages; run tools/setup, or source a ROS 2 installation')


def command_of(argv: Sequence[str]) -> str:
    """Return a command line as a user types it."""
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
    Check that a file may be written, before any work is done for it.

    :param path: of the file.
    :param what: description of the file, for the message.
    :param option: option that names the file.
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
    Check that files may be written to a folder, before any work is done for them.

    The folder has to be new or empty, or to have the mark of an earlier run.

    :param names: of the files that are written, or removed if an earlier run has left them.
    :param mark: name of a file that every run leaves there, perhaps with ``*``.
    :param read: inputs in addition to those of :func:`inputs_of`.
    :param option: option that names the folder.
    :raises ConfigurationError: if an input would be replaced, or the folder has other files.
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
    """Return whether the file or the files in the folder at a path may be replaced."""
    return arguments.overwrite or path.resolve().is_relative_to(RESULTS.resolve())


def _check_inputs(paths: Iterable[Path], inputs: Iterable[str | Path], option: str) -> None:
    """Refuse to replace an input, also with ``--overwrite``."""
    read = [path for path in map(Path, inputs) if path.exists()]
    for path in paths:
        if path.exists() and any(path.samefile(one) for one in read):
            raise ConfigurationError(
                f'{option}: found {path}, which is an input of this command and would be '
                'replaced; expected an output that replaces no input; name another one')
