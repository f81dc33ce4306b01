# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures: plans, rooms, curves, and the labels and fonts on them."""

from ocp_ros.util.kernels import import_elsewhere

# It reads matplotlibrc of the current folder, which may be another picture, or no text at all.
import_elsewhere('matplotlib')
