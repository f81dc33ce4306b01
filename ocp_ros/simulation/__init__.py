# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A rig in a scene: state, reward, the Gymnasium environment."""
