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

"""A camera that would see nothing new goes where much is unseen, as the rig allows."""

from conftest import box_room
import numpy as np
from ocp_ros.geometry.packed_bits import count_bits
from ocp_ros.online.episode_places import scouted
from ocp_ros.online.lookahead import Lookahead
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.online.step import play
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
import pytest

RANGE, STEP = 3.0, 1.0
#: Two cameras at one end of a hall.
HALL, POSITIONS = box_room(width=12.0), np.array([[1.5, 1.5, 1.9], [1.5, 2.5, 1.9]])


def scout(goals, visited=POSITIONS, turns=8.0):
    """Return where cameras go in the hall, and the cells (bits) that no camera has covered."""
    model, memory = PartialMap(HALL.points, POSITIONS, RANGE, 6000, 32), LookHistory()
    memory.visit(np.asarray(visited))
    unseen = memory.unseen(model)
    space = FreePlane.around(HALL.points, POSITIONS, 0.1, 0.2)
    return scouted(model, space, unseen, None, POSITIONS, np.array(goals), STEP, turns), unseen


def test_idle_cameras_go_to_what_is_unseen_and_busy_ones_are_left_alone():
    still = POSITIONS[:, :2]
    found, _ = scout(still)
    # Both go along the hall, to different places, by one step.
    assert (found[:, 0] > still[:, 0] + 0.7 * STEP).all()
    assert np.linalg.norm(found - still, axis=1).max() <= STEP + 1e-6
    busy = [[2.4, 1.5], [1.5, 2.5]]
    found, _ = scout(busy)
    assert (found[0] == busy[0]).all() and found[1, 0] > 2.0


def test_where_all_is_seen_or_too_far_away_goals_stay():
    everywhere = [[x, y, 1.9] for x in range(1, 12) for y in (1, 2, 3)]
    found, unseen = scout(POSITIONS[:, :2], everywhere)
    assert (found == POSITIONS[:, :2]).all() and count_bits(unseen) < 20
    near = [[x, y, 1.9] for x in range(1, 7) for y in (1, 2, 3)]
    found, unseen = scout(POSITIONS[:, :2], near, turns=1.0)
    assert (found == POSITIONS[:, :2]).all() and count_bits(unseen) > 100


@pytest.mark.usefixtures('quick_lookahead')
@pytest.mark.parametrize('limits', [
    {'keep_out': [{'box': [[3.0, 0.0, 0.0], [9.0, 4.0, 3.0]]}]},
    {'keep_in': [{'box': [[0.0, 0.0, 0.0], [4.0, 4.0, 3.0]]}]}])
def test_what_a_rig_forbids_is_not_planned(limits):
    rig = rig_of(2, 'omnidirectional', mount={'on': 'plane', 'height': 1.9}, **limits)
    problem = Problem.of(HALL, rig, SimulationConfig())
    episode = Episode(problem, np.random.default_rng(0),
                      config=EpisodeConfig(turns=8, max_step=STEP, start_radius=3.0))
    online = Lookahead(np.random.default_rng(0), STEP, RANGE, 0.1)
    play(online, episode)
    planned = np.column_stack([online.targets, episode.placement[:, 2]])
    assert problem.region.allowed(planned).all()
    # So all cameras arrive.
    assert np.abs(planned[:, :2] - episode.placement[:, :2]).max() < 0.1
