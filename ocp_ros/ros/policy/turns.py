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

from collections import defaultdict, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
import math
import time
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from ocp_ros.geometry.cameras import angle_between
from scipy.spatial.transform import Rotation

T = TypeVar('T')

#: Nanoseconds: a cloud whose stamp is later than that of the poses by more than this has another
#: clock than the poses, or a wrong one.
MAX_LEAD_NS = 1_000_000_000
#: Nanoseconds for which poses have to stay within the limits of a standing camera.
STEADY_NS = 200_000_000
#: Poses that have stayed within the limits of arrival for this long are noisy, nanoseconds.
NOISY_NS = 1_000_000_000
#: Seconds without new poses after which the cameras count as standing too, and clocks cannot be
#: compared any more.
QUIET_S = 0.5
#: Seconds for which the status reports that stamps went back.
JUMP_REPORT_S = 10.0
#: Key of the poses in dictionaries whose other keys are names of cloud topics.
POSES = ''


class WaitLimits(NamedTuple):
    """
    Limits of waiting for cameras and clouds.

    :ivar arrival_distance: a camera within this distance of its target has arrived, metres; the
        height counts only if the camera was sent up or down.
    :ivar arrival_timeout: longest wait for cameras, seconds.
    :ivar cloud_timeout: longest wait for clouds after the cameras stand, seconds; at least one
        cloud is needed in any case.
    :ivar min_duration: shortest duration of a turn, seconds.
    :ivar arrival_angle: a camera within this angle of its target has arrived, radians.
    """

    arrival_distance: float
    arrival_timeout: float
    cloud_timeout: float
    min_duration: float = 0.0
    arrival_angle: float = np.pi


class _Poses(NamedTuple):
    """Measured poses: stamp in nanoseconds, positions (K, 3) in metres, K rotations (3, 3)."""

    stamp: int
    positions: np.ndarray
    rotations: Sequence[np.ndarray]


class Moment(NamedTuple):
    """The stamp of poses, nanoseconds, and the time on the steady clock, seconds."""

    stamp: int
    time: float


class Turns(Generic[T]):
    """
    Wait for cameras and clouds; keep only the newest cloud of each topic.

    Below, K is the number of cameras.

    :param topics: names of the cloud topics.
    :param limits: limits of waiting; they may be replaced at any time.
    :param clock: returns seconds of a steady clock.
    :ivar positions: (K, 3) metres, newest positions of the cameras; None before the first poses,
        and from a command to go elsewhere until the next poses.
    :ivar overdue: whether this turn continues although the cameras have not arrived.
    :ivar overdue_turns: number of turns that were overdue.
    :ivar stamp_jumps: number of times that stamps went back.
    :ivar used_stamps: by topic: stamp of the cloud that this turn has used, nanoseconds.
    :ivar standing_begin: stamp of the first poses that show all cameras standing at their targets,
        from which on clouds are used, and the time at which this was found; None while the cameras
        do not stand.
    """

    def __init__(self, topics: list[str], limits: WaitLimits,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._topics = topics
        self.limits = limits
        self._clock = clock
        #: Newest stamp of each source (cloud topic or ``POSES``), nanoseconds.
        self._newest_stamps: dict[str, int] = {}
        #: Stamp of the newest poses, or the first stamp after the stamps went back, nanoseconds.
        self._pose_stamp = 0
        #: The newest unread cloud of each topic, with its stamp.
        self._unread_clouds: dict[str, tuple[int, T]] = {}
        self.used_stamps: dict[str, int] = {}
        #: Time since which the clouds of a topic have been waiting for a newer transform.
        self._transform_waits: dict[str, float] = {}
        #: Topics whose wait ended without a cloud, now or before; using a cloud removes its topic.
        self._silent_topics: set[str] = set()
        self.overdue_turns = 0
        self.stamp_jumps = 0
        self.overdue = False
        self.positions: np.ndarray | None = None
        #: Targets of the last command, (K, 3) metres; None before the first command.
        self._targets: np.ndarray | None = None
        #: (K,) bool, whether the last command sent each camera up or down.
        self._height_changes = np.zeros(0, dtype=bool)
        #: Newest rotations of all cameras, and target rotations of those that the command rotates.
        self._rotations: Sequence[np.ndarray] = ()
        self._target_rotations: Mapping[int, np.ndarray] = {}
        #: Time of the last command; of the start before the first command.
        self._command_time = clock()
        self.standing_begin: Moment | None = None
        #: Time at which all cameras were first measured at their targets.
        self._arrival_time: float | None = None
        #: Whether the cameras count as arrived in this turn although they may not be at their
        #: targets.
        self._arrival_accepted = False
        #: The first poses from which all later poses differ by noise only.
        self._reference: _Poses | None = None
        #: The newest poses, and the stamp since which they show the standing cameras.
        self._recent_poses: deque[_Poses] = deque(maxlen=100)
        self._mean_begin_ns = 0
        #: By how much the stamps of a topic's newest clouds are later than those of poses,
        #: nanoseconds.
        self._cloud_leads = defaultdict[str, deque[int]](partial(deque, [0], maxlen=5))
        #: By topic: stamp of the poses that its last cloud was compared with, and when that came.
        self._compared_poses: dict[str, int] = {}
        self._cloud_times: dict[str, float] = {}
        #: Time at which the newest poses came.
        self._pose_time = clock()
        #: Source whose stamps went back last, and the time of that.
        self._last_jump = '', -math.inf

    def on_command(self, targets: np.ndarray, rotations: Mapping[int, np.ndarray] | None = None,
                   height_changes: np.ndarray | None = None) -> None:
        """
        Begin a turn: the cameras were sent to new targets.

        If all cameras are at their targets already, the newest poses show that they stand: some
        rigs publish poses only while they move.

        :param targets: (K, 3) metres.
        :param rotations: target rotations, (3, 3), by camera number, of the cameras that rotate.
        :param height_changes: (K,) bool, whether each camera was sent up or down; None: if its
            target height differs from its measured height.
        """
        self._targets = targets
        self._command_time = self._clock()
        self.overdue = False
        self._height_changes = (targets[:, 2] != self.positions[:, 2] if height_changes is None
                                else height_changes)
        self._target_rotations = rotations or {}
        self._arrival_time = None
        self._arrival_accepted = False
        self.standing_begin = Moment(self._pose_stamp, self._command_time)
        if not self._cameras_arrived():
            self.standing_begin = None
            self.positions = None
        self.drop_clouds()

    def accept_arrival(self) -> None:
        """Count the cameras as arrived in this turn, wherever they come to a stand."""
        self._arrival_accepted = True
        if self.positions is not None and self._arrival_time is None:
            self._arrival_time = self._clock()
            self._mean_begin_ns = self._pose_stamp

    def drop_clouds(self) -> None:
        """Drop the clouds of this turn, and wait for new ones."""
        self._unread_clouds.clear()
        self.used_stamps.clear()
        self._transform_waits.clear()

    def repeat_turn(self) -> None:
        """Drop the clouds of this turn, and wait for new ones for as long as at its begin."""
        self.drop_clouds()
        if self.standing_begin is not None:
            self.standing_begin = self.standing_begin._replace(time=self._clock())

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
        if not self._accept_stamp(POSES, stamp):
            return False
        poses = _Poses(stamp, positions, rotations)
        self.positions = positions
        self._rotations = rotations
        self._pose_stamp = stamp
        self._pose_time = self._clock()
        self._recent_poses.append(poses)
        # A camera that had arrived has left if it is this many times the arrival distance or angle
        # away: smaller offsets may be noise of the poses.
        leaving_factor = 4.0
        if self._targets is None and self._reference and not self.overdue and (
                self._left_reference(leaving_factor * self.limits.arrival_distance,
                                     leaving_factor * self.limits.arrival_angle)):
            # Something else than this node moves the cameras.
            self._wait_for_standing()
        # Measured poses of a standing camera vary by 2 cm and 0.02 radians at most.
        if self._left_reference(distance=0.02, angle=0.02):
            self._reference = poses
        # A camera that has arrived stays arrived within the wider limits.
        if self._cameras_arrived() or (
                self._arrival_time is not None and self._cameras_arrived(leaving_factor)):
            if self._arrival_time is None:
                self._arrival_time = self._pose_time
                self._mean_begin_ns = stamp
            self._update_standing()
        elif not self.overdue:
            self._wait_for_standing()
        return True

    @property
    def mean_poses(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """
        Return the mean of the measured poses since the cameras stand.

        :returns: positions, (K, 3) metres, and K rotations, (3, 3); the newest ones if no such
            poses are stored.
        """
        measured = [poses for poses in self._recent_poses if poses.stamp >= self._mean_begin_ns
                    and len(poses.positions) == len(self.positions)]
        if not measured:
            return self.positions, list(self._rotations)
        # The mean of the offsets from the first poses: it is exactly 0 for equal poses.
        first = measured[0]
        mean_offset = np.mean([poses.positions - first.positions for poses in measured], axis=0)
        return first.positions + mean_offset, [
            _mean_rotation([poses.rotations[camera] for poses in measured])
            for camera in range(len(first.rotations))]

    def _wait_for_standing(self) -> None:
        """Wait again for cameras that do not stand any more."""
        self.standing_begin = None
        self._arrival_time = None
        self.used_stamps.clear()

    def _left_reference(self, distance: float, angle: float) -> bool:
        """Return whether a camera is farther (m, radians) from its reference pose, or has none."""
        if self._reference is None or len(self._reference.positions) != len(self.positions):
            return True
        distances = np.linalg.norm(self.positions - self._reference.positions, axis=1)
        return bool((distances > distance).any()) or any(
            angle_between(reference, rotation) > angle
            for reference, rotation in zip(self._reference.rotations, self._rotations))

    def _cameras_arrived(self, factor: float = 1.0) -> bool:
        """Return whether all cameras are at their targets, within ``factor`` x the limits."""
        # Before the first command there are no targets.
        if self._targets is None or self._arrival_accepted:
            return True
        offsets = self.positions - self._targets
        # The height counts only if the camera was sent up or down.
        offsets[~self._height_changes, 2] = 0.0
        distances = np.linalg.norm(offsets, axis=1)
        return bool((distances <= factor * self.limits.arrival_distance).all()) and all(
            angle_between(self._rotations[camera], rotation) <= factor * self.limits.arrival_angle
            for camera, rotation in self._target_rotations.items())

    def on_cloud(self, topic: str, stamp: int, cloud: T) -> None:
        """Store a cloud with its stamp (ns); it replaces the unread cloud of its topic."""
        if self._accept_stamp(topic, stamp):
            self._unread_clouds[topic] = stamp, cloud
            now = self._cloud_times[topic] = self._clock()
            if POSES in self._newest_stamps and self._poses_are_new:
                leads = self._cloud_leads[topic]
                # One lead for each of the poses: it may be the delay of these poses.
                if self._compared_poses.get(topic) == self._pose_stamp:
                    leads.pop()
                self._compared_poses[topic] = self._pose_stamp
                # Poses measured now would have the stamp of the newest poses plus their age.
                leads.append(stamp - self._pose_stamp - int((now - self._pose_time) * 1e9))

    @property
    def _poses_are_new(self) -> bool:
        """Return whether the clocks of poses and clouds can be compared now."""
        return self._clock() - self._pose_time <= QUIET_S

    def _accept_stamp(self, source: str, stamp: int) -> bool:
        """Store a stamp, also after a clock was set back; return False for one that is late."""
        newest = self._newest_stamps.get(source, stamp)
        # A stamp that goes back by more than a second comes from a clock that was set, or from a
        # recording that began again.
        if newest - 1_000_000_000 <= stamp < newest:
            return False
        if stamp < newest:
            self._begin_after_jump(source, stamp)
        self._newest_stamps[source] = stamp
        return True

    def _begin_after_jump(self, source: str, stamp: int) -> None:
        """Drop the clouds, poses and stamps of before: the stamps of a source went back."""
        self.stamp_jumps += 1
        self._newest_stamps.clear()
        self._cloud_leads.clear()
        self._compared_poses.clear()
        self._recent_poses.clear()
        self.drop_clouds()
        self._pose_stamp = stamp
        self._reference = None
        self._mean_begin_ns = stamp
        now = self._clock()
        _, last_jump_time = self._last_jump
        self._last_jump = source, now
        if self.standing_begin is not None:
            # A source with stamps of two clocks must not restart the wait for ever.
            is_repeated = now - last_jump_time <= 2.0 * self.limits.cloud_timeout
            self.standing_begin = Moment(stamp, self.standing_begin.time if is_repeated else now)

    def take_cloud(self, excluded_topics: Collection[str] = ()) -> tuple[str, T] | None:
        """
        Take a cloud that this turn can use: since the cameras stand, of a topic not used yet.

        :param excluded_topics: topics from which no cloud is taken.
        :returns: the topic and the cloud; None if there is no such cloud.
        """
        if self._stop_waiting_for_cameras():
            for topic in self._topics:
                if topic in self._unread_clouds and (
                        topic not in (*self.used_stamps, *excluded_topics)) and (
                        self._unread_clouds[topic][0] >= self.standing_begin.stamp) and (
                        not self._may_lead(topic)):
                    self.used_stamps[topic], cloud = self._unread_clouds.pop(topic)
                    self._silent_topics.discard(topic)
                    return topic, cloud
        return None

    def _may_lead(self, topic: str) -> bool:
        """Return whether the cloud of a topic may be of before, by a clock ahead of the poses."""
        if self._cloud_leads[topic][-1] <= MAX_LEAD_NS:
            return False
        # Without newer poses, a lead that was found once was perhaps the delay of the last ones.
        # Then a cloud that came after the cameras stood still is used.
        return (self._poses_are_new or topic in self.clock_leads()
                or self._cloud_times[topic] <= self.standing_begin.time)

    def put_back(self, topic: str, stamp: int, cloud: T) -> bool:
        """
        Give back a cloud whose transform has not come yet, so that it can be taken again.

        :param stamp: stamp of the cloud, nanoseconds.
        :returns: whether a cloud of this topic waits now; False if clouds of this topic have
            already waited too long.
        """
        now = self._clock()
        wait_begin = self._transform_waits.setdefault(topic, now)
        # Clouds wait a second for a newer transform.
        if now - wait_begin > 1.0:
            return False
        del self.used_stamps[topic]
        # A newer cloud that has come meanwhile is kept.
        self._unread_clouds.setdefault(topic, (stamp, cloud))
        return True

    def refuse_cloud(self, topic: str) -> None:
        """Wait for another cloud of a topic: the one that was taken cannot be used."""
        del self.used_stamps[topic]
        self._transform_waits.pop(topic, None)

    def is_due(self) -> bool:
        """
        Return whether this turn is to be answered now; note the topics that have stayed silent.

        A turn is answered once it has all its clouds, or at least one when the wait is over, but
        not before ``min_duration`` seconds have passed since the last command.
        """
        time_is_up = self._stop_waiting_for_cameras() and self._cloud_time_is_up()
        if time_is_up:
            self._silent_topics |= set(self._topics) - set(self.used_stamps)
        too_early = (self._targets is not None
                     and self._clock() - self._command_time < self.limits.min_duration)
        return not too_early and (len(self.used_stamps) == len(self._topics)
                                  or (time_is_up and bool(self.used_stamps)))

    def _cloud_time_is_up(self) -> bool:
        """Return whether the cameras have been standing for ``cloud_timeout`` seconds."""
        return self._clock() - self.standing_begin.time >= self.limits.cloud_timeout

    def _stop_waiting_for_cameras(self) -> bool:
        """Return whether the cameras stand; after the longest wait they count as standing too."""
        self._update_standing()
        now = self._clock()
        timeout = self.limits.arrival_timeout
        if self._targets is None:
            # Before the first command the wait is limited even if a person moves the cameras, to
            # the default of ``arrival_timeout``.
            timeout = min(timeout, 20.0)
        if self.standing_begin is None and self.positions is not None and (
                now - self._command_time >= timeout):
            self.standing_begin = Moment(self._pose_stamp, now)
            self._mean_begin_ns = self._pose_stamp
            self.overdue = True
            self.overdue_turns += 1
        return self.standing_begin is not None

    def _update_standing(self) -> None:
        """Mark the cameras as standing if they have been still at their targets."""
        if self.standing_begin is not None or self._arrival_time is None:
            return
        now = self._clock()
        is_steady = bool(self._reference) and (
            self._pose_stamp - self._reference.stamp >= STEADY_NS)
        if self._reference and (is_steady or now - self._pose_time >= QUIET_S):
            self.standing_begin = Moment(self._reference.stamp, now)
            self._mean_begin_ns = self._reference.stamp if is_steady else self._noise_begin()
        elif now - self._arrival_time >= self.limits.cloud_timeout:
            # The measured poses never become still: end the wait.
            self.standing_begin = Moment(self._pose_stamp, now)

    def _noise_begin(self) -> int:
        """
        Return the stamp since which the measured poses differ by noise only, nanoseconds.

        If poses end before any were still, they are noisy, or the cameras moved until then. They
        are noisy if they have stayed within the limits of arrival for a second.
        """
        begin, limits, newest = self._reference.stamp, self.limits, self._recent_poses[-1]
        for poses in reversed(self._recent_poses):
            if len(poses.positions) != len(newest.positions) or (
                    np.linalg.norm(poses.positions - newest.positions, axis=1).max()
                    > limits.arrival_distance) or any(
                    angle_between(one, other) > limits.arrival_angle
                    for one, other in zip(poses.rotations, newest.rotations)):
                break
            if newest.stamp - poses.stamp >= NOISY_NS:
                begin = min(begin, poses.stamp)
        return begin

    def silent_topics(self) -> dict[str, str]:
        """Return the topics whose wait ended without a cloud, with a reason for each."""
        return {topic: self._explain_silence(topic) for topic in self._topics
                if topic in self._silent_topics}

    def _explain_silence(self, topic: str) -> str:
        """Return in words what a silent topic has sent last."""
        if topic not in self._newest_stamps:
            return 'nothing came'
        lag_ns = 0
        if self.standing_begin is not None:
            lag_ns = self.standing_begin.stamp - self._newest_stamps[topic]
        return f'stamps {lag_ns * 1e-9:.1f} s before the poses' if lag_ns > 0 else 'nothing usable'

    def clock_leads(self) -> dict[str, float]:
        """Return by how many seconds the poses' clock leads, by topics with another clock."""
        # A single cloud may have waited while the node was busy.
        return {topic: -1e-9 * leads[-1] for topic, leads in self._cloud_leads.items()
                if len(leads) == leads.maxlen and min(map(abs, leads)) > MAX_LEAD_NS}

    def jumped_source(self) -> str:
        """Return the source whose stamps went back less than ``JUMP_REPORT_S`` ago; else ''."""
        source, jump_time = self._last_jump
        if self._clock() - jump_time > JUMP_REPORT_S:
            return ''
        return 'the poses' if source == POSES else source

    @property
    def cameras_stand(self) -> bool:
        """Return whether the cameras count as standing."""
        return self.standing_begin is not None

    @property
    def no_command_sent(self) -> bool:
        """Return whether no command was sent yet."""
        return self._targets is None

    @property
    def lacks_clouds(self) -> bool:
        """Return whether the wait for clouds is over, but no cloud can be used."""
        return self.cameras_stand and not self.used_stamps and self._cloud_time_is_up()

    @property
    def poses_missing(self) -> bool:
        """Return whether no poses came in ``cloud_timeout`` s since the last command or start."""
        turn_duration = self._clock() - self._command_time
        return self.positions is None and turn_duration >= self.limits.cloud_timeout


def _mean_rotation(rotations: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of rotations (3, 3) that are close to each other."""
    # SciPy changes the last digits even if all rotations are equal.
    if all(np.array_equal(rotation, rotations[0]) for rotation in rotations[1:]):
        return rotations[0]
    return Rotation.from_matrix(np.array(rotations)).mean().as_matrix()
