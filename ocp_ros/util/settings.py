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
Configuration as dataclasses, which define every default, its description and its range.

Nodes declare their parameters from these classes, YAML and JSON files are read into them, and the
values used are saved with each result.
"""

from collections.abc import Collection, Iterable
from dataclasses import asdict, Field, field, fields, is_dataclass
import difflib
from importlib.util import find_spec
from numbers import Integral, Real
from typing import Any, TypeVar

T = TypeVar('T')

#: The largest number of cameras of a rig.
MAX_CAMERAS = 64
#: The largest seed.
MAX_SEED = 1 << 31
#: Packages that only some programs need, by the extra of setup.py that installs them.
EXTRAS = {'plan': ('cma', 'highspy', 'plotly'), 'studio': ('viser',), 'ray': ('ray',),
          'train': ('gymnasium', 'stable_baselines3', 'tensorboard'),
          'buildings': ('ezdxf', 'ifcopenshell', 'pxr'),
          'files': ('laspy', 'lazrs', 'open3d', 'plyfile', 'pye57', 'rosbags')}
#: The least number of points of a room.
MIN_ROOM_POINTS = 1000
#: The largest number of points of a room.
MAX_ROOM_POINTS = 5_000_000


class UserError(ValueError):
    """Report unusable input of a user in one sentence."""


class ConfigurationError(UserError):
    """Report an unusable setting; the message names it and says what was expected."""


def need(user: str, *packages: str) -> None:
    """
    Check that packages of ``EXTRAS`` are installed.

    :param user: what needs them, for the error.
    :raises ConfigurationError: names the extra to install.
    """
    for package in packages:
        if not find_spec(package):
            extra = next(name for name, members in EXTRAS.items() if package in members)
            raise ConfigurationError(f'{user}: found no package {package}; expected it; install '
                                     f'it by pip install "ocp_ros[{extra}]"')


def setting(default: Any, description: str, low: float | None = None, high: float | None = None,
            choices: tuple[str, ...] = (), running: bool = False, names: bool = False) -> Any:
    """
    Declare a field of a configuration dataclass.

    :param default: its default, whose type is the type of the setting.
    :param description: one sentence with the unit.
    :param low: smallest value allowed.
    :param high: largest value allowed.
    :param choices: the values allowed, for text.
    :param running: whether a running node can change it.
    :param names: whether it is a text of names with commas between, which may be given to a node
        as a list too.
    """
    metadata = {'description': description, 'low': low, 'high': high, 'choices': choices,
                'running': running, 'names': names}
    return field(default=default, metadata=metadata)


def group(cls: type[T]) -> Any:
    """Declare a field that holds another configuration dataclass with its defaults."""
    return field(default_factory=cls)


def leaves(cls: type, prefix: str = '') -> dict[str, Field]:
    """Return the dataclass field of every setting by its dotted name, such as ``rig.cameras``."""
    settings = {}
    for item in fields(cls):
        if is_dataclass(item.type):
            settings.update(leaves(item.type, f'{prefix}{item.name}.'))
        else:
            settings[prefix + item.name] = item
    return settings


def check_known(names: Iterable[str], known: Collection[str], what: str) -> None:
    """
    Refuse names that do not exist; the message suggests the most similar known name.

    :param names: the names to check.
    :param known: the names that exist.
    :param what: the source of the names, for the message.
    :raises ConfigurationError: for the first unknown name.
    """
    for name in names:
        if name not in known:
            similar = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
            hint = f'; did you mean {similar[0]!r}?' if similar else (
                f'; expected one of {sorted(known)}')
            raise ConfigurationError(f'{what}: found the unknown name {_short_text(name)}{hint}')


def check_positive(name: str, value: Any) -> None:
    """
    Refuse a value that is neither a finite number above 0 nor None.

    :param name: the name of the value, for the message.
    :raises ConfigurationError: for any other value.
    """
    if value is not None and (isinstance(value, bool) or not isinstance(value, Real)
                              or not 0.0 < value < float('inf')):
        raise ConfigurationError(f'{name}: found {_short_text(value)}; expected a number above 0')


def check_whole(name: str, value: Any, least: int = 1, most: int | None = None) -> None:
    """
    Refuse a value that is neither a whole number from ``least`` to ``most`` nor None.

    :param name: the name of the value, for the message.
    :param most: the largest number allowed; None for no limit.
    :raises ConfigurationError: for any other value.
    """
    if value is not None and (isinstance(value, bool) or not isinstance(value, Integral)
                              or value < least or (most is not None and value > most)):
        limit = 'or more' if most is None else f'to {most}'
        raise ConfigurationError(f'{name}: found {_short_text(value)}; expected a whole number, '
                                 f'{least} {limit}')


def _short_text(value: Any) -> str:
    """Return a value as short text for messages."""
    text = repr(value)
    return text if len(text) <= 60 else f'{text[:57]}...'


def _checked_value(name: str, item: Field, value: Any) -> Any:
    """Return a value in the type of its setting, the field ``item``; refuse invalid values."""
    expected: Any = item.type
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    # A list of names is stored as a text.
    if item.metadata['names'] and isinstance(value, (list, tuple)):
        value = ','.join(map(str, value))
    found = f'{name}: found {_short_text(value)}'
    if not isinstance(value, expected) or (isinstance(value, bool) and expected is not bool):
        raise ConfigurationError(f'{found} ({type(value).__name__}); expected {expected.__name__}')
    low, high, choices = (item.metadata[key] for key in ('low', 'high', 'choices'))
    if choices and value not in choices:
        raise ConfigurationError(f'{found}; expected one of {list(choices)}')
    # ``not >=`` and ``not <=`` refuse NaN too.
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        raise ConfigurationError(f'{found}; expected {low} to {high}')
    return value


def from_flat(cls: type[T], values: dict[str, Any], what: str = 'configuration') -> T:
    """
    Build a configuration from dotted names; missing settings keep their defaults.

    :param values: dotted name to value, such as ``{'rig.cameras': 4}``.
    :param what: the source of the values, for messages.
    :raises ConfigurationError: for an unknown name, a wrong type or a value out of range.
    """
    known = leaves(cls)
    check_known(values, known, what)
    checked = {name: _checked_value(f'{what}: {name}', known[name], value)
               for name, value in values.items()}
    return _build_config(cls, checked, '')


def _build_config(cls: type[T], values: dict[str, Any], prefix: str) -> T:
    """Build a dataclass and its nested dataclasses from values by dotted name."""
    arguments = {}
    for item in fields(cls):
        name = prefix + item.name
        if is_dataclass(item.type):
            arguments[item.name] = _build_config(item.type, values, name + '.')
        elif name in values:
            arguments[item.name] = values[name]
    return cls(**arguments)


def flatten(nested: dict[str, Any], prefix: str = '') -> dict[str, Any]:
    """Return the values of nested dictionaries by dotted name, such as ``{'rig.cameras': 4}``."""
    flat = {}
    for key, value in nested.items():
        if isinstance(value, dict):
            flat.update(flatten(value, f'{prefix}{key}.'))
        else:
            flat[f'{prefix}{key}'] = value
    return flat


def from_nested(cls: type[T], nested: dict[str, Any], what: str = 'configuration') -> T:
    """Build a configuration from nested dictionaries, as read from YAML and JSON."""
    if not isinstance(nested, dict):
        raise ConfigurationError(f'{what}: found {type(nested).__name__}; expected a mapping')
    return from_flat(cls, flatten(nested), what)


def to_nested(config: Any) -> dict[str, Any]:
    """Turn a configuration into nested dictionaries for YAML and JSON."""
    return asdict(config)
