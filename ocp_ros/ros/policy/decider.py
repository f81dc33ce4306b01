# SPDX-License-Identifier: Apache-2.0
"""What ``policy_node`` decides in a turn: what a planner asks for, as far as it is allowed."""

from geometry_msgs.msg import PoseArray
import numpy as np
from rclpy.impl.rcutils_logger import RcutilsLogger

from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.heading_planner import HeadingPlanner
from ocp_ros.agent.rig_state import RigState
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import kept_inside, towards, way_between
from ocp_ros.ros.interface.conversions import MessageError, moved_to, msg_to_positions
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.policy.policy_planners import make_planner, planned_alike
from ocp_ros.ros.policy.rig_constraints import RigConstraints
from ocp_ros.scenes.scene import LARGEST


class Decider:
    """
    Ask a planner where cameras go, and hold its answer to the floor and to a rig file.

    :param config: of the node.
    :param checkpoint: weights of the policy; None where none is asked.
    :param log: of the node.
    :ivar planner: chooses the moves.
    :ivar learned: its part that runs the policy; None where there is none.
    :ivar guard: the rig file; None where there is none.
    :ivar aim: turns the cameras; None where all see all around, for all that is known.
    :ivar widest: the widest turn of a camera that was asked for last, radians.
    :raises ConfigurationError: if the rig file cannot be used.
    """

    def __init__(self, config: PolicyNodeConfig, checkpoint: Checkpoint | None,
                 log: RcutilsLogger) -> None:
        self._config, self._log = config, log
        self.planner, self.learned = make_planner(config, checkpoint)
        self.guard = RigConstraints(config.rig_file,
                                    config.wall_margin) if config.rig_file else None
        self.aim, self.widest = self._make_aim(), 0.0

    def _make_aim(self) -> HeadingPlanner | None:
        """Build what turns the cameras."""
        if self.guard is None:
            return None
        rig = self.guard.rig
        aim = HeadingPlanner(rig.models, len(rig.cameras), rig.pitch, self._config.wall_margin)
        return aim if aim.aimed else None

    def reset(self) -> None:
        """Forget the turns of the last episode."""
        self.planner.reset()
        if self.aim is not None:
            self.aim.reset()

    def change(self, config: PolicyNodeConfig) -> None:
        """Go on with other parameters; a planner that begins anew knows what it needs."""
        before, self._config = self._config, config
        if not planned_alike(before, config):
            self.planner, self.learned = make_planner(
                config, None if self.learned is None else self.learned.policy.checkpoint)
        if self.guard is not None:
            self.guard.change_margin(config.wall_margin)
        if before.wall_margin != config.wall_margin:
            self.aim = self._make_aim()

    @property
    def models(self) -> tuple[CameraModel, ...]:
        """Return what each camera sees, or one model for all."""
        if self.guard is not None:
            return self.guard.models
        return (CameraModel(self._config.min_range, self._config.max_range),)

    @property
    def alone(self) -> bool:
        """Return whether a policy plays without lookahead, which refines to the end."""
        return self.planner is self.learned

    def check(self, cloud: np.ndarray, poses: PoseArray) -> None:
        """
        Refuse what is no turn.

        :param cloud: (N, 3) float32, metres: the points seen so far.
        :param poses: where the cameras are.
        :raises MessageError: if nothing was seen, or not a room, or the cameras are of another
            rig, or nobody says how one is turned that looks one way.
        """
        if len(cloud) == 0:
            raise MessageError('cloud: found no finite point; expected what the cameras see')
        positions = msg_to_positions(poses)
        around = np.concatenate([corners_of(cloud).astype(np.float64), positions])
        if (size := np.ptp(around, axis=0).max()) > LARGEST:
            raise MessageError(f'cloud: found points and cameras {size:.0f} m apart; expected '
                               f'those of a room, within {LARGEST:.0f} m')
        self._movable(positions)
        self.sight(poses)

    def sight(self, poses: PoseArray) -> RigState | None:
        """
        Return how the cameras stand and what each sees; None where nobody knows.

        :raises MessageError: if it is not said how a camera is turned that looks one way.
        """
        return None if self.guard is None else self.guard.sight(poses)._replace(
            turns=self._config.max_turn > 0.0)

    def _movable(self, positions: np.ndarray) -> np.ndarray:
        """Return where the cameras are that may be moved: (M, 3) metres, M <= K."""
        return positions if self.guard is None else self.guard.movable(positions)

    def decide(self, cloud: np.ndarray, poses: PoseArray, step: int, settled: bool) -> PoseArray:
        """
        Choose where the cameras go and how they are turned there.

        :param cloud: (N, 3) float32, metres: the points seen so far.
        :param poses: where the cameras are.
        :param step: turns played so far.
        :param settled: whether the cameras shall stay where they are.
        """
        positions = msg_to_positions(poses)
        target, movable, sight = positions.copy(), self._movable(positions), self.sight(poses)
        self.planner.know(sight)
        if not settled:
            # Nobody leaves the floor that was seen: beyond a wall one looks through its back.
            space = FreePlane.of(cloud, float(np.median(movable[:, 2])), len(movable),
                                 self._config.wall_margin)
            target[:len(movable), :2] = space.moved(
                movable[:, :2], self.moves(cloud, movable, step), self._config.max_step)
        target = self._held(cloud, positions, target, settled)
        turned = {} if settled else self._turned(cloud, sight, target, step)
        self.widest = max((float(np.linalg.norm(way_between(sight.placement[camera, 3:], heading)))
                           for camera, heading in turned.items()), default=0.0)
        return moved_to(poses, target, turned)

    def _turned(self, cloud: np.ndarray, sight: RigState | None, target: np.ndarray, step: int
                ) -> dict[int, np.ndarray]:
        """Return yaw, pitch and roll (3,) in radians of the cameras that are turned."""
        max_turn, turns = self._config.max_turn, self._config.turns
        if self.aim is None or not max_turn:
            return {}
        everybody = sight.placement[:, :3].copy()
        everybody[:len(target)] = target
        try:
            headings = self.aim(cloud, sight, everybody, max_turn, min(step, turns), turns,
                                self.planner.headings)
        except Exception as error:
            # As with planners: whatever happens, this node goes on.
            self._log.error(f'aiming: found {type(error).__name__}: {error}; cameras stay turned '
                            'as they are')
            return {}
        return {camera: headings[camera] for camera in self.aim.aimed}

    def _held(self, cloud: np.ndarray, positions: np.ndarray, target: np.ndarray,
              settled: bool) -> np.ndarray:
        """Bring targets (K, 3) to where cameras may be."""
        if settled:
            return positions.copy()
        target, _ = kept_inside(target, corners_of(cloud).astype(np.float64),
                                self._config.wall_margin)
        if self.guard is None:
            # A camera that looks one way may stand far outside what it has seen.
            target[:, :2] = towards(positions[:, :2], target[:, :2], self._config.max_step)
            return target
        target = self.guard.hold(cloud, positions, target, self._config.max_step)
        if self.guard.held:
            self._log.warning('; '.join(self.guard.held), throttle_duration_sec=5.0)
        return target

    def moves(self, cloud: np.ndarray, positions: np.ndarray, step: int) -> np.ndarray:
        """Ask the planner for the next moves, (K, 2) metres; where it fails, cameras stay."""
        turns = self._config.turns
        try:
            moves = self.planner.move(cloud, positions, min(step, turns), turns)
        except Exception as error:
            # Planners know what to do without a room. What else may happen, this node goes on.
            failure = f'{type(error).__name__}: {error}'
        else:
            if np.isfinite(moves).all():
                return moves
            failure = 'moves of NaN or inf'
        self._log.error(
            f'{self._config.planner}: found {failure}; cameras stay where they are')
        return np.zeros((len(positions), 2))
