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

"""Instructions in words, and as arrows, for a person who moves the cameras."""

from collections.abc import Mapping, Sequence

import numpy as np
from ocp_ros.geometry.cameras import heading_of
from ocp_ros.rig.motion import way_between
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.frames import LiveRig
from ocp_ros.ros.interface.qos import LATCHED
from ocp_ros.ros.interface.views import move_markers
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from rclpy.node import Node
from std_msgs.msg import Header, String
from visualization_msgs.msg import MarkerArray

STAY = 'leave every camera where it is'
FINAL = f'the placement is final: {STAY}'


def needs_move(positions: np.ndarray, targets: np.ndarray, min_move: float) -> np.ndarray:
    """
    Return for each camera whether it has to be moved.

    :param positions: (K, 3) metres, present positions.
    :param targets: (K, 3) metres, target positions.
    :param min_move: moves up to this length are left out, metres.
    :returns: (K,) bool.
    """
    return np.linalg.norm(targets - positions, axis=1) > min_move


def instructions(positions: np.ndarray, targets: np.ndarray, min_move: float,
                 rotations: np.ndarray | None = None, min_rotation: float = np.inf,
                 expected: str = '') -> str:
    """
    Return the instructions: a line for each camera that has to be moved or rotated.

    A plan has x to the right and y upwards: its arrows say in which direction to move.

    :param positions: present positions of K cameras, (K, 3) metres.
    :param targets: target positions, (K, 3) metres.
    :param min_move: moves up to this length, and shorter parts of a longer move, are left out,
        metres.
    :param rotations: rotations of the cameras, (K, 2) radians: counter-clockwise seen from above,
        and down; None if no camera is rotated.
    :param min_rotation: rotations up to this angle are left out in the same way, radians.
    :param expected: a sentence on the expected gain, so that a person can decide to stop; empty:
        none.
    :returns: the lines and the sentence; ``STAY`` if no camera has to be moved or rotated.
    """
    rotations = np.zeros((len(targets), 2)) if rotations is None else rotations
    has_move = needs_move(positions, targets, min_move)
    has_rotation = np.linalg.norm(rotations, axis=1) > min_rotation
    lines = []
    for camera in np.flatnonzero(has_move | has_rotation):
        texts = []
        if has_move[camera]:
            move = targets[camera] - positions[camera]
            # The height of the target is printed only if it changes. Adding 0 changes -0 to 0.
            coordinates = np.round(targets[camera][:3 if move[2] else 2], 2) + 0.0
            place = ', '.join(f'{coordinate:.2f}' for coordinate in coordinates)
            texts.append(_parts_text(
                move, min_move, '{:.2f} m {}', ('→←', '↑↓', ('higher', 'lower')))
                + f', to ({place})')
        if has_rotation[camera]:
            texts.append('turn ' + _parts_text(
                np.rad2deg(rotations[camera]), np.rad2deg(min_rotation), '{:.0f} degrees {}',
                (('to the left', 'to the right'), ('down', 'up'))))
        lines.append(f'camera {camera}: {"; ".join(texts)}')
    if not lines:
        return STAY
    return '\n'.join([*lines, expected] if expected else lines)


def _parts_text(parts: np.ndarray, least: float, form: str, directions: Sequence[Sequence[str]]
                ) -> str:
    """
    Return the parts of a move or rotation in words.

    :param parts: (A,) the part along each axis.
    :param least: smaller parts are left out; if all are smaller, the largest one stays.
    :param form: text of a part, with places for its length and its direction.
    :param directions: for each axis the directions of a positive and of a negative part.
    """
    least = min(least, np.abs(parts).max())
    return ' and '.join(form.format(abs(part), names[int(part < 0.0)])
                        for part, names in zip(parts, directions) if abs(part) >= least)


class Instructor:
    """
    Publish which cameras a person has to move or rotate, if that has changed.

    :param node: gets the publishers.
    """

    def __init__(self, node: Node) -> None:
        self._log = node.get_logger()
        self._text_publisher = node.create_publisher(String, topics.INSTRUCTIONS, LATCHED)
        self._markers_publisher = node.create_publisher(MarkerArray, topics.MARKERS, LATCHED)
        self.reset()

    def reset(self) -> None:
        """Forget the last instruction."""
        self._text = ''
        #: The last instruction, (K, 8): target x, y, z and present x, y, z, metres; changes of yaw
        #: and pitch, radians.
        self._moves = np.empty((0, 8))

    def publish(self, rig: LiveRig, targets: np.ndarray,
                target_rotations: Mapping[int, np.ndarray], header: Header,
                config: PolicyNodeConfig, expected: str, is_final: bool) -> None:
        """
        Publish the instructions.

        :param rig: present poses of K cameras.
        :param targets: target positions, (K, 3) metres.
        :param target_rotations: target rotations, (3, 3), of the cameras that are rotated.
        :param header: header of the markers.
        :param config: smaller moves and rotations than its arrival limits are left out.
        :param expected: see :func:`instructions`.
        :param is_final: whether the placement is final: all cameras stay.
        """
        positions = rig.positions
        # Changes of yaw and pitch, radians.
        changes = np.zeros((len(targets), 2))
        for camera, target_rotation in target_rotations.items():
            changes[camera] = way_between(heading_of(rig.poses[camera].rotation),
                                          heading_of(target_rotation))
        min_move = config.arrival_distance
        text = FINAL if is_final else instructions(
            positions, targets, min_move, changes, config.arrival_angle, expected)
        moves = np.column_stack([targets, positions, changes])
        # Changes of less than 5 cm and 0.05 radians may be noise of the poses.
        is_same = (self._moves.shape == moves.shape
                   and (np.abs(moves - self._moves) < 0.05).all()
                   and _instructed_cameras(text) == _instructed_cameras(self._text))
        if text != self._text and not is_same:
            self._text = text
            self._moves = moves
            self._text_publisher.publish(String(data=text))
            self._markers_publisher.publish(
                move_markers(positions, targets, needs_move(positions, targets, min_move), header))
            self._log.info(text)


def _instructed_cameras(text: str) -> list[str]:
    """Return the lines of an instruction without distances: cameras, or the text to stay."""
    return [line.partition(':')[0] for line in text.splitlines()]
