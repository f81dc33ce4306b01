# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test equipment for whole systems: soak, fuzz, and how fast nodes are."""
