# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rig's regions and keep-out zones on a plan, told apart by hatching as well as by colour."""

from matplotlib.axes import Axes
from matplotlib.patches import Patch, Polygon
import numpy as np

from ocp_ros.rig.rig_file import Rig
from ocp_ros.rig.zones import Zone

#: Edge colour, hatching and line of each kind of zone.
STYLES = {
    'must-see region': {'edgecolor': '#00664d', 'hatch': '//', 'linestyle': '-'},
    'weighted region': {'edgecolor': '#00664d', 'hatch': '..', 'linestyle': '--'},
    'keep-out zone': {'edgecolor': '#9c2f6b', 'hatch': 'xx', 'linestyle': '-'}}


def corners_of(zone: Zone) -> np.ndarray:
    """Return the corners of a zone seen from above: (P, 2) metres, map frame."""
    if zone.polygon is not None:
        return zone.polygon
    (x0, y0), (x1, y1) = zone.low[:2], zone.high[:2]
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def zones_of(rig: Rig) -> list[tuple[str, Zone]]:
    """Return the kind of each zone of a rig, a key of :data:`STYLES`, and the zone."""
    return [*(('must-see region' if region.must_see else 'weighted region', region.zone)
              for region in rig.regions), *(('keep-out zone', zone) for zone in rig.keep_out)]


def draw_zones(axes: Axes, rig: Rig, frame: np.ndarray, level: float) -> None:
    """
    Draw the zones of a rig on a plan.

    :param frame: (2, 2) rotation from the map frame to that of the plan.
    :param level: drawing order (zorder).
    """
    for kind, zone in zones_of(rig):
        axes.add_patch(Polygon(corners_of(zone) @ frame.T, facecolor='none', linewidth=1.2,
                               zorder=level, label=kind, **STYLES[kind]))


def zone_legend(rig: Rig) -> dict[str, Patch]:
    """Return what explains the kinds of zones that a rig has."""
    return {kind: Patch(facecolor='none', **STYLES[kind])
            for kind in dict.fromkeys(kind for kind, _ in zones_of(rig))}
