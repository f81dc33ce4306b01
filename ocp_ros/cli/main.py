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
import sys

from ocp_ros.cli import (
    benchmark_command,
    calibrate_command,
    evaluate_command,
    info_command,
    plan_command,
    replay_command,
    room_command,
    rooms_command,
    score_command,
    studio_command,
    train_command,
    view_command,
)
from ocp_ros.cli.common import Commands, run


def build_commands() -> Commands:
    """
    Return all commands.

    The module of a command adds its arguments and has two functions: ``run`` imports slow modules
    and returns plain data, ``show`` prints the data.
    """
    commands = Commands('ocp', 'Where do I put my depth cameras? Tools that need no ROS graph.')
    for command in (plan_command, score_command, calibrate_command, info_command, view_command,
                    studio_command, room_command, rooms_command, train_command,
                    evaluate_command, benchmark_command, replay_command):
        command.add_arguments(commands)
    return commands


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    return build_commands().parser


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code: 0, or 2 after bad input."""
    return run(build_parser(), sys.argv[1:] if argv is None else argv)


if __name__ == '__main__':
    sys.exit(main())
