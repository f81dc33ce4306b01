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
        self._heard: dict[str, int] = {}
        #: Stamp of the newest poses, or the first stamp after the stamps went back, nanoseconds.
        self._posed = 0
        #: The newest unread cloud of each topic with its stamp, and the stamp of the cloud that
        #: this turn has used.
        self._waiting: dict[str, tuple[int, T]] = {}
        self._used: dict[str, int] = {}
        #: Time since which the clouds of a topic have been waiting for a newer transform.
        self._too_soon: dict[str, float] = {}
        #: Topics whose wait ended without a cloud, now or before; using a cloud removes its topic.
        self._silent: set[str] = set()
        self.late = self.jumps = 0
        self.overdue = False
        self.positions: np.ndarray | None = None
        #: Targets of the last command, (K, 3) metres, None before the first one, and its time.
        self._targets: np.ndarray | None = None
        #: (K,) bool, which of them were sent up or down.
        self._raised = np.zeros(0, dtype=bool)
        #: Newest rotations of all cameras, and target rotations of those that the command rotates.
        self._rotations: Sequence[np.ndarray] = ()
        self._turned: Mapping[int, np.ndarray] = {}
        self._sent_at = clock()
        #: The first poses that show all cameras standing at their targets: their stamp in
        #: nanoseconds, and the time at which this was found.
        self._stand: tuple[int, float] | None = None
        #: Time at which all cameras were first measured at their targets.
        self._near: float | None = None
        #: The first poses from which all later poses differ by noise only: stamp, positions,
        #: rotations.
        self._anchor: tuple[int, np.ndarray, Sequence[np.ndarray]] | None = None
        #: The newest poses: stamp, positions, rotations; and the stamp since which they show the
        #: standing cameras.
        self._recent: deque[tuple[int, np.ndarray, Sequence[np.ndarray]]] = deque(maxlen=100)
        self._stood = 0
        #: By how much the stamps of a topic's clouds are later than those of poses, nanoseconds.
        self._ahead: dict[str, int] = {}
        #: Time at which the newest poses came.
        self._posed_at = clock()
        #: Source whose stamps went back last, and the time of that.
        self._jumped = '', -math.inf

    def change(self, arrival_distance: float, arrival_timeout: float, cloud_timeout: float,
               shortest: float, arrival_angle: float = np.pi) -> None:
        """Change the limits of waiting; the parameters are those of the class."""
        self._arrival_distance, self._arrival_timeout, self._cloud_timeout, self._shortest = (
            arrival_distance, arrival_timeout, cloud_timeout, shortest)
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
        self._targets, self._sent_at, self.overdue = targets, self._clock(), False
        self._raised = targets[:, 2] != self.positions[:, 2] if raised is None else raised
        self._turned = turned or {}
        self._stand = (self._posed, self._sent_at) if self._arrived() else None
        self._near = None
        if self._stand is None:
            self.positions = None
        self.restarted()

    def restarted(self) -> None:
        """Drop the clouds of this turn, and wait for new ones."""
        self._waiting.clear()
        self._used.clear()
        self._too_soon.clear()

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
        if not self._is_news(POSES, stamp):
            return False
        self.positions, self._rotations, self._posed = positions, rotations, stamp
        self._posed_at = self._clock()
        self._recent.append((stamp, positions, rotations))
        if self._targets is None and self._anchor and not self.overdue and self._far(
                LEAVING_FACTOR * self._arrival_distance, LEAVING_FACTOR * self._arrival_angle):
            # Something else than this node moves the cameras.
            self._leave()
        # Measured poses of a standing camera vary by 2 cm and 0.02 radians at most.
        if self._far(0.02, 0.02):
            self._anchor = stamp, positions, rotations
        if self._arrived() or (self._near is not None and self._arrived(LEAVING_FACTOR)):
            if self._near is None:
                self._near, self._stood = self._posed_at, stamp
            self._settle()
        elif not self.overdue:
            self._leave()
        return True

    @property
    def measured(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """
        Return the mean of the measured poses since the cameras stand.

        :returns: (K, 3) metres, and K rotations (3, 3).
        """
        poses = [(positions, rotations) for stamp, positions, rotations in self._recent
                 if stamp >= self._stood and len(positions) == len(self.positions)]
        if not poses:
            return self.positions, list(self._rotations)
        first = poses[0][0]
        middle = first + np.mean([positions - first for positions, _ in poses], axis=0)
        return middle, [_mean_rotation([one[k] for _, one in poses])
                        for k in range(len(poses[0][1]))]

    def _leave(self) -> None:
        """Wait again for cameras that do not stand any more."""
        self._stand = self._near = None
        self._used.clear()

    def _far(self, distance: float, angle: float) -> bool:
        """Return whether a camera is farther from its anchor pose than the given limits."""
        if self._anchor is None or len(self._anchor[1]) != len(self.positions):
            return True
        _, positions, rotations = self._anchor
        away = np.linalg.norm(self.positions - positions, axis=1)
        return bool((away > distance).any()) or any(
            angle_between(*pair) > angle for pair in zip(rotations, self._rotations))

    def _arrived(self, times: float = 1.0) -> bool:
        """Return whether every camera is at its target, within ``times`` the arrival limits."""
        if self._targets is None:
            return True
        away = self.positions - self._targets
        away[~self._raised, 2] = 0.0
        away = np.linalg.norm(away, axis=1)
        return bool((away <= times * self._arrival_distance).all()) and all(
            angle_between(self._rotations[camera], rotation) <= times * self._arrival_angle
            for camera, rotation in self._turned.items())

    def on_cloud(self, topic: str, stamp: int, cloud: T) -> None:
        """Store a cloud; it replaces the unread cloud of its topic."""
        if self._is_news(topic, stamp):
            self._waiting[topic] = stamp, cloud
            late = self._clock() - self._posed_at
            # The comparison of stamps needs poses of the last half second.
            if POSES in self._heard and late <= 0.5:
                self._ahead[topic] = stamp - self._posed - int(late * 1e9)

    def _is_news(self, source: str, stamp: int) -> bool:
        """Return whether a stamp is not older than the last of its source, or a clock was set."""
        last = self._heard.get(source, stamp)
        # A stamp that goes back by more than a second comes from a clock that was set, or from a
        # recording that began again.
        if last - 1_000_000_000 <= stamp < last:
            return False
        if stamp < last:
            self.jumps += 1
            self._heard.clear()
            self._ahead.clear()
            self._recent.clear()
            self.restarted()
            self._posed, self._anchor, self._stood = stamp, None, stamp
            now, before = self._clock(), self._jumped[1]
            self._jumped = source, now
            if self._stand is not None:
                # A source with stamps of two clocks must not restart the wait for ever.
                again = now - before <= 2.0 * self._cloud_timeout
                self._stand = stamp, self._stand[1] if again else now
        self._heard[source] = stamp
        return True

    def take(self, but: Collection[str] = ()) -> tuple[str, T] | None:
        """
        Take a cloud that this turn can use: since the cameras stand, of a topic not used yet.

        :param but: topics to leave out now.
        """
        if self._standing():
            for topic in self._topics:
                if topic in self._waiting and topic not in (*self._used, *but) and (
                        self._waiting[topic][0] >= self._stand[0]) and (
                        self._ahead.get(topic, 0) <= MAX_AHEAD_NS):
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
        if now - self._too_soon.setdefault(topic, now) > 1.0:
            return False
        del self._used[topic]
        self._waiting.setdefault(topic, (stamp, cloud))
        return True

    def refuse(self, topic: str) -> None:
        """Wait for another cloud of a topic: the one that was taken cannot be used."""
        del self._used[topic]
        self._too_soon.pop(topic, None)

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
        return self._clock() - self._stand[1] >= self._cloud_timeout

    def _standing(self) -> bool:
        """Return whether the cameras stand, or the wait for them is over."""
        self._settle()
        now = self._clock()
        patience = self._arrival_timeout
        if self._targets is None:
            # No command was sent yet: the wait is limited even if a person moves the cameras.
            patience = min(patience, 20.0)
        if self._stand is None and self.positions is not None and (
                now - self._sent_at >= patience):
            self._stand, self._stood = (self._posed, now), self._posed
            self.overdue = True
            self.late += 1
        return self._stand is not None

    def _settle(self) -> None:
        """Mark the cameras as standing if they have been still at their targets."""
        if self._stand is not None or self._near is None:
            return
        now = self._clock()
        if self._anchor and (self._posed - self._anchor[0] >= STEADY_NS
                             or now - self._posed_at >= QUIET_S):
            self._stand, self._stood = (self._anchor[0], now), self._anchor[0]
        elif now - self._near >= self._cloud_timeout:
            # The measured poses never become still: end the wait.
            self._stand = self._posed, now

    def silent(self) -> dict[str, str]:
        """Return the topics whose wait ended without a cloud, with a reason for each."""
        return {topic: self._last_sign(topic) for topic in self._topics if topic in self._silent}

    def _last_sign(self, topic: str) -> str:
        """Return in words what a silent topic has sent last."""
        if topic not in self._heard:
            return 'nothing came'
        if self._ahead.get(topic, 0) > MAX_AHEAD_NS:
            return f'stamps {self._ahead[topic] * 1e-9:.1f} s after the poses'
        behind = 0 if self._stand is None else self._stand[0] - self._heard[topic]
        return f'stamps {behind * 1e-9:.1f} s before the poses' if behind > 0 else 'nothing usable'

    def backward(self) -> str:
        """Return the source whose stamps went back less than ``JUMP_REPORT_S`` ago; else ''."""
        source, when = self._jumped
        return '' if self._clock() - when > JUMP_REPORT_S else source or 'the poses'

    @property
    def used(self) -> set[str]:
        """Return the topics whose clouds this turn has used."""
        return set(self._used)

    @property
    def standing(self) -> bool:
        """Return whether the cameras count as standing."""
        return self._stand is not None

    @property
    def since(self) -> int:
        """Return the stamp of the poses from which on clouds are used, nanoseconds."""
        return self._stand[0]

    @property
    def sent_nowhere(self) -> bool:
        """Return whether no command was sent yet."""
        return self._targets is None

    @property
    def stuck(self) -> bool:
        """Return whether the cameras stand and time is up, but no cloud can be used."""
        return self.standing and not self._used and self._time_is_up()

    @property
    def lost(self) -> bool:
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
