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
Decide when a turn of real cameras is due.

A turn begins when a command is sent. It is due when every camera stands still at its target and
every topic has delivered a cloud since then. The wait is limited both for cameras that do not
arrive and for topics that are silent. Stamps are compared only with stamps; durations are measured
on the steady clock of this machine, which cannot be set. Poses are measurements: the position of a
standing camera is the mean of its poses, and a single pose that is off does not mean that the
camera has left.
"""

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
import math
import time
from typing import Generic, TypeVar

import numpy as np
from ocp_ros.geometry.cameras import angle_between
from scipy.spatial.transform import Rotation

T = TypeVar('T')

#: A camera that had arrived counts as having left when its offset exceeds the arrival distance or
#: angle by this factor: a smaller offset may be noise of the poses.
LEAVING_FACTOR = 4.0
#: Nanoseconds: a cloud whose stamp is later than that of the poses by more has another clock, or a
#: wrong one.
MAX_AHEAD_NS = 1_000_000_000
#: Nanoseconds for which poses have to stay within the limits of a standing camera.
STEADY_NS = 200_000_000
#: Seconds without new poses after which the cameras count as standing too.
QUIET_S = 0.5
#: Seconds for which the status reports that stamps went back.
JUMP_REPORT_S = 10.0
#: Key of the poses in dictionaries whose other keys are names of cloud topics.
POSES = ''


class Turns(Generic[T]):
    """
    Wait for cameras and clouds; keep only the newest cloud of each topic.

    :param topics: names of the cloud topics.
    :param arrival_distance: a camera within this distance of its target has arrived, metres; the
        height counts only if the camera was sent up or down.
    :param arrival_timeout: longest wait for cameras, seconds.
    :param cloud_timeout: longest wait for clouds after the cameras stand, seconds; at least one
        cloud is needed in any case.
    :param clock: returns seconds of a steady clock.
    :param shortest: shortest duration of a turn, seconds.
    :param arrival_angle: a camera within this angle of its target has arrived, radians.
    :ivar positions: (K, 3) metres, newest positions of the cameras; None while no poses came since
        a command to go elsewhere.
    :ivar overdue: whether this turn continues although the cameras have not arrived.
    :ivar late: number of turns that were overdue.
    :ivar jumps: number of times that stamps went back.
    """

    def __init__(self, topics: list[str], arrival_distance: float, arrival_timeout: float,
                 cloud_timeout: float, clock: Callable[[], float] = time.monotonic,
                 shortest: float = 0.0, arrival_angle: float = np.pi) -> None:
        self._topics, self._clock = topics, clock
        self.change(arrival_distance, arrival_timeout, cloud_timeout, shortest, arrival_angle)
        #: Newest stamp of each source (cloud topic or ``POSES``), nanoseconds.
        self._newest_stamps: dict[str, int] = {}
        #: Stamp of the newest poses, or the first stamp after the stamps went back, nanoseconds.
        self._pose_stamp = 0
        #: The newest unread cloud of each topic with its stamp, and the stamp of the cloud that
        #: this turn has used.
        self._waiting: dict[str, tuple[int, T]] = {}
        self._used: dict[str, int] = {}
        #: Time since which the clouds of a topic have been waiting for a newer transform.
        self._waiting_since: dict[str, float] = {}
        #: Topics whose wait ended without a cloud, now or before; using a cloud removes its topic.
        self._silent: set[str] = set()
        self.late = self.jumps = 0
        self.overdue = False
        self.positions: np.ndarray | None = None
        #: Targets of the last command, (K, 3) metres, None before the first one, and its time.
        self._targets: np.ndarray | None = None
        #: (K,) bool, which of them were sent up or down.
        self._height_changes = np.zeros(0, dtype=bool)
        #: Newest rotations of all cameras, and target rotations of those that the command rotates.
        self._rotations: Sequence[np.ndarray] = ()
        self._target_rotations: Mapping[int, np.ndarray] = {}
        self._sent_at = clock()
        #: The first poses that show all cameras standing at their targets: their stamp in
        #: nanoseconds, and the time at which this was found.
        self._standing_from: tuple[int, float] | None = None
        #: Time at which all cameras were first measured at their targets.
        self._arrived_at: float | None = None
        #: The first poses from which all later poses differ by noise only: stamp, positions,
        #: rotations.
        self._reference: tuple[int, np.ndarray, Sequence[np.ndarray]] | None = None
        #: The newest poses: stamp, positions, rotations; and the stamp since which they show the
        #: standing cameras.
        self._recent: deque[tuple[int, np.ndarray, Sequence[np.ndarray]]] = deque(maxlen=100)
        self._averaged_from = 0
        #: By how much the stamps of a topic's clouds are later than those of poses, nanoseconds.
        self._cloud_leads: dict[str, int] = {}
        #: Time at which the newest poses came.
        self._pose_time = clock()
        #: Source whose stamps went back last, and the time of that.
        self._last_jump = '', -math.inf

    def change(self, arrival_distance: float, arrival_timeout: float, cloud_timeout: float,
               shortest: float, arrival_angle: float = np.pi) -> None:
        """Change the limits of waiting; the parameters are those of the class."""
        self._arrival_distance = arrival_distance
        self._arrival_timeout = arrival_timeout
        self._cloud_timeout = cloud_timeout
        self._shortest = shortest
        self._arrival_angle = arrival_angle

    def sent(self, targets: np.ndarray, turned: Mapping[int, np.ndarray] | None = None,
             raised: np.ndarray | None = None) -> None:
        """
        Begin a turn: the cameras were sent to new targets.

        If all cameras are at their targets already, the newest poses show that they stand: some
        rigs publish poses only while they move.

        :param targets: (K, 3) metres.
        :param turned: target rotations, (3, 3), of the cameras that are rotated.
        :param raised: (K,) bool, whether a camera was sent up or down; None: if its target height
            differs from its measured height.
        """
        self._targets = targets
        self._sent_at = self._clock()
        self.overdue = False
        self._height_changes = targets[:, 2] != self.positions[:, 2] if raised is None else raised
        self._target_rotations = turned or {}
        self._standing_from = (self._pose_stamp, self._sent_at) if self._arrived() else None
        self._arrived_at = None
        if self._standing_from is None:
            self.positions = None
        self.restarted()

    def restarted(self) -> None:
        """Drop the clouds of this turn, and wait for new ones."""
        self._waiting.clear()
        self._used.clear()
        self._waiting_since.clear()

    def on_poses(self, stamp: int, positions: np.ndarray,
                 rotations: Sequence[np.ndarray] = ()) -> bool:
        """
        Store measured poses of the cameras.

        :param stamp: nanoseconds.
        :param positions: (K, 3) metres.
        :param rotations: K of (3, 3), needed once a command rotates cameras.
        :returns: whether the poses were used: their stamp is not older than the last one, or a
            clock was set.
        """
        if not self._is_new(POSES, stamp):
            return False
        self.positions = positions
        self._rotations = rotations
        self._pose_stamp = stamp
        self._pose_time = self._clock()
        self._recent.append((stamp, positions, rotations))
        if self._targets is None and self._reference and not self.overdue and self._differs(
                LEAVING_FACTOR * self._arrival_distance, LEAVING_FACTOR * self._arrival_angle):
            # Something else than this node moves the cameras.
            self._wait_for_standing()
        # Measured poses of a standing camera vary by 2 cm and 0.02 radians at most.
        if self._differs(0.02, 0.02):
            self._reference = stamp, positions, rotations
        if self._arrived() or (self._arrived_at is not None and self._arrived(LEAVING_FACTOR)):
            if self._arrived_at is None:
                self._arrived_at = self._pose_time
                self._averaged_from = stamp
            self._update_standing()
        elif not self.overdue:
            self._wait_for_standing()
        return True

    @property
    def measured(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """
        Return the mean of the measured poses since the cameras stand.

        :returns: (K, 3) metres, and K rotations (3, 3).
        """
        poses = [(positions, rotations) for stamp, positions, rotations in self._recent
                 if stamp >= self._averaged_from and len(positions) == len(self.positions)]
        if not poses:
            return self.positions, list(self._rotations)
        first = poses[0][0]
        middle = first + np.mean([positions - first for positions, _ in poses], axis=0)
        return middle, [_mean_rotation([one[k] for _, one in poses])
                        for k in range(len(poses[0][1]))]

    def _wait_for_standing(self) -> None:
        """Wait again for cameras that do not stand any more."""
        self._standing_from = self._arrived_at = None
        self._used.clear()

    def _differs(self, distance: float, angle: float) -> bool:
        """Return whether a camera is farther from its anchor pose than the given limits."""
        if self._reference is None or len(self._reference[1]) != len(self.positions):
            return True
        _, positions, rotations = self._reference
        away = np.linalg.norm(self.positions - positions, axis=1)
        return bool((away > distance).any()) or any(
            angle_between(*pair) > angle for pair in zip(rotations, self._rotations))

    def _arrived(self, times: float = 1.0) -> bool:
        """Return whether every camera is at its target, within ``times`` the arrival limits."""
        if self._targets is None:
            return True
        away = self.positions - self._targets
        away[~self._height_changes, 2] = 0.0
        away = np.linalg.norm(away, axis=1)
        return bool((away <= times * self._arrival_distance).all()) and all(
            angle_between(self._rotations[camera], rotation) <= times * self._arrival_angle
            for camera, rotation in self._target_rotations.items())

    def on_cloud(self, topic: str, stamp: int, cloud: T) -> None:
        """Store a cloud; it replaces the unread cloud of its topic."""
        if self._is_new(topic, stamp):
            self._waiting[topic] = stamp, cloud
            late = self._clock() - self._pose_time
            # The comparison of stamps needs poses of the last half second.
            if POSES in self._newest_stamps and late <= 0.5:
                self._cloud_leads[topic] = stamp - self._pose_stamp - int(late * 1e9)

    def _is_new(self, source: str, stamp: int) -> bool:
        """Return whether a stamp is not older than the last of its source, or a clock was set."""
        last = self._newest_stamps.get(source, stamp)
        # A stamp that goes back by more than a second comes from a clock that was set, or from a
        # recording that began again.
        if last - 1_000_000_000 <= stamp < last:
            return False
        if stamp < last:
            self.jumps += 1
            self._newest_stamps.clear()
            self._cloud_leads.clear()
            self._recent.clear()
            self.restarted()
            self._pose_stamp = stamp
            self._reference = None
            self._averaged_from = stamp
            now, before = self._clock(), self._last_jump[1]
            self._last_jump = source, now
            if self._standing_from is not None:
                # A source with stamps of two clocks must not restart the wait for ever.
                again = now - before <= 2.0 * self._cloud_timeout
                self._standing_from = stamp, self._standing_from[1] if again else now
        self._newest_stamps[source] = stamp
        return True

    def take(self, but: Collection[str] = ()) -> tuple[str, T] | None:
        """
        Take a cloud that this turn can use: since the cameras stand, of a topic not used yet.

        :param but: topics to leave out now.
        """
        if self._standing():
            for topic in self._topics:
                if topic in self._waiting and topic not in (*self._used, *but) and (
                        self._waiting[topic][0] >= self._standing_from[0]) and (
                        self._cloud_leads.get(topic, 0) <= MAX_AHEAD_NS):
                    self._used[topic], cloud = self._waiting.pop(topic)
                    self._silent.discard(topic)
                    return topic, cloud
        return None

    def wait_on(self, topic: str, stamp: int, cloud: T) -> bool:
        """
        Give back a cloud that was taken before its transform came, to be taken again.

        :returns: whether it waits; False if clouds of its topic have waited too long already.
        """
        now = self._clock()
        # Clouds wait a second for a newer transform.
        if now - self._waiting_since.setdefault(topic, now) > 1.0:
            return False
        del self._used[topic]
        self._waiting.setdefault(topic, (stamp, cloud))
        return True

    def refuse(self, topic: str) -> None:
        """Wait for another cloud of a topic: the one that was taken cannot be used."""
        del self._used[topic]
        self._waiting_since.pop(topic, None)

    def due(self) -> bool:
        """Return whether all clouds of this turn are here, or at least one and time is up."""
        up = self._standing() and self._time_is_up()
        if up:
            self._silent |= set(self._topics) - set(self._used)
        soon = self._targets is not None and self._clock() - self._sent_at < self._shortest
        return not soon and (
            len(self._used) == len(self._topics) or (up and bool(self._used)))

    def _time_is_up(self) -> bool:
        """Return whether the cameras have been standing for ``cloud_timeout`` seconds."""
        return self._clock() - self._standing_from[1] >= self._cloud_timeout

    def _standing(self) -> bool:
        """Return whether the cameras stand, or the wait for them is over."""
        self._update_standing()
        now = self._clock()
        patience = self._arrival_timeout
        if self._targets is None:
            # No command was sent yet: the wait is limited even if a person moves the cameras.
            patience = min(patience, 20.0)
        if self._standing_from is None and self.positions is not None and (
                now - self._sent_at >= patience):
            self._standing_from = self._pose_stamp, now
            self._averaged_from = self._pose_stamp
            self.overdue = True
            self.late += 1
        return self._standing_from is not None

    def _update_standing(self) -> None:
        """Mark the cameras as standing if they have been still at their targets."""
        if self._standing_from is not None or self._arrived_at is None:
            return
        now = self._clock()
        if self._reference and (self._pose_stamp - self._reference[0] >= STEADY_NS
                                or now - self._pose_time >= QUIET_S):
            self._standing_from = self._reference[0], now
            self._averaged_from = self._reference[0]
        elif now - self._arrived_at >= self._cloud_timeout:
            # The measured poses never become still: end the wait.
            self._standing_from = self._pose_stamp, now

    def silent(self) -> dict[str, str]:
        """Return the topics whose wait ended without a cloud, with a reason for each."""
        return {topic: self._why_silent(topic) for topic in self._topics if topic in self._silent}

    def _why_silent(self, topic: str) -> str:
        """Return in words what a silent topic has sent last."""
        if topic not in self._newest_stamps:
            return 'nothing came'
        if self._cloud_leads.get(topic, 0) > MAX_AHEAD_NS:
            return f'stamps {self._cloud_leads[topic] * 1e-9:.1f} s after the poses'
        behind = 0
        if self._standing_from is not None:
            behind = self._standing_from[0] - self._newest_stamps[topic]
        return f'stamps {behind * 1e-9:.1f} s before the poses' if behind > 0 else 'nothing usable'

    def backward(self) -> str:
        """Return the source whose stamps went back less than ``JUMP_REPORT_S`` ago; else ''."""
        source, when = self._last_jump
        return '' if self._clock() - when > JUMP_REPORT_S else source or 'the poses'

    @property
    def used(self) -> set[str]:
        """Return the topics whose clouds this turn has used."""
        return set(self._used)

    @property
    def standing(self) -> bool:
        """Return whether the cameras count as standing."""
        return self._standing_from is not None

    @property
    def since(self) -> int:
        """Return the stamp of the poses from which on clouds are used, nanoseconds."""
        return self._standing_from[0]

    @property
    def no_command_sent(self) -> bool:
        """Return whether no command was sent yet."""
        return self._targets is None

    @property
    def stuck(self) -> bool:
        """Return whether the cameras stand and time is up, but no cloud can be used."""
        return self.standing and not self._used and self._time_is_up()

    @property
    def poses_missing(self) -> bool:
        """Return whether no camera poses have come for ``cloud_timeout`` seconds."""
        return self.positions is None and self._clock() - self._sent_at >= self._cloud_timeout

    @property
    def stamp(self) -> int:
        """Return the stamp of the newest cloud that this turn has used, nanoseconds."""
        return max(self._used.values())


def _mean_rotation(rotations: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of rotations (3, 3) that are close to each other."""
    if all(np.array_equal(rotation, rotations[0]) for rotation in rotations[1:]):
        return rotations[0]
    return Rotation.from_matrix(np.array(rotations)).mean().as_matrix()
