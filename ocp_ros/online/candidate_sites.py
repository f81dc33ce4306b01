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

from collections.abc import Sequence
from functools import partial

import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.depth_error import lost_depth, unsettled
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import fixed_views, RigState
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.simulation.simulator import View
from ocp_ros.util.annealing import between
from ocp_ros.util.kernels import njit
from ocp_ros.util.threads import mapped
from scipy.spatial import cKDTree

#: Proposals of one annealing run among the candidates.
EXCHANGES = 3000
#: First and last temperature, in multiples of the depth error without any visible point.
HOT, COLD = 0.04, 2e-4
#: Consecutive proposals that change the same camera.
IN_A_ROW = 20
#: Share of the proposals that take any candidate, and from how many nearest candidates the other
#: proposals take one.
ANYWHERE, NEIGHBOURS = 0.3, 12
#: Number of yaws and largest number of pitches, for cameras that are not omnidirectional.
YAWS, PITCHES = 8, 2
#: Largest number of candidate poses (position and heading).
SITES = 2000
#: Metres that a rotation by one radian counts as in the search for neighbours.
PER_RADIAN = 0.5


@njit(cache=True, nogil=True)
def _worth(seen, covered, trees, pixels, weight):
    """Return the depth error of visible points less the bonus for covered unseen cells, metres."""
    return lost_depth(trees, seen) / pixels - weight * count_bits(covered)


@njit(cache=True, nogil=True)
def _annealed(chosen, seen, covered, trees, pixels, weight, kind_of, own, firsts, near,
              temperatures, rng):
    """
    Improve a choice by simulated annealing: exchange one site at a time, return the best choice.

    Each camera gets some proposals in a row, so the views of the other cameras are merged once
    for all of them.

    :param chosen: (K,) int64, the first choice.
    :param seen: (S, W) uint64, packed bits of the points that each site sees.
    :param covered: (S, V) uint64, packed bits of the unseen cells that each site covers.
    :param trees: of the depth error.
    :param pixels: the divisor of its sums, see :class:`~ocp_ros.geometry.depth_error.DepthError`.
    :param weight: bonus for each covered cell, metres.
    :param kind_of: (K,) int64, the kind of site that each camera takes.
    :param own: (S,) int64, the sites, sorted by kind.
    :param firsts: (kinds + 1,) int64, where each kind begins in ``own``.
    :param near: (S, N) int64, for each site the most similar sites of its kind. Of a kind with
        fewer than N sites, only that many entries of a row are used.
    :param temperatures: one for each proposal, metres.
    :param rng: numpy.random.Generator.
    """
    state, best, best_value = chosen.copy(), chosen.copy(), np.inf
    for block in range(0, len(temperatures), IN_A_ROW):
        camera = rng.integers(0, len(state))
        first, last = firsts[kind_of[camera]], firsts[kind_of[camera] + 1]
        neighbours = min(near.shape[1], last - first)
        others_seen, others_covered = np.zeros_like(seen[0]), np.zeros_like(covered[0])
        for other in range(len(state)):
            if other != camera:
                others_seen |= seen[state[other]]
                others_covered |= covered[state[other]]
        left, settled = unsettled(trees, others_seen)
        value = (settled + lost_depth(left, seen[state[camera]])) / pixels - weight * count_bits(
            others_covered | covered[state[camera]])
        if value < best_value:
            best[:], best_value = state, value
        for temperature in temperatures[block:block + IN_A_ROW]:
            if rng.random() < ANYWHERE or not neighbours:
                site = own[first + rng.integers(0, last - first)]
            else:
                site = near[state[camera], rng.integers(0, neighbours)]
            most = value + temperature * rng.exponential()
            bonus = weight * count_bits(others_covered | covered[site])
            trial = (settled + lost_depth(
                left, seen[site], (most + bonus) * pixels - settled)) / pixels - bonus
            if trial <= most:
                state[camera], value = site, trial
                if value < best_value:
                    best[:], best_value = state, value
    return best


class Candidates:
    """
    Candidate positions for omnidirectional cameras, each with its visible points and cells.

    A choice is a list of candidate indices, one for each camera.

    :param model: partial map of the observed cloud.
    :param places: (M, 2) metres, M >= 1.
    :param space: feasible region of the cameras.
    :param cameras: number of cameras to place.
    :param unseen: packed bits of the model's cells that count as unseen.
    :param weight: bonus for each covered unseen cell, metres of depth error.
    :param fixed: views of the fixed cameras; they are part of every choice.
    :ivar kind_of: (K,) the kind of site that each camera takes; here all are of one kind.
    """

    def __init__(self, model: PartialMap, places: np.ndarray, space: FreePlane, cameras: int,
                 unseen: np.ndarray, weight: float, fixed: Sequence[View] = ()) -> None:
        self.model, self.places, self.weight = model, places, weight
        self.kind_of = np.zeros(cameras, dtype=np.int64)
        self._see(mapped(model.look, space.placement(places)), fixed, unseen)
        apart = ((places[:, None] - places[None]) ** 2).sum(axis=-1)
        self._near = np.argsort(apart, axis=1, kind='stable')[:, 1:NEIGHBOURS + 1].copy()
        self._of_kind = [np.arange(len(places))]

    def _see(self, views: list[View], fixed: Sequence[View], unseen: np.ndarray) -> None:
        """Store the view of each candidate, merged with the views of the fixed cameras."""
        self._seen = np.array([view.seen for view in views])
        self._covered = np.array([view.covered for view in views]) & unseen
        always = self.model.together(fixed)
        self._seen |= always.seen
        self._covered |= always.covered & unseen

    def headings(self, chosen: np.ndarray) -> np.ndarray | None:
        """Return the headings of a choice, (K, 3) radians; None for omnidirectional cameras."""
        return None

    def value(self, chosen: list[int]) -> float:
        """Return the objective value of a choice, metres; less is better."""
        error = self.model.depth_error
        return _worth(np.bitwise_or.reduce(self._seen[chosen], axis=0),
                      np.bitwise_or.reduce(self._covered[chosen], axis=0),
                      error.trees, error.pixels, self.weight)

    def fill(self) -> list[int]:
        """Choose a site for one camera after the other, each time the one with the best value."""
        chosen: list[int] = []
        for kind in self.kind_of:
            own = self._of_kind[kind].tolist()
            values = [self.value([*chosen, site]) for site in own]
            chosen.append(own[int(np.argmin(values))])
        return chosen

    def anneal(self, chosen: list[int], rng: np.random.Generator) -> list[int]:
        """Return the best choice that annealing finds from a first choice, perhaps that one."""
        error = self.model.depth_error
        temperatures = error.worst * between(HOT, COLD, np.arange(EXCHANGES) / EXCHANGES)
        firsts = np.cumsum([0, *(len(own) for own in self._of_kind)])
        return _annealed(np.array(chosen), self._seen, self._covered, error.trees, error.pixels,
                         self.weight, self.kind_of, np.concatenate(self._of_kind),
                         firsts, self._near, temperatures, rng).tolist()


class Sites(Candidates):
    """
    Candidate poses for rigs with at least one camera that is not omnidirectional.

    A choice is a list of site indices, one for each camera in the order of the rig. Each camera
    gets a site of its own kind.

    :param model: partial map of the observed cloud.
    :param places: (M, 3) metres, M >= 1.
    :param plans: placements (K, 6); their poses are the first sites of the list.
    :param rig_state: the rig.
    :param unseen: packed bits of the model's cells that count as unseen.
    :param weight: bonus for each covered unseen cell, metres of depth error.
    :ivar sites: (S, 6) x, y, z in metres, yaw, pitch, roll in radians.
    """

    def __init__(self, model: PartialMap, places: np.ndarray, plans: Sequence[np.ndarray],
                 rig_state: RigState, unseen: np.ndarray, weight: float) -> None:
        self.model, self.weight = model, weight
        self.kind_of, firsts = kinds_of(rig_state)
        sites, of_kind, views = [], [], []
        for plan in plans:
            views += [model.look(row, camera.lens) for row, camera in zip(plan, rig_state.models)]
            sites += list(plan)
            of_kind += self.kind_of.tolist()
        for kind, camera in enumerate(firsts):
            headings = rig_state.headings(camera, YAWS, PITCHES)
            look = partial(model.look_many, headings=headings, lens=rig_state.models[camera].lens)
            for place, some in zip(places, mapped(look, places)):
                views += some
                sites += [np.concatenate([place, heading]) for heading in headings]
                of_kind += [kind] * len(headings)
        self.sites, self.places = np.array(sites), np.array(sites)[:, :2]
        self._of_kind = [np.flatnonzero(np.array(of_kind) == kind) for kind in range(len(firsts))]
        self._see(views, fixed_views(model, rig_state), unseen)
        self._near = np.zeros((len(sites), NEIGHBOURS + 1), dtype=np.int64)
        for own in self._of_kind:
            near = self._neighbours(own)
            self._near[own, :near.shape[1]] = near

    def _neighbours(self, own: np.ndarray) -> np.ndarray:
        """List the most similar sites of the same kind for each site of a kind."""
        forward = np.array([rotation_matrix(*row[3:])[:, 0] for row in self.sites[own]])
        tree = cKDTree(np.hstack([self.sites[own, :3], PER_RADIAN * forward]))
        _, near = tree.query(tree.data, min(NEIGHBOURS + 1, len(own)))
        return own[near.reshape(len(own), -1)]

    def headings(self, chosen: np.ndarray) -> np.ndarray:
        """Return the headings of a choice; see :meth:`Candidates.headings`."""
        return self.sites[chosen, 3:]


def kinds_of(rig_state: RigState) -> tuple[np.ndarray, list[int]]:
    """
    Group the cameras of a rig into kinds: cameras of one kind may exchange their poses.

    :returns: (K,) the kind of each camera, and the first camera of each kind.
    """
    free = 5 if rig_state.turns else 3
    keys = [(model, () if model.omnidirectional else tuple(row[free:]))
            for model, row in zip(rig_state.models[:rig_state.movable], rig_state.placement)]
    kinds = list(dict.fromkeys(keys))
    return np.array([kinds.index(key) for key in keys]), [keys.index(kind) for kind in kinds]


def most_places(rig_state: RigState) -> int:
    """Return the largest number of candidate positions so that poses stay within ``SITES``."""
    _, firsts = kinds_of(rig_state)
    headings = sum(len(rig_state.headings(camera, YAWS, PITCHES)) for camera in firsts)
    return max(SITES // headings, 1)
