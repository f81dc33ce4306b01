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
The rooms of a run: generated ones, those of S3DIS or a folder of scans, in three sets.

The policy learns in the training rooms. The validation rooms select the best weights, and the test
rooms are used only for the reported results. The set of a scan depends on its content, so that it
does not change when the file is renamed or scans are added, if there are enough scans for all
three sets.
"""

from ocp_ros.rooms.room_sets import (
    chosen_rooms,
    MORE_TRAINING,
    s3dis_folder,
    TEST,
    TEST_AREAS,
    TRAINING,
    VALIDATION,
)
from ocp_ros.scenes.scene import SceneError
from ocp_ros.scenes.scene_files import READERS, scans_in
from ocp_ros.training.training_config import RoomsConfig
from ocp_ros.util.files import sha256_of_file
from ocp_ros.util.settings import ConfigurationError

#: The three sets of rooms.
PARTS = ('training', 'validation', 'test')


def room_names(config: RoomsConfig, part: str) -> list[str]:
    """
    Return the names of the rooms of a set for :func:`~ocp_ros.rooms.scene_source.make_room`.

    :param config: source and number of the rooms.
    :param part: ``training``, ``validation`` or ``test``.
    :raises ConfigurationError: if the set has no rooms.
    :raises SceneError: if S3DIS or a folder cannot be read.
    """
    if config.source == 's3dis':
        names = _s3dis_paths(part)
    elif config.source == 'folder':
        names = _scan_paths(config.folder, part)
    else:
        seeds = {'training': (*TRAINING, *MORE_TRAINING), 'validation': VALIDATION, 'test': TEST}
        names = [str(seed) for seed in seeds[part]]
    # The settings ``training``, ``validation`` and ``test`` are largest numbers of rooms.
    names = names[:getattr(config, part)]
    if not names:
        raise ConfigurationError(f'rooms: found no {part} rooms; expected at least one; '
                                 'choose another rooms.source or add scans')
    return names


def _s3dis_paths(part: str) -> list[str]:
    """Return the paths of the S3DIS rooms of a set."""
    folder = s3dis_folder()
    if folder is None:
        raise SceneError('rooms.source: found s3dis but no S3DIS_DIR; expected the folder that '
                         'it was unpacked to; set S3DIS_DIR to Stanford3dDataset_v1.2')
    areas = {'training': (1, 2, 3, 4), 'validation': (5,), 'test': TEST_AREAS}[part]
    return [str(path.resolve()) for area in areas for path in chosen_rooms(folder, area)]


def _scan_paths(folder: str, part: str) -> list[str]:
    """
    Return the paths of the scans of a set, sorted by the hashes of their contents.

    About a tenth each is for validation and for test, the rest for training. If a set would be
    empty, the first scan goes to test, the second to validation, and the rest to training.
    """
    scans = scans_in(folder)
    if len(scans) < len(PARTS):
        raise SceneError(f'{folder}: found {len(scans)} scans; expected at least {len(PARTS)}, '
                         f'one for each set, of {", ".join(READERS)}')
    # Scans with equal contents have one hash and count as one.
    paths = dict(sorted({sha256_of_file(path): path for path in scans}.items()))
    parts = [_part_of(digest) for digest in paths]
    if set(parts) != set(PARTS):
        parts = ['test', 'validation', *['training'] * (len(paths) - 2)]
    return [str(path.resolve()) for path, path_part in zip(paths.values(), parts)
            if path_part == part]


def _part_of(digest: str) -> str:
    """Return the set of a scan, given the hexadecimal hash of its content."""
    share = int(digest[:8], 16) / 16 ** 8
    return 'test' if share < 0.1 else 'validation' if share < 0.2 else 'training'
