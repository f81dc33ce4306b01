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

"""Options of ``ocp replay``, and the topics that it publishes."""

from dataclasses import dataclass

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.ros.bags.bag_files import Bag, CLOUD, POSES
from ocp_ros.ros.interface import topics
from ocp_ros.util.settings import check_known, ConfigurationError
from sensor_msgs.msg import PointCloud2

#: The types of recorded messages that are published.
TYPES = {CLOUD: PointCloud2, POSES: PoseArray}


@dataclass(frozen=True)
class ReplayOptions:
    """
    Which topics to replay, and how.

    :ivar topics: names of topics, or ``name:=new_name``; empty: all clouds, and the poses if any.
    :ivar rate: factor of the recorded speed.
    :ivar loop: whether to begin again at the end, without limit.
    :ivar start: seconds at the beginning of the recording to leave out.
    :ivar duration: seconds of the recording to replay; None: to its end.
    :ivar frames: pairs of a topic and the frame of its clouds, in place of the recorded one; the
        topic ``''`` stands for all others.
    :ivar poses: an array (6,) for each camera: x, y, z (metres), yaw, pitch, roll (radians).
    :ivar fixed_frame: frame of the poses.
    :ivar wait: longest time to wait for subscribers, seconds.
    """

    topics: tuple[str, ...] = ()
    rate: float = 1.0
    loop: bool = False
    start: float = 0.0
    duration: float | None = None
    frames: tuple[tuple[str, str], ...] = ()
    poses: tuple[np.ndarray, ...] = ()
    fixed_frame: str = 'map'
    wait: float = 10.0


def choose_topics(bag: Bag, requested: tuple[str, ...]) -> dict[str, tuple[str, str]]:
    """
    Choose the topics to replay.

    :param requested: see ``topics`` of :class:`ReplayOptions`.
    :returns: message type and published name by recorded name, in the order of ``requested``; if
        this is empty, the clouds sorted by name, then the poses.
    :raises ConfigurationError: if a topic is missing or of another type, or there is no cloud.
    """
    known = {topic.name: topic for topic in bag.topics}
    names = dict(name.split(':=', 1) if ':=' in name else (name, name) for name in requested)
    check_known(names, known, f'{bag.path}: topics')
    for name in names:
        if known[name].kind not in TYPES:
            raise ConfigurationError(f'{bag.path}: found {known[name].kind} on {name}; expected '
                                     f'{" or ".join(TYPES)}; leave it out')
    # This raises the error if the bag has no clouds.
    clouds = bag.clouds
    if names and not set(names).intersection(clouds):
        raise ConfigurationError(f'{bag.path}: found no clouds among {", ".join(names)}; expected '
                                 f'one at least of {", ".join(clouds)}; name it')
    if not names:
        names = {name: name for name in clouds}
        if (poses := _find_poses_topic(list(known.values()))) is not None:
            names[poses] = topics.CAMERA_POSES
    return {name: (known[name].kind, new_name) for name, new_name in names.items()}


def _find_poses_topic(known: list) -> str | None:
    """Return the topic named as camera poses, else the only PoseArray topic; None if neither."""
    pose_topics = [topic.name for topic in known if topic.kind == POSES]
    named = [name for name in pose_topics if name.split('/')[-1] == topics.CAMERA_POSES]
    if named:
        return named[0]
    return pose_topics[0] if len(pose_topics) == 1 else None
