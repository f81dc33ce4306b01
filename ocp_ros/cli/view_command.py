# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ocp view``: a room, and where there is one a placement in it, as a page to turn around."""

import argparse
import sys
from typing import Any
import webbrowser

from ocp_ros.cli.score_command import room_and_placement, room_asked
from ocp_ros.planning.assessment import judge
from ocp_ros.report.viewer import write_view
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.shown_text import printable


def view(arguments: argparse.Namespace, command: str) -> dict[str, Any]:
    """
    Write the page, and open it where that is wanted.

    :param arguments: of ``ocp view``.
    :param command: the command line, for the record.
    :returns: which room it is, and the page.
    """
    if arguments.rig and not arguments.placement:
        raise ConfigurationError(f'--rig: found {arguments.rig} and no placement; expected a '
                                 'placement that it is about; name one, or leave it out')
    if arguments.placement is None:
        scene, room = room_asked(arguments, {})
        write_view(arguments.out, scene)
    else:
        scene, placement, room = room_and_placement(arguments)
        write_view(arguments.out, scene, judge(scene, placement, room, command))
    if arguments.open and not webbrowser.open(arguments.out.resolve().as_uri()):
        print(f'no browser was found; open {printable(str(arguments.out))} in one',
              file=sys.stderr)
    return {'room': room, 'written': [str(arguments.out)]}
