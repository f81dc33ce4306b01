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
The places of the cameras in an episode: the best of those where they were, and new ones.

Scouting: a camera whose next place shows nothing new goes where much is unseen. While a room is
explored, policies and plans let cameras go to and fro between places that they know. In an episode
of few turns each such turn is lost. Places are compared by the unseen cells of the air that a
camera there would cover in the observed cloud, over the turns of the way (a next best view; C. I.
Connolly, "The Determination of Next Best Views", 1985).
"""

import numpy as np
from ocp_ros.geometry.cameras import OMNIDIRECTIONAL
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.online.online_planner import standing
from ocp_ros.online.partial_map import NO_CELL, PartialMap
from ocp_ros.online.rig_state import fixed_views, RigState, view_from
from ocp_ros.rig.free_plane import FreePlane

#: Largest number of placements of an episode that are compared: the last ones.
MAX_PLACEMENTS = 60
#: The least share of the cells of the air that is worth a move; chosen on validation rooms.
LEAST_SHARE = 0.01
#: Metres between the places to go to, and the largest number of them.
SPACING_M, MAX_PLACES = 0.7, 150


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


def scouted(model: PartialMap, space: FreePlane, unseen: np.ndarray, rig_state: RigState | None,
            positions: np.ndarray, goals: np.ndarray, max_step: float, turns: float) -> np.ndarray:
    """
    Return the next positions of cameras, where those that would cover nothing new scout.

    :param model: partial map of the observed cloud.
    :param space: the feasible region.
    :param unseen: packed bits of the model's cells that no camera has covered.
    :param rig_state: state of the rig; None for omnidirectional cameras. Cameras with a frustum
        can look around, so they count as omnidirectional.
    :param positions: (K, 3) metres, of the K movable cameras.
    :param goals: (K, 2) metres, where they would be in the next turn.
    :param max_step: the longest move of a turn, metres.
    :param turns: the largest number of turns of a way.
    :returns: (K, 2) metres.
    """
    lenses = [None] * len(positions) if rig_state is None else [
        lens and lens._replace(kind=OMNIDIRECTIONAL)
        for lens in rig_state.lenses[:rig_state.movable]]
    least = LEAST_SHARE * np.count_nonzero(model.cells != NO_CELL)

    def covered(camera: int, place: np.ndarray) -> np.ndarray:
        # One height for all cameras, so that they share views.
        return model.look(space.placement(place[None])[0], lenses[camera]).covered & unseen

    new = [covered(camera, goal) for camera, goal in enumerate(goals)]
    is_idle = [count_bits(bits) < least for bits in new]
    # What the other cameras leave.
    rest = unseen & ~np.bitwise_or.reduce([
        np.zeros_like(unseen), *(bits for bits, idle in zip(new, is_idle) if not idle)])
    if not any(is_idle) or count_bits(rest) < least:
        return goals
    places = space.grid(int(np.clip(space.area / SPACING_M ** 2, 4, MAX_PLACES)))
    ways = np.linalg.norm(places - positions[:, None, :2], axis=2) / max_step
    gains = {(camera, place): covered(camera, places[place])
             for camera, place in np.argwhere(ways <= turns) if is_idle[camera]}
    goals = goals.copy()
    # One after the other, the camera and the place that are worth most.
    while gains:
        counts = {pair: count_bits(gain & rest) for pair, gain in gains.items()}
        best = max(counts, key=lambda pair: counts[pair] / (1.0 + np.ceil(ways[pair]))
                   if counts[pair] >= least else 0.0)
        if counts[best] < least:
            break
        camera, place = best
        rest &= ~gains[best]
        goals[camera] = space.on_way(positions[camera, None, :2], places[place, None],
                                     max_step)[0]
        gains = {pair: gain for pair, gain in gains.items() if pair[0] != camera}
    return goals
