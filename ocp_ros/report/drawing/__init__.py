# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures: plans, rooms, curves, and the labels and fonts on them."""
