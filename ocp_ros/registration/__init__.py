# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a camera hangs: its live cloud registered to the scan of the room, without a target."""
