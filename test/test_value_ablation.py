# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a choice owes to what is read: channels that are left out, and who has no network."""

import json

from conftest import Here
import numpy as np
import pytest
import torch

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.errors import CheckpointError
from ocp_ros.agent.observation_map import NUMBERS, OF_OTHERS, OF_ROOM
from ocp_ros.agent.value_network import ValueMapNetwork
from ocp_ros.training import value_ablation
from ocp_ros.training.training_config import RoomsConfig
from ocp_ros.training.value_ablation import (
    GROUPS,
    LABELS,
    learned,
    main,
    means_of,
    regrets,
    Without,
)
from ocp_ros.training.value_fit import regret_of, ValueSet
from ocp_ros.training.value_states import play_states, StateTask

AGENT = AgentConfig(inputs='map')


@pytest.fixture(scope='module')
def states(small):
    """Return the states of a room, places also valued on what was seen."""
    return play_states(StateTask(RoomsConfig(), '1000', (0, 0, 0), observed=True))


def test_each_channel_belongs_to_one_group():
    counts = {'room': np.zeros(OF_ROOM), 'others': np.zeros(OF_OTHERS),
              'numbers': np.zeros(NUMBERS)}
    for part, channels in GROUPS.values():
        counts[part][channels] += 1
    assert all((count == 1).all() for count in counts.values())


def test_what_is_left_out_makes_no_difference(states):
    class Sum(torch.nn.Module):
        def forward(self, observation):
            return (observation['room'].double().sum(dim=1, keepdim=True)
                    + observation['numbers'].sum(dim=1)[:, None, None, None])

    means = means_of([states])
    seen = {name: torch.from_numpy(states[name][:2]) for name in ('others', 'numbers')}
    seen['room'] = torch.from_numpy(states['room'][:1]).expand(2, -1, -1, -1)
    points = GROUPS['points'][1]
    without = Without(Sum(), 'room', points, means['room'])
    first = without(seen)
    changed = seen | {'room': seen['room'].clone()}
    changed['room'][:, points] = 7
    torch.testing.assert_close(without(changed), first)
    changed['room'][:, points.stop] += 1
    assert not torch.equal(without(changed), first)
    without = Without(Sum(), 'numbers', slice(None), means['numbers'])
    torch.testing.assert_close(without(seen | {'numbers': seen['numbers'] + 1.0}), without(seen))


def test_who_knows_the_labels_regrets_nothing_and_chance_regrets_most(states):
    torch.manual_seed(0)
    network = ValueMapNetwork(AGENT)
    found = regrets(network, [states])
    assert set(found) == {'all', 'observed_points', 'random',
                          *(f'without_{name}' for name in GROUPS)}
    # The last layer of a new network says the same of all that it reads.
    assert all(regret >= 0.0 for regret in found.values())
    knowing = regrets(network, [states | {'observed': states['values']}])
    assert knowing['observed_points'] == 0.0 < knowing['random']
    assert found['observed_points'] < found['random']


def test_what_is_learned_is_the_labels_that_are_named(states):
    # Labels that praise the worst places: who has learned them loses most.
    wrong = [states | {'observed': -states['values']}]
    by_true, by_wrong = (regret_of(learned(AGENT, wrong, labels, 60, 0), ValueSet([states]))
                         for labels in LABELS)
    assert by_true < by_wrong, (by_true, by_wrong)


def test_the_command_writes_what_it_measured(small, monkeypatch, tmp_path):
    monkeypatch.setattr(value_ablation, 'WorkerPool', Here)
    main(['--rooms', '1', '--out', str(tmp_path / 'found.json')])
    found = json.loads((tmp_path / 'found.json').read_bytes())
    assert found['rooms'] == 1 and found['choices'] > 0 and found['model'] == 'map'
    assert 0.0 <= found['regret']['all'] <= found['regret']['random']
    assert 'labels_values' not in found['regret']
    main(['--rooms', '1', '--learn', '1', '--steps', '2', '--out', str(tmp_path / 'learned.json')])
    again = json.loads((tmp_path / 'learned.json').read_bytes())
    assert again['learned_from'] == 1 and again['steps'] == 2
    assert set(again['regret']) - set(found['regret']) == {'labels_values', 'labels_observed'}
    assert again['regret']['all'] == found['regret']['all']
    wrong = tmp_path / 'wrong.safetensors'
    Checkpoint.load(value_ablation.find_model('moves')).save(wrong)
    with pytest.raises(CheckpointError, match='expected those of the map actor'):
        main(['--model', str(wrong), '--out', str(tmp_path / 'none.json')])
