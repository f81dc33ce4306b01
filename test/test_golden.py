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
What the engine and plain searches answer is what they answered before.

``tools/golden`` compares all answers bit for bit, on the machine that stored them. Elsewhere the
last bits differ: kernels are compiled with fused operations and reordered sums for the processor
at hand, and libraries choose their own. So floats are compared to a millionth here, and hashes,
which tell the last bit, not at all.
"""

from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
import json

from conftest import ROOT
import pytest

TOLERANCE = 1e-6
#: Searches that choose among scores far apart: rounding does not lead them elsewhere, as it may
#: lead those that accept by chance.
STEADY = ('random', 'regular_grid', 'greedy_coverage', 'greedy_error')


@pytest.fixture(scope='module')
def golden():
    """Return tools/golden as a module."""
    loader = SourceFileLoader('golden', str(ROOT / 'tools' / 'golden'))
    module = module_from_spec(spec_from_loader('golden', loader))
    loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def stored(golden):
    """Return the stored answers."""
    return json.loads(golden.STORED.read_text())


def test_the_engine_answers_as_it_did(golden, stored, tmp_path):
    found = dict(golden.engine_answers(tmp_path))
    assert list(golden.differences(stored['engine'], found, TOLERANCE)) == []


def test_plain_searches_find_what_they_found(golden, stored, tmp_path):
    found = dict(golden.benchmark(tmp_path, STEADY, golden.ROOMS[:1]))
    expected = {key: stored['offline'][key] for key in found}
    assert list(golden.differences(expected, found, TOLERANCE)) == []


def test_every_planner_is_stored(golden, stored):
    from ocp_ros.search.registry import OBSERVED, planner_names, SCORES
    for section, knows in (('offline', SCORES), ('online', OBSERVED)):
        kept = {key.partition(',')[0] for key in stored[section]}
        assert kept - {'environment'} == set(planner_names(knows))
    assert {f'ceiling by {name}' for name in planner_names()} <= stored['rigs'].keys()


def test_each_difference_is_a_line(golden):
    before = {'a': {'error': 1.0, 'sha256': 'x', 'at': [0.0, 2]}, 'gone': {'error': 1.0}}
    now = {'a': {'error': 1.0 + 1e-15, 'sha256': 'y', 'at': [-0.0, 3]}, 'new': {'error': 1.0}}

    def places(*tolerance):
        return [': '.join(line.split(': ')[:2]).partition(': found')[0]
                for line in golden.differences(before, now, *tolerance)]

    assert list(golden.differences(before, before)) == []
    assert places() == ['a: error', 'a: sha256', 'a: at.0', 'a: at.1', 'gone', 'new']
    # Whole numbers and texts are never near.
    assert places(1e-9) == ['a: at.1', 'gone', 'new']
