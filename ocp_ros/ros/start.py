# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the scripts of the nodes call: a signal that comes while modules are imported ends in peace.

The imports take a second or more; a Ctrl-C in the middle of them would be a page of traceback.
From then on :mod:`ocp_ros.ros.runtime.node_main` handles the signals.
"""

from importlib import import_module
import os
import signal

#: Ctrl-C and a polite kill.
EARLY = (signal.SIGINT, signal.SIGTERM)


def _started(module: str) -> int:
    """Import a node and run it."""
    for number in EARLY:
        # Nothing has begun yet that would have to be ended, and some libraries take an error that
        # is raised while they are imported for one of their own.
        signal.signal(number, lambda *_: os._exit(0))
    return import_module(f'ocp_ros.ros.{module}').main()


def sim_node() -> int:
    """Run ``sim_node``."""
    return _started('sim_node')


def policy_node() -> int:
    """Run ``policy_node``."""
    return _started('policy_node')


def trainer_node() -> int:
    """Run ``trainer_node``."""
    return _started('trainer_node')
