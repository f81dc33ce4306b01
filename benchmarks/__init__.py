# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The laboratory: what measures and draws for the documentation. It is not installed.

Run a module from the folder of the repository, such as ``python -m benchmarks.engine_bench``.
"""
