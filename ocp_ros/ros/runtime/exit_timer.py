# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
An end that comes in time, even where native code never returns.

Fast DDS 2.14 may wait for ever while it takes down a participant at the moment that another one
leaves (``DomainParticipantImpl::set_listener``): it waits until no callback runs, without a time
limit, by taking and releasing a lock in a tight loop, and the callback waits for that same lock.
As rclpy keeps the interpreter's lock meanwhile, no Python code can help: a timer of the C library
ends the process.
"""

from collections.abc import Iterator
from contextlib import contextmanager
import ctypes
import sys
import time

#: ``SIGEV_THREAD`` of timer_create(2): a new thread calls a function.
SIGEV_THREAD = 2


class _Notification(ctypes.Structure):
    """``struct sigevent`` of glibc."""

    _fields_ = [('value', ctypes.c_void_p), ('signal', ctypes.c_int), ('how', ctypes.c_int),
                ('function', ctypes.c_void_p), ('attributes', ctypes.c_void_p),
                ('rest', ctypes.c_byte * 32)]


class _Times(ctypes.Structure):
    """``struct itimerspec``: period and time until the timer fires, seconds and nanoseconds."""

    _fields_ = [(name, ctypes.c_long) for name in (
        'period_s', 'period_ns', 'seconds', 'nanoseconds')]


@contextmanager
def leaving_within(seconds: float, code: int) -> Iterator[None]:
    """
    End this process with an exit code if a block takes longer than some seconds.

    Whatever is to be kept has to be saved before. Nothing is limited where the C library has no
    such timers.
    """
    # What was printed is not lost: the process may end without finalisers.
    sys.stdout.flush()
    sys.stderr.flush()
    libc, timer = ctypes.CDLL(None), ctypes.c_void_p()
    event = _Notification(value=code, how=SIGEV_THREAD,
                          function=ctypes.cast(libc._exit, ctypes.c_void_p))
    armed = hasattr(libc, 'timer_create') and not libc.timer_create(
        time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer))
    if armed:
        whole, part = divmod(seconds, 1.0)
        libc.timer_settime(timer, 0, ctypes.byref(_Times(0, 0, int(whole), int(1e9 * part))), None)
    try:
        yield
    finally:
        if armed:
            libc.timer_delete(timer)
