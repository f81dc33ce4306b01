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
When a turn of real cameras is due.

A turn begins when a command is sent and is due when every camera stands still where it was sent
and every topic has delivered a cloud since. Nobody is waited for without end: neither for cameras
that do not arrive nor for topics that are silent. Only stamps are compared with stamps; how long
something takes is measured on this machine's own clock, which nobody sets. Poses are measurements:
cameras that stand are where the mean of their poses is, and a single pose that is off does not
mean that they have left.
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

#: Nanoseconds: a stamp that goes back by more is that of a clock that was set, or of a recording
#: that began anew.
JUMP = 1_000_000_000
#: Cameras that were in place have left once they are so many times as far off as cameras may be
#: that arrive: less may be the noise of their poses.
LEFT = 4.0
#: Nanoseconds: a cloud whose stamp is later than the poses by more has another clock, or one that
#: is wrong; poses that came so many seconds ago tell nothing of it.
AHEAD, FRESH = 1_000_000_000, 0.5
#: Poses that are averaged at most, and the seconds that cameras which nobody has sent anywhere are
#: waited for at most.
AVERAGED, FIRST = 100, 20.0
#: Metres, and radians, within which cameras that stand seem to move.
STILL, STEADY = 0.02, 0.02
#: Nanoseconds that they have to be seen within these, and seconds after which it is enough that
#: nobody says any more where they are.
HOLD, QUIET = 200_000_000, 0.5
#: Seconds for which a cloud waits that was taken too soon.
PATIENCE = 1.0
#: Seconds for which it is told that stamps went back.
TOLD = 10.0
#: Who sends the poses, among the topics, which have names.
POSES = ''


class Turns(Generic[T]):
    """
    Wait for cameras and clouds; of each topic only the newest cloud is kept.

    :param topics: the names of those that send clouds.
    :param arrival_distance: a camera this near to where it was sent is there, metres; how high it
        is counts if it was sent up or down.
    :param arrival_timeout: cameras are waited for so long, seconds.
    :param cloud_timeout: clouds are waited for so long since the cameras stand, seconds; at least
        one has to be there in any case.
    :param clock: tells the seconds.
    :param shortest: a turn lasts so long at least, seconds.
    :param arrival_angle: a camera turned to within this of how it shall be is there, radians.
    :ivar positions: (K, 3) metres, where the cameras are; None while nobody has said so since they
        were sent elsewhere.
    :ivar overdue: whether this turn goes on though the cameras have not arrived.
    :ivar late: turns that did.
    :ivar jumps: how often stamps went back.
    """

    def __init__(self, topics: list[str], arrival_distance: float, arrival_timeout: float,
                 cloud_timeout: float, clock: Callable[[], float] = time.monotonic,
                 shortest: float = 0.0, arrival_angle: float = np.pi) -> None:
        self._topics, self._clock = topics, clock
        self.change(arrival_distance, arrival_timeout, cloud_timeout, shortest, arrival_angle)
        #: Newest stamp of whoever sends anything, nanoseconds.
        self._heard: dict[str, int] = {}
        #: Stamp of the newest poses, or from which on time has begun anew, nanoseconds.
        self._posed = 0
        #: Of each topic the newest cloud, and the stamp of the one that this turn has used.
        self._waiting: dict[str, tuple[int, T]] = {}
        self._used: dict[str, int] = {}
        #: Since when the clouds of a topic have been taken too soon.
        self._too_soon: dict[str, float] = {}
        #: Topics that some turn, maybe this one, did not wait for any longer.
        self._silent: set[str] = set()
        self.late = self.jumps = 0
        self.overdue = False
        self.positions: np.ndarray | None = None
        #: Where the cameras were sent, if anywhere, and when.
        self._targets: np.ndarray | None = None
        #: (K,) bool, which of them were sent up or down.
        self._raised = np.zeros(0, dtype=bool)
        #: How they are turned, and how those shall be that were to be turned.
        self._rotations: Sequence[np.ndarray] = ()
        self._turned: Mapping[int, np.ndarray] = {}
        self._sent_at = clock()
        #: The first poses that show all cameras standing in place: stamp in nanoseconds, and when
        #: that was known.
        self._stand: tuple[int, float] | None = None
        #: When they were first seen in place.
        self._near: float | None = None
        #: Of the first poses that all since are about the same as: stamp, positions, rotations.
        self._anchor: tuple[int, np.ndarray, Sequence[np.ndarray]] | None = None
        #: The newest poses: stamp, positions, rotations; and the stamp of the first of them that
        #: show the cameras where they stand.
        self._recent: deque[tuple[int, np.ndarray, Sequence[np.ndarray]]] = deque(maxlen=AVERAGED)
        self._stood = 0
        #: How much later than the poses the clouds of a topic are, nanoseconds.
        self._ahead: dict[str, int] = {}
        #: When the newest poses came.
        self._posed_at = clock()
        #: Whose stamps went back last, and when.
        self._jumped = '', -math.inf

    def change(self, arrival_distance: float, arrival_timeout: float, cloud_timeout: float,
               shortest: float, arrival_angle: float = np.pi) -> None:
        """Wait for something else from now on; the parameters are those of the class."""
        self._arrival_distance, self._arrival_timeout, self._cloud_timeout, self._shortest = (
            arrival_distance, arrival_timeout, cloud_timeout, shortest)
        self._arrival_angle = arrival_angle

    def sent(self, targets: np.ndarray, turned: Mapping[int, np.ndarray] | None = None,
             raised: np.ndarray | None = None) -> None:
        """
        Begin a turn: the cameras were sent to (K, 3) metres.

        Where they have been until now counts if they are there already: some rigs say where they
        are when they move, and not otherwise.

        :param targets: (K, 3) metres.
        :param turned: the rotations, (3, 3), of the cameras that were to be turned.
        :param raised: (K,) bool, which of them were sent up or down; None for those whose
            height is to be another.
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
        """Ask for new clouds: those of this turn were of no use."""
        self._waiting.clear()
        self._used.clear()
        self._too_soon.clear()

    def on_poses(self, stamp: int, positions: np.ndarray,
                 rotations: Sequence[np.ndarray] = ()) -> bool:
        """
        Take note of where the cameras are.

        :param stamp: nanoseconds.
        :param positions: (K, 3) metres.
        :param rotations: K of (3, 3), needed once cameras were to be turned.
        :returns: whether this is news.
        """
        if not self._is_news(POSES, stamp):
            return False
        self.positions, self._rotations, self._posed = positions, rotations, stamp
        self._posed_at = self._clock()
        self._recent.append((stamp, positions, rotations))
        if self._targets is None and self._anchor and not self.overdue and self._far(
                LEFT * self._arrival_distance, LEFT * self._arrival_angle):
            # Somebody else moves them.
            self._leave()
        if self._far(STILL, STEADY):
            self._anchor = stamp, positions, rotations
        if self._arrived() or (self._near is not None and self._arrived(LEFT)):
            if self._near is None:
                self._near, self._stood = self._posed_at, stamp
            self._settle()
        elif not self.overdue:
            self._leave()
        return True

    @property
    def measured(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """
        Return where cameras stand, by the mean of the poses that say so.

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
        """Wait anew for cameras that do not stand any more."""
        self._stand = self._near = None
        self._used.clear()

    def _far(self, distance: float, angle: float) -> bool:
        """Return whether a camera is no longer where all poses had it for a while."""
        if self._anchor is None or len(self._anchor[1]) != len(self.positions):
            return True
        _, positions, rotations = self._anchor
        away = np.linalg.norm(self.positions - positions, axis=1)
        return bool((away > distance).any()) or any(
            angle_between(*pair) > angle for pair in zip(rotations, self._rotations))

    def _arrived(self, times: float = 1.0) -> bool:
        """Return whether every camera is where it was sent, and turned so, or not far from it."""
        if self._targets is None:
            return True
        away = self.positions - self._targets
        away[~self._raised, 2] = 0.0
        away = np.linalg.norm(away, axis=1)
        return bool((away <= times * self._arrival_distance).all()) and all(
            angle_between(self._rotations[camera], rotation) <= times * self._arrival_angle
            for camera, rotation in self._turned.items())

    def on_cloud(self, topic: str, stamp: int, cloud: T) -> None:
        """Keep a cloud, whatever it is, in place of the one of its topic that waits."""
        if self._is_news(topic, stamp):
            self._waiting[topic] = stamp, cloud
            late = self._clock() - self._posed_at
            if POSES in self._heard and late <= FRESH:
                self._ahead[topic] = stamp - self._posed - int(late * 1e9)

    def _is_news(self, source: str, stamp: int) -> bool:
        """Return whether a stamp is no older than the last one, or from another time."""
        last = self._heard.get(source, stamp)
        if last - JUMP <= stamp < last:
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
                # Who sends stamps of two clocks does not keep the others waiting for ever.
                again = now - before <= 2.0 * self._cloud_timeout
                self._stand = stamp, self._stand[1] if again else now
        self._heard[source] = stamp
        return True

    def take(self, but: Collection[str] = ()) -> tuple[str, T] | None:
        """
        Take a cloud that this turn can use: the first of its topic since the cameras stand.

        :param but: topics of which none is to be taken now.
        """
        if self._standing():
            for topic in self._topics:
                if topic in self._waiting and topic not in (*self._used, *but) and (
                        self._waiting[topic][0] >= self._stand[0]) and (
                        self._ahead.get(topic, 0) <= AHEAD):
                    self._used[topic], cloud = self._waiting.pop(topic)
                    self._silent.discard(topic)
                    return topic, cloud
        return None

    def wait_on(self, topic: str, stamp: int, cloud: T) -> bool:
        """
        Give back a cloud that was taken too soon, to be taken again.

        :returns: whether it may be; where that has lasted too long already another is asked for.
        """
        now = self._clock()
        if now - self._too_soon.setdefault(topic, now) > PATIENCE:
            return False
        del self._used[topic]
        self._waiting.setdefault(topic, (stamp, cloud))
        return True

    def refuse(self, topic: str) -> None:
        """Ask for another cloud of a topic: the one that was taken is of no use."""
        del self._used[topic]
        self._too_soon.pop(topic, None)

    def due(self) -> bool:
        """Return whether all clouds of this turn are here, or some and time is up."""
        up = self._standing() and self._time_is_up()
        if up:
            self._silent |= set(self._topics) - set(self._used)
        soon = self._targets is not None and self._clock() - self._sent_at < self._shortest
        return not soon and (
            len(self._used) == len(self._topics) or (up and bool(self._used)))

    def _time_is_up(self) -> bool:
        """Return whether the cameras have stood for as long as clouds are waited for."""
        return self._clock() - self._stand[1] >= self._cloud_timeout

    def _standing(self) -> bool:
        """Return whether the cameras stand, or have been waited for long enough."""
        self._settle()
        now = self._clock()
        patience = self._arrival_timeout
        if self._targets is None:
            # They have not been sent anywhere: a person has nothing to do yet.
            patience = min(patience, FIRST)
        if self._stand is None and self.positions is not None and (
                now - self._sent_at >= patience):
            self._stand, self._stood = (self._posed, now), self._posed
            self.overdue = True
            self.late += 1
        return self._stand is not None

    def _settle(self) -> None:
        """Let the cameras count as standing if they have been still, where they were sent."""
        if self._stand is not None or self._near is None:
            return
        now = self._clock()
        if self._anchor and (self._posed - self._anchor[0] >= HOLD
                             or now - self._posed_at >= QUIET):
            self._stand, self._stood = (self._anchor[0], now), self._anchor[0]
        elif now - self._near >= self._cloud_timeout:
            # They never seem to be still.
            self._stand = self._posed, now

    def silent(self) -> dict[str, str]:
        """Return the topics that were not waited for any longer, and what is known of each."""
        return {topic: self._last_sign(topic) for topic in self._topics if topic in self._silent}

    def _last_sign(self, topic: str) -> str:
        """Say what a topic that was silent has last sent."""
        if topic not in self._heard:
            return 'nothing came'
        if self._ahead.get(topic, 0) > AHEAD:
            return f'stamps {self._ahead[topic] * 1e-9:.1f} s after the poses'
        behind = 0 if self._stand is None else self._stand[0] - self._heard[topic]
        return f'stamps {behind * 1e-9:.1f} s before the poses' if behind > 0 else 'nothing usable'

    def backward(self) -> str:
        """Return whose stamps went back a short while ago, if anybody's."""
        source, when = self._jumped
        return '' if self._clock() - when > TOLD else source or 'the poses'

    @property
    def used(self) -> set[str]:
        """Return the topics of which this turn has taken a cloud."""
        return set(self._used)

    @property
    def standing(self) -> bool:
        """Return whether the cameras count as standing."""
        return self._stand is not None

    @property
    def since(self) -> int:
        """Return the stamp of the poses since which clouds count, nanoseconds."""
        return self._stand[0]

    @property
    def sent_nowhere(self) -> bool:
        """Return whether no command has sent the cameras anywhere yet."""
        return self._targets is None

    @property
    def stuck(self) -> bool:
        """Return whether the cameras stand and time is up, but no cloud can be used."""
        return self.standing and not self._used and self._time_is_up()

    @property
    def lost(self) -> bool:
        """Return whether nobody has said for long where the cameras are."""
        return self.positions is None and self._clock() - self._sent_at >= self._cloud_timeout

    @property
    def stamp(self) -> int:
        """Return the stamp of the newest cloud that was taken, nanoseconds."""
        return max(self._used.values())


def _mean_rotation(rotations: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of rotations (3, 3), which are near to each other."""
    if all(np.array_equal(rotation, rotations[0]) for rotation in rotations[1:]):
        return rotations[0]
    return Rotation.from_matrix(np.array(rotations)).mean().as_matrix()
