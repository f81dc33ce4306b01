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
Find the models and configuration files that come with the package.

They are in one folder: the source tree, or ``share/ocp_ros`` if the package is installed.
"""

from collections.abc import Iterator
from pathlib import Path

#: Name of the default model.
DEFAULT_MODEL = 'actor'


def share_folder() -> Path:
    """
    Return the folder with ``models`` and ``config``.

    The folder of the running code comes first, so that both have the same version: the source
    tree, or the nearest ``share/ocp_ros`` above the package, as pip (in a virtual environment,
    ``--user``, ``--prefix`` or ``--target``), colcon and Debian install it. Then the folder in the
    index of ROS packages is tried.

    :raises FileNotFoundError: if there is no such folder: the package is incomplete.
    """
    # Only the folder of this package contains ``fastdds_local.xml``.
    for folder in _candidate_folders():
        if (folder / 'config' / 'fastdds_local.xml').is_file():
            return folder
    raise FileNotFoundError(
        f'ocp_ros: found no folder share/ocp_ros above {Path(__file__).parents[1]}; expected one '
        'with the models and the configuration of the package; install the package again')


def _candidate_folders() -> Iterator[Path]:
    """Yield paths that may be the folder with ``models`` and ``config``, the most likely first."""
    # Some installers link to files elsewhere, without the rest of the prefix.
    for file in (Path(__file__).absolute(), Path(__file__).resolve()):
        # The folder around the package is the source tree or site-packages. The folders above
        # site-packages are python3.x, lib, and the installation prefix.
        parents = file.parents[2:6]
        yield parents[0]
        yield from (folder / 'share' / 'ocp_ros' for folder in parents)
    try:
        from ament_index_python.packages import get_package_share_directory
        yield Path(get_package_share_directory('ocp_ros'))
    except (ImportError, LookupError, ValueError, OSError):
        # No ROS, the package is not installed in its index, or no index is set at all.
        return


def find_config(path: str | Path) -> Path:
    """
    Find a file by its path or, if it does not exist, among those of the package.

    :param path: such as ``config/train/actor.yaml``.
    :returns: the path of the file that was found; ``path`` itself if there is none, so that the
        reader of the file reports the error.
    """
    path = Path(path)
    if path.exists():
        return path
    packaged_file = share_folder() / path
    return packaged_file if packaged_file.is_file() else path


def find_model(name: str) -> Path:
    """
    Return the path of a weights file, given its path or the name of a shipped model.

    :param name: a path, or a name such as ``actor``.
    :raises FileNotFoundError: if there is no such file; the message lists the shipped models.
    """
    shipped = {path.stem: path for path in (share_folder() / 'models').glob('*.safetensors')}
    # A file in the current folder must not hide a model of the package.
    if name in shipped:
        return shipped[name]
    if Path(name).is_file():
        return Path(name)
    raise FileNotFoundError(f'model: found no file {name!r} and no model of that name; expected a '
                            f'path to .safetensors or one of {sorted(shipped)}')
