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

"""Candidate poses from which :mod:`ocp_ros.online.lookahead` chooses a placement."""

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np
from ocp_ros.geometry.cameras import pose_features
from ocp_ros.geometry.depth_error import lost_depth, unsettled
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import fixed_views, RigState
from ocp_ros.util.annealing import between
from ocp_ros.util.kernels import njit
from ocp_ros.util.threads import mapped
from scipy.spatial import cKDTree

#: Proposals of one annealing run among the candidates.
EXCHANGES = 3000
#: Temperatures of the first and the last proposal, in multiples of the depth error without any
#: visible point.
FIRST_TEMPERATURE, LAST_TEMPERATURE = 0.04, 2e-4
#: Consecutive proposals that change the same camera.
IN_A_ROW = 20
#: Share of the proposals that take any candidate, and from how many nearest candidates the other
#: proposals take one.
ANYWHERE_SHARE, NEIGHBOURS = 0.3, 12
#: Number of yaws and largest number of pitches, for cameras that are not omnidirectional.
YAWS, PITCHES = 8, 2
#: Largest number of candidate poses (position and heading).
MAX_POSES = 2000
#: Metres: rounding of a value.
ROUNDING_M = 1e-9
#: Metres that a rotation by one radian counts as in the search for neighbours.
METRES_PER_RADIAN = 0.5


@njit(cache=True, nogil=True)
def _value(seen, covered, trees, pixels, weight):
    """Return the depth error of visible points less the bonus for covered unseen cells, metres."""
    return lost_depth(trees, seen) / pixels - weight * count_bits(covered)


@njit(nogil=True)
def _union(views):
    """Return the union of some views (M, W) uint64, packed bits."""
    union = np.zeros_like(views[0])
    for view in views:
        union |= view
    return union


@njit(nogil=True)
def _beside(camera, state, seen, covered, trees):
    """Return what the cameras beside one leave: trees, the settled sum, and covered cells."""
    others_seen, others_covered = np.zeros_like(seen[0]), np.zeros_like(covered[0])
    for other in range(len(state)):
        if other != camera:
            others_seen |= seen[state[other]]
            others_covered |= covered[state[other]]
    left, settled = unsettled(trees, others_seen)
    return left, settled, others_covered


@njit(nogil=True)
def _trial(site, most, beside, seen, covered, pixels, weight, values, exact):
    """Return the value of a site beside the other cameras, any larger one if it exceeds most."""
    if not exact[site] and values[site] <= most:
        left, settled, others_covered = beside
        bonus = weight * count_bits(others_covered | covered[site])
        values[site] = (settled + lost_depth(
            left, seen[site], (most + bonus) * pixels - settled)) / pixels - bonus
        exact[site] = values[site] <= most
    return values[site]


@njit(cache=True, nogil=True)
def _filled(seen, covered, trees, pixels, weight, kind_of, own, firsts):
    """
    Choose the best site for one camera after the other; for the parameters see :func:`_annealed`.

    What a site adds to a choice becomes less as the choice grows (both terms of the value are
    submodular), so sites that once added less than the best one does now are not looked at.
    """
    chosen = np.empty(len(kind_of), dtype=np.int64)
    gains = np.full(len(seen), np.inf)
    for camera in range(len(kind_of)):
        beside = _beside(camera, chosen[:camera], seen, covered, trees)
        left, settled, others_covered = beside
        nothing = np.zeros_like(seen[0])
        before = ((settled + lost_depth(left, nothing)) / pixels
                  - weight * count_bits(others_covered))
        values = np.full(len(seen), -np.inf)
        exact = np.zeros(len(seen), dtype=np.bool_)
        best, best_value = -1, np.inf
        of_kind = own[firsts[kind_of[camera]]:firsts[kind_of[camera] + 1]]
        for site in of_kind[np.argsort(-gains[of_kind], kind='mergesort')]:
            if before - gains[site] > best_value + ROUNDING_M:
                break
            value = _trial(site, best_value, beside, seen, covered, pixels, weight, values, exact)
            gains[site] = before - value
            if value < best_value or (value == best_value and site < best):
                best, best_value = site, value
        chosen[camera] = best
    return chosen


@njit(cache=True, nogil=True)
def _annealed(state, best, seen, covered, trees, pixels, weight, kind_of, own, firsts, near,
              temperatures, rng):
    """
    Improve a choice by simulated annealing: exchange one site at a time.

    Each camera gets some proposals in a row. The values of its sites beside the other cameras are
    stored until another camera moves: late in a run the same few sites are proposed repeatedly.

    :param state: (K,) int64, the current choice, in and out.
    :param best: (K,) int64, the best choice so far, in and out.
    :param seen: (S, W) uint64, packed bits of the points that each site sees.
    :param covered: (S, V) uint64, packed bits of the unseen cells that each site covers.
    :param trees: of the depth error.
    :param pixels: the divisor of its sums, see :class:`~ocp_ros.geometry.depth_error.DepthError`.
    :param weight: bonus for each covered cell, metres.
    :param kind_of: (K,) int64, the kind of site that each camera takes.
    :param own: (S,) int64, the sites, sorted by kind.
    :param firsts: (kinds + 1,) int64, where each kind begins in ``own``.
    :param near: (S, N) int64, for each site the most similar other sites of its kind. Of a kind
        with n <= N sites, only n - 1 entries of a row are used.
    :param temperatures: one for each proposal, metres.
    :param rng: numpy.random.Generator.
    """
    best_value = _value(_union(seen[best]), _union(covered[best]), trees, pixels, weight)
    beside = [(trees, 0.0, covered[0])] * len(state)
    stale = np.ones(len(state), dtype=np.bool_)
    values = np.empty((len(state), len(seen)))
    exact = np.empty(values.shape, dtype=np.bool_)
    for block in range(0, len(temperatures), IN_A_ROW):
        camera = rng.integers(0, len(state))
        first, last = firsts[kind_of[camera]], firsts[kind_of[camera] + 1]
        neighbours = min(near.shape[1], last - first - 1)
        if stale[camera]:
            beside[camera] = _beside(camera, state, seen, covered, trees)
            stale[camera], exact[camera], values[camera] = False, False, -np.inf
        value = _trial(state[camera], np.inf, beside[camera], seen, covered, pixels, weight,
                       values[camera], exact[camera])
        if value < best_value:
            best[:], best_value = state, value
        for temperature in temperatures[block:block + IN_A_ROW]:
            if rng.random() < ANYWHERE_SHARE or not neighbours:
                site = own[first + rng.integers(0, last - first)]
            else:
                site = near[state[camera], rng.integers(0, neighbours)]
            most = value + temperature * rng.exponential()
            trial = _trial(site, most, beside[camera], seen, covered, pixels, weight,
                           values[camera], exact[camera])
            if trial <= most:
                if site != state[camera]:
                    stale[:] = True
                    stale[camera] = False
                state[camera], value = site, trial
                if value < best_value:
                    best[:], best_value = state, value


class Candidates:
    """
    Candidate poses for the cameras of a rig, each with its visible points and covered cells.

    A choice is a list of candidate numbers, one for each camera in the order of the rig. Each
    camera gets a candidate of its own kind. An omnidirectional camera has a single heading.

    :param model: partial map of the observed cloud.
    :param places: (M, 3) metres, M >= 1.
    :param plans: placements (K, 6); their poses are the first candidates.
    :param rig_state: the rig.
    :param unseen: packed bits of the model's cells that count as unseen.
    :param weight: bonus for each covered unseen cell, metres of depth error.
    :ivar poses: (S, 6) x, y, z in metres, yaw, pitch, roll in radians.
    :ivar kind_of: (K,) the kind of candidate that each camera takes.
    :ivar of_kind: the numbers of the candidates of each kind.
    :ivar near: (S, N) for each candidate the most similar other candidates of its kind, in the
        first columns.
    """

    def __init__(self, model: PartialMap, places: np.ndarray, plans: Sequence[np.ndarray],
                 rig_state: RigState, unseen: np.ndarray, weight: float) -> None:
        self.model, self.weight = model, weight
        self.kind_of, firsts = kinds_of(rig_state)
        groups = [(kind, row[:3], row[None, 3:], lens) for plan in plans
                  for kind, row, lens in zip(self.kind_of, plan, rig_state.lenses)]
        for kind, camera in enumerate(firsts):
            headings, lens = rig_state.headings(camera, YAWS, PITCHES), rig_state.lenses[camera]
            groups += [(kind, place, headings, lens) for place in places]
        views = list(chain(*mapped(lambda group: model.look_many(*group[1:]), groups)))
        kinds, positions, headings, _ = zip(*groups)
        counts = [len(some) for some in headings]
        self.poses = np.hstack([np.repeat(positions, counts, axis=0), np.vstack(headings)])
        kinds = np.repeat(kinds, counts)
        self.of_kind = [np.flatnonzero(kinds == kind) for kind in range(len(firsts))]
        always = model.together(fixed_views(model, rig_state))
        self._seen = np.array([view.seen for view in views]) | always.seen
        self._covered = (np.array([view.covered for view in views]) | always.covered) & unseen
        self.near = np.zeros((len(views), NEIGHBOURS), dtype=np.int64)
        for own in self.of_kind:
            near = self._neighbours(own)
            self.near[own, :near.shape[1]] = near

    def _neighbours(self, own: np.ndarray) -> np.ndarray:
        """List the most similar other candidates of the same kind for each one of a kind."""
        tree = cKDTree(pose_features(self.poses[own], METRES_PER_RADIAN))
        _, near = tree.query(tree.data, np.arange(2, min(NEIGHBOURS + 1, len(own)) + 1))
        return own[near]

    def value(self, chosen: list[int]) -> float:
        """Return the objective value of a choice, metres; less is better."""
        error = self.model.depth_error
        return _value(_union(self._seen[chosen]), _union(self._covered[chosen]),
                      error.trees, error.pixels, self.weight)

    def fill(self) -> list[int]:
        """Choose a pose for one camera after the other, each time the one with the best value."""
        error = self.model.depth_error
        return _filled(self._seen, self._covered, error.trees, error.pixels, self.weight,
                       self.kind_of, *self._by_kind()).tolist()

    def _by_kind(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the candidates, sorted by kind, and where each kind begins: (kinds + 1,)."""
        return (np.concatenate(self.of_kind),
                np.cumsum([0, *(len(own) for own in self.of_kind)]))

    def anneal(self, chosen: list[int], rng: np.random.Generator, parts: int = 1
               ) -> Iterator[list[int]]:
        """
        Anneal in several parts, from a first choice; yield the best choice after each part.

        :param chosen: the first choice.
        :param rng: draws the proposals.
        :param parts: the number of parts; at least 1.
        """
        error = self.model.depth_error
        temperatures = error.worst * between(FIRST_TEMPERATURE, LAST_TEMPERATURE,
                                             np.arange(EXCHANGES) / EXCHANGES)
        state, best = np.array(chosen), np.array(chosen)
        for some in np.array_split(temperatures, parts):
            _annealed(state, best, self._seen, self._covered, error.trees, error.pixels,
                      self.weight, self.kind_of, *self._by_kind(), self.near, some, rng)
            yield best.tolist()


def kinds_of(rig_state: RigState) -> tuple[np.ndarray, list[int]]:
    """
    Group the cameras of a rig into kinds: cameras of one kind may exchange their poses.

    :returns: (K,) the kind of each camera, and the first camera of each kind.
    """
    free = 5 if rig_state.turns else 3
    keys = [(lens, () if model.omnidirectional else tuple(row[free:])) for lens, model, row
            in zip(rig_state.lenses[:rig_state.movable], rig_state.models, rig_state.placement)]
    kinds = list(dict.fromkeys(keys))
    return np.array([kinds.index(key) for key in keys]), [keys.index(kind) for kind in kinds]


def most_places(rig_state: RigState) -> int:
    """Return the largest number of candidate positions so that poses stay within ``MAX_POSES``."""
    _, firsts = kinds_of(rig_state)
    headings = sum(len(rig_state.headings(camera, YAWS, PITCHES)) for camera in firsts)
    return max(MAX_POSES // headings, 1)
