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
Summary of a comparison: sums, intervals and tests over its rows.

The *delivered* error of a placement is computed by the judge, the *promised* error by the engine
of the search. The *regret* is the delivered error divided by the best delivered error of the
searches with ray casting.

Errors are averaged over seeds, then over the rotations of a room, and summed over rooms, as in
Table I of arXiv 2110.11106. Intervals are percentile bootstraps over rooms, because rooms differ
more than seeds.

Two planners are also compared by room, each room as a pair. The errors of rooms differ by a factor
of up to one hundred, so logarithms are compared: a ratio is the geometric mean over rooms, and the
signed-rank test (Wilcoxon, 1945) tests whether it differs from 1.
"""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from ocp_ros.compare.protocol import PROVED_OPTIMUM, RANDOM_PLACEMENT, RAY_SEARCH, REFERENCES
from scipy import stats

Rows = list[dict[str, Any]]
#: Added to errors before their logarithm, metres: the error is 0 in some rooms.
LOG_OFFSET_M = 0.01


def best_known(rows: Rows) -> dict[str, float]:
    """Return the smallest delivered depth error of the searches with ray casting, by room."""
    best: dict[str, dict[float, float]] = defaultdict(lambda: defaultdict(lambda: np.inf))
    for row in rows:
        if row['planner'] == RAY_SEARCH:
            turned = best[row['room']]
            turned[row['rotation']] = min(turned[row['rotation']], row['depth_error'])
    return {room: float(np.mean(list(turned.values()))) for room, turned in best.items()}


def per_room(rows: Rows, planner: str, budget: int, figure: str) -> dict[str, float]:
    """Return the mean of a figure over seeds and rotations, by room."""
    cases = defaultdict(list)
    for row in rows:
        if row['planner'] == planner and row['budget'] == budget:
            cases[row['room']].append(row[figure])
    return {room: float(np.mean(values)) for room, values in cases.items()}


def runs_in(rows: Rows) -> list[tuple[str, int]]:
    """Return the compared planners with each of their budgets."""
    return list(dict.fromkeys((row['planner'], row['budget']) for row in rows
                              if row['planner'] not in REFERENCES))


def interval(values: np.ndarray, total: Callable[..., np.ndarray] = np.sum) -> list[float]:
    """
    Return the 95 % bootstrap interval of a sum over rooms.

    :param values: (R,) one for each room.
    :param total: ``np.sum``, or ``np.mean`` for the interval of the mean.
    """
    rng = np.random.default_rng(0)
    # 2000 resamples of the bootstrap.
    draws = total(values[rng.integers(len(values), size=(2000, len(values)))], axis=1)
    return [float(edge) for edge in np.percentile(draws, [2.5, 97.5])]


def summarise(rows: Rows) -> dict[str, Any]:
    """
    Summarise a comparison.

    :param rows: of :func:`~ocp_ros.compare.protocol.run_task`.
    :returns: ``planners``: by planner and budget (as text) ``sum`` of the delivered errors and its
        ``interval``, ``rooms`` (the errors by room), ``wins``, ``regret`` (of the sums),
        ``regret_geometric`` (mean over rooms), ``promised`` (sum), ``promise_over_delivered``
        (mean over rooms), ``promise_worst_room`` (the ratio farthest from 1), ``gap_closed``,
        ``seconds`` and ``evaluations`` (means), ``seeds``, and for online planners, whose budget
        is 0, ``seconds_per_turn`` (median) and ``seconds_at_most``. A ratio is None if its
        denominator is 0. Most of these are also in ``truth``, for the searches with ray casting,
        and, if there are proofs, in ``exact``, for the placements of column generation, with
        ``bounds`` by room; then ``exact`` and the planners have ``promised_over_bound`` (of sums).
        Further: ``rank_tests`` by budget, ``rooms`` with their reference errors, and ``notes`` on
        rooms whose errors are too small to compare planners.
    """
    known, rooms = best_known(rows), list(dict.fromkeys(row['room'] for row in rows))
    control = per_room(rows, RANDOM_PLACEMENT, 1, 'depth_error')
    least = per_room(rows, RANDOM_PLACEMENT, 1, 'lower_bound')
    runs = runs_in(rows)
    errors = {run: per_room(rows, *run, 'depth_error') for run in runs}
    summary: dict[str, Any] = {'rooms': {
        room: {'best_known': known[room], 'random_placement': control[room],
               'share': _share(known[room], control[room]),
               'lower_bound': least[room]} for room in rooms}, 'planners': {}, 'rank_tests': {}}
    # Below this share of a random placement's error the best known error is too small to compare.
    saturated_share = 0.01
    summary['notes'] = [
        f'{Path(room).stem}: found that the best known leaves {known[room]:.3f} m, less than '
        f'{100.0 * saturated_share:g} % of what a random placement leaves; expected more to be '
        'missed; ratios to so little say nothing: use fewer cameras or a larger room'
        for room in rooms if control[room] > 0.0 and known[room] < saturated_share * control[room]]
    chance = sum(control.values())
    for planner, budget in runs:
        values = np.array([errors[planner, budget][room] for room in rooms])
        rivals = [errors[run] for run in runs if run[1] == budget]
        figures = {
            **_delivered(rows, planner, budget, known),
            'interval': interval(values), 'rooms': errors[planner, budget],
            'wins': sum(errors[planner, budget][room] <= min(rival[room] for rival in rivals)
                        for room in rooms),
            'gap_closed': _share(chance - values.sum(), chance - sum(known.values()))}
        summary['planners'].setdefault(planner, {})[str(budget)] = figures
    if proofs := [row for row in rows if row['planner'] == PROVED_OPTIMUM]:
        summary['exact'] = _proved(rows, proofs, known)
        bound = sum(row['bound'] for row in proofs) / len(proofs) * len(rooms)
        for figures in (*(run for runs in summary['planners'].values() for run in runs.values()),
                        summary['exact']):
            figures['promised_over_bound'] = _share(figures['promised'], bound)
    last, = {row['budget'] for row in rows if row['planner'] == RAY_SEARCH}
    summary['truth'] = _delivered(rows, RAY_SEARCH, last, known)
    for budget in dict.fromkeys(budget for _, budget in runs):
        names = [planner for planner, other in runs if other == budget]
        summary['rank_tests'][str(budget)] = ranks(
            {name: np.array([errors[name, budget][room] for room in rooms]) for name in names})
    return summary


def _proved(rows: Rows, proofs: Rows, known: dict[str, float]) -> dict[str, Any]:
    """Return the figures of the placements of column generation, and their optimality gaps."""
    gaps = [_share(row['found'] - row['bound'], row['found']) or 0.0 for row in proofs]
    return {**_delivered(rows, PROVED_OPTIMUM, proofs[0]['budget'], known),
            'candidates': proofs[0]['budget'], 'proved': sum(row['proved'] for row in proofs),
            'worst_gap': max(gaps), 'bounds': {row['room']: row['bound'] for row in proofs}}


def _delivered(rows: Rows, planner: str, budget: int, known: dict[str, float]) -> dict[str, Any]:
    """Return a planner's delivered and promised errors over all rooms, and its seconds."""
    delivered = per_room(rows, planner, budget, 'depth_error')
    promised = per_room(rows, planner, budget, 'promised')
    kept = [promised[room] / error for room, error in delivered.items() if error > 0.0]
    regrets = [error / known[room] for room, error in delivered.items() if known[room] > 0.0]
    own = [row for row in rows if (row['planner'], row['budget']) == (planner, budget)]
    figures: dict[str, Any] = {
        'sum': sum(delivered.values()), 'promised': sum(promised.values()),
        'regret': _share(sum(delivered.values()), sum(known.values())),
        'regret_geometric': float(stats.gmean(regrets)) if regrets else None,
        'promise_over_delivered': float(np.mean(kept)) if kept else None,
        'promise_worst_room': max(kept, key=lambda share: abs(share - 1.0), default=None),
        'seeds': len({row['seed'] for row in own})}
    for name in ('seconds', 'evaluations'):
        figures[name] = float(np.mean(list(per_room(rows, planner, budget, name).values())))
    if 'seconds_per_turn' in own[0]:
        figures['seconds_per_turn'] = float(np.median([row['seconds_per_turn'] for row in own]))
        figures['seconds_at_most'] = float(np.max([row['seconds_at_most'] for row in own]))
    return figures


def _share(part: float, whole: float) -> float | None:
    """Return a ratio; None if the denominator is 0, as in rooms without any depth error."""
    return float(part / whole) if whole > 0.0 else None


def budgets_of(summary: dict[str, Any]) -> list[str]:
    """Return the budgets, the smallest first; 0 is the budget of online planners."""
    return sorted({budget for runs in summary['planners'].values() for budget in runs}, key=int)


def last_runs(summary: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the figures of each planner at the largest budget, online planners included."""
    last = budgets_of(summary)[-1]
    return {name: runs.get(last, runs.get('0')) for name, runs in summary['planners'].items()
            if last in runs or '0' in runs}


def ranks(errors: dict[str, np.ndarray]) -> dict[str, Any]:
    """
    Rank planners over rooms.

    :param errors: by planner (R,), one for each room.
    :returns: mean ranks (1 is best), the p-value of the Friedman test that all planners are equal,
        and for each planner the p-value of Wilcoxon's signed-rank test against the planner of best
        mean rank, corrected after Holm. With too few rooms or planners there are no p-values.
    """
    names, table = list(errors), np.array(list(errors.values()))
    mean = stats.rankdata(table, axis=0).mean(axis=1)
    leader = int(np.argmin(mean))
    result: dict[str, Any] = {'mean_rank': dict(zip(names, map(float, mean))),
                              'leader': names[leader], 'friedman_p': None, 'against_leader': {}}
    if table.shape[1] < 5 or len(names) < 3:
        return result
    result['friedman_p'] = float(stats.friedmanchisquare(*table).pvalue)
    others = [k for k in range(len(names)) if k != leader and (table[k] != table[leader]).any()]
    values = [float(stats.wilcoxon(table[k], table[leader]).pvalue) for k in others]
    highest = 0.0
    for place, k in enumerate(np.argsort(values)):
        highest = max(highest, min(1.0, (len(values) - place) * values[k]))
        result['against_leader'][names[others[k]]] = highest
    return result


def pairs(rows: Rows, first: str) -> dict[str, dict[str, Any]]:
    """
    Compare a planner with each other planner.

    :param rows: of :func:`~ocp_ros.compare.protocol.run_task`.
    :param first: name of the first planner.
    :returns: by planner, and by budget if there are several: ``sum`` over rooms, metres; ``wins``,
        the number of rooms in which the first planner is better; ``rooms``, their number;
        ``ratio``, the first planner's error divided by the other's, with its 95 % bootstrap
        ``interval``; and ``p`` of the signed-rank test, None with too few or equal errors.
    """
    runs = runs_in(rows)
    errors = {run: per_room(rows, *run, 'depth_error') for run in runs}
    (base,) = [run for run in runs if run[0] == first][-1:]
    rooms = list(errors[base])
    own = np.array([errors[base][room] for room in rooms])
    return {_named(run, runs): pair(own, np.array([errors[run][room] for room in rooms]))
            for run in runs}


def _named(run: tuple[str, int], runs: list[tuple[str, int]]) -> str:
    """Return a planner's name, with its budget if there are several."""
    planner, budget = run
    return planner if sum(name == planner for name, _ in runs) == 1 else f'{planner}, {budget:,}'


def pair(own: np.ndarray, other: np.ndarray) -> dict[str, Any]:
    """Compare the errors (R,) of two planners in the same rooms; see :func:`pairs`."""
    gain = np.log(own + LOG_OFFSET_M) - np.log(other + LOG_OFFSET_M)
    tested = len(gain) >= 5 and np.any(gain != 0.0)
    return {'sum': float(other.sum()), 'wins': int(np.sum(own < other)), 'rooms': len(gain),
            'ratio': float(np.exp(gain.mean())),
            'interval': np.exp(interval(gain, np.mean)).tolist(),
            'p': float(stats.wilcoxon(gain).pvalue) if tested else None}
