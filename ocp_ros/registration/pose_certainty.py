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
The certainty of a pose in each of the six directions in which it may be wrong.

Neighbouring points have common errors, since they belong to one panel or one frame of the scan. So
the number of one-metre blocks counts, not the number of points. The covariance is that of the
delete-a-group jackknife over the blocks, plus that of blocks with independent errors as large as
those observed.
"""

from typing import NamedTuple

import numpy as np
from ocp_ros.registration.alignment import Matches

#: The number of points of a whole block.
WHOLE_BLOCK_POINTS = 8.0
#: The largest deviation in metres and radians, for an unconstrained camera.
FREE_DEVIATION = 10.0


class Certainty(NamedTuple):
    """
    Expected standard deviations of a pose.

    :ivar along: (3, 3), one row each: directions in the map frame of a possible displacement.
    :ivar metres: (3,) deviations along these, the largest first.
    :ivar about: (3, 3) axes in the map frame of a possible rotation.
    :ivar degrees: (3,) deviations about these, the largest first.
    """

    along: np.ndarray
    metres: np.ndarray
    about: np.ndarray
    degrees: np.ndarray

    def doubted(self, overlap: float, beside: float) -> 'Certainty':
        """
        Return the deviations of the pose if the scan may be partly wrong.

        Displaced surfaces may have been moved, or the scan may show their other side; then other
        surfaces may be wrong as well. With little overlap, few surfaces reveal this.

        :param overlap: the share of the cloud that the scan explains, 0 to 1.
        :param beside: the share of displaced surfaces, 0 to 1.
        """
        # Chosen on validation rooms: the factor by which a deviation grows if the scan explains
        # nothing.
        doubt = 1.0 + 2.0 * (1.0 - overlap + beside)
        return self._replace(metres=self.metres * doubt, degrees=self.degrees * doubt)

    @property
    def loose(self) -> list[str]:
        """Return descriptions of the unconstrained directions."""
        # Up to 5 cm and 2 degrees a direction counts as constrained.
        return [*(f'can slide along {axis_words(axis)}' for axis, deviation
                  in zip(self.along, self.metres) if deviation > 0.05),
                *(f'can turn about {axis_words(axis)}' for axis, deviation
                  in zip(self.about, self.degrees) if deviation > 2.0)]


def axis_words(axis: np.ndarray) -> str:
    """Return the name of a line with direction (3,) in the map, independently of its sign."""
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
    Return the expected deviations of a registered pose.

    :param points: (M, 3) the matched surface points, metres, map frame.
    :param normals: (M, 3) their normals.
    :param matches: the matches of one pose, with M points.
    :param weights: (1, M), see :func:`~ocp_ros.registration.alignment.weights_of`.
    """
    jacobians, weights = matches.jacobians[0], weights[0]
    used = weights > 1e-9 * max(weights.max(), 1e-9)
    # A block has an edge of a metre.
    cells = np.column_stack([np.floor(points[used]), np.abs(normals[used]).argmax(axis=1)])
    blocks = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    count = int(blocks.max(initial=-1)) + 1
    weighted = jacobians[used] * weights[used, None]
    information, pull = np.zeros((count, 6, 6)), np.zeros((count, 6))
    np.add.at(information, blocks, weighted[:, :, None] * jacobians[used][:, None])
    np.add.at(pull, blocks, weighted * matches.residuals[0, used, None])
    mass = np.bincount(blocks, weights[used], count)
    share = np.minimum(np.bincount(blocks, minlength=count) / WHOLE_BLOCK_POINTS, 1.0)
    floor = np.eye(6) / FREE_DEVIATION ** 2
    spread = np.bincount(blocks, weights[used] * matches.residuals[0, used] ** 2, count) / mass
    # A fifth of the variance within a block is common to its points.
    variance = _block_deviation(matches.residuals[0, used], blocks) ** 2 + 0.2 * spread
    own = (information * (share / mass / variance)[:, None, None]).sum(axis=0)
    covariance = np.linalg.inv(own + floor)
    scale = np.trace(own) / max(np.trace(information.sum(axis=0)), 1e-30)
    rest = information.sum(axis=0) - information
    steps = np.linalg.solve(rest + floor / max(scale, 1e-12), pull[..., None])[..., 0]
    covariance = covariance + (count - 1) / max(count, 1) * steps.T @ steps
    slide, turn = _principal(covariance[3:, 3:]), _principal(covariance[:3, :3])
    return Certainty(slide[0], slide[1], turn[0], np.rad2deg(turn[1]))


def _block_deviation(residuals: np.ndarray, blocks: np.ndarray) -> float:
    """Return the deviation of blocks of the scan, metres, given the residuals (M,)."""
    ends = np.cumsum(np.bincount(blocks))[:-1]
    parts = np.split(residuals[np.argsort(blocks, kind='stable')], ends)
    middles = [np.median(part) for part in parts if len(part) >= WHOLE_BLOCK_POINTS]
    # Fewer than four whole blocks do not show how accurate the scan is: 2 cm are assumed.
    if len(middles) < 4:
        return 0.02
    # Few panels were scanned from the other side, so the median ignores them.
    # 1.4826 is the standard deviation of a normal distribution over its median absolute deviation.
    return max(1.4826 * float(np.median(np.abs(middles))), 0.003)


def _principal(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the principal directions as rows, and their standard deviations, largest first."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors.T[::-1], np.minimum(np.sqrt(np.maximum(values[::-1], 0.0)), FREE_DEVIATION)
