# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How fast training in one process is: what training over ROS is compared with."""

from collections.abc import Iterable
import multiprocessing
import os
from pathlib import Path
import time
from typing import NamedTuple

from stable_baselines3.common.logger import configure

from ocp_ros.agent.checkpoint import Checkpoint
from ocp_ros.training.sac import load_actor, make_sac
from ocp_ros.training.train import environments
from ocp_ros.training.training_config import RoomsConfig, SacConfig, TrainingConfig
from ocp_ros.training.training_rooms import room_names
from ocp_ros.util.resources import find_model


class Speed(NamedTuple):
    """
    How fast something learns.

    :ivar interactions: per second, each with its gradient step.
    :ivar cpu: milliseconds of the processor that one takes, in all processes together. Other
        programs change it less than they change the time on the wall.
    """

    interactions: float
    cpu: float

    @classmethod
    def of(cls, count: int, seconds: float, cpu: float) -> 'Speed':
        """Return that of so many interactions in seconds on the wall and of the processor."""
        return cls(count / seconds, 1e3 * cpu / max(count, 1))


def cpu_of(pids: Iterable[int]) -> float:
    """Return the seconds of the processor that processes have taken."""
    ticks = 0
    for pid in pids:
        # The name, in parentheses, may hold anything.
        fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf('SC_CLK_TCK')


def in_one_process(count: int, seconds: float, starts: int) -> Speed:
    """
    Let soft actor-critic learn as ``ocp train`` does, in rooms of the nodes' defaults.

    :param count: of environments, each in a room of its own and played by a process of its own.
    :param seconds: to measure.
    :param starts: interactions before the first gradient step; after as many more, time is taken.
    """
    config = TrainingConfig(
        environments=count, rooms=RoomsConfig(training=count, points=15000, rotations='0'),
        sac=SacConfig(learning_starts=starts, device='cpu'))
    model = make_sac(config.sac, config.agent, 1, environments=count, train_freq=1,
                     gradient_steps=count)
    load_actor(model, Checkpoint.load(find_model('moves')))
    model.warm = True
    model.set_logger(configure(None, []))
    model.set_env(environments(config, room_names(config.rooms, 'training')))
    try:
        model.learn(2 * starts)
        pids = [os.getpid(), *(child.pid for child in multiprocessing.active_children())]
        began, first, cpu = time.monotonic(), model.num_timesteps, cpu_of(pids)
        while time.monotonic() - began < seconds:
            model.learn(10 * count, reset_num_timesteps=False)
        return Speed.of(model.num_timesteps - first, time.monotonic() - began, cpu_of(pids) - cpu)
    finally:
        model.env.close()
