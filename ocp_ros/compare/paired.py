# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Planners room by room: who is better where, and whether that is more than chance.

Each room is its own pair. Rooms differ by a factor of hundred in how much is missed in them, so
logarithms are compared: a ratio is the geometric mean over rooms, and the signed-rank test
(Wilcoxon, 1945) asks whether it differs from one.
"""

from typing import Any

import numpy as np
from scipy import stats

from ocp_ros.compare.protocol import YARDSTICKS
from ocp_ros.compare.summary import per_room, Rows

#: Metres: errors are compared with so much added, since some rooms are seen completely.
NEGLIGIBLE = 0.01


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
    runs = list(dict.fromkeys((row['planner'], row['budget']) for row in rows
                              if row['planner'] not in YARDSTICKS))
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
    draws = np.random.default_rng(0).integers(len(gain), size=(2000, len(gain)))
    low, high = np.exp(np.percentile(gain[draws].mean(axis=1), [2.5, 97.5]))
    tested = len(gain) >= 5 and np.any(gain != 0.0)
    return {'sum': float(other.sum()), 'wins': int(np.sum(own < other)), 'rooms': len(gain),
            'ratio': float(np.exp(gain.mean())), 'interval': [float(low), float(high)],
            'p': float(stats.wilcoxon(gain).pvalue) if tested else None}
