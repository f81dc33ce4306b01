# SPDX-License-Identifier: Apache-2.0
"""
What the rows of a comparison say.

The mean over seeds stands for a turned room, the mean over its rotations for a room, and the sum
over rooms for a planner, as in Table I of arXiv 2110.11106. Intervals are percentile bootstraps
over rooms: rooms differ more than seeds do.
"""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from ocp_ros.evaluation.protocol import CONTROL

Rows = list[dict[str, Any]]
#: Resamples of the bootstrap.
RESAMPLES = 2000
#: Share of a random placement's error below which the best known leaves nothing to be compared.
SATURATED = 0.01


def best_known(rows: Rows) -> dict[tuple[str, float], float]:
    """Return the least depth error of all methods, seeds and budgets for each turned room."""
    best: dict[tuple[str, float], float] = defaultdict(lambda: np.inf)
    for row in rows:
        case = row['room'], row['rotation']
        best[case] = min(best[case], row['depth_error'])
    return dict(best)


def per_room(rows: Rows, planner: str, budget: int, figure: str) -> dict[str, float]:
    """Return the mean of a figure over seeds and rotations, by room."""
    cases = defaultdict(list)
    for row in rows:
        if row['planner'] == planner and row['budget'] == budget:
            cases[row['room']].append(row[figure])
    return {room: float(np.mean(values)) for room, values in cases.items()}


def interval(values: np.ndarray) -> list[float]:
    """
    Return the 95 % bootstrap interval of a sum over rooms.

    :param values: (R,) one per room.
    """
    rng = np.random.default_rng(0)
    draws = values[rng.integers(len(values), size=(RESAMPLES, len(values)))].sum(axis=1)
    return [float(edge) for edge in np.percentile(draws, [2.5, 97.5])]


def summarise(rows: Rows) -> dict[str, Any]:
    """
    Sum a comparison up.

    :param rows: of :func:`~ocp_ros.evaluation.protocol.run_task`.
    :returns: by planner and budget, as text: ``sum``, ``interval``, ``rooms``, ``wins``,
        ``ratio_to_best_known`` and ``gap_closed`` (None where nothing is ever missed),
        ``seconds``, ``seeds``, ``off_5_cm``, ``off_10_cm`` and, of online planners, whose budget
        is 0, ``seconds_per_turn`` (median) and ``seconds_at_most``; the rank test of each budget;
        what is known of each room; and ``notes`` on rooms that tell planners apart no more.
    """
    best = best_known(rows)
    rooms = list(dict.fromkeys(row['room'] for row in rows))
    known = {room: float(np.mean([error for (name, _), error in best.items() if name == room]))
             for room in rooms}
    control = per_room(rows, CONTROL, 1, 'depth_error')
    least = per_room(rows, CONTROL, 1, 'lower_bound')
    runs = list(dict.fromkeys((row['planner'], row['budget']) for row in rows
                              if row['planner'] != CONTROL))
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
    total, chance = sum(known.values()), sum(control.values())
    for planner, budget in runs:
        values = np.array([errors[planner, budget][room] for room in rooms])
        rivals = [errors[run] for run in runs if run[1] == budget]
        figures = {
            'sum': float(values.sum()), 'interval': interval(values),
            'rooms': errors[planner, budget],
            'wins': sum(errors[planner, budget][room] <= min(rival[room] for rival in rivals)
                        for room in rooms),
            'ratio_to_best_known': _share(values.sum(), total),
            'gap_closed': _share(chance - values.sum(), chance - total),
            'seeds': len({row['seed'] for row in rows
                          if (row['planner'], row['budget']) == (planner, budget)})}
        for figure in ('seconds', 'evaluations'):
            figures[figure] = float(np.mean(list(
                per_room(rows, planner, budget, figure).values())))
        for figure in ('seconds_per_turn', 'seconds_at_most'):
            values = [row[figure] for row in rows if row['planner'] == planner and figure in row]
            if values:
                figures[figure] = float(
                    np.median(values) if figure == 'seconds_per_turn' else np.max(values))
        for figure in ('exact', 'off_5_cm', 'off_10_cm'):
            figures[figure] = sum(per_room(rows, planner, budget, figure).values())
        summary['planners'].setdefault(planner, {})[str(budget)] = figures
    for budget in dict.fromkeys(budget for _, budget in runs):
        names = [planner for planner, other in runs if other == budget]
        summary['rank_tests'][str(budget)] = ranks(
            {name: np.array([errors[name, budget][room] for room in rooms]) for name in names})
    return summary


def _share(part: float, whole: float) -> float | None:
    """Return a ratio, None where it means nothing: rooms that any placement sees completely."""
    return float(part / whole) if whole > 0.0 else None


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
