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
import sys
from typing import Any

from geometry_msgs.msg import PoseArray
from ocp_ros.ros.interface import topics
from ocp_ros.ros.interface.conversions import MessageError, msg_to_cloud, msg_to_poses, shortened
from ocp_ros.ros.interface.qos import LATCHED, LOOP, POSES
from ocp_ros.ros.runtime.managed_node import autostart, create_steady_timer, ManagedNode
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.studio import FIRST_PORT, guide_page, LOCAL_ADDRESS
from ocp_ros.studio.guide_page import GuidePage
from ocp_ros.studio.server import start_server
from ocp_ros.util.settings import setting
from rclpy.client import Client
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger


@dataclass(frozen=True)
class GuideNodeConfig:
    """Parameters of ``guide_node``."""

    host: str = setting(LOCAL_ADDRESS, f'address that the page listens on; {LOCAL_ADDRESS}: this '
                        'machine alone; 0.0.0.0: all, with a random token in the URL')
    port: int = setting(FIRST_PORT + 1, 'port of the page, or the first one to try; 0: any free '
                        'one', 0, 65535)
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
        for msg_type, topic, callback, qos in (
                (PointCloud2, topics.OBSERVATION, self._on_cloud, LOOP),
                (PoseArray, topics.CAMERA_POSES, self._on_poses, POSES),
                (PoseArray, topics.CAMERA_COMMANDS, self._on_command, LOOP),
                (String, topics.INSTRUCTIONS, self._on_instructions, LATCHED),
                (String, topics.PLACEMENT_STATUS, self._on_status, LATCHED)):
            self.create_subscription(msg_type, topic, partial(self._take_message, callback), qos)
        pause = self.create_client(SetBool, 'policy_node/pause')
        #: The client and the request of each button.
        self._actions: dict[str, tuple[Client, Any]] = {
            guide_page.HOLD: (pause, SetBool.Request(data=True)),
            guide_page.GO_ON: (pause, SetBool.Request(data=False)),
            **{label: (self.create_client(Trigger, f'policy_node/{name}'), Trigger.Request())
               for label, name in ((guide_page.ARRIVED, 'arrived'), (guide_page.RESET, 'reset'),
                                   (guide_page.ACCEPT, 'accept'))}}
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
        """Show the targets."""
        self.page.targets = msg_to_poses(message)

    def _on_instructions(self, message: String) -> None:
        """Show where the cameras shall go, and what that is expected to bring."""
        self.page.instructions = message.data

    def _on_status(self, message: String) -> None:
        """Show the progress towards a final placement."""
        self.page.status = message.data

    def _run_pressed_actions(self) -> None:
        """Run the actions of the buttons that were pressed since the last call."""
        while self._pressed:
            self._call(*self._actions[self._pressed.popleft()])

    def _call(self, client: Client, request: Any) -> None:
        """Call a service of ``policy_node``, and show its response."""
        if not client.service_is_ready():
            self.page.show_message(
                f'found no service {client.srv_name}; expected the one of policy_node; start it')
            return
        client.call_async(request).add_done_callback(
            lambda future: self.page.show_message(future.result().message))


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(GuideNode, args)


if __name__ == '__main__':
    sys.exit(main())
