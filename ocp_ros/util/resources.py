# SPDX-License-Identifier: Apache-2.0
"""Models and configuration that come with the package, wherever it is installed."""

from pathlib import Path


def share_folders() -> list[Path]:
    """Return where the package's files may be: the ament index's share, then the source tree."""
    folders = []
    try:
        from ament_index_python.packages import get_package_share_directory
        folders.append(Path(get_package_share_directory('ocp_ros')))
    except (ImportError, LookupError, ValueError, OSError):
        # No ROS, the package is not installed in its index, or no index is set at all.
        pass
    folders.append(Path(__file__).resolve().parents[2])
    return folders


def find_model(name: str) -> Path:
    """
    Find weights by path or by the name of a model that comes with the package.

    :param name: a path, or a name such as ``default``.
    :raises FileNotFoundError: if there is none; the message lists the names there are.
    """
    if Path(name).is_file():
        return Path(name)
    known = set()
    for folder in share_folders():
        found = {path.stem: path for path in (folder / 'models').glob('*.safetensors')}
        if name in found:
            return found[name]
        known |= found.keys()
    raise FileNotFoundError(f'model: found no file {name!r} and no model of that name; expected a '
                            f'path to .safetensors or one of {sorted(known)}')


def find_config(name: str) -> Path:
    """
    Find a file of ``config/``.

    :raises FileNotFoundError: if it is not there: the package is not whole.
    """
    for folder in share_folders():
        if (folder / 'config' / name).is_file():
            return folder / 'config' / name
    raise FileNotFoundError(f'config: found no file {name!r}; expected it in one of '
                            f'{", ".join(map(str, share_folders()))}; install the package again')
