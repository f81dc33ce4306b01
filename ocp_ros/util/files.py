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

"""Files that are whole or absent, whenever the process ends, and places to write them to."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
import errno
import fcntl
import hashlib
import json
import math
import os
from pathlib import Path
import shutil
import stat
import tempfile
from typing import BinaryIO

from ocp_ros.util.settings import ConfigurationError

#: Folders in a folder of results: a set of files that is being written, one that is complete and
#: takes its place, and in that one the names of its files.
UNFINISHED, COMPLETE, NAMES = '.ocp_unfinished_', '.ocp_complete', '.names.json'
#: Bytes of a list of names.
LONGEST_LIST = 10_000
#: Bytes of what is read whole unless a reader knows better, and that are read at once.
LARGEST, PIECE = 1_000_000_000, 1 << 20


def read_regular(path: str | Path, most: int = LARGEST) -> bytes:
    """
    Read a file that should not be large; pipes and devices, which may never end, are refused.

    :param most: bytes that it may have.
    :raises OSError: if it cannot be read, is no regular file, or has more; ``EFBIG`` with the
        number of bytes for the last.
    """
    with _regular(path, most) as file:
        # Of files in /proc the size is not known before they are read.
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f'{len(content):,} bytes')
    return content


def check_regular(path: str | Path, most: int) -> None:
    """Refuse a file that :func:`read_regular` would, for a library that reads it itself."""
    with _regular(path, most):
        pass


@contextmanager
def _regular(path: str | Path, most: float) -> Iterator[BinaryIO]:
    """Open a regular file of so many bytes at most; see :func:`read_regular`."""
    if '\0' in str(path):
        raise OSError(errno.EINVAL, 'its name has a zero byte')
    with open(path, 'rb', opener=_open_at_once) as file:
        state = os.fstat(file.fileno())
        if not stat.S_ISREG(state.st_mode):
            raise OSError(errno.EINVAL, 'it is a pipe or a device, not a regular file')
        if state.st_size > most:
            raise OSError(errno.EFBIG, f'{state.st_size:,} bytes')
        yield file


def sha256_of_file(path: str | Path) -> str:
    """
    Return the SHA-256 of a file of any size.

    :raises OSError: if it cannot be read, or is a pipe or a device.
    """
    found = hashlib.sha256()
    with _regular(path, math.inf) as file:
        while piece := file.read(PIECE):
            found.update(piece)
    return found.hexdigest()


def _open_at_once(path: str, flags: int) -> int:
    """Open a file without waiting for somebody who writes to it, if it is a pipe."""
    return os.open(path, flags | os.O_NONBLOCK)


def cache_folder() -> Path | None:
    """
    Return where the package keeps what it can make again: ``OCP_ROS_CACHE``, or the user's cache.

    :returns: an absolute path, made with its folder closed to other users; None where there is
        none.
    """
    base = os.environ.get('XDG_CACHE_HOME', '')
    if not os.path.isabs(base):
        base = os.path.expanduser('~/.cache')
    folder = Path(os.environ.get('OCP_ROS_CACHE') or Path(base, 'ocp_ros'))
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    # What is relative is in a folder that somebody else may have made.
    return folder if folder.is_absolute() else None


def write_atomically(path: str | Path, content: bytes | str, private: bool = False) -> None:
    """
    Write a file so that readers find the old content or the new, never a part.

    :param path: its folder is made where it is not there.
    :param content: text is written as UTF-8; bytes of file names that are no text, as escapes.
    :param private: whether other users must not read it, whatever the umask says.
    :raises OSError: if it cannot be written; what was there before stays.
    """
    content = content.encode(errors='backslashreplace') if isinstance(content, str) else content
    with whole_or_absent(path, private) as beside:
        beside.write_bytes(content)


@contextmanager
def whole_or_absent(path: str | Path, private: bool = False) -> Iterator[Path]:
    """
    Yield a path beside a file; what is written there takes its place in the end, or never.

    :param path: its folder is made where it is not there.
    :param private: see :func:`write_atomically`.
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
        if not private:
            # Temporary files are private; what people share is as they say.
            os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException as error:
        Path(name).unlink(missing_ok=True)
        if isinstance(error, OSError):
            # That of a full disk names no file.
            error.filename = str(path)
        raise


def _umask() -> int:
    """Return which rights new files do not have; to read it, it has to be set."""
    umask = os.umask(0o077)
    os.umask(umask)
    return umask


class FileSet:
    """
    Files of a folder that belong together: written aside, and swapped in at the end.

    Use it in a ``with`` statement. Whenever the process ends, the folder has all files of the set
    or all of the one before, if not at once, then when the next run begins, see :func:`recover`.
    Where the block fails, what it has written is taken for the set, if the mark is among it.

    :param folder: it is made where it is not there.
    :param names: of all files that sets may have; those that this one has not are removed.
    :param mark: name of the file without which nothing is a set.
    :ivar aside: the folder to write to.
    :raises OSError: if nothing can be written.
    """

    def __init__(self, folder: Path, names: Collection[str], mark: str) -> None:
        self.folder, self._names, self._mark = folder, names, mark

    def __enter__(self) -> 'FileSet':
        """Make the folder to write to."""
        recover(self.folder, self._names, self._mark)
        with _locked(self.folder):
            self.aside = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=self.folder))
            #: Shows that whoever writes there lives.
            self._lock = os.open(self.aside, os.O_RDONLY)
            with suppress(OSError):
                fcntl.flock(self._lock, fcntl.LOCK_EX)
        return self

    def __exit__(self, *exception) -> None:
        """Swap the set in."""
        written = [name for name in self._names if (self.aside / name).exists()]
        try:
            if self._mark in written:
                write_atomically(self.aside / NAMES, json.dumps(written))
                with _locked(self.folder):
                    _swap_in(self.folder, self._names, self._mark)
                    self.aside.rename(self.folder / COMPLETE)
        finally:
            os.close(self._lock)
            recover(self.folder, self._names, self._mark)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Let no other process swap files of a folder, where the disk knows locks."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def recover(folder: Path, names: Collection[str], mark: str) -> None:
    """
    Finish what a killed run has begun: swap in a set that is complete, remove one that is not.

    :param names: of all files that sets may have.
    :param mark: see :class:`FileSet`.
    :raises OSError: if a complete set cannot be swapped in; it stays where it is.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder):
        _swap_in(folder, names, mark)
        for aside in folder.glob(f'{UNFINISHED}*'):
            with suppress(OSError):
                handle = os.open(aside, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(aside, ignore_errors=True)
                finally:
                    os.close(handle)


def complete_set(folder: Path, names: Collection[str], mark: str) -> list[str]:
    """Return the names of the files of a set that is to be swapped in; none without one."""
    complete = folder / COMPLETE
    try:
        kept = json.loads(read_regular(complete / NAMES, LONGEST_LIST))
        # Those that are not there any more are in the folder already.
        whole = mark in kept and set(kept) <= set(names) and all(
            (complete / name).is_file() or (folder / name).is_file() for name in kept)
    except (OSError, ValueError, TypeError, RecursionError):
        return []
    return list(kept) if whole and isinstance(kept, list) else []


def _swap_in(folder: Path, names: Collection[str], mark: str) -> None:
    """Let a complete set take the place of the one before; what is none is removed."""
    complete, kept = folder / COMPLETE, complete_set(folder, names, mark)
    for name in names if kept else ():
        if name not in kept:
            (folder / name).unlink(missing_ok=True)
        elif (complete / name).exists():
            os.replace(complete / name, folder / name)
    if complete.is_dir() and not complete.is_symlink():
        shutil.rmtree(complete, ignore_errors=True)
    else:
        complete.unlink(missing_ok=True)


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
