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
Expected depth error of a placement in the room itself, from the engine's error on its scan.

A search fits the placement to the scan, so the error in the room is mostly a little larger. A scan
without ceiling or floor has no points there, so the engine does not count what the cameras miss on
them. The ratio of both errors was measured in generated rooms, whose meshes are known. The table
is ``promise.json``, written by ``benchmarks/promise.py``.
"""

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
import json
from typing import Any

import numpy as np


@cache
def _table() -> dict[str, Any]:
    """Return the table of ratios."""
    return json.loads(files(__package__).joinpath('promise.json').read_text())


def ratios_for(error: float, nothing: float, missing: Sequence[str]) -> list[float]:
    """Return the smallest, the median and the largest ratio for :func:`expected`."""
    for surface in missing:
        if surface in _table():
            return _table()[surface]['ratios']
    levels = _table()['levels']
    number = np.searchsorted([level['from'] for level in levels], error / nothing, side='right')
    return levels[max(int(number) - 1, 0)]['ratios']


def expected(error: float, nothing: float, missing: Sequence[str] = ()) -> dict[str, float]:
    """
    Return the depth error that a placement is expected to have in the room itself.

    :param error: depth error by the engine, metres.
    :param nothing: depth error without any visible point, metres.
    :param missing: surfaces without points in the scan, from
        :func:`~ocp_ros.rig.plausibility.missing_surfaces`.
    :returns: ``depth_error``, ``low`` and ``high``, metres; in nine of ten rooms the error was
        between ``low`` and ``high``.
    """
    least = _table()['offset'] * nothing
    low, middle, high = (float(np.clip(ratio * (error + least) - least, 0.0, nothing))
                         for ratio in ratios_for(error, nothing, missing))
    return {'depth_error': middle, 'low': low, 'high': high}


def notes_on(missing: Sequence[str]) -> list[str]:
    """Return a note on the effect of each missing surface on the expected error."""
    return [f'without the {surface} in the scan, what the cameras miss there is not known: in '
            f'{_table()[surface]["plans"]} rooms whose {surface} was left out the true depth '
            f'error was {_table()[surface]["times"][0]:.1f} to {_table()[surface]["times"][1]:.1f}'
            f' times that of the scan; scan the {surface} as well'
            for surface in missing if surface in _table()]
