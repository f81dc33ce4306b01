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

"""What every node's ``main`` does when its end comes at an awkward moment."""

from contextlib import suppress
import os
from pathlib import Path
import select
import signal
import subprocess
import sys

from conftest import HUNG, run_python
from ocp_ros.demo.watched_nodes import free_domain
from ocp_ros.ros.runtime.node_main import run, stay_local, undisturbed, USER_VARIABLES
from ocp_ros.scenes.scene import SceneError
import pytest
import rclpy
from rclpy.node import Node
from rclpy.signals import get_current_signal_handlers_options, SignalHandlerOptions
from std_msgs.msg import Float64


@pytest.fixture(autouse=True)
def in_domain(domain, monkeypatch):
    """Use the test's own domain: ``run`` initialises the default context."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
    # ``run`` ends deaf to signals, as the process is to end with it; this one is not.
    with undisturbed():
        yield


def test_a_signal_while_a_node_publishes_ends_it_with_0():
    def make_node():
        publisher = Node('ending').create_publisher(Float64, 'number', 1)
        rclpy.shutdown()
        publisher.publish(Float64())

    assert run(make_node, []) == 0
    assert not rclpy.ok()


INTERRUPTED = """
import signal, sys
from ocp_ros.ros.runtime.node_main import run

def make_node():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise RuntimeError('unable to convert') from None

sys.exit(run(make_node, []))
"""


def test_an_interrupt_that_a_library_turns_into_another_error_ends_it_with_0():
    # In a process of its own: rclpy shuts its context down from another thread, at its leisure.
    done = run_python(INTERRUPTED)
    assert done.returncode == 0, done.stderr


def called_at_once(node, callback):
    """Return a node with a timer that is due."""
    node.create_timer(0.0, callback)
    return node


def test_no_native_thread_handles_signals_and_all_is_saved_before_ros_is_taken_down():
    seen = []

    class Saving(Node):

        def stop(self):
            seen.extend([get_current_signal_handlers_options(), rclpy.ok(),
                         self.count_publishers('a')])
            # An impatient user.
            signal.raise_signal(signal.SIGINT)
            seen.append('saved')

    assert run(lambda: called_at_once(
        Saving('saving'), lambda: signal.raise_signal(signal.SIGTERM)), []) == 0
    assert seen == [SignalHandlerOptions.NO, True, 0, 'saved'] and not rclpy.ok()


def test_an_interrupt_that_a_callback_takes_for_an_error_of_its_own_ends_a_node():
    def callback():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    assert run(lambda: called_at_once(Node('deaf'), callback), []) == 0


#: Waits in native code that keeps the interpreter's lock.
STUCK = """
import ctypes
from ocp_ros.ros.runtime import node_main

class Stuck:
    def destroy_node(self):
        ctypes.PyDLL(None).sleep(1000)

node_main.SHUTDOWN_TIMEOUT_S = 0.2
print('saved')
node_main.shut_down_node(Stuck(), None)
print('not here')
"""


def test_native_code_that_never_returns_keeps_no_process():
    done = run_python(STUCK)
    assert 'in destroy_node' in done.stderr
    assert (done.returncode, done.stdout) == (1, 'saved\n'), done.stderr


#: Starts a node, tells its process id, and waits to be killed.
PARENT = """
import sys
from pathlib import Path
from ocp_ros.demo.watched_nodes import free_domain, NodeProcess

domain, holder = free_domain()
node = NodeProcess('policy_node', domain, Path(sys.argv[1]), {})
# From here on the node alone holds it.
holder.close()
print(domain, node.process.pid, flush=True)
sys.stdin.read()
"""


@pytest.mark.system
@pytest.mark.parametrize('early', [True, False])
def test_a_node_ends_with_its_parent_and_keeps_its_domain_until_then(tmp_path, early):
    log = tmp_path / 'log'
    parent = subprocess.Popen([sys.executable, '-c', PARENT, str(log)], text=True,
                              stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    taken, pid = map(int, parent.stdout.readline().split())
    ended = os.pidfd_open(pid)
    while not early and 'weights' not in log.read_text():
        assert not select.select([ended], [], [], 0.05)[0], log.read_text()
    domain, holder = free_domain()
    holder.close()
    assert domain != taken
    parent.kill()
    parent.communicate()
    assert select.select([ended], [], [], HUNG)[0], 'the node lives on'
    os.close(ended)


def test_any_other_error_of_the_middleware_is_not_hidden():
    from rclpy.impl.implementation_singleton import rclpy_implementation

    def make_node():
        raise rclpy_implementation.RCLError('something else')

    with pytest.raises(rclpy_implementation.RCLError, match='something else'):
        run(make_node, [])
    assert not rclpy.ok()


def test_what_a_user_can_put_right_is_told_in_one_sentence(capsys):
    def make_node():
        raise SceneError('room.ply: found nothing; expected points')

    assert run(make_node, []) == 2
    assert capsys.readouterr().err == 'make_node: room.ply: found nothing; expected points\n'


@pytest.mark.parametrize('arguments', [
    ['-p', 'a:=3'], ['--ros-args', '-p', 'a=3'], ['--ros-args', '--params-file', 'nowhere.yaml']])
def test_arguments_that_ros_would_ignore_or_choke_on_are_refused(capsys, arguments):
    assert run(Node, arguments) == 2
    assert arguments[-1] in capsys.readouterr().err


def test_a_node_that_cannot_be_kept_safe_is_not_started(tmp_path, monkeypatch, capsys):
    for name, value in (('ENABLE', 'true'), ('STRATEGY', 'Enforce'), ('KEYSTORE', str(tmp_path))):
        monkeypatch.setenv(f'ROS_SECURITY_{name}', value)
    assert run(lambda: Node('open'), []) == 2
    # A keystore with an enclave, but without its keys.
    (tmp_path / 'enclaves' / 'ocp').mkdir(parents=True)
    assert run(lambda: Node('keyless'), ['--ros-args', '--enclave', '/ocp']) == 2
    assert not rclpy.ok()
    err = capsys.readouterr().err
    assert err.count('keep it safe') == 2 and 'Traceback' not in err


@pytest.mark.parametrize(('said', 'value', 'alone', 'reach'), [
    (None, '', True, 'SYSTEM_DEFAULT'),
    ('RMW_IMPLEMENTATION', 'rmw_cyclonedds_cpp', True, 'LOCALHOST'),
    ('ROS_STATIC_PEERS', '192.168.0.7', True, 'LOCALHOST'),
    ('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET', False, 'SUBNET'),
    ('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4', False, ''),
    ('FASTRTPS_DEFAULT_PROFILES_FILE', 'mine.xml', False, '')])
def test_nobody_outside_this_machine_is_heard_unless_asked(monkeypatch, said, value, alone,
                                                           reach):
    # Set and taken away again, for what is looked at here is not put back otherwise.
    for name in (*USER_VARIABLES, 'RMW_IMPLEMENTATION', 'ROS_STATIC_PEERS'):
        monkeypatch.setenv(name, '')
    if said:
        monkeypatch.setenv(said, value)
    assert stay_local() is alone
    assert os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] == reach
    profiles = os.environ['FASTRTPS_DEFAULT_PROFILES_FILE']
    # Fast DDS reads the interfaces from the file: this machine's own, and no other.
    if reach == 'SYSTEM_DEFAULT':
        assert '<address>127.0.0.1</address></interfaceWhiteList>' in Path(profiles).read_text()
    else:
        assert profiles == (value if said == 'FASTRTPS_DEFAULT_PROFILES_FILE' else '')


BOUND = """
import os, socket, struct
from contextlib import suppress
from pathlib import Path
import rclpy
from ocp_ros.ros.runtime.node_main import USER_VARIABLES, stay_local

for name in USER_VARIABLES:
    os.environ.pop(name, None)
assert stay_local()
rclpy.init()
node = rclpy.create_node('bound')
mine = set()
for number in os.listdir('/proc/self/fd'):
    with suppress(OSError):
        mine.add(os.readlink(f'/proc/self/fd/{number}'))
for table in ('udp', 'udp6', 'tcp', 'tcp6'):
    for line in Path('/proc/net', table).read_text().splitlines()[1:]:
        words = line.split()
        if f'socket:[{words[9]}]' in mine:
            address = words[1].partition(':')[0]
            print(table, socket.inet_ntoa(struct.pack('=I', int(address, 16)))
                  if len(address) == 8 else address)
node.destroy_node()
rclpy.try_shutdown()
"""


@pytest.mark.skipif(sys.platform != 'linux', reason='sockets are listed by Linux')
def test_nodes_bind_this_machine_alone():
    done = run_python(BOUND)
    assert done.returncode == 0, done.stderr
    # The second is the group of discovery, which is joined on the loopback interface.
    assert set(done.stdout.splitlines()) == {'udp 127.0.0.1', 'udp 239.255.0.1'}
