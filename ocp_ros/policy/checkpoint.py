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
Checkpoints: weights and their card, as one safetensors blob, in files and in messages.

Nothing is ever unpickled. The card is JSON: the settings that the weights need (the agent's
sizes), their version (updates so far) and their provenance.
"""

from dataclasses import dataclass, field
import io
import json
from pathlib import Path
from typing import Any

from ocp_ros.policy.agent_config import AgentConfig, CheckpointError
from ocp_ros.policy.cloud_encoder import LENGTH_SCALE
from ocp_ros.policy.networks import Actor
from ocp_ros.util.files import MAX_BYTES, read_regular, write_atomically
from ocp_ros.util.settings import from_nested, to_nested
from ocp_ros.util.tensor_blob import read_blob, write_blob
import torch

#: Format of the card, and its key in the metadata of a safetensors file.
FORMAT = 'ocp_ros-actor-3'
METADATA_KEY = 'ocp_ros'
#: Largest absolute weight: trained weights stay below 100, and much larger ones cause an overflow
#: in the network.
MAX_WEIGHT = 1e4


@dataclass(frozen=True)
class Checkpoint:
    """
    The weights of an actor (the network that runs), their settings and their provenance.

    :ivar config: sizes of the network.
    :ivar weights: tensors by name, those of :class:`~ocp_ros.policy.networks.Actor`.
    :ivar updates: gradient steps so far; within one run, weights with more updates are newer.
    :ivar run: identity of the training run.
    :ivar provenance: how the weights were made: command, seed, date, rooms, results.
    """

    config: AgentConfig
    weights: dict[str, torch.Tensor]
    updates: int = 0
    run: str = ''
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Reject weights that do not fit the network or would overflow in it."""
        # Tensors on the meta device need no memory: only their shapes are compared.
        with torch.device('meta'):
            expected = Actor(self.config).state_dict()
        missing = expected.keys() - self.weights.keys()
        unknown = self.weights.keys() - expected.keys()
        if missing or unknown:
            raise CheckpointError(
                f'weights: found other layers than the network has; missing {sorted(missing)}, '
                f'unknown {sorted(unknown)}; expected weights made with the same agent settings')
        for name, tensor in self.weights.items():
            if tensor.shape != expected[name].shape or tensor.dtype != torch.float32:
                raise CheckpointError(
                    f'weights: found {name} as {tensor.dtype} {tuple(tensor.shape)}; expected '
                    f'float32 {tuple(expected[name].shape)}')
            # NaN fails this comparison too.
            if not (tensor.abs() <= MAX_WEIGHT).all():
                raise CheckpointError(
                    f'weights: found NaN, inf or more than {MAX_WEIGHT:g} in {name}; expected '
                    'smaller finite numbers; the training that made them has diverged')

    @property
    def domain(self) -> dict[str, tuple[float, float]]:
        """
        Return the lowest and the highest value of each limit that the weights have learned.

        Its keys are those of ``TrainingConfig.domain``; there are none if the card has no readable
        domain.
        """
        try:
            return {str(name): (float(low), float(high))
                    for name, (low, high) in self.provenance.get('domain', {}).items()}
        except (AttributeError, OverflowError, TypeError, ValueError):
            return {}

    def to_bytes(self) -> bytes:
        """Return the checkpoint as one safetensors blob, with the card in its metadata."""
        blob = io.BytesIO()
        write_blob(blob, {name: value.detach().cpu().numpy()
                          for name, value in self.weights.items()},
                   {METADATA_KEY: json.dumps(self.card())})
        return blob.getvalue()

    def card(self) -> dict[str, Any]:
        """Return the card: everything except the weights, as plain data."""
        return {'format': FORMAT, 'run': self.run, 'updates': self.updates,
                'config': to_nested(self.config), 'provenance': self.provenance}

    @property
    def origin(self) -> str:
        """Return in words how long, and in which run, the weights were trained."""
        return f'{self.updates} updates of run {self.run or "-"}'

    def check_replaces(self, running: 'Checkpoint', followed_run: str = '') -> None:
        """
        Check that these weights may replace the running ones.

        :param running: the checkpoint that a policy runs now.
        :param followed_run: the run that the policy follows; empty for any.
        :raises CheckpointError: if the networks differ, the weights are of another run than the
            followed one, or both are of the same run and these weights are not newer.
        """
        if followed_run and self.run != followed_run:
            raise CheckpointError(
                f'weights: found those of run {self.run!r}; expected those of {followed_run!r}, '
                'which this policy follows; to follow another run, configure the policy again')
        if self.config != running.config:
            raise CheckpointError(f'weights: found {self.config}; expected those of the running '
                                  f'policy, {running.config}')
        if self.run == running.run and self.updates <= running.updates:
            raise CheckpointError(
                f'weights: found {self.updates} updates; expected more than the '
                f'{running.updates} of the running policy, which are of the same run')

    @classmethod
    def from_bytes(cls, blob: bytes, source: str = 'weights') -> 'Checkpoint':
        """
        Return the checkpoint in a blob, after all checks.

        :param blob: from :meth:`to_bytes`.
        :param source: name of the file or message, for errors.
        :raises CheckpointError: if the blob is incomplete, has another format or network, or has
            weights that are not finite or exceed ``MAX_WEIGHT``.
        """
        try:
            arrays, metadata = read_blob(blob)
            card = json.loads(metadata[METADATA_KEY])
            if card['format'] != FORMAT:
                raise ValueError(f'its format is {card["format"]!r}, not {FORMAT!r}')
            # Older cards have the unit of length, which was a setting; another unit is unknown.
            settings = dict(card['config'])
            if settings.get('length_scale') == LENGTH_SCALE:
                del settings['length_scale']
            config = from_nested(AgentConfig, settings, source)
            updates = card['updates']
            run = card['run']
            # ``type`` rejects True too. Nodes publish updates as float64, exact up to 2^53.
            if (type(updates) is not int or not 0 <= updates <= (1 << 53)
                    or not isinstance(run, str) or len(run) > 100):
                raise ValueError(f'its updates are {updates!r} and its run is {str(run)[:50]!r}')
            provenance = dict(card['provenance'])
            # The copies may be written to, as PyTorch expects.
            weights = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
        except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError,
                RecursionError) as error:
            raise CheckpointError(
                f'{source}: found no readable checkpoint ({type(error).__name__}: {error}); '
                'expected a whole safetensors file written by this package') from error
        try:
            return cls(config, weights, updates, run, provenance)
        except CheckpointError as error:
            # The message names the source instead of ``weights``.
            raise CheckpointError(f'{source}: {str(error).removeprefix("weights: ")}') from error

    def save(self, path: Path) -> None:
        """
        Write the weights, and the card to a ``.json`` file beside them, each atomically.

        :param path: file of the weights, whose name ends in ``.safetensors``.
        """
        write_atomically(path, self.to_bytes())
        card = json.dumps(self.card(), indent=2) + '\n'
        write_atomically(card_of(path), card)

    @classmethod
    def load(cls, path: Path) -> 'Checkpoint':
        """
        Return the checkpoint in a ``.safetensors`` file.

        :raises CheckpointError: if the file does not exist or cannot be used.
        """
        try:
            blob = read_regular(path)
        except OSError as error:
            raise CheckpointError(f'{path}: found no file that can be read ({error.strerror}); '
                                  'expected weights ending in .safetensors, of '
                                  f'{MAX_BYTES:,} bytes at most') from error
        return cls.from_bytes(blob, str(path))


def card_of(path: Path) -> Path:
    """Return the path of the card that belongs to a weights file."""
    return Path(path).with_suffix('.json')
