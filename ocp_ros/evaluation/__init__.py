# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measurements that stand behind the figures in the documentation."""
