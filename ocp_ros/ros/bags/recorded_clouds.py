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

"""Clouds of each camera of a rig from a bag, or from depth images in it, in its body frame."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from ocp_ros.geometry.cameras import TO_BODY
from ocp_ros.registration.steady_cloud import MAX_FRAMES
from ocp_ros.ros.bags.bag_files import Bag, BrokenMessage, Recorded
from ocp_ros.ros.interface.conversions import RawMessage
from ocp_ros.ros.interface.depth_images import POINT_SOURCES, read_points
from ocp_ros.ros.interface.frames import OPTICAL_FRAME_ENDINGS
from ocp_ros.ros.interface.topics import camera_info_of_image
from ocp_ros.util.settings import check_known, ConfigurationError
from sensor_msgs.msg import CameraInfo, PointCloud2


def recorded_frames(path: Path, names: Sequence[str], chosen: Mapping[str, str],
                    frame: str | None = None) -> Iterator[tuple[str, dict[int, np.ndarray]]]:
    """
    Read the clouds of cameras from a bag, one camera after the other.

    :param path: path of the bag.
    :param names: names of the cameras, in the order of the placement.
    :param chosen: topic by the name of the camera; if empty, :func:`topics_of_cameras` chooses.
    :param frame: axes of the clouds, ``'optical'`` or ``'body'``; None: those of depth images are
        optical, those of clouds as the names of their frames say.
    :returns: the name of each camera that has a topic, and its frames by the time of recording,
        nanoseconds: (N, 3) float32, metres, body frame.
    :raises ConfigurationError: if the bag cannot be read, or the topic of a camera is not clear.
    """
    with Bag(path) as bag:
        kinds = {topic.name: topic.kind for topic in bag.topics if topic.kind in POINT_SOURCES}
        check_known(chosen.values(), kinds, f'{path}: topics')
        for name, topic in (chosen or topics_of_cameras(path, names, bag.clouds)).items():
            yield name, _read_frames(bag, topic, kinds[topic], frame)


def topics_of_cameras(path: Path, names: Sequence[str], topics: Sequence[str]) -> dict[str, str]:
    """
    Choose the topic of each camera.

    A camera gets the topic that has its name as a part between slashes. A camera with no such
    topic, or with several, gets none. If no camera gets a topic in this way, there has to be a
    topic for each camera, in their order.

    :returns: topic by the name of the camera.
    :raises ConfigurationError: if no name is found and the numbers of topics and cameras differ.
    """
    matches = {name: [topic for topic in topics if name in topic.split('/')] for name in names}
    unique = {name: matching[0] for name, matching in matches.items() if len(matching) == 1}
    if unique:
        return unique
    if len(topics) != len(names):
        raise ConfigurationError(
            f'{path}: found {len(topics)} topics of clouds ({", ".join(topics) or "none"}) for '
            f'{len(names)} cameras ({", ".join(names)}); expected one each, or the names of '
            'cameras in those of topics; say which is whose (--topics CAMERA=TOPIC)')
    return dict(zip(names, topics))


def _read_frames(bag: Bag, topic: str, kind: str, frame: str | None) -> dict[int, np.ndarray]:
    """Return frames of a topic by the time of recording, each (N, 3) metres, body frame."""
    clouds = {}
    info = None
    if POINT_SOURCES[kind] is not PointCloud2:
        frame = frame or 'optical'
        for item in bag.messages([camera_info_of_image(topic)], max_messages=1):
            if isinstance(item, Recorded):
                info = RawMessage.of(CameraInfo, item.cdr).message()
    # Why there is no cloud; each message that cannot be read replaces it.
    reason = 'it has no message'
    for item in _spread(bag.messages([topic])):
        try:
            if not isinstance(item, Recorded):
                raise item
            points, cloud_frame = read_points(RawMessage.of(POINT_SOURCES[kind], item.cdr), info)
            is_optical = cloud_frame.endswith(OPTICAL_FRAME_ENDINGS)
            rotation = TO_BODY[frame or ('optical' if is_optical else 'body')]
            clouds[item.time] = points @ rotation.T
        except ValueError as error:
            reason = str(error)
    if not clouds:
        raise ConfigurationError(f'{bag.path}: found no cloud on {topic} that can be read '
                                 f'({reason}); expected one; name another topic (--topics)')
    return clouds


def _spread(items: Iterable[Recorded | BrokenMessage]) -> list[Recorded | BrokenMessage]:
    """Return at most ``MAX_FRAMES`` of the first 1,000 items, spread evenly."""
    kept: list[Recorded | BrokenMessage] = []
    stride = 1
    for number, item in enumerate(islice(items, 1000)):
        if number % stride == 0:
            kept.append(item)
            if len(kept) > MAX_FRAMES:
                kept, stride = kept[::2], 2 * stride
    return kept
