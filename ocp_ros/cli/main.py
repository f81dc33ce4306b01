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

"""``ocp``: the package's command line tools, which need no ROS graph."""

import argparse
from importlib import import_module
import sys

from ocp_ros.cli.common import Commands, run

#: The commands, in the order of the help; the module of each is ``NAME_command``.
COMMANDS = ('plan', 'score', 'calibrate', 'export', 'info', 'view', 'studio', 'room', 'rooms',
            'train', 'benchmark', 'replay')


def build_commands(name: str = '') -> Commands:
    """
    Return one command, or all of them.

    The module of a command adds its arguments and has two functions: ``run`` imports slow modules
    and returns plain data, ``show`` prints the data.

    :param name: of the only command to read; any other text for all commands.
    """
    commands = Commands('ocp', 'Where do I put my depth cameras? Tools that need no ROS graph.')
    for command in (name,) if name in COMMANDS else COMMANDS:
        import_module(f'ocp_ros.cli.{command}_command').add_arguments(commands)
    return commands


def build_parser(name: str = '') -> argparse.ArgumentParser:
    """Return the parser of one command, or of all; see :func:`build_commands`."""
    return build_commands(name).parser


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code: 0, or 2 after bad input."""
    arguments = sys.argv[1:] if argv is None else argv
    return run(build_parser(arguments[0] if arguments else ''), arguments)


if __name__ == '__main__':
    sys.exit(main())
