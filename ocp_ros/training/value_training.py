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
Train the map actor on dense values: this module is the whole run, from top to bottom.

First the network learns dense values in rooms in which a rig moves to random poses, then also in
rooms in which the network itself has moved the cameras. If the settings have headings, the network
learns cameras with a limited field of view in the same way; their value map starts from that of
the first weights. The folder has the files of :mod:`ocp_ros.training.train`, and ``states/`` with
the states of each room.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from datetime import date
from functools import cached_property
import io
from pathlib import Path
import time
from typing import Any

import numpy as np
from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.policy.shipped_models import find_model
from ocp_ros.policy.value_network import ValueMapNetwork
from ocp_ros.training.run_folder import add_record, BEST, records, VALUES_PHASE, VALUES_STATE
from ocp_ros.training.sac_state import new_run
from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.training.training_rooms import room_names
from ocp_ros.training.validation import evaluate, trials_of, ValidationTrial
from ocp_ros.training.value_fit import regret_of, ValueFit, ValueSet
from ocp_ros.training.value_states import play_states, shapes_of, StateTask
from ocp_ros.util.files import write_atomically
from ocp_ros.util.settings import to_nested, UserError
from ocp_ros.util.worker_pool import WorkerPool
from rich.progress import Progress
import torch


class TrainingRun(ABC):
    """
    A training run: its folder, clock, progress and validation. Subclasses train.

    :param config: settings of the run.
    :param folder: folder of the run.
    :param pool: worker pool that plays episodes.
    :param progress: shows the progress bars.
    :ivar name: name of the run, 12 random hexadecimal digits.
    :ivar past: the lines of progress that earlier processes of the run have written.
    """

    #: Number of interactions of soft actor-critic so far.
    interactions = 0
    #: Device of the networks.
    device = torch.device('cpu')

    def __init__(self, config: TrainingConfig, folder: Path, pool: WorkerPool,
                 progress: Progress) -> None:
        self.config = config
        self.folder = folder
        self.pool = pool
        self.progress = progress
        # The name of a new run; a run that resumes gets its name from its saved state.
        self.name = new_run()
        self.past = records(folder)
        #: The clock goes on from the last line of progress.
        self._start_time = time.monotonic() - (self.past[-1]['seconds'] if self.past else 0.0)

    @property
    @abstractmethod
    def updates(self) -> int:
        """Return the number of gradient steps so far."""

    @property
    def seconds(self) -> float:
        """Return the duration of the run so far, in all its processes, seconds."""
        return round(time.monotonic() - self._start_time, 1)

    @property
    def provenance(self) -> dict[str, Any]:
        """Return how the present weights were made: interactions, seed, date and settings."""
        return {'interactions': self.interactions, 'seed': self.config.seed,
                'date': date.today().isoformat(), 'training': to_nested(self.config)}

    def note(self, phase: str, **figures: float) -> None:
        """Append a line with some figures to the progress of the run."""
        add_record(self.folder, {
            'phase': phase, 'interactions': self.interactions, 'updates': self.updates,
            'seconds': self.seconds, **figures})

    def judge(self, checkpoint: Checkpoint) -> dict[str, float]:
        """Return the results of weights in the validation rooms; see :func:`evaluate`."""
        return evaluate(self.pool, self._validation_trials, checkpoint.to_bytes())

    @cached_property
    def _validation_trials(self) -> list[ValidationTrial]:
        """Return the trials in the validation rooms."""
        return trials_of(self.config, 'validation')


class ValueRun(TrainingRun):
    """A run in which the map actor learns dense values; see :class:`TrainingRun`."""

    def __init__(self, *settings) -> None:
        super().__init__(*settings)
        config = self.config
        torch.manual_seed(config.seed)
        #: The network. If it has a part ``aimed``, for cameras with headings, only this part
        #: learns.
        self._network = ValueMapNetwork(config.agent)
        #: Provenance of the first weights, if there are any.
        self._first_provenance: dict[str, Any] = {}
        if config.model:
            start = _load_first_weights(self._network, config)
            self._first_provenance = {'began_with': {
                'run': start.run, 'updates': start.updates, **start.provenance}}
        self.fit = ValueFit(self._network.aimed or self._network, config.values, config.seed)

    def checkpoint(self) -> Checkpoint:
        """Return a checkpoint of the present network."""
        # The averaged weights replace those of the part that learns.
        trained = self.fit.average.state_dict(prefix='aimed.' if self._network.aimed else '')
        weights = {name: value.clone()
                   for name, value in (self._network.state_dict() | trained).items()}
        return Checkpoint(self.config.agent, weights, self.updates, self.name,
                          {**self.provenance, **self._first_provenance})

    @property
    def updates(self) -> int:
        """Return the number of gradient steps so far."""
        return self.fit.step

    def save(self) -> None:
        """Write the state to resume from, and the weights so far."""
        write_atomically(self.folder / VALUES_STATE, self.fit.to_bytes(self.name))
        self.checkpoint().save(self.folder / BEST)

    def resume(self) -> None:
        """
        Resume from the state that was saved last; without one, the run begins.

        :raises CheckpointError: if the state cannot be used.
        """
        path = self.folder / VALUES_STATE
        if path.exists():
            self.name = self.fit.load(path)

    def states(self, kind: str, rooms: list[str], weights: bytes = b'') -> ValueSet:
        """
        Return the states of some rooms: read the saved ones, play and save the missing ones.

        :param kind: ``walked``: the cameras move to random poses; ``own``: the network itself
            moves them; ``validation``: validation rooms, with random poses.
        :param rooms: names of the rooms.
        :param weights: see :class:`~ocp_ros.training.value_states.StateTask`.
        """
        paths = [self.folder / 'states' / f'{kind}_{index:05}.npz' for index in range(len(rooms))]
        missing = [number for number, path in enumerate(paths) if not path.exists()]
        headings = self.config.agent.headings
        # The index of the kind and the number of the room make the seed of a room unique.
        seed = self.config.seed, ('walked', 'own', 'validation').index(kind)
        tasks = [StateTask(self.config.rooms, rooms[number], (*seed, number), weights, headings)
                 for number in missing]
        bar = self.progress.add_task(f'states, {kind}', total=len(rooms),
                                     completed=len(rooms) - len(missing), error='')
        for task_number, arrays in self.pool.unordered(play_states, tasks):
            buffer = io.BytesIO()
            np.savez_compressed(buffer, **arrays)
            write_atomically(paths[missing[task_number]], buffer.getvalue())
            self.progress.advance(bar)
        return ValueSet([_read_states(path, shapes_of(headings)) for path in paths])


def _load_first_weights(network: ValueMapNetwork, config: TrainingConfig) -> Checkpoint:
    """
    Load the weights that the settings name into a network, and return their checkpoint.

    :raises CheckpointError: if the weights have other agent settings, except for ``headings``.
    """
    checkpoint = Checkpoint.load(find_model(config.model))
    if config.agent not in (checkpoint.config,
                            replace(checkpoint.config, headings=config.agent.headings)):
        raise CheckpointError(f'{config.model}: found {checkpoint.config}; expected weights of '
                              f"the run's own agent settings, {config.agent}")
    # A part ``aimed`` for another number of headings does not fit. The new part then starts from
    # the weights for omnidirectional cameras.
    same_headings = checkpoint.config.headings == config.agent.headings
    network.load_state_dict(network.state_dict() | {
        name: value for name, value in checkpoint.weights.items()
        if same_headings or not name.startswith('aimed.')})
    if network.aimed is not None and not same_headings:
        network.begin_aimed()
    return checkpoint


def _read_states(path: Path, shapes: dict[str, tuple[type, tuple]]) -> dict[str, np.ndarray]:
    """
    Read the states of a room from a file, and check them.

    :param shapes: expected types and shapes; see :func:`~ocp_ros.training.value_states.shapes_of`.
    :raises UserError: if the states are damaged or of another kind of map.
    """
    try:
        with path.open('rb') as stream, np.load(stream, allow_pickle=False) as file:
            states = {name: file[name] for name in shapes}
        for name, (kind, shape) in shapes.items():
            if states[name].dtype != kind or states[name].shape[1:] != shape:
                raise ValueError(f'{name} is {states[name].dtype} {states[name].shape}')
        # All arrays of choices have one length, and the map of each choice exists.
        counts = {len(states[name]) for name in ('of', 'others', 'numbers', 'lens', 'values')}
        if len(counts) != 1 or not (
                (states['of'] >= 0) & (states['of'] < len(states['room']))).all():
            raise ValueError('its choices are of other maps')
    except Exception as error:  # A broken file makes the libraries raise almost anything.
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise UserError(
            f'{path}: found no whole states of a room ({reason}); expected what was played for '
            'this network; remove the file, and the room is played again: nothing else is lost'
        ) from error
    return states


def learn_values(run: ValueRun) -> Checkpoint:
    """
    Learn dense values: first from moves to random poses, then also from the network's own moves.

    :returns: the checkpoint of the trained network.
    """
    values = run.config.values
    rooms = room_names(run.config.rooms, 'training')
    total = values.steps + values.own_steps
    if run.fit.step >= total:
        return run.checkpoint()
    # Every third validation room is used to measure the regret.
    validation_set = run.states('validation', room_names(run.config.rooms, 'validation')[::3])
    walked_set = run.states('walked', rooms[:values.rooms])
    bar = run.progress.add_task('dense values', total=total, error='')

    def report_step(step: int, loss: float) -> None:
        run.progress.update(bar, completed=step)
        if step % values.evaluate_every == 0 or step == total:
            regret = regret_of(run.fit.average, validation_set)
            run.progress.update(bar, error=f'regret {regret:.3f}, loss {loss:.3f}')
            run.note(VALUES_PHASE, loss=loss, regret=regret)
            run.save()

    run.fit.run(walked_set, values.steps, total, report_step)
    if values.own_steps:
        weights = run.checkpoint().to_bytes()
        # The last training rooms; if there are few rooms, some have walked states as well.
        own_set = run.states('own', rooms[-values.own_rooms:], weights)
        run.fit.run(ValueSet.joined([walked_set, own_set]), total, total, report_step)
    return run.checkpoint()
