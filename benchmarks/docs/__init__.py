# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of the documentation that are made from the code: tables, schemas and pictures."""
