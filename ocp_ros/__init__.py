# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Online optimal placement of depth cameras in indoor rooms."""

__version__ = '0.1.0'
