# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays in, arrays out: camera models, shadow maps, coverage and depth error (NumPy, Numba)."""
