# SPDX-License-Identifier: Apache-2.0
"""Settings of a training run."""

from dataclasses import dataclass
from itertools import combinations

from ocp_ros.agent.config import AgentConfig
from ocp_ros.configuration import ConfigurationError, group, setting
from ocp_ros.simulation.config import SimulationConfig


@dataclass(frozen=True)
class SacConfig:
    """Soft actor-critic (Haarnoja et al., 2018) as stable-baselines3 names its settings."""

    learning_rate: float = setting(5e-4, 'step size of Adam', 1e-7, 1.0)
    batch_size: int = setting(64, 'transitions per gradient step', 1, 65536)
    buffer_size: int = setting(40000, 'transitions the replay buffer holds', 100, 10000000)
    learning_starts: int = setting(1000, 'transitions before the first gradient step', 1, 1000000)
    gamma: float = setting(0.95, 'discount per turn', 0.0, 1.0)
    tau: float = setting(0.01, 'share of the targets replaced per gradient step', 1e-6, 1.0)
    entropy: float = setting(0.1, 'first entropy coefficient; it is then learned', 1e-6, 100.0)
    target_entropy: float = setting(
        -1.5, 'target entropy per component of the action', -10.0, 1.0)
    device: str = setting('auto', 'auto, cpu or cuda', choices=('auto', 'cpu', 'cuda'))


@dataclass(frozen=True)
class RoomsConfig:
    """
    Generated rooms by seed, in three sets that never overlap.

    The policy learns in the training rooms, the best checkpoint is chosen by the validation rooms,
    and the test rooms are only ever used for the figures that are reported.
    """

    training_first: int = setting(1000, 'seed of the first training room', 0, 1 << 31)
    training: int = setting(64, 'number of training rooms', 1, 100000)
    validation_first: int = setting(500, 'seed of the first validation room', 0, 1 << 31)
    validation: int = setting(10, 'number of validation rooms', 1, 100000)
    test_first: int = setting(0, 'seed of the first test room', 0, 1 << 31)
    test: int = setting(20, 'number of test rooms', 1, 100000)
    points: int = setting(12000, 'points per room', 1000, 1000000)

    def seeds(self, part: str) -> range:
        """Return the seeds of ``training``, ``validation`` or ``test``."""
        first = getattr(self, f'{part}_first')
        return range(first, first + getattr(self, part))

    def __post_init__(self) -> None:
        """Refuse sets that share a room."""
        parts = ('training', 'validation', 'test')
        for one, other in combinations(parts, 2):
            shared = set(self.seeds(one)) & set(self.seeds(other))
            if shared:
                raise ConfigurationError(
                    f'rooms: found {len(shared)} rooms both in {one} and in {other}, such as seed '
                    f'{min(shared)}; expected none; move {one}_first or {other}_first')


@dataclass(frozen=True)
class TrainingConfig:
    """A training run: what ``ocp train`` reads from YAML."""

    seed: int = setting(0, 'seed of networks, exploration and order of rooms', 0, 1 << 31)
    interactions: int = setting(40000, 'turns to play in all', 1, 1 << 40)
    environments: int = setting(4, 'episodes played side by side', 1, 1024)
    updates_per_turn: float = setting(1.0, 'gradient steps per turn played', 0.0, 100.0)
    evaluate_every: int = setting(2000, 'turns between evaluations', 1, 1 << 40)
    rooms: RoomsConfig = group(RoomsConfig)
    simulation: SimulationConfig = group(SimulationConfig)
    agent: AgentConfig = group(AgentConfig)
    sac: SacConfig = group(SacConfig)
