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
Numba's ``njit`` for all kernels of the package, cached in the user's cache.

Numba reads ``.numba_config.yaml`` in the current folder, which may name modules to import and
kernels to unpickle. The folder of an untrusted scan must not control this.
"""

from concurrent.futures import ThreadPoolExecutor
import ctypes
from importlib import import_module
import os
import sys
from types import ModuleType

from ocp_ros.util.files import cache_folder


def import_elsewhere(name: str) -> ModuleType:
    """
    Import a package without reading files of the current folder.

    A new thread changes to the root folder and imports the package there. The current folder of
    other threads does not change, except in containers that forbid a folder per thread; there it
    changes for a moment.

    :raises ImportError: if the package cannot be imported.
    """
    if name not in sys.modules:
        with ThreadPoolExecutor(1) as executor:
            executor.submit(_import_in_root, name).result()
    # This waits if another thread is importing the package just now.
    return import_module(name)


def _import_in_root(name: str) -> None:
    """Import a package in the root folder."""
    unshare = getattr(ctypes.CDLL(None), 'unshare', None)
    # CLONE_FS, 0x200, of unshare(2) gives the calling thread a current folder of its own.
    has_own_folder = unshare is not None and unshare(0x200) == 0
    previous_folder = os.open('.', os.O_RDONLY)
    os.chdir('/')
    try:
        import_module(name)
    finally:
        if not has_own_folder:
            os.fchdir(previous_folder)
        os.close(previous_folder)


if (_folder := cache_folder()) is not None:
    os.environ.setdefault('NUMBA_CACHE_DIR', str(_folder / 'kernels'))
_numba = import_elsewhere('numba')
# The compiler reads the file repeatedly.
_numba.core.config._config_fname = os.devnull
_numba.core.config.reload_config()
njit = _numba.njit
