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

"""Messages that lie, sent to nodes on real DDS; ``make fuzz`` sends many more."""

from functools import partial

from benchmarks.drills.fuzz_targets import (
    BATCH,
    Fuzzer,
    FuzzError,
    LiveTarget,
    PolicyTarget,
    SimTarget,
)
from benchmarks.drills.fuzz_trainer import TrainerTarget
from benchmarks.drills.malformed import spoilt_weights
from conftest import counted, random_checkpoint
import numpy as np
from ocp_ros.policy.checkpoint import Checkpoint, CheckpointError
from ocp_ros.ros.interface import topics
from ocp_ros.ros.policy_node import PolicyNode
from ocp_ros.ros.sim_node import SimNode
from ocp_ros.ros.trainer_node import TrainerNode
import pytest
from std_msgs.msg import UInt8MultiArray

SIM = {'scene__points': 2000, 'engine__preset': 'fast', 'engine__error_rows': 32,
       'engine__coverage_cell': 0.5, 'rig__cameras': 3, 'auto_reset': True}


@pytest.fixture
def fuzzer(graph, probe, tmp_path, small_agent):
    """Return what sends lies; the weights are random."""
    made = random_checkpoint(small_agent, updates=5, run='a')
    made.save(tmp_path / 'm.safetensors')
    fuzzer = Fuzzer(probe.node, lambda predicate, what: graph.until(predicate), 0, made)
    fuzzer.model = str(tmp_path / 'm.safetensors')
    return fuzzer


def test_a_policy_and_its_trainer_outlive_lies(graph, fuzzer, tmp_path):
    policy = graph.add(partial(PolicyNode, namespace='turns'), planner='learned', turns=100000,
                       model=fuzzer.model, convergence_distance=0.0)
    trainer = graph.add(partial(TrainerNode, namespace='turns'), folder=str(tmp_path / 'run'))
    target = PolicyTarget(fuzzer, '/turns')
    for number in range(12):
        target.batch(again=number % 3 > 0)
    assert fuzzer.sent == 12 * (3 * BATCH + 1) and fuzzer.answered == 12
    assert counted(policy, 'refused_messages') > 12 * BATCH / 2
    assert counted(policy, 'weights_refused') > 6
    assert trainer.sources['/turns'].counts['refused'] > 12 * BATCH / 2
    assert trainer.sources['/turns'].counts['transitions'] == 0


def test_a_trainer_goes_on_learning_whatever_it_is_told(graph, fuzzer, tmp_path, small_agent):
    agent = {f'agent__{name}': value for name, value in vars(small_agent).items()}
    trainer = graph.add(partial(TrainerNode, namespace='learn'), folder=str(tmp_path / 'run'),
                        sac__learning_starts=4, sac__batch_size=8, sac__buffer_size=100,
                        sac__device='cpu', **agent)
    target = TrainerTarget(fuzzer, '/learn')
    for _ in range(4):
        target.batch()
    assert trainer.sources['/learn'].counts['refused'] > 10
    graph.until(lambda: trainer.learner.updates >= 4)
    assert trainer.learner.failure is None


def test_live_cameras_outlive_lies(graph, fuzzer):
    policy = graph.add(partial(PolicyNode, namespace='live'), cloud_topics='a,b', turns=100000,
                       cloud_timeout=0.3, arrival_timeout=0.5)
    target = LiveTarget(fuzzer, '/live', ['a', 'b'])
    for _ in range(4):
        target.batch()
    assert fuzzer.answered == 4 and counted(policy, 'turns_answered') >= 4


def test_a_simulation_outlives_lies(graph, fuzzer):
    sim = graph.add(partial(SimNode, namespace='sim'), **SIM)
    target = SimTarget(fuzzer, '/sim')
    for _ in range(12):
        target.batch()
    assert fuzzer.answered == 12 and counted(sim, 'refused_commands') > 4


def test_a_cloud_of_millions_of_points_is_answered(graph, fuzzer, probe):
    graph.add(partial(PolicyNode, namespace='turns'), planner='learned', model=fuzzer.model)
    # Somebody hears experiences, without a trainer.
    probe.listen(UInt8MultiArray, f'/turns/{topics.EXPERIENCE}', 10)
    target = PolicyTarget(fuzzer, '/turns')
    assert target.ping(np.tile(fuzzer._cloud, (3400, 1))) > 0.0


def test_a_command_out_of_bounds_is_noticed(fuzzer):
    box = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    fuzzer.check(np.array([[0.5, 1.0, 9.0]]), box, 'command')
    for wrong in ([0.5, 1.1, 0.5], [np.nan, 0.5, 0.5], [-0.1, 0.5, 0.5]):
        with pytest.raises(FuzzError, match='command: found'):
            fuzzer.check(np.array([wrong]), box, 'command')
    # Who was outside may be so still, but no farther.
    before = np.array([[2.0, 0.5, 0.5]])
    fuzzer.check(np.array([[1.5, 0.5, 0.5]]), box, 'command', before)
    with pytest.raises(FuzzError):
        fuzzer.check(np.array([[2.1, 0.5, 0.5]]), box, 'command', before)


def test_spoilt_weights_are_refused_but_for_changes_that_do_not_matter(checkpoint):
    rng, taken = np.random.default_rng(1), 0
    for _ in range(200):
        try:
            found = Checkpoint.from_bytes(spoilt_weights(rng, checkpoint))
            found.check_replaces(checkpoint)
        except CheckpointError:
            continue
        # A letter of the name of the run, or a digit of the updates.
        taken += 1
        assert (found.run, found.updates) != (checkpoint.run, checkpoint.updates)
    assert taken < 20
