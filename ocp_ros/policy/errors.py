# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with weights: told apart from other errors without an import of torch."""

from ocp_ros.util.settings import UserError


class CheckpointError(UserError):
    """Weights that cannot be used; the message says what was found and expected."""
