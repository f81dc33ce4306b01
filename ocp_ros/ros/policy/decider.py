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

"""Decision of a turn in ``policy_node``: messages to a rig state, one planner step, and back."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, heading_of, Pose
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.online.expected_gain import ExpectedGain
from ocp_ros.online.online_planner import Online
from ocp_ros.online.rig_state import Limits, RigState
from ocp_ros.online.step import OnlineStep
from ocp_ros.rig.motion import way_between
from ocp_ros.rig.rig_file import load_rig
from ocp_ros.ros.interface.conversions import (
    MessageError,
    moved_to,
    msg_to_positions,
    rotation_of,
)
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.policy.policy_planners import make_planner, planned_alike
from ocp_ros.scenes.scene import MAX_EXTENT_M, SceneError
from rclpy.impl.rcutils_logger import RcutilsLogger

if TYPE_CHECKING:
    from ocp_ros.policy.checkpoint import Checkpoint


def limits_of(config: PolicyNodeConfig) -> Limits:
    """Return the limits of a rig's moves in one turn."""
    return Limits(config.max_step, config.max_turn, config.wall_margin, config.clearance)


class Decider:
    """
    Ask a planner for the next camera poses, within the observed floor and the rig's constraints.

    :param config: of the node.
    :param checkpoint: weights of the policy; None if no policy is used.
    :param log: of the node.
    :ivar rig: the rig of the rig file; None without a rig file.
    :ivar learned: the part of the planner that runs the policy; None without a policy.
    :ivar step: computes the time steps.
    :ivar held: a sentence for each camera that stays because it has no feasible pose to go to.
    :ivar widest: the largest camera rotation of the last command, radians.
    :raises ConfigurationError: if the rig file cannot be used.
    """

    def __init__(self, config: PolicyNodeConfig, checkpoint: 'Checkpoint | None',
                 log: RcutilsLogger) -> None:
        self._config, self._log = config, log
        planner, self.learned = make_planner(config, checkpoint)
        self.rig = load_rig(config.rig_file) if config.rig_file else None
        # An error in a step is logged and must not end this node.
        self.step = OnlineStep(planner, limits_of(config), self.rig, log.error)
        self.held: list[str] = []
        self.widest = 0.0

    @property
    def planner(self) -> Online:
        """Return the planner that chooses the moves."""
        return self.step.planner

    def reset(self) -> None:
        """Drop the data of the last episode."""
        self.step.reset()

    def change(self, config: PolicyNodeConfig) -> None:
        """Continue with other parameters; make a new planner if it depends on them."""
        before, self._config, planner = self._config, config, self.planner
        if not planned_alike(before, config):
            planner, self.learned = make_planner(
                config, None if self.learned is None else self.learned.policy.checkpoint)
        self.step.change(planner, limits_of(config))

    @property
    def models(self) -> tuple[CameraModel, ...]:
        """Return the camera model of each camera, or one for all."""
        if self.rig is not None:
            return self.rig.models
        return (CameraModel(self._config.min_range, self._config.max_range),)

    @property
    def alone(self) -> bool:
        """Return whether the policy plays without lookahead; lookahead uses all turns."""
        return self.planner is self.learned

    def movable(self, poses: PoseArray) -> int:
        """Return the number of cameras to place; they come first, then the fixed cameras."""
        return len(poses.poses) if self.rig is None else len(self.rig.cameras)

    @property
    def in_place(self) -> tuple[list[Pose], int]:
        """Return the fixed cameras' poses and the number to place; [] and 0 without a rig file."""
        return ([], 0) if self.rig is None else (
            list(map(Pose.of, self.rig.fixed_poses)), len(self.rig.cameras))

    def check(self, cloud: np.ndarray, poses: PoseArray) -> None:
        """
        Refuse a turn that cannot be used.

        :param cloud: (N, 3) float32, metres: the points observed so far.
        :param poses: of the cameras.
        :raises MessageError: if the cloud is empty or larger than a room, the cameras are of
            another rig, or the heading of a camera with a limited field of view is missing.
        """
        if len(cloud) == 0:
            raise MessageError('cloud: found no finite point; expected what the cameras see')
        around = np.concatenate([corners_of(cloud).astype(np.float64), msg_to_positions(poses)])
        if (size := np.ptp(around, axis=0).max()) > MAX_EXTENT_M:
            raise MessageError(f'cloud: found points and cameras {size:.0f} m apart; expected '
                               f'those of a room, within {MAX_EXTENT_M:.0f} m')
        self.state(poses)

    def state(self, poses: PoseArray) -> RigState:
        """
        Return the poses and models of the cameras; fixed cameras as in the message or the file.

        :param poses: of all cameras of the rig, or only of the cameras to place.
        :raises MessageError: if they are of another rig, or the heading of a camera with a limited
            field of view is missing.
        """
        count = len(poses.poses)
        models, movable, pitch = self.models * count, self.movable(poses), (0.0, 0.5 * np.pi)
        if self.rig is not None:
            models, pitch = self.rig.models, self.rig.pitch
            if count not in (movable, movable + len(self.rig.fixed)):
                others = f', or {movable + len(self.rig.fixed)} with fixed ones' \
                    if self.rig.fixed else ''
                raise MessageError(f'poses: found {count} cameras; expected {movable}{others}, '
                                   f'as {self.rig.document.name} has it')
        rows = np.zeros((count, 6))
        rows[:, :3] = msg_to_positions(poses)
        for camera, (pose, model) in enumerate(zip(poses.poses, models)):
            if not model.omnidirectional:
                rows[camera, 3:] = heading_of(
                    rotation_of(pose.orientation, f'poses: camera {camera}'))
        if self.rig is not None and count == movable:
            rows = np.concatenate([rows, self.rig.fixed_poses])
        return RigState(rows, models, movable, pitch, self._config.max_turn > 0.0,
                        None if self.rig is None else self.rig.clearance)

    def decide(self, cloud: np.ndarray, poses: PoseArray, turn: int) -> PoseArray:
        """
        Choose the next positions and headings of the cameras.

        :param cloud: (N, 3) float32, metres: the points observed so far.
        :param poses: present poses of the cameras.
        :param turn: number of turns played so far.
        """
        state, turns = self.state(poses), self._config.turns
        command = self.step(cloud, state, min(turn, turns), turns)
        self.held = command.held
        if self.held:
            self._log.warning('; '.join(self.held), throttle_duration_sec=5.0)
        headings = {camera: command.placement[camera, 3:] for camera in command.rotated}
        self.widest = max((float(np.linalg.norm(way_between(state.placement[camera, 3:], heading)))
                           for camera, heading in headings.items()), default=0.0)
        return moved_to(poses, command.placement[:len(poses.poses), :3], headings)

    def plan_ahead(self, interrupted: Callable[[], bool]) -> None:
        """
        Let the planner plan the next turn while the cameras move.

        :param interrupted: returns whether planning has to end.
        """
        self.step.plan_ahead(interrupted)

    def expected(self, cloud: np.ndarray, poses: PoseArray, command: PoseArray) -> str:
        """Return the expected gain of a command as a sentence; empty if too little was seen."""
        try:
            return str(ExpectedGain.of(cloud, self.state(poses), self.state(command).placement,
                                       self._config.max_range))
        except SceneError:
            return ''

    def plan(self, cloud: np.ndarray, poses: PoseArray, turn: int) -> None:
        """Let the planner choose moves that are not executed."""
        turns = self._config.turns
        self.step.plan(cloud, self.state(poses), min(turn, turns), turns)
