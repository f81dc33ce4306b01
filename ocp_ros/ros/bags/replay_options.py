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
from ocp_ros.ros.bags.bag_files import Bag, CLOUD, KINDS, POSES
from ocp_ros.ros.interface import topics
from ocp_ros.util.settings import check_known, ConfigurationError
from sensor_msgs.msg import PointCloud2

#: The types of recorded messages that are published.
TYPES = {CLOUD: PointCloud2, POSES: PoseArray}


@dataclass(frozen=True)
class ReplayOptions:
    """
    Which topics to replay, and how.

    :ivar topics: names of topics, or ``name:=new``; empty for all clouds, and the poses if any.
    :ivar rate: factor of the recorded speed.
    :ivar loop: whether to begin again at the end, without limit.
    :ivar start: seconds at the beginning of the recording to leave out.
    :ivar duration: seconds of the recording to replay; None for all.
    :ivar frames: pairs of a topic and the frame of its clouds, in place of the recorded one; the
        topic ``''`` stands for all others.
    :ivar poses: one (6,) array per camera: x, y, z, yaw, pitch, roll, metres and radians.
    :ivar fixed_frame: frame of the poses.
    :ivar wait: seconds to wait for subscribers.
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


def chosen_topics(bag: Bag, wanted: tuple[str, ...]) -> dict[str, tuple[str, str]]:
    """
    Choose the topics to replay.

    :param wanted: see :class:`ReplayOptions`.
    :returns: type and published name by recorded name; clouds keep their order.
    :raises ConfigurationError: if a topic is missing or of another type, or there is no cloud.
    """
    known = {topic.name: topic for topic in bag.topics}
    names = dict(name.split(':=', 1) if ':=' in name else (name, name) for name in wanted)
    check_known(names, known, f'{bag.path}: topics')
    for name in names:
        if KINDS.get(known[name].kind) not in TYPES:
            raise ConfigurationError(f'{bag.path}: found {known[name].kind} on {name}; expected '
                                     f'{" or ".join(TYPES)}; leave it out')
    clouds = bag.clouds
    if names and not set(names).intersection(clouds):
        raise ConfigurationError(f'{bag.path}: found no clouds among {", ".join(names)}; expected '
                                 f'one at least of {", ".join(clouds)}; name it')
    if not names:
        names = {name: name for name in clouds}
        if (poses := _poses_among(list(known.values()))) is not None:
            names[poses] = topics.CAMERA_POSES
    return {name: (KINDS[known[name].kind], new) for name, new in names.items()}


def _poses_among(known: list) -> str | None:
    """Return the topic of the camera poses: by its name, or the only PoseArray; else None."""
    arrays = [topic.name for topic in known if topic.kind == POSES]
    named = [name for name in arrays if name.split('/')[-1] == topics.CAMERA_POSES]
    if named:
        return named[0]
    return arrays[0] if len(arrays) == 1 else None
