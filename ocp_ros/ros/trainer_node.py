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
``trainer_node``: learn from the turns of policies that explore, and publish better weights.

Each policy runs in a namespace of its own, on this machine or another. It publishes what it
observed and chose; its simulation publishes the rewards. Training runs in a separate thread, so
that no message waits for a gradient step. Where turns come faster than the trainer can learn from
them, the trainer asks the policies to wait.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
import sys
import time

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from ocp_ros.policy.agent_config import AgentConfig
from ocp_ros.policy.checkpoint import Checkpoint
from ocp_ros.ros.interface import topics
from ocp_ros.ros.runtime.managed_node import (
    create_steady_timer,
    OverridableNode,
    publish_diagnostics,
    Status,
)
from ocp_ros.ros.runtime.node_main import run
from ocp_ros.ros.runtime.parameters import declare
from ocp_ros.ros.training_source import TransitionSource
from ocp_ros.training.learner import Learner, LearnerConfig
from ocp_ros.training.training_config import SacConfig
from ocp_ros.util.files import folder_to_write, write_atomically
from ocp_ros.util.resources import find_model
from ocp_ros.util.settings import group, setting, to_nested
import torch
import yaml

#: Largest number of namespaces to learn from.
MAX_SOURCES = 256
#: Seconds without a transition after which a namespace is dropped, if it has no publisher any more
#: or if others need its place.
MAX_SILENCE_S = 60.0
#: Seconds between two lines about the progress in the log.
LOG_INTERVAL_S = 60


@dataclass(frozen=True)
class TrainerNodeConfig(LearnerConfig):
    """Parameters of ``trainer_node``."""

    sources: str = setting('', 'namespaces to learn from, separated by commas; empty: its own '
                           'namespace and every namespace in which a policy explores')
    most_behind: int = setting(
        100, 'policies wait while more gradient steps than this are due', 1, 1 << 31)
    agent: AgentConfig = group(AgentConfig)
    sac: SacConfig = group(SacConfig)


class TrainerNode(OverridableNode):
    """Collect transitions from many namespaces, train a policy, and publish its weights."""

    # Namespaces come and go, and declared overrides would stay.
    declares_all_overrides = False

    def __init__(self, **kwargs) -> None:
        super().__init__('trainer_node', **kwargs)
        self.config = declare(self, TrainerNodeConfig)
        folder_to_write(Path(self.config.folder), 'folder')
        # More threads for a gradient step save time only on idle cores.
        torch.set_num_threads(1)
        checkpoint = Checkpoint.load(find_model(self.config.model)) if self.config.model else None
        # A checkpoint contains the settings of its network.
        self.agent = self.config.agent if checkpoint is None else checkpoint.config
        self.learner = Learner(self.config, self.agent, self.config.sac, checkpoint)
        write_atomically(self.learner.folder / 'config.yaml',
                         yaml.safe_dump(to_nested(self.config), sort_keys=False))
        self.sources: dict[str, TransitionSource] = {}
        #: Sums of the counts of all dropped sources, and the time at which each was dropped.
        self._dropped_counts: Counter[str] = Counter()
        self._drop_times: dict[str, float] = {}
        self._published_weights = self._tick_count = 0
        self._policies_wait = self._failure_logged = False
        #: The latest weights, for namespaces that are found later; empty while there are none.
        self._weights = b''
        names = [name.strip().strip('/') for name in self.config.sources.split(',')]
        for name in [name for name in names if name] or [self.get_namespace().strip('/')]:
            self._add_source(f'/{name}')
        if unknown := self.find_unknown_override():
            self.get_logger().warning(unknown)
        create_steady_timer(self, 0.1, self._tick)
        publish_diagnostics(self, self._status)
        self.get_logger().info(
            f'run {self.learner.run}: {self.learner.updates} updates so far from '
            f'{self.learner.transitions} transitions, checkpoints in {self.learner.folder}')

    @property
    def late_topics(self) -> list[str]:
        """Return its topics, and the overridden ones of namespaces that may be found later."""
        own = [source_topic for source in self.sources.values() for source_topic in source.topics]
        names = {topic.rpartition('/')[2] for topic in own}
        return own + [topic for topic in self.overridden_topics
                      if not self.config.sources and topic.rpartition('/')[2] in names]

    def _add_source(self, namespace: str) -> None:
        """Subscribe to a namespace to learn from it."""
        source = self.sources[namespace] = TransitionSource(
            self, namespace, self.agent, self.learner.add)
        if self._weights:
            source.send_weights(self._weights)

    def _discover(self) -> None:
        """Add namespaces in which a policy explores, and drop silent namespaces."""
        # Namespaces that the user has named do not change.
        if self.config.sources:
            return
        found_namespaces = [
            topic.rpartition('/')[0] or '/' for topic, types in self.get_topic_names_and_types()
            if topic.rpartition('/')[2] == topics.EXPERIENCE
            and types == [topics.TYPES[topics.EXPERIENCE]] and self.count_publishers(topic)]
        # Namespaces that were dropped before come after all others.
        new_namespaces = [name for name in found_namespaces if name not in self.sources]
        new_namespaces.sort(key=lambda name: self._drop_times.get(name, 0.0))
        idle_before = time.monotonic() - MAX_SILENCE_S
        # The first source, the own namespace, is always kept.
        for namespace, source in list(self.sources.items())[1:]:
            is_full = len(self.sources) + len(new_namespaces) > MAX_SOURCES
            if source.idle_since < idle_before and (is_full or namespace not in found_namespaces):
                self._drop_source(namespace)
        for namespace in new_namespaces[:MAX_SOURCES - len(self.sources)]:
            self._add_source(namespace)
            self.get_logger().info(f'learning from {namespace}')

    def _drop_source(self, namespace: str) -> None:
        """Stop learning from a namespace."""
        source = self.sources.pop(namespace)
        self._dropped_counts.update(source.status())
        source.close()
        # The times of the last 10,000 namespaces are kept.
        if len(self._drop_times) >= 10_000:
            del self._drop_times[min(self._drop_times, key=self._drop_times.get)]
        self._drop_times[namespace] = time.monotonic()
        self.get_logger().info(f'not learning from {namespace} any more: it was silent for '
                               f'{MAX_SILENCE_S:g} s')

    def _tick(self) -> None:
        """Publish new weights, and tell the policies whether they have to wait."""
        self._publish_weights()
        learner = self.learner
        did_wait = self._policies_wait
        # Policies wait until half of ``most_behind`` is left: else they would stop at every turn.
        limit = self.config.most_behind / 2 if did_wait else self.config.most_behind
        self._policies_wait = learner.failure is None and learner.behind > limit
        self._tick_count += 1
        # Every tenth call looks for namespaces, and sends the status even without a change.
        is_tenth_tick = self._tick_count % 10 == 0
        if self._tick_count % (LOG_INTERVAL_S * 10) == 0:
            self._log_progress()
        if is_tenth_tick:
            self._discover()
        if is_tenth_tick or self._policies_wait != did_wait:
            for source in self.sources.values():
                # ``behind`` is negative until there are enough transitions to begin the training.
                source.send_status(self._policies_wait, learner.updates, max(learner.behind, 0.0))

    def _log_progress(self) -> None:
        """Write the progress of the training to the log and to TensorBoard."""
        learner, turns, ratio = self.learner, self.totals()['turns'], self.error_ratio
        seconds = round(learner.seconds_to_checkpoint)
        self.get_logger().info(
            f'{turns} turns, {learner.transitions} transitions, {learner.updates} gradient steps; '
            f'error at the end of the last episodes / at their start: {ratio}; next checkpoint in '
            f'{seconds} s')
        values = {'turns': turns, 'transitions': learner.transitions,
                  'gradient_steps': learner.updates, 'seconds_to_checkpoint': seconds,
                  **({'error_ratio': ratio} if ratio != '-' else {})}
        learner.record({f'progress/{name}': value for name, value in values.items()})

    def _publish_weights(self) -> None:
        """Publish the newest weights, if the learner has made any; log its failure once."""
        if self.learner.failure is not None and not self._failure_logged:
            self._failure_logged = True
            self.get_logger().error(f'training stopped: {self.learner.failure!r}')
        checkpoint = self.learner.take_weights()
        if checkpoint is not None:
            self._published_weights += 1
            self._weights = checkpoint.to_bytes()
            for source in self.sources.values():
                source.send_weights(self._weights)

    def totals(self) -> dict[str, int]:
        """Return the sums of the counts over all sources."""
        # The last item has all names: it is a source's, since the first source is never dropped.
        counts = [self._dropped_counts, *(source.status() for source in self.sources.values())]
        return {name: sum(source_counts[name] for source_counts in counts) for name in counts[-1]}

    @property
    def error_ratio(self) -> float | str:
        """Return the mean of ``error_ratios`` over all sources; ``-`` before the first episode."""
        ratios = [ratio for source in self.sources.values() for ratio in source.error_ratios]
        return round(float(np.mean(ratios)), 3) if ratios else '-'

    def _status(self) -> Status:
        """Return the status of the training for diagnostics."""
        learner = self.learner
        totals = self.totals()
        losses = list(learner.losses)
        values = {'run': learner.run, 'stored_transitions': learner.transitions, **totals,
                  'refused_messages': totals['refused'], 'updates': learner.updates,
                  'critic_loss': round(float(np.mean(losses)), 4) if losses else '-',
                  'error_ratio': self.error_ratio,
                  'behind': round(max(learner.behind, 0.0)), 'policies_wait': self._policies_wait,
                  'weights_published': self._published_weights, 'sources': len(self.sources),
                  **{f'turns {name}': source.assembler.assembled
                     for name, source in self.sources.items()}}
        if learner.failure is not None:
            return DiagnosticStatus.ERROR, f'training stopped: {learner.failure!r}', values
        return DiagnosticStatus.OK, 'training', values

    def stop(self) -> None:
        """Stop training and save the policy, before ROS is shut down."""
        self.learner.close()

    def destroy_node(self) -> None:
        """Stop training, save the policy, and destroy the node."""
        self.stop()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(TrainerNode, args)


if __name__ == '__main__':
    sys.exit(main())
