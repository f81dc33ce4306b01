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

"""Files of the studio, all in the folder that the command was given."""

from collections.abc import Sequence
from pathlib import Path
import re

import numpy as np
from ocp_ros.formats.exported import Exported
from ocp_ros.formats.exports import export_to, formats_named
from ocp_ros.report.assessment import assess
from ocp_ros.rig.placement_file import load_placement, Placement, save_placement
from ocp_ros.rig.rig_file import load_rig, Rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.util.files import folder_to_write, write_atomically
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.yaml_files import written


class Folder:
    """
    The folder for files of the studio; no file name leads out of this folder.

    :param path: of the folder, which is created.
    :param formats: formats of exported placements.
    """

    def __init__(self, path: Path, formats: Sequence[str] = ('default',)) -> None:
        self._formats = formats_named(formats, '--export')
        self.path = folder_to_write(path).resolve()
        #: Files and folders that this studio has read or written, which it may replace.
        self._replaceable_paths: set[Path] = set()

    def file_names(self) -> list[str]:
        """Return the names of the files that can be loaded."""
        return sorted(path.name for path in self.path.iterdir()
                      if path.suffix in ('.yaml', '.yml', '.json') and path.is_file()
                      and not path.is_symlink() and not path.name.startswith('.'))

    def claim_path(self, name: str, suffix: str = '.yaml') -> Path:
        """
        Return the path of a file or folder to write; this studio may replace it from now on.

        :param name: without suffix.
        :param suffix: of a file; empty for a folder.
        :raises ConfigurationError: if the name is not 1 to 60 letters, digits, _ and -, the first
            one not -, or if the path exists and this studio has neither written nor read it.
        """
        # A path, the name of a hidden file and special characters are refused.
        if not re.fullmatch(r'[A-Za-z0-9_][A-Za-z0-9_-]{0,59}', name, re.ASCII):
            raise ConfigurationError(f'name: found {name[:80]!r}; expected 1 to 60 letters, '
                                     'digits, _ and -; correct it')
        path = self.path / f'{name}{suffix}'
        if path.is_symlink() or (path.exists() and path not in self._replaceable_paths):
            raise ConfigurationError(f'name: found {path.name}, which exists already; expected a '
                                     'new name; choose another, or load it first')
        self._replaceable_paths.add(path)
        return path

    def save_placement(self, name: str, placement: Placement) -> Path:
        """Write the placement file with this name, and return its path."""
        path = self.claim_path(name)
        save_placement(path, placement)
        return path

    def save_rig(self, name: str, rig: Rig) -> Path:
        """Write the rig file with this name, and return its path."""
        path = self.claim_path(name)
        write_atomically(path, written(rig.document.data, '.yaml'))
        return path

    def load(self, name: str, scene: Scene) -> tuple[Rig, np.ndarray | None]:
        """
        Read a placement or a rig of this folder.

        :param name: one of :meth:`file_names`.
        :param scene: the room of the studio.
        :returns: the rig, and the poses of its K cameras: (K, 6) metres, map frame, and radians;
            None in place of the poses if the file is a rig file.
        :raises ConfigurationError: if the file is neither a placement nor a rig file.
        """
        if name not in self.file_names():
            raise ConfigurationError('load: found a name that is no file of this folder; expected '
                                     'one of the list; choose one')
        path = self.path / name
        self._replaceable_paths.add(path)
        try:
            placement = load_placement(path)
        except ConfigurationError as error:
            try:
                return load_rig(path), None
            except ConfigurationError:
                # A file that is neither is reported as a placement.
                raise error from None
        return placement.rig_in(scene), placement.poses

    def export(self, name: str, scene: Scene, placement: Placement, command: str) -> list[str]:
        """
        Write a placement in all formats, as ``ocp plan`` does, to a new folder.

        :param name: of the folder.
        :param scene: the room of the studio.
        :param command: the command line, for the record in the placement file.
        :returns: the names of the files.
        :raises ConfigurationError: if a format cannot contain the placement.
        """
        assessment = assess(scene, placement, placement.room, command)
        folder = folder_to_write(self.claim_path(name, ''))
        found = export_to(folder, Exported(assessment.placement, assessed=assessment),
                          self._formats)
        if 'error' in found:
            raise ConfigurationError(found['error'])
        return [Path(path).name for path in found['written']]
