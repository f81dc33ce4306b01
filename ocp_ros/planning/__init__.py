# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rig planned and judged in a room: what a user calls."""
