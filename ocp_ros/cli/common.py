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

"""Common parts of the commands of ``ocp``: parsers, errors, JSON, and checks of outputs."""

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

from ocp_ros.cli import EXIT_STOPPED
from ocp_ros.cli.arguments import join_up_option
from ocp_ros.util.files import file_to_write, printable
from ocp_ros.util.settings import ConfigurationError, UserError

#: Groups of commands in ``ocp --help``, named by their purpose.
PLAN, EVALUATE, LOOK, LEARN, COMPARE, REPLAY = TITLES = (
    'find a placement', 'evaluate a placement', 'look at rooms and placements', 'train a policy',
    'compare planners', 'feed the nodes')
#: Result of a command as plain data.
Found = dict[str, Any]
#: Exit code for wrong input.
EXIT_WRONG_INPUT = 2


class UsageError(Exception):
    """A command line that cannot be read; ``parser`` prints the usage."""

    def __init__(self, parser: argparse.ArgumentParser, message: str) -> None:
        super().__init__(message)
        self.parser = parser


class Parser(argparse.ArgumentParser):
    """A parser that raises errors, so that :func:`run` prints them."""

    def __init__(self, **options: Any) -> None:
        # No abbreviations of options, as :func:`run` searches ``argv`` for ``--json``.
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise a UsageError."""
        raise UsageError(self, message)


class Commands:
    """
    The commands of a program, in groups by purpose.

    :param program: name of the program.
    :param description: purpose of the program.
    :ivar parser: parser of all commands.
    :ivar examples: an example of each command, as a user types it.
    """

    def __init__(self, program: str, description: str) -> None:
        self.parser = Parser(prog=program, usage=f'{program} COMMAND ...', description=description,
                             formatter_class=argparse.RawDescriptionHelpFormatter)
        self._subparsers = self.parser.add_subparsers(
            prog=program, required=True, metavar='COMMAND', help=argparse.SUPPRESS)
        self._contents: dict[str, list[tuple[str, str]]] = {title: [] for title in TITLES}
        self.examples: list[str] = []

    def add(self, group: str, name: str, purpose: str, example: str) -> Parser:
        """
        Add a command, and return its parser, which has the option ``--json``.

        :param group: title of its group, one of ``TITLES``.
        :param purpose: what the command does, in a few words.
        :param example: a command line.
        """
        self._contents[group].append((name, purpose))
        self.parser.epilog = self._contents_table()
        self.examples.append(example)
        parser = self._subparsers.add_parser(
            name, help=purpose, description=f'{purpose[0].upper()}{purpose[1:]}.',
            epilog=f'example:\n  {example}',
            formatter_class=argparse.RawDescriptionHelpFormatter)
        parser.add_argument('--json', action='store_true',
                            help='print one JSON document and nothing else, also for errors')
        return parser

    def _contents_table(self) -> str:
        """Return the table of contents: names and purposes of commands, by group."""
        lines = []
        for title, commands in self._contents.items():
            if commands:
                rows = [f'  {name:<12}{purpose}' for name, purpose in commands]
                lines += [f'{title}:', *rows, '']
        hint = f'{self.parser.prog} COMMAND --help says more, with an example.'
        return '\n'.join([*lines, hint])


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """
    Run one command, and print its result, by its function ``show`` or with ``--json`` as JSON.

    Bad input is reported in one sentence, or with ``--json`` in an object with the key ``error``.
    A result may have the key ``error`` too.

    :param parser: parser of all commands; it sets ``run`` and ``show`` of the chosen command.
    :param argv: the command line without the program's name.
    :returns: the exit code.
    """
    as_json = '--json' in argv
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Characters that a terminal or a pipe cannot encode are printed as escapes.
        sys.stdout.reconfigure(errors='backslashreplace')
    try:
        _check_folder()
        arguments = parser.parse_args(join_up_option(argv))
        arguments.argv = list(argv)
        # With --json, only the document may be on the standard output.
        with warnings.catch_warnings(), redirect_stdout(sys.stderr) if as_json else nullcontext():
            warnings.showwarning = _print_warning
            result = arguments.run(arguments)
        if as_json:
            print(json_text(result))
        else:
            arguments.show(result)
        sys.stdout.flush()
        # A JSON document has the error already.
        if 'error' in result:
            return EXIT_WRONG_INPUT if as_json else _print_error(result['error'], as_json)
    except UsageError as error:
        if not as_json:
            error.parser.print_usage(sys.stderr)
            # This call raises SystemExit, so the line after it is reached with --json only.
            error.parser.exit(
                EXIT_WRONG_INPUT, f'{error.parser.prog}: error: {printable(str(error))}\n')
        return _print_error(str(error), as_json)
    except BrokenPipeError:
        # The reader, such as head, has closed the pipe: discard the rest of the output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (UserError, OSError) as error:
        return _print_error(_error_sentence(error), as_json)
    except MemoryError:
        return _print_error('memory: found less than this needs; expected enough; use fewer '
                            'points, cameras or rows, or smaller networks and buffers', as_json)
    except KeyboardInterrupt:
        return EXIT_STOPPED
    return 0


def _check_folder() -> None:
    """Raise an error if the current folder was removed: relative paths are invalid there."""
    try:
        os.getcwd()
    except FileNotFoundError as error:
        raise ConfigurationError(
            'the folder in which ocp was started: found that it no longer exists; expected an '
            'existing folder; change to another folder (cd) and start again') from error


def _print_warning(message: Warning | str, *_: Any) -> None:
    """Print a warning in one line, without file name and line number."""
    print(f'ocp: warning: {printable(str(message))}', file=sys.stderr)


def _error_sentence(error: Exception) -> str:
    """Return an error as a text."""
    # A full disk, an exceeded quota, or a file that is too large.
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return (f'{error.filename}: found no room to write it ({error.strerror}); expected some; '
                'what was there before is whole: make room, or name another place, and start '
                'again')
    return str(error)


def _print_error(sentence: str, as_json: bool) -> int:
    """Print an error, and return the exit code for wrong input."""
    if as_json:
        print(json_text({'error': sentence}))
    else:
        print(f'ocp: {printable(sentence)}', file=sys.stderr)
    return EXIT_WRONG_INPUT


def json_text(data: Any) -> str:
    """Return data as JSON: paths become texts, and NaN and infinity become null."""
    return json.dumps(_json_value(data), indent=1, allow_nan=False)


def _json_value(value: Any) -> Any:
    """Return a value converted to types that JSON has."""
    if isinstance(value, Mapping):
        return {str(key): _json_value(item) for key, item in value.items()}
    # Arrays and numbers of NumPy.
    if hasattr(value, 'tolist'):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_json_value(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def show_written(result: Found) -> None:
    """Print the names of the written files; if some could not be written, print the cameras."""
    for path in result.get('written', ()):
        print(f'wrote {printable(str(path))}')
    if 'error' in result:
        from ocp_ros.util.yaml_files import written
        print(written({'cameras': result['cameras']}, '.yaml'), end='')


def no_ros(asked: str, error: ImportError) -> ConfigurationError:
    """Return the error of a command or an option that needs ROS 2, which is not installed."""
    return ConfigurationError(f'{asked}: found no ROS 2 ({error}); expected rclpy and its '
                              'messages; run tools/setup, or source a ROS 2 installation')


def command_of(argv: Sequence[str]) -> str:
    """Return a command line as a user types it."""
    return shlex.join(['ocp', *argv])


def inputs_of(arguments: argparse.Namespace) -> list[Path]:
    """Return the files and folders that a command line reads, which it must not replace."""
    paths: list[Any] = []
    for name in ('room', 'rooms', 'placement', 'rig', 'config'):
        value = getattr(arguments, name, None)
        paths += value if isinstance(value, list) else ([value] if value else [])
    return [Path(path) for path in paths]


def claim_file(arguments: argparse.Namespace, path: Path, what: str, option: str = '--out'
               ) -> None:
    """
    Check that a command may write a file, before it does any work.

    :param path: of the file.
    :param what: description of the file, for errors.
    :param option: option that names the file, for errors.
    :raises ConfigurationError: if the file cannot be written, is an input, or exists and may not
        be replaced.
    """
    file_to_write(path, what, option)
    _check_inputs([path], inputs_of(arguments), option)
    if (path.exists() or path.is_symlink()) and not _may_replace(arguments, path):
        raise ConfigurationError(
            f'{option}: found {path}, which exists already; expected a new file; name another '
            'one, or add --overwrite to replace this one')


def claim_folder(arguments: argparse.Namespace, folder: Path, names: Iterable[str], mark: str,
                 more_inputs: Iterable[str | Path] = ()) -> None:
    """
    Check that a command may write files to a folder, before it does any work.

    The folder must be new or empty, or have a file that an earlier run has left. Hidden files do
    not count. A folder in which files may be replaced may have other files too.

    :param names: of the files that are written, or removed if an earlier run has left them.
    :param mark: name of a file that every run leaves in the folder; may contain ``*``.
    :param more_inputs: inputs in addition to those of :func:`inputs_of`.
    :raises ConfigurationError: if an input would be replaced, a folder has one of the names, or
        the folder has other files.
    """
    names = list(names)
    _check_inputs([folder / name for name in names], [*inputs_of(arguments), *more_inputs],
                  '--out')
    if folders := [folder / name for name in names if (folder / name).is_dir()]:
        raise ConfigurationError(
            f'--out: found the folder {folders[0]}; expected a file there, or nothing; '
            'name another folder, or move that one')
    if not folder.is_dir() or _may_replace(arguments, folder) or any(folder.glob(mark)):
        return
    others = sorted(path.name for path in folder.iterdir() if not path.name.startswith('.'))
    if others:
        raise ConfigurationError(
            f'--out: found {folder / others[0]}, and no {mark} of an earlier run; expected a '
            'new or empty folder, or that of an earlier run; name another one, or add --overwrite '
            'to write to this one')


def _may_replace(arguments: argparse.Namespace, path: Path) -> bool:
    """Return whether a command may replace a file, or files in a folder, at a path."""
    # The default outputs are in this folder, in which files are replaced without --overwrite.
    return arguments.overwrite or path.resolve().is_relative_to(Path('out').resolve())


def _check_inputs(paths: Iterable[Path], inputs: Iterable[str | Path], option: str) -> None:
    """Raise an error if a path to write is an input, also with ``--overwrite``."""
    existing = [path for path in map(Path, inputs) if path.exists()]
    for path in paths:
        if path.exists() and any(path.samefile(source) for source in existing):
            raise ConfigurationError(
                f'{option}: found {path}, which is an input of this command and would be '
                'replaced; expected an output that replaces no input; name another one')
