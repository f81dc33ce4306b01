# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drills of whole systems: nodes that are killed or sent wrong messages, and how fast they are."""
