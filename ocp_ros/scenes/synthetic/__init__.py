# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The generator of furnished rooms: plan, furniture, and a simulated scan of them."""
