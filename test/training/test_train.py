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

"""Training: evaluation and whole runs."""

from dataclasses import replace
import json

from conftest import Here, random_checkpoint, TINY
import numpy as np
from ocp_ros.cli.main import main
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.policy import Policy
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.training.run_folder import claim, read_config
from ocp_ros.training.train import train, trials_of
from ocp_ros.training.training_config import RoomsConfig, TrainingConfig
from ocp_ros.training.validation import evaluate, play_trial, ValidationTrial
from ocp_ros.util.settings import ConfigurationError, from_nested
import pytest

SIMULATION = SimulationConfig(engine=EngineConfig(preset='fast', error_rows=16, coverage_cell=1.0),
                              episode=EpisodeConfig(turns=6))


def trial(**changes):
    """Return an episode to judge in a small room."""
    return ValidationTrial(**{'room': '8', 'rooms': RoomsConfig(points=2000), 'rotation': 30.0,
                              'simulation': SIMULATION, 'seed': 3, **changes})


def test_evaluation_starts_everybody_from_the_same_place_and_with_the_rig_of_the_trial(agent):
    weights = random_checkpoint(agent).to_bytes()
    # The policy knows from the trial's rig how far cameras see and move.
    far = replace(SIMULATION, rig=RigConfig(max_range=2.0))
    slow = replace(SIMULATION, episode=EpisodeConfig(turns=6, max_step=0.1))
    ends = {name: play_trial(one) for name, one in {
        'random': trial(), 'weights': trial(weights=weights), 'another seed': trial(seed=4),
        'far': trial(weights=weights, simulation=far),
        'slow': trial(weights=weights, simulation=slow)}.items()}
    assert ends['random'][0] == ends['weights'][0] == ends['slow'][0]
    assert ends['another seed'][0] != ends['random'][0]
    assert len({end for _, end, _ in ends.values()}) == 5
    assert play_trial(trial(weights=weights)) == ends['weights']


def test_an_evaluation_is_the_mean_of_its_episodes():
    pool, trials = Here(), [trial(seed=seed, room=room) for seed, room in ((0, '8'), (1, '12'))]
    starts, ends, covered = np.array([play_trial(one) for one in trials]).T
    assert evaluate(pool, trials) == {
        'depth_error_start': starts.mean(), 'depth_error_end': ends.mean(),
        'ratio': ends.mean() / starts.mean(), 'space_coverage_end': covered.mean()}
    assert pool.played == trials


@pytest.mark.system
def test_a_run_reports_on_rooms_it_never_saw_and_goes_on_when_it_is_started_again(
        tmp_path, here):
    config, fine = from_nested(TrainingConfig, TINY), EngineConfig(preset='fine')
    first = train(config, tmp_path)
    figures, lines = first.provenance['test'], first.provenance['curve']
    best = min(lines, key=lambda line: line['ratio'])
    assert first.provenance['interactions'] == best['interactions']
    trials = [replace(one, simulation=replace(one.simulation, engine=fine))
              for one in trials_of(config, 'test')]
    judged = [replace(one, weights=first.to_bytes()) for one in trials]
    assert figures == {'rooms': 1, 'random_moves': evaluate(Here(), trials),
                       'policy': evaluate(Here(), judged)}
    assert lines == [
        json.loads(line) for line in (tmp_path / 'progress.jsonl').read_text().splitlines()]
    assert [line['interactions'] for line in lines] == [24, 48]
    again = train(config, tmp_path / 'again').provenance['curve']
    assert [{**line, 'seconds': 0} for line in again] == [{**line, 'seconds': 0} for line in lines]
    longer = train(from_nested(TrainingConfig, {**TINY, 'interactions': 80}), tmp_path)
    assert longer.run == first.run
    curve = longer.provenance['curve']
    assert [line['interactions'] for line in curve] == [24, 48, 72, 80]
    assert np.all(np.diff([line['seconds'] for line in curve]) >= 0.0)
    # The replay buffer goes on as well, so each new move gets its gradient steps.
    assert curve[-1]['updates'] == curve[1]['updates'] + (80 - 48)
    # The best stays the best.
    best = min(curve, key=lambda line: line['ratio'])
    assert longer.provenance['interactions'] == best['interactions']
    assert Checkpoint.load(tmp_path / 'best.safetensors').updates == best['updates']


@pytest.mark.parametrize(('changes', 'key'), [
    ({'seed': 1}, 'seed 0'), ({'sac': {**TINY['sac'], 'gamma': 0.9}}, 'sac.gamma 0.95'),
    ({'rooms': {**TINY['rooms'], 'training': 2}}, 'rooms.training 1')])
def test_a_folder_of_another_run_is_left_as_it_is(tmp_path, changes, key):
    claim(tmp_path, from_nested(TrainingConfig, TINY))
    claim(tmp_path, from_nested(TrainingConfig, {**TINY, 'interactions': 90, 'workers': 2}))
    before = (tmp_path / 'config.yaml').read_text()
    assert 'interactions: 90' in before
    with pytest.raises(ConfigurationError, match=key):
        train(from_nested(TrainingConfig, {**TINY, **changes}), tmp_path)
    assert (tmp_path / 'config.yaml').read_text() == before


@pytest.mark.system
def test_ocp_train_writes_a_model_that_runs(tmp_path, capsys, room):
    (tmp_path / 'c.yaml').write_text(json.dumps(TINY))
    model = tmp_path / 'm.safetensors'
    assert main(['train', '--config', str(tmp_path / 'c.yaml'), '--out', str(tmp_path / 'run'),
                 '--model', str(model), '--seed', '5']) == 0
    assert 'random_moves' in capsys.readouterr().out
    assert read_config(tmp_path / 'run' / 'config.yaml').seed == 5
    assert Checkpoint.load(model).provenance['command'].endswith('c.yaml --seed 5')
    moves = Policy(Checkpoint.load(model)).act(room.points, room.bounds.mean(0)[None])
    assert np.isfinite(moves).all()
