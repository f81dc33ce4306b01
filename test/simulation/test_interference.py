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

"""Cameras that disturb each other, time slots for them, and what a computer can carry."""

from itertools import product

from conftest import box_room, made_room
import numpy as np
from ocp_ros import plan
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.report.assessment import assess
from ocp_ros.report.facts import details_of
from ocp_ros.rig.connections import bandwidth_notes, CONNECTIONS
from ocp_ros.rig.placement_file import placement_of
from ocp_ros.rig.rig_file import rig_from, rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.simulation.interference import MAX_LIT_SHARE, time_slots
from ocp_ros.simulation.objective import MUST_SEE_COST
from ocp_ros.util.yaml_files import Document
import pytest


def cycle(count):
    """Return the conflicts of cameras in a ring."""
    conflicts = np.zeros((count, count), dtype=bool)
    for k in range(count):
        conflicts[k, (k + 1) % count] = conflicts[(k + 1) % count, k] = True
    return conflicts


@pytest.mark.parametrize(('conflicts', 'least'), [
    (np.zeros((3, 3), dtype=bool), 1), (~np.eye(5, dtype=bool), 5), (cycle(6), 2), (cycle(7), 3)])
def test_time_slots_of_known_graphs(conflicts, least):
    slots = time_slots(conflicts)
    assert len(set(slots)) == least and set(slots) == set(range(least))


@pytest.mark.parametrize('seed', range(6))
def test_no_fewer_time_slots_keep_cameras_in_conflict_apart(seed):
    conflicts = np.triu(np.random.default_rng(seed).random((7, 7)) < 0.45, 1)
    conflicts |= conflicts.T

    def fits(slots):
        return not any(conflicts[i, k] and slots[i] == slots[k] for i in range(7)
                       for k in range(i))
    slots = time_slots(conflicts)
    assert fits(slots)
    # Every assignment of one slot less has a conflict.
    assert not any(fits(others) for others in product(range(len(set(slots)) - 1), repeat=7))


def test_every_sensor_has_a_connection_and_its_first_mode_is_that_of_the_preset():
    assert CONNECTIONS.keys() == SENSORS.keys()
    for name, connection in CONNECTIONS.items():
        pixels = SENSORS[name].model.resolution
        # Two images side by side.
        across = 2 if name == 'zed_2i_wide' else 1
        assert connection.modes[0].pixels == (across * pixels[0], pixels[1]), name


def test_a_computer_that_cannot_carry_its_cameras_is_noted():
    # 442 Mbit/s each.
    assert not list(bandwidth_notes(rig_of(7, 'd455').cameras))
    note, = bandwidth_notes(rig_of(8, 'd455').cameras)
    assert note.startswith('host: found 8 cameras with 3,539 Mbit/s on USB 3')
    hosts = [{'sensor': 'realsense_d455', 'count': 4, 'host': host} for host in ('a', 'b')]
    assert not list(bandwidth_notes(rig_from(Document('rig', {'cameras': hosts})).cameras))


def kinects(**more):
    """Return a rig of two cameras on walls that disturb each other."""
    return rig_of(2, 'azure_kinect_nfov', mount={'on': 'walls'}, **more)


def found_of(room, rig, poses):
    """Return the findings on a placement."""
    engine = EngineConfig(preset='fast', error_rows=32)
    placement = placement_of(rig, np.array(poses), engine=engine)
    return assess(room, placement, {'sha256': ''}, 'ocp score').found


def test_cameras_that_light_the_same_wall_are_named_with_their_time_slots():
    # Both look at the middle of the room; then each along the wall of the other.
    facing = [[0.1, 2.0, 2.0, 0.0, 0.3, 0.0], [5.9, 2.0, 2.0, np.pi, 0.3, 0.0]]
    found = found_of(box_room(), kinects(require={'interference': 'none'}), facing)
    light = found['scores']['interference']
    assert light['pairs'][0]['light'] == 'time of flight' and len(light['slots']) == 2
    assert any(sentence.startswith('interference: found 1 pairs') for sentence in found['broken'])
    assert any('in 2 time slots' in line for line in details_of(found))
    allowed = found_of(box_room(), kinects(), facing)
    assert not allowed['broken'] and allowed['scores']['interference']['pairs']
    # The cost of the pair is that of what is lit twice beyond the limit.
    share = light['pairs'][0]['shared']
    assert found['scores']['loss'] - allowed['scores']['loss'] == pytest.approx(
        MUST_SEE_COST * (share - MAX_LIT_SHARE))
    # Stereo cameras are not disturbed.
    stereo = found_of(box_room(), rig_of(2, 'd455', mount={'on': 'walls'}), facing)
    assert 'interference' not in stereo['scores']


def test_a_plan_keeps_cameras_from_disturbing_each_other():
    room = made_room(3, 3000)
    results = [plan(room, kinects(**more), evaluations=300)
               for more in ({}, {'require': {'interference': 'none'}})]
    shared = [result.found['scores']['interference']['pairs']
              if 'interference' in result.found['scores'] else [] for result in results]
    assert len(shared[0]) == 1 and not shared[1] and not results[1].broken
    assert results[1].depth_error >= results[0].depth_error
