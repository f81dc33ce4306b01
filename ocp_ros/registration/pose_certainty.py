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
How well surfaces hold a camera in each of the six directions in which it could be off.

Neighbouring points err alike: they are of one panel, or of one frame of the scan. So what counts
is the blocks of a metre that they lie in, not their number. The covariance is that of the
delete-a-group jackknife over the blocks, plus that of blocks that each err on their own, by as
much as the blocks at hand do.
"""

from typing import NamedTuple

import numpy as np
from ocp_ros.registration.alignment import Matches

#: Metres: edge of a block; and points that make a whole one.
BLOCK, WHOLE = 1.0, 8.0
#: Metres that a block of a scan is off: at least, and where fewer whole blocks than so many tell.
LEAST_DEVIATION, UNKNOWN_DEVIATION, TELLING = 0.003, 0.02, 4
#: Standard deviation of a normal distribution over its median absolute deviation.
NORMAL = 1.4826
#: By how much a doubted deviation grows where the scan explains nothing; chosen on validation
#: rooms.
DOUBT = 2.0
#: Share of the variance within a block that is common to the block.
UNEVEN = 0.2
#: Metres and radians at most, where nothing holds a camera at all.
FREE = 10.0
#: Metres and degrees within which a direction counts as held.
HELD_METRES, HELD_DEGREES = 0.05, 2.0


class Certainty(NamedTuple):
    """
    Expected standard deviations of a pose.

    :ivar along: (3, 3), a row each: directions in the map frame in which it may have slid.
    :ivar metres: (3,) along these, the largest first.
    :ivar about: (3, 3) axes in the map frame about which it may have turned.
    :ivar degrees: (3,) about these, the largest first.
    """

    along: np.ndarray
    metres: np.ndarray
    about: np.ndarray
    degrees: np.ndarray

    def doubted(self, overlap: float, beside: float) -> 'Certainty':
        """
        Return by how much the pose may be off where the scan is not to be trusted throughout.

        Surfaces that are seen beside where they were scanned may have been moved, or the scan may
        show their other side; then so may others. Little overlap leaves few that say so.

        :param overlap: the share of what is seen that the scan explains, 0 to 1.
        :param beside: the share of the surfaces that stand beside, 0 to 1.
        """
        doubt = 1.0 + DOUBT * (1.0 - overlap + beside)
        return self._replace(metres=self.metres * doubt, degrees=self.degrees * doubt)

    @property
    def loose(self) -> list[str]:
        """Say which directions nothing holds."""
        return [*(f'can slide along {axis_words(axis)}' for axis, deviation
                  in zip(self.along, self.metres) if deviation > HELD_METRES),
                *(f'can turn about {axis_words(axis)}' for axis, deviation
                  in zip(self.about, self.degrees) if deviation > HELD_DEGREES)]


def axis_words(axis: np.ndarray) -> str:
    """Name a direction (3,) of the map, whichever way it points."""
    largest = int(np.abs(axis).argmax())
    if abs(axis[largest]) > 0.95:
        return ('the x direction', 'the y direction', 'the vertical')[largest]
    if abs(axis[2]) < 0.3:
        # Lines have no sign: 0 to 180 degrees from x.
        angle = np.rad2deg(np.arctan2(axis[1], axis[0])) % 180.0
        return f'the level line at {angle:.0f} degrees from x'
    axis = axis * np.sign(axis[largest]) + 0.0
    return 'the line ' + ', '.join(f'{value:.2f}' for value in axis)


def certainty(points: np.ndarray, normals: np.ndarray, matches: Matches, weights: np.ndarray
              ) -> Certainty:
    """
    Tell how well a registration holds a camera.

    :param points: (M, 3) the surfaces that were matched, metres, map frame.
    :param normals: (M, 3) their normals.
    :param matches: of one pose, with M points.
    :param weights: (1, M), see :func:`~ocp_ros.registration.alignment.weights_of`.
    """
    jacobians, weights = matches.jacobians[0], weights[0]
    used = weights > 1e-9 * max(weights.max(), 1e-9)
    cells = np.column_stack([np.floor(points[used] / BLOCK), np.abs(normals[used]).argmax(axis=1)])
    blocks = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    count = int(blocks.max(initial=-1)) + 1
    weighted = jacobians[used] * weights[used, None]
    information, pull = np.zeros((count, 6, 6)), np.zeros((count, 6))
    np.add.at(information, blocks, weighted[:, :, None] * jacobians[used][:, None])
    np.add.at(pull, blocks, weighted * matches.residuals[0, used, None])
    mass = np.bincount(blocks, weights[used], count)
    share = np.minimum(np.bincount(blocks, minlength=count) / WHOLE, 1.0)
    floor = np.eye(6) / FREE ** 2
    spread = np.bincount(blocks, weights[used] * matches.residuals[0, used] ** 2, count) / mass
    variance = _block_deviation(matches.residuals[0, used], blocks) ** 2 + UNEVEN * spread
    own = (information * (share / mass / variance)[:, None, None]).sum(axis=0)
    covariance = np.linalg.inv(own + floor)
    scale = np.trace(own) / max(np.trace(information.sum(axis=0)), 1e-30)
    rest = information.sum(axis=0) - information
    steps = np.linalg.solve(rest + floor / max(scale, 1e-12), pull[..., None])[..., 0]
    covariance = covariance + (count - 1) / max(count, 1) * steps.T @ steps
    slide, turn = _principal(covariance[3:, 3:]), _principal(covariance[:3, :3])
    return Certainty(slide[0], slide[1], turn[0], np.rad2deg(turn[1]))


def _block_deviation(residuals: np.ndarray, blocks: np.ndarray) -> float:
    """Return how far blocks of the scan are off, metres, by the residuals (M,) in each of them."""
    ends = np.cumsum(np.bincount(blocks))[:-1]
    parts = np.split(residuals[np.argsort(blocks, kind='stable')], ends)
    middles = [np.median(part) for part in parts if len(part) >= WHOLE]
    if len(middles) < TELLING:
        return UNKNOWN_DEVIATION
    # Panels whose other side was scanned are few: the median leaves them out.
    return max(NORMAL * float(np.median(np.abs(middles))), LEAST_DEVIATION)


def _principal(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the principal directions as rows, and their standard deviations, largest first."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors.T[::-1], np.minimum(np.sqrt(np.maximum(values[::-1], 0.0)), FREE)
