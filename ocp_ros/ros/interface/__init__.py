# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics, their quality of service, and messages to arrays and back."""
