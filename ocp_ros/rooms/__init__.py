# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Generated rooms, and rooms by their names."""
