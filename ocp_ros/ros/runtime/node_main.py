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
What every node's ``main`` does: start, spin, and end with code 0 when they are told to.

A node handles its signals itself. The handlers of rclpy wake the executor from a native thread,
which reads the list of guard conditions without a lock (``rclpy/src/rclpy/signal_handler.cpp``,
``trigger_guard_conditions``). Where the machine is busy, that thread runs late, when the executor
has taken its guard condition out of the list and freed both: the process dies of SIGSEGV, whatever
the main thread does at that moment. ``make endings`` looks for such crashes.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import ctypes
import faulthandler
import logging
import os
import signal
import sys
from types import FrameType

from ocp_ros.policy.agent_config import CheckpointError
from ocp_ros.ros.runtime.network import stay_local
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.settings import ConfigurationError
import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

#: Ctrl-C, a polite kill, and a terminal that is closed.
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Environment variable with the process id of who started a node that ends with it.
PARENT = 'OCP_ROS_PARENT'
#: Seconds after which an idle executor looks for signals.
LOOK = 0.1
#: Seconds that the middleware has to take a node down: ``ros2 launch`` kills 10 s after Ctrl-C.
PATIENCE = 3.0
#: Number of the file of errors, whatever ``sys.stderr`` is at the moment.
STDERR = 2
#: ``PR_SET_PDEATHSIG`` of prctl(2).
DEATH_SIGNAL = 1
#: Packages that make kernels.
COMPILERS = ('numba', 'llvmlite')
#: What rclpy raises where it cannot read its arguments, or cannot start.
REFUSALS = (rclpy_implementation.RCLError, rclpy_implementation.RCLInvalidROSArgsError)
#: What a user can put right: told in one sentence, exit code 2.
USER_ERRORS = (CheckpointError, ConfigurationError, SceneError, FileNotFoundError,
               InvalidParameterTypeException, InvalidParameterValueException)


def ignore_signals() -> None:
    """Let nothing interrupt this process any more."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Let nothing interrupt a block."""
    before = {number: signal.getsignal(number) for number in ENDING}
    ignore_signals()
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def about_security(error: Exception) -> bool:
    """Return whether ROS has refused to start a node that was to be kept safe."""
    return isinstance(error, rclpy_implementation.RCLError) and 'security' in str(error).lower()


def refusal(error: Exception) -> str:
    """Return in one sentence why ROS has refused to start a node."""
    words = ' '.join(str(error).split())
    if about_security(error):
        return (f'found that ROS cannot keep it safe, as ROS_SECURITY_ENABLE asks ({words}); '
                'expected a ROS 2 with SROS 2 (the one from apt, not that from PyPI) and its keys '
                'in a keystore; see docs/tasks/secure_nodes.md')
    return (f'found ROS arguments that cannot be read ({words}); '
            'expected -p name:=value or --params-file FILE')


def end_with_parent() -> None:
    """Let this process be told to end when its parent dies, where the parent asks for it."""
    parent = os.environ.get(PARENT)
    if parent is None or sys.platform != 'linux':
        return
    ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGTERM)
    if str(os.getppid()) != parent:
        # It has died already.
        os.kill(os.getpid(), signal.SIGTERM)


def compiling(frame: FrameType | None) -> bool:
    """Return whether a frame is of the compiler, or called by it: errors would be its end."""
    while frame is not None:
        if str(frame.f_globals.get('__name__')).partition('.')[0] in COMPILERS:
            return True
        frame = frame.f_back
    return False


def interrupt_on_signals() -> list[int]:
    """
    Raise KeyboardInterrupt at the first signal that ends a node, and ignore those that follow.

    While kernels are compiled or read, nothing is raised: native code that calls Python back would
    go on with what is not there. Whoever spins looks for the signal.

    :returns: a list that gets the number of that signal.
    """
    received: list[int] = []

    def interrupt(number, frame):
        # What is saved from here on must not be lost to a second Ctrl-C.
        ignore_signals()
        received.append(number)
        if not compiling(frame):
            raise KeyboardInterrupt

    for number in ENDING:
        # nohup ignores SIGHUP before a node starts, and so it stays.
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, interrupt)
    return received


def spin(executor: SingleThreadedExecutor, received: list[int]) -> None:
    """
    Spin until a signal comes.

    A wait in native code ends often enough to notice it. An interrupt in the middle of a compiled
    kernel becomes another error, which whoever called the kernel may take for one of its own.

    :param received: gets the number of the signal.
    """
    while not received:
        executor.spin_once(timeout_sec=LOOK)


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """
    Run one node until it is told to stop.

    What the node has to save is saved first, by its ``stop`` where it has one; then ROS is taken
    down.

    :param make_node: builds the node.
    :param args: command line, None for that of the process.
    :returns: exit code.
    """
    # What the engine has to say, such as how a large scan was thinned.
    logging.basicConfig(format='[%(levelname)s] [%(name)s]: %(message)s')
    logging.getLogger('ocp_ros').setLevel(logging.INFO)
    logging.captureWarnings(True)
    name, node, executor = make_node.__name__, None, None
    received, code = interrupt_on_signals(), 2
    try:
        alone = stay_local()
        end_with_parent()
        left = remove_ros_args(sys.argv if args is None else ['', *args])[1:]
        if left:
            print(f'{name}: found the arguments {" ".join(left)}; expected parameters '
                  'after --ros-args, such as --ros-args -p name:=value', file=sys.stderr)
            return code
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        executor = SingleThreadedExecutor()
        node = make_node()
        if alone:
            node.get_logger().info('nodes of this machine are heard, and no others; '
                                   'ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET reaches farther')
        executor.add_node(node)
        spin(executor, received)
        code = 0
    except (KeyboardInterrupt, ExternalShutdownException):
        code = 0
    except USER_ERRORS as error:
        print(f'{name}: {error}', file=sys.stderr)
    except Exception as error:
        if isinstance(error, REFUSALS) and executor is None or about_security(error):
            print(f'{name}: {refusal(error)}', file=sys.stderr)
        elif rclpy.ok() and not received:
            code = 1
            raise
        else:
            # A signal comes at any moment: in the middle of a conversion, which turns the
            # interrupt into another error, or while somebody shuts the context down.
            code = 0
    finally:
        ignore_signals()
        take_down(node, executor)
    return code


def take_down(node: Node | None, executor: SingleThreadedExecutor | None) -> None:
    """
    Save what a node has to save, then end executor, node and context, in this order.

    Fast DDS 2.14 may wait for ever while it takes down a participant at the moment that another
    one leaves (``DomainParticipantImpl::set_listener``): it waits until no callback runs, by
    taking and releasing a lock in a tight loop, and the callback waits for that same lock. rclpy
    keeps the interpreter's lock meanwhile. A thread in C writes the stacks and ends the process
    then, with exit code 1.
    """
    try:
        if hasattr(node, 'stop'):
            node.stop()
    finally:
        # What was printed is not lost: the process may end without finalisers.
        sys.stdout.flush()
        faulthandler.dump_traceback_later(PATIENCE, exit=True, file=STDERR)
        if executor is not None:
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()
