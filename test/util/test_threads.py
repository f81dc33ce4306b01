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

"""Threads change how long answers take and nothing else."""

from pathlib import Path
import subprocess
import sys
import threading

from conftest import HUNG
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.search.registry import PLANNERS
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.util.threads import mapped, set_threads
import pytest


@pytest.fixture
def threads():
    """Return what sets the number of threads; it is one again afterwards."""
    yield set_threads
    set_threads(1)


@pytest.mark.parametrize('count', [1, 2, 8])
@pytest.mark.parametrize('items', [0, 1, 7, 40])
def test_what_is_mapped_keeps_its_order(threads, count, items):
    threads(count)
    assert mapped(lambda item: item * item, range(items)) == [item ** 2 for item in range(items)]


def test_as_many_work_at_once_as_were_asked_for(threads):
    threads(3)
    together = threading.Barrier(3, timeout=HUNG)
    assert sorted(mapped(lambda _: together.wait(), range(3))) == [0, 1, 2]


@pytest.mark.parametrize('wrong', range(4))
def test_what_fails_in_a_thread_fails(threads, wrong):
    threads(2)
    with pytest.raises(ZeroDivisionError):
        mapped(lambda item: 1 // (item - wrong), range(4))


@pytest.mark.parametrize('name', ['learned', 'lookahead'])
def test_planners_answer_alike_with_any_number_of_threads(threads, room, name):
    config = SimulationConfig(rig=RigConfig(cameras=2), engine=EngineConfig(preset='fast'))
    positions = room.bounds.mean(axis=0)[None] + [[0.4, 0.3, 0.3], [-0.5, 0.2, 0.3]]
    answers = []
    for count in (1, 3):
        threads(count)
        online = PLANNERS[name].make(config.episode, config.placed_rig, np.random.default_rng(0))
        answers.append([online.move(room.points, positions, turn, 30) for turn in (0, 1, 25)])
    np.testing.assert_array_equal(*answers)


#: Prints by how many MB a process grew that freed 180 MB of arrays of 0.6 MB between smaller ones.
FREED = """
from pathlib import Path
import numpy as np
from ocp_ros.util.threads import return_freed_arrays
return_freed_arrays()
def resident_pages():
    return int(Path('/proc/self/statm').read_text().split()[1])
before, freed, kept = resident_pages(), [], []
for _ in range(300):
    freed.append(np.ones(75_000))
    kept.append(np.ones(3_000))
del freed
print((resident_pages() - before) * 4096 // 1_000_000)
"""


@pytest.mark.skipif(not Path('/proc/self/statm').exists(), reason='needs the memory of a process')
def test_arrays_of_half_a_megabyte_are_returned_when_they_are_freed():
    grown = subprocess.run([sys.executable, '-c', FREED], capture_output=True, text=True,
                           timeout=HUNG, check=True)
    assert int(grown.stdout) < 60
