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

"""ROS parameters from configuration dataclasses, which define the defaults."""

from collections.abc import Callable
from dataclasses import Field
from functools import partial
from typing import Any, TYPE_CHECKING, TypeVar

from ocp_ros.util.settings import check_known, ConfigurationError, from_flat, leaves
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

if TYPE_CHECKING:
    from ocp_ros.ros.runtime.managed_node import ManagedNode

T = TypeVar('T')
OtherDefaults = Callable[[dict[str, Any]], dict[str, Any]]


def declare(node: Node, config_type: type[T]) -> T:
    """
    Declare every setting of a dataclass as a parameter, and read the given values.

    From then on, changes that a running node cannot apply are refused. To apply all other changes,
    call :func:`watch_parameters`.

    :param node: the node that gets the parameters.
    :param config_type: configuration dataclass; settings of groups get dotted names.
    :returns: the configuration in effect.
    :raises ConfigurationError: for a parameter that does not exist.
    """
    settings = leaves(config_type)
    for name, field in settings.items():
        node.declare_parameter(name, field.default, _descriptor_of(field))
    # rclpy would ignore unknown parameters without a warning. Those with the prefix
    # qos_overrides change the quality of service of topics.
    unknown = [name for name in node._parameter_overrides if not node.has_parameter(name)
               and not name.startswith('qos_overrides.')]
    check_known(unknown, settings, f'{node.get_name()} parameters')
    node.add_on_set_parameters_callback(partial(_check_changes, node, config_type))
    return read_config(node, config_type)


def renew_defaults(node: 'ManagedNode', other_defaults: OtherDefaults) -> None:
    """
    Give parameters that the user has not given the defaults that suit the others as they are now.

    :param other_defaults: gets the values that the user has given, by dotted name; returns other
        defaults of some settings than those of the dataclass.
    """
    settings = leaves(type(node.config))
    values = {name: node.get_parameter(name).value for name in settings}
    defaults = {name: field.default for name, field in settings.items()} | other_defaults(
        {name: values[name] for name in node.given_parameters if name in values})
    renewed = [name for name, value in values.items()
               if name not in node.given_parameters and value != defaults[name]]
    node.set_parameters_atomically([Parameter(name, value=defaults[name]) for name in renewed])
    node.given_parameters.difference_update(renewed)


def watch_parameters(node: 'ManagedNode', apply_config: Callable[[T], None]) -> None:
    """
    Call a function when the parameters of a node have changed.

    :param node: its attribute ``config`` is what :func:`declare` has returned.
    :param apply_config: is called with the new configuration once it is in effect.
    """
    config_type = type(node.config)
    settings = leaves(config_type)

    def apply_changes(parameters: list[Parameter]) -> None:
        changed = [f'{p.name} = {p.value!r}' for p in parameters if p.name in settings]
        if changed:
            node.given_parameters.update(p.name for p in parameters)
            apply_config(read_config(node, config_type))
            node.get_logger().info(f'from now on {", ".join(changed)}')

    node.add_post_set_parameters_callback(apply_changes)


def read_config(node: Node, config_type: type[T], changes: dict[str, Any] | None = None
                ) -> T:
    """
    Return the configuration from the parameters of a node.

    :param changes: other values of some parameters, by dotted name.
    """
    settings = leaves(config_type)
    values = {name: node.get_parameter(name).value for name in settings} | (changes or {})
    return from_flat(config_type, values, node.get_name())


def _check_changes(node: Node, config_type: type, parameters: list[Parameter]
                   ) -> SetParametersResult:
    """Return whether a node can apply changed parameters; if not, with the reason."""
    settings = leaves(config_type)
    changes = {p.name: p.value for p in parameters if p.name in settings}
    # Before a managed node is configured, all its parameters may change. A plain node has no
    # attribute ``configured``: it has read its parameters.
    unconfigured = not getattr(node, 'configured', True)
    try:
        for name, value in changes.items():
            old_value = node.get_parameter(name).value
            # Settings with ``running`` may change while the node runs.
            if value != old_value and not (settings[name].metadata['running'] or unconfigured):
                remedy = ('to change it, let ros2 lifecycle set deactivate and cleanup the node, '
                          'set it, then let it configure and activate the node'
                          ) if hasattr(node, 'configured') else 'start the node again to change it'
                raise ConfigurationError(
                    f'{node.get_name()}: {name}: found {value!r}, but it is read once, at the '
                    f'start; expected {old_value!r}; {remedy}')
        read_config(node, config_type, changes)
    except ConfigurationError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _descriptor_of(field: Field) -> ParameterDescriptor:
    """Return the description of a parameter; rclpy refuses values outside its range."""
    low, high, choices = (field.metadata[key] for key in ('low', 'high', 'choices'))
    constraints = [f'one of {", ".join(choices)}'] if choices else []
    if not field.metadata['running']:
        # Not declared read-only: rclpy would refuse a change without saying what to do.
        constraints.append('read once, at the start')
    descriptor = ParameterDescriptor(description=field.metadata['description'],
                                     additional_constraints='; '.join(constraints),
                                     dynamic_typing=field.metadata['names'])
    if low is not None and field.type is int:
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    elif low is not None:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)]
    return descriptor
