# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What every layer needs and no layer owns: settings, files, threads, worker processes."""
