# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Packages that read settings of the current folder when they are imported."""

import ctypes
from importlib import import_module
import os
import sys
from threading import Thread
from types import ModuleType

#: Of unshare(2): a current folder that is the calling thread's own.
OWN_FOLDER = 0x200


def import_elsewhere(name: str) -> ModuleType:
    """
    Import a package, unless it is, where no file of the current folder is read.

    A thread does it that has a current folder of its own, so that no other thread sees another;
    in containers that forbid this, all threads do for a moment.

    :param name: of the package.
    :returns: the package.
    :raises ImportError: if it cannot be imported.
    """
    if name not in sys.modules:
        thread = Thread(target=_import, args=(name,))
        thread.start()
        thread.join()
    return import_module(name)


def _import(name: str) -> None:
    """Import a package in the root folder; where that fails, the caller's attempt says why."""
    unshare = getattr(ctypes.CDLL(None), 'unshare', None)
    alone = unshare is not None and unshare(OWN_FOLDER) == 0
    before = os.open('.', os.O_RDONLY)
    os.chdir('/')
    try:
        import_module(name)
    except ImportError:
        pass
    finally:
        if not alone:
            os.fchdir(before)
        os.close(before)
