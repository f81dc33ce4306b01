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

The page shows what ``policy_node`` with ``manual: true`` publishes. Its buttons call services of
that node. So ``policy_node`` continues when the page or this node ends.
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
from ocp_ros.ros.runtime.managed_node import autostart, create_steady_timer, ManagedNode
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.studio import FIRST_PORT, guide_page, LOCAL_ADDRESS
from ocp_ros.studio.guide_page import GuidePage
from ocp_ros.studio.server import start_server
from ocp_ros.util.settings import setting
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.client import Client
from rclpy.parameter import Parameter
from rclpy.task import Future
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

#: Parameters of ``policy_node``: a camera within both limits of its target has arrived.
ARRIVAL_LIMITS = 'arrival_distance', 'arrival_angle'


@dataclass(frozen=True)
class GuideNodeConfig:
    """Parameters of ``guide_node``."""

    host: str = setting(LOCAL_ADDRESS, f'address that the page listens on; {LOCAL_ADDRESS}: this '
                        'machine alone; 0.0.0.0: all, with a random token in the URL')
    port: int = setting(FIRST_PORT + 1, 'port of the page, or the first one to try; 0: any free '
                        'one', 0, 65535)
    policy: str = setting('policy_node', 'name of the policy_node that is guided')
    autostart: bool = autostart()


class GuideNode(ManagedNode):
    """Serve the page of the guide."""

    def __init__(self, **kwargs) -> None:
        self.page: GuidePage | None = None
        super().__init__('guide_node', GuideNodeConfig, **kwargs)

    def configure(self) -> None:
        """Start the page, its subscriptions, and the clients of the services of the policy."""
        server, self.url = start_server(self.config.host, self.config.port, 'guide')
        #: Labels of the buttons that were pressed, from the threads of the page.
        self._pressed: deque[str] = deque()
        self.page = GuidePage(server, self._pressed.append)
        #: Values of the arrival limits before they were widened, to be set at the next command;
        #: empty if the limits are not widened.
        self._limits_to_restore: dict[str, float] = {}
        #: Seconds and nanoseconds of the last command; a command with this stamp repeats it.
        self._command_stamp: tuple[int, int] | None = None
        for msg_type, topic, callback, qos in (
                (PointCloud2, topics.OBSERVATION, self._on_cloud, LOOP),
                (PoseArray, topics.CAMERA_POSES, self._on_poses, POSES),
                (PoseArray, topics.CAMERA_COMMANDS, self._on_command, LOOP),
                (String, topics.INSTRUCTIONS, self._on_instructions, LATCHED),
                (String, topics.PLACEMENT_STATUS, self._on_status, LATCHED)):
            self.create_subscription(msg_type, topic, partial(self._take_message, callback), qos)
        policy = self.config.policy
        self._pause_client = self.create_client(SetBool, f'{policy}/pause')
        self._reset_client = self.create_client(Trigger, f'{policy}/reset')
        self._set_client = self.create_client(SetParameters, f'{policy}/set_parameters')
        self._get_client = self.create_client(GetParameters, f'{policy}/get_parameters')
        create_steady_timer(self, 0.1, self._run_pressed_actions)
        create_steady_timer(self, 0.25, self.page.show)
        self.get_logger().info(f'the guide is at {self.url}')

    def release(self) -> None:
        """End the page."""
        if self.page is not None:
            self.page.server.stop()
            self.page = None

    def _take_message(self, callback: Callable[[Any], None], message: Any) -> None:
        """Call the callback with a message, or log why the message cannot be used."""
        try:
            callback(message)
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
        """Show the targets; a new command restores the arrival limits."""
        self.page.targets = msg_to_poses(message)
        stamp = message.header.stamp.sec, message.header.stamp.nanosec
        if self._limits_to_restore and stamp != self._command_stamp:
            self._set_policy_parameters(**self._limits_to_restore)
            self._limits_to_restore = {}
        self._command_stamp = stamp

    def _on_instructions(self, message: String) -> None:
        """Show what the next turn is expected to bring."""
        # The sentence of ExpectedGain begins with this word. If it is missing, nothing is shown.
        self.page.expectation = next((line for line in message.data.splitlines()
                                      if line.startswith('expected')), '')

    def _on_status(self, message: String) -> None:
        """Show the progress towards a final placement."""
        self.page.status = message.data

    def _run_pressed_actions(self) -> None:
        """Run the actions of the buttons that were pressed since the last call."""
        actions = {guide_page.ARRIVED: self._arrive,
                   guide_page.HOLD: partial(self._pause, paused=True),
                   guide_page.GO_ON: partial(self._pause, paused=False),
                   guide_page.RESET: partial(self._call, self._reset_client, Trigger.Request()),
                   guide_page.ACCEPT: self._accept}
        while self._pressed:
            actions[self._pressed.popleft()]()

    def _pause(self, paused: bool) -> None:
        """Pause ``policy_node``, or let it continue."""
        self._call(self._pause_client, SetBool.Request(data=paused))

    def _largest_offsets(self) -> tuple[float, float]:
        """Return the largest distance (m) and angle (radians) to a target; inf if unknown."""
        offsets = [pose.away_from(target)
                   for pose, target in zip(self.page.poses, self.page.targets)]
        return tuple(np.max(offsets, axis=0).tolist()) if offsets else (np.inf, np.inf)

    def _arrive(self, **other_parameters: int) -> None:
        """
        Widen the arrival limits for this turn, so that all cameras count as arrived.

        :param other_parameters: of ``policy_node``, to be set too.
        """
        # The limits exceed the measured values by this factor, since the next values may differ.
        margin = 1.1
        # policy_node accepts an arrival distance up to 1 m and an arrival angle up to pi radians.
        max_metres, max_radians = 1.0, 3.1
        distance, angle = self._largest_offsets()
        if distance * margin > max_metres:
            self.page.show_message(
                'found no targets yet; expected some; wait for the first command'
                if distance == np.inf else f'found a camera {distance:.2f} m off; expected at '
                f'most {max_metres / margin:.2f} m; carry it nearer to its target')
            return
        needed = dict(zip(ARRIVAL_LIMITS, (distance * margin, min(angle * margin, max_radians))))

        def widen_limits(future: Future) -> None:
            present = {name: value.double_value
                       for name, value in zip(ARRIVAL_LIMITS, future.result().values)}
            # rclpy responds without any value if the node lacks one of the parameters.
            if len(present) == len(ARRIVAL_LIMITS):
                # If the limits are widened already, ``present`` has the wide ones: keep the values
                # from before.
                self._limits_to_restore = self._limits_to_restore or present
                widened = {name: max(present[name], needed[name]) for name in ARRIVAL_LIMITS}
                self._set_policy_parameters(**widened, **other_parameters)
        self._call(self._get_client, GetParameters.Request(names=list(ARRIVAL_LIMITS)),
                   widen_limits)

    def _accept(self) -> None:
        """Let the present turn be the last one, and the present poses the final placement."""
        turn = re.search(r'turn (\d+) of', self.page.status)
        if turn is None:
            self.page.show_message(
                self.page.status or 'found no turn yet; expected one at least; wait')
        else:
            # policy_node ends when it has played ``turns`` turns; the least value is 1.
            self._arrive(turns=max(int(turn[1]), 1))

    def _set_policy_parameters(self, **values: float) -> None:
        """Set parameters of ``policy_node``."""
        self._call(self._set_client, SetParameters.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]))

    def _call(self, client: Client, request: Any,
              on_response: Callable[[Future], None] | None = None) -> None:
        """
        Call a service of ``policy_node``.

        :param on_response: is called with the future of the response; None to show the response.
        """
        if not client.service_is_ready():
            self.page.show_message(
                f'found no service {client.srv_name}; expected the one of {self.config.policy}; '
                'start it, or set the parameter policy')
            return
        client.call_async(request).add_done_callback(on_response or self._show_response)

    def _show_response(self, future: Future) -> None:
        """Show the response of a service."""
        response = future.result()
        if isinstance(response, SetParameters.Response):
            errors = [result.reason for result in response.results if not result.successful]
            self.page.show_message(errors[0] if errors else 'done; the next target follows')
        else:
            self.page.show_message(response.message)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(GuideNode, args)


if __name__ == '__main__':
    sys.exit(main())
