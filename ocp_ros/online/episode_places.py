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

"""The places of the cameras in an episode, and the best combination of them."""

import numpy as np
from ocp_ros.online.online_planner import standing
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import fixed_views, RigState, view_from

#: Largest number of placements of an episode that are compared: the last ones.
MAX_PLACEMENTS = 60


class EpisodePlaces:
    """The placements of the K movable cameras since the episode began."""

    def __init__(self) -> None:
        #: (V, K, 6) metres, map frame, and radians: the last placements.
        self._placements = np.empty((0, 0, 6))

    def add(self, positions: np.ndarray, rig_state: RigState | None) -> None:
        """
        Record the placement of a turn.

        :param positions: (K, 3) metres. Another K than before begins a new record.
        :param rig_state: state of the rig; None for omnidirectional cameras.
        """
        placement = standing(positions, rig_state)[None]
        if self._placements.shape[1:] != placement.shape[1:]:
            self._placements = placement[:0]
        self._placements = np.concatenate([self._placements, placement])[-MAX_PLACEMENTS:]

    def best(self, model: PartialMap, rig_state: RigState | None, positions: np.ndarray,
             reach: float) -> np.ndarray:
        """
        Return the best combination of the places where each camera has been: (K, 6).

        This begins with the best placement. Then one camera after the other takes the best of its
        places, given those of the others, until no camera finds a better one.

        :param model: of the observed cloud, which compares them.
        :param rig_state: state of the rig; None for omnidirectional cameras.
        :param positions: (K, 3) metres: where the cameras are, one more place of each.
        :param reach: metres: places that are farther from these positions are left out.
        :returns: (K, 6) metres, map frame, and radians.
        """
        placements = np.concatenate([self._placements, standing(positions, rig_state)[None]])
        distances = np.linalg.norm(placements[..., :3] - positions, axis=2)
        # (V, K) from lengths of paths in metres; the constant allows for rounding.
        within_reach = distances <= reach + 1e-6
        # For each camera the view from each place within reach, by the number of the place.
        views = [{place: view_from(model, rig_state, camera,
                                   *np.split(placements[place, camera], 2))
                  for place in np.flatnonzero(reached)}
                 for camera, reached in enumerate(within_reach.T)]
        fixed = fixed_views(model, rig_state)
        # The last placement is always within reach.
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
        return placements[choice, np.arange(len(views))]
