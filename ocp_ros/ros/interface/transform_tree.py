# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The newest transforms between frames, where tf2 is not at hand."""

from collections.abc import Iterable

import numpy as np

from ocp_ros.geometry.cameras import LEVEL, Pose
from ocp_ros.ros.interface.conversions import MessageError, rotation_of


class TransformTree:
    """Where each frame is in its parent, as last told."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def add(self, transforms: Iterable) -> None:
        """
        Take note of transforms.

        :param transforms: each with ``header.frame_id``, ``child_frame_id`` and ``transform``.
        :raises MessageError: if one has no direction or is not finite.
        """
        for one in transforms:
            move, name = one.transform, one.child_frame_id.lstrip('/')
            position = np.array([move.translation.x, move.translation.y, move.translation.z])
            if not np.isfinite(position).all():
                raise MessageError(f'transform of {name!r}: found {position.tolist()}; expected '
                                   'finite metres')
            self._parents[name] = (one.header.frame_id.lstrip('/'), Pose(
                position, rotation_of(move.rotation, f'transform of {name!r}')))

    def pose(self, frame: str, fixed: str) -> Pose | None:
        """Return where a frame is in another one above it; None where nobody has said so."""
        frame, fixed = frame.lstrip('/'), fixed.lstrip('/')
        position, rotation = np.zeros(3), LEVEL
        # So many steps and no more: frames may have been told in a circle.
        for _ in range(len(self._parents) + 1):
            if frame == fixed:
                return Pose(position, rotation)
            if frame not in self._parents:
                return None
            frame, step = self._parents[frame]
            position = step.rotation @ position + step.position
            rotation = step.rotation @ rotation
        return None
