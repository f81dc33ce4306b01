# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or absent, whenever the process ends, and places to write them to."""

import os
from pathlib import Path
import tempfile

from ocp_ros.util.settings import ConfigurationError


def write_atomically(path: str | Path, content: bytes | str) -> None:
    """
    Write a file so that readers find the old content or the new, never a part.

    :param path: its folder is made where it is not there.
    :param content: text is written as UTF-8; bytes of file names that are no text, as escapes.
    :raises OSError: if it cannot be written; what was there before stays.
    """
    path = Path(path)
    content = content.encode(errors='backslashreplace') if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(handle, 'wb') as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        # Temporary files are private; what people share is not.
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException as error:
        Path(name).unlink(missing_ok=True)
        if isinstance(error, OSError):
            # That of a full disk names no file.
            error.filename = str(path)
        raise


def file_to_write(path: Path, what: str, option: str = '--out') -> Path:
    """
    Make the folder of a file, and try whether it can be written to.

    :param what: the file is, for the message.
    :param option: which names it.
    :raises ConfigurationError: if it cannot be written.
    """
    try:
        _try_folder(path.parent)
        if path.is_dir():
            raise IsADirectoryError(0, 'it is a folder')
    except OSError as error:
        raise ConfigurationError(
            f'{option}: found {path}, which cannot be written ({error.strerror}); expected a file '
            f'to write {what} to; name another one') from error
    return path


def folder_to_write(path: Path, option: str = '--out') -> Path:
    """
    Make a folder, and try whether it can be written to.

    :param option: which names it.
    :raises ConfigurationError: if it cannot be.
    """
    try:
        if path.exists() and not path.is_dir():
            raise NotADirectoryError(0, 'it is a file')
        _try_folder(path)
    except OSError as error:
        raise ConfigurationError(
            f'{option}: found {path}, where nothing can be written ({error.strerror}); expected a '
            'folder for what is found; name another one') from error
    return path


def _try_folder(path: Path) -> None:
    """Make a folder, and write a file to it that goes again."""
    path.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=path) as file:
        file.write(b'ocp')
