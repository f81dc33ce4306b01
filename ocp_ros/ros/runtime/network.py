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

"""Range of ROS discovery: only this machine, unless the environment asks for more."""

import os

from ocp_ros.util.resources import share_folder

#: Environment variables that limit nodes of any middleware to this machine.
LOCALHOST_ENVIRONMENT = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
#: Variables by which the user may have set the range of discovery or the transport.
USER_VARIABLES = ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOCALHOST_ONLY', 'ROS_DISCOVERY_SERVER',
                  'FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE',
                  'FASTDDS_BUILTIN_TRANSPORTS', 'CYCLONEDDS_URI')


def local_transport() -> dict[str, str]:
    """
    Return the environment variables that limit nodes to this machine.

    With Fast DDS, messages go by UDP and not by shared memory, for two reasons. A killed node
    keeps the segments that it was reading, until the other nodes have no shared memory left for
    clouds. And a living node may die of SIGSEGV when it ends
    (``SharedMemChannelResource::release``, once in about 700 endings beside killed nodes). Nodes
    that use shared memory are still received, by UDP. Peers in
    ``ROS_STATIC_PEERS`` may be on other machines, which this UDP does not reach.
    """
    middleware = os.environ.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps'
    if not middleware.startswith('rmw_fastrtps') or os.environ.get('ROS_STATIC_PEERS'):
        return LOCALHOST_ENVIRONMENT
    # The file limits the nodes to this machine, so ROS sets no range of its own (SYSTEM_DEFAULT).
    return {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
            'FASTRTPS_DEFAULT_PROFILES_FILE': str(share_folder() / 'config' / 'fastdds_local.xml')}


def stay_local() -> bool:
    """
    Limit this process to its machine, unless a variable of ``USER_VARIABLES`` is set.

    Nodes on this machine are found whatever their own range is. Call it before ``rclpy.init``.

    :returns: whether it was limited: no variable was set.
    """
    # Fast DDS would read a file of the current folder as the user's profile.
    os.environ.setdefault('SKIP_DEFAULT_XML_FILE', '1')
    if any(os.environ.get(name) for name in USER_VARIABLES):
        return False
    os.environ.update(local_transport())
    return True
