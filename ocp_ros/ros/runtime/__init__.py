# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What every node needs at run time: main loop, parameters, diagnostics, network."""
