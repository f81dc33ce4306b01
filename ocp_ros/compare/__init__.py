# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Planners compared in the same rooms: one protocol, one judge, one summary."""
