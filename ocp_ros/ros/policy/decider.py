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

"""
Decision of a turn in ``policy_node``: messages to a rig state, one planner step, and back.

PyTorch is imported only where a policy is made: its import takes longer than all others together.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
import math
import time
from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.geometry.cameras import CameraModel, heading_of, Pose
from ocp_ros.geometry.clouds import corners_of, voxel_downsample
from ocp_ros.online.heading_planner import never_interrupted
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.online_planner import Online
from ocp_ros.online.rig_state import RigState
from ocp_ros.online.step import ExpectedGain, OnlineStep
from ocp_ros.policy.learned import Learned, PolicyAlone
from ocp_ros.rig.placement_file import as_written, Placed, Placement, placement_of
from ocp_ros.rig.rig_file import Camera, load_rig, Rig, rig_of
from ocp_ros.rig.structure import floors_of
from ocp_ros.ros.interface.conversions import (
    MessageError,
    move_poses,
    msg_to_positions,
    rotation_of,
)
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.scenes.scene import MAX_EXTENT_M, Scene, SceneError
from ocp_ros.util.settings import ConfigurationError
from rclpy.impl.rcutils_logger import RcutilsLogger

if TYPE_CHECKING:
    from ocp_ros.policy.checkpoint import Checkpoint

#: Longest time that a turn of a simulation waits for a plan made meanwhile, seconds; planners need
#: about a tenth of it.
PATIENCE_S = 2.0
#: Edge of the cubes of which one point each shows where the floor is, metres.
FLOOR_VOXEL_M = 0.1
#: Parameters that the constructor of a planner takes, and that may change at run time.
PLANNER_PARAMETERS = ('max_step', 'max_range', 'wall_margin', 'clearance')


def max_range_of(config: PolicyNodeConfig, rig: Rig | None) -> float:
    """Return the range of the cameras to place, metres: that of the rig file, if there is one."""
    return config.max_range if rig is None else rig.farthest


def make_planner(config: PolicyNodeConfig, checkpoint: 'Checkpoint | None',
                 rig: Rig | None = None) -> tuple[Online, PolicyAlone | None]:
    """
    Build the planner that chooses the moves.

    :param config: parameters of the node: the name of the planner, and limits of the moves.
    :param checkpoint: weights of the policy; None if no policy is used.
    :param rig: the rig of the rig file; None without a rig file.
    :returns: the planner, and its part that runs the policy (None without a policy).
    """
    # The positional arguments of Online.
    settings = (np.random.default_rng(config.seed), config.max_step, max_range_of(config, rig),
                config.wall_margin, config.clearance)
    if checkpoint is None:
        return Lookahead(*settings), None
    from ocp_ros.policy.policy import Policy
    from ocp_ros.ros.policy.experiences import RecordedPolicy
    if config.explore:
        explorer = PolicyAlone(RecordedPolicy(checkpoint), *settings, drawn=True)
        return explorer, explorer
    learned = Learned(Policy(checkpoint), *settings)
    return learned, learned.agent


class Decider:
    """
    Ask a planner for the next camera poses, within the observed floor and the rig's constraints.

    While the cameras move, the planner plans ahead in a thread of its own. All methods that use
    the planner end this first.

    :param config: parameters of the node.
    :param checkpoint: weights of the policy; None if no policy is used.
    :param log: log of the node.
    :ivar rig: the rig of the rig file; None without a rig file.
    :ivar explorer: the part of the planner that runs the policy; None without a policy.
    :ivar step: computes the turns.
    :ivar stay_warnings: a sentence for each camera that stays since it has no feasible pose.
    :raises ConfigurationError: if the rig file cannot be used.
    """

    def __init__(self, config: PolicyNodeConfig, checkpoint: 'Checkpoint | None',
                 log: RcutilsLogger) -> None:
        self._config = config
        self._log = log
        self.rig = load_rig(config.rig_file) if config.rig_file else None
        planner, self.explorer = make_planner(config, checkpoint, self.rig)
        # Real cameras get a command within ``think_seconds``, if that is limited.
        at_once = bool(config.live_topics) and config.think_seconds > 0.0
        # An error in a step is logged and must not end this node.
        self.step = OnlineStep(planner, config, self.rig, log.error, at_once)
        self.stay_warnings: list[str] = []
        #: Size of the cloud in which real cameras without a rig file were last looked at.
        self._mount_points = 0
        self._thread = ThreadPoolExecutor(1, 'planner')
        #: The plan that is being made while the cameras move; None if there is none.
        self._plan: Future[None] | None = None
        #: Time on the steady clock at which planning stops, seconds.
        self._deadline = math.inf

    def reset(self) -> None:
        """Drop the data of the last episode."""
        self._end_planning()
        self.step.reset()
        if self.rig is None:
            # Next, there may be other cameras.
            self._mount_points = 0
            self.step.constrain(None)

    def close(self) -> None:
        """End the planner."""
        self._end_planning()
        self._thread.shutdown()

    def plan_ahead(self) -> None:
        """Plan the next turn while the cameras move."""
        if self._plan is None:
            self._deadline = math.inf
            self._plan = self._thread.submit(self.step.plan_ahead, self._must_stop)

    def _must_stop(self) -> bool:
        """Return whether the planner has to stop and use the best plan so far."""
        return time.monotonic() > self._deadline

    def _end_planning(self, seconds: float = 0.0) -> None:
        """Let the planner plan ahead for at most some more seconds, and wait until it ends."""
        self._deadline = time.monotonic() + seconds
        if self._plan is not None:
            plan, self._plan = self._plan, None
            plan.result()

    def apply_config(self, config: PolicyNodeConfig) -> None:
        """Continue with new parameters; make a new planner if the present one does not suit."""
        self._end_planning()
        planner = self.step.planner
        if any(getattr(self._config, name) != getattr(config, name)
               for name in PLANNER_PARAMETERS):
            checkpoint = None if self.explorer is None else self.explorer.policy.checkpoint
            planner, self.explorer = make_planner(config, checkpoint, self.rig)
        self._config = config
        self.step.change(planner, config)

    @property
    def models(self) -> tuple[CameraModel, ...]:
        """Return the model of each camera; without a rig file, a single model for all cameras."""
        if self.rig is not None:
            return self.rig.models
        return (CameraModel(self._config.min_range, self._config.max_range),)

    @property
    def ranges(self) -> tuple[float, float]:
        """Return the least minimum range and the largest maximum range of all cameras, metres."""
        return (min(model.min_range for model in self.models),
                max(model.max_range for model in self.models))

    def count_movable(self, poses: PoseArray) -> int:
        """Return the number of cameras to place; the fixed cameras come after them in a rig."""
        return len(poses.poses) if self.rig is None else len(self.rig.cameras)

    def add_fixed_poses(self, poses: list[Pose]) -> list[Pose]:
        """Return poses of cameras, followed by those of the fixed cameras that are missing."""
        if self.rig is None:
            return poses
        # Poses beyond the cameras to place are those of the first fixed cameras.
        known_count = max(len(poses) - len(self.rig.cameras), 0)
        return poses + [Pose.of(row) for row in self.rig.fixed_poses[known_count:]]

    def check_turn(self, cloud: np.ndarray, poses: PoseArray) -> None:
        """
        Refuse a turn that cannot be used.

        :param cloud: the N points observed so far, (N, 3) float32, metres.
        :param poses: present poses of the cameras.
        :raises MessageError: if the cloud is empty or larger than a room, the cameras are of
            another rig, or the heading of a camera with a limited field of view is missing.
        """
        if len(cloud) == 0:
            raise MessageError('cloud: found no finite point; expected what the cameras see')
        extremes = np.concatenate([corners_of(cloud).astype(np.float64), msg_to_positions(poses)])
        if (size := np.ptp(extremes, axis=0).max()) > MAX_EXTENT_M:
            raise MessageError(f'cloud: found points and cameras {size:.0f} m apart; expected '
                               f'those of a room, within {MAX_EXTENT_M:.0f} m')
        # This checks the number of the cameras and their headings.
        self.state(poses)

    def state(self, poses: PoseArray) -> RigState:
        """
        Return the poses and models of all cameras of the rig.

        :param poses: poses of the cameras to place, followed by those of all fixed cameras or of
            none. The poses of missing fixed cameras are those of the rig file.
        :raises MessageError: if the cameras are of another rig, or the heading of a camera with a
            limited field of view is missing.
        """
        count = len(poses.poses)
        movable = self.count_movable(poses)
        models = self.models * count if self.rig is None else self.models
        # Without a rig file the cameras are omnidirectional: their pitch limits have no effect.
        pitch = (0.0, 0.5 * np.pi) if self.rig is None else self.rig.pitch
        if self.rig is not None:
            with_fixed = movable + len(self.rig.fixed)
            if count not in (movable, with_fixed):
                others = f', or {with_fixed} with fixed ones' if self.rig.fixed else ''
                raise MessageError(f'poses: found {count} cameras; expected {movable}{others}, as '
                                   f'{self.rig.document.name} has it')
        # Poses, metres and radians; the heading of an omnidirectional camera stays 0.
        rows = np.zeros((count, 6))
        rows[:, :3] = msg_to_positions(poses)
        for camera, (pose, model) in enumerate(zip(poses.poses, models)):
            if not model.omnidirectional:
                rows[camera, 3:] = heading_of(
                    rotation_of(pose.orientation, f'poses: camera {camera}'))
        if self.rig is not None and count == movable:
            rows = np.concatenate([rows, self.rig.fixed_poses])
        return RigState(rows, models, movable, pitch, may_rotate=self._config.max_turn > 0.0,
                        clearance=None if self.rig is None else self.rig.clearance)

    def all_poses(self, poses: PoseArray) -> list[Pose]:
        """Return the poses of all cameras in a turn, fixed cameras included; see :meth:`state`."""
        return [Pose.of(row) for row in self.state(poses).placement]

    def placement(self, poses: np.ndarray, frame: str, created: dict[str, str] | None = None
                  ) -> Placement:
        """
        Return a placement of the cameras.

        Without a rig file, or if poses are missing, the cameras are named by their numbers.

        :param poses: (N, 6) metres and radians. The placement takes the poses of fixed cameras
            from the rig file.
        :param frame: frame of the poses.
        :param created: see :class:`~ocp_ros.rig.placement_file.Placement`.
        """
        fields = {'created': created or {}, 'frame': frame}
        if self.rig is not None and len(poses) >= len(self.rig.cameras):
            return placement_of(self.rig, poses[:len(self.rig.cameras)], **fields)
        models = self.models * len(poses) if self.rig is None else self.models
        return Placement(tuple(
            Placed(Camera(f'camera_{number}', '', model), tuple(pose[:3].tolist()),
                   tuple(np.rad2deg(pose[3:]).tolist()), 'free')
            for number, (pose, model) in enumerate(zip(as_written(poses), models))), **fields)

    def decide(self, cloud: np.ndarray, poses: PoseArray, turn: int) -> PoseArray:
        """
        Return the next positions and headings of the cameras.

        :param cloud: the N points observed so far, (N, 3) float32, metres.
        :param poses: present poses of the cameras.
        :param turn: number of turns played so far.
        :returns: a pose for each of ``poses``.
        """
        state = self.state(poses)
        at_once = self.step.planner.at_once
        self._end_planning(self._config.think_seconds if at_once else PATIENCE_S)
        is_unknown_rig = self.rig is None and bool(self._config.live_topics)
        if is_unknown_rig and len(cloud) > 1.5 * self._mount_points:
            self._find_mount(cloud, state)
        # The parameter ``turns`` may have been lowered below the number of turns played.
        turns = self._config.turns
        command = self.step(cloud, state, min(turn, turns), turns,
                            self._must_stop if at_once else never_interrupted)
        self.stay_warnings = command.held
        if self.stay_warnings:
            self._log.warning('; '.join(self.stay_warnings), throttle_duration_sec=5.0)
        headings = {camera: command.placement[camera, 3:] for camera in command.rotated}
        # The placement has the fixed cameras too, which ``poses`` may lack.
        return move_poses(poses, command.placement[:len(poses.poses), :3], headings)

    def _find_mount(self, cloud: np.ndarray, state: RigState) -> None:
        """Take real cameras without a rig file to be on tripods, as a rig file does by height."""
        self._mount_points = len(cloud)
        positions = state.placement[:, :3]
        # A floor is found in thinned points too, in a third of the time or less. Cameras whose
        # height is not that of cameras are left as they are.
        with suppress(ConfigurationError, SceneError):
            floor = floors_of(Scene(voxel_downsample(cloud, FLOOR_VOXEL_M), 'observed cloud')
                              ).under(positions)
            height = float(np.median(positions[:, 2] - floor))
            rig = rig_of(len(positions), mount={'on': 'plane', 'height': height},
                         keep_clear=self._config.clearance)
            rig = replace(rig, cameras=tuple(
                camera._replace(name=f'camera_{number}')
                for number, camera in enumerate(rig.cameras)))
            on_tripods = rig.mount.footprint > 0.0
            if on_tripods != (self.step.rig is not None):
                self.step.constrain(rig if on_tripods else None)
                feet = f'on tripods, with {rig.mount.footprint} m of free floor around each' \
                    if on_tripods else 'not on tripods'
                self._log.info(f'cameras: found them {height:.2f} m above the floor and no rig '
                               f'file: taken to be {feet}; to change this, name a rig_file')

    def describe_gain(self, cloud: np.ndarray, poses: PoseArray, command: PoseArray) -> str:
        """Return a sentence on the expected gain of a command; empty if too little is observed."""
        try:
            return str(ExpectedGain.of(cloud, self.state(poses), self.state(command).placement,
                                       max_range_of(self._config, self.rig)))
        except SceneError:
            return ''

    def plan(self, cloud: np.ndarray, poses: PoseArray, turn: int) -> None:
        """Let the planner choose moves that are not executed: a recording policy records them."""
        self._end_planning()
        turns = self._config.turns
        self.step.plan(cloud, self.state(poses), min(turn, turns), turns)
