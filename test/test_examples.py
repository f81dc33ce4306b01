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

"""Each program of ``examples/`` is short, runs, and prints what its page says."""

import runpy
import subprocess
import sys

from conftest import HUNG, ROOT
from ocp_ros.search.registry import PLANNERS
import pytest

EXAMPLES = {path.stem: path for path in sorted((ROOT / 'examples').glob('*.py'))}
#: What the last lines of an example contain.
PRINTED = {
    '01_plan': 'optimality gap', '02_score': 'found an array of shape (3,)',
    '03_own_rig': 'target reached: True', '04_own_planner': 'random_moves: objective value',
    '05_own_room': 'points, [6.  4.5 2.7] m', '06_environment': 'end: depth error',
    '07_live_from_bag': '/cam1/points: 8 messages', '08_calibrate': 'mm from its true position'}
#: Examples that take longer, because they start programs.
SLOW = {'07_live_from_bag', '08_calibrate'}


def test_examples_are_short_and_all_are_tested():
    assert EXAMPLES.keys() == PRINTED.keys()
    for path in EXAMPLES.values():
        code = [line for line in path.read_text().splitlines() if not line.startswith('#')]
        assert len(code) <= 41, path  # 40, and the empty line below the licence


@pytest.mark.parametrize('name', sorted(PRINTED.keys() - SLOW))
def test_an_example_runs(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # The planner that an example registers is unregistered at the end.
    monkeypatch.setitem(PLANNERS, 'random_moves', None)
    del PLANNERS['random_moves']
    runpy.run_path(str(EXAMPLES[name]), run_name='__main__')
    assert PRINTED[name] in capsys.readouterr().out


@pytest.mark.system
@pytest.mark.parametrize('name', sorted(SLOW))
def test_an_example_that_starts_programs_runs(name, tmp_path, monkeypatch, request):
    if 'bag' in name:
        pytest.importorskip('rosbags', reason='the example needs rosbags')
        monkeypatch.setenv('ROS_DOMAIN_ID', str(request.getfixturevalue('domain')))
    done = subprocess.run([sys.executable, EXAMPLES[name]], cwd=tmp_path, capture_output=True,
                          text=True, timeout=HUNG)
    assert done.returncode == 0, done.stderr
    assert PRINTED[name] in done.stdout
