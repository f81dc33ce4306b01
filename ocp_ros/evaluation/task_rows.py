# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether rows that were kept are those of a task: whole, and with numbers that can be."""

from dataclasses import asdict
from typing import Any

import numpy as np

from ocp_ros.evaluation.protocol import (
    BenchmarkTask,
    CONTROL,
    Protocol,
    PROVED,
)
from ocp_ros.planners.registry import ONLINE

#: Metres, cubic metres, seconds and evaluations are less.
LARGEST = 1e9
FIGURES = ('exact', 'space_coverage', 'depth_error', 'promised', 'evaluations', 'seconds')


def check_rows(rows: Any, protocol: Protocol, task: BenchmarkTask) -> None:
    """
    Refuse what :func:`~ocp_ros.evaluation.protocol.run_task` does not return for a task.

    :param rows: as they were read from a file.
    :raises ValueError: if they are damaged; KeyError and TypeError as well.
    """
    if not isinstance(rows, list):
        raise ValueError(f'{type(rows).__name__} in place of rows')
    runs = [(row['budget'], row['seed']) for row in rows]
    if sorted(runs) != sorted(protocol.runs(task.planner)):
        raise ValueError(f'{len(runs)} runs, not those of all budgets and seeds')
    for row in rows:
        if {name: row[name] for name in asdict(task)} != asdict(task):
            raise ValueError('runs of another task')
        for name in (*FIGURES, *_more(protocol, task)):
            if type(row[name]) not in (int, float) or not 0.0 <= row[name] < LARGEST:
                raise ValueError(f'{name} is {row[name]!r}')
        placement = np.array(row['placement'], dtype=np.float64)
        if placement.ndim != 2 or placement.shape[1] not in (3, 6) or not (
                np.abs(placement) < LARGEST).all():
            raise ValueError('a placement is none')
        trace = np.array(row['trace'], dtype=np.float64)
        if trace.size and (trace.ndim != 2 or trace.shape[1] != 3):
            raise ValueError('a trace is none')


def _more(protocol: Protocol, task: BenchmarkTask) -> tuple[str, ...]:
    """Return the figures that only some tasks have."""
    if task.planner == CONTROL:
        return ('lower_bound',)
    if task.planner == PROVED:
        return 'found', 'bound'
    if task.planner in ONLINE and not protocol.simulation.rig_file:
        return ('seconds_per_turn', 'seconds_at_most')
    return ()
