# SPDX-License-Identifier: Apache-2.0
"""What every node's ``main`` does: start, spin, and end with code 0 when they are told to."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import logging
import os
import signal
import sys

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from ocp_ros.agent.errors import CheckpointError
from ocp_ros.configuration import ConfigurationError
from ocp_ros.nodes.network import stay_local
from ocp_ros.scenes.scene import SceneError

#: Ctrl-C, a polite kill, and a terminal that is closed.
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
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
    """Tell whether ROS has refused to start a node that was to be kept safe."""
    return isinstance(error, rclpy_implementation.RCLError) and 'security' in str(error).lower()


def refusal(error: Exception) -> str:
    """Return in one sentence why ROS has refused to start a node."""
    words = ' '.join(str(error).split())
    if about_security(error):
        return (f'found that ROS cannot keep it safe, as ROS_SECURITY_ENABLE asks ({words}); '
                'expected a ROS 2 with SROS 2 (the one from apt, not that from PyPI) and its keys '
                'in a keystore; see docs/ros.md, Security')
    return (f'found ROS arguments that cannot be read ({words}); '
            'expected -p name:=value or --params-file FILE')


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """
    Run one node until it is told to stop.

    :param make_node: builds the node.
    :param args: command line, None for that of the process.
    :returns: exit code.
    """
    # What the engine has to say, such as how a large scan was thinned.
    logging.basicConfig(format='[%(levelname)s] [%(name)s]: %(message)s')
    logging.getLogger('ocp_ros').setLevel(logging.INFO)
    logging.captureWarnings(True)
    name, node, interrupts, alone = make_node.__name__, None, [], stay_local()

    def interrupt(number, frame):
        interrupts.append(number)
        raise KeyboardInterrupt

    # Before rclpy sets its own handler, which calls this one.
    signal.signal(signal.SIGINT, interrupt)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        # A terminal that is closed ends a node like any other who tells it to; nohup does not.
        signal.signal(signal.SIGHUP, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    try:
        left = remove_ros_args(sys.argv if args is None else ['', *args])[1:]
        rclpy.init(args=args)
    except (rclpy_implementation.RCLError,
            rclpy_implementation.RCLInvalidROSArgsError) as error:
        print(f'{name}: {refusal(error)}', file=sys.stderr)
        return 2
    if left:
        print(f'{name}: found the arguments {" ".join(left)}; expected parameters '
              'after --ros-args, such as --ros-args -p name:=value', file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    executor = SingleThreadedExecutor()
    try:
        node = make_node()
        if alone:
            node.get_logger().info('nodes of this machine are heard, and no others; '
                                   'ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET reaches farther')
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except USER_ERRORS as error:
        print(f'{name}: {error}', file=sys.stderr)
        return 2
    except Exception as error:
        if about_security(error):
            print(f'{name}: {refusal(error)}', file=sys.stderr)
            return 2
        # A signal comes at any moment: in the middle of a callback, where the context is gone from
        # one line to the next, or of a conversion, which turns the interrupt into another error.
        if rclpy.ok() and not interrupts:
            raise
    finally:
        # The process ends here: a second Ctrl-C must not lose what was learned.
        ignore_signals()
        executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        # rclpy has put back the handlers that it had found.
        ignore_signals()
    return 0
