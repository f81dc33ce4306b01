# SPDX-License-Identifier: Apache-2.0
"""
The map actor: each camera goes to the place that a trained network finds best for it.

The network reads a map of what was observed and values all places at once; see
:mod:`ocp_ros.agent.observation_map`. Each camera has a target. Turn after turn some cameras choose
again, given the targets of the others: among the places over the floor that was seen and that can
be reached in the turns that are left.
"""

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import uniform_filter

from ocp_ros.agent.encoder import order_of
from ocp_ros.agent.observation_map import ObservationMap, Window
from ocp_ros.agent.partial_map import KeptModel, LookHistory, PartialMap
from ocp_ros.agent.rig_state import clearance_of, fixed_views, remember, view_from
from ocp_ros.geometry.visibility import FAST
from ocp_ros.planners.online_planner import matched, Online
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.simulator import View

if TYPE_CHECKING:
    from ocp_ros.agent.value_policy import ValuePolicy

#: Points and rows of depth maps of the model that is read.
PLAIN_POINTS, PLAIN_ROWS = 6000, 32
#: Cameras that choose again in a turn; in the first turn all do.
AGAIN = 2
#: What a metre of way costs, and what a target has to be better by to be changed for, both in
#: units of the value: shares of the error.
PER_METRE, GAIN = 0.01, 0.02
#: What unseen air is worth at first, in the same units, the share of the turns after which it is
#: worth nothing, and the metres around a place in which it counts.
CURIOSITY, EXPLORING, AROUND = 0.6, 0.5, 1.5


class MapActor(Online):
    """
    Go where a trained network says.

    :param policy: values places.
    :param settings: of :class:`~ocp_ros.planners.online_planner.Online`.
    """

    def __init__(self, policy: 'ValuePolicy', *settings) -> None:
        super().__init__(*settings)
        self.policy = policy
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._memory = LookHistory()
        self._kept = KeptModel(self.max_range, self.wall_margin, PLAIN_POINTS, PLAIN_ROWS)
        self.targets = None

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`~ocp_ros.planners.online_planner.Online.move`."""
        if len(cloud) == 0:
            return self.wander(cloud, positions)
        remember(self._memory, positions, self.sight)
        try:
            model, space = self._kept(cloud, positions, FAST,
                                      clearance_of(self.sight, self.clearance))
        except SceneError:
            return self.wander(cloud, positions)
        self._choose(model, space, positions, turn, turns)
        flat = positions[:, :2]
        return space.moved(flat, self.towards(positions, self.targets) - flat,
                           self.max_step) - flat

    def _choose(self, model: PartialMap, space: FreePlane, positions: np.ndarray, turn: int,
                turns: int) -> None:
        """Let some cameras choose again where they go."""
        count = len(positions)
        if self.targets is None or len(self.targets) != count:
            self.targets, asked = space.inside(positions[:, :2]), 2 * count
        else:
            self.targets, asked = space.inside(self.targets), AGAIN
        unseen = self._memory.unseen(model)
        known = ObservationMap(model, unseen, count, self.max_range,
                               float(np.median(positions[:, 2])))
        fixed = fixed_views(model, self.sight)
        places = known.window.middles
        free = space.contains(places)
        curiosity = CURIOSITY * max(1.0 - turn / (EXPLORING * turns), 0.0)
        bonus = curiosity * _nearby(known.unseen_air(), known.window) if curiosity else 0.0
        views = [self._view(model, positions, camera) for camera in range(count)]
        reach = (turns - turn) * self.max_step
        for camera in np.resize(order_of(turn * AGAIN, count), asked):
            others = [k for k in range(count) if k != camera]
            values = self.policy.values(known.room, *known.others(
                [views[k] for k in others] + fixed, self.targets[others]))
            away = np.linalg.norm(places - positions[camera, :2], axis=-1)
            scores = np.where(free & (away <= reach), values + PER_METRE * away - bonus, np.inf)
            cell = np.unravel_index(np.argmin(scores), scores.shape)
            now = known.window.cell_of(self.targets[camera][None])[0]
            if not np.isfinite(scores[cell]) or scores[cell] > scores.flat[now] - GAIN:
                continue
            self.targets[camera] = space.inside(_peak(scores, cell, known.window))
            views[camera] = self._view(model, positions, camera)
        self.targets = self.targets[matched(positions, self.targets, self._kinds(count))]

    def _kinds(self, count: int) -> np.ndarray | None:
        """Tell which cameras may take each other's places: (K,); None for all."""
        if self.sight is None:
            return None
        models = list(self.sight.models)
        return np.array([models.index(model) for model in models[:count]])

    def _view(self, model: PartialMap, positions: np.ndarray, camera: int) -> View:
        """Compute what a camera would see from its target, as high as it is now."""
        target = np.append(self.targets[camera], positions[camera, 2])
        return view_from(model, self.sight, camera, target)


def _nearby(share: np.ndarray, window: Window) -> np.ndarray:
    """Return the mean of a share of the cells around each cell."""
    return uniform_filter(share, max(round(2.0 * AROUND / window.edge), 1), mode='constant')


def _peak(scores: np.ndarray, cell: tuple[int, int], window: Window) -> np.ndarray:
    """Return the lowest point of the parabolas through a cell and its neighbours: (2,) metres."""
    place = np.array(cell, dtype=np.float64)
    for axis in (0, 1):
        step = np.eye(2, dtype=int)[axis]
        before, after = np.array(cell) - step, np.array(cell) + step
        if before.min() < 0 or after.max() >= len(scores):
            continue
        low, here, high = scores[tuple(before)], scores[cell], scores[tuple(after)]
        bend = low - 2.0 * here + high
        if np.isfinite(bend) and bend > 1e-9:
            place[axis] += np.clip(0.5 * (low - high) / bend, -0.5, 0.5)
    return window.low + (place + 0.5) * window.edge
