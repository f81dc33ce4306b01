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
Entry points of the node scripts: start and end fast, and without a traceback on Ctrl-C.

Imports take a second or more, and a Ctrl-C during them would print a page of traceback. After the
imports :mod:`ocp_ros.ros.runtime.node_main` handles the signals. When it has saved all data and
shut ROS down, the process ends at once: the interpreter would take up to a second of processor
time to free memory that the system frees anyway, and ``ros2 launch`` on a busy machine does not
wait for that.
"""

from importlib import import_module
import logging
import os
import signal
import sys
from typing import NoReturn

from ocp_ros.util.settings import ConfigurationError, need

#: Packages of extras that a node needs.
NEEDED = {'trainer_node': ('stable_baselines3', 'gymnasium', 'tensorboard'),
          'guide_node': ('viser',)}


def _run_and_exit(module_name: str) -> NoReturn:
    """Import a module of this package, run its node, and end the process with its exit code."""
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        # A signal during the import ends the process at once: nothing has to be saved yet. A
        # handler that raises an error does not suffice: some libraries catch all errors of their
        # imports.
        signal.signal(signal_number, lambda *_: os._exit(0))
    try:
        need(module_name, *NEEDED.get(module_name, ()))
        exit_code = import_module(f'ocp_ros.ros.{module_name}').main()
    except ConfigurationError as error:
        print(error, file=sys.stderr)
        exit_code = 2
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(exit_code)


def sim_node() -> NoReturn:
    """Run ``sim_node``."""
    _run_and_exit('sim_node')


def policy_node() -> NoReturn:
    """Run ``policy_node``."""
    _run_and_exit('policy_node')


def trainer_node() -> NoReturn:
    """Run ``trainer_node``."""
    _run_and_exit('trainer_node')


def guide_node() -> NoReturn:
    """Run ``guide_node``."""
    _run_and_exit('guide_node')
