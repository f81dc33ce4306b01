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
Find walls of glass, which a scanner sees through: of what is behind them there are fewer points.

Glass lets a part of the rays through twice, there and back. So the numbers of points on floor and
ceiling drop at once, by a like factor, and not slowly with the distance from the scanner. A frame
in a glass wall adds points at the wall and hides some behind it. Above a parapet, which hides the
floor behind it, the ceiling alone is evidence.
"""

from collections.abc import Iterator

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.clouds import corners_of
from ocp_ros.geometry.normals import STEEP
from ocp_ros.scenes.scene import MIN_POINTS, Scene
from scipy import ndimage

#: Metres: edges of the cells in which points are counted, across a wall and along it.
CELL_M = (0.05, 0.4)
#: Rows of cells on each side of a wall that say whether there is a step, and how large it is.
NEAR_ROWS, FAR_ROWS = 10, 40


def glass_walls(scene: Scene, points: np.ndarray) -> np.ndarray:
    """
    Find the walls of glass in a scan.

    :param points: (N, 3) metres, the points of the file before merging.
    :returns: (G, 2) metres, places on these walls, 5 cm apart.
    """
    is_steep = np.abs(scene.normals_or_estimate[:, 2]) <= STEEP
    normals = scene.normals_or_estimate[is_steep].astype(np.float64)
    # The direction of the walls: angles are the same after quarters of a turn.
    angle = np.angle(np.exp(4j * np.arctan2(normals[:, 1], normals[:, 0])).sum()) / 4.0
    rotation = rotation_matrix(angle)[:2, :2]
    places = points[:, :2] @ rotation
    floor = np.percentile(points[:, 2], 1.0)
    ceiling = floor + ceiling_height(points[:, 2] - floor)
    layers = [places[np.abs(points[:, 2] - z) < 0.1] for z in (floor, ceiling)]
    parapets = places[(points[:, 2] > floor + 0.3) & (points[:, 2] < floor + 0.8)]
    found = [np.empty((0, 2))]
    for axis in (0, 1):
        order = [axis, 1 - axis]
        for start, end in _density_steps([layer[:, order] for layer in layers],
                                         parapets[:, order]):
            count = int(np.ceil(np.ptp([start[1], end[1]]) / 0.05)) + 1
            line = np.linspace(start, end, count)
            found.append(line if axis == 0 else line[:, ::-1])
    return np.concatenate(found) @ rotation.T


def _density_steps(layers: list[np.ndarray], parapets: np.ndarray
                   ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """
    Yield the lines along the second axis at which all layers become less dense.

    :param layers: places (N, 2) metres on the floor, and those on the ceiling.
    :param parapets: (P, 2) metres, places at the height of parapets.
    :returns: the start and the end (2,) of each line.
    """
    if min(map(len, layers)) < MIN_POINTS:
        return
    low, high = corners_of(np.concatenate(layers))
    shape = ((high - low) / CELL_M).astype(int) + 1
    counts = np.array([np.histogram2d(*layer.T, shape, np.column_stack(
        [low, low + shape * CELL_M]))[0] for layer in (*layers, parapets)])
    # A parapet has ten times the area of a cell of the ceiling; stray points and chairs are few.
    least = 2.0 * np.median(counts[1][counts[1] > 0])
    # Twice: with the glass room behind, and before.
    for is_turned in (False, True):
        turned = counts[:, ::-1] if is_turned else counts
        above_parapets = [
            (row, first, end) for row, first, end in _steps_in(turned[1:2])
            if (turned[2, max(row - 2, 0):row + 3, first:end].sum(axis=0) > least).mean() > 0.7]
        for row, first, end in (*_steps_in(turned[:2]), *above_parapets):
            middle = 0.5 + (shape[0] - 1 - row if is_turned else row)
            # Two cells longer, up to the next walls.
            yield (low + np.multiply(CELL_M, (middle, first - 2)),
                   low + np.multiply(CELL_M, (middle, end + 2)))


def _steps_in(counts: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """
    Yield the steps down in the numbers of points of the cells of L layers, (L, X, Y).

    :returns: the row (along X) of each step, and the first and the end of its cells along Y.
    """
    width = 10
    # Sums of the cells in ``width`` rows: from each row on.
    sums = np.cumsum(np.pad(counts, ((0, 0), (1, 0), (0, 0))), axis=1)
    sums = sums[:, width:] - sums[:, :-width]
    if sums.shape[1] <= width + 1:
        return
    room, other = sums[:, :-width - 1], sums[:, width + 1:]
    # The logarithm of the odds that a cell has a step to 0.45, and no mere decline to 0.7; a
    # shadow of furniture counts little.
    log_odds = np.clip(other * np.log(0.31 / 0.41) + room * np.log(0.69 / 0.59), -2.0, 2.0)
    # The run of cells along each line with the largest sum.
    sums = np.cumsum(np.pad(log_odds.sum(axis=0), ((0, 0), (1, 0))), axis=1)
    rises = sums - np.minimum.accumulate(sums, axis=1)
    ends, gains = np.argmax(rises, axis=1), rises.max(axis=1)
    for k in np.flatnonzero(gains > 1.5 * len(counts)).tolist():
        first, end, row = int(np.argmin(sums[k, :ends[k] + 1])), int(ends[k]), k + width
        # Only the best line within 0.2 m, and of 2.4 m at least.
        if gains[k] < gains[max(k - 4, 0):k + 5].max() or end - first < 6:
            continue
        # The line alone is left out, or a frame in it with its shadow behind it.
        if any(_is_glass(counts[:, :, first:end], before, behind) for before, behind in (
                (row, row + 1), *((row - 1, row + shadow) for shadow in (4, 7, 10)))):
            yield row, first, end


def _is_glass(counts: np.ndarray, before: int, behind: int) -> bool:
    """
    Return whether the numbers of points in all L layers drop alike and at once.

    :param counts: (L, X, Y) of the cells.
    :param before: the end of the rows before the line; those behind it begin at ``behind``.
    """
    near, far = (counts[:, side].sum(axis=1) for side in (
        slice(max(before - NEAR_ROWS, 0), before), slice(behind, behind + NEAR_ROWS)))
    # Furniture hides cells of the floor.
    is_seen = near >= 2.0
    near, far = (ndimage.uniform_filter1d(3.0 * is_seen * side, 3, mode='nearest')
                 for side in (near, far))
    # Glass lets a like share through all along the line; other edges are ragged.
    shares = np.where(is_seen, far / np.maximum(near, 1.0), np.nan)
    if np.count_nonzero(is_seen, axis=1).min() < 4 or is_seen.mean() < 0.6:
        return False
    share = np.nanmedian(shares, axis=1, keepdims=True)
    is_like = is_seen & (np.abs(far - share * near)
                         < 0.4 * share * near + 2.0 * np.sqrt(share * near + 1.0))
    like_cells = np.count_nonzero(is_like, axis=1)
    if share.min() < 0.04 or like_cells.min() < 4 or (
            like_cells.sum() < 0.75 * np.count_nonzero(is_seen)):
        return False
    rows = np.einsum('lxy,ly->lx', counts, is_like)
    for reach, deviations in ((FAR_ROWS, 2.0), (NEAR_ROWS, 1.5)):
        steps, variances = _fitted_steps(rows, before, behind, reach)
        if np.ptp(steps) > 0.4 + deviations * np.sqrt(variances.sum()):
            return False
        near_step = np.average(steps, weights=1.0 / variances)
        deviation = 1.0 / np.sqrt(np.sum(1.0 / variances))
        if reach == FAR_ROWS:
            step = near_step
            if not max(0.4, 4.0 * deviation) < step < 1.6 or (
                    variances.max() > 0.2 or steps.min() < 0.25):
                return False
    # A mere decline is no step in the nearest rows.
    return bool(near_step + deviations * deviation > 0.5 * step)


def _fitted_steps(counts: np.ndarray, before: int, behind: int, reach: int
                  ) -> tuple[np.ndarray, np.ndarray]:
    """
    Fit a step at a line, and a smooth decline, to the numbers of points in rows of L layers.

    The logarithm of a number is a parabola with a step, by Poisson regression (McCullagh and
    Nelder, Generalized Linear Models, 1989, section 6.2).

    :param counts: (L, X) of the rows; ``before`` and ``behind`` are those of :func:`_is_glass`.
    :param reach: the number of rows on each side.
    :returns: the steps (L,) down, and their variances (L,).
    """
    rows = np.r_[max(before - reach, 0):before, behind:min(behind + reach, counts.shape[1])]
    x = (rows - before) / NEAR_ROWS
    terms = np.column_stack([np.ones(len(x)), x, x * x, rows >= behind])
    steps, variances = np.zeros(len(counts)), np.zeros(len(counts))
    for layer, numbers in enumerate(counts[:, rows]):
        logarithms = np.log(numbers + 0.5)
        for _ in range(4):
            expected = np.exp(logarithms)
            covariances = np.linalg.inv((terms.T * expected) @ terms + 1e-6 * np.eye(4))
            factors = covariances @ (terms.T @ (expected * logarithms + numbers - expected))
            logarithms = np.clip(terms @ factors, -5.0, 15.0)
        # The numbers may scatter more than by chance.
        scatter = np.mean((numbers - expected) ** 2 / expected)
        steps[layer], variances[layer] = -factors[3], covariances[3, 3] * max(scatter, 1.0)
    return steps, variances


def ceiling_height(heights: np.ndarray) -> float:
    """
    Return the height of the ceiling above the floor, metres.

    :param heights: (N,) metres, heights of points above the floor.
    :returns: the height of the ceiling; without a clear ceiling, the height below which 99 % of
        the points are.
    """
    top = float(np.percentile(heights, 99))
    layer_m = 0.1
    min_ceiling_m = 1.9
    upper_heights = heights[heights > min_ceiling_m] - min_ceiling_m
    layer_counts = np.bincount((upper_heights / layer_m).astype(int), minlength=2)
    # The ceiling may lie across the border of two layers: each layer gets the points of the layer
    # below it as well.
    layer_counts[1:] += layer_counts[:-1].copy()
    # A ceiling has more than three times as many points as the median layer.
    if layer_counts.max() <= 3.0 * np.median(layer_counts):
        return top
    # The middle of the layer; if the ceiling lies across a border, that of the upper layer.
    return min(top, min_ceiling_m + layer_m * (int(layer_counts.argmax()) + 0.5))
