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
The ``main`` of every node: start, spin, and end with exit code 0 on a signal.

A node handles its signals itself. The handlers of rclpy wake the executor from a native thread,
which reads the list of guard conditions without a lock (``rclpy/src/rclpy/signal_handler.cpp``,
``trigger_guard_conditions``). On a busy machine that thread may run after the executor has removed
its guard condition from the list and freed both. The process then dies of SIGSEGV, whatever the
main thread does. ``make endings`` looks for such crashes.
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
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.resources import share_folder
from ocp_ros.util.settings import ConfigurationError
import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

#: Ctrl-C, a plain ``kill``, and a closed terminal.
END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Environment variable with the id of the parent process with which a node shall end.
PARENT_VARIABLE = 'OCP_ROS_PARENT'
#: Seconds for the middleware to shut a node down: ``ros2 launch`` kills it 10 s after Ctrl-C.
SHUTDOWN_TIMEOUT_S = 3.0
LOCALHOST_ENVIRONMENT = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
#: Variables by which the user may have set the range of discovery or the transport.
USER_VARIABLES = ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_LOCALHOST_ONLY', 'ROS_DISCOVERY_SERVER',
                  'FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE',
                  'FASTDDS_BUILTIN_TRANSPORTS', 'CYCLONEDDS_URI')


def local_transport() -> dict[str, str]:
    """
    Return the environment variables that limit nodes to this machine.

    With Fast DDS, messages go by UDP and not by shared memory, for two reasons. A killed node
    keeps the segments that it was reading, until the other nodes have no shared memory left for
    clouds. And a living node may die of SIGSEGV when it ends
    (``SharedMemChannelResource::release``, once in about 700 endings beside killed nodes). Nodes
    that use shared memory are still received, by UDP. Peers in
    ``ROS_STATIC_PEERS`` may be on other machines, which this UDP does not reach.
    """
    middleware = os.environ.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps'
    if not middleware.startswith('rmw_fastrtps') or os.environ.get('ROS_STATIC_PEERS'):
        return LOCALHOST_ENVIRONMENT
    # The file limits the nodes to this machine, so ROS sets no range of its own (SYSTEM_DEFAULT).
    return {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
            'FASTRTPS_DEFAULT_PROFILES_FILE': str(share_folder() / 'config' / 'fastdds_local.xml')}


def stay_local() -> bool:
    """
    Limit this process to its machine, unless a variable of ``USER_VARIABLES`` is set.

    Nodes on this machine are found whatever their own range is. Call it before ``rclpy.init``.

    :returns: whether it was limited: no variable was set.
    """
    # Fast DDS would read a file of the current folder as the user's profile.
    os.environ.setdefault('SKIP_DEFAULT_XML_FILE', '1')
    if any(os.environ.get(name) for name in USER_VARIABLES):
        return False
    os.environ.update(local_transport())
    return True


def ignore_signals() -> None:
    """Ignore the signals of ``END_SIGNALS`` from now on."""
    for signal_number in END_SIGNALS:
        signal.signal(signal_number, signal.SIG_IGN)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore the signals of ``END_SIGNALS`` within a ``with`` block."""
    old_handlers = {number: signal.getsignal(number) for number in END_SIGNALS}
    ignore_signals()
    try:
        yield
    finally:
        for signal_number, handler in old_handlers.items():
            signal.signal(signal_number, handler)


def is_security_error(error: Exception) -> bool:
    """Return whether ROS refused to start a node because it cannot enable security (SROS 2)."""
    return isinstance(error, rclpy_implementation.RCLError) and 'security' in str(error).lower()


def explain_refusal(error: Exception) -> str:
    """Return in one sentence why ROS refused to start a node: its security or its arguments."""
    text = ' '.join(str(error).split())
    if is_security_error(error):
        return (f'found that ROS cannot keep it safe, as ROS_SECURITY_ENABLE asks ({text}); '
                'expected a ROS 2 with SROS 2 (the one from apt, not that from PyPI) and its keys '
                'in a keystore; see docs/tasks/secure_nodes.md')
    return (f'found ROS arguments that cannot be read ({text}); '
            'expected -p name:=value or --params-file FILE')


def end_with_parent() -> None:
    """End this process (SIGTERM) when its parent dies, if ``PARENT_VARIABLE`` is set."""
    parent = os.environ.get(PARENT_VARIABLE)
    if parent is None or sys.platform != 'linux':
        return
    # Option 1 of prctl(2) is PR_SET_PDEATHSIG.
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if str(os.getppid()) != parent:
        # The parent has died already.
        os.kill(os.getpid(), signal.SIGTERM)


def is_compiling(frame: FrameType | None) -> bool:
    """Return whether kernels are being compiled: the frame or a caller is in the compiler."""
    while frame is not None:
        # These packages compile the numerical kernels.
        if str(frame.f_globals.get('__name__')).partition('.')[0] in ('numba', 'llvmlite'):
            return True
        frame = frame.f_back
    return False


def interrupt_on_signals() -> list[int]:
    """
    Raise KeyboardInterrupt at the first signal of ``END_SIGNALS``, and ignore later signals.

    While kernels are compiled or loaded, nothing is raised: native code that calls Python would
    continue with missing data. The loop in :func:`spin` checks the returned list instead.

    :returns: an empty list, to which the number of that signal is appended.
    """
    received: list[int] = []

    def interrupt(signal_number: int, frame: FrameType | None) -> None:
        # A second Ctrl-C must not interrupt the saving of data that follows.
        ignore_signals()
        received.append(signal_number)
        if not is_compiling(frame):
            raise KeyboardInterrupt

    for signal_number in END_SIGNALS:
        # nohup sets SIGHUP to ignored before a node starts; keep it ignored.
        if signal_number != signal.SIGHUP or signal.getsignal(signal_number) is not signal.SIG_IGN:
            signal.signal(signal_number, interrupt)
    return received


def spin(executor: SingleThreadedExecutor, received: list[int]) -> None:
    """
    Spin until a signal comes, which is checked ten times a second.

    The KeyboardInterrupt alone is not enough: within a compiled kernel it becomes another error,
    which the caller of the kernel may catch as its own.

    :param received: the list that :func:`interrupt_on_signals` has returned.
    """
    while not received:
        executor.spin_once(timeout_sec=0.1)


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """
    Run one node until a signal ends it.

    At the end the node saves its data with its method ``stop``, if it has one; then ROS is shut
    down.

    :param make_node: builds the node.
    :param args: command line, None for that of the process.
    :returns: exit code.
    """
    # Show log messages of the engine, such as how a large scan was thinned.
    logging.basicConfig(format='[%(levelname)s] [%(name)s]: %(message)s')
    logging.getLogger('ocp_ros').setLevel(logging.INFO)
    logging.captureWarnings(True)
    name = make_node.__name__
    node = executor = None
    received = interrupt_on_signals()
    # The exit code of errors that the user can correct.
    exit_code = 2
    try:
        # Limit the range of discovery, and refuse unknown arguments.
        limited_to_machine = stay_local()
        end_with_parent()
        other_arguments = remove_ros_args(sys.argv if args is None else ['', *args])[1:]
        if other_arguments:
            print(f'{name}: found the arguments {" ".join(other_arguments)}; expected parameters '
                  'after --ros-args, such as --ros-args -p name:=value', file=sys.stderr)
            return exit_code
        # Start ROS and the node, and spin until a signal comes.
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        executor = SingleThreadedExecutor()
        node = make_node()
        if limited_to_machine:
            node.get_logger().info('nodes of this machine are heard, and no others; '
                                   'ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET reaches farther')
        executor.add_node(node)
        spin(executor, received)
        exit_code = 0
    except (KeyboardInterrupt, ExternalShutdownException):
        exit_code = 0
    except (CheckpointError, ConfigurationError, SceneError, FileNotFoundError,
            InvalidParameterTypeException, InvalidParameterValueException) as error:
        # The user can correct these errors.
        print(f'{name}: {error}', file=sys.stderr)
    except Exception as error:
        # Errors of rclpy when it cannot read its arguments or cannot start.
        start_errors = (rclpy_implementation.RCLError, rclpy_implementation.RCLInvalidROSArgsError)
        if (isinstance(error, start_errors) and executor is None) or is_security_error(error):
            print(f'{name}: {explain_refusal(error)}', file=sys.stderr)
        elif rclpy.ok() and not received:
            raise
        else:
            # A signal can come at any moment: during a message conversion, which turns the
            # interrupt into another error, or while the context is shut down.
            exit_code = 0
    finally:
        ignore_signals()
        shut_down_node(node, executor)
    return exit_code


def shut_down_node(node: Node | None, executor: SingleThreadedExecutor | None) -> None:
    """
    Save the data of a node, then end the executor, the node and the context, in this order.

    Fast DDS 2.14 may wait for ever when it shuts down a participant while another participant
    leaves (``DomainParticipantImpl::set_listener``): it takes and releases a lock in a tight loop
    until no callback runs, and the callback waits for the same lock. No Python code runs
    meanwhile. Therefore, after ``SHUTDOWN_TIMEOUT_S``, a thread in C writes the stacks of all
    threads and ends the process with exit code 1.
    """
    try:
        if hasattr(node, 'stop'):
            node.stop()
    finally:
        # Flush the output: the process may end without finalisers.
        sys.stdout.flush()
        # File descriptor 2 is standard error, even if ``sys.stderr`` is replaced.
        faulthandler.dump_traceback_later(SHUTDOWN_TIMEOUT_S, exit=True, file=2)
        if executor is not None:
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()
