# SPDX-License-Identifier: Apache-2.0
"""Settings of the engine: resolution and rules of the shadow maps."""

from dataclasses import dataclass

from ocp_ros.geometry.visibility import PRESETS
from ocp_ros.util.settings import setting


@dataclass(frozen=True)
class EngineConfig:
    """Resolution and rules of the shadow maps."""

    preset: str = setting('fine', 'visibility rules: fine, fast or paper', choices=tuple(PRESETS))
    error_rows: int = setting(
        128, 'rows of the depth maps of the error; they have twice as many columns', 16, 2048)
    coverage_cell: float = setting(0.25, 'edge of a cell of the coverage grid, metres', 0.02, 5.0)
