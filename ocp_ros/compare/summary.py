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
search with ray casting.

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
from ocp_ros.compare.protocol import RANDOM_PLACEMENT, RAY_SEARCH
from ocp_ros.search.registry import REFERENCES
from scipy import stats

#: Rows of :func:`~ocp_ros.compare.protocol.run_task`.
Rows = list[dict[str, Any]]
#: Added to errors before their logarithm, metres: the error is 0 in some rooms.
LOG_OFFSET_M = 0.01


def per_room(rows: Rows, planner: str, budget: int, figure: str) -> dict[str, float]:
    """
    Return the mean of a figure over seeds and rotations, by room.

    :param figure: name of the figure in the rows, such as ``depth_error``.
    """
    values_by_room = defaultdict(list)
    for row in rows:
        if row['planner'] == planner and row['budget'] == budget:
            values_by_room[row['room']].append(row[figure])
    return {room: float(np.mean(values)) for room, values in values_by_room.items()}


def planners_and_budgets(rows: Rows) -> list[tuple[str, int]]:
    """Return each compared planner with each of its budgets, without the references."""
    return list(dict.fromkeys((row['planner'], row['budget']) for row in rows
                              if row['planner'] not in REFERENCES))


def interval(values: np.ndarray, total: Callable[..., np.ndarray] = np.sum) -> list[float]:
    """
    Return the 95 % bootstrap interval of a sum over rooms: its lower and upper end.

    :param values: (R,) one for each of R rooms.
    :param total: ``np.sum``, or ``np.mean`` for the interval of the mean.
    """
    rng = np.random.default_rng(0)
    resamples = 2000
    totals = total(values[rng.integers(len(values), size=(resamples, len(values)))], axis=1)
    return [float(end) for end in np.percentile(totals, [2.5, 97.5])]


def summarise(rows: Rows) -> dict[str, Any]:
    """
    Summarise a comparison.

    :param rows: of :func:`~ocp_ros.compare.protocol.run_task`.
    :returns: ``planners``: by planner and budget (as text) ``sum`` of the delivered errors and its
        ``interval``, ``rooms`` (the errors by room), ``wins`` (number of rooms with the least
        error), ``regret`` (of the sums), ``regret_geometric`` (mean over rooms), ``promised``
        (sum), ``promise_over_delivered`` (mean over rooms), ``promise_worst_room`` (the ratio
        farthest from 1), ``gap_closed`` (reduction of a random placement's error, as a share of
        that by the best known placement), ``seconds`` and ``evaluations`` (means), ``seeds``, and
        for online planners, whose budget is 0, ``seconds_per_turn`` (median) and
        ``seconds_at_most``. A ratio is None if its denominator is 0. Most of these are also in
        ``truth``, for the search with ray casting. Planners with a proof have ``gap``, the mean
        optimality gap. Further: ``rank_tests`` by budget, ``rooms`` with their reference errors,
        and ``notes`` on rooms whose errors are too small to compare planners.
    """
    # The search with ray casting has one run in each room and rotation.
    ray_budget, = {row['budget'] for row in rows if row['planner'] == RAY_SEARCH}
    best_errors = per_room(rows, RAY_SEARCH, ray_budget, 'depth_error')
    rooms = list(dict.fromkeys(row['room'] for row in rows))
    # The budget of a random placement is 1.
    random_errors = per_room(rows, RANDOM_PLACEMENT, 1, 'depth_error')
    lower_bounds = per_room(rows, RANDOM_PLACEMENT, 1, 'lower_bound')
    # Here, a run is a planner with a budget, over all seeds.
    runs = planners_and_budgets(rows)
    errors = {run: per_room(rows, *run, 'depth_error') for run in runs}
    summary: dict[str, Any] = {'rooms': {}, 'planners': {}, 'rank_tests': {}}
    for room in rooms:
        summary['rooms'][room] = {
            'best_known': best_errors[room], 'random_placement': random_errors[room],
            'share': _ratio(best_errors[room], random_errors[room]),
            'lower_bound': lower_bounds[room]}
    # Below this share of a random placement's error the best known error is too small to compare.
    saturated_share = 0.01
    summary['notes'] = [
        f'{Path(room).stem}: found that the best known leaves {best_errors[room]:.3f} m, less '
        f'than {100.0 * saturated_share:g} % of what a random placement leaves; expected more to '
        'be missed; ratios to so little say nothing: use fewer cameras or a larger room'
        for room in rooms if random_errors[room] > 0.0
        and best_errors[room] < saturated_share * random_errors[room]]
    # The figures of each planner with each budget.
    random_sum, best_sum = sum(random_errors.values()), sum(best_errors.values())
    for planner, budget in runs:
        values = np.array([errors[planner, budget][room] for room in rooms])
        rivals = [errors[run] for run in runs if run[1] == budget]
        least_errors = np.array([min(rival[room] for rival in rivals) for room in rooms])
        summary['planners'].setdefault(planner, {})[str(budget)] = {
            **_planner_figures(rows, planner, budget, best_errors),
            'interval': interval(values), 'rooms': errors[planner, budget],
            'wins': int(np.sum(values <= least_errors)),
            'gap_closed': _ratio(random_sum - values.sum(), random_sum - best_sum)}
    summary['truth'] = _planner_figures(rows, RAY_SEARCH, ray_budget, best_errors)
    for budget in dict.fromkeys(budget for _, budget in runs):
        names = [planner for planner, other in runs if other == budget]
        summary['rank_tests'][str(budget)] = ranks(
            {name: np.array([errors[name, budget][room] for room in rooms]) for name in names})
    return summary


def _planner_figures(rows: Rows, planner: str, budget: int, best_errors: dict[str, float]
                     ) -> dict[str, Any]:
    """Return a planner's delivered and promised errors over all rooms, and its seconds."""
    delivered = per_room(rows, planner, budget, 'depth_error')
    promised = per_room(rows, planner, budget, 'promised')
    ratios = [promised[room] / error for room, error in delivered.items() if error > 0.0]
    regrets = [error / best_errors[room] for room, error in delivered.items()
               if best_errors[room] > 0.0]
    planner_rows = [row for row in rows if (row['planner'], row['budget']) == (planner, budget)]
    figures: dict[str, Any] = {
        'sum': sum(delivered.values()), 'promised': sum(promised.values()),
        'regret': _ratio(sum(delivered.values()), sum(best_errors.values())),
        'regret_geometric': float(stats.gmean(regrets)) if regrets else None,
        'promise_over_delivered': float(np.mean(ratios)) if ratios else None,
        'promise_worst_room': max(ratios, key=lambda ratio: abs(ratio - 1.0), default=None),
        'seeds': len({row['seed'] for row in planner_rows})}
    for name in ('seconds', 'evaluations'):
        figures[name] = float(np.mean(list(per_room(rows, planner, budget, name).values())))
    if gaps := [row['gap'] for row in planner_rows if 'gap' in row]:
        figures['gap'] = float(np.mean(gaps))
    if 'seconds_per_turn' in planner_rows[0]:
        for name, reduce in (('seconds_per_turn', np.median), ('seconds_at_most', np.max)):
            figures[name] = float(reduce([row[name] for row in planner_rows]))
    return figures


def _ratio(numerator: float, denominator: float) -> float | None:
    """Return a ratio; None if the denominator is 0, as in rooms without any depth error."""
    return float(numerator / denominator) if denominator > 0.0 else None


def budgets_of(summary: dict[str, Any]) -> list[str]:
    """Return the budgets in a summary as text, the smallest first; online planners have 0."""
    return sorted({budget for runs in summary['planners'].values() for budget in runs}, key=int)


def last_runs(summary: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the figures of each planner at the largest budget, online planners included."""
    largest = budgets_of(summary)[-1]
    return {name: figures.get(largest, figures.get('0')) for name, figures
            in summary['planners'].items() if largest in figures or '0' in figures}


def ranks(errors: dict[str, np.ndarray]) -> dict[str, Any]:
    """
    Rank planners over rooms.

    :param errors: by planner (R,), one for each of R rooms.
    :returns: ``mean_rank`` by planner (1 is best), ``leader`` (the planner of best mean rank),
        ``friedman_p``, the p-value of the Friedman test that all planners are equal, and
        ``against_leader``, for each planner that differs from the leader in a room, the p-value of
        Wilcoxon's signed-rank test against the leader, corrected after Holm. With fewer than five
        rooms or three planners, ``friedman_p`` is None and ``against_leader`` is empty.
    """
    names = list(errors)
    table = np.array(list(errors.values()))
    mean_ranks = stats.rankdata(table, axis=0).mean(axis=1)
    leader = int(np.argmin(mean_ranks))
    result: dict[str, Any] = {'mean_rank': dict(zip(names, map(float, mean_ranks))),
                              'leader': names[leader], 'friedman_p': None, 'against_leader': {}}
    if table.shape[1] < 5 or len(names) < 3:
        return result
    result['friedman_p'] = float(stats.friedmanchisquare(*table).pvalue)
    # Without any difference from the leader, there is nothing to test.
    others = [k for k in range(len(names)) if k != leader and (table[k] != table[leader]).any()]
    p_values = [float(stats.wilcoxon(table[k], table[leader]).pvalue) for k in others]
    # Holm: multiply each p-value, the smallest first, by the number of tests left; the results do
    # not decrease.
    corrected = 0.0
    for rank, k in enumerate(np.argsort(p_values)):
        corrected = max(corrected, min(1.0, (len(p_values) - rank) * p_values[k]))
        result['against_leader'][names[others[k]]] = corrected
    return result


def pairs(rows: Rows, first: str) -> dict[str, dict[str, Any]]:
    """
    Compare a planner with each other planner.

    :param rows: of :func:`~ocp_ros.compare.protocol.run_task`.
    :param first: name of the first planner.
    :returns: by planner, and by budget if there are several: ``sum`` over rooms, metres; ``wins``,
        the number of rooms in which the first planner is better; ``rooms``, their number;
        ``ratio``, the first planner's error divided by the other's, with its 95 % bootstrap
        ``interval``; and ``p`` of the signed-rank test, None with fewer than five rooms or only
        equal errors. If the first planner has several budgets, its errors are those with the last
        one.
    """
    runs = planners_and_budgets(rows)
    errors = {run: per_room(rows, *run, 'depth_error') for run in runs}
    (base,) = [run for run in runs if run[0] == first][-1:]
    rooms = list(errors[base])
    first_errors = np.array([errors[base][room] for room in rooms])
    return {_run_name(run, runs): pair(first_errors, np.array([by_room[room] for room in rooms]))
            for run, by_room in errors.items()}


def _run_name(run: tuple[str, int], runs: list[tuple[str, int]]) -> str:
    """Return a planner's name, with its budget if there are several."""
    planner, budget = run
    return planner if sum(name == planner for name, _ in runs) == 1 else f'{planner}, {budget:,}'


def pair(first_errors: np.ndarray, other_errors: np.ndarray) -> dict[str, Any]:
    """Compare the errors (R,), metres, of two planners in the same rooms; see :func:`pairs`."""
    log_ratios = np.log(first_errors + LOG_OFFSET_M) - np.log(other_errors + LOG_OFFSET_M)
    tested = len(log_ratios) >= 5 and np.any(log_ratios != 0.0)
    return {'sum': float(other_errors.sum()), 'wins': int(np.sum(first_errors < other_errors)),
            'rooms': len(log_ratios), 'ratio': float(np.exp(log_ratios.mean())),
            'interval': np.exp(interval(log_ratios, np.mean)).tolist(),
            'p': float(stats.wilcoxon(log_ratios).pvalue) if tested else None}
