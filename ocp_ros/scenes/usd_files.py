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
Rooms from USD stages (usd-core).

:func:`usd_rows` runs in the separate process of :mod:`ocp_ros.scenes.guarded_reading`, and yields
rows as the functions of :mod:`ocp_ros.scenes.building_files` do. A matrix of USD is one of row
vectors.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from ocp_ros.scenes.building_files import frame_row, triangles_of
from ocp_ros.scenes.measured_room import box_faces

#: Number of straight parts that stand for a circle.
CIRCLE_PARTS = 24


def usd_rows(path: str) -> Iterator[np.ndarray]:
    """
    Yield the visible solids of a USD stage: a row of its frame, and triangles.

    What moves is where it is at the earliest time.
    """
    from pxr import Usd, UsdGeom
    stage = Usd.Stage.Open(path)
    if errors := stage.GetCompositionErrors():
        raise ValueError(f'found a part that cannot be read ({str(errors[0])[:120]}); expected '
                         'files in the folder of the stage; copy them there')
    yield frame_row(UsdGeom.GetStageMetersPerUnit(stage),
                    'xyz'.index(UsdGeom.GetStageUpAxis(stage).lower()))
    transforms = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    for corners, matrix in _solids(stage.GetPseudoRoot(), transforms):
        yield (corners.reshape(-1, 3) @ matrix[:3, :3] + matrix[3, :3]).reshape(-1, 9)


def _solids(root: Any, transforms: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """
    Yield the visible solids below a prim: triangles (T, 3, 3), and a matrix (4, 4) to the stage.

    :param transforms: the cache of the transforms, at the time of the stage.
    """
    from pxr import Usd, UsdGeom
    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in prims:
        image = UsdGeom.Imageable(prim)
        if not image or image.ComputePurpose() in ('guide', 'proxy') or (
                image.ComputeVisibility(transforms.GetTime()) == 'invisible'):
            continue
        matrix = np.array(transforms.GetLocalToWorldTransform(prim))
        if prim.IsA(UsdGeom.PointInstancer):
            # Its prototypes are only visible where it puts them.
            prims.PruneChildren()
            for corners, place in _instances(UsdGeom.PointInstancer(prim), transforms):
                yield corners, place @ matrix
        elif (corners := _corners_of(prim, transforms.GetTime())) is not None:
            yield corners, matrix


def _instances(instancer: Any, transforms: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the solids of a point instancer: triangles (T, 3, 3), and a matrix (4, 4) to it."""
    time, stage = transforms.GetTime(), instancer.GetPrim().GetStage()
    places = np.array(instancer.ComputeInstanceTransformsAtTime(
        time, time, instancer.IncludeProtoXform, instancer.IgnoreMask)).reshape(-1, 4, 4)
    indices = np.array(instancer.GetProtoIndicesAttr().Get(time) or [], dtype=np.int64)
    shown = np.array(instancer.ComputeMaskAtTime(time) or np.ones(len(indices)), dtype=bool)
    for number, path in enumerate(instancer.GetPrototypesRel().GetForwardedTargets()):
        prototype = stage.GetPrimAtPath(path)
        to_prototype = np.linalg.inv(np.array(transforms.GetLocalToWorldTransform(prototype)))
        for corners, matrix in _solids(prototype, transforms):
            for place in places[(indices == number) & shown]:
                yield corners, matrix @ to_prototype @ place


def _corners_of(prim: Any, time: Any) -> np.ndarray | None:
    """Return the triangles (T, 3, 3) of a mesh or a simple solid; None for other prims."""
    from pxr import UsdGeom

    def value(name: str) -> Any:
        """Return an attribute at the time of the stage."""
        return prim.GetAttribute(name).Get(time)

    if prim.IsA(UsdGeom.Mesh):
        return _polygons(*(np.array(value(name) or [], dtype=kind) for name, kind in (
            ('points', np.float64), ('faceVertexCounts', np.int64),
            ('faceVertexIndices', np.int64))))
    if prim.IsA(UsdGeom.Cube):
        half = np.full(3, 0.5 * value('size'))
        return triangles_of(box_faces(-half, half))
    # Radii and heights of the others, along half an outline.
    if prim.IsA(UsdGeom.Sphere):
        angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, CIRCLE_PARTS // 2 + 1)
        outline = value('radius') * np.column_stack([np.cos(angles), np.sin(angles)])
        return _turned(outline, 'Z')
    if prim.IsA(UsdGeom.Cylinder) or prim.IsA(UsdGeom.Cone):
        radius, end = value('radius'), 0.5 * value('height')
        top = radius if prim.IsA(UsdGeom.Cylinder) else 0.0
        return _turned(np.array([[0.0, -end], [radius, -end], [top, end], [0.0, end]]),
                       value('axis'))
    return None


def _turned(outline: np.ndarray, axis: str) -> np.ndarray:
    """Return the triangles (T, 3, 3) of an outline (M, 2), radii and heights, turned round."""
    angles = np.linspace(0.0, 2.0 * np.pi, CIRCLE_PARTS + 1)
    rings = np.stack([outline[:, :1] * np.cos(angles), outline[:, :1] * np.sin(angles),
                      np.broadcast_to(outline[:, 1:], (len(outline), len(angles)))], axis=-1)
    quads = np.stack([rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1]], axis=2)
    return np.roll(triangles_of(quads.reshape(-1, 4, 3)).reshape(-1, 3, 3),
                   'ZXY'.index(axis), axis=2)


def _polygons(points: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the triangles (T, 3, 3) of polygons: points, numbers of corners, corners."""
    points = points.reshape(-1, 3)
    if counts.sum() != len(indices) or (counts < 0).any() or (
            len(indices) and not 0 <= indices.min() <= indices.max() < len(points)):
        raise ValueError('faces with vertices that are not there')
    # A polygon of n corners is a fan of n - 2 triangles around its first corner.
    fans = np.maximum(counts - 2, 0)
    first = np.repeat(np.cumsum(counts) - counts, fans)
    number = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    return points[indices[np.stack([first, first + number + 1, first + number + 2], axis=1)]]
