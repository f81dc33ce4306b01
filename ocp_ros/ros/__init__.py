# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS 2 nodes; the only folder that imports rclpy and message packages."""
