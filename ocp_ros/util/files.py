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
Write files atomically, so that they are complete or absent whenever the process ends.

Untrusted text, such as the names of files, is made safe to print.
"""

from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
import errno
import fcntl
import hashlib
import logging
import math
import os
from pathlib import Path
import shutil
import stat
import tempfile
from typing import BinaryIO

from ocp_ros.util.settings import ConfigurationError

_log = logging.getLogger(__name__)

#: The folder of a complete set that will replace the previous one.
COMPLETE_FOLDER = '.ocp_complete'
#: The folder of an unfinished set.
UNFINISHED_FOLDER = '.ocp_unfinished'
#: The default largest size in bytes of a file read at once.
MAX_BYTES = 1_000_000_000


def read_regular(path: str | Path, max_bytes: int = MAX_BYTES) -> bytes:
    """
    Read a file that should not be large; pipes and devices, which may never end, are refused.

    :raises OSError: if the file cannot be read, is not a regular file, or is larger than
        ``max_bytes``; then ``errno`` is ``EFBIG``, and ``strerror`` gives the number of bytes.
    """
    with _opened_regular(path, max_bytes) as file:
        # One byte too many shows that a file is too large: the size of a file in /proc is
        # unknown before it is read.
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise OSError(errno.EFBIG, f'{len(content):,} bytes')
    return content


def check_regular(path: str | Path, max_bytes: int) -> None:
    """Refuse a file that :func:`read_regular` refuses, before a library reads it."""
    with _opened_regular(path, max_bytes):
        pass


@contextmanager
def _opened_regular(path: str | Path, max_bytes: float) -> Iterator[BinaryIO]:
    """Yield an open regular file of at most ``max_bytes``; see :func:`read_regular`."""
    if '\0' in str(path):
        raise OSError(errno.EINVAL, 'its name has a zero byte')
    # With O_NONBLOCK, opening a pipe does not wait for its writer.
    with open(path, 'rb', opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        state = os.fstat(file.fileno())
        if not stat.S_ISREG(state.st_mode):
            raise OSError(errno.EINVAL, 'it is a pipe or a device, not a regular file')
        if state.st_size > max_bytes:
            raise OSError(errno.EFBIG, f'{state.st_size:,} bytes')
        yield file


def sha256_of_file(path: str | Path, max_bytes: float = math.inf) -> str:
    """
    Return the SHA-256 of a file.

    :returns: 64 hexadecimal digits.
    :raises OSError: see :func:`read_regular`.
    """
    with _opened_regular(path, max_bytes) as file:
        digest = hashlib.sha256()
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def cache_folder() -> Path | None:
    """
    Return the cache folder of the package: ``OCP_ROS_CACHE``, or a folder in the user's cache.

    :returns: an absolute path, created with access for this user only; None if the folder cannot
        be created, or ``OCP_ROS_CACHE`` is a relative path.
    """
    base = os.environ.get('XDG_CACHE_HOME', '')
    if not os.path.isabs(base):
        base = os.path.expanduser('~/.cache')
    folder = Path(os.environ.get('OCP_ROS_CACHE') or Path(base, 'ocp_ros'))
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    # A relative path may lie in a folder of another user.
    return folder if folder.is_absolute() else None


def write_atomically(path: str | Path, content: bytes | str, private: bool = False) -> None:
    """
    Write a file atomically: readers find all of the old content or all of the new.

    :param path: the path of the file; its folder is created if necessary.
    :param content: text is written as UTF-8; bytes of file names that are not text become escapes.
    :param private: whether other users must not read it, independently of the umask.
    :raises OSError: if the file cannot be written; the old content stays.
    """
    content = content.encode(errors='backslashreplace') if isinstance(content, str) else content
    with whole_or_absent(path, private) as temporary:
        temporary.write_bytes(content)


@contextmanager
def whole_or_absent(path: str | Path, private: bool = False) -> Iterator[Path]:
    """
    Yield the path of an empty temporary file beside a file.

    At the end of the block the temporary file replaces the file; after an error it is removed.

    :param path: the path of the file; its folder is created if necessary.
    :param private: see :func:`write_atomically`.
    :raises OSError: if the file cannot be written; the old content stays.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    os.close(handle)
    try:
        yield Path(name)
        with open(name, 'rb') as file:
            os.fsync(file.fileno())
        if not private:
            # Temporary files are private; other files follow the umask. The function that returns
            # the umask also sets it.
            umask = os.umask(0o077)
            os.umask(umask)
            os.chmod(name, 0o666 & ~umask)
        os.replace(name, path)
    except BaseException as error:
        Path(name).unlink(missing_ok=True)
        if isinstance(error, OSError):
            # The error of a full disk does not name the file.
            error.filename = str(path)
        raise


@contextmanager
def file_set(folder: Path, names: Collection[str], mark: str) -> Iterator[Path]:
    """
    Yield a folder to write a set of files to; at the end they replace the previous set.

    Whenever the process ends, ``folder`` contains all files of the new set or all files of the
    previous one, at the latest after the next run has begun. If the block fails after the file
    ``mark`` was written, the files written so far are the new set. Another process that writes a
    set to ``folder`` waits.

    :param folder: the folder of the set; it is created if necessary.
    :param names: the names of all files that a set may have. Files of the previous set that the
        new set does not have are removed.
    :param mark: the name of the file that makes a set complete: every set must have it.
    :returns: a subfolder of ``folder``, which is empty.
    :raises OSError: if nothing can be written, or if a complete set cannot replace the previous
        one; then it stays in its own folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = folder / UNFINISHED_FOLDER
    handle = os.open(folder, os.O_RDONLY)
    try:
        _lock(handle, folder)
        _swap_in(folder, names, mark)
        _remove(unfinished)
        unfinished.mkdir(mode=0o700)
        try:
            yield unfinished
        finally:
            if (unfinished / mark).exists():
                unfinished.rename(folder / COMPLETE_FOLDER)
            _swap_in(folder, names, mark)
            _remove(unfinished)
    finally:
        os.close(handle)


def _lock(handle: int, folder: Path) -> None:
    """Lock a folder, given its open handle; wait for another process that writes a set to it."""
    # Some disks do not support locks.
    with suppress(OSError):
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _log.warning('%s: found another process that writes to it; waiting for its end',
                         printable(str(folder)))
            fcntl.flock(handle, fcntl.LOCK_EX)


def _swap_in(folder: Path, names: Collection[str], mark: str) -> None:
    """Replace the previous set by the complete one, if any, which a killed run may have left."""
    complete = folder / COMPLETE_FOLDER
    if complete.is_symlink():
        complete.unlink()
    # The mark is moved first: as long as it is in its folder, all other files are there too.
    if (complete / mark).exists():
        for name in names:
            if not (complete / name).exists():
                (folder / name).unlink(missing_ok=True)
    for name in (mark, *names):
        if (complete / name).exists():
            os.replace(complete / name, folder / name)
    _remove(complete)


def _remove(path: Path) -> None:
    """Remove a folder with its files, or anything else at a path; links are not followed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files of weights and states whose writing process was killed."""
    for path in folder.glob('.*.safetensors.*'):
        path.unlink(missing_ok=True)


def file_to_write(path: Path, what: str, option: str = '--out') -> Path:
    """
    Make the folder of a file, and check that it can be written to.

    :param what: the kind of file, for the message.
    :param option: the option that names the file, for the message.
    :returns: ``path``.
    :raises ConfigurationError: if the file cannot be written.
    """
    try:
        _try_to_write(path.parent)
        if path.is_dir():
            raise IsADirectoryError(0, 'it is a folder')
    except OSError as error:
        raise ConfigurationError(
            f'{option}: found {path}, which cannot be written ({error.strerror}); expected a file '
            f'to write {what} to; name another one') from error
    return path


def folder_to_write(path: Path, option: str = '--out') -> Path:
    """
    Make a folder, and check that it can be written to.

    :param option: the option that names the folder, for the message.
    :returns: ``path``.
    :raises ConfigurationError: if nothing can be written to the folder.
    """
    try:
        if path.exists() and not path.is_dir():
            raise NotADirectoryError(0, 'it is a file')
        _try_to_write(path)
    except OSError as error:
        raise ConfigurationError(
            f'{option}: found {path}, where nothing can be written ({error.strerror}); expected a '
            'folder for what is found; name another one') from error
    return path


def _try_to_write(folder: Path) -> None:
    """Make a folder, and write a temporary file to it; raise OSError if that fails."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(b'ocp')


def printable(text: str) -> str:
    """
    Return a text as one line without terminal control or text direction characters.

    Undecodable bytes of file names, control characters and text direction characters become
    hexadecimal escapes; tabs, line ends and other blanks become spaces.
    """
    return ''.join(_printable_letter(letter) for letter in text)


def _printable_letter(letter: str) -> str:
    """Return a letter, or its replacement if it is not printable."""
    # Several scripts need these invisible characters, which join or separate letters.
    if letter.isprintable() or letter in '\u200c\u200d':
        return letter
    return ' ' if letter.isspace() else letter.encode('unicode_escape').decode('ascii')
