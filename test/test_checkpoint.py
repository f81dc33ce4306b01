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

"""Weights in files and messages: whole, or refused."""

import json

from conftest import random_checkpoint
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.checkpoint import Checkpoint, CheckpointError, KEY, write_atomically
from ocp_ros.util.resources import find_model
import pytest
import torch


def test_a_checkpoint_comes_back_as_it_went(small_agent, tmp_path):
    before = random_checkpoint(small_agent, updates=7, run='r', provenance={'seed': 3})
    before.save(tmp_path / 'm.safetensors')
    after = Checkpoint.load(tmp_path / 'm.safetensors')
    assert (after.config, after.updates, after.run, after.provenance) == (
        small_agent, 7, 'r', {'seed': 3})
    assert all(torch.equal(after.weights[name], value) for name, value in before.weights.items())
    assert '"updates": 7' in (tmp_path / 'm.json').read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ['m.json', 'm.safetensors']


@given(data=st.data())
@budget(max_examples=60, deadline=None)
def test_a_damaged_blob_is_refused_and_nothing_else_happens(small_agent, data):
    blob = bytearray(random_checkpoint(small_agent, updates=1).to_bytes())
    if data.draw(st.booleans()):
        blob = blob[:data.draw(st.integers(0, len(blob) - 1))]
    else:
        header = int.from_bytes(blob[:8], 'little') + 8
        blob[data.draw(st.integers(0, header - 1))] ^= data.draw(st.integers(1, 255))
    try:
        found = Checkpoint.from_bytes(bytes(blob))
    except CheckpointError as error:
        assert 'found' in str(error) and 'expected' in str(error)
    else:
        # A digit of the provenance, of the count or of a radius may have changed unnoticed.
        assert all(torch.isfinite(value).all() for value in found.weights.values())


@pytest.mark.parametrize(('name', 'value'), [
    ('updates', 'Infinity'), ('updates', 'NaN'), ('updates', '"many"'), ('updates', '[1]'),
    ('updates', '-1'), ('updates', '1' + 300 * '0'), ('run', f'"{"x" * 101}"'),
    ('run', 'null'), ('provenance', '7'), ('config', '[]'), ('format', 'null'),
    ('config', '{"points": 1e999}'), ('config', '{"hidden": 4096}'),
    ('provenance', '[' * 5000 + ']' * 5000)])
def test_a_card_with_odd_values_is_refused_and_nothing_else_happens(small_agent, name, value):
    blob = random_checkpoint(small_agent).to_bytes()
    body = 8 + int.from_bytes(blob[:8], 'little')
    header = json.loads(blob[8:body])
    card = json.loads(header['__metadata__'][KEY])
    parts = [f'"{key}": {value if key == name else json.dumps(item)}'
             for key, item in card.items()]
    header['__metadata__'][KEY] = '{' + ', '.join(parts) + '}'
    text = json.dumps(header).encode()
    try:
        found = Checkpoint.from_bytes(len(text).to_bytes(8, 'little') + text + blob[body:])
    except CheckpointError as error:
        assert 'found' in str(error) and 'expected' in str(error)
    else:
        assert (name, found.run) == ('run', 'None')


@pytest.mark.parametrize(('bias', 'words'), [
    (None, 'missing .*mu.bias'), (torch.zeros(5), 'mu.bias .*float32'),
    *((torch.full((2,), wrong), 'mu.bias') for wrong in (torch.nan, -torch.inf, 3e38, -1e5))])
def test_weights_of_another_network_are_refused(small_agent, bias, words):
    weights = {**random_checkpoint(small_agent).weights, 'mu.bias': bias}
    if bias is None:
        del weights['mu.bias']
    with pytest.raises(CheckpointError, match=words):
        Checkpoint(small_agent, weights)


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    write_atomically(tmp_path / 'f', b'old')

    def fail(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr('os.replace', fail)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / 'f', b'new')
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [('f', b'old')]


def test_the_shipped_model_has_its_card_and_a_missing_one_is_named():
    checkpoint = Checkpoint.load(find_model('map'))
    test = checkpoint.provenance['test']
    assert checkpoint.config == AgentConfig(headings=8)
    assert test['policy']['depth_error_end'] < test['random_moves']['depth_error_end']
    assert {'seed', 'date', 'interactions', 'training', 'seconds', 'curve'} <= (
        checkpoint.provenance.keys())
    with pytest.raises(CheckpointError, match='none.safetensors'):
        Checkpoint.load('none.safetensors')
    with pytest.raises(FileNotFoundError, match="'none'.*'map'"):
        find_model('none')
