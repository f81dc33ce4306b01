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

"""The simulated rig: what placements are worth, moves, rewards, episodes, the environment."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
import warnings

from conftest import for_any, made_room
from gymnasium.utils.env_checker import check_env
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import pack, Subset
from ocp_ros.rig.motion import bounded_moves, kept_inside
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.rig_file import rig_of
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.episode import Episode, potential, reward, Value
from ocp_ros.simulation.objective import MUST_SEE_COST, Objective
from ocp_ros.simulation.problem import PlaneProblem, Problem
from ocp_ros.simulation.simulation_config import EpisodeConfig, RewardConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError
import pytest
from stable_baselines3.common.env_checker import check_env as check_env_sb3

SMALL = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=32, coverage_cell=0.5),
                         episode=EpisodeConfig(turns=6))
seeds = st.integers(0, 2 ** 32 - 1)
FIXED = [{'sensor': 'kinect_v2', 'position': [4.0, 4.0, 2.2], 'yaw': 200, 'pitch': 20}]
REGIONS = [{'name': 'a', 'box': [[0, 0, -1], [4, 4, 9]], 'weight': 2.0, 'must_see': 0.9},
           {'name': 'b', 'polygon': [[4, 4], [7, 4], [7, 7]], 'weight': 0.5}]
POSES = np.array([[2.0, 2.0, 1.9, 0.3, 0.4, 0.0], [5.0, 5.0, 1.9, 3.0, 0.5, 0.0],
                  [4.0, 3.0, 1.9, 1.5, 0.6, 0.0]])


@pytest.fixture(scope='module')
def simulator(room):
    """Return the engine for a small room."""
    return Simulator(room, SMALL)


def two_rooms(room, **options):
    """Return an environment of four cameras in two small rooms."""
    return CameraPlacementEnv([room, made_room(12, 2000)], SMALL, observation_points=128,
                              **options)


@pytest.fixture
def few(room):
    """Return one of one to four cameras in rooms that are turned."""
    return two_rooms(room, fewest=1, rotations=(0.0, 30.0, 60.0, 90.0))


def problem_of(room, cameras, sensor, **more):
    """Return the problem of cameras that look one way, on a plane."""
    return Problem.of(room, rig_of(cameras, sensor, mount={'on': 'plane', 'height': 1.9}, **more),
                      SMALL)


def episode_in(simulator, seed=0):
    """Return an episode that has begun."""
    return Episode(PlaneProblem(simulator), np.random.default_rng(seed))


def seen_by(simulator, pose, camera):
    """Return which points a camera sees: (N,) bool, in the scene's order."""
    return Subset(simulator.look(pose, camera).seen, simulator.visibility.order).mask


def play(env, seed):
    """Return everything an episode of random actions gives."""
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    record = [(observation, 0.0, False, False, info)]
    for _ in range(6):
        record.append(env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)))
    return record


def test_the_checkers_of_gymnasium_and_stable_baselines3_find_nothing(few):
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        check_env(few, skip_render_check=True)
        # It advises a custom policy for anything but vectors and images, and there is one.
        warnings.filterwarnings('ignore', '.*unconventional shape')
        check_env_sb3(few, warn=True)


def test_a_seed_and_its_actions_determine_an_episode_which_is_truncated_and_explained(room):
    env = two_rooms(room)
    record = play(env, 11)
    for one, two in zip(record, play(two_rooms(room), 11), strict=True):
        assert all(np.array_equal(one[0][key], two[0][key]) for key in one[0])
        assert one[1:] == two[1:]
    assert not np.array_equal(record[-1][0]['camera_positions'],
                              play(env, 12)[-1][0]['camera_positions'])
    assert [truncated for *_, truncated, _ in record] == [False] * 6 + [True]
    for _, value, terminated, _, info in record[1:]:
        assert not terminated and info['reward'] == value
        assert {'delta_space_coverage', 'delta_depth_error', 'penalty', 'space_coverage',
                'depth_error', 'worst_depth_error', 'scene', 'step'} <= info.keys()


def test_the_room_its_rotation_and_the_cameras_can_be_chosen(room, few):
    assert two_rooms(room).reset(options={'scene': 1})[1]['scene'] == 'room-12'
    seen, info = few.reset(seed=3, options={'rotation': 90.0, 'cameras': 2})
    assert info['scene'].endswith('@90') and seen['present'].sum() == 2
    scene, = (one for one in few.scenes if info['scene'] == f'{one.name}@90')
    np.testing.assert_allclose(few.episode.scene.points[:, 0], -scene.points[:, 1], atol=1e-4)
    # What is chosen does not change what else is drawn.
    drawn = [few.reset(seed=3, options=options)[1]['scene'].partition('@')[0]
             for options in ({}, {'rotation': 90.0}, {'cameras': 1})]
    assert len(set(drawn)) == 1


def test_how_many_cameras_there_are_is_drawn_and_padded(room, few):
    counts, names = [], set()
    for seed in range(40):
        seen, info = few.reset(seed=seed)
        count = len(few.episode.turn.positions)
        np.testing.assert_array_equal(seen['present'], np.arange(4) < count)
        padded = np.zeros((4, 3))
        padded[:count] = few.episode.turn.positions
        np.testing.assert_allclose(seen['camera_positions'], padded, atol=1e-6)
        counts.append(count)
        names.add(info['scene'])
    assert np.bincount(counts, minlength=5)[1:].min() >= 3 and len(names) == 8
    env = two_rooms(room)
    assert all(env.reset(seed=seed)[0]['present'].all() for seed in range(5))


@pytest.mark.parametrize(('rooms', 'fewest', 'words'), [
    (1, 0, 'fewest: found 0'), (1, 5, 'fewest: found 5'), (0, None, 'scenes')])
def test_an_environment_without_rooms_or_cameras_is_refused(room, rooms, fewest, words):
    with pytest.raises(ValueError, match=words):
        CameraPlacementEnv([room] * rooms, SMALL, fewest=fewest)


def test_moves_of_cameras_that_there_are_not_change_nothing(few):
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 2)).astype(np.float32)
    outcomes = []
    for other in (1.0, -1.0):
        few.reset(seed=1, options={'cameras': 2})
        actions[2:] = other
        seen, value, *_ = few.step(actions)
        outcomes.append((value, seen['camera_positions'].tolist(), seen['cloud'].tolist()))
    assert outcomes[0] == outcomes[1] and np.any(outcomes[0][1][:2])
    few.reset(seed=1, options={'cameras': 3})
    assert few.step(actions)[1] != outcomes[0][0]


def test_where_nothing_is_seen_the_cameras_are_all_that_is_known(room):
    config = replace(SMALL, rig=RigConfig(max_range=0.1))
    observation, info = CameraPlacementEnv([room], config).reset(seed=0)
    assert info['depth_error'] == info['worst_depth_error']
    np.testing.assert_allclose(observation['bounds'][0], observation['camera_positions'].min(0))


@for_any(30, seed=seeds, scale=st.floats(0.0, 100.0))
def test_cameras_stay_in_the_room_and_what_was_observed_stays_observed(simulator, seed, scale):
    episode = episode_in(simulator, seed)
    low, high = simulator.scene.bounds
    for moves in scale * np.random.default_rng(seed).normal(size=(4, 4, 2)):
        before, observed = episode.turn.positions, episode.observed
        turn = episode.move(moves)
        assert episode.observed >= observed
        assert len(episode.observed_cloud) == len(episode.observed)
        assert np.linalg.norm(turn.positions - before, axis=1).max() <= 0.5 + 1e-9
        assert (turn.positions >= low + [0.1, 0.1, 0.0] - 1e-9).all()
        assert (turn.positions <= high - [0.1, 0.1, 0.0] + 1e-9).all()
        assert (turn.positions[:, 2] == simulator.height).all()


@for_any(15, seed=seeds)
def test_one_camera_more_never_sees_less(simulator, seed):
    positions = np.random.default_rng(seed).uniform(*simulator.scene.bounds, (3, 3))
    fewer, more = simulator.evaluate(positions[:2]), simulator.evaluate(positions)
    assert more.seen >= fewer.seen
    assert more.space_coverage >= fewer.space_coverage
    assert more.depth_error <= fewer.depth_error + 1e-5
    judged = simulator.evaluate_views([simulator.look(position) for position in positions])
    assert np.array_equal(judged.seen.bits, more.seen.bits) and judged[1:] == more[1:]


def test_a_move_out_of_the_bounding_box_is_penalised(simulator):
    episode = episode_in(simulator)
    penalties = [episode.move(np.tile([0.5, 0.0], (4, 1))).terms.penalty for _ in range(12)]
    assert penalties[0] == 0.0 and penalties[-1] == 1.0


def test_cameras_start_near_the_centre_at_their_height_above_the_floor(room):
    sunken = Scene(room.points - np.float32([0.0, 0.0, 1.5]), name='sunken')
    # With a clearance they start beside furniture, which may be farther from the centre.
    simulator = Simulator(sunken, replace(SMALL, episode=EpisodeConfig(clearance=0.0)))
    starts = np.concatenate([episode_in(simulator, seed).turn.positions for seed in range(20)])
    offsets = np.linalg.norm((starts - sunken.bounds.mean(axis=0))[:, :2], axis=1)
    assert 0.3 < offsets.max() <= 0.5
    np.testing.assert_allclose(starts[:, 2], sunken.bounds[0, 2] + 1.9)


def test_cameras_are_turned_with_a_move_and_stay_so(room):
    problem = problem_of(room, 2, 'realsense_d455', pitch=[0, 60])
    simulator, episode = problem.simulator, Episode(problem, np.random.default_rng(0))
    moves = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]])
    headings = np.array([[1, 0.3, 0], [2, 0.1, 0.2]])
    before = episode.turn.headings
    np.testing.assert_array_equal(episode.move(moves).headings, before)
    turn = episode.move(moves, headings)
    np.testing.assert_array_equal(turn.headings, headings)
    # They are judged as they are turned, and the moves after it leave them so.
    for now in (turn, episode.move(moves)):
        found = simulator.evaluate(np.hstack([now.positions, headings]))
        assert (found.depth_error, found.space_coverage) == (now.depth_error, now.space_coverage)
        np.testing.assert_array_equal(now.headings, headings)
    other = simulator.evaluate(np.hstack([now.positions, before]))
    assert found.depth_error != other.depth_error


def test_each_camera_of_a_mixed_rig_sees_with_its_own_model(room):
    simulator = Simulator(room, SMALL, [CameraModel(max_range=4.0),
                                        SENSORS['realsense_d435'].model])
    middle = np.append(room.bounds.mean(axis=0)[:2], 1.9)
    whole, part = (seen_by(simulator, middle, k) for k in (0, 1))
    x, y, _ = (room.points - middle).T
    assert 0 < part.sum() < 0.3 * whole.sum()
    assert (np.abs(np.arctan2(y, x))[part] <= np.deg2rad(43.6)).all()
    seen = seen_by(simulator, np.append(middle, [np.pi / 2, 0.0, 0.0]), 1)
    assert seen.any() and (y[seen] > 0.0).all()
    with pytest.raises(ValueError, match='3 cameras'):
        simulator.evaluate(np.tile(middle, (3, 1)))


def test_the_cameras_of_an_episode_look_outwards(room):
    problem = problem_of(room, 4, 'azure_kinect_wfov', pitch=[20, 60])
    simulator, turn = problem.simulator, Episode(problem, np.random.default_rng(0)).turn
    np.testing.assert_allclose(np.rad2deg(turn.headings[:, 0]), [0, 90, 180, 270])
    outwards, alike = (simulator.evaluate(np.hstack([turn.positions, headings]))
                       for headings in (turn.headings, 0.0 * turn.headings))
    assert turn.depth_error == outwards.depth_error
    assert len(alike.seen) < 0.8 * len(outwards.seen)


@pytest.mark.parametrize('preset', ['fine', 'fast', 'paper', 'mesh'])
def test_a_rig_sees_in_one_call_what_its_cameras_see_one_by_one(room, preset):
    simulator = Simulator(room, SimulationConfig(engine=EngineConfig(preset)), [
        CameraModel(max_range=4.0), SENSORS['realsense_d435'].model,
        SENSORS['azure_kinect_wfov'].model])
    poses = np.array([[*room.bounds.mean(axis=0), yaw, 0.3, 0.1] for yaw in (0.2, -2.0, 3.0)])
    together = simulator.look_from_all(poses[::-1], [2, 1, 0])[::-1]
    for camera, (pose, view) in enumerate(zip(poses, together, strict=True)):
        assert all(map(np.array_equal, view, simulator.look(pose, camera)))
        assert view.seen.any() and view.covered.any()
    assert simulator.look_from_all(poses[:0], []) == []


@pytest.mark.parametrize('preset', ['fine', 'fast', 'paper'])
def test_threads_change_nothing(room, preset):
    simulator = Simulator(room, replace(SMALL, engine=replace(SMALL.engine, preset=preset)))
    placements = np.random.default_rng(0).uniform(*room.bounds, (24, 3, 3))
    alone = [simulator.evaluate(placement)[1:] for placement in placements]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda placement: simulator.evaluate(placement)[1:],
                             placements)) == alone


def test_the_papers_reward_is_its_formula(monkeypatch):
    monkeypatch.setattr('ocp_ros.simulation.episode.PENALTY', -2.0)
    config = RewardConfig(kind='paper', coverage=0.02, depth_error=1.0)
    inside, outside = (reward(Value(10.0, 5.0, 0.1), Value(25.0, 4.5, 0.3), left, 100.0, 50.0,
                              config) for left in (False, True))
    assert inside.reward == pytest.approx((0.02 * 15.0 + 0.5) ** 3) and outside.reward == -8.0
    assert (inside.delta_space_coverage, inside.delta_depth_error) == (15.0, 0.5)


@for_any(actions=st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=6))
def test_no_move_is_longer_than_the_longest_step(actions):
    moves = bounded_moves(np.array(actions), 0.5)
    assert np.linalg.norm(moves, axis=1).max() <= 0.5 + 1e-12
    short = np.linalg.norm(actions, axis=1) <= 1.0
    np.testing.assert_allclose(moves[short], 0.5 * np.array(actions)[short])


def test_a_box_narrower_than_its_margins_keeps_its_middle():
    bounds = np.array([[0.0, 0.0, 0.0], [0.1, 5.0, 3.0]])
    inside, outside = kept_inside(np.array([[-3.0, 1.0, 1.0]]), bounds, 0.2)
    np.testing.assert_allclose(inside, [[0.05, 1.0, 1.0]])
    assert outside


def test_the_shares_of_the_cameras_add_up_to_the_reward_of_the_turn(simulator):
    """The share of the points that are new counts by its weight."""
    config = replace(SMALL, reward=RewardConfig(explored=5.0))
    episode = episode_in(simulator.with_models(simulator.models, config))
    for first in range(3):
        before, seen = episode.turn, len(episode.observed)
        episode.move([[0.2, 0.1], [-0.3, 0.2], [0.1, -0.2], [0.0, 0.3]])
        now, later = (potential(turn.space_coverage, turn.depth_error, simulator.volume,
                                simulator.depth_error.worst) for turn in (before, episode.turn))
        new = (len(episode.observed) - seen) / len(simulator.scene)
        assert episode.turn.terms.reward == pytest.approx(later - now + 5.0 * new) and new > 0.0
        shares = episode.shares(np.roll(np.arange(4), -first))
        assert sum(share.reward for share in shares) == pytest.approx(episode.turn.terms.reward)
        # The first one alone has moved when its share is told.
        alone = before.positions.copy()
        alone[first] = episode.turn.positions[first]
        gain = before.depth_error - simulator.evaluate(alone).depth_error
        assert shares[0].delta_depth_error == pytest.approx(gain)


def objective_of(room, **more):
    """Judge three D455 and a Kinect that hangs already."""
    rig = rig_of(3, 'd455', fixed=FIXED, **more)
    return Problem.of(room, rig, SMALL).objective


def flags_of(objective):
    """Return who sees which point: (4, N) bool."""
    placement = [*POSES, *objective.rig.fixed_poses]
    return np.array([seen_by(objective.simulator, pose, k) for k, pose in enumerate(placement)])


@pytest.mark.parametrize('least', [1, 2, 3])
def test_a_point_counts_where_enough_cameras_see_it(room, least):
    objective = objective_of(room, seen_by=least, regions=REGIONS)
    simulator, flags = objective.simulator, flags_of(objective)
    worth = objective.evaluate(POSES)
    enough = flags.sum(axis=0) >= least
    assert np.array_equal(worth.seen.mask, enough) and enough.any()
    error = simulator.depth_error(pack(enough[simulator.visibility.order]))
    assert worth.depth_error == error
    x, y, _ = room.points.T
    inside = [(x >= 0.0) & (x <= 4.0) & (y >= 0.0) & (y <= 4.0), (x < 7.0) & (y > 4.0) & (x > y)]
    shares = [enough[part].mean() for part in inside]
    np.testing.assert_allclose(worth.regions, shares)
    loss = (error / simulator.depth_error.worst + 2.0 * (1.0 - shares[0])
            + 0.5 * (1.0 - shares[1]) + MUST_SEE_COST * max(0.9 - shares[0], 0.0))
    assert worth.loss == pytest.approx(loss)
    # Where one camera is enough, all is as the engine says.
    plain = simulator.evaluate(np.concatenate([POSES, objective.rig.fixed_poses]))
    assert worth.space_coverage <= plain.space_coverage and worth.depth_error >= plain.depth_error
    assert (worth.space_coverage == plain.space_coverage) == (least == 1)
    assert (worth.depth_error == plain.depth_error) == (least == 1)


@pytest.mark.parametrize('least', [1, 2])
def test_overlap_what_each_camera_adds_and_what_one_more_would(room, least):
    objective = objective_of(room, seen_by=least)
    views, flags = objective.look(POSES), flags_of(objective)
    counts = flags.sum(axis=0)
    shown = np.bincount(np.minimum(counts, 3), minlength=4)
    assert objective.overlap(views) == shown.tolist()
    error = objective.evaluate_views(views).depth_error
    for k, contribution in zip(range(4), objective.contributions(views), strict=True):
        assert contribution.only == np.mean(flags[k] & (counts == 1))
        without = np.delete(flags, k, axis=0).sum(axis=0) >= least
        lost = objective.simulator.depth_error(pack(without[objective.simulator.visibility.order]))
        assert contribution.depth_error == pytest.approx(lost - error)
        assert contribution.depth_error >= 0.0
    errors = objective.with_one_more(views[:2], views)
    np.testing.assert_allclose(
        errors, [objective.evaluate_views([*views[:2], view]).depth_error for view in views])
    assert errors.max() <= objective.evaluate_views(views[:2]).depth_error


@pytest.mark.parametrize('more', [{}, {'seen_by': 2, 'regions': REGIONS}, {'calibratable': {}}])
def test_the_losses_of_one_more_camera_are_those_of_all(room, more):
    objective = objective_of(room, **more)
    views = objective.look(POSES)
    np.testing.assert_allclose(objective.losses_with(views[:2], views),
                               [objective.loss([*views[:2], view]) for view in views])
    # The eased losses are the means for requirements of one camera and more.
    eased = [Objective(objective.simulator, replace(objective.rig, seen_by=count)).loss(views[:1])
             for count in range(1, objective.rig.seen_by + 1)]
    assert objective.losses_with([], views[:1], eased=True) == pytest.approx(np.mean(eased))


def test_a_search_demands_more_of_links_than_the_rig(room):
    objective = objective_of(room, calibratable={'overlap': 0.2})
    views = objective.look(POSES)
    assert objective.searched.covisibility(views).required == pytest.approx(0.25)
    assert objective.covisibility(views).required == 0.2
    assert objective.searched.loss(views) >= objective.loss(views)
    assert objective_of(room).searched.covisibility(views) is None


def test_nobody_sees_nothing(room):
    objective = Problem.of(room, rig_of(2, 'd455', seen_by=2), SMALL).objective
    worth = objective.evaluate_views([])
    assert worth.depth_error == objective.simulator.depth_error.worst and worth.loss == 1.0
    assert len(worth.seen) == 0 and worth.space_coverage == 0.0
    assert objective.overlap([]) == [len(room), 0, 0, 0] and objective.contributions([]) == []
    alone = objective.contributions(objective.look(POSES[:1]))
    assert alone[0].depth_error == 0.0 and alone[0].only > 0.0


def test_a_region_without_points_and_a_height_without_a_room_are_refused(room):
    with pytest.raises(ConfigurationError, match=r'regions\[0\]'):
        objective_of(room, regions=[{'name': 'far', 'box': [[40, 0, 0], [41, 1, 1]]}])
    with pytest.raises(ConfigurationError, match='mount.height'):
        objective_of(room, mount={'on': 'plane', 'height': 9})
    with pytest.raises(SceneError, match='rig.height'):
        Simulator(room, SimulationConfig(rig=RigConfig(height=9.0)))
