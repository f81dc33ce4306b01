# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What runs on the robot: observation cache, networks, policy, checkpoints."""
