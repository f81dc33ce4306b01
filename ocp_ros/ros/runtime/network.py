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

"""How far nodes are heard: no farther than this machine, unless somebody asks for more."""

import os

from ocp_ros.util.resources import share_folder

#: What keeps nodes of any middleware to this machine.
LOCALHOST = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
#: Where somebody may have said how far ROS shall look, or by which transport.
ASKED = ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOCALHOST_ONLY', 'ROS_DISCOVERY_SERVER',
         'FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE',
         'FASTDDS_BUILTIN_TRANSPORTS', 'CYCLONEDDS_URI')


def local_transport() -> dict[str, str]:
    """
    Return the environment that keeps nodes to this machine.

    With Fast DDS messages go by UDP. Of its shared memory a killed node keeps what it was
    reading, until those who live have none left to send clouds in, and who lives may die of
    SIGSEGV when it ends (``SharedMemChannelResource::release``, once in some 700 endings beside
    killed nodes). Nodes that use shared memory are still heard, by UDP. Peers that were named
    one by one (``ROS_STATIC_PEERS``) may be on other machines, which that UDP does not reach.
    """
    middleware = os.environ.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps'
    if not middleware.startswith('rmw_fastrtps') or os.environ.get('ROS_STATIC_PEERS'):
        return LOCALHOST
    return {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
            'FASTRTPS_DEFAULT_PROFILES_FILE': str(share_folder() / 'config' / 'fastdds_local.xml')}


def stay_local() -> bool:
    """
    Keep this process to its machine where nobody has said how far ROS shall look.

    Nodes on this machine are heard whatever they look for. Call it before ``rclpy.init``.

    :returns: whether nobody had.
    """
    # Fast DDS would take a file of the current folder for the user's profile.
    os.environ.setdefault('SKIP_DEFAULT_XML_FILE', '1')
    if any(os.environ.get(name) for name in ASKED):
        return False
    os.environ.update(local_transport())
    return True
