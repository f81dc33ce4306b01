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
Train a policy: this module is the whole run, from top to bottom.

Soft actor-critic learns from its own episodes. The folder of a run has ``config.yaml`` (the
effective settings), ``rooms.json`` (the rooms of each set),
``progress.jsonl`` (one line per evaluation), ``best.safetensors`` with its card,
``state.safetensors`` and ``replay.safetensors`` to resume from, and TensorBoard's files.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import date
from functools import lru_cache, partial
import logging
from pathlib import Path
import time

import gymnasium as gym
import numpy as np
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.simulation.environment import CameraPlacementEnv, Rooms
from ocp_ros.simulation.viewpoints import VIEWPOINTS
from ocp_ros.training.encoded_environment import playable
from ocp_ros.training.run_folder import add_record, BEST, claim, is_count, records, REPLAY, STATE
from ocp_ros.training.sac import actor_checkpoint, AgentSac, load_actor, make_sac
from ocp_ros.training.sac_state import (
    load_replay,
    load_state,
    new_run,
    save_replay,
    save_state,
)
from ocp_ros.training.training_config import TrainingConfig
from ocp_ros.training.training_rooms import room_names
from ocp_ros.training.validation import evaluate, trials_of
from ocp_ros.util.files import printable, remove_unfinished
from ocp_ros.util.resources import find_model
from ocp_ros.util.settings import to_nested
from ocp_ros.util.threads import cores
from ocp_ros.util.worker_pool import WorkerPool
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
import torch

_log = logging.getLogger(__name__)
#: Largest number of pixels, over the depth maps of all engines that are kept in memory. A pixel
#: takes about 50 bytes; building an engine takes as long as a hundred turns with it.
MAX_DEPTH_PIXELS = 25_000_000
#: Number of problems of ``episodes.rig_file`` that are kept in memory.
RIG_PROBLEMS = 256


class Run:
    """
    A run in which soft actor-critic plays and learns: its folder, clock, progress and validation.

    :param model: SAC with the actor to train.
    :param config: settings of the run.
    :param folder: folder of the run.
    :param pool: worker pool that plays episodes.
    :param progress: shows the progress bar.
    :ivar name: name of the run, 12 random hexadecimal digits.
    :ivar past: the lines of progress that earlier processes of the run have written.
    :ivar best: least error ratio so far: depth error at the end of an episode / at its start.
    """

    def __init__(self, model: AgentSac, config: TrainingConfig, folder: Path, pool: WorkerPool,
                 progress: Progress) -> None:
        self.model = model
        self.config = config
        self.folder = folder
        self.pool = pool
        self.progress = progress
        # The name of a new run; a run that resumes gets its name from its saved state.
        self.name = new_run()
        self.past = records(folder)
        self.best = np.inf
        #: The clock goes on from the last line of progress.
        self._start_time = time.monotonic() - (self.past[-1]['seconds'] if self.past else 0.0)

    @property
    def interactions(self) -> int:
        """Return the number of interactions so far."""
        return self.model.num_timesteps

    @property
    def updates(self) -> int:
        """Return the number of gradient steps so far."""
        return int(self.model._n_updates)

    @property
    def seconds(self) -> float:
        """Return the duration of the run so far, in all its processes, seconds."""
        return round(time.monotonic() - self._start_time, 1)

    def checkpoint(self) -> Checkpoint:
        """Return a checkpoint of the present actor, with its settings as provenance."""
        return actor_checkpoint(self.model, self.name, {
            'interactions': self.interactions, 'seed': self.config.seed,
            'date': date.today().isoformat(), 'domain': self.config.domain,
            'training': to_nested(self.config)})

    def note(self, **figures: float) -> None:
        """Append a line with some figures, and the losses that were logged last."""
        losses = {name.rpartition('/')[2]: float(value) for name, value
                  in self.model.logger.name_to_value.items() if name.endswith('loss')}
        add_record(self.folder, {
            'interactions': self.interactions, 'updates': self.updates, 'seconds': self.seconds,
            **losses, **figures})

    def tested(self, checkpoint: Checkpoint) -> dict[str, float]:
        """Return the results of weights in the validation rooms; see :func:`evaluate`."""
        return evaluate(self.pool, trials_of(self.config, 'validation'), checkpoint.to_bytes())

    def evaluate(self) -> float:
        """
        Play the validation rooms; write the progress, the state and, if best, the weights.

        :returns: the error ratio.
        """
        checkpoint = self.checkpoint()
        result = self.tested(checkpoint)
        for name, value in result.items():
            self.model.logger.record(f'validation/{name}', value)
        # The line of progress is written last: if it exists, the files above exist too.
        if result['ratio'] < self.best:
            self.best = result['ratio']
            replace(checkpoint, provenance={**checkpoint.provenance, 'ratio': self.best}).save(
                self.folder / BEST)
        self.save()
        self.note(**result)
        return result['ratio']

    def resume(self) -> None:
        """
        Resume from the state that was saved last, and keep the best weights so far.

        :raises CheckpointError: if the state or the best weights cannot be used; the message says
            what is lost and how to continue.
        """
        remove_unfinished(self.folder)
        state, replay = self.folder / STATE, self.folder / REPLAY
        if state.exists():
            self.name = load_state(self.model, state)
            if replay.exists():
                load_replay(self.model.replay_buffer, replay)
        elif self.past:
            raise CheckpointError(
                f'{state}: found no file though the run had begun; expected the state to go '
                'on from; put it back from a copy, or begin in another folder with model set to '
                f'{self.folder / BEST}: its best weights are kept, the rest is lost')
        self._find_best()

    def _find_best(self) -> None:
        """Set ``best`` to the error ratio of the best weights so far, if there is a file."""
        path = self.folder / BEST
        if not path.exists():
            if self.past:
                _log.warning('%s: found no file; expected the best weights so far; going on from '
                             'the last state, the best from now on are kept',
                             printable(str(path)))
            return
        try:
            best = Checkpoint.load(path)
            if best.config != self.config.agent:
                raise CheckpointError(f'{path}: found weights of another network; expected those '
                                      'of this run')
        except CheckpointError as error:
            raise CheckpointError(
                f'{error}; the best weights so far are lost: put them back from a copy, or remove '
                'the file, and the run goes on from its last state') from error
        # The ratio is that of the weights themselves, since the progress may be damaged.
        ratio = best.provenance.get('ratio')
        self.best = ratio if is_count(ratio) else self.tested(best)['ratio']

    def save(self) -> None:
        """Write the files that are needed to resume."""
        # Transitions first: the state may count fewer transitions than there are, but not more.
        if self.model.replay_buffer.size():
            save_replay(self.model.replay_buffer, self.folder / REPLAY)
        save_state(self.model, self.folder / STATE, self.name)


class TrainingWatch(BaseCallback):
    """
    Log the terms of the reward, and evaluate at intervals, while SAC learns.

    The three attributes below are set when the training starts.

    :ivar due: number of interactions at which the next evaluation is due.
    :ivar evaluated: number of interactions at the last evaluation, or at the start.
    :ivar task: number of the progress bar.
    """

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run
        self.due = self.evaluated = 0

    def _on_training_start(self) -> None:
        """Show the progress bar, and plan the first evaluation."""
        self.evaluated = self.num_timesteps
        self.due = self.num_timesteps + self.run.config.evaluate_every
        self.task = self.run.progress.add_task(
            'soft actor-critic', total=self.run.config.interactions,
            completed=self.num_timesteps, error='')

    def _on_step(self) -> bool:
        """Update the progress bar, and evaluate if this is due; True: go on learning."""
        for name in ('delta_space_coverage', 'delta_depth_error', 'penalty'):
            self.logger.record_mean(
                f'reward/{name}', float(np.mean([info[name] for info in self.locals['infos']])))
        self.run.progress.update(self.task, completed=self.num_timesteps)
        if self.num_timesteps >= self.due:
            self.due += self.run.config.evaluate_every
            self._evaluate()
        return True

    def _on_training_end(self) -> None:
        """Evaluate and save if SAC has learned since the last evaluation."""
        if self.num_timesteps > self.evaluated:
            self._evaluate()

    def _evaluate(self) -> None:
        """Evaluate in the validation rooms, and show the ratio."""
        ratio = self.run.evaluate()
        self.evaluated = self.num_timesteps
        self.run.progress.update(self.task, error=f'validation {ratio:.4f}')


class ThreadedEnvironments(DummyVecEnv):
    """Environments in threads of this process: their slow parts release the interpreter's lock."""

    def __init__(self, builders: list[Callable[[], gym.Env]]) -> None:
        super().__init__(builders)
        self._threads = ThreadPoolExecutor(cores(), 'environment')

    def step_wait(self) -> VecEnvStepReturn:
        """Play a step in each environment, and begin a new episode where one has ended."""
        # ``list`` waits for all steps, and raises their exceptions.
        list(self._threads.map(self._play, range(self.num_envs)))
        return (self._obs_from_buf(), self.buf_rews.copy(), self.buf_dones.copy(),
                [info.copy() for info in self.buf_infos])

    def _play(self, number: int) -> None:
        """Play a step of one environment, and store its results in the buffers."""
        env = self.envs[number]
        # The keys of ``info`` are those of stable-baselines3.
        observation, reward, terminated, truncated, info = env.step(self.actions[number])
        info['TimeLimit.truncated'] = truncated and not terminated
        if terminated or truncated:
            info['terminal_observation'] = observation
            observation, self.reset_infos[number] = env.reset()
        self.buf_rews[number], self.buf_infos[number] = reward, info
        self.buf_dones[number] = terminated or truncated
        self._save_obs(number, observation)

    def close(self) -> None:
        """End the threads."""
        self._threads.shutdown()
        super().close()


def environments(config: TrainingConfig, rooms: Sequence[str]) -> VecMonitor:
    """Return the environments of a run; they share their rooms and engines."""
    scenes = Rooms(rooms, **config.rooms.reading)
    numbers = range(config.environments)
    envs = [CameraPlacementEnv(scenes, config.simulation, fewest=config.fewest_cameras,
                               rotations=config.rooms.angles) for _ in numbers]
    # The depth maps of one engine: they have twice as many columns as rows.
    pixels = VIEWPOINTS * 2 * config.simulation.engine.error_rows ** 2
    # ``env.problem`` is a function with a cache of its own, which ``__wrapped__`` leaves out. All
    # environments get one cache, of at least one engine for each of them.
    problem = lru_cache(max(MAX_DEPTH_PIXELS // pixels, len(envs)))(envs[0].problem.__wrapped__)
    for env in envs:
        env.problem = problem
    rig_envs: list[CameraPlacementEnv | None] = [None for _ in numbers]
    if config.episodes.rig_file:
        settings = replace(config.simulation, rig_file=config.episodes.rig_file)
        rig = settings.placed_rig
        rig_problem = lru_cache(RIG_PROBLEMS)(
            lambda scene, rotation: problem(scene, rotation).with_rig(rig, settings))
        rig_envs = [CameraPlacementEnv(scenes, settings, rotations=config.rooms.angles)
                    for _ in numbers]
        for env in rig_envs:
            env.problem = rig_problem
    return VecMonitor(ThreadedEnvironments([
        partial(playable, env, config.agent, config.episodes, rig_env)
        for env, rig_env in zip(envs, rig_envs)]))


def learn(run: Run) -> None:
    """Let SAC play and learn up to the number of interactions in the settings."""
    config, model = run.config, run.model
    if model.num_timesteps >= config.interactions:
        return
    # The actor plays from the first turn, without random actions, if it has first weights or has
    # learned before.
    model.warm = bool(config.model) or model.num_timesteps > 0
    # ``learning_starts`` counts from the beginning of the run. If the replay buffer was lost,
    # collect as many transitions again before the next gradient step.
    if not model.replay_buffer.size():
        model.learning_starts += model.num_timesteps
    model.set_env(environments(config, room_names(config.rooms, 'training')))
    # The seed depends on the number of interactions, so that a resumed run plays other episodes.
    # The shift halves the 32-bit number, so that it is less than MAX_SEED.
    sequence = np.random.SeedSequence([config.seed, model.num_timesteps])
    model.env.seed(int(sequence.generate_state(1)[0]) >> 1)
    try:
        model.learn(config.interactions - model.num_timesteps, callback=TrainingWatch(run),
                    reset_num_timesteps=False, tb_log_name='sac')
    finally:
        model.env.close()


def train(config: TrainingConfig, folder: Path, command: str = '') -> Checkpoint:
    """
    Train, or resume the run in the folder, and evaluate in the test rooms.

    :param config: settings of the run.
    :param folder: folder of the run.
    :param command: command line of the run, for the card (metadata) of the weights.
    :returns: the best checkpoint; its provenance has the learning curve and the test results,
        together with those of random moves.
    """
    claim(folder, config)
    columns = (TextColumn('{task.description}'), MofNCompleteColumn(), TimeRemainingColumn(),
               TextColumn('{task.fields[error]}'))
    with WorkerPool(config.workers) as pool, Progress(*columns) as progress:
        start = Checkpoint.load(find_model(config.model)) if config.model else None
        run = Run(build_model(config, folder, start), config, folder, pool, progress)
        run.resume()
        learn(run)
        if not (folder / BEST).exists():
            # The file was lost, and no evaluation has written it again.
            run.evaluate()
        return report(run, command)


def build_model(config: TrainingConfig, folder: Path, start: Checkpoint | None = None) -> AgentSac:
    """
    Build SAC for a run.

    :param config: settings of the run.
    :param folder: folder of the run.
    :param start: weights from which the actor starts; None for random ones.
    """
    # Gradient steps per step of all environments. If less than 1, the environments take several
    # steps per gradient step.
    steps = config.updates_per_turn * config.environments
    model = make_sac(config.sac, config.agent, seed=config.seed,
                     environments=config.environments,
                     train_freq=1 if steps == 0.0 else max(round(1.0 / steps), 1),
                     gradient_steps=max(round(steps), 1) if steps else 0,
                     tensorboard=str(folder / 'tensorboard'))
    # ``Run`` writes to the logger also outside ``learn``, which would set it up.
    model.set_logger(configure(str(folder / 'tensorboard'), ['tensorboard']))
    if start is not None:
        load_actor(model, start)
    return model


def report(run: Run, command: str) -> Checkpoint:
    """Play the test rooms with the best weights and random moves; write both into the card."""
    config = run.config
    best = Checkpoint.load(run.folder / BEST)
    # The results are computed with the finest engine, even if the run learned on another.
    # Without weights, these trials are those of random moves.
    trials = [replace(t, simulation=replace(t.simulation, engine=EngineConfig(preset='fine')))
              for t in trials_of(config, 'test')]
    cpu = f'CPU, {config.workers or cores()} processes, {torch.get_num_threads()} threads'
    lines = records(run.folder)
    provenance = {
        **best.provenance, 'command': command,
        'hardware': torch.cuda.get_device_name() if run.model.device.type == 'cuda' else cpu,
        'seconds': lines[-1]['seconds'] if lines else run.seconds, 'curve': lines,
        'test': {'rooms': len(trials),
                 'policy': evaluate(run.pool, trials, best.to_bytes()),
                 'random_moves': evaluate(run.pool, trials)}}
    final = replace(best, provenance=provenance)
    final.save(run.folder / BEST)
    return final
