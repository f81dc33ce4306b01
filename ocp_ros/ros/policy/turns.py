# SPDX-License-Identifier: Apache-2.0
"""
When a turn of real cameras is due.

A turn begins when a command is sent and is due when every camera stands still where it was sent
and every topic has delivered a cloud since. Nobody is waited for without end: neither for cameras
that do not arrive nor for topics that are silent. Only stamps are compared with stamps; how long
something takes is measured on this machine's own clock, which nobody sets.
"""

from collections.abc import Callable, Mapping, Sequence
import math
import time
from typing import Generic, TypeVar

import numpy as np

from ocp_ros.geometry.cameras import angle_between

T = TypeVar('T')

#: Nanoseconds: a stamp that goes back by more is that of a clock that was set, or of a recording
#: that began anew.
JUMP = 1_000_000_000
#: Metres, and radians, within which cameras that stand seem to move.
STILL, STEADY = 0.02, 0.02
#: Nanoseconds that they have to be seen within these, and seconds after which it is enough that
#: nobody says any more where they are.
HOLD, QUIET = 200_000_000, 0.5
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

    def sent(self, targets: np.ndarray, turned: Mapping[int, np.ndarray] | None = None) -> None:
        """
        Begin a turn: the cameras were sent to (K, 3) metres.

        Where they have been until now counts if they are there already: some rigs say where they
        are when they move, and not otherwise.

        :param targets: (K, 3) metres.
        :param turned: the rotations, (3, 3), of the cameras that were to be turned.
        """
        self._targets, self._sent_at, self.overdue = targets, self._clock(), False
        self._raised = targets[:, 2] != self.positions[:, 2]
        self._turned = turned or {}
        self._stand = (self._posed, self._sent_at) if self._arrived() else None
        self._near = None
        if self._stand is None:
            self.positions = None
        self.again()

    def again(self) -> None:
        """Ask for new clouds: those of this turn were of no use."""
        self._waiting.clear()
        self._used.clear()

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
        if self._targets is None and self._anchor and self._far(
                self._arrival_distance, self._arrival_angle):
            # Somebody else moves them.
            self._leave()
        if self._far(STILL, STEADY):
            self._anchor = stamp, positions, rotations
        if self._arrived():
            self._near = self._posed_at if self._near is None else self._near
            self._settle()
        elif not self.overdue:
            self._leave()
        return True

    def _leave(self) -> None:
        """Wait anew for cameras that do not stand any more."""
        self._stand = self._near = None
        self._used.clear()

    def _far(self, distance: float, angle: float) -> bool:
        """Tell whether a camera is no longer where all poses had it for a while."""
        if self._anchor is None or len(self._anchor[1]) != len(self.positions):
            return True
        _, positions, rotations = self._anchor
        away = np.linalg.norm(self.positions - positions, axis=1)
        return bool((away > distance).any()) or any(
            angle_between(*pair) > angle for pair in zip(rotations, self._rotations))

    def _arrived(self) -> bool:
        """Tell whether every camera is where it was sent, and turned so."""
        if self._targets is None:
            return True
        away = self.positions - self._targets
        away[~self._raised, 2] = 0.0
        away = np.linalg.norm(away, axis=1)
        return bool((away <= self._arrival_distance).all()) and all(
            angle_between(self._rotations[camera], rotation) <= self._arrival_angle
            for camera, rotation in self._turned.items())

    def on_cloud(self, topic: str, stamp: int, cloud: T) -> None:
        """Keep a cloud, whatever it is, in place of the one of its topic that waits."""
        if self._is_news(topic, stamp):
            self._waiting[topic] = stamp, cloud

    def _is_news(self, source: str, stamp: int) -> bool:
        """Tell whether a stamp is no older than the last one, or from another time altogether."""
        last = self._heard.get(source, stamp)
        if last - JUMP <= stamp < last:
            return False
        if stamp < last:
            self.jumps += 1
            self._heard.clear()
            self.again()
            self._posed, self._anchor = stamp, None
            now, before = self._clock(), self._jumped[1]
            self._jumped = source, now
            if self._stand is not None:
                # Who sends stamps of two clocks does not keep the others waiting for ever.
                again = now - before <= 2.0 * self._cloud_timeout
                self._stand = stamp, self._stand[1] if again else now
        self._heard[source] = stamp
        return True

    def take(self) -> tuple[str, T] | None:
        """Take a cloud that this turn can use: the first of its topic since the cameras stand."""
        if self._standing():
            for topic in self._topics:
                if topic in self._waiting and topic not in self._used and (
                        self._waiting[topic][0] >= self._stand[0]):
                    self._used[topic], cloud = self._waiting.pop(topic)
                    self._silent.discard(topic)
                    return topic, cloud
        return None

    def refuse(self, topic: str) -> None:
        """Ask for another cloud of a topic: the one that was taken is of no use."""
        del self._used[topic]

    def due(self) -> bool:
        """Tell whether all clouds of this turn are here, or some and time is up."""
        up = self._standing() and self._clock() - self._stand[1] >= self._cloud_timeout
        if up:
            self._silent |= set(self._topics) - set(self._used)
        soon = self._targets is not None and self._clock() - self._sent_at < self._shortest
        return not soon and (
            len(self._used) == len(self._topics) or (up and bool(self._used)))

    def _standing(self) -> bool:
        """Tell whether the cameras stand, or have been waited for long enough."""
        self._settle()
        now = self._clock()
        if self._stand is None and self.positions is not None and (
                now - self._sent_at >= self._arrival_timeout):
            self._stand = self._posed, now
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
            self._stand = self._anchor[0], now
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
        behind = 0 if self._stand is None else self._stand[0] - self._heard[topic]
        return f'stamps {behind * 1e-9:.1f} s before the poses' if behind > 0 else 'nothing usable'

    def backward(self) -> str:
        """Return whose stamps went back a short while ago, if anybody's."""
        source, when = self._jumped
        return '' if self._clock() - when > TOLD else source or 'the poses'

    @property
    def standing(self) -> bool:
        """Return whether the cameras count as standing."""
        return self._stand is not None

    @property
    def since(self) -> int:
        """Return the stamp of the poses since which clouds count, nanoseconds."""
        return self._stand[0]

    @property
    def lost(self) -> bool:
        """Return whether nobody has said for long where the cameras are."""
        return self.positions is None and self._clock() - self._sent_at >= self._cloud_timeout

    @property
    def stamp(self) -> int:
        """Return the stamp of the newest cloud that was taken, nanoseconds."""
        return max(self._used.values())
