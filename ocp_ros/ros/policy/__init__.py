# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of policy_node: turns, decisions, constraints, convergence."""
