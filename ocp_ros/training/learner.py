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

"""A learner that takes transitions from other threads and trains in a thread of its own."""

from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
import math
from pathlib import Path
import queue
import threading
import time

import numpy as np
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.training.experience import Transition
from ocp_ros.training.run_folder import REPLAY, STATE
from ocp_ros.training.sac import actor_checkpoint, load_actor, make_sac
from ocp_ros.training.sac_state import (
    end_episodes,
    load_replay,
    load_state,
    new_run,
    save_replay,
    save_state,
)
from ocp_ros.training.training_config import SacConfig
from ocp_ros.util.files import remove_unfinished
from ocp_ros.util.settings import MAX_SEED, setting
from stable_baselines3.common.logger import configure

#: Gradient steps between two checks of the inbox: few, so that the learner can stop soon.
BURST_STEPS = 4
#: Largest number of transitions in the inbox; the learner stores them between two bursts.
INBOX_SIZE = 4096
#: File of the actor's weights.
ACTOR = 'actor.safetensors'


@dataclass(frozen=True)
class LearnerConfig:
    """Settings of a learner: gradient steps per transition, and its files."""

    updates_per_turn: float = setting(0.25, 'gradient steps per transition', 0.0, 100.0)
    publish_every: int = setting(50, 'gradient steps between two sets of weights', 1, 1 << 31)
    save_seconds: float = setting(
        300.0, 'longest time between two checkpoints, which is what a killed process loses, '
               'seconds', 0.0, 86400.0)
    folder: str = setting('out/trainer', 'folder of checkpoints and TensorBoard files')
    model: str = setting('', 'first weights: path or name; empty: random')
    seed: int = setting(0, 'seed of networks and batches', 0, MAX_SEED)


class Learner:
    """
    Train SAC from transitions in a separate thread.

    The learner resumes from the files in its folder: the networks, optimisers and transitions that
    were saved last. The first checkpoint comes with the first transition, so a run whose weights
    are published can always be continued. Each file is whole or absent, whenever the process ends.

    :param config: pace and folder.
    :param agent: sizes of the networks.
    :param sac: settings of SAC.
    :param start: weights to start from, or None.
    :ivar dropped: number of transitions for which the inbox had no room.
    :ivar losses: losses of the critics in the latest bursts, of some gradient steps each.
    :ivar failure: the exception that ended the thread, or None.
    """

    def __init__(self, config: LearnerConfig, agent: AgentConfig, sac: SacConfig,
                 start: Checkpoint | None = None) -> None:
        self.config = config
        self.sac = sac
        self.folder = Path(config.folder)
        self.model = make_sac(sac, agent, seed=config.seed)
        if start is not None:
            load_actor(self.model, start)
            self.model.warm = True
        self.model.set_logger(configure(str(self.folder / 'tensorboard'), ['tensorboard']))
        self.run = self._resume()
        self.dropped = 0
        self.losses: deque[float] = deque(maxlen=max(config.publish_every // BURST_STEPS, 1))
        self.failure: BaseException | None = None
        #: The observation after the last transition.
        self._next_observation: dict[str, np.ndarray] = {}
        #: Numbers of transitions and updates in the files, and the time at which these were
        #: written, by a steady clock.
        self._saved_counts = self.transitions, self.updates
        self._save_time = -math.inf
        self._new_weights: deque[Checkpoint] = deque(maxlen=1)
        if self.updates:
            # Publish the weights again, as policies may have been started again as well.
            self._new_weights.append(self.checkpoint())
        # Only the thread uses the model; other threads put transitions into the inbox.
        self._inbox: queue.Queue[Transition | None] = queue.Queue(INBOX_SIZE)
        self._thread = threading.Thread(target=self._work, name='learner', daemon=True)
        self._thread.start()

    def _resume(self) -> str:
        """Load the files in the folder, if any, and count; return the name of the run."""
        remove_unfinished(self.folder)
        state, replay = self.folder / STATE, self.folder / REPLAY
        run = load_state(self.model, state) if state.exists() else new_run()
        if replay.exists():
            load_replay(self.model.replay_buffer, replay)
        # The replay file is written before the state, and may have transitions that the state does
        # not count: count them too.
        buffered = self.model.replay_buffer.size()
        self.model.num_timesteps = max(self.transitions, buffered)
        #: Number of transitions that were lost before this start: overwritten in the full buffer,
        #: or not in the replay file when the process ended.
        self._lost_transitions = self.transitions - buffered
        # ``_steps_for`` leaves out the lost transitions.
        steps_of_kept = max(self._steps_for(self.transitions), 0.0)
        #: Number of gradient steps that were taken for lost transitions: all steps beyond those
        #: that the transitions in memory call for.
        self._steps_of_lost = max(self.updates - steps_of_kept, 0.0)
        return run

    @property
    def transitions(self) -> int:
        """Return the number of transitions of this run so far."""
        return int(self.model.num_timesteps)

    @property
    def updates(self) -> int:
        """Return the number of gradient steps of this run so far."""
        return int(self.model._n_updates)

    @property
    def behind(self) -> float:
        """Return the number of gradient steps due, counting the transitions in the inbox."""
        return self._steps_due(self.transitions + self._inbox.qsize())

    def _steps_due(self, transitions: int) -> float:
        """Return the number of gradient steps still due for a number of transitions."""
        return self._steps_for(transitions) - (self.updates - self._steps_of_lost)

    def _steps_for(self, transitions: int) -> float:
        """
        Return the number of gradient steps that a number of transitions calls for.

        Lost transitions, and the first ``learning_starts`` of the others, call for no steps. While
        there are fewer transitions than these, the result is below 0.
        """
        counted = transitions - self._lost_transitions - self.sac.learning_starts
        return counted * self.config.updates_per_turn

    def add(self, transition: Transition) -> bool:
        """
        Put a transition into the inbox; return at once.

        :returns: whether there was room for it; False after a failure of the thread.
        """
        if self.failure is not None:
            return False
        try:
            self._inbox.put_nowait(transition)
        except queue.Full:
            self.dropped += 1
            return False
        return True

    def take_weights(self) -> Checkpoint | None:
        """Return the newest weights made since the last call, or None."""
        try:
            return self._new_weights.pop()
        except IndexError:
            return None

    def close(self) -> None:
        """Stop training and save; a second call does nothing."""
        # None ends the thread. If the inbox is full, wait, but not for a thread that has failed.
        while self._thread.is_alive():
            with suppress(queue.Full):
                self._inbox.put(None, timeout=0.1)
                break
        self._thread.join()
        # Write buffered log entries to the files.
        self.model.logger.close()
        if self.failure is None and self._has_unsaved:
            self._save()

    @property
    def seconds_to_checkpoint(self) -> float:
        """Return the time until the next checkpoint, which comes only if it has something new."""
        return max(self._save_time + self.config.save_seconds - time.monotonic(), 0.0)

    @property
    def _has_unsaved(self) -> bool:
        """Return whether there are transitions or updates that the files lack."""
        return (self.transitions, self.updates) != self._saved_counts

    def record(self, values: Mapping[str, float]) -> None:
        """Write values to the TensorBoard files, by name; this may be called in any thread."""
        for output in self.model.logger.output_formats:
            output.write(dict(values), dict.fromkeys(values, ()), self.transitions)

    def _work(self) -> None:
        """Store transitions, and train in bursts, until the learner is closed."""
        try:
            while self._read_inbox():
                if self._burst_is_due():
                    self.model.train(BURST_STEPS, self.sac.batch_size)
                    self.losses.append(float(
                        self.model.logger.name_to_value['train/critic_loss']))
                    self._publish(self.updates)
                if self._checkpoint_is_due():
                    self._save()
        except BaseException as error:
            # An exception ends a thread silently, so the user of the learner reports it.
            self.failure = error

    def _read_inbox(self) -> bool:
        """Store new transitions; wait for more if nothing is due. Return False once closed."""
        while not (self._checkpoint_is_due() or self._inbox.empty() and self._burst_is_due()):
            try:
                transition = self._inbox.get(
                    timeout=self.seconds_to_checkpoint if self._has_unsaved else None)
            except queue.Empty:
                break
            if transition is None:
                return False
            self._store(transition)
            self.model.num_timesteps += 1
        return True

    def _store(self, transition: Transition) -> None:
        """Put a transition into the replay buffer, as one of its only environment."""
        # A sum of rewards over several steps ends where the next transition is not the following
        # one: it is of another rig, or some between them are missing.
        if transition.observation is not self._next_observation and (
                self.model.replay_buffer.size()):
            end_episodes(self.model.replay_buffer)
        self._next_observation = transition.next_observation
        before, after = ({name: value[None] for name, value in observation.items()}
                         for observation in (transition.observation, transition.next_observation))
        self.model.replay_buffer.add(
            before, after, transition.actions[None], np.array([transition.reward]),
            np.array([transition.terminated]), [{}])

    def _burst_is_due(self) -> bool:
        """Return whether a burst of gradient steps is due for the stored transitions."""
        return self._steps_due(self.transitions) >= BURST_STEPS

    def _checkpoint_is_due(self) -> bool:
        """Return whether it is time to save, and there is something new."""
        return self._has_unsaved and self.seconds_to_checkpoint <= 0.0

    def _publish(self, updates: int) -> None:
        """Publish and log the weights once in ``publish_every`` gradient steps."""
        # Updates grow by BURST_STEPS, so the condition holds once in each interval, or after each
        # burst if the interval is shorter.
        if updates % self.config.publish_every < BURST_STEPS:
            self._new_weights.append(self.checkpoint())
            self.model.logger.record('train/transitions', self.transitions)
            self.model.logger.dump(self.model.num_timesteps)

    def checkpoint(self) -> Checkpoint:
        """Return a checkpoint of the present actor."""
        return actor_checkpoint(self.model, self.run, {
            'interactions': self.transitions, 'seed': self.config.seed})

    def _save(self) -> None:
        """Write the transitions, the actor and the state; each file is whole or absent."""
        # Transitions first: if the process ends before the state is written, the next start counts
        # the transitions in the replay file that the state does not count.
        save_replay(self.model.replay_buffer, self.folder / REPLAY)
        self.checkpoint().save(self.folder / ACTOR)
        save_state(self.model, self.folder / STATE, self.run)
        self._saved_counts = self.transitions, self.updates
        self._save_time = time.monotonic()
