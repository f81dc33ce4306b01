# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which files of a folder a command wrote, so that a later one replaces these and no others.

Beside its files a command leaves a record of their SHA-256. A file that is not in it, or that has
been edited since, belongs to somebody else.
"""

from collections.abc import Iterable, Sequence
import hashlib
import json
from pathlib import Path

from ocp_ros.util.files import write_atomically
from ocp_ros.util.settings import ConfigurationError

RECORD = '.ocp_written.json'


def check_own(paths: Iterable[Path], inputs: Iterable[str | Path] = (), overwrite: bool = False,
              option: str = '--out') -> None:
    """
    Refuse to write files before any work is done for them.

    :param paths: to be written.
    :param inputs: what is read for them; these are never replaced.
    :param overwrite: whether files that no command wrote may be replaced.
    :param option: which names the files.
    :raises ConfigurationError: if one of them is an input, or is not as a command wrote it.
    """
    read = [path for path in map(Path, inputs) if path.exists()]
    for path in filter(_is_there, paths):
        if any(path.exists() and path.samefile(one) for one in read):
            raise ConfigurationError(
                f'{option}: found {path}, which is an input of this command and would be '
                'replaced; expected an output that replaces no input; name another one')
        if not overwrite and not is_own(path):
            raise ConfigurationError(
                f'{option}: found {path}, which no command of ocp wrote, or which was changed '
                'later; expected a file that ocp may replace; name another one, or add '
                '--overwrite to replace this one')


def is_own(path: Path) -> bool:
    """Tell whether a file is as a command wrote it."""
    return path.is_file() and _record(path.parent).get(path.name) == _digest(path)


def note_own(paths: Iterable[str | Path]) -> None:
    """
    Write down that a command wrote some files as they are now.

    :raises OSError: if the record cannot be written.
    """
    for folder, names in _by_folder(map(Path, paths)).items():
        record = {name: digest for name, digest in _record(folder).items()
                  if _is_there(folder / name)}
        record |= {name: _digest(folder / name) for name in names}
        write_atomically(folder / RECORD, json.dumps(record, indent=1, sort_keys=True) + '\n')


def remove_own(paths: Sequence[Path]) -> list[Path]:
    """Remove what an earlier command wrote and nobody has changed; return what was removed."""
    stale = [path for path in paths if is_own(path)]
    for path in stale:
        path.unlink(missing_ok=True)
    return stale


def _by_folder(paths: Iterable[Path]) -> dict[Path, list[str]]:
    """Return the names of files by their folder."""
    folders: dict[Path, list[str]] = {}
    for path in paths:
        folders.setdefault(path.parent, []).append(path.name)
    return folders


def _is_there(path: Path) -> bool:
    """Tell whether there is something of a name, be it a link that leads nowhere."""
    return path.exists() or path.is_symlink()


def _record(folder: Path) -> dict[str, str]:
    """Read a record; one that is damaged knows of nothing."""
    try:
        record = json.loads((folder / RECORD).read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
