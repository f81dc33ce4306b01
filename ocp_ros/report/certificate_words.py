# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How much better than a plan other placements may be, in words and as plain data."""

from dataclasses import asdict
from math import ceil
from typing import Any

from ocp_ros.planners.rig_plan import RigPlan


def certificate_data(plan: RigPlan) -> dict[str, Any]:
    """
    Return the certificate of a plan as plain data.

    :returns: ``sentence``, and what it is made of; ``gap`` is None where nothing was proved.
    """
    if plan.certificate is None:
        return {'sentence': f'The optimality gap is unknown: '
                            f'{plan.uncertain}.', 'gap': None}
    return {'sentence': sentence_of(plan), 'gap': plan.certificate.gap,
            **asdict(plan.certificate)}


def gap_percent(gap: float) -> float:
    """Return a gap in per cent, rounded up to tenths, so that it stays true."""
    return ceil(1000.0 * gap - 0.01) / 10.0


def sentence_of(plan: RigPlan) -> str:
    """Say what a certificate proves."""
    known = plan.certificate
    percent = gap_percent(known.gap)
    more = f' by more than {percent:.1f} %' if percent > 0.0 else ''
    without = ', without what regions must see' if any(
        region.must_see for region in plan.rig.regions) else ''
    return (f'No placement on the {known.candidates:,} compared candidate poses is better{more} '
            f'(computed on depth maps of {known.rows} rows{without}).')
