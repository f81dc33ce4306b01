# SPDX-License-Identifier: Apache-2.0
"""ROS parameters from configuration dataclasses, which own the defaults."""

from dataclasses import Field
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from ocp_ros.configuration import check_known, from_flat, leaves

T = TypeVar('T')


def declare(node: Node, cls: type[T]) -> T:
    """
    Declare every setting of a dataclass as a parameter and read what was given.

    :param node: the node that gets the parameters.
    :param cls: configuration dataclass; groups become dotted names.
    :returns: the configuration in effect.
    :raises ConfigurationError: for a parameter that does not exist.
    """
    settings = leaves(cls)
    values = {name: node.declare_parameter(name, item.default, _descriptor(item)).value
              for name, item in settings.items()}
    # Overrides that nobody declares would be dropped without a word.
    unknown = [name for name in node._parameter_overrides
               if not node.has_parameter(name) and not name.startswith('qos_overrides.')]
    check_known(unknown, settings, f'{node.get_name()} parameters')
    return from_flat(cls, values, node.get_name())


def _descriptor(item: Field) -> ParameterDescriptor:
    """Describe one parameter; rclpy itself refuses values outside the range."""
    low, high, choices = (item.metadata[key] for key in ('low', 'high', 'choices'))
    descriptor = ParameterDescriptor(
        description=item.metadata['description'], read_only=True,
        additional_constraints=f'one of {", ".join(choices)}' if choices else '')
    if low is not None and item.type is int:
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    elif low is not None:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)]
    return descriptor
