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

"""What a rig's placement is worth, against counting flags by hand."""

from dataclasses import replace

import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import pack
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.scenes.scene import SceneError
from ocp_ros.search.scorer import Scorer
from ocp_ros.simulation.objective import MUST_SEE_COST
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError
import pytest

ENGINE = EngineConfig(preset='fast', error_rows=32)
SETTINGS = SimulationConfig(engine=ENGINE)
FIXED = [{'sensor': 'kinect_v2', 'position': [4.0, 4.0, 2.2], 'yaw': 200, 'pitch': 20}]
REGIONS = [{'name': 'a', 'box': [[0, 0, -1], [4, 4, 9]], 'weight': 2.0, 'must_see': 0.9},
           {'name': 'b', 'polygon': [[4, 4], [7, 4], [7, 7]], 'weight': 0.5}]
POSES = np.array([[2.0, 2.0, 1.9, 0.3, 0.4, 0.0], [5.0, 5.0, 1.9, 3.0, 0.5, 0.0],
                  [4.0, 3.0, 1.9, 1.5, 0.6, 0.0]])


def objective_of(room, **more):
    """Judge three D455 and a Kinect that hangs already."""
    rig = rig_of(3, 'd455', fixed=FIXED, **more)
    return Problem.of(room, rig, SETTINGS).objective


def flags_of(objective, poses=POSES):
    """Return who sees which point: (4, N) bool, in the scene's order."""
    simulator = objective.simulator
    placement = [*poses, *objective.rig.fixed_poses]
    flags = np.zeros((len(placement), len(simulator.scene)), dtype=bool)
    for k, pose in enumerate(placement):
        bits = simulator.look(pose, k).seen
        flags[k, simulator.visibility.order] = np.unpackbits(
            bits.view(np.uint8), count=flags.shape[1], bitorder='little')
    return flags


@pytest.mark.parametrize('seen_by', [1, 2, 3])
def test_a_point_counts_where_enough_cameras_see_it(room, seen_by):
    objective = objective_of(room, seen_by=seen_by, regions=REGIONS)
    simulator, flags = objective.simulator, flags_of(objective)
    worth = objective.evaluate(POSES)
    enough = flags.sum(axis=0) >= seen_by
    assert np.array_equal(worth.seen.mask, enough) and enough.any()
    error = simulator.depth_error(pack(enough[simulator.visibility.order]))
    assert worth.depth_error == error
    inside = [(room.points[:, :2] <= 4.0).all(axis=1) & (room.points[:, :2] >= 0.0).all(axis=1),
              (room.points[:, 0] < 7.0) & (room.points[:, 1] > 4.0)
              & (room.points[:, 0] > room.points[:, 1])]
    shares = [enough[part].mean() for part in inside]
    np.testing.assert_allclose(worth.regions, shares)
    loss = (error / simulator.depth_error.worst + 2.0 * (1.0 - shares[0])
            + 0.5 * (1.0 - shares[1]) + MUST_SEE_COST * max(0.9 - shares[0], 0.0))
    assert worth.loss == pytest.approx(loss)


def test_without_regions_the_loss_is_the_error_and_all_is_as_the_engine_says(room):
    objective = objective_of(room)
    worth, simulator = objective.evaluate(POSES), objective.simulator
    plain = simulator.evaluate(np.concatenate([POSES, objective.rig.fixed_poses]))
    assert worth.depth_error == plain.depth_error
    assert worth.space_coverage == plain.space_coverage
    assert worth.loss == worth.depth_error / simulator.depth_error.worst
    assert objective_of(room, seen_by=2).evaluate(POSES).space_coverage < worth.space_coverage


@pytest.mark.parametrize('seen_by', [1, 2])
def test_overlap_and_what_each_camera_adds(room, seen_by):
    objective = objective_of(room, seen_by=seen_by)
    views, flags = objective.look(POSES), flags_of(objective)
    counts = flags.sum(axis=0)
    assert objective.overlap(views) == [
        np.sum(counts == 0), np.sum(counts == 1), np.sum(counts == 2), np.sum(counts >= 3)]
    found = objective.contributions(views)
    assert len(found) == 4
    error = objective.judge(views).depth_error
    for k, contribution in enumerate(found):
        assert contribution.only == np.mean(flags[k] & (counts == 1))
        without = np.delete(flags, k, axis=0).sum(axis=0) >= seen_by
        bits = pack(without[objective.simulator.visibility.order])
        assert contribution.depth_error == pytest.approx(
            objective.simulator.depth_error(bits) - error)
        assert contribution.depth_error >= 0.0


@pytest.mark.parametrize('seen_by', [1, 2])
def test_one_more_camera_is_judged_as_if_it_hung_there(room, seen_by):
    objective = objective_of(room, seen_by=seen_by)
    views = objective.look(POSES)
    errors = objective.with_one_more(views[:2], views)
    np.testing.assert_allclose(
        errors, [objective.judge([*views[:2], view]).depth_error for view in views])
    assert errors.max() <= objective.judge(views[:2]).depth_error


def test_nobody_sees_nothing(room):
    rig = rig_of(2, 'd455', seen_by=2)
    objective = Problem.of(room, rig, SETTINGS).objective
    worth = objective.judge([])
    assert worth.depth_error == objective.simulator.depth_error.worst and worth.loss == 1.0
    assert len(worth.seen) == 0 and worth.space_coverage == 0.0
    assert objective.overlap([]) == [len(room), 0, 0, 0] and objective.contributions([]) == []
    alone = objective.contributions(objective.look(POSES[:1]))
    assert alone[0].depth_error == 0.0 and alone[0].only > 0.0


def test_the_engine_takes_models_of_ones_own(room):
    rig = rig_of(1, 'd455', fixed=FIXED)
    own = replace(rig.cameras[0].model, max_range=4.0, horizontal_fov=0.7)
    rig = replace(rig, cameras=(rig.cameras[0]._replace(model=own), *rig.cameras))
    simulator = Simulator(room, SETTINGS, rig.models)
    assert simulator.models == (own, SENSORS['realsense_d455'].model, SENSORS['kinect_v2'].model)
    few, many = (np.unpackbits(simulator.look(POSES[0], k).seen.view(np.uint8)).sum()
                 for k in (0, 1))
    assert 0 < few < 0.5 * many
    with pytest.raises(ValueError, match='found 4 cameras'):
        simulator.evaluate(np.zeros((4, 6)))


def test_cameras_that_see_alike_share_what_was_seen(room, monkeypatch):
    simulator = objective_of(room).simulator
    assert [simulator.kind(k) for k in range(4)] == [0, 0, 0, 3]
    looks, look = [], simulator.look
    monkeypatch.setattr(simulator, 'look', lambda pose, camera: looks.append(camera) or look(
        pose, camera))
    score = Scorer(simulator)
    placement = np.concatenate([POSES, objective_of(room).rig.fixed_poses])
    one, = score([placement]).error
    other, = score([placement[[1, 2, 0, 3]]]).error
    assert one == other and len(looks) == 4
    score([placement[[0, 1, 3, 2]]])
    assert len(looks) == 6
    plain = Simulator(room, SimulationConfig(RigConfig(cameras=2, sensors='kinect_v2'), ENGINE))
    assert plain.kind(1) == 0


@pytest.mark.parametrize(('more', 'words'), [
    ({'regions': [{'name': 'far', 'box': [[40, 0, 0], [41, 1, 1]]}]}, r'^rig: regions\[0\]'),
    ({'mount': {'on': 'plane', 'height': 9}}, 'mount.height')])
def test_a_region_without_points_and_a_height_without_a_room_are_refused(room, more, words):
    with pytest.raises(ConfigurationError, match=words):
        objective_of(room, **more)
    with pytest.raises(SceneError, match='height'):
        Simulator(room, SimulationConfig(RigConfig(height=9.0), ENGINE))
