# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Numba's ``njit`` for all kernels of the package, which are kept in the user's cache.

Numba reads ``.numba_config.yaml`` of the current folder, which may name modules to import and
kernels to unpickle. A folder that a scan came in must not say that.
"""

import os

from ocp_ros.util.elsewhere import import_elsewhere
from ocp_ros.util.files import cache_folder

if (_folder := cache_folder()) is not None:
    os.environ.setdefault('NUMBA_CACHE_DIR', str(_folder / 'kernels'))
_numba = import_elsewhere('numba')
# The compiler looks for the file again and again.
_numba.core.config._config_fname = os.devnull
_numba.core.config.reload_config()
njit = _numba.njit
