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
Read YAML and JSON files, check them against a schema, and name the line in errors.

Only those parts of YAML that JSON has are read: mappings, lists, texts, numbers, true, false and
null. ``on`` and ``no`` are texts, 010 is ten, and tags and aliases are refused.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
import difflib
import errno
import json
import math
from numbers import Real
from os import PathLike
from pathlib import Path
import re
from typing import Any

from jsonschema import Draft202012Validator, ValidationError
from jsonschema.validators import extend
from ocp_ros.util.files import read_regular
from ocp_ros.util.settings import ConfigurationError
import yaml


def _check_pattern(_, pattern: str, value: Any, __) -> Iterator[ValidationError]:
    """Yield an error unless a whole text matches; a ``$`` would also match before a line end."""
    if isinstance(value, str) and not re.fullmatch(pattern, value):
        yield ValidationError(f'{value!r} does not match {pattern!r}')


#: JSON Schema accepts 3.0 as an integer, and NaN and inf as numbers within any limits; code that
#: counts or computes with the value does not.
SchemaValidator = extend(
    Draft202012Validator, {'pattern': _check_pattern},
    type_checker=Draft202012Validator.TYPE_CHECKER.redefine_many({
        'integer': lambda _, value: isinstance(value, int) and not isinstance(value, bool),
        'number': lambda _, value: (isinstance(value, Real) and not isinstance(value, bool)
                                    and -math.inf < value < math.inf)}))
#: The path to a value in nested data: keys of mappings and indices of lists.
Way = tuple[str | int, ...]
Schema = dict[str, Any]
YAML_CONSTANTS = {'': None, '~': None, 'null': None, 'true': True, 'false': False}


@dataclass(frozen=True)
class Document:
    """
    Plain data with the line of each value.

    :ivar name: the name of the document in messages: the name of its file.
    :ivar data: mappings, lists, texts, numbers, booleans and None.
    :ivar lines: the line of each value, from 1, by the path to the value; empty without a file.
    :ivar written: for values that were made from other values of the file: the path to the value
        in ``data``, and the path to the other value in the file.
    """

    name: str
    data: Any
    lines: dict[Way, int] = field(default_factory=dict, repr=False)
    written: dict[Way, Way] = field(default_factory=dict, repr=False)

    def where(self, *key_path: str | int) -> str:
        """Return the file, the line and the key of a value, such as ``a.yaml: line 3, b[0].c``."""
        key_path = self.written.get(key_path, key_path)
        key = ''.join(f'[{step}]' if isinstance(step, int) else f'.{_short_key(step)}'
                      for step in key_path)
        line = f'line {self.line(key_path)}' if self.lines else ''
        return f'{self.name}: ' + ', '.join(filter(None, [line, key.lstrip('.')]))

    def line(self, key_path: Way) -> int:
        """Return the line of a value, or of the innermost mapping or list around it; else 1."""
        while key_path and key_path not in self.lines:
            key_path = key_path[:-1]
        return self.lines.get(key_path, 1)

    def error(self, key_path: Way, found: str, expected: str, remedy: str) -> ConfigurationError:
        """Return an error, in one sentence, about the unusable value at a path."""
        return ConfigurationError(
            f'{self.where(*key_path)}: found {found}; expected {expected}; {remedy}')

    def value(self, *key_path: str | int) -> Any:
        """Return the value at a path."""
        data = self.data
        for step in key_path:
            data = data[step]
        return data

    def part(self, *key_path: str | int) -> 'Document':
        """Return the value at a path as a separate document that keeps the lines of the file."""
        lines = {path[len(key_path):]: line for path, line in self.lines.items()
                 if path[:len(key_path)] == key_path}
        return Document(self.name, self.value(*key_path), lines)


class _BadLine(Exception):
    """An error in a file; its arguments: line, what was found, what was expected, what to do."""


class _Loader(yaml.BaseLoader):
    """A YAML loader that limits the number of nodes and refuses aliases."""

    nodes = 0

    def compose_node(self, parent: yaml.Node, index: Any) -> yaml.Node:
        """Return the next node; refuse an alias, and a node beyond the largest number of nodes."""
        self.nodes += 1
        line = self.peek_event().start_mark.line + 1
        max_nodes = 20_000
        if self.nodes > max_nodes:
            raise _BadLine(line, f'more than {max_nodes:,} keys and values', 'fewer',
                           'name the right file')
        if self.check_event(yaml.AliasEvent):
            raise _BadLine(line, 'an alias', 'each value where it belongs',
                           'write it out in place of *')
        return super().compose_node(parent, index)


def read_document(path: str | Path, schema: dict[str, Any]) -> Document:
    """
    Read a YAML or JSON file.

    :param path: the path of the file, which is UTF-8.
    :param schema: the schema of the file, JSON Schema 2020-12; see :func:`check`.
    :raises ConfigurationError: if the file cannot be read or is invalid, in one sentence.
    """
    document = read_plain(path)
    if document.data is None:
        raise ConfigurationError(f'{document.name}: line 1: found an empty file; expected '
                                 f'{schema["description"]}; write it, or name another file')
    check(document, schema)
    return document


def document_of(name: str, data: Mapping[Any, Any], schema: dict[str, Any]) -> Document:
    """
    Return data in memory as a document, as if it were read from a file.

    :param name: the name of the document in messages.
    :param data: plain data; tuples and arrays are lists. The keys ``on`` and ``off``, which YAML
        1.1 reads as true and false, may be these.
    :param schema: the schema of the data, JSON Schema 2020-12; see :func:`check`.
    :raises ConfigurationError: if the data are invalid, in one sentence.
    """
    document = Document(name, _plain_value(Document(name, data), data, ()))
    check(document, schema)
    return document


def _plain_value(document: Document, value: Any, key_path: Way) -> Any:
    """Return a value as plain data; refuse what a file cannot contain."""
    # NumPy is not imported for it.
    if hasattr(value, 'tolist'):
        value = value.tolist()
    if isinstance(value, (list, tuple)) and len(key_path) < 20:
        return [_plain_value(document, item, (*key_path, k)) for k, item in enumerate(value)]
    if isinstance(value, Mapping) and len(key_path) < 20:
        words = {True: 'on', False: 'off'}
        data = {words[key] if isinstance(key, bool) else key: item for key, item in value.items()}
        for key in data:
            if not isinstance(key, str):
                raise document.error(key_path, f'the key {key!r:.40}', 'a word',
                                     'write one, such as count: 3')
        return {key: _plain_value(document, item, (*key_path, key)) for key, item in data.items()}
    if value is None or isinstance(value, (str, int)) or (
            isinstance(value, float) and math.isfinite(value)):
        return value
    raise document.error(key_path, f'{value!r:.40}',
                         'a finite number, a text, a list or a mapping', 'write one of them')


def read_plain(path: str | Path) -> Document:
    """
    Read a YAML or JSON file of any content.

    :param path: the path of the file, which is UTF-8.
    :returns: the document; its data are None if the file is empty.
    :raises ConfigurationError: if the file cannot be read, in one sentence.
    """
    if not isinstance(path, (str, PathLike)):
        raise ConfigurationError(f'path: found {type(path).__name__}; expected the path of a YAML '
                                 'or JSON file')
    path = Path(path)
    lines: dict[Way, int] = {}
    text = _read_text(path)
    try:
        node = yaml.compose(text, Loader=_Loader)
        data = None if node is None else _plain_data(node, (), lines)
    except _BadLine as error:
        line, found, expected, remedy = error.args
        raise ConfigurationError(f'{path.name}: line {line}: found {found}; expected {expected}; '
                                 f'{remedy}') from error
    except yaml.YAMLError as error:
        # Errors of syntax have a mark; errors of single letters have a position instead.
        mark = getattr(error, 'problem_mark', None)
        line = text[:getattr(error, 'position', 0)].count('\n') if mark is None else mark.line
        reason = getattr(error, 'problem', None) or str(error).partition('\n')[0]
        raise ConfigurationError(
            f'{path.name}: line {line + 1}: found no valid YAML ({reason}); expected keys '
            'and values such as count: 3; correct the line') from error
    except RecursionError as error:
        raise ConfigurationError(
            f'{path.name}: line 1: found lists in lists without end; expected a few levels; write '
            'them out') from error
    return Document(path.name, data, lines)


def _read_text(path: Path) -> str:
    """Return the text of a file; refuse more than a million bytes."""
    max_bytes = 1_000_000
    try:
        return read_regular(path, max_bytes).decode('utf-8-sig')
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise ConfigurationError(
                f'{path.name}: line 1: found {error.strerror}; expected at most '
                f'{max_bytes:,}; name the right file') from error
        raise ConfigurationError(f'{path}: found no file that can be read ({error.strerror}); '
                                 'expected YAML or JSON; check the path') from error
    except UnicodeDecodeError as error:
        # 10 is the byte of a line end.
        raise ConfigurationError(
            f'{path.name}: line {error.object[:error.start].count(10) + 1}: found bytes that are '
            'no text; expected YAML or JSON in UTF-8; name the right file or save it as UTF-8'
            ) from error


def _plain_data(node: yaml.Node, key_path: Way, lines: dict[Way, int]) -> Any:
    """Return a YAML node as plain data; add the lines of its values to ``lines``."""
    line = node.start_mark.line + 1
    # The base loader gives one of these tags to each value without a tag in the file.
    if node.tag not in {f'tag:yaml.org,2002:{kind}' for kind in ('str', 'seq', 'map')}:
        raise _BadLine(line, f'the tag {_short_key(node.tag)}', 'a plain value', 'remove the tag')
    # The line of a value with a key is that of the key, which the caller has set.
    lines.setdefault(key_path, line)
    if isinstance(node, yaml.SequenceNode):
        return [_plain_data(item, (*key_path, k), lines) for k, item in enumerate(node.value)]
    if isinstance(node, yaml.ScalarNode):
        return _scalar_value(node)
    data: dict[str, Any] = {}
    for key, value in node.value:
        line = key.start_mark.line + 1
        if not isinstance(key, yaml.ScalarNode):
            raise _BadLine(line, 'a list or mapping as a key', 'a word',
                           'write one, such as count: 3')
        if key.value in data:
            raise _BadLine(line, f'the key {describe(key.value)} twice', 'it once',
                           'remove one of the two')
        lines[(*key_path, key.value)] = line
        data[key.value] = _plain_data(value, (*key_path, key.value), lines)
    return data


def _scalar_value(node: yaml.ScalarNode) -> Any:
    """Return the value of a YAML scalar: a text, a number, a boolean or None."""
    text = node.value
    # PyYAML sets a style for texts in quotes or blocks only.
    if node.style is not None:
        return text
    if text.lower() in YAML_CONSTANTS:
        return YAML_CONSTANTS[text.lower()]
    # Whole numbers of 300 digits still fit into a float, which ends at 1.8e308.
    if re.fullmatch(r'[-+]?(\d{1,300}(\.\d*)?|\.\d+)([eE][-+]?\d{1,2})?', text):
        return float(text) if re.search(r'[.eE]', text) else int(text)
    return text


def check(document: Document, schema: dict[str, Any]) -> None:
    """
    Check a document against a schema.

    The messages use texts of the schema: ``description`` says what is expected, and ``examples``
    what to write. Each is taken from the innermost subschema around the error that has it.
    ``remedies`` says what to do about an unknown key or about a value, by this key or value, or
    by the type of the value. An unknown key that the whole file knows belongs there.

    :param document: the data.
    :param schema: JSON Schema 2020-12 without references.
    :raises ConfigurationError: for the first error in the file, in one sentence.
    """
    errors = list(SchemaValidator(schema).iter_errors(document.data))
    if errors:
        # Of the errors in one line, the error about an unknown key comes first (False < True),
        # because this key is often a misspelt required key.
        first_error = min(errors, key=lambda error: (
            document.line(_error_key_path(error)), error.validator != 'additionalProperties'))
        raise _error_from_schema(document, schema, first_error)


def _error_key_path(error: ValidationError) -> Way:
    """Return the path to the value, or to the unknown key, that a schema error is about."""
    key_path = tuple(error.absolute_path)
    if error.validator == 'additionalProperties':
        return (*key_path, next(key for key in error.instance
                                if key not in error.schema['properties']))
    return key_path


def _error_from_schema(document: Document, schema: dict[str, Any], error: ValidationError
                       ) -> ConfigurationError:
    """Return an error of this package for an error that the schema validator has found."""
    key_path = _error_key_path(error)
    remedies = error.schema.get('remedies', {})
    if error.validator == 'additionalProperties':
        known_keys = list(error.schema['properties'])
        return document.error(key_path, f'the unknown key {describe(key_path[-1])}',
                              'one of ' + ', '.join(known_keys),
                              remedies.get(str(key_path[-1]).lower())
                              or (key_path[-1] in schema['properties'] and len(key_path) > 1
                                  and f"write it beside '{key_path[0]}'")
                              or nearest(key_path[-1], known_keys, 'remove it'))
    if error.validator == 'required':
        key = next(key for key in error.validator_value if key not in error.instance)
        missing_schema = error.schema['properties'][key]
        return document.error(key_path, f'no {key}', missing_schema['description'],
                              missing_schema.get('remedies', {}).get('[]') or
                              f'add, for example, {key}: {shown(missing_schema["examples"][0])}')
    # Only lists of a variable length get this message: the description of a list of a fixed
    # length says the length.
    if error.validator == 'maxItems' and error.schema['minItems'] < error.validator_value:
        return document.error(key_path, f'{len(error.instance)} entries',
                              f'at most {error.validator_value}', 'remove some')
    expected, remedy = _expected_and_remedy(schema, error)
    if error.validator == 'enum' and isinstance(error.instance, str):
        remedy = nearest(error.instance, error.validator_value, remedy)
    return document.error(key_path, describe(error.instance), expected,
                          remedies.get(shown(error.instance).lower())
                          or remedies.get(type(error.instance).__name__, remedy))


def _expected_and_remedy(schema: dict[str, Any], error: ValidationError) -> tuple[str, str]:
    """Return what was expected and what to write, each from the innermost subschema with it."""
    subschema: Any = schema
    key = ''
    expected = schema['description']
    # The mapping of a whole file is written without braces.
    remedy = f'write, for example, {shown(schema["examples"][0])[1:-1]}'
    path = list(error.absolute_schema_path)
    for previous_step, step in zip([None, *path], path):
        subschema = subschema[step]
        if previous_step == 'properties':
            key = step
        # The value of ``properties`` is no schema; it has a schema for each key.
        if isinstance(subschema, dict) and step != 'properties':
            expected = subschema.get('description', expected)
            if 'examples' in subschema:
                # An item of a list has no key.
                prefix = '' if step == 'items' else f'{key}: '
                remedy = f'write, for example, {prefix}{shown(subschema["examples"][0])}'
    return expected, remedy


class _Dumper(yaml.SafeDumper):
    """A YAML dumper that quotes each text that would not be read as text without quotes."""


def _represent_text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    """Return the node of a text, with quotes if it would not be read as text without them."""
    unquoted = yaml.ScalarNode('tag:yaml.org,2002:str', text)
    style = None if isinstance(_scalar_value(unquoted), str) else '"'
    return dumper.represent_scalar('tag:yaml.org,2002:str', text, style=style)


_Dumper.add_representer(str, _represent_text)


def written(data: Any, suffix: str) -> str:
    """
    Return plain data as the text of a YAML or JSON file that :func:`read_document` reads.

    :param suffix: ``.json`` for JSON, YAML for any other.
    """
    if suffix == '.json':
        return json.dumps(data, indent=1, allow_nan=False) + '\n'
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=99)


def timestamp() -> str:
    """Return the present date and time in UTC, to the second, in ISO 8601."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


def nearest(word: str, known: Collection[str], otherwise: str) -> str:
    """Return "did you mean X?" with the most similar known word; ``otherwise`` without one."""
    similar = difflib.get_close_matches(word, known, n=1, cutoff=0.5) or [
        known_word for known_word in known if word and word in known_word]
    return f'did you mean {similar[0]!r}?' if similar else otherwise


def shown(value: Any) -> str:
    """Return a value as it is written in YAML, in one line without quotes."""
    # A mapping of Python may have values that YAML has not, such as arrays.
    return json.dumps(value, default=repr).replace('"', '')


def _short_key(text: str) -> str:
    """Return a key or tag for messages, shortened if it is long or not printable."""
    return text if text.isprintable() and len(text) <= 60 else describe(text)


def describe(value: Any) -> str:
    """Return a value as text of at most 60 letters for messages."""
    if value is None:
        return 'nothing'
    text = repr(value) if isinstance(value, str) else shown(value)
    return text if len(text) <= 60 else text[:57] + '...'


def number(description: str, example: float, **limits: float) -> Schema:
    """Return the schema of a number; limits have their JSON Schema names."""
    return {'description': description, 'type': 'number', **limits, 'examples': [example]}


def whole(description: str, example: int, **limits: int) -> Schema:
    """Return the schema of a whole number; limits have their JSON Schema names."""
    return {'description': description, 'type': 'integer', **limits, 'examples': [example]}


def text(description: str, example: str, **limits: str) -> Schema:
    """Return the schema of a text; limits have their JSON Schema names."""
    return {'description': description, 'type': 'string', **limits, 'examples': [example]}


def one_of(choices: Iterable[str], example: str) -> Schema:
    """Return the schema of a text that is one of ``choices``."""
    return {'description': f'one of {", ".join(choices)}', 'enum': list(choices),
            'examples': [example]}


def array(items: Schema, least: int, most: int) -> Schema:
    """Return the schema of a list of ``least`` to ``most`` items, without a description."""
    return {'type': 'array', 'items': items, 'minItems': least, 'maxItems': most}


def one_or_two(description: str, example: Any, low: float, high: float) -> Schema:
    """Return the schema of a number from ``low`` to ``high``, or of a list of two such numbers."""
    item = {'type': 'number', 'minimum': low, 'maximum': high}
    return {'description': description, 'examples': [example], 'anyOf': [item, array(item, 2, 2)]}


def many(description: str, items: Schema, example: Any, least: int = 0, most: int = 64) -> Schema:
    """Return the schema of a list of ``least`` to ``most`` items."""
    return {'description': description, **array(items, least, most), 'examples': [example]}


def mapping(description: str, example: Any, required: tuple[str, ...] = (), **keys: Schema
            ) -> Schema:
    """Return the schema of a mapping whose only keys, and their schemas, are ``keys``."""
    return {'description': description, 'type': 'object', 'properties': keys,
            'required': list(required), 'additionalProperties': False, 'examples': [example]}
