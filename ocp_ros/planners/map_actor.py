# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The map actor: each camera goes to the place that a trained network finds best for it.

The network reads a map of what was observed and values all places at once; see
:mod:`ocp_ros.agent.observation_map`. Each camera has a target. Turn after turn some cameras choose
again, given the targets of the others: among the places over the floor that was seen and that can
be reached in the turns that are left. The few places that the network finds best are then tried on
what was observed: of what has been seen the trial knows more, of all else the network does.
"""

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import uniform_filter

from ocp_ros.agent.encoder import order_of
from ocp_ros.agent.observation_map import FLOOR, ObservationMap, Window
from ocp_ros.agent.partial_map import KeptModel, LookHistory, NO_CELL, PartialMap
from ocp_ros.agent.rig_state import clearance_of, fixed_views, remember, RigState
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.geometry.visibility import FAST
from ocp_ros.planners.candidate_sites import kinds_of, PITCHES, YAWS
from ocp_ros.planners.online_planner import matched, Online
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.simulator import View

if TYPE_CHECKING:
    from ocp_ros.agent.value_policy import ValuePolicy

#: Points and rows of depth maps of the model that is read.
PLAIN_POINTS, PLAIN_ROWS = 6000, 32
#: Cameras that choose again in a turn at least, and how often each does in an episode.
AGAIN, OFTEN = 2, 8
#: Places that are tried: those that the network finds best.
TRIED = 16
#: The least share of the network in what a place is worth, and how much larger it is than the
#: share of the air that has not been seen.
TRUST, PER_UNSEEN = 0.35, 5.0
#: What a metre of way costs, and what a target has to be better by to be changed for, both in
#: units of the value: shares of the error.
PER_METRE, GAIN = 0.01, 0.02
#: What unseen air is worth at first, in the same units, the share of the turns after which it is
#: worth nothing, and the metres around a place in which it counts.
CURIOSITY, EXPLORING, AROUND = 1.5, 0.5, 1.5


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
        #: (K, 6) metres and radians: where each camera goes, and how it is turned there.
        self._plan: np.ndarray | None = None

    @property
    def targets(self) -> np.ndarray | None:
        """Return where each camera goes; see :attr:`Online.targets`."""
        return None if self._plan is None else self._plan[:, :2]

    @property
    def headings(self) -> np.ndarray | None:
        """Return how the cameras are turned there; see :attr:`Online.headings`."""
        return self._plan[:, 3:] if self._plan is not None and self.directional else None

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
        count = len(positions)
        asked = max(AGAIN, -(-OFTEN * count // turns))
        if self._plan is None or len(self._plan) != count:
            self._plan, asked = _standing(positions, self.sight), max(asked, 2 * count)
        self._plan[:, :2], self._plan[:, 2] = space.inside(self._plan[:, :2]), positions[:, 2]
        self._choose(model, space, positions, np.resize(order_of(turn * AGAIN, count), asked),
                     turn, turns)
        flat = positions[:, :2]
        return space.moved(flat, self.towards(positions, self.targets) - flat,
                           self.max_step) - flat

    def _choose(self, model: PartialMap, space: FreePlane, positions: np.ndarray,
                asked: np.ndarray, turn: int, turns: int) -> None:
        """Let some cameras, one after the other, choose again where they go."""
        plan, unseen = self._plan, self._memory.unseen(model)
        known = ObservationMap(model, unseen, len(plan), self.max_range,
                               float(np.median(positions[:, 2])))
        window, cells = known.window, known.window.middles.reshape(-1, 2)
        free, reach = space.contains(cells), (turns - turn) * self.max_step
        curiosity = CURIOSITY * max(1.0 - turn / (EXPLORING * turns), 0.0)
        bonus = curiosity * _nearby(known.unseen_air(), window).ravel()
        trust = float(np.clip(PER_UNSEEN * _share(model, unseen), TRUST, 1.0))
        fixed = fixed_views(model, self.sight)
        views = [self._look(model, camera, row[None])[0] for camera, row in enumerate(plan)]
        for camera in asked:
            others = [k for k in range(len(plan)) if k != camera]
            beside = [views[k] for k in others] + fixed
            values = self.policy.values(known.room, *known.others(beside, plan[others])).ravel()
            away = np.linalg.norm(cells - positions[camera, :2], axis=-1)
            extra = PER_METRE * away - bonus
            scores = np.where(free & (away <= reach), values + extra, np.inf)
            best = np.argpartition(scores, TRIED)[:TRIED]
            best = best[np.isfinite(scores[best])]
            rows, of_cells = self._turned(camera, np.column_stack(
                [cells[best], np.full(len(best), plan[camera, 2])]))
            at = np.append(window.cell_of(plan[camera, None]), best[of_cells])
            rows = np.concatenate([plan[camera, None], rows])
            looks = self._look(model, camera, rows)
            change = model.depth_error.changes(
                [view.seen for view in beside], [look.seen for look in looks], FLOOR)
            tried = trust * values[at] + (1.0 - trust) * change + extra[at]
            found = int(np.argmin(tried))
            # Beyond what was seen the network says inf.
            if not tried[found] > tried[0] - GAIN:
                plan[camera], views[camera] = rows[found], looks[found]
        self._plan = plan[matched(positions, plan[:, :2], self._kinds())]

    def _turned(self, camera: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Turn a camera all ways at places (M, 3): rows (M * H, 6), and the place of each."""
        headings = np.zeros((1, 3))
        if self.directional:
            headings = self.sight.headings(camera, YAWS, PITCHES)
        of_places = np.repeat(np.arange(len(places)), len(headings))
        return np.hstack([places[of_places], np.tile(headings, (len(places), 1))]), of_places

    def _look(self, model: PartialMap, camera: int, rows: np.ndarray) -> list[View]:
        """Compute what a camera would see from rows (M, 6); those of a place are in a row."""
        lens = self.sight.lenses[camera] if self.directional else None
        if lens is None:
            return [model.look(row[:3]) for row in rows]
        ends = np.flatnonzero(np.any(np.diff(rows[:, :3], axis=0), axis=1)) + 1
        return [view for some in np.split(rows, ends)
                for view in model.look_many(some[0, :3], some[:, 3:], lens)]

    def _kinds(self) -> np.ndarray | None:
        """Tell which cameras may take each other's places: (K,); None for all."""
        return None if self.sight is None else kinds_of(self.sight)[0]


def _standing(positions: np.ndarray, sight: RigState | None) -> np.ndarray:
    """Return how the cameras are: (K, 6) metres and radians."""
    if sight is None:
        return np.hstack([positions, np.zeros_like(positions)])
    return sight.placement[:sight.movable].copy()


def _share(model: PartialMap, unseen: np.ndarray) -> float:
    """Return the share of the air in the model that has not been seen."""
    return int(count_bits(unseen)) / max(int(np.count_nonzero(model.cells != NO_CELL)), 1)


def _nearby(share: np.ndarray, window: Window) -> np.ndarray:
    """Return the mean of a share of the cells around each cell."""
    return uniform_filter(share, max(round(2.0 * AROUND / window.edge), 1), mode='constant')
