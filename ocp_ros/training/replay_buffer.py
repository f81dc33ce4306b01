# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A replay buffer that stores what is known at each turn and builds observations when it is sampled.

What has been seen of a scene is one bit per point, so a turn takes some 1.6 kB where its encoded
observation takes ten times that, and every turn is stored once: the observation after a
transition is the one before the next.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

from gymnasium import spaces
import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
import torch

from ocp_ros.agent.agent_config import AgentConfig
from ocp_ros.agent.encoder import encode_cloud
from ocp_ros.geometry.packed_bits import spatial_order, Subset
from ocp_ros.scenes.scene import Scene
from ocp_ros.training.augmentation import symmetric
from ocp_ros.training.encoded_environment import Known, padded

#: Turns per episode that the rings are sized for: each episode's final turn begins no transition.
EPISODE = 30


class Rebuild:
    """
    Build the encoded cloud of a turn from what is known.

    :param scene: makes the scene of a number.
    :param agent: what the network reads.
    """

    def __init__(self, scene: Callable[[int], Scene], agent: AgentConfig) -> None:
        self._agent = agent
        self._points = lru_cache(maxsize=None)(lambda number: _with_order(scene(number).points))

    def __call__(self, known: Known) -> dict[str, np.ndarray]:
        """Return what :func:`ocp_ros.agent.observation.encode` gives, padded."""
        points, order = self._points(known.scene)
        here = np.isfinite(known.positions[:, 0])
        encoded = encode_cloud(points[Subset(known.observed, order).mask],
                               known.positions[here], self._agent)
        return padded(encoded, len(here))


def _with_order(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) and the order of the engine's bits (N,)."""
    return points, spatial_order(points)


class _Cache:
    """
    The rebuilt turns that were asked for last.

    :param limit: bytes that their arrays may take.
    """

    def __init__(self, limit: int) -> None:
        self.limit, self.nbytes = limit, 0
        self._turns: OrderedDict[tuple[int, int], dict[str, np.ndarray]] = OrderedDict()

    def __len__(self) -> int:
        """Return the number of turns."""
        return len(self._turns)

    def get(self, at: tuple[int, int]) -> dict[str, np.ndarray] | None:
        """Return the arrays of a slot, or None."""
        if at in self._turns:
            self._turns.move_to_end(at)
        return self._turns.get(at)

    def put(self, at: tuple[int, int], arrays: dict[str, np.ndarray]) -> None:
        """Keep the arrays of a slot at the cost of those not asked for the longest."""
        self.drop(at)
        size = _size(arrays)
        if size > self.limit:
            return
        while self.nbytes + size > self.limit:
            self.drop(next(iter(self._turns)))
        self._turns[at] = arrays
        self.nbytes += size

    def drop(self, at: tuple[int, int]) -> None:
        """Forget a slot."""
        self.nbytes -= _size(self._turns.pop(at, {}))

    def clear(self) -> None:
        """Forget everything."""
        self._turns.clear()
        self.nbytes = 0


def _size(arrays: dict[str, np.ndarray]) -> int:
    """Return the bytes of some arrays."""
    return sum(array.nbytes for array in arrays.values())


class TurnReplay(DictReplayBuffer):
    """
    Replay of turns in memory, each sample turned or mirrored at random on its own.

    All arrays are indexed by slot and environment, as those of stable-baselines3 are; each
    environment has a ring of its own, of which ``pos`` is the slot written next and ``full`` tells
    whether it has wrapped round. A transition begins in the slots marked in ``starts`` and ends in
    the slot after; the final turn of an episode is not marked.

    :param buffer_size: transitions of all environments together that it holds at least, while
        episodes have 30 turns or more.
    :param observation_space: of the encoded observations.
    :param action_space: (K, 2).
    :param device: of the samples.
    :param n_envs: number of environments that are played in step.
    :param optimize_memory_usage: for stable-baselines3; must be False.
    :param handle_timeout_termination: do not take for the end what ``TimeLimit.truncated`` in
        ``infos`` tells to be the end of the time only.
    :param rebuild: builds the encoded arrays of a turn from what is known.
    :param words: words of 64 bits that ``Known.observed`` has in a scene; where one has more, room
        is made for them.
    :param cache_bytes: how much of what was rebuilt is kept.
    :param stored: keys of the observation that ``rebuild`` does not return: they are stored,
        floating-point numbers with half precision.
    :raises ValueError: if the settings contradict each other.
    """

    pos: np.ndarray
    full: np.ndarray

    def __init__(self, buffer_size: int, observation_space: spaces.Dict,
                 action_space: spaces.Space, device: torch.device | str = 'auto', n_envs: int = 1,
                 optimize_memory_usage: bool = False, handle_timeout_termination: bool = True, *,
                 rebuild: Callable[[Known], dict[str, np.ndarray]], words: int,
                 cache_bytes: int = 1 << 28, stored: tuple[str, ...] = ()) -> None:
        # Past the constructors that allocate both observations of every transition.
        super(ReplayBuffer, self).__init__(
            buffer_size, observation_space, action_space, device, n_envs=n_envs)
        if optimize_memory_usage:
            raise ValueError('optimize_memory_usage: found True; expected False: every turn is '
                             'stored once anyway')
        if unknown := set(stored) - set(observation_space.spaces):
            raise ValueError(f'stored: found {sorted(unknown)}; expected keys of the observation '
                             f'space, of {sorted(observation_space.spaces)}')
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.rebuild, self.words, self.cache = rebuild, words, _Cache(cache_bytes)
        self.buffer_size = max(-(-buffer_size // n_envs), 1)
        # One more slot for each episode, one for an episode cut off by the ring's end and one for
        # the turn that waits for its successor.
        self.slots = self.buffer_size + -(-self.buffer_size // EPISODE) + 2
        self._allocate(stored)
        self.reset()

    def _allocate(self, stored: tuple[str, ...]) -> None:
        """Make the arrays; memory is taken only as it is written to."""
        def ring(*shape, dtype):
            return np.zeros((self.slots, self.n_envs, *shape), dtype)

        self.scenes, self.counts = ring(dtype=np.int32), ring(dtype=np.int32)
        self.observed = ring(self.words, dtype=np.uint64)
        self.positions = ring(self.action_space.shape[0], 3, dtype=np.float32)
        self.actions = ring(self.action_dim, dtype=np.float32)
        self.rewards = ring(dtype=np.float32)
        self.dones, self.timeouts, self.starts = (ring(dtype=bool) for _ in range(3))
        self.stored = {}
        for key in stored:
            space = self.observation_space[key]
            floating = np.issubdtype(space.dtype, np.floating)
            self.stored[key] = ring(*space.shape, dtype=np.float16 if floating else space.dtype)

    def reset(self) -> None:
        """Forget all turns."""
        self.pos = np.zeros(self.n_envs, dtype=np.int64)
        self.full = np.zeros(self.n_envs, dtype=bool)
        # Whether the turn written last waits for the one after it.
        self.waiting = np.zeros(self.n_envs, dtype=bool)
        self.starts[:] = False
        self.cache.clear()

    @property
    def nbytes(self) -> int:
        """Return the bytes of all arrays when they are full; the cache comes on top."""
        return _size(self.stored) + _size(
            {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)})

    def size(self) -> int:
        """Return the number of transitions."""
        return int(np.count_nonzero(self.starts))

    def add(self, obs: dict[str, np.ndarray], next_obs: dict[str, np.ndarray], action: np.ndarray,
            reward: np.ndarray, done: np.ndarray, infos: Sequence[dict[str, Any]]) -> None:
        """
        Store one transition of every environment.

        :param obs: encoded observations, batched; only the keys in ``stored`` are read.
        :param next_obs: those after the transitions, at an episode's end those before its reset.
        :param action: (E, K, 2) or (E, 2 K).
        :param reward: (E,).
        :param done: (E,) bool, whether the episode ended, be it by truncation.
        :param infos: for each environment, with ``before`` and ``after``: :class:`Known`.
        :raises ValueError: if what is known is not told, or does not fit.
        """
        known = [self._checked(info) for info in infos]
        for env, (before, after) in enumerate(known):
            if not (self.waiting[env] and self._is_last(env, before)):
                self._write(env, before, obs)
            start = (self.pos[env] - 1) % self.slots, env
            self._write(env, after, next_obs)
            self.actions[start] = np.asarray(action[env]).reshape(-1)
            self.rewards[start], self.dones[start] = reward[env], done[env]
            self.timeouts[start] = (self.handle_timeout_termination
                                    and infos[env].get('TimeLimit.truncated', False))
            self.starts[start] = True
            self.waiting[env] = not done[env]

    def _checked(self, info: dict[str, Any]) -> tuple[Known, Known]:
        """Return what is known before and after a transition."""
        if not {'before', 'after'} <= info.keys():
            raise ValueError(f'infos: found {sorted(info)}; expected before and after among them; '
                             'let the environment put there what is known')
        for known in (info['before'], info['after']):
            if known.positions.shape != self.positions.shape[2:]:
                raise ValueError(f'positions: found shape {known.positions.shape}; expected '
                                 f'{self.positions.shape[2:]}, a row for each camera that acts')
        return info['before'], info['after']

    def _is_last(self, env: int, known: Known) -> bool:
        """Tell whether the turn written last in an environment is the given one."""
        last = self._known((self.pos[env] - 1) % self.slots, env)
        return (last.scene == known.scene and np.array_equal(last.observed, known.observed)
                and np.array_equal(last.positions, known.positions.astype(np.float32),
                                   equal_nan=True))

    def _known(self, slot: int, env: int) -> Known:
        """Return what is stored in a slot."""
        at = slot, env
        return Known(int(self.scenes[at]), self.observed[at][:self.counts[at]].copy(),
                     self.positions[at].copy())

    def _write(self, env: int, known: Known, observation: dict[str, np.ndarray]) -> None:
        """Write a turn, which begins no transition yet, to the next slot."""
        slot = int(self.pos[env])
        at = slot, env
        self.make_room_for(len(known.observed))
        self.cache.drop(at)
        self.starts[at] = False
        self.scenes[at], self.counts[at] = known.scene, len(known.observed)
        self.observed[at][:len(known.observed)] = known.observed
        self.positions[at] = known.positions
        for key, values in self.stored.items():
            values[at] = observation[key][env]
        self.pos[env] = (slot + 1) % self.slots
        self.full[env] |= self.pos[env] == 0

    def make_room_for(self, words: int) -> None:
        """Make room for scenes of so many words of bits, if there is none yet."""
        if words <= self.words:
            return
        written = self.slots if self.full.any() else int(self.pos.max())
        wider = np.zeros((*self.observed.shape[:2], words), dtype=np.uint64)
        wider[:written, :, :self.words] = self.observed[:written]
        self.observed, self.words = wider, words

    def sample(self, batch_size: int, env=None) -> DictReplayBufferSamples:
        """
        Draw a batch and one symmetry per transition.

        :param batch_size: B.
        :param env: stable-baselines3's normalization, or None.
        :raises ValueError: if there is no transition yet.
        """
        return symmetric(self._get_samples(self._draw(batch_size), env))

    def _draw(self, count: int) -> np.ndarray:
        """Draw transitions, each as likely: (count,) int64 indices of slots and environments."""
        if not self.starts.any():
            raise ValueError('replay: found no transition; expected at least one; add before '
                             'sampling')
        written = self.slots if self.full.any() else int(self.pos.max())
        drawn = np.empty(0, dtype=np.int64)
        # Nearly all slots begin a transition, so drawing again is cheaper than to list those.
        while len(drawn) < count:
            more = np.random.randint(written * self.n_envs, size=count)
            drawn = np.concatenate([drawn, more[self.starts.reshape(-1)[more]]])
        return drawn[:count]

    def _get_samples(self, batch_inds: np.ndarray, env=None) -> DictReplayBufferSamples:
        """Return given transitions as they are."""
        slots, envs = np.divmod(batch_inds, self.n_envs)
        at = slots, envs
        ended = self.dones[at] & ~self.timeouts[at]
        observations, next_observations = (
            {key: self.to_torch(values, copy=False) for key, values in
             self._normalize_obs(  # type: ignore[union-attr]
                 self._observations(of, envs), env).items()}
            for of in (slots, (slots + 1) % self.slots))
        return DictReplayBufferSamples(
            observations=observations, actions=self.to_torch(self.actions[at], copy=False),
            next_observations=next_observations,
            dones=self.to_torch(ended.astype(np.float32).reshape(-1, 1), copy=False),
            rewards=self.to_torch(
                self._normalize_reward(self.rewards[at].reshape(-1, 1), env), copy=False))

    def _observations(self, slots: np.ndarray, envs: np.ndarray) -> dict[str, np.ndarray]:
        """Return the encoded observations of some turns, batched."""
        turns = [self._rebuilt(at) for at in zip(slots.tolist(), envs.tolist())]
        stored = {key: values[slots, envs] for key, values in self.stored.items()}
        return {**{key: np.stack([turn[key] for turn in turns]) for key in turns[0]},
                **{key: values.astype(np.float32) if values.dtype == np.float16 else values
                   for key, values in stored.items()}}

    def _rebuilt(self, at: tuple[int, int]) -> dict[str, np.ndarray]:
        """Return the rebuilt arrays of a turn."""
        arrays = self.cache.get(at)
        if arrays is None:
            arrays = self.rebuild(self._known(*at))
            expected = self.observation_space.spaces.keys() - self.stored.keys()
            if arrays.keys() != expected:
                raise ValueError(f'rebuild: found the keys {sorted(arrays)}; expected '
                                 f'{sorted(expected)}; name the others in stored')
            self.cache.put(at, arrays)
        return arrays
