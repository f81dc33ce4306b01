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
The rooms of each set for training and tests: generated ones, and those of S3DIS.

No two sets of generated rooms share a room; they are frozen by seed. In each room, the best
placement of four cameras in a short search leaves at least 5 % of the mean depth error of random
placements, so that the task is neither trivial nor hopeless; longer searches leave less. The sets
contain the seeds of consecutive ranges that fulfil this condition: 128 of 310 for training, 36 of
102 for the choice of the best weights, 10 of 26 for the comparison of planners and 40 of 132 fresh
ones for paired tests. They were chosen by ``python -m benchmarks.room_sets`` on 2026-11-21.

The terms of the data set S3DIS (Armeni et al., 2016) forbid passing it on. ``S3DIS_DIR`` names the
folder it was unpacked to, ``Stanford3dDataset_v1.2``, with ``Area_1`` to ``Area_6`` in it.
"""

import os
from pathlib import Path
import re

import numpy as np
from ocp_ros.rooms.scene_source import load_cached
from ocp_ros.scenes.scene import Scene, SceneError

TRAINING = (
    1000, 1002, 1004, 1008, 1012, 1014, 1016, 1017, 1022, 1023, 1025, 1026, 1028, 1029, 1032,
    1033, 1035, 1036, 1039, 1041, 1043, 1045, 1048, 1053, 1056, 1057, 1058, 1060, 1063, 1065,
    1067, 1069, 1072, 1074, 1076, 1077, 1079, 1080, 1083, 1084, 1085, 1086, 1087, 1091, 1092,
    1093, 1096, 1098, 1100, 1101, 1104, 1111, 1113, 1115, 1116, 1119, 1122, 1125, 1126, 1130,
    1136, 1140, 1145, 1153, 1156, 1157, 1159, 1161, 1164, 1165, 1166, 1172, 1174, 1175, 1178,
    1179, 1182, 1183, 1186, 1187, 1191, 1192, 1193, 1194, 1199, 1200, 1201, 1202, 1203, 1205,
    1208, 1214, 1221, 1232, 1234, 1241, 1244, 1245, 1251, 1252, 1253, 1256, 1258, 1262, 1264,
    1266, 1267, 1269, 1270, 1271, 1272, 1274, 1276, 1279, 1280, 1281, 1282, 1285, 1291, 1295,
    1299, 1300, 1304, 1305, 1306, 1307, 1308, 1309)
VALIDATION = (
    501, 503, 505, 507, 508, 509, 511, 517, 520, 521, 523, 528, 531, 535, 537, 540, 542, 543,
    549, 550, 551, 554, 557, 559, 566, 569, 573, 574, 576, 584, 585, 588, 595, 599, 600, 601)
TEST = (
    3000, 3001, 3004, 3005, 3007, 3009, 3011, 3016, 3020, 3025)
FRESH = (
    4001, 4003, 4005, 4006, 4008, 4009, 4012, 4015, 4016, 4019, 4020, 4022, 4027, 4034, 4035,
    4037, 4043, 4044, 4053, 4059, 4061, 4062, 4069, 4078, 4079, 4080, 4081, 4095, 4103, 4106,
    4107, 4108, 4109, 4110, 4113, 4115, 4119, 4120, 4127, 4131)
#: More training rooms, not chosen by this condition.
MORE_TRAINING = range(1310, 3000)
SETS = {'fresh': FRESH, 'test': TEST, 'training': TRAINING, 'validation': VALIDATION}
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
