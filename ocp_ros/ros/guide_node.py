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
``guide_node``: a page for the person who carries the cameras, on a phone beside the rig.

It shows what ``policy_node`` with ``manual: true`` publishes. Its buttons call services of that
node, so the loop goes on when the page or this node ends.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import re
import sys
from typing import Any

from geometry_msgs.msg import PoseArray
import numpy as np
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import MessageError, msg_to_cloud, msg_to_poses, shortened
from ocp_ros.ros.interface.qos import LATCHED, LOOP, POSES
from ocp_ros.ros.runtime.managed_node import autostart, ManagedNode
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.studio import guide_page, FIRST_PORT, LOCAL_ADDRESS
from ocp_ros.studio.guide_page import GuidePage
from ocp_ros.studio.server import start_server
from ocp_ros.util.settings import setting
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

#: Seconds between two looks at the buttons, and between two changes of the page.
TICK, SHOWN = 0.1, 0.25
#: Parameters of ``policy_node`` that say when a camera has arrived, their largest values, metres
#: and radians, and how much more than the measured distance they get.
LIMITS = 'arrival_distance', 'arrival_angle'
FARTHEST, WIDEST, MORE = 1.0, 3.1, 1.1


@dataclass(frozen=True)
class GuideNodeConfig:
    """Parameters of ``guide_node``."""

    host: str = setting(LOCAL_ADDRESS, f'address that the page listens on; {LOCAL_ADDRESS}: this machine alone; '
                               '0.0.0.0: all, with a random token in the URL')
    port: int = setting(FIRST_PORT + 1, 'port of the page, or the first one to try; 0: any free one', 0,
                        65535)
    policy: str = setting('policy_node', 'name of the policy_node that is guided')
    autostart: bool = autostart()


class GuideNode(ManagedNode):
    """Serve the page of the guide."""

    def __init__(self, **kwargs) -> None:
        self.page: GuidePage | None = None
        super().__init__('guide_node', GuideNodeConfig, **kwargs)

    def configure(self) -> None:
        """Start the page, and subscribe to what it shows."""
        server, self.url = start_server(self.config.host, self.config.port, 'guide')
        self._pressed: deque[str] = deque()
        self.page = GuidePage(server, self._pressed.append)
        #: Limits of arrival to set again at the next command; empty if they have not been widened.
        self._limits: dict[str, float] = {}
        # A command with the stamp of the last one is a repetition.
        self._stamp: tuple[int, int] | None = None
        for kind, topic, take, profile in (
                (PointCloud2, topics.OBSERVATION, self._on_cloud, LOOP),
                (PoseArray, topics.CAMERA_POSES, self._on_poses, POSES),
                (PoseArray, topics.CAMERA_COMMANDS, self._on_command, LOOP),
                (String, topics.INSTRUCTIONS, self._on_instructions, LATCHED),
                (String, topics.PLACEMENT_STATUS, self._on_status, LATCHED)):
            self.create_subscription(kind, topic, partial(self._taken, take), profile)
        policy = self.config.policy
        self._pause = self.create_client(SetBool, f'{policy}/pause')
        self._reset = self.create_client(Trigger, f'{policy}/reset')
        self._setting = self.create_client(SetParameters, f'{policy}/set_parameters')
        self._getting = self.create_client(GetParameters, f'{policy}/get_parameters')
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(TICK, self._act, clock=steady)
        self.create_timer(SHOWN, self.page.show, clock=steady)
        self.get_logger().info(f'the guide is at {self.url}')

    def release(self) -> None:
        """End the page."""
        if self.page is not None:
            self.page.server.stop()
            self.page = None

    def _taken(self, take: Callable, message) -> None:
        """Take a message, or log why it cannot be used."""
        try:
            take(message)
        except MessageError as error:
            self.get_logger().warning(f'message refused: {shortened(error)}',
                                      throttle_duration_sec=1.0)

    def _on_cloud(self, message: PointCloud2) -> None:
        """Show the observed cloud."""
        self.page.set_cloud(msg_to_cloud(message))

    def _on_poses(self, message: PoseArray) -> None:
        """Show the measured poses."""
        self.page.poses = msg_to_poses(message)

    def _on_command(self, message: PoseArray) -> None:
        """Show the targets; the next command ends the wider limits of arrival."""
        self.page.targets = msg_to_poses(message)
        stamp = message.header.stamp.sec, message.header.stamp.nanosec
        if self._limits and stamp != self._stamp:
            limits, self._limits = self._limits, {}
            self._set(**limits)
        self._stamp = stamp

    def _on_instructions(self, message: String) -> None:
        """Show what the next time step is expected to bring."""
        self.page.expected = next((line for line in message.data.splitlines()
                                   if line.startswith('expected')), '')

    def _on_status(self, message: String) -> None:
        """Show the progress towards a final placement."""
        self.page.status = message.data

    def _act(self) -> None:
        """Do what the buttons ask for."""
        actions = {guide_page.ARRIVED: self._arrive, guide_page.HOLD: partial(self._hold, True),
                   guide_page.GO_ON: partial(self._hold, False),
                   guide_page.RESET: partial(self._ask, self._reset, Trigger.Request()),
                   guide_page.ACCEPT: self._accept}
        while self._pressed:
            actions[self._pressed.popleft()]()

    def _hold(self, held: bool) -> None:
        """Pause ``policy_node``, or let it continue."""
        self._ask(self._pause, SetBool.Request(data=held))

    def _off(self) -> tuple[float, float]:
        """Return how far the farthest camera is from its target: metres and radians."""
        pairs = [pose.away_from(target)
                 for pose, target in zip(self.page.poses, self.page.targets)]
        return tuple(np.max(pairs, axis=0).tolist()) if pairs else (np.inf, np.inf)

    def _arrive(self, **more: int) -> None:
        """
        Let the present poses count as arrived for this turn.

        :param more: other parameters of ``policy_node`` to set.
        """
        distance, angle = self._off()
        if distance * MORE > FARTHEST:
            self.page.say('found no targets yet; expected some; wait for the first command'
                          if distance == np.inf else
                          f'found a camera {distance:.2f} m off; expected at most '
                          f'{FARTHEST / MORE:.2f} m; carry it nearer to its target')
            return
        needed = dict(zip(LIMITS, (distance * MORE, min(angle * MORE, WIDEST))))

        def widen(future: Future) -> None:
            before = {name: value.double_value
                      for name, value in zip(LIMITS, future.result().values)}
            if len(before) == len(LIMITS):
                self._limits = self._limits or before
                self._set(**{name: max(before[name], needed[name]) for name in LIMITS}, **more)
        self._ask(self._getting, GetParameters.Request(names=list(LIMITS)), widen)

    def _accept(self) -> None:
        """Let the placement become final with the present poses."""
        found = re.search(r'turn (\d+) of', self.page.status)
        if found is None:
            self.page.say(self.page.status or 'found no turn yet; expected one at least; wait')
        else:
            self._arrive(turns=max(int(found[1]), 1))

    def _set(self, **values: float) -> None:
        """Set parameters of ``policy_node``."""
        self._ask(self._setting, SetParameters.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]))

    def _ask(self, client: Client, request: Any, answered: Callable[[Future], None] | None = None
             ) -> None:
        """Call a service of ``policy_node``, and show its answer unless another function does."""
        if not client.service_is_ready():
            self.page.say(f'found no service {client.srv_name}; expected the one of '
                          f'{self.config.policy}; start it, or set the parameter policy')
            return
        client.call_async(request).add_done_callback(answered or self._answered)

    def _answered(self, future: Future) -> None:
        """Show the answer of a service."""
        answer = future.result()
        if isinstance(answer, SetParameters.Response):
            wrong = [result.reason for result in answer.results if not result.successful]
            self.page.say(wrong[0] if wrong else 'done; the next target follows')
        else:
            self.page.say(answer.message)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(GuideNode, args)


if __name__ == '__main__':
    sys.exit(main())
