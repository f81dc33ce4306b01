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
What the rows of a comparison say.

*Delivered* is what the judge says of a placement, *promised* what the engine said that it was
searched with, *regret* what is delivered over the best that a search with the truth delivered.

The mean over seeds stands for a turned room, the mean over its rotations for a room, and the sum
over rooms for a planner, as in Table I of arXiv 2110.11106. Intervals are percentile bootstraps
over rooms: rooms differ more than seeds do.

Planners are also compared room by room: who is better where, and whether that is more than chance.
Each room is its own pair. Rooms differ by a factor of hundred in how much is missed in them, so
logarithms are compared: a ratio is the geometric mean over rooms, and the signed-rank test
(Wilcoxon, 1945) asks whether it differs from one.
"""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from ocp_ros.compare.protocol import CONTROL, PROVED, TRUTH, YARDSTICKS
from scipy import stats

Rows = list[dict[str, Any]]
#: Resamples of the bootstrap.
RESAMPLES = 2000
#: Share of a random placement's error below which the best known leaves nothing to be compared.
SATURATED = 0.01
#: Metres: errors are compared with so much added, since some rooms are seen completely.
NEGLIGIBLE = 0.01


def best_known(rows: Rows) -> dict[str, float]:
    """Return the least depth error that searches with the truth delivered, by room."""
    best: dict[str, dict[float, float]] = defaultdict(lambda: defaultdict(lambda: np.inf))
    for row in rows:
        if row['planner'] == TRUTH:
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
    """Return the planners that are compared, each with its budgets."""
    return list(dict.fromkeys((row['planner'], row['budget']) for row in rows
                              if row['planner'] not in YARDSTICKS))


def interval(values: np.ndarray, total: Callable[..., np.ndarray] = np.sum) -> list[float]:
    """
    Return the 95 % bootstrap interval of a sum over rooms.

    :param values: (R,) one per room.
    :param total: ``np.sum``, or ``np.mean`` for the interval of the mean.
    """
    rng = np.random.default_rng(0)
    draws = total(values[rng.integers(len(values), size=(RESAMPLES, len(values)))], axis=1)
    return [float(edge) for edge in np.percentile(draws, [2.5, 97.5])]


def summarise(rows: Rows) -> dict[str, Any]:
    """
    Sum a comparison up.

    :param rows: of :func:`~ocp_ros.compare.protocol.run_task`.
    :returns: by planner and budget, as text: ``sum`` of what is delivered, ``interval``,
        ``rooms``, ``wins``, ``regret`` (of the sums) and ``regret_geometric`` (mean over rooms),
        ``promised`` (its sum), ``promise_over_delivered`` (mean over rooms),
        ``promise_worst_room`` (the ratio farthest from 1), ``gap_closed`` (ratios are None where
        nothing is ever missed), ``seconds``, ``seeds`` and, of online planners, whose budget is
        0, ``seconds_per_turn`` (median) and ``seconds_at_most``; the same of ``truth``, the
        search with the truth, and of ``exact``, the placements that are proved best on
        candidates, with ``bounds`` by room; ``promised_over_bound``, of the sums; the rank test
        of each budget; what is known of each room; and ``notes`` on rooms that tell planners
        apart no more.
    """
    known, rooms = best_known(rows), list(dict.fromkeys(row['room'] for row in rows))
    control = per_room(rows, CONTROL, 1, 'depth_error')
    least = per_room(rows, CONTROL, 1, 'lower_bound')
    runs = runs_in(rows)
    errors = {run: per_room(rows, *run, 'depth_error') for run in runs}
    summary: dict[str, Any] = {'rooms': {
        room: {'best_known': known[room], 'random_placement': control[room],
               'share': _share(known[room], control[room]),
               'lower_bound': least[room]} for room in rooms}, 'planners': {}, 'rank_tests': {}}
    summary['notes'] = [
        f'{Path(room).stem}: found that the best known leaves {known[room]:.3f} m, less than '
        f'{100.0 * SATURATED:g} % of what a random placement leaves; expected more to be missed; '
        'ratios to so little say nothing: use fewer cameras or a larger room'
        for room in rooms if control[room] > 0.0 and known[room] < SATURATED * control[room]]
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
    if proofs := [row for row in rows if row['planner'] == PROVED]:
        summary['exact'] = _proved(rows, proofs, known)
        bound = sum(row['bound'] for row in proofs) / len(proofs) * len(rooms)
        for figures in (*(run for runs in summary['planners'].values() for run in runs.values()),
                        summary['exact']):
            figures['promised_over_bound'] = _share(figures['promised'], bound)
    ((_, last),) = {(row['planner'], row['budget']) for row in rows if row['planner'] == TRUTH}
    summary['truth'] = _delivered(rows, TRUTH, last, known)
    for budget in dict.fromkeys(budget for _, budget in runs):
        names = [planner for planner, other in runs if other == budget]
        summary['rank_tests'][str(budget)] = ranks(
            {name: np.array([errors[name, budget][room] for room in rooms]) for name in names})
    return summary


def _proved(rows: Rows, proofs: Rows, known: dict[str, float]) -> dict[str, Any]:
    """Say what the placements deliver that are proved best on candidates, and how well proved."""
    gaps = [_share(row['found'] - row['bound'], row['found']) or 0.0 for row in proofs]
    return {**_delivered(rows, PROVED, proofs[0]['budget'], known),
            'candidates': proofs[0]['budget'], 'proved': sum(row['proved'] for row in proofs),
            'worst_gap': max(gaps), 'bounds': {row['room']: row['bound'] for row in proofs}}


def _delivered(rows: Rows, planner: str, budget: int, known: dict[str, float]) -> dict[str, Any]:
    """Say what a planner delivered in all rooms, what it promised, and how long it took."""
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
    """Return a ratio, None where it means nothing: rooms that any placement sees completely."""
    return float(part / whole) if whole > 0.0 else None


def budgets_of(summary: dict[str, Any]) -> list[str]:
    """Return the budgets, least first; 0 stands for the turns of online planners."""
    return sorted({budget for runs in summary['planners'].values() for budget in runs}, key=int)


def last_runs(summary: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return each planner's figures at the largest budget, those of online planners as well."""
    last = budgets_of(summary)[-1]
    return {name: runs.get(last, runs.get('0')) for name, runs in summary['planners'].items()
            if last in runs or '0' in runs}


def ranks(errors: dict[str, np.ndarray]) -> dict[str, Any]:
    """
    Rank planners over rooms.

    :param errors: (R,) per planner, one for each room.
    :returns: mean ranks (1 is best), the Friedman test's p that all are alike, and for each
        planner Wilcoxon's signed-rank p against the one of best rank, corrected after Holm; NaN
        as None where there are too few rooms or planners.
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
    Compare a planner with each of the others.

    :param rows: of :func:`~ocp_ros.compare.protocol.run_task`.
    :param first: the planner that is compared.
    :returns: by planner, and budget where there are several: ``sum`` over rooms, metres;
        ``wins`` of the first over it; ``rooms``; ``ratio``, the first's error over its own, and
        its 95 % bootstrap ``interval``; and ``p`` of the signed-rank test, None where it has no
        meaning.
    """
    runs = runs_in(rows)
    errors = {run: per_room(rows, *run, 'depth_error') for run in runs}
    (base,) = [run for run in runs if run[0] == first][-1:]
    rooms = list(errors[base])
    own = np.array([errors[base][room] for room in rooms])
    return {_named(run, runs): pair(own, np.array([errors[run][room] for room in rooms]))
            for run in runs}


def _named(run: tuple[str, int], runs: list[tuple[str, int]]) -> str:
    """Return a planner's name, with its budget where there are several."""
    planner, budget = run
    return planner if sum(name == planner for name, _ in runs) == 1 else f'{planner}, {budget:,}'


def pair(own: np.ndarray, other: np.ndarray) -> dict[str, Any]:
    """Compare the errors (R,) of two planners in the same rooms; see :func:`pairs`."""
    gain = np.log(own + NEGLIGIBLE) - np.log(other + NEGLIGIBLE)
    tested = len(gain) >= 5 and np.any(gain != 0.0)
    return {'sum': float(other.sum()), 'wins': int(np.sum(own < other)), 'rooms': len(gain),
            'ratio': float(np.exp(gain.mean())),
            'interval': np.exp(interval(gain, np.mean)).tolist(),
            'p': float(stats.wilcoxon(gain).pvalue) if tested else None}
