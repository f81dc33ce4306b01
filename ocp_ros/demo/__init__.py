# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Demonstrations over real ROS: node processes, and who watches them."""
