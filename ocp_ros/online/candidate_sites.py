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

#: Number of proposals of one annealing run among the candidates.
PROPOSALS = 3000
#: First and last temperature, in multiples of the depth error without any visible point.
TEMPERATURES = 0.04, 2e-4
#: Number of consecutive proposals that change the same camera.
PROPOSALS_PER_CAMERA = 20
#: Share of the proposals that draw among all candidates.
ANY_CANDIDATE_SHARE = 0.3
#: Number of yaws and largest number of pitches, for cameras that are not omnidirectional.
YAWS, PITCHES = 8, 2


@njit(cache=True, nogil=True)
def _objective_value(seen, covered, trees, pixels, weight):
    """
    Return the depth error less the bonus for covered unseen cells, metres; less is better.

    :param seen: (W,) uint64, packed bits of the points that the cameras see.
    :param covered: (V,) uint64, packed bits of the unseen cells that the cameras cover.
    :param trees: see :func:`_anneal_choice`, as for ``pixels`` and ``weight``.
    """
    return lost_depth(trees, seen) / pixels - weight * count_bits(covered)


@njit(cache=True, nogil=True)
def _union(views):
    """Return the union (W,) of M views (M, W) uint64, packed bits."""
    union = np.zeros_like(views[0])
    for view in views:
        union |= view
    return union


@njit(nogil=True)
def _merge_others(camera, choice, seen, covered, trees):
    """
    Merge the views of all cameras of a choice but one.

    :param camera: the camera that is left out; for all else see :func:`_anneal_choice`.
    :returns: the trees without nodes whose error the merged view decides; the summed error of
        trees that were removed as a whole, metres, not yet divided by ``pixels``; and the packed
        bits (V,) of the cells that the merged view covers.
    """
    others_seen, others_covered = np.zeros_like(seen[0]), np.zeros_like(covered[0])
    for other in range(len(choice)):
        if other != camera:
            others_seen |= seen[choice[other]]
            others_covered |= covered[choice[other]]
    open_trees, settled_error = unsettled(trees, others_seen)
    return open_trees, settled_error, others_covered


@njit(nogil=True)
def _site_value(site, max_value, others, seen, covered, pixels, weight, values, is_exact):
    """
    Return the objective value of a site together with the other cameras; cache this value.

    :param site: the number of the site; for all else see :func:`_anneal_choice`.
    :param max_value: metres; if the objective value is larger, any number above ``max_value`` may
        be returned.
    :param others: the result of :func:`_merge_others` for the other cameras.
    :param values: (S,) metres, in and out: cached values of the sites, or lower bounds of them.
    :param is_exact: (S,) bool, in and out: whether a cached value is exact.
    """
    if not is_exact[site] and values[site] <= max_value:
        open_trees, settled_error, others_covered = others
        bonus = weight * count_bits(others_covered | covered[site])
        # Above this limit the summation stops, and the value is a lower bound.
        limit = (max_value + bonus) * pixels - settled_error
        values[site] = (settled_error + lost_depth(open_trees, seen[site], limit)) / pixels - bonus
        is_exact[site] = values[site] <= max_value
    return values[site]


@njit(cache=True, nogil=True)
def _choose_greedily(seen, covered, trees, pixels, weight, kind_of, sites, starts):
    """
    Choose the best site for one camera after the other; parameters as in :func:`_anneal_choice`.

    The gain of a site never rises as the choice grows (the objective is submodular). So its gain
    for an earlier camera is an upper bound. Sites whose bound is below the best present gain are
    skipped.
    """
    choice = np.empty(len(kind_of), dtype=np.int64)
    gain_bounds = np.full(len(seen), np.inf)
    for camera in range(len(kind_of)):
        # Only the cameras before this one have a site, so no camera has to be left out.
        others = _merge_others(camera, choice[:camera], seen, covered, trees)
        open_trees, settled_error, others_covered = others
        value_before = ((settled_error + lost_depth(open_trees, np.zeros_like(seen[0]))) / pixels
                        - weight * count_bits(others_covered))
        values = np.full(len(seen), -np.inf)
        is_exact = np.zeros(len(seen), dtype=np.bool_)
        best_site, best_value = -1, np.inf
        kind_sites = sites[starts[kind_of[camera]]:starts[kind_of[camera] + 1]]
        # Most promising sites first; merge sort keeps the order of sites with equal bounds.
        for site in kind_sites[np.argsort(-gain_bounds[kind_sites], kind='mergesort')]:
            # Even with its largest possible gain this site is worse than the best one, and later
            # sites have no larger bounds. A nanometre is the tolerance for rounding.
            if value_before - gain_bounds[site] > best_value + 1e-9:
                break
            value = _site_value(site, best_value, others, seen, covered, pixels, weight, values,
                                is_exact)
            # If the value is a lower bound, this is an upper bound of the gain.
            gain_bounds[site] = value_before - value
            # Of equal sites the first one wins, in whatever order they are compared.
            if value < best_value or (value == best_value and site < best_site):
                best_site, best_value = site, value
        choice[camera] = best_site
    return choice


@njit(cache=True, nogil=True)
def _anneal_choice(choice, best_choice, seen, covered, trees, pixels, weight, kind_of, sites,
                   starts, neighbours, temperatures, rng):
    """
    Improve a choice of K sites by simulated annealing: exchange one site at a time.

    Each drawn camera gets several consecutive proposals. The values of its sites, together with
    the other cameras, are cached until another camera moves: late in a run the same few sites are
    proposed repeatedly.

    :param choice: (K,) int64, the current choice, in and out.
    :param best_choice: (K,) int64, the best choice so far, in and out.
    :param seen: (S, W) uint64, packed bits in W words of the points that each of S sites sees.
    :param covered: (S, V) uint64, packed bits of the unseen cells that each site covers.
    :param trees: the trees of a :class:`~ocp_ros.geometry.depth_error.DepthError`.
    :param pixels: the divisor of sums over these trees, as in that class.
    :param weight: bonus for each covered cell, metres.
    :param kind_of: (K,) int64, the kind of site that each camera takes.
    :param sites: (S,) int64, the numbers of the sites, sorted by kind.
    :param starts: (kinds + 1,) int64, the start of each kind in ``sites``.
    :param neighbours: (S, N) int64, for each site the most similar other sites of its kind. Of a
        kind with n <= N sites, only n - 1 entries of a row are used.
    :param temperatures: (P,) metres, one for each of P proposals.
    :param rng: numpy.random.Generator.
    """
    best_value = _objective_value(_union(seen[best_choice]), _union(covered[best_choice]), trees,
                                  pixels, weight)
    # Placeholders that give Numba the type; every entry is computed before its first use.
    others = [(trees, 0.0, covered[0])] * len(choice)
    is_stale = np.ones(len(choice), dtype=np.bool_)
    values = np.empty((len(choice), len(seen)))
    is_exact = np.empty(values.shape, dtype=np.bool_)
    for block in range(0, len(temperatures), PROPOSALS_PER_CAMERA):
        camera = rng.integers(0, len(choice))
        first, last = starts[kind_of[camera]], starts[kind_of[camera] + 1]
        neighbour_count = min(neighbours.shape[1], last - first - 1)
        if is_stale[camera]:
            others[camera] = _merge_others(camera, choice, seen, covered, trees)
            values[camera], is_exact[camera] = -np.inf, False
            is_stale[camera] = False
        value = _site_value(choice[camera], np.inf, others[camera], seen, covered, pixels, weight,
                            values[camera], is_exact[camera])
        if value < best_value:
            best_choice[:], best_value = choice, value
        for temperature in temperatures[block:block + PROPOSALS_PER_CAMERA]:
            if rng.random() < ANY_CANDIDATE_SHARE or not neighbour_count:
                site = sites[first + rng.integers(0, last - first)]
            else:
                site = neighbours[choice[camera], rng.integers(0, neighbour_count)]
            # The rule of Metropolis as in :func:`~ocp_ros.util.annealing.annealed`.
            max_value = value + temperature * rng.exponential()
            trial_value = _site_value(site, max_value, others[camera], seen, covered, pixels,
                                      weight, values[camera], is_exact[camera])
            if trial_value <= max_value:
                if site != choice[camera]:
                    # The caches of all other cameras hold for the old site of this camera.
                    is_stale[:] = True
                    is_stale[camera] = False
                choice[camera], value = site, trial_value
                if value < best_value:
                    best_choice[:], best_value = choice, value


class Candidates:
    """
    S candidate poses for the cameras of a rig, each with its visible points and covered cells.

    A choice is a list of candidate numbers, one for each of K movable cameras in the order of the
    rig. Each camera gets a candidate of its own kind, see :func:`kinds_of`. An omnidirectional
    camera has a single heading.

    :param model: partial map of the observed cloud.
    :param positions: (M, 3) metres, map frame: M >= 1 candidate positions.
    :param plans: placements (K, 6), metres and radians; their poses are the first candidates.
    :param rig_state: the rig.
    :param unseen: (V,) uint64, packed bits of the model's cells that count as unseen.
    :param weight: bonus for each covered unseen cell, metres of depth error.
    :ivar poses: (S, 6) x, y, z in metres, map frame, yaw, pitch, roll in radians.
    :ivar kind_of: (K,) the kind of candidate that each camera takes.
    :ivar of_kind: for each kind the numbers of its candidates.
    :ivar neighbours: (S, N) for each candidate the most similar other candidates of its kind, in
        the first of N columns.
    """

    def __init__(self, model: PartialMap, positions: np.ndarray, plans: Sequence[np.ndarray],
                 rig_state: RigState, unseen: np.ndarray, weight: float) -> None:
        self._error = model.depth_error
        #: The last three inputs of the objective: trees, divisor of sums, bonus for a cell.
        self._objective = self._error.trees, self._error.pixels, weight
        self.kind_of, first_cameras = kinds_of(rig_state)
        # Candidates at one position: kind, position (3,), headings (H, 3) and frustum.
        groups = [(kind, pose[:3], pose[None, 3:], lens) for plan in plans
                  for kind, pose, lens in zip(self.kind_of, plan, rig_state.lenses)]
        for kind, camera in enumerate(first_cameras):
            headings, lens = rig_state.headings(camera, YAWS, PITCHES), rig_state.lenses[camera]
            groups += [(kind, position, headings, lens) for position in positions]
        views = list(chain(*mapped(lambda group: model.look_many(*group[1:]), groups)))
        kinds, group_positions, group_headings, _ = zip(*groups)
        counts = [len(headings) for headings in group_headings]
        self.poses = np.hstack([np.repeat(group_positions, counts, axis=0),
                                np.vstack(group_headings)])
        kinds = np.repeat(kinds, counts)
        self.of_kind = [np.flatnonzero(kinds == kind) for kind in range(len(first_cameras))]
        #: Candidate numbers (S,), sorted by kind, and in it the start of each kind (kinds + 1,).
        self._sites = np.concatenate(self.of_kind)
        self._starts = np.cumsum([0, *map(len, self.of_kind)])
        fixed = model.together(fixed_views(model, rig_state))
        self._seen = np.array([view.seen for view in views]) | fixed.seen
        self._covered = (np.array([view.covered for view in views]) | fixed.covered) & unseen
        # A proposal draws among all candidates of the kind, or among the 12 most similar ones.
        self.neighbours = np.zeros((len(views), 12), dtype=np.int64)
        for candidates, camera in zip(self.of_kind, first_cameras):
            # The heading of an omnidirectional camera means nothing.
            metres_per_radian = 0.0 if rig_state.models[camera].omnidirectional else 0.5
            neighbours = self._neighbours_of(candidates, metres_per_radian)
            self.neighbours[candidates, :neighbours.shape[1]] = neighbours

    def _neighbours_of(self, candidates: np.ndarray, metres_per_radian: float) -> np.ndarray:
        """Return the most similar others for each of C candidates of one kind: (C, n <= N)."""
        tree = cKDTree(pose_features(self.poses[candidates], metres_per_radian))
        # Rank 1 is the candidate itself, so the ranks from 2 are used.
        ranks = np.arange(2, min(self.neighbours.shape[1] + 1, len(candidates)) + 1)
        _, indices = tree.query(tree.data, ranks)
        return candidates[indices]

    def value(self, choice: list[int]) -> float:
        """Return the objective value of a choice, metres; less is better."""
        return _objective_value(_union(self._seen[choice]), _union(self._covered[choice]),
                                *self._objective)

    def choose_greedily(self) -> list[int]:
        """Choose a pose for one camera after the other, each time the one with the best value."""
        return _choose_greedily(self._seen, self._covered, *self._objective, self.kind_of,
                                self._sites, self._starts).tolist()

    def anneal(self, first_choice: list[int], rng: np.random.Generator, parts: int = 1
               ) -> Iterator[list[int]]:
        """
        Anneal in several parts, from a first choice; yield the best choice after each part.

        :param first_choice: K candidate numbers.
        :param rng: draws the proposals.
        :param parts: the number of parts; at least 1.
        """
        temperatures = self._error.worst * between(*TEMPERATURES, np.arange(PROPOSALS) / PROPOSALS)
        choice, best_choice = np.array(first_choice), np.array(first_choice)
        for part_temperatures in np.array_split(temperatures, parts):
            _anneal_choice(choice, best_choice, self._seen, self._covered, *self._objective,
                           self.kind_of, self._sites, self._starts, self.neighbours,
                           part_temperatures, rng)
            yield best_choice.tolist()


def kinds_of(rig_state: RigState) -> tuple[np.ndarray, list[int]]:
    """
    Group the K movable cameras of a rig into kinds; cameras of a kind may exchange their poses.

    :returns: (K,) the kind of each camera, and the first camera of each kind.
    """
    # Cameras of a kind have the same frustum and are equal in the angles that may not change: the
    # roll (column 5 of a pose), or all angles (from column 3).
    first_kept = 5 if rig_state.may_rotate else 3
    keys = [(lens, () if model.omnidirectional else tuple(pose[first_kept:])) for lens, model, pose
            in zip(rig_state.lenses[:rig_state.movable], rig_state.models, rig_state.placement)]
    kinds = list(dict.fromkeys(keys))
    return np.array([kinds.index(key) for key in keys]), [keys.index(kind) for kind in kinds]


def max_positions(rig_state: RigState) -> int:
    """Return the largest number of positions that give at most 2000 candidate poses, or 1."""
    _, first_cameras = kinds_of(rig_state)
    headings = sum(len(rig_state.headings(camera, YAWS, PITCHES)) for camera in first_cameras)
    return max(2000 // headings, 1)
