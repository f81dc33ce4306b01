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

"""The folder of a training run: its settings, its rooms, its evaluations."""

import json
import logging
from pathlib import Path
import sys
from typing import Any

from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.training.training_rooms import PARTS, room_names
from ocp_ros.util.files import printable, read_regular, write_atomically
from ocp_ros.util.settings import ConfigurationError, flatten, from_nested, to_nested
from ocp_ros.util.yaml_files import read_plain
import yaml

#: Files of the settings, of the names of the rooms, and of the evaluations so far.
CONFIG, ROOMS, PROGRESS = 'config.yaml', 'rooms.json', 'progress.jsonl'
#: Files of the best weights, and of the state of soft actor-critic.
BEST, STATE = 'best.safetensors', 'state.safetensors'
#: File of the transitions that soft actor-critic learns from.
REPLAY = 'replay.safetensors'
_log = logging.getLogger(__name__)


def read_config(path: Path) -> TrainingConfig:
    """
    Read a YAML file of training settings; settings that are not in it keep their defaults.

    :raises ConfigurationError: for an unknown name or a bad value.
    """
    return _config_of(read_plain(path).data, path)


def _config_of(content: Any, path: Path) -> TrainingConfig:
    """Return the settings in the parsed content of a YAML file."""
    try:
        return from_nested(TrainingConfig, {} if content is None else content, str(path))
    except ConfigurationError as error:
        # The error of contradicting settings names only their keys: add the path.
        prefix = '' if str(path) in str(error) else f'{path}: '
        raise ConfigurationError(f'{prefix}{error}') from error


def claim(folder: Path, config: TrainingConfig) -> None:
    """
    Write the settings and rooms of a run, or check that the run in the folder has the same ones.

    :raises ConfigurationError: if the folder has another run, or files of another origin.
    """
    path, rooms_path = folder / CONFIG, folder / ROOMS
    _check_name(folder)
    if not rooms_path.exists() and not path.exists():
        _refuse_unknown_files(folder)
    # Scans are compared by file name, without their folder.
    sets = {part: [Path(name).name for name in room_names(config.rooms, part)] for part in PARTS}
    asked = flatten(to_nested(config))
    saved = flatten(to_nested(_saved_config(path))) if path.exists() else asked
    may_change = ('interactions', 'workers', 'evaluate_every')
    wrong = [f'{name} {saved[name]!r}' for name in asked
             if name not in may_change and asked[name] != saved[name]
             # With a rig file, the settings of the rig have no effect, so they may differ.
             and not (config.simulation.rig_file and name.startswith('simulation.rig.'))]
    if rooms_path.exists() and _saved_room_sets(rooms_path) != sets:
        wrong.append('other rooms')
    if wrong:
        raise ConfigurationError(
            f'{folder}: found a run with {", ".join(wrong)}; expected one with the settings '
            f'asked for, but for {", ".join(may_change)}; name another folder, or remove '
            'this one to begin anew')
    if not rooms_path.exists():
        write_atomically(rooms_path, json.dumps(sets) + '\n')
    if not path.exists() or asked != saved:
        write_atomically(path, yaml.safe_dump(to_nested(config), sort_keys=False))


def _check_name(folder: Path) -> None:
    """Refuse a folder whose name is not valid UTF-8: TensorBoard cannot write to it."""
    try:
        str(folder).encode()
    except UnicodeEncodeError as error:
        raise ConfigurationError(
            f'{printable(str(folder))}: found a name that is not in UTF-8; expected one that '
            'TensorBoard can write to; name another folder') from error


def _refuse_unknown_files(folder: Path) -> None:
    """Refuse a folder without a run that has files which a run would replace."""
    found = [name for name in (BEST, 'best.json', STATE, REPLAY, PROGRESS)
             if (folder / name).exists()]
    if found:
        raise ConfigurationError(
            f'{folder}: found {", ".join(found)} and neither {CONFIG} nor {ROOMS} of a run; '
            'expected a folder without them, or that of a run; name another folder')


def _saved_config(path: Path) -> TrainingConfig:
    """Read the settings of a run; an empty file is an error."""
    try:
        content = read_plain(path).data
        if not content:
            raise ConfigurationError(f'{path}: found no settings; expected those of the run')
        return _config_of(content, path)
    except ConfigurationError as error:
        prefix = '' if str(path) in str(error) else f'{path.parent}: '
        raise ConfigurationError(
            f'{prefix}{error}; nothing of the run is lost: remove the file, and the run goes on '
            'with the settings asked for') from error


def _saved_room_sets(path: Path) -> dict[str, list[str]]:
    """Read the names of the rooms of a run: by training, validation and test set."""
    try:
        sets = json.loads(read_regular(path))
        if not isinstance(sets, dict) or sets.keys() != set(PARTS):
            raise ValueError('no sets of rooms')
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigurationError(
            f'{path}: found no list of rooms ({error}); expected those of {", ".join(PARTS)}; '
            'nothing of the run is lost: remove the file, and the run goes on with the rooms '
            'asked for') from error
    return sets


def records(folder: Path) -> list[dict[str, Any]]:
    """Read the lines of progress so far, [] without any; skip malformed lines with a warning."""
    path = folder / PROGRESS
    if not path.exists():
        return []
    lines = read_regular(path).decode(errors='replace').splitlines()
    readable = [record for line in lines if (record := _record_of(line)) is not None]
    if len(readable) < len(lines):
        _log.warning(
            '%s: found %d of %d lines that cannot be read; expected an evaluation in each; going '
            'on without them, only their figures are lost', printable(str(path)),
            len(lines) - len(readable), len(lines))
    return readable


def _record_of(line: str) -> dict[str, Any] | None:
    """Return the record in a line of progress; None if the line is malformed."""
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    names = ('interactions', 'updates', 'seconds', 'ratio')
    return (record if isinstance(record, dict)
            and all(is_count(record.get(name)) for name in names) else None)


def is_count(value: Any) -> bool:
    """Return whether a value is a finite number of 0 or more."""
    # A whole number may be too large for a float.
    return type(value) in (int, float) and 0 <= value <= sys.float_info.max


def add_record(folder: Path, record: dict[str, Any]) -> None:
    """Append a line of progress."""
    lines = [*records(folder), record]
    write_atomically(folder / PROGRESS, ''.join(json.dumps(line) + '\n' for line in lines))
