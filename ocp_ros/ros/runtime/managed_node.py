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

This module also has what all nodes share: steady timers and diagnostics.
By default a node configures and activates itself, so that ``ros2 run`` is one step. With
``autostart: false`` it waits for ``ros2 lifecycle``, a launch file or a life cycle manager. If the
node cannot be configured, it logs why and can be configured again.
"""

from collections.abc import Callable, Iterable, Mapping
from copy import copy
import re
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.ros.runtime.parameters import (
    declare,
    OtherDefaults,
    read_config,
    renew_defaults,
    watch_parameters,
)
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.settings import check_known, ConfigurationError, setting
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
ONE_SIMULATION = 'one simulation, or their turns get mixed up'
#: The status of a node for diagnostics: level, message, and values by their names.
Status = tuple[bytes, str, Mapping[str, object]]


def autostart() -> Any:
    """Declare the setting ``autostart``, which all managed nodes have."""
    return setting(True, 'configure and activate the node at the start; false: wait for lifecycle '
                         'commands, such as `ros2 lifecycle set`')


def create_steady_timer(node: Node, period_s: float, callback: Callable[[], None]) -> Timer:
    """Create a timer that runs on a steady clock: also while /clock stops or jumps."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def warn_of_crowd(node: 'ManagedNode', topic: str, expected: str, max_publishers: int = 1) -> str:
    """
    Warn if more nodes publish on a topic than expected.

    :param node: reads the ROS graph, and warns.
    :param topic: relative or full name.
    :param expected: which publishers are expected, in words for the warning.
    :param max_publishers: number of publishers that is expected at most.
    :returns: the warning; empty if there are not too many publishers.
    """
    publishers = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    names = sorted(f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in publishers)
    warning = '' if len(publishers) <= max_publishers else (
        f'found publishers of {topic}: {", ".join(names)}; expected {expected}; end the '
        'others, or give each its own namespace (a node that was killed is found for up to '
        '20 s more)')
    node.warn(f'publishers of {topic}', warning)
    return warning


def publish_diagnostics(node: Node, make_status: Callable[[], Status]) -> None:
    """
    Publish a node's status on ``/diagnostics`` once a second.

    :param make_status: returns the status.
    """
    publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish() -> None:
        level, message, values = make_status()
        array = DiagnosticArray()
        array.header.stamp = node.get_clock().now().to_msg()
        array.status = [DiagnosticStatus(
            level=level, name=node.get_fully_qualified_name(), message=message,
            # The nodes of a namespace work with one rig.
            hardware_id=node.get_namespace().strip('/') or 'rig',
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])]
        publisher.publish(array)

    create_steady_timer(node, 1.0, publish)


class OverridableNode(Node):
    """A node whose publishers and subscriptions take their quality of service from parameters."""

    #: Whether it declares these parameters for all topics, not only where they are given.
    declares_all_overrides = True

    def create_publisher(self, msg_type, topic: str, qos_profile, **settings) -> Publisher:
        """Create a publisher; parameters may override its quality of service."""
        profile = self._allow_overrides(topic, qos_profile, settings)
        return super().create_publisher(msg_type, topic, profile, **settings)

    def create_subscription(self, msg_type, topic: str, callback, qos_profile, **settings
                            ) -> Subscription:
        """Create a subscription; parameters may override its quality of service."""
        profile = self._allow_overrides(topic, qos_profile, settings)
        return super().create_subscription(msg_type, topic, callback, profile, **settings)

    def _allow_overrides(self, topic: str, profile: QoSProfile | int, settings: dict
                         ) -> QoSProfile | int:
        """
        Return the profile of a topic; let parameters override it if it is of this package.

        :param profile: the profile, or the number of messages to keep, which is returned as it is.
        :param settings: keyword arguments for rclpy; gets the option that declares the parameters.
        """
        # Topics that begin with these names, or with ~, are common to nodes of all packages.
        common_topics = ('/rosout', '/parameter_events', '/diagnostics', '/clock', '/tf')
        if topic.startswith(('~', *common_topics)) or not isinstance(profile, QoSProfile):
            return profile
        if self.declares_all_overrides or (
                self.resolve_topic_name(topic) in self.overridden_topics):
            settings.setdefault('qos_overriding_options',
                                QoSOverridingOptions.with_default_policies())
        # rclpy writes the overrides into the profile: return a copy.
        return copy(profile)

    @property
    def late_topics(self) -> list[str]:
        """Return the topics that the node creates only later."""
        return []

    @property
    def overridden_topics(self) -> set[str]:
        """Return the full names of the topics that parameters override."""
        return self._topics_in(self._parameter_overrides)

    @staticmethod
    def _topics_in(parameters: Iterable[str]) -> set[str]:
        """Return the topics in names such as ``qos_overrides.TOPIC.publisher.depth``."""
        return {name.split('.')[1] for name in parameters if name.startswith('qos_overrides.')}

    def find_unknown_override(self) -> str:
        """Return in words the first topic that is overridden and that the node lacks; else ''."""
        late = set(map(self.resolve_topic_name, self.late_topics))
        try:
            check_known(sorted(self.overridden_topics), self._topics_in(self._parameters) | late,
                        f'{self.get_name()}: qos_overrides')
        except ConfigurationError as error:
            return str(error)
        return ''


class ManagedNode(OverridableNode, LifecycleNode):
    """
    A node with the life cycle of ROS 2.

    :param name: name of the node.
    :param config_type: dataclass of its parameters, with a field ``autostart``.
    :param other_defaults: see :func:`~ocp_ros.ros.runtime.parameters.renew_defaults`.
    :ivar config: parameters in effect.
    :ivar configured: whether the node is configured.
    :ivar active: whether the node is active and may send messages.
    :ivar warnings: texts of the present warnings, by what they are about.
    :raises ConfigurationError: for parameters that are invalid.
    """

    def __init__(self, name: str, config_type: type,
                 other_defaults: OtherDefaults = lambda given: {}, **kwargs) -> None:
        super().__init__(name, **kwargs)
        self.configured = self.active = False
        self.warnings: dict[str, str] = {}
        #: What was new in each of these when it was logged.
        self._logged_words: dict[str, str] = {}
        #: ROS entities that existed before the configuration, by kind: the clean-up keeps them.
        self._kept_entities: dict[str, set] = {}
        self._step_error: Exception | None = None
        self._other_defaults = other_defaults
        self.config = declare(self, config_type)
        #: Names of the parameters that the user has given.
        self.given_parameters = set(self._parameter_overrides)
        self._renew_config()
        watch_parameters(self, self._store_config)
        #: Whether the constructor starts the node: it raises the error of a failed step itself.
        self._is_starting = self.config.autostart
        if self._is_starting:
            for trigger in (self.trigger_configure, self.trigger_activate):
                if trigger() != SUCCESS:
                    raise self._step_error
        self._is_starting = False

    def warn(self, about: str, text: str, news: str = '') -> None:
        """
        Log a warning once, and store it for the diagnostics until it ends.

        :param about: what the warning is about; there is one warning about each thing at a time.
        :param text: the warning; empty: it has ended.
        :param news: the warning is logged if this is new; empty: its text without numbers.
        """
        if not text:
            self.warnings.pop(about, None)
            self._logged_words.pop(about, None)
            return
        self.warnings[about] = text
        # Numbers within names, such as those of topics, stay.
        words = news or re.sub(r'(?<![\w/])-?\d[\d.]*', '', text)
        if self._logged_words.get(about) != words:
            self._logged_words[about] = words
            self.get_logger().warning(text)

    def configure(self) -> None:
        """Prepare with the parameters; entities created here are destroyed at clean-up."""

    def activate(self) -> None:
        """Start sending, or continue."""

    def deactivate(self) -> None:
        """Stop sending until the next activation; undo everything that ``activate`` has done."""

    def release(self) -> None:
        """Release everything that is not an entity of ROS."""

    def destroy_node(self) -> None:
        """Release everything, and end the node."""
        self.release()
        super().destroy_node()
        # rclpy 7.1 forgets it, and it keeps the node in the graph until Python collects garbage.
        self._state_machine.destroy_when_not_in_use()

    def apply_config(self, config: Any) -> None:
        """Continue with new parameters; is called only while the node is configured."""

    def _store_config(self, config: Any) -> None:
        """Store new parameters, and apply them if the node is configured."""
        self.config = config
        if self.configured:
            self.apply_config(config)

    def _renew_config(self) -> None:
        """Read the parameters; those that the user has not given get suitable defaults before."""
        renew_defaults(self, self._other_defaults)
        self.config = read_config(self, type(self.config))

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure the node, or log why that fails."""
        self._renew_config()
        self._kept_entities = self._entities()
        self.configured = self._try_step(self.configure, self._release_node)
        if self.configured:
            self.warn('qos_overrides', self.find_unknown_override())
        return SUCCESS if self.configured else FAILURE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate the node, or log why that fails."""
        self.active = self._try_step(self.activate, self._deactivate_node)
        return SUCCESS if self.active else FAILURE

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate the node."""
        self._deactivate_node()
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything that was prepared at the configuration."""
        self._release_node()
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate the node and release everything."""
        if self.active:
            self._deactivate_node()
        self._release_node()
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything; the node can be configured again."""
        return self.on_shutdown(state)

    def _try_step(self, run_step: Callable[[], None], undo_step: Callable[[], None]) -> bool:
        """
        Run a step of the life cycle; if it fails, undo it and store the error.

        The error is logged here, except where the constructor raises it.

        :returns: whether the step succeeded.
        """
        try:
            run_step()
        except Exception as error:
            undo_step()
            self._step_error = error
            if not self._is_starting:
                # The user can correct a wrong file or parameter.
                user_errors = (CheckpointError, ConfigurationError, SceneError, OSError)
                self.get_logger().error(
                    str(error) if isinstance(error, user_errors) else
                    f'found {type(error).__name__}: {error}; the node stays as it was')
            return False
        return True

    def _deactivate_node(self) -> None:
        """Deactivate the node."""
        self.deactivate()
        self.active = False

    def _release_node(self) -> None:
        """Release everything, and destroy all entities created since the configuration."""
        self.configured = False
        self.warnings.clear()
        self._logged_words.clear()
        self.release()
        for kind, entities in self._entities().items():
            # There is no record before the first configuration.
            for entity in entities - self._kept_entities.get(kind, entities):
                getattr(self, f'destroy_{kind}')(entity)

    def _entities(self) -> dict[str, set]:
        """Return the ROS entities that the node has now, by kind."""
        return {kind: set(getattr(self, f'{kind}s'))
                for kind in ('publisher', 'subscription', 'timer', 'service', 'client')}

    def _LifecycleNodeMixin__change_state(self, transition_id: int) -> TransitionCallbackReturn:
        """
        Refuse a transition that the present state does not allow.

        This overrides a private method of rclpy, which would raise an error that nothing catches:
        any caller of ``~/change_state`` could end the node.
        """
        # Each available transition begins with its number and its label.
        labels = {number: label for number, label, *_ in self._state_machine.available_transitions}
        if transition_id not in labels:
            self.get_logger().warning(f'life cycle: found the transition {transition_id} while '
                                      f'the node is {self._state_machine.current_state[1]}; '
                                      f'expected one of {sorted(set(labels.values()))}')
            return FAILURE
        return super()._LifecycleNodeMixin__change_state(transition_id)
