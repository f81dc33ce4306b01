# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Planners that know only what was seen, and the model of it."""
