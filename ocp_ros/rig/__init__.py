# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras, their mounts and constraints, and the region in which they may hang."""
