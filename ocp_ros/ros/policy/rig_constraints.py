# SPDX-License-Identifier: Apache-2.0
"""The rig file of ``policy_node``: which cameras may be moved, and where to."""

from geometry_msgs.msg import PoseArray
import numpy as np

from ocp_ros.agent.constraint_filter import ConstraintFilter
from ocp_ros.agent.rig_state import RigState
from ocp_ros.geometry.cameras import CameraModel, heading_of
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.ros.interface.conversions import MessageError, msg_to_positions, rotation_of


class RigConstraints:
    """
    Hold commands to a rig file.

    :param path: YAML of docs/rig.md.
    :param wall_margin: cameras stay this far inside the observed bounding box, metres.
    :ivar held: sentences, one for each camera that stays since it may go nowhere.
    :raises ConfigurationError: if the file cannot be used.
    """

    def __init__(self, path: str, wall_margin: float) -> None:
        self.rig = load_rig(path)
        self._guard = ConstraintFilter(self.rig, wall_margin)
        self.held: list[str] = []

    def change_margin(self, wall_margin: float) -> None:
        """Keep another distance from the sides of the observed bounding box, metres."""
        self._guard.wall_margin = wall_margin

    @property
    def models(self) -> tuple[CameraModel, ...]:
        """Return what each camera sees: those to be placed, then those in place."""
        return self.rig.models

    def movable(self, positions: np.ndarray) -> np.ndarray:
        """
        Return where the cameras are that may be moved: (K, 3) metres.

        :param positions: of all cameras of the rig, or of those that are to be placed.
        :raises MessageError: if they are of another rig.
        """
        count, fixed = len(self.rig.cameras), len(self.rig.fixed)
        if len(positions) not in (count, count + fixed):
            others = f', or {count + fixed} with those in place' if fixed else ''
            raise MessageError(f'poses: found {len(positions)} cameras; expected {count}{others}, '
                               f'as {self.rig.document.name} has it')
        return positions[:count]

    def sight(self, poses: PoseArray) -> RigState:
        """
        Return how all cameras of the rig stand; those in place as told, or as the file has them.

        :param poses: of all cameras of the rig, or of those that are to be placed.
        :raises MessageError: if it is not said how a camera is turned that looks one way.
        """
        rows = np.zeros((len(poses.poses), 6))
        rows[:, :3] = msg_to_positions(poses)
        for camera, (pose, model) in enumerate(zip(poses.poses, self.models)):
            if not model.omnidirectional:
                rows[camera, 3:] = heading_of(
                    rotation_of(pose.orientation, f'poses: camera {camera}'))
        if len(rows) == len(self.rig.cameras):
            rows = np.concatenate([rows, self.rig.fixed_poses])
        return RigState(rows, self.models, len(self.rig.cameras), self.rig.pitch)

    def hold(self, cloud: np.ndarray, positions: np.ndarray, targets: np.ndarray, max_step: float
             ) -> np.ndarray:
        """
        Move targets to where the rig file lets cameras be.

        See :class:`ocp_ros.agent.constraint_filter.ConstraintFilter`.

        :param positions: (K, 3) or (K + F, 3) metres, where the cameras are.
        :param targets: of the same shape, where they were to go.
        :returns: where they go; those in place stay.
        """
        count = len(self.rig.cameras)
        fixed = positions[count:] if len(positions) > count else None
        found = self._guard(cloud, positions[:count], targets[:count], max_step, fixed)
        self.held = found.held
        return np.concatenate([found.targets, positions[count:]])
