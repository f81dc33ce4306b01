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

"""Requirements: what cameras measure well is what a slow twin says, and plans pay for it."""

from conftest import for_any, made_room, printed
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import unpack
from ocp_ros.report.facts import facts_of, requirement_rows
from ocp_ros.report.findings import broken_by, scores_of
from ocp_ros.rig.placement_file import numbers_of
from ocp_ros.rig.rig_file import rig_from, rig_of
from ocp_ros.rig.schemas import RIG
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.search.budget import Budget
from ocp_ros.search.rig_plan import RigPlanner
from ocp_ros.simulation.objective import MUST_SEE_COST
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.settings import ConfigurationError
from ocp_ros.util.yaml_files import document_of
import pytest

FAST = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16))
ROOM = made_room(8, 2000)
MIDDLE = ROOM.bounds.mean(axis=0)
BOX = {'name': 'corner', 'box': [[0, 0, 0], [3.5, 3.5, 1.5]]}


def problem_of(count, sensor, require, **more):
    """Return the problem of a rig with one requirement."""
    return Problem.of(ROOM, rig_of(count, sensor, require=require, spacing=0.0, **more), FAST)


def poses_of(rng, count):
    """Draw poses (K, 6) about the middle of the room."""
    return np.column_stack([MIDDLE + rng.uniform(-1.0, 1.0, (count, 3)),
                            rng.uniform(-np.pi, np.pi, count), rng.uniform(0.0, 0.8, count),
                            np.zeros(count)])


def is_good(model, pose, limits):
    """Return whether each point is measured within limits: density, millimetres and degrees."""
    offsets = ROOM.points - pose[:3]
    distances = np.linalg.norm(offsets, axis=1)
    across, down = model.resolution
    if model.horizontal_fov < np.pi:
        depths = (offsets @ rotation_matrix(*pose[3:]))[:, 0]
        density = min(across / (2.0 * np.tan(model.horizontal_fov / 2)),
                      down / (2.0 * np.tan(model.vertical_fov / 2))) / depths
    else:
        depths = distances
        density = min(across / model.horizontal_fov, down / model.vertical_fov) / depths
    cosines = np.abs((offsets * ROOM.normals_or_estimate).sum(axis=1)) / distances
    angles = np.arccos(np.minimum(cosines, 1.0))
    noise = model.noise
    with np.errstate(invalid='ignore', divide='ignore'):
        deviations = (noise.constant + noise.linear * depths + noise.quadratic * depths ** 2
                      + noise.grazing * depths ** 1.5 * (angles / (np.pi / 2 - angles)) ** 2)
    good = np.rad2deg(angles) <= limits['incidence']
    return good & (density >= limits['pixel_density']) & (
        1e3 * deviations <= limits['depth_accuracy'])


@for_any(12, seed=st.integers(0, 9999), density=st.sampled_from((20.0, 125.0, 250.0)),
         millimetres=st.floats(1.0, 40.0), degrees=st.sampled_from((30, 60, 80)),
         sensor=st.sampled_from(('realsense_d455', 'kinect_v2', 'velodyne_vlp16')))
def test_good_points_are_those_of_the_twin(seed, density, millimetres, degrees, sensor):
    limits = {'pixel_density': density / 10 ** (sensor == 'velodyne_vlp16'),
              'depth_accuracy': millimetres, 'incidence': degrees}
    simulator = problem_of(1, sensor, limits).simulator
    pose, = poses_of(np.random.default_rng(seed), 1)
    order, model = simulator.visibility.order, SENSORS[sensor].model
    expected = is_good(model, pose, limits)[order]
    for view in (simulator.look(pose), *simulator.look_many(np.stack([pose, pose + [
            0, 0, 0, 0.1, 0, 0]]))[:1]):
        seen, good = unpack(view.seen, len(ROOM)), unpack(view.good[0], len(ROOM))
        assert np.array_equal(good, seen & expected)
    # Beside the points, poses of a grid have those that are good.
    rows, bits = simulator.look_around(pose[:3], pose[None, 3:])
    assert np.array_equal(rows[rows >= len(ROOM)] - len(ROOM),
                          np.flatnonzero(good)) and (bits == 1).all()


def share_of(flags, poses, points, seen_by, degrees):
    """Return the share of points that enough cameras see, far enough apart, by trying all."""
    from itertools import combinations
    rays = points[None] - poses[:, None, :3]
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    met = np.zeros(flags.shape[1], dtype=bool)
    for some in combinations(range(len(flags)), seen_by):
        far = np.ones(flags.shape[1], dtype=bool)
        for one, other in combinations(some, 2):
            far &= (rays[one] * rays[other]).sum(axis=1) <= np.cos(np.deg2rad(degrees)) + 1e-9
        met |= flags[list(some)].all(axis=0) & far
    return met.mean()


@for_any(12, seed=st.integers(0, 9999), count=st.integers(1, 2), degrees=st.sampled_from((0, 40)),
         fails=st.booleans())
def test_shares_are_those_of_all_groups_of_cameras(seed, count, degrees, fails):
    asked = {'pixel_density': 'perceive', 'incidence': 70, 'seen_by': count, 'angle': degrees,
             'one_may_fail': fails, 'share': 0.9}
    rig = rig_of(3, 'd455', regions=[{**BOX, 'require': asked}])
    objective = Problem.of(ROOM, rig, FAST).objective
    poses = poses_of(np.random.default_rng(seed), 3)
    views = objective.look(poses)
    order = objective.simulator.visibility.order
    inside = ((ROOM.points >= 0.0) & (ROOM.points <= [3.5, 3.5, 1.5])).all(axis=1)[order]
    flags = np.array([unpack(view.good[0], len(ROOM)) for view in views])[:, inside]
    points = ROOM.points[order][inside]
    steps = [share_of(flags, poses, points, n, degrees) for n in range(1, count + 1)]
    if fails:
        steps.append(min(share_of(np.delete(flags, k, 0), np.delete(poses, k, 0), points, count,
                                  degrees) for k in range(3)))
    found = objective.evaluate_views(views)
    assert found.requirements == pytest.approx([steps[-1]])
    # A search aims halfway between this share and 1.
    cost = MUST_SEE_COST * np.maximum(0.95 - np.array(steps), 0.0).mean()
    error = found.depth_error / objective.simulator.depth_error.worst
    # The region has the weight 1.
    assert found.loss == pytest.approx(error + 1.0 - found.regions[0] + cost)
    scores = scores_of(objective, views)
    row, = requirement_rows(scores)
    assert row[0] == 'corner' and '125 px/m' in row[1] and ('fails' in row[1]) == fails
    region = Problem.of(ROOM, rig, FAST).region
    assert any('(require)' in line for line in broken_by(region, poses, scores)) == (
        steps[-1] < 0.9)


def test_plans_pay_for_what_is_required_and_prove_it():
    asked = {'depth_accuracy': 12, 'share': 0.6}
    rig = rig_of(2, 'd455', mount={'on': 'walls'}, regions=[{**BOX, 'require': asked}])
    plain = rig_of(2, 'd455', mount={'on': 'walls'}, regions=[BOX])
    required, free = (RigPlanner(ROOM, one, FAST.engine, Budget(evaluations=100)).plan(one)
                      for one in (rig, plain))
    judge = Problem.of(ROOM, rig, FAST).objective
    (without,) = judge.evaluate(free.answer.poses).requirements
    assert required.evaluation.requirements[0] > without + 0.1
    assert required.union_bound.requirements[0] >= required.evaluation.requirements[0]
    proof = required.certificate
    assert 0.0 < proof.bound <= proof.found == pytest.approx(required.evaluation.loss)
    assert required.reaches('seen', 0.0) == (required.evaluation.requirements[0] >= 0.6)


def test_the_score_shows_what_is_met(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'rig.yaml').write_text(
        'cameras: [{sensor: kinect_v2, count: 2}]\nrequire: {pixel_density: 125, share: 0.99}\n')
    (tmp_path / 'at.yaml').write_text('cameras:\n' + ''.join(
        f'  - {{sensor: kinect_v2, position: [{x}, 3.0, 1.9], mount: plane}}\n' for x in (2, 3)))
    found = printed(capsys, 'score', '8', 'at.yaml', '--rig', 'rig.yaml', '--points', 2000)
    (score,) = found['scores']['requirements']
    assert score == {'region': '', 'require': '125 px/m (perceive, recognise), by 1 camera',
                     'share': score['share'], 'asked': 0.99, 'met': False}
    assert 0.0 < score['share'] < found['scores']['seen']
    assert any('measured as required (125 px/m' in line for line in found['broken'])
    assert ('requirements', '0 of 1 met') in [figure[:2] for figure in facts_of(found).figures]


@pytest.mark.parametrize(('sensor', 'require', 'words'), [
    ('omnidirectional', {'pixel_density': 20}, 'without resolution'),
    ('omnidirectional', {'depth_accuracy': 20}, 'without depth_noise'),
    ('d455', {'seen_by': 3}, 'require.seen_by'), ('d455', {}, 'require'),
    ('d455', {'seen_by': 2, 'one_may_fail': True}, 'require.one_may_fail'),
    ('d455', {'pixel_density': 'inspekt'}, 'require.pixel_density')])
def test_requirements_that_cameras_cannot_have_are_refused(sensor, require, words):
    with pytest.raises(ConfigurationError, match=words):
        rig_of(2, sensor, require=require)


def test_air_has_no_requirement_and_noise_of_ones_own_is_written():
    with pytest.raises(ConfigurationError, match=r'regions\[0\].require'):
        rig_of(2, 'd455', regions=[{**BOX, 'air': {}, 'require': {'incidence': 60}}])
    own, preset = rig_from(document_of('rig', {'require': {'depth_accuracy': 20}, 'cameras': [
        {'sensor': 'omnidirectional', 'depth_noise': [1, 0, 2.5]},
        {'sensor': 'realsense_d455'}]}, RIG)).cameras
    assert numbers_of(own)['depth_noise'] == [1.0, 0.0, 2.5]
    assert 'depth_noise' not in numbers_of(preset)
