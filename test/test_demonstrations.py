# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Imitation: what an expert shows, how it is kept, what is learned from it, and whole runs."""

from dataclasses import replace
import json

from conftest import box_room, box_sides, random_checkpoint
import numpy as np
import pytest
from test_training import TINY
import torch

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.move_effects import CHOICES, OF_CAMERAS
from ocp_ros.agent.policy import Policy
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.planners.online_planner import GreedyStep, Learned
from ocp_ros.planners.registry import settings_of
from ocp_ros.planners.rollout import play
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.scenes.scene_source import make_room
from ocp_ros.simulation.environment import CameraPlacementEnv
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem, space_of
from ocp_ros.simulation.reward import potential
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.training import train as training
from ocp_ros.training.demonstration_rounds import (
    ACTIONS,
    ENDS,
    LAST,
    load_rounds,
    MOVES,
    REWARDS,
    save_round,
)
from ocp_ros.training.demonstrations import (
    demonstrate,
    DemonstrationTask,
    expert_of,
    fill,
    fit,
    Imitation,
    tasks_of,
    turns_played,
    Walk,
)
from ocp_ros.training.encoded_environment import CameraByCamera
from ocp_ros.training.sac import actor_checkpoint, make_sac
from ocp_ros.training.train import train
from ocp_ros.training.training_config import (
    DemonstrationsConfig,
    RoomsConfig,
    SacConfig,
    TrainingConfig,
)
from ocp_ros.util.settings import ConfigurationError, from_nested

TURNS, MOST = 6, 3
SIMULATION = SimulationConfig(rig=RigConfig(cameras=MOST), episode=EpisodeConfig(turns=TURNS),
                              engine=EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0))
SAC = SacConfig(learning_starts=12, batch_size=8, buffer_size=400, device='cpu')


@pytest.fixture(scope='module', params=['world', 'both'])
def agent(request, small_agent):
    """Return sizes of a network for each kind of inputs that imitates."""
    return replace(small_agent, inputs=request.param)


def config_of(agent, **shown):
    """Return a small run's settings."""
    return TrainingConfig(
        seed=1, fewest_cameras=2, rooms=RoomsConfig(points=1500, rotations='0,30'),
        simulation=SIMULATION, agent=agent, sac=SAC,
        demonstrations=DemonstrationsConfig(**{'expert': 'greedy_step', 'stray': 0.2, **shown}))


def task_of(agent, number=0, expert_moves=0.5, **shown):
    """Return an episode that a policy with random weights plays too."""
    return DemonstrationTask(config_of(agent, **shown), '1000', (1, 0, number), expert_moves,
                             random_checkpoint(agent).to_bytes())


def environment_of(task):
    """Return the environment that a task is played in, reset, and its first observation."""
    config, rng = task.config, np.random.default_rng(task.seed)
    cameras = int(rng.integers(config.fewest_cameras, MOST + 1))
    rotation = float(rng.choice(config.rooms.angles))
    env = CameraByCamera(CameraPlacementEnv(
        [make_room(task.room, 0.0, config.rooms.points)], config.simulation,
        fewest=config.fewest_cameras, rotations=(rotation,)), config.agent)
    return env, env.reset(seed=int(rng.integers(1 << 31)), options={'cameras': cameras})[0]


def inputs_of(steps):
    """Return the names of what the network reads."""
    return steps.keys() - {MOVES, ACTIONS, REWARDS, LAST, ENDS}


@pytest.fixture(scope='module')
def episodes(agent):
    """Return some episodes for each kind of inputs."""
    return [demonstrate(task_of(agent, number)) for number in range(4)]


def test_an_episode_has_a_row_for_each_camera_of_each_turn(episodes, agent):
    counts = []
    for one in episodes:
        cameras = round(4 * float(one['own'][0, 0, -1]))
        steps = TURNS * cameras + 1
        assert one[MOVES].shape == one[ACTIONS].shape == (steps, 1, 2)
        assert one[REWARDS].shape == (steps,) and one[ENDS].shape == (steps, 2)
        np.testing.assert_array_equal(np.flatnonzero(one[LAST]), [steps - 1])
        assert {'present', 'directions', 'own'} <= inputs_of(one)
        assert ('points' in inputs_of(one)) == agent.cloud
        assert all(len(one[name]) == steps for name in inputs_of(one))
        assert (one['present'] == 1.0).all() and one['own'].shape == (steps, 1, OF_CAMERAS)
        # Nobody is told anything at the end.
        assert not one[MOVES][-1].any() and not one[ACTIONS][-1].any() and not one[REWARDS][-1]
        assert one[MOVES].any() and one[REWARDS].any()
        np.testing.assert_allclose(one['own'][:-1, 0, 2], np.repeat(np.arange(TURNS), cameras)
                                   / TURNS, atol=1e-6)
        assert (one[ENDS] == one[ENDS][0]).all() and 0.0 < one[ENDS][0, 0] < one[ENDS][0, 1]
        counts.append(cameras)
    assert set(counts) == {2, 3}


def test_no_played_move_is_too_long(episodes):
    for name in (ACTIONS, MOVES):
        lengths = np.concatenate([np.linalg.norm(one[name], axis=-1).ravel() for one in episodes])
        assert 0.5 < lengths.max() <= 1.0 + 1e-5


def test_an_episode_is_what_the_environment_gives_for_its_moves(episodes, agent):
    """Rewards add up to the difference of the potential, observations are those of the turns."""
    for number, one in enumerate(episodes):
        env, seen = environment_of(task_of(agent, number))
        episode = env.unwrapped.episode

        def worth():
            simulator, turn = episode.simulator, episode.turn
            return potential(turn.space_coverage, turn.depth_error, simulator.volume,
                             simulator.depth_error.worst)

        first = worth()
        for row, action in enumerate(one[ACTIONS][:-1]):
            for name, value in seen.items():
                np.testing.assert_allclose(one[name][row], value, atol=1e-4, err_msg=name)
            seen, value, *_ = env.step(action)
            assert one[REWARDS][row] == pytest.approx(value, abs=1e-4)
        np.testing.assert_allclose(
            one[ENDS][0], [episode.turn.depth_error, episode.simulator.depth_error.worst],
            rtol=1e-4)
        assert one[REWARDS].sum() == pytest.approx(worth() - first, abs=1e-3)
        assert abs(worth() - first) > 0.05


def test_the_same_task_is_the_same_episode(agent, episodes):
    again = demonstrate(task_of(agent))
    for name, value in episodes[0].items():
        np.testing.assert_array_equal(value, again[name])
    assert not np.array_equal(episodes[0][ACTIONS], episodes[3][ACTIONS])


def test_who_moves_is_the_expert_the_policy_or_chance(small_agent):
    alone, policy, strayed = (
        demonstrate(task_of(small_agent, 0, share, stray=stray))
        for share, stray in ((1.0, 0.0), (0.0, 0.0), (0.0, 1.0)))
    np.testing.assert_array_equal(alone[ACTIONS], alone[MOVES])
    actor = Policy(Checkpoint.from_bytes(task_of(small_agent).weights))
    for row, action in enumerate(policy[ACTIONS][:-1]):
        encoded = {name: policy[name][row] for name in ('directions', 'own')}
        np.testing.assert_allclose(action, actor.choose(encoded), atol=1e-5)
    # The expert would have done otherwise, and chance does.
    assert not np.allclose(policy[MOVES], policy[ACTIONS])
    away = np.linalg.norm(strayed[ACTIONS][:-1] - CHOICES[:, None, None] / 0.5, axis=-1)
    assert away.min(axis=0).max() > 0.05


def test_the_greedy_step_is_imitated_as_it_plays(small_agent):
    """What it answers camera by camera is what it does for all of them."""
    task = task_of(small_agent, 1, 1.0, stray=0.0)
    shown = demonstrate(replace(task, weights=b''))
    env, _ = environment_of(task)
    episode = env.unwrapped.episode
    online = GreedyStep(*settings_of(SIMULATION, np.random.default_rng(0)))
    outcome = play(online, episode)
    assert shown[ENDS][0, 0] == pytest.approx(outcome.depth_error[-1], rel=1e-3)
    assert outcome.depth_error[-1] < 0.9 * outcome.depth_error[0]


def test_a_cloud_alone_does_not_imitate(small_agent):
    cloud = replace(small_agent, inputs='cloud')
    with pytest.raises(ConfigurationError, match='rounds: found 2 with agent.inputs'):
        config_of(cloud, rounds=2)


@pytest.mark.parametrize('name', ['random', 'exact'])
def test_an_expert_that_knows_the_room_goes_straight_to_its_placement(room, name):
    # Who keeps a clearance goes round what is in the way, not straight.
    settings = replace(SIMULATION, episode=replace(SIMULATION.episode, clearance=0.0))
    simulator = Simulator(room, settings)
    expert = expert_of(name, simulator, settings, 40, np.random.default_rng(0))
    assert isinstance(expert, Walk)
    goal = expert._placement
    outcome = play(expert, Episode(PlaneProblem(simulator), np.random.default_rng(3)))

    def away(positions):
        apart = np.linalg.norm(positions[:, None, :2] - goal[None], axis=2)
        return min(sum(apart[k, order[k]] for k in range(MOST))
                   for order in ([0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]))

    ways = [away(positions) for positions in outcome.trajectory]
    assert np.all(np.diff(ways) <= 1e-9) and ways[-1] < ways[0] - 1.0
    # As near as the turns allow: those that are not there yet have made whole steps.
    steps = np.linalg.norm(np.diff(outcome.trajectory, axis=0), axis=2)
    assert steps.max() <= 0.5 + 1e-9
    unfinished = np.linalg.norm(outcome.trajectory[-1][:, None, :2] - goal, axis=2).min(1) > 1e-6
    assert np.allclose(steps[:, unfinished], 0.5)


@pytest.mark.system
def test_an_expert_that_plans_leads_to_a_better_end(small_agent):
    ends = {name: np.mean([
        demonstrate(task_of(small_agent, number, 1.0, expert=name, stray=stray,
                            budget=60))[ENDS][0, 0] for number in range(3)])
            for name, stray in (('lookahead', 0.0), ('annealing', 0.0), ('random', 1.0))}
    assert max(ends['lookahead'], ends['annealing']) < ends['random']


@pytest.mark.parametrize(('name', 'words'), [
    ('lokahead', "demonstrations.expert: found the unknown name 'lokahead'; did you mean "
                 "'lookahead'"),
    ('anealing', "did you mean 'annealing'"), ('zzz', 'expected one of')])
def test_experts_that_do_not_exist_are_refused_with_the_nearest_that_does(name, words):
    with pytest.raises(ConfigurationError, match=words):
        DemonstrationsConfig(expert=name)


def test_the_policy_takes_over_from_round_to_round(small_agent):
    config = config_of(small_agent, alone=2, expert_moves=0.4, fading=0.5, episodes=5)
    rounds = [tasks_of(config, ['a', 'b', 'c'], number, b'w') for number in range(5)]
    assert [tasks[0].expert_moves for tasks in rounds] == [1.0, 1.0, 0.1, 0.05, 0.025]
    assert [tasks[0].weights for tasks in rounds] == [b'', b'', b'w', b'w', b'w']
    everything = [task for tasks in rounds for task in tasks]
    assert len({task.seed for task in everything}) == 25
    assert {task.room for task in everything} == {'a', 'b', 'c'}
    assert rounds[3] == tasks_of(config, ['a', 'b', 'c'], 3, b'w')


def test_rounds_come_back_as_they_went(episodes, agent, tmp_path):
    save_round(tmp_path / '0000.npz', episodes[:3])
    save_round(tmp_path / '0001.npz', episodes[3:])
    back = load_rounds(tmp_path, 2, agent)
    assert back.keys() == episodes[0].keys()
    for name, value in back.items():
        expected = np.concatenate([one[name] for one in episodes])
        assert value.shape == expected.shape
        if expected.dtype == np.float32:
            assert value.dtype == np.float16
            np.testing.assert_allclose(value, expected, rtol=1e-3, atol=1e-4, err_msg=name)
        else:
            np.testing.assert_array_equal(value, expected, err_msg=name)
    assert turns_played(back) == sum(len(one[LAST]) - 1 for one in episodes)
    first = load_rounds(tmp_path, 1, agent)
    assert len(first[REWARDS]) == sum(len(one[LAST]) for one in episodes[:3])
    assert sorted(path.name for path in tmp_path.iterdir()) == ['0000.npz', '0001.npz']


def kept(episodes, folder, agent):
    """Return episodes as they come back from a file."""
    save_round(folder / '0000.npz', episodes)
    return load_rounds(folder, 1, agent)


def test_a_fit_comes_nearer_to_what_the_expert_did(episodes, agent, tmp_path):
    shown, model = kept(episodes, tmp_path, agent), make_sac(SAC, agent, 1, seed=0)
    imitation = Imitation(shown, model.device)
    assert len(imitation) == turns_played(shown)

    def loss():
        np.random.seed(0)
        with torch.no_grad():
            return float(imitation.loss(model.policy.actor, torch.arange(len(imitation))))

    config = DemonstrationsConfig(batch_size=16, learning_rate=3e-3)
    critic = [value.clone() for value in model.critic.parameters()]
    before, first = loss(), fit(model, shown, config, 1)
    last = fit(model, shown, config, 30)
    assert last < first and loss() < before - 0.1
    # The critics learn nothing from it; every gradient step is counted.
    assert all(map(torch.equal, critic, model.critic.parameters()))
    assert model._n_updates == 31 * (len(imitation) // 16)


def test_what_is_imitated_is_turned_as_the_room_is(small_agent, tmp_path):
    """The loss of what turns with the room does not depend on how it is turned."""
    shown = kept([demonstrate(task_of(small_agent))], tmp_path, small_agent)
    imitation = Imitation(shown, torch.device('cpu'))
    actor, losses = make_sac(SAC, small_agent, 1, seed=0).policy.actor, []
    for number in range(4):
        with pytest.MonkeyPatch.context() as patch, torch.no_grad():
            patch.setattr(np.random, 'randint', lambda *_, size: np.full(size, number))
            losses.append(float(imitation.loss(actor, torch.arange(len(imitation)))))
    np.testing.assert_allclose(losses, losses[0], rtol=1e-4)


def test_demonstrations_fill_the_replay(episodes, agent, tmp_path):
    shown = kept(episodes, tmp_path, agent)
    model = make_sac(SAC, agent, 1, seed=0, environments=2)
    fill(model, shown)
    replay, starts = model.replay_buffer, np.flatnonzero(~shown[LAST])
    size = replay.size()
    assert size == len(starts) // 2 and not replay.dones[:size].any()
    starts = starts[len(starts) - 2 * size:].reshape(size, 2)
    np.testing.assert_allclose(replay.rewards[:size], shown[REWARDS][starts])
    np.testing.assert_allclose(replay.actions[:size].reshape(size, 2, 1, 2),
                               shown[ACTIONS][starts])
    for name in inputs_of(shown):
        np.testing.assert_allclose(replay.observations[name][:size], shown[name][starts])
        np.testing.assert_allclose(replay.next_observations[name][:size],
                                   shown[name][starts + 1])
    # No episode leads into the next one.
    times = shown['own'][:, 0, 2]
    assert (times[starts + 1] >= times[starts]).all()
    assert torch.isfinite(replay.sample(16).observations['own']).all()


def test_only_the_latest_demonstrations_fill_a_small_replay(small_agent):
    one = demonstrate(task_of(small_agent))
    steps, starts = len(one[LAST]), len(one[LAST]) - 1
    shown = {name: np.concatenate([value] * 20) for name, value in one.items()}
    shown[REWARDS] = np.arange(20.0 * steps, dtype=np.float32)
    model = make_sac(replace(SAC, buffer_size=100), small_agent, 1, seed=0)
    fill(model, shown)
    expected = [reward for reward in range(20 * steps) if reward % steps < starts][-100:]
    assert model.replay_buffer.size() == 100
    assert model.replay_buffer.rewards[:100].ravel().tolist() == expected


SHOWN = {**TINY, 'interactions': 0, 'demonstrations': {
    'rounds': 2, 'episodes': 2, 'expert': 'greedy_step', 'evaluate_every': 1, 'epochs': 2,
    'last_epochs': 3, 'batch_size': 4}}


def lines_of(folder):
    """Return the evaluations of a run."""
    return [json.loads(line) for line in (folder / 'progress.jsonl').read_text().splitlines()]


def moves_shown(folder, rounds):
    """Return how many moves there are in so many rounds of a run."""
    agent = from_nested(TrainingConfig, SHOWN).agent
    return turns_played(load_rounds(folder / 'demonstrations', rounds, agent))


@pytest.mark.system
def test_a_run_of_demonstrations_alone_goes_on_where_it_stopped(tmp_path, here):
    first = train(from_nested(TrainingConfig, SHOWN), tmp_path)
    lines = lines_of(tmp_path)
    assert [line['phase'] for line in lines] == ['demonstrations'] * 2
    assert [line['interactions'] for line in lines] == [moves_shown(tmp_path, k) for k in (1, 2)]
    best = min(lines, key=lambda line: line['ratio'])
    assert first.provenance['interactions'] == best['interactions']
    assert {path.name for path in (tmp_path / 'demonstrations').iterdir()} == {
        '0000.npz', '0000.fitted', '0001.npz', '0001.fitted'}
    # As if nothing better could come.
    best['ratio'] = 1e-6
    (tmp_path / 'progress.jsonl').write_text(''.join(json.dumps(line) + '\n' for line in lines))
    times = {path.name: path.stat().st_mtime_ns
             for path in (tmp_path / 'demonstrations').glob('*.npz')}
    longer = train(from_nested(TrainingConfig, {
        **SHOWN, 'demonstrations': {**SHOWN['demonstrations'], 'rounds': 3}}), tmp_path)
    lines = lines_of(tmp_path)
    assert [line['interactions'] for line in lines] == [
        moves_shown(tmp_path, rounds) for rounds in (1, 2, 3)]
    assert lines[2]['updates'] > lines[1]['updates'] and longer.run == first.run
    # Played rounds are not played again, and the best stays the best.
    for name, time in times.items():
        assert (tmp_path / 'demonstrations' / name).stat().st_mtime_ns == time
    assert longer.updates == first.updates == best['updates']


def test_a_run_that_was_killed_between_play_and_fit_plays_nothing_twice(
        tmp_path, here, monkeypatch):
    # The first round is not evaluated: its line has no figures to choose the best by.
    config = from_nested(TrainingConfig, {
        **SHOWN, 'demonstrations': {**SHOWN['demonstrations'], 'evaluate_every': 2}})
    real, fits = training.demonstrations.fit, []

    def interrupted(*arguments):
        fits.append(arguments)
        if len(fits) == 2:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(training.demonstrations, 'fit', interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path)
    played = (tmp_path / 'demonstrations' / '0001.npz').read_bytes()
    again = train(config, tmp_path)
    assert (tmp_path / 'demonstrations' / '0001.npz').read_bytes() == played
    lines = lines_of(tmp_path)
    assert len(fits) == 3 and ['ratio' in line for line in lines] == [False, True]
    assert Checkpoint.load(tmp_path / 'best.safetensors').run == again.run
    assert again.updates == lines[-1]['updates']


@pytest.mark.system
def test_a_run_imitates_first_and_then_learns_by_itself(tmp_path, here):
    config = from_nested(TrainingConfig, {
        **SHOWN, 'interactions': 24, 'sac': {**TINY['sac'], 'burn_in': 6}})
    found = train(config, tmp_path)
    lines = lines_of(tmp_path)
    assert [line['phase'] for line in lines] == ['demonstrations'] * 2 + ['sac']
    shown = moves_shown(tmp_path, 2)
    assert [line['interactions'] for line in lines] == [moves_shown(tmp_path, 1), shown,
                                                        shown + 24]
    assert lines[2]['updates'] > lines[1]['updates']
    assert found.provenance['test']['rooms'] == 1
    best = min(lines, key=lambda line: line['ratio'])
    assert found.provenance['interactions'] == best['interactions']
    # Nothing is left to do: started again, it only reports.
    again = train(config, tmp_path)
    assert lines_of(tmp_path) == lines and again.run == found.run


def occluded():
    """Return a room with a large box beside its middle, around whose end one has to see."""
    box = box_sides(np.array([1.2, 2.4, 2.6]), np.array([3.3, 1.2, 1.3]))
    return np.concatenate([box_room(5.0, 4.0).points, box.astype(np.float32)])


@pytest.mark.system
def test_the_best_place_of_a_toy_room_is_learned(tmp_path):
    """One camera, one room: imitation leads it near the best place there is."""
    path = str(tmp_path / 'toy.npy')
    np.save(path, occluded())
    simulation = SimulationConfig(
        rig=RigConfig(cameras=1, max_range=6.0),
        episode=EpisodeConfig(turns=12, start_radius=0.2, clearance=0.0),
        engine=EngineConfig(preset='fast', error_rows=32, coverage_cell=0.5))
    agent = AgentConfig(hidden=64)
    config = TrainingConfig(
        fewest_cameras=1, simulation=simulation, agent=agent, sac=SAC,
        rooms=RoomsConfig(points=3000, rotations='0'), demonstrations=DemonstrationsConfig(
            episodes=16, expert='greedy_step', stray=0.15, batch_size=32, learning_rate=3e-3))
    shown = kept([demonstrate(task) for task in tasks_of(config, [path], 0, b'')], tmp_path, agent)
    model = make_sac(SAC, agent, 1, seed=0)
    simulator = Simulator(make_room(path, 0.0, 3000), simulation)
    grid = space_of(simulator).grid(300)
    least = simulator.evaluate_many(
        np.insert(grid, 2, simulator.height, axis=1)[:, None])[:, 1].min()

    def errors():
        policy = Policy(actor_checkpoint(model, 'r', {}))
        online = Learned(policy, *settings_of(simulation, np.random.default_rng(0)))
        problem = PlaneProblem(simulator)
        return np.mean([play(online, Episode(problem, np.random.default_rng(seed))).depth_error
                        for seed in range(5)], axis=0)

    unlearned = errors()
    torch.manual_seed(0)
    np.random.seed(0)
    fit(model, shown, config.demonstrations, 60)
    learned = errors()
    assert learned[0] == unlearned[0] > 2.0 * least
    # Nearly all that there is to gain is gained, and without having learned it is not.
    assert learned[-1] - least < 0.15 * (learned[0] - least)
    assert unlearned[-1] - least > 0.6 * (learned[0] - least)
