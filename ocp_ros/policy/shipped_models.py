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

"""The trained models that come with the package, and which of them is the default."""

from pathlib import Path

from ocp_ros.util.resources import share_folder

#: Name of the default model.
DEFAULT_MODEL = 'actor'


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
