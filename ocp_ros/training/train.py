# SPDX-License-Identifier: Apache-2.0
"""
Train a policy in generated rooms: read from top to bottom, this is the whole run.

A run's folder holds ``config.yaml`` (the effective settings), ``progress.jsonl`` (one line per
evaluation), ``best.safetensors`` with its card, ``state.safetensors`` to resume from, and
TensorBoard's files.
"""

from dataclasses import replace
from datetime import date
import json
from pathlib import Path
import time
from typing import Any

import numpy as np
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
import torch
import yaml

from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.agent.policy import Policy
from ocp_ros.configuration import ConfigurationError, from_nested, to_nested
from ocp_ros.scenes.rooms import generate_room
from ocp_ros.simulation.env import CameraPlacementEnv
from ocp_ros.training.config import TrainingConfig
from ocp_ros.training.evaluation import evaluate, random_moves, simulators
from ocp_ros.training.sac import actor_checkpoint, EncodedObservation, make_sac
from ocp_ros.training.state import load_state, new_run, save_state


def read_config(path: Path) -> TrainingConfig:
    """
    Read a YAML file of training settings; what it leaves out keeps its default.

    :raises ConfigurationError: for an unknown name or a bad value.
    """
    try:
        content = yaml.safe_load(Path(path).read_text())
    except OSError as error:
        raise ConfigurationError(f'{path}: found no file that can be read ({error.strerror}); '
                                 'expected YAML such as config/train/default.yaml') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = ' '.join(str(error).split())
        raise ConfigurationError(f'{path}: found no valid YAML ({reason}); expected settings, '
                                 'one "name: value" per line') from error
    return from_nested(TrainingConfig, content or {}, str(path))


def make_rooms(config: TrainingConfig, part: str) -> list:
    """Generate the rooms of ``training``, ``validation`` or ``test``."""
    return [generate_room(seed, config.rooms.points) for seed in config.rooms.seeds(part)]


class Watch(BaseCallback):
    """Evaluate as it learns, keep the best weights and enough state to resume."""

    def __init__(self, config: TrainingConfig, folder: Path, run: str, progress: Progress
                 ) -> None:
        super().__init__()
        self.config, self.folder, self.run, self.progress = config, folder, run, progress
        self.engines = simulators(make_rooms(config, 'validation'), config.simulation)
        self.began, self.best = time.monotonic(), np.inf
        self.due = self.evaluated = 0

    def _on_training_start(self) -> None:
        """Show the bar; when resuming, the best so far stays the best."""
        for record in _records(self.folder):
            self.best = min(self.best, record['ratio'])
            self.began = time.monotonic() - record['seconds']
        self.evaluated = self.num_timesteps
        self.due = self.num_timesteps + self.config.evaluate_every
        self.task = self.progress.add_task(
            'training', total=self.config.interactions, completed=self.num_timesteps, error='')

    def _on_step(self) -> bool:
        """Move the bar, and evaluate when it is time."""
        self.progress.update(self.task, completed=self.num_timesteps)
        if self.num_timesteps >= self.due:
            self.due += self.config.evaluate_every
            self._evaluate()
        return True

    def _on_training_end(self) -> None:
        """Keep what was learned since the last evaluation."""
        if self.num_timesteps > self.evaluated:
            self._evaluate()

    def _evaluate(self) -> None:
        """Play the validation rooms; write the line, the state and, if best, the weights."""
        provenance = {'interactions': self.num_timesteps, 'seed': self.config.seed,
                      'date': date.today().isoformat(), 'training': to_nested(self.config)}
        checkpoint = actor_checkpoint(self.model, self.config.agent, self.run, provenance)
        result = evaluate(act_of(Policy(checkpoint)), self.engines)
        for name, value in result.items():
            self.logger.record(f'validation/{name}', value)
        record = {'interactions': self.num_timesteps, 'updates': checkpoint.updates,
                  'seconds': round(time.monotonic() - self.began, 1), **result}
        with open(self.folder / 'progress.jsonl', 'a', encoding='utf-8') as file:
            file.write(json.dumps(record) + '\n')
        if result['ratio'] < self.best:
            self.best = result['ratio']
            checkpoint.save(self.folder / 'best.safetensors')
        save_state(self.model, self.folder / 'state.safetensors', self.run)
        self.evaluated = self.num_timesteps
        self.progress.update(self.task, error=f'validation {result["ratio"]:.3f}')


def _records(folder: Path) -> list[dict[str, Any]]:
    """Read the evaluations of a run so far."""
    path = folder / 'progress.jsonl'
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def act_of(policy: Policy):
    """Let the evaluation call a policy: its most likely moves."""
    return lambda cloud, positions, rng: policy.act(cloud, positions)


def train(config: TrainingConfig, folder: Path, command: str = '') -> Checkpoint:
    """
    Train, or go on with what the folder holds, and report on the test rooms.

    :param config: the run's settings.
    :param folder: where the run lives.
    :param command: what started it, for the card.
    :returns: the best checkpoint; its provenance has the curve and the test's figures, those of
        random moves beside them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / 'config.yaml').write_text(yaml.safe_dump(to_nested(config), sort_keys=False))
    rooms = make_rooms(config, 'training')
    env = DummyVecEnv([
        lambda: EncodedObservation(CameraPlacementEnv(rooms, config.simulation), config.agent)
        for _ in range(config.environments)])
    cameras = config.simulation.rig.cameras
    steps = max(round(config.updates_per_turn * config.environments), 1)
    model = make_sac(config.sac, config.agent, cameras, env, config.seed,
                     str(folder / 'tensorboard'), train_freq=1, gradient_steps=steps)
    state = folder / 'state.safetensors'
    run = load_state(model, state) if state.exists() else new_run()
    # The replay buffer starts empty, also when the run goes on: fill it before learning from it.
    model.learning_starts += model.num_timesteps
    columns = (TextColumn('{task.description}'), MofNCompleteColumn(), TimeRemainingColumn(),
               TextColumn('{task.fields[error]}'))
    with Progress(*columns) as progress:
        left = config.interactions - model.num_timesteps
        model.learn(max(left, 0), callback=Watch(config, folder, run, progress),
                    reset_num_timesteps=False, tb_log_name='sac')
    return report(config, folder, command)


def report(config: TrainingConfig, folder: Path, command: str) -> Checkpoint:
    """Play the test rooms with the best weights and at random; write the figures into the card."""
    best = Checkpoint.load(folder / 'best.safetensors')
    # Whatever it learned on, the figures are those of the engine at its best.
    fine = replace(config.simulation, engine=replace(config.simulation.engine, preset='fine'))
    engines = simulators(make_rooms(config, 'test'), fine)
    records = _records(folder)
    on_gpu = config.sac.device != 'cpu' and torch.cuda.is_available()
    threads = f'CPU, {torch.get_num_threads()} threads'
    hardware = torch.cuda.get_device_name() if on_gpu else threads
    provenance = {
        **best.provenance, 'command': command, 'hardware': hardware,
        'seconds': records[-1]['seconds'], 'curve': records,
        'test': {'rooms': len(engines), 'policy': evaluate(act_of(Policy(best)), engines),
                 'random_moves': evaluate(random_moves, engines)}}
    final = replace(best, provenance=provenance)
    final.save(folder / 'best.safetensors')
    return final
