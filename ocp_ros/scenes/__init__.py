# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where rooms come from: files and the generator."""
