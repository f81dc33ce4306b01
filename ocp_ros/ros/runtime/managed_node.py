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
Nodes with a life cycle: they send nothing before they are activated, and can be cleaned up.

By default a node configures and activates itself, so that ``ros2 run`` is one step. With
``autostart: false`` it waits for ``ros2 lifecycle``, a launch file or a life cycle manager. If the
node cannot be configured, it logs why and can be configured again.
"""

from collections.abc import Callable
from copy import copy
from typing import Any

from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.ros.runtime.parameters import configured, declare, follow
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.settings import ConfigurationError, setting
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


def autostart() -> Any:
    """Declare the setting ``autostart``, which all managed nodes have."""
    return setting(True, 'configure and activate the node at the start; false: wait for lifecycle '
                         'commands, such as `ros2 lifecycle set`')


def _overridable(topic: str, profile: QoSProfile | int, settings: dict[str, Any]
                 ) -> QoSProfile | int:
    """Return the profile of a topic; for own topics ``qos_overrides`` parameters may change it."""
    # All nodes have the topics that begin with these names.
    common = ('/rosout', '/parameter_events', '/diagnostics', '/clock', '/tf')
    if topic.startswith(('~', *common)) or not isinstance(profile, QoSProfile):
        return profile
    settings.setdefault('qos_overriding_options', QoSOverridingOptions.with_default_policies())
    # rclpy writes the overrides into the profile: it gets a copy.
    return copy(profile)


class ManagedNode(LifecycleNode):
    """
    A node with the life cycle of ROS 2.

    :param name: of the node.
    :param settings: dataclass of its parameters, with a field ``autostart``.
    :param instead: other defaults, see :func:`~ocp_ros.ros.runtime.parameters.declare`.
    :ivar config: parameters in effect.
    :ivar configured: whether the node is configured.
    :ivar active: whether the node is active and may send messages.
    :raises ConfigurationError: for parameters that are invalid.
    """

    def __init__(self, name: str, settings: type,
                 instead: dict[str, dict[str, Any]] | None = None, **kwargs) -> None:
        super().__init__(name, **kwargs)
        self.configured = self.active = False
        self._mark: dict[str, set] = {}
        self._acting: dict[str, set] = {}
        self._failure: Exception | None = None
        #: Whether the constructor still runs: then it raises the error of a failed transition.
        self._starting = True
        self.config = declare(self, settings, instead)
        follow(self, self._change)
        if self.config.autostart:
            for trigger in (self.trigger_configure, self.trigger_activate):
                if trigger() != SUCCESS:
                    raise self._failure
        self._starting = False

    def create_publisher(self, msg_type, topic: str, qos_profile, **settings) -> Publisher:
        """Create a publisher; parameters may override its quality of service."""
        profile = _overridable(topic, qos_profile, settings)
        return super().create_publisher(msg_type, topic, profile, **settings)

    def create_subscription(self, msg_type, topic: str, callback, qos_profile, **settings
                            ) -> Subscription:
        """Create a subscription; parameters may override its quality of service."""
        profile = _overridable(topic, qos_profile, settings)
        return super().create_subscription(msg_type, topic, callback, profile, **settings)

    def configure(self) -> None:
        """Prepare with the parameters; entities created here are destroyed at clean-up."""

    def activate(self) -> None:
        """Start sending, or continue."""

    def deactivate(self) -> None:
        """Stop sending until the next activation."""

    def release(self) -> None:
        """Release everything that is not an entity of ROS."""

    def destroy_node(self) -> None:
        """Release everything, and end the node."""
        self.release()
        super().destroy_node()

    def change(self, config: Any) -> None:
        """Continue with other parameters; is called only while the node is configured."""

    def _change(self, config: Any) -> None:
        """Store changed parameters, and apply them if the node is configured."""
        self.config = config
        if self.configured:
            self.change(config)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure the node, or log why that fails."""
        self.config = configured(self, type(self.config), {})
        self._mark = self._entities()
        self.configured = self._done(self.configure, self._put_away)
        return SUCCESS if self.configured else FAILURE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate the node."""
        self._acting = self._entities()
        self.active = self._done(self.activate, self._stand_down)
        return SUCCESS if self.active else FAILURE

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate the node."""
        self._stand_down()
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything."""
        self._put_away()
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate the node and release everything."""
        if self.active:
            self._stand_down()
        self._put_away()
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything; the node can be configured again."""
        return self.on_shutdown(state)

    def _done(self, begin: Callable[[], None], undo: Callable[[], None]) -> bool:
        """
        Run a step of the life cycle; if it fails, undo it and store the error.

        The error is logged, unless the constructor is going to raise it.

        :returns: whether the step succeeded.
        """
        try:
            begin()
        except Exception as error:
            undo()
            self._failure = error
            if not (self._starting and self.config.autostart):
                # The user can correct a wrong file or parameter.
                mendable = (CheckpointError, ConfigurationError, SceneError, OSError)
                self.get_logger().error(
                    str(error) if isinstance(error, mendable) else
                    f'found {type(error).__name__}: {error}; the node stays as it was')
            return False
        return True

    def _stand_down(self) -> None:
        """Deactivate, and destroy all entities created since the activation."""
        self.deactivate()
        self.active = False
        self._destroy(self._acting)

    def _put_away(self) -> None:
        """Release everything, and destroy all entities created since the configuration."""
        self.configured = False
        self.release()
        self._destroy(self._mark)

    def _entities(self) -> dict[str, set]:
        """Return the ROS entities that the node has now, by kind."""
        return {kind: set(getattr(self, f'{kind}s'))
                for kind in ('publisher', 'subscription', 'timer', 'service', 'client')}

    def _destroy(self, kept: dict[str, set]) -> None:
        """Destroy the ROS entities of the node that are not among those kept."""
        for kind, entities in self._entities().items():
            for entity in entities - kept.get(kind, entities):
                getattr(self, f'destroy_{kind}')(entity)

    def _LifecycleNodeMixin__change_state(self, transition_id: int) -> TransitionCallbackReturn:
        """
        Refuse a transition that the present state does not allow.

        rclpy raises an error then that is caught nowhere: any caller of ``~/change_state`` could
        end the node.
        """
        possible = {one[0]: one[1] for one in self._state_machine.available_transitions}
        if transition_id not in possible:
            self.get_logger().warning(
                f'life cycle: found the transition {transition_id} while the node is '
                f'{self._state_machine.current_state[1]}; expected one of '
                f'{sorted(set(possible.values()))}')
            return FAILURE
        return super()._LifecycleNodeMixin__change_state(transition_id)
