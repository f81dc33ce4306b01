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
Mixes of camera groups by price: which numbers of each group are worth a search.

The loss of a mix is estimated by greedy steps: of the mixes with one camera less, each is extended
by the best of some candidates, on small depth maps. A mix is on the Pareto front if no mix that
costs the same or less has as low a loss.
"""

from collections.abc import Iterable, Sequence
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
from ocp_ros.rig.rig_file import Rig, with_counts
from ocp_ros.search.candidate_pool import are_spaced, CandidatePool, Sites, views_of
from ocp_ros.search.pose_decoder import coarse_objective
from ocp_ros.simulation.objective import Objective
from ocp_ros.util.settings import MAX_CAMERAS

T = TypeVar('T')

#: Number of candidates that are compared for each camera of a mix.
COMPARED = 150


class Mix(NamedTuple):
    """
    A number of cameras of each group of a rig.

    :ivar counts: for each group of the rig's document.
    :ivar rig: the rig with these cameras.
    :ivar price: of all these cameras.
    :ivar sites: a placement by greedy steps.
    :ivar loss: of this placement, on small depth maps.
    """

    counts: tuple[int, ...]
    rig: Rig
    price: float
    sites: Sites
    loss: float


def prices_of(rig: Rig) -> list[float]:
    """
    Return the price of one camera of each group of a rig.

    :raises ConfigurationError: if a price is not known.
    """
    prices = []
    for number, camera in enumerate(rig.group_cameras):
        if camera.price is None:
            raise rig.document.error(
                ('cameras', number), f'{camera.name}, whose price is not known',
                'a price for each group of cameras', 'add price: 419')
        prices.append(float(camera.price))
    return prices


def mixes_of(objective: Objective, pool: CandidatePool, max_cameras: int, max_price: float,
             rng: np.random.Generator) -> list[Mix]:
    """
    Return all mixes of a rig's groups that fit, the cheapest first, with estimates of their loss.

    :param objective: of the rig with all groups.
    :param pool: candidates of all its models.
    :param max_cameras: largest number of cameras of a mix.
    :param max_price: largest price of a mix.
    :param rng: chooses the candidates that are compared.
    """
    rig, coarse = objective.rig, coarse_objective(objective)
    prices, models = prices_of(rig), [camera.model for camera in rig.group_cameras]
    most = min(max_cameras, MAX_CAMERAS - len(rig.fixed))
    least = max(rig.least_cameras - len(rig.fixed), 1)
    # The sites of each group, by the numbers of cameras.
    placed: dict[tuple[int, ...], tuple[Sites, ...]] = {(0,) * len(models): ((),) * len(models)}
    mixes = []
    for counts in sorted(product(range(most + 1), repeat=len(models)), key=sum):
        price = float(np.dot(counts, prices))
        if not 0 < sum(counts) <= most or price > max_price:
            continue
        best: tuple[float, tuple[Sites, ...]] | None = None
        for group, model in enumerate(models):
            fewer = placed.get(tuple(np.subtract(counts, np.eye(len(models), dtype=int)[group])))
            if fewer is None:
                continue
            candidates = pool.candidates_of(model)
            sites = [site for part in fewer for site in part]
            rows = rng.choice(len(candidates.poses), min(COMPARED, len(candidates.poses)), False)
            rows = rows[are_spaced(candidates.poses[rows], sites, rig.spacing)]
            losses = coarse.losses_with(
                views_of(sites), [candidates.views[row] for row in rows], eased=True)
            for row, loss in zip(rows, losses):
                if best is None or loss < best[0]:
                    added = (*fewer[group], pool.mounted_candidate(model, row))
                    best = loss, (*fewer[:group], added, *fewer[group + 1:])
        if best is None:
            continue
        placed[counts] = best[1]
        if sum(counts) >= least:
            sites = tuple(site for part in best[1] for site in part)
            mixes.append(Mix(counts, with_counts(rig, counts), price, sites,
                             coarse.loss(views_of(sites))))
    return sorted(mixes, key=lambda mix: (mix.price, mix.loss))


def pareto_front(items: Iterable[T], costs: Sequence[float], losses: Sequence[float]) -> list[T]:
    """Return the items whose loss is lower than that of all that cost the same or less."""
    order = sorted(range(len(costs)), key=lambda k: (costs[k], losses[k]))
    items, front, least = list(items), [], np.inf
    for k in order:
        if losses[k] < least:
            front.append(items[k])
            least = losses[k]
    return front
