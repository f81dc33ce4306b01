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
Rooms of the data set S3DIS (Armeni et al., 2016), if the user has it.

The terms of the data set forbid passing it on. ``S3DIS_DIR`` names the folder it was unpacked to,
``Stanford3dDataset_v1.2``, with ``Area_1`` to ``Area_6`` in it.
"""

import os
from pathlib import Path
import re

import numpy as np
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.scenes.scene_cache import load_cached

#: The areas (storeys of buildings) whose rooms are for tests; the others are for training.
TEST_AREAS = (6,)


def s3dis_folder() -> Path | None:
    """Return the folder that ``S3DIS_DIR`` names; None if it is not set."""
    folder = os.environ.get('S3DIS_DIR')
    return Path(folder) if folder else None


def rooms_of_area(folder: Path, area: int) -> list[Path]:
    """
    List the rooms of an area.

    :param folder: the folder that contains ``Area_1`` to ``Area_6``.
    :param area: 1 to 6.
    :returns: the files of the rooms in numeric order, such as ``Area_1/office_2/office_2.txt``
        before ``Area_1/office_10/office_10.txt``.
    :raises SceneError: if there are no rooms.
    """
    # Underscores are ignored, since one room is called Area_6/copyRoom_1/copy_Room_1.txt.
    rooms = [path for path in (folder / f'Area_{area}').glob('*/*.txt')
             if path.stem.replace('_', '') == path.parent.name.replace('_', '')]
    if not rooms:
        raise SceneError(
            f'{folder}: found no rooms such as Area_{area}/office_1/office_1.txt; expected the '
            'folder that S3DIS was unpacked to; set S3DIS_DIR to Stanford3dDataset_v1.2')
    return sorted(rooms, key=lambda path: [int(part) if part.isdigit() else part
                                           for part in re.split(r'(\d+)', path.parent.name)])


def chosen_rooms(folder: Path, area: int) -> list[Path]:
    """
    Choose up to ten rooms of an area in which to compare cameras on a plane.

    The paper (arXiv 2110.11106) compares them in such rooms. A fitting room has a flat floor that
    is neither too small nor too large; a room for training also has a ceiling. Of the fitting
    rooms, those with the largest floors are chosen.

    :param folder: see :func:`rooms_of_area`.
    :param area: 1 to 6.
    :returns: the files of the rooms, the largest first.
    :raises SceneError: if the area has no rooms or a room cannot be read.
    """
    fitting_rooms = []
    for path in rooms_of_area(folder, area):
        # Rooms of these kinds have no flat floor.
        if path.parent.name.rpartition('_')[0] in ('stairs', 'auditorium'):
            continue
        scene = load_cached(path, max_points=15000)
        floor_area = float(np.prod(scene.size[:2]))
        # Square metres: four cameras roughly cover floors between these limits.
        if 20.0 <= floor_area <= 130.0 and (area in TEST_AREAS or is_closed(scene)):
            fitting_rooms.append((-floor_area, path))
    return [path for _, path in sorted(fitting_rooms)[:10]]


def is_closed(scene: Scene) -> bool:
    """Return whether a room has a ceiling above at least 90 % of its floor."""
    points, (low, high) = scene.points, scene.bounds
    # Cells of a plan with edges of 0.25 m.
    cells = np.floor((points[:, :2] - low[:2]) / 0.25).astype(np.int64)
    # Points within 0.3 m of the lowest point belong to the floor, and points more than 0.5 m above
    # half the height to the ceiling.
    floor_cells = {tuple(cell) for cell in cells[points[:, 2] < low[2] + 0.3]}
    ceiling_cells = {tuple(cell) for cell in cells[points[:, 2] > 0.5 * (low[2] + high[2]) + 0.5]}
    return len(floor_cells & ceiling_cells) >= 0.9 * max(len(floor_cells), 1)
