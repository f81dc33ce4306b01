# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or absent, whenever the process ends."""

import os
from pathlib import Path
import tempfile


def write_atomically(path: str | Path, content: bytes | str) -> None:
    """
    Write a file so that readers find the old content or the new, never a part.

    :param path: its folder is made where it is not there.
    :param content: text is written as UTF-8.
    :raises OSError: if it cannot be written; what was there before stays.
    """
    path, content = Path(path), content.encode() if isinstance(content, str) else content
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
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
