# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or absent, whenever the process ends, and places to write them to."""

from collections.abc import Iterator
from contextlib import contextmanager
import errno
import os
from pathlib import Path
import stat
import tempfile

from ocp_ros.util.settings import ConfigurationError


def read_regular(path: str | Path, most: int) -> bytes:
    """
    Read a file that should not be large; pipes and devices, which may never end, are refused.

    :param most: bytes that it may have.
    :raises OSError: if it cannot be read, is no regular file, or has more; ``EFBIG`` with the
        number of bytes for the last.
    """
    with open(path, 'rb', opener=_open_at_once) as file:
        state = os.fstat(file.fileno())
        if not stat.S_ISREG(state.st_mode):
            raise OSError(errno.EINVAL, 'it is a pipe or a device, not a regular file')
        # Of files in /proc the size is not known before they are read.
        content = file.read(most + 1) if state.st_size <= most else b''
    size = max(state.st_size, len(content))
    if size > most:
        raise OSError(errno.EFBIG, f'{size:,} bytes')
    return content


def _open_at_once(path: str, flags: int) -> int:
    """Open a file without waiting for somebody who writes to it, if it is a pipe."""
    return os.open(path, flags | os.O_NONBLOCK)


def write_atomically(path: str | Path, content: bytes | str) -> None:
    """
    Write a file so that readers find the old content or the new, never a part.

    :param path: its folder is made where it is not there.
    :param content: text is written as UTF-8; bytes of file names that are no text, as escapes.
    :raises OSError: if it cannot be written; what was there before stays.
    """
    content = content.encode(errors='backslashreplace') if isinstance(content, str) else content
    with whole_or_absent(path) as beside:
        beside.write_bytes(content)


@contextmanager
def whole_or_absent(path: str | Path) -> Iterator[Path]:
    """
    Yield a path beside a file; what is written there takes its place in the end, or never.

    :param path: its folder is made where it is not there.
    :raises OSError: if it cannot be written; what was there before stays.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    os.close(handle)
    try:
        yield Path(name)
        with open(name, 'rb') as file:
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


def remove_unfinished(folder: Path) -> None:
    """Remove the weights and states of which a process was killed while it wrote them."""
    for path in folder.glob('.*.safetensors.*'):
        path.unlink(missing_ok=True)


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
