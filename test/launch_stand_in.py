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
As much of ROS's launch system as executes the launch files of this package.

It stands in where ``launch_ros`` is not installed, as with ROS from PyPI. Classes have the names
and the arguments of the real ones.
"""

from pathlib import Path
import sys
from types import ModuleType, SimpleNamespace


class LaunchConfiguration:
    """An argument of a launch file."""

    def __init__(self, name):
        self.name = name

    def perform(self, context):
        """Return its text."""
        return context.launch_configurations[self.name]


class DeclareLaunchArgument:
    """The default of an argument."""

    def __init__(self, name, *, default_value, description):
        assert isinstance(default_value, str) and description
        self.name, self.default_value = name, default_value

    def visit(self, context):
        """Set it where it is not given."""
        context.launch_configurations.setdefault(self.name, self.default_value)


class OpaqueFunction:
    """A function that returns what is to be started."""

    def __init__(self, *, function):
        self.function = function

    def execute(self, context):
        """Call it."""
        return self.function(context)


class IfCondition:
    """Whether an argument is true."""

    def __init__(self, substitution):
        self.substitution = substitution

    def evaluate(self, context):
        """Return whether it is."""
        text = self.substitution.perform(context).lower()
        assert text in ('true', 'false', '1', '0')
        return text in ('true', '1')


class ParameterValue:
    """A value of a given type."""

    def __init__(self, value, *, value_type):
        self.value, self.value_type = value, value_type

    def evaluate(self, context):
        """Return it."""
        text = self.value.perform(context)
        if self.value_type is bool:
            assert text in ('true', 'false')
            return text == 'true'
        return self.value_type(text)


class Node:
    """A process to start."""

    def __init__(self, *, package, executable, output='log', namespace=None, parameters=(),
                 arguments=(), condition=None):
        self.package, self.executable, self.namespace = package, executable, namespace
        self.parameters, self.condition = parameters, condition


class LaunchDescription:
    """What a launch file returns."""

    def __init__(self, entities):
        self.entities = entities


def install(monkeypatch):
    """Let launch files import all this."""
    modules = {
        'ament_index_python.packages': {'get_package_share_directory': lambda name: str(
            Path(__file__).parent.parent)},
        'launch': {'LaunchDescription': LaunchDescription, 'LaunchContext': SimpleNamespace},
        'launch.actions': {'DeclareLaunchArgument': DeclareLaunchArgument,
                           'OpaqueFunction': OpaqueFunction},
        'launch.conditions': {'IfCondition': IfCondition},
        'launch.substitutions': {'LaunchConfiguration': LaunchConfiguration},
        'launch_ros': {}, 'launch_ros.actions': {'Node': Node},
        'launch_ros.parameter_descriptions': {'ParameterValue': ParameterValue}}
    for name, contents in modules.items():
        module = ModuleType(name)
        module.__dict__.update(contents)
        monkeypatch.setitem(sys.modules, name, module)


def started(description, **given):
    """Return what a launch file starts: executable, namespace and parameters of each node."""
    context = SimpleNamespace(launch_configurations=dict(given))

    def text(value):
        return value.perform(context) if isinstance(value, LaunchConfiguration) else value

    found = []
    for entity in description.entities:
        if isinstance(entity, DeclareLaunchArgument):
            entity.visit(context)
            continue
        nodes = entity.execute(context) if isinstance(entity, OpaqueFunction) else [entity]
        for node in nodes:
            if node.condition is None or node.condition.evaluate(context):
                found.append((node.executable, text(node.namespace), [
                    {name: value.evaluate(context) if isinstance(value, ParameterValue) else value
                     for name, value in entry.items()} if isinstance(entry, dict) else text(entry)
                    for entry in node.parameters]))
    return found
