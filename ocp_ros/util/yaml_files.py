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

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime, timezone
import difflib
import errno
import json
from os import PathLike
from pathlib import Path
import re
from typing import Any

from jsonschema import Draft202012Validator, ValidationError
from jsonschema.validators import extend
from ocp_ros.util.files import read_regular
from ocp_ros.util.settings import ConfigurationError
import yaml


def _matches(_, pattern: str, value: Any, __) -> Iterator[ValidationError]:
    """Match a whole text with a pattern, since Python's ``$`` also matches before a line's end."""
    if isinstance(value, str) and not re.fullmatch(pattern, value):
        yield ValidationError(f'{value!r} does not match {pattern!r}')


#: JSON Schema accepts 3.0 as an integer; code that counts with the value does not.
Validator = extend(
    Draft202012Validator, {'pattern': _matches},
    type_checker=Draft202012Validator.TYPE_CHECKER.redefine(
        'integer', lambda _, value: isinstance(value, int) and not isinstance(value, bool)))
#: The path to a value: keys and indices of lists.
Way = tuple[str | int, ...]
Schema = dict[str, Any]
PLAIN_WORDS = {'': None, '~': None, 'null': None, 'true': True, 'false': False}


@dataclass(frozen=True)
class Document:
    """
    Plain data with the line of each value.

    :ivar name: its name in messages: the name of its file.
    :ivar data: mappings, lists, texts, numbers, booleans and None.
    :ivar lines: the line of each value, from 1; empty without a file.
    :ivar written: the paths in the file of the values that the data were made from.
    """

    name: str
    data: Any
    lines: dict[Way, int] = field(default_factory=dict, repr=False)
    written: dict[Way, Way] = field(default_factory=dict, repr=False)

    def where(self, *way: str | int) -> str:
        """Return the file, the line and the key of a value, such as ``a.yaml: line 3, b[0].c``."""
        way = self.written.get(way, way)
        key = ''.join(f'[{step}]' if isinstance(step, int) else f'.{_word(step)}' for step in way)
        place = [f'line {self.line(way)}'] if self.lines else []
        return f'{self.name}: ' + ', '.join([*place, *filter(None, [key.lstrip('.')])])

    def line(self, way: Way) -> int:
        """Return the line of a value, or of the nearest one around it."""
        while way and way not in self.lines:
            way = way[:-1]
        return self.lines.get(way, 1)

    def error(self, way: Way, found: str, expected: str, remedy: str) -> ConfigurationError:
        """Return the error, in one sentence, about an unusable value."""
        return ConfigurationError(
            f'{self.where(*way)}: found {found}; expected {expected}; {remedy}')

    def value(self, *way: str | int) -> Any:
        """Return a value."""
        data = self.data
        for step in way:
            data = data[step]
        return data

    def part(self, *way: str | int) -> 'Document':
        """Return a value as a separate document that keeps its lines."""
        lines = {other[len(way):]: line for other, line in self.lines.items()
                 if other[:len(way)] == way}
        return Document(self.name, self.value(*way), lines)


class _Refused(Exception):
    """Report what was found at a line of a file, what was expected, and what to do."""


class _Loader(yaml.BaseLoader):
    """A loader that limits the number of nodes and refuses aliases."""

    nodes = 0

    def compose_node(self, parent: yaml.Node, index: Any) -> yaml.Node:
        """Refuse too many nodes and aliases."""
        self.nodes += 1
        line = self.peek_event().start_mark.line + 1
        max_nodes = 20_000
        if self.nodes > max_nodes:
            raise _Refused(line, f'more than {max_nodes:,} keys and values', 'fewer',
                           'name the right file')
        if self.check_event(yaml.AliasEvent):
            raise _Refused(line, 'an alias', 'each value where it belongs',
                           'write it out in place of *')
        return super().compose_node(parent, index)


def read_document(path: str | Path, schema: dict[str, Any]) -> Document:
    """
    Read a YAML or JSON file.

    :param path: the path of the file, in UTF-8.
    :param schema: its schema, JSON Schema 2020-12; see :func:`check`.
    :raises ConfigurationError: if it cannot be read or is invalid, in one sentence.
    """
    document = read_plain(path)
    if document.data is None:
        raise ConfigurationError(f'{document.name}: line 1: found an empty file; expected '
                                 f'{schema["description"]}; write it, or name another file')
    check(document, schema)
    return document


def read_plain(path: str | Path) -> Document:
    """
    Read a YAML or JSON file of any content.

    :param path: the path of the file, in UTF-8.
    :returns: its data; None if it is empty.
    :raises ConfigurationError: if it cannot be read, in one sentence.
    """
    if not isinstance(path, (str, PathLike)):
        raise ConfigurationError(f'path: found {type(path).__name__}; expected the path of a YAML '
                                 'or JSON file')
    path = Path(path)
    lines: dict[Way, int] = {}
    text = _text(path)
    try:
        node = yaml.compose(text, Loader=_Loader)
        data = None if node is None else _plain(node, (), lines)
    except _Refused as error:
        line, found, expected, remedy = error.args
        raise ConfigurationError(f'{path.name}: line {line}: found {found}; expected {expected}; '
                                 f'{remedy}') from error
    except yaml.YAMLError as error:
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


def _text(path: Path) -> str:
    """Read a file that should be text of a reasonable length."""
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
        raise ConfigurationError(
            f'{path.name}: line {error.object[:error.start].count(10) + 1}: found bytes that are '
            'no text; expected YAML or JSON in UTF-8; name the right file or save it as UTF-8'
            ) from error


def _plain(node: yaml.Node, way: Way, lines: dict[Way, int]) -> Any:
    """Convert a YAML node to plain data and record its lines."""
    line = node.start_mark.line + 1
    if node.tag not in {f'tag:yaml.org,2002:{kind}' for kind in ('str', 'seq', 'map')}:
        raise _Refused(line, f'the tag {_word(node.tag)}', 'a plain value', 'remove the tag')
    lines.setdefault(way, line)
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, (*way, k), lines) for k, item in enumerate(node.value)]
    if isinstance(node, yaml.ScalarNode):
        return _scalar(node)
    data: dict[str, Any] = {}
    for key, value in node.value:
        line = key.start_mark.line + 1
        if not isinstance(key, yaml.ScalarNode):
            raise _Refused(line, 'a list or mapping as a key', 'a word',
                           'write one, such as count: 3')
        if key.value in data:
            raise _Refused(line, f'the key {describe(key.value)} twice', 'it once',
                           'remove one of the two')
        lines[(*way, key.value)] = line
        data[key.value] = _plain(value, (*way, key.value), lines)
    return data


def _scalar(node: yaml.ScalarNode) -> Any:
    """Return a text, a number, a boolean or None."""
    text = node.value
    if node.style is not None:
        return text
    if text.lower() in PLAIN_WORDS:
        return PLAIN_WORDS[text.lower()]
    if re.fullmatch(r'[-+]?(\d{1,300}(\.\d*)?|\.\d+)([eE][-+]?\d{1,2})?', text):
        return float(text) if re.search(r'[.eE]', text) else int(text)
    return text


def check(document: Document, schema: dict[str, Any]) -> None:
    """
    Check a document against a schema.

    The messages use the schema's own words: ``description`` says what is expected and ``examples``
    what to write, both from the innermost part that has them.

    :param document: the data.
    :param schema: JSON Schema 2020-12 without references.
    :raises ConfigurationError: for the first error in the file, in one sentence.
    """
    errors = list(Validator(schema).iter_errors(document.data))
    if errors:
        # An unknown key is often a misspelt required key.
        first = min(errors, key=lambda error: (document.line(_way(error)),
                                               error.validator != 'additionalProperties'))
        raise _refused(document, schema, first)


def _way(error: ValidationError) -> Way:
    """Return the path of the value of a schema error."""
    way = tuple(error.absolute_path)
    if error.validator == 'additionalProperties':
        return (*way, next(key for key in error.instance if key not in error.schema['properties']))
    return way


def _refused(document: Document, schema: dict[str, Any], error: ValidationError
             ) -> ConfigurationError:
    """Return the error of the package for an error of the schema."""
    way, part = _way(error), error.schema
    if error.validator == 'additionalProperties':
        known = list(part['properties'])
        return document.error(way, f'the unknown key {describe(way[-1])}',
                              'one of ' + ', '.join(known),
                              nearest(way[-1], known, 'remove it'))
    if error.validator == 'required':
        key = next(key for key in error.validator_value if key not in error.instance)
        needed = part['properties'][key]
        return document.error(way, f'no {key}', needed['description'],
                              f'add, for example, {key}: {shown(needed["examples"][0])}')
    if error.validator == 'maxItems' and part['minItems'] < error.validator_value:
        return document.error(way, f'{len(error.instance)} entries',
                              f'at most {error.validator_value}', 'remove some')
    expected, remedy = _words(schema, error)
    if error.validator == 'enum' and isinstance(error.instance, str):
        remedy = nearest(error.instance, error.validator_value, remedy)
    return document.error(way, describe(error.instance), expected, remedy)


def _words(schema: dict[str, Any], error: ValidationError) -> tuple[str, str]:
    """Return what was expected and what to write, from the innermost parts with these texts."""
    part: Any = schema
    key, expected = '', schema['description']
    remedy = f'write, for example, {shown(schema["examples"][0])[1:-1]}'
    path = list(error.absolute_schema_path)
    for before, step in zip([None, *path], path):
        part = part[step]
        if before == 'properties':
            key = step
        if isinstance(part, dict) and step != 'properties':
            expected = part.get('description', expected)
            if 'examples' in part:
                # An item of a list has no key.
                named = '' if step == 'items' else f'{key}: '
                remedy = f'write, for example, {named}{shown(part["examples"][0])}'
    return expected, remedy


class _Dumper(yaml.SafeDumper):
    """A YAML dumper that quotes each text that would not be read as text without quotes."""


def _represent_text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    """Return the node of a text, quoted if necessary."""
    plain = yaml.ScalarNode('tag:yaml.org,2002:str', text)
    style = None if isinstance(_scalar(plain), str) else '"'
    return dumper.represent_scalar('tag:yaml.org,2002:str', text, style=style)


_Dumper.add_representer(str, _represent_text)


def written(data: Any, suffix: str) -> str:
    """
    Return plain data as the text of a file for :func:`read_document`.

    :param suffix: ``.json`` for JSON, YAML for any other.
    """
    if suffix == '.json':
        return json.dumps(data, indent=1, allow_nan=False) + '\n'
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=99)


def timestamp() -> str:
    """Return the date and the time in UTC, to the second, for files of results."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


def nearest(word: str, known, otherwise: str) -> str:
    """Return a question for the most similar known word, or another text if there is none."""
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5) or [
        other for other in known if word and word in other]
    return f'did you mean {near[0]!r}?' if near else otherwise


def shown(value: Any) -> str:
    """Return a value as it is written in YAML."""
    return json.dumps(value).replace('"', '')


def _word(text: str) -> str:
    """Return a key or tag as short text in one line for messages."""
    return text if text.isprintable() and len(text) <= 60 else describe(text)


def describe(value: Any) -> str:
    """Return a value as short text for messages."""
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
    """Return the schema of one of some words."""
    return {'description': f'one of {", ".join(choices)}', 'enum': list(choices),
            'examples': [example]}


def array(items: Schema, least: int, most: int) -> Schema:
    """Return the schema of a list without a description."""
    return {'type': 'array', 'items': items, 'minItems': least, 'maxItems': most}


def one_or_two(description: str, example: Any, low: float, high: float) -> Schema:
    """Return the schema of a number or of the lowest and highest of a range."""
    one = {'type': 'number', 'minimum': low, 'maximum': high}
    return {'description': description, 'examples': [example], 'anyOf': [one, array(one, 2, 2)]}


def many(description: str, items: Schema, example: Any, least: int = 0, most: int = 64) -> Schema:
    """Return the schema of a list."""
    return {'description': description, **array(items, least, most), 'examples': [example]}


def mapping(description: str, example: Any, required: tuple[str, ...] = (), **keys: Schema
            ) -> Schema:
    """Return the schema of a mapping without other keys."""
    return {'description': description, 'type': 'object', 'properties': keys,
            'required': list(required), 'additionalProperties': False, 'examples': [example]}
