# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trained policies: networks, weights, and the planners that run them."""
