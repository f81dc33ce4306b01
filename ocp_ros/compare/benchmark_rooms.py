# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The rooms that planners are compared in: none of them was ever trained on."""

from pathlib import Path

from ocp_ros.scenes.s3dis import chosen_rooms, s3dis_folder, TEST_AREAS
from ocp_ros.scenes.scene import SceneError
from ocp_ros.scenes.scene_files import READERS, scans_in
from ocp_ros.scenes.scene_source import make_room

#: Points of a scan that is tried before it is compared in.
POINTS = 15000


def rooms_of_s3dis() -> list[str]:
    """
    Return the test rooms of S3DIS, none where ``S3DIS_DIR`` is not set.

    :raises SceneError: if the folder it names is not that of S3DIS.
    """
    folder = s3dis_folder()
    return [] if folder is None else [str(path.resolve()) for area in TEST_AREAS
                                      for path in chosen_rooms(folder, area)]


def rooms_in(folder: Path, scale: float = 1.0, up: str = 'z') -> list[str]:
    """
    Return the scans of a folder.

    :param scale: metres per unit of the scans.
    :param up: the axis of the scans that points up.
    :raises SceneError: if there are none, or one that cannot be used.
    """
    found = [str(path.resolve()) for path in scans_in(folder)]
    if not found:
        raise SceneError(f'{folder}: found no scans; expected files of {", ".join(READERS)}')
    for path in found:
        try:
            make_room(path, 0.0, POINTS, scale, up)
        except SceneError as error:
            raise SceneError(f'{error}; every scan in {folder} is compared: convert this file '
                             'first, or move it out') from error
    return found
