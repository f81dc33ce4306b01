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

"""``ocp replay``: publish the clouds of a bag."""

import argparse
from pathlib import Path

from ocp_ros.cli.arguments import read_delay, read_positive
from ocp_ros.cli.common import Commands, Found, no_ros, REPLAY
from ocp_ros.util.files import printable


def add_arguments(commands: Commands) -> None:
    """Add ``ocp replay``."""
    command = commands.add(
        REPLAY, 'replay', 'publish the clouds of a ROS 1 or ROS 2 bag for policy_node',
        'ocp replay recording --list')
    command.add_argument('bag', type=Path, metavar='BAG', help='ROS 1 bag, or folder of a ROS 2 '
                         'bag')
    command.add_argument('--list', action='store_true', help='show the topics and nothing else')
    command.add_argument('--topics', nargs='+', default=(), metavar='TOPIC[:=NEW]',
                         help='topics to publish, with new names; default: all clouds and the '
                         'camera poses')
    command.add_argument('--rate', type=read_positive, default=1.0, help='speed factor')
    command.add_argument('--loop', action='store_true', help='start again at the end')
    command.add_argument('--start', type=read_delay, default=0.0,
                         help='seconds to skip at the beginning')
    command.add_argument('--duration', type=read_positive, help='seconds of the bag to publish')
    command.add_argument('--frame', action='append', default=[], metavar='[TOPIC=]FRAME',
                         help='frame of the clouds, instead of the recorded one; may be repeated')
    command.add_argument('--pose', action='append', default=[], metavar='X,Y,Z[,YAW,PITCH,ROLL]',
                         help='pose of a camera in metres and degrees, once for each cloud topic; '
                         'write --pose=-1,0,2 if the first number is negative')
    command.add_argument('--fixed-frame', default='map', metavar='FRAME',
                         help='frame of the poses')
    command.add_argument('--wait', type=read_delay, default=10.0,
                         help='seconds to wait for a subscriber')
    command.set_defaults(run=run, show=show)


def run(arguments: argparse.Namespace) -> Found:
    """Publish the clouds of a bag, or list its topics; return counts of messages, or topics."""
    try:
        from ocp_ros.ros.bags.replay_run import replay
    except ImportError as error:
        raise no_ros('ocp replay', error) from error
    return replay(arguments)


def show(result: Found) -> None:
    """Print the number of messages published on each topic, or the topics of the bag."""
    if 'topics' in result:
        from ocp_ros.report.terminal import print_table
        from rich.console import Console
        print_table(Console(), f'{result["bag"]}: {result["seconds"]:.3f} s',
                    ('topic', 'type', 'messages', 'frames', 'published as'),
                    [(topic['topic'], topic['type'], str(topic['messages']),
                      ', '.join(topic['frames']), topic['published_as'] or '-')
                     for topic in result['topics']])
        return
    for name, topic in result['published'].items():
        print(printable(f'{name} -> {topic["as"]}: {topic["messages"]} messages'))
    if result['left_out']:
        print(f'left out {result["left_out"]} messages that could not be used')
