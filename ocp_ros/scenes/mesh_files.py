# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Meshes, read with Open3D: points on their faces stand for the room."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ocp_ros.scenes.guarded_reading import read_guarded, ReadingLimits, WORDS
from ocp_ros.scenes.mesh_sampling import SAMPLES

#: Formats of meshes. PLY files are meshes where they have faces.
MESHES = ('.glb', '.gltf', '.obj', '.off', '.stl')
#: Bytes of memory that reading takes: with any file, and for each byte of it.
MEMORY, MEMORY_PER_BYTE = 700_000_000, 40
#: Seconds of all cores: with any file, and for each million bytes.
SECONDS, SECONDS_PER_MB = 20, 4
#: Bytes of a point and its normal. A face with NaN gives one more point, and takes a byte or more.
ROW = 48


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """
    Read a mesh as points that lie evenly on its faces, as dense as those of a good scan.

    All parts of a scene graph are placed as it says; textures do not matter. Open3D runs in a
    process of its own, which takes about two seconds.

    :returns: (N, 3) points and (N, 3) normals, float64, in the file's unit and axes; see
        :func:`~ocp_ros.scenes.mesh_sampling.sampled`.
    :raises ValueError: if the file is broken or has no faces.
    :raises ImportError: if there is no Open3D.
    """
    if not find_spec('open3d'):
        raise ImportError('open3d; pip install open3d')
    size = path.stat().st_size
    limits = ReadingLimits(MEMORY + MEMORY_PER_BYTE * size,
                           SECONDS + SECONDS_PER_MB * size // 1_000_000,
                           ROW * (SAMPLES + size) + WORDS)
    rows = read_guarded('mesh', path, 6, limits)
    return rows[:, :3], rows[:, 3:]
