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
The online planner that moves cameras by a trained policy.

The policy chooses moves, and does not know how good its placements are. The planner therefore
compares the places where the cameras have been in the episode, on the observed cloud: it chooses
the best combination of one place of each camera. The policy moves the cameras as long as they can
still return to these places in time; then they return.
"""

from typing import TYPE_CHECKING

import numpy as np
from ocp_ros.geometry.visibility import FAST
from ocp_ros.online.online_planner import Online, standing
from ocp_ros.online.partial_map import KeptModel, PartialMap
from ocp_ros.online.rig_state import clearance_of, fixed_views, RigState, view_from
from ocp_ros.policy.cloud_encoder import Encoder
from ocp_ros.policy.map_actor import MapActor
from ocp_ros.rig.motion import bounded_moves
from ocp_ros.scenes.scene import SceneError

if TYPE_CHECKING:
    from ocp_ros.policy.policy import Policy, ValuePolicy

#: Points, and rows of the depth maps, of the partial map on which places are compared.
MODEL_POINTS, MODEL_ROWS = 60_000, 128
#: Largest number of places of a camera that are compared: those of the last time steps.
MAX_PLACES = 60


class Learned(Online):
    """
    Move cameras by a trained policy that reads the observed cloud.

    :param policy: chooses moves in units of ``max_step``.
    :param settings: positional arguments of :class:`Online`.
    """

    def __init__(self, policy: 'Policy', *settings) -> None:
        super().__init__(*settings)
        self.policy = policy
        self.reset()

    def set_rig_state(self, rig_state: RigState | None) -> None:
        """Set the rig state of the policy's encoder too; see :meth:`Online.set_rig_state`."""
        super().set_rig_state(rig_state)
        self.policy.encoder.partial_maps.rig_state = rig_state

    def reset(self) -> None:
        """Discard the state of the last episode."""
        self.policy.reset()
        #: (V, K, 6) metres, map frame, and radians: the last placements of the episode.
        self._placements = np.empty((0, 0, 6))
        self._kept_model = KeptModel(self.max_range, self.wall_margin, MODEL_POINTS, MODEL_ROWS)

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Return the next moves; see :meth:`Online.move`."""
        if len(cloud) == 0:
            return self.random_walk(cloud, positions)
        start, space = positions[:, :2], self.space(cloud, positions)
        moves = bounded_moves(self.policy.act(cloud, positions, turn, turns), self.max_step)
        ends = space.moved(start, moves, self.max_step)
        placement = standing(positions, self.rig_state)[None]
        if self._placements.shape[1:] != placement.shape[1:]:
            self._placements = placement[:0]
        self._placements = np.concatenate([self._placements, placement])[-MAX_PLACES:]
        best = self._due_places(cloud, positions, ends, turns - turn)
        if best is not None:
            ends = space.moved(start, self.towards(positions, best) - start, self.max_step)
        return ends - start

    def _due_places(self, cloud: np.ndarray, positions: np.ndarray, ends: np.ndarray,
                    turns_left: int) -> np.ndarray | None:
        """
        Return the best places of the episode if the cameras have to return to them now.

        :param cloud: see :meth:`Online.move`.
        :param positions: see :meth:`Online.move`; the last of the placements.
        :param ends: (K, 2) metres, where the policy sends the cameras.
        :param turns_left: time steps until the end of the episode.
        :returns: (K, 2) metres; None if the policy may move the cameras.
        """
        now, then = (np.linalg.norm(self._placements[..., :2] - places, axis=2)
                     for places in (positions[:, :2], ends))
        # (V, K) each, from lengths of paths in metres; the constant allows for rounding.
        within_reach = now <= turns_left * self.max_step + 1e-6
        due = then > (turns_left - 1) * self.max_step + 1e-6
        if not due[within_reach].any():
            return None
        try:
            model, _ = self._kept_model(cloud, positions, FAST,
                                        clearance_of(self.rig_state, self.clearance))
        except SceneError:
            return None
        best = self._best_places(model, within_reach), np.arange(len(positions))
        return self._placements[best][:, :2] if due[best].any() else None

    def _best_places(self, model: PartialMap, within_reach: np.ndarray) -> np.ndarray:
        """
        Return the number of the best place of each camera: (K,).

        This begins with the best placement. Then one camera after the other takes the best of its
        places, given those of the others, until no camera finds a better one.

        :param model: of the observed cloud.
        :param within_reach: (V, K) bool, which places the cameras can still reach; the last of
            each camera is always among them.
        """
        # For each camera the view from each place within reach, by the number of the place.
        views = [{place: view_from(model, self.rig_state, camera,
                                   *np.split(self._placements[place, camera], 2))
                  for place in np.flatnonzero(reached)}
                 for camera, reached in enumerate(within_reach.T)]
        fixed = fixed_views(model, self.rig_state)
        places = np.flatnonzero(within_reach.all(axis=1))
        errors = [model.error([*fixed, *(own[place] for own in views)]) for place in places]
        choice = np.full(len(views), places[np.argmin(errors)])
        least_error, camera, unchanged = min(errors), 0, 0
        while unchanged < len(views):
            others = [own[choice[k]] for k, own in enumerate(views) if k != camera]
            error_with = model.depth_error.given(model.together(others + fixed).seen)
            unchanged += 1
            for place, view in views[camera].items():
                error = error_with(view.seen, least_error)
                if error < least_error - 1e-9:
                    choice[camera], least_error, unchanged = place, error, 0
            camera = (camera + 1) % len(views)
        return choice


def planned_by(policy: 'Policy | ValuePolicy', settings: tuple) -> Learned | MapActor:
    """
    Return the online planner that moves cameras by a policy.

    :param policy: from :func:`ocp_ros.policy.policy.make_policy`.
    :param settings: positional arguments of :class:`~ocp_ros.online.online_planner.Online`.
    """
    # This import loads torch; an import of the present module alone does not.
    from ocp_ros.policy.policy import ValuePolicy
    if isinstance(policy, ValuePolicy):
        return MapActor(policy, *settings)
    _, max_step, max_range, *margins = settings
    # The policy was made with an encoder for default settings.
    policy.encoder = Encoder(policy.checkpoint.config, max_range, max_step, *margins)
    return Learned(policy, *settings)
