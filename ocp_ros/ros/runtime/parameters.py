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

from collections.abc import Callable, Iterator, Sequence
from dataclasses import Field
import difflib
from functools import partial
from pathlib import Path
import sys
from typing import Any, TypeVar

from ocp_ros.util.settings import check_known, ConfigurationError, from_flat, leaves
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
import yaml

T = TypeVar('T')


def declare(node: Node, cls: type[T], instead: dict[str, dict[str, Any]] | None = None) -> T:
    """
    Declare every setting of a dataclass as a parameter, and read the given values.

    From then on, changes that a running node cannot apply are refused; see :func:`follow`.

    :param node: the node that gets the parameters.
    :param cls: configuration dataclass; settings of groups get dotted names.
    :param instead: other defaults of some settings, by the flag (bool setting) that enables them.
    :returns: the configuration in effect.
    :raises ConfigurationError: for a parameter that does not exist.
    """
    settings = leaves(cls)
    defaults = {name: item.default for name, item in settings.items()}
    for flag, others in (instead or {}).items():
        given = node._parameter_overrides.get(flag)
        if given is not None and given.value is True:
            defaults |= others
    values = {name: node.declare_parameter(name, defaults[name], _descriptor(item)).value
              for name, item in settings.items()}
    # rclpy would drop overrides that are not declared without a warning.
    # These parameters override the quality of service of topics.
    unknown = [name for name in node._parameter_overrides if not node.has_parameter(name)
               and not name.startswith('qos_overrides.')]
    # A name for all nodes that is similar to a parameter is a misspelt parameter.
    shared = {name for name in for_all_nodes(sys.argv, node.get_name()) & set(unknown)
              if not difflib.get_close_matches(name, settings, n=1, cutoff=0.8)}
    for name in shared:
        node.get_logger().warning(f'parameters: found {name!r} for all nodes (/**), which this '
                                  'one does not have; going on without')
    check_known([name for name in unknown if name not in shared], settings,
                f'{node.get_name()} parameters')
    node.add_on_set_parameters_callback(partial(_check, node, cls))
    return from_flat(cls, values, node.get_name())


def for_all_nodes(arguments: Sequence[str], own: str) -> set[str]:
    """
    Return the parameters that files set only for all nodes (``/**``), not for this node.

    Other nodes may need them, so they are no error here.

    :param arguments: of the command line, with ``--params-file FILE``.
    :param own: name of this node; parameters that a file sets for it are left out.
    """
    names: dict[bool, set[str]] = {True: set(), False: set()}
    for option, path in zip(arguments, arguments[1:]):
        if option != '--params-file':
            continue
        try:
            content = yaml.safe_load(Path(path).read_text())
        except (OSError, UnicodeDecodeError, yaml.YAMLError):
            # ROS itself reports a file that cannot be read.
            continue
        for key, part in content.items() if isinstance(content, dict) else ():
            said = part.get('ros__parameters') if isinstance(part, dict) else None
            if isinstance(said, dict) and (key == '/**' or str(key).endswith(own)):
                names[key == '/**'] |= set(_flat(said))
    return names[True] - names[False]


def _flat(values: dict[str, Any], prefix: str = '') -> Iterator[str]:
    """Yield the dotted names of nested parameters."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{name}.')
        else:
            yield f'{prefix}{name}'


def follow(node: Node, change: Callable[[T], None]) -> None:
    """
    Call a function when the parameters of a node have changed.

    :param node: its ``config`` is what :func:`declare` has returned.
    :param change: is called with the new configuration once it is in effect.
    """
    cls = type(node.config)  # type: ignore[attr-defined]
    settings = leaves(cls)

    def apply(parameters: list[Parameter]) -> None:
        changed = [f'{one.name} = {one.value!r}' for one in parameters if one.name in settings]
        if changed:
            change(configured(node, cls, {}))
            node.get_logger().info(f'from now on {", ".join(changed)}')

    node.add_post_set_parameters_callback(apply)


def configured(node: Node, cls: type[T], changes: dict[str, Any]) -> T:
    """Return the configuration from the parameters of a node, with some changes."""
    values = {name: node.get_parameter(name).value for name in leaves(cls)}
    return from_flat(cls, values | changes, node.get_name())


def _check(node: Node, cls: type, parameters: list[Parameter]) -> SetParametersResult:
    """Refuse changes that a running node cannot apply, and changes that contradict others."""
    settings = leaves(cls)
    changes = {one.name: one.value for one in parameters if one.name in settings}
    # Before the node is configured, all parameters may change.
    unconfigured = not getattr(node, 'configured', True)
    try:
        for name, value in changes.items():
            before = node.get_parameter(name).value
            if value != before and not (
                    settings[name].metadata['running'] or unconfigured):
                raise ConfigurationError(
                    f'{node.get_name()}: {name}: found {value!r}, but it is read once, at the '
                    f'start; expected {before!r}; start the node again to change it')
        configured(node, cls, changes)
    except ConfigurationError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _descriptor(item: Field) -> ParameterDescriptor:
    """Describe one parameter; rclpy itself refuses values outside the range."""
    low, high, choices = (item.metadata[key] for key in ('low', 'high', 'choices'))
    constraints = [f'one of {", ".join(choices)}'] if choices else []
    if not item.metadata['running']:
        # Not declared read-only: rclpy would refuse a change without saying what to do.
        constraints.append('read once, at the start')
    descriptor = ParameterDescriptor(
        description=item.metadata['description'],
        additional_constraints='; '.join(constraints))
    if low is not None and item.type is int:
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    elif low is not None:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)]
    return descriptor
