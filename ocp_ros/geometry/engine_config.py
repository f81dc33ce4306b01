# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the engine: resolution and rules of the shadow maps."""

from dataclasses import dataclass

from ocp_ros.geometry.visibility import PRESETS
from ocp_ros.util.settings import ConfigurationError, setting

#: The most of rows times rows times folds: the maps of a room then take some 0.7 GB.
MOST_ROWS = 1 << 21


@dataclass(frozen=True)
class EngineConfig:
    """Resolution and rules of the shadow maps."""

    preset: str = setting('fine', 'visibility rules: fine, fast or paper', choices=tuple(PRESETS))
    error_rows: int = setting(
        128, 'rows of the depth maps of the error; they have twice as many columns', 16, 2048)
    coverage_cell: float = setting(0.25, 'edge of a cell of the coverage grid, metres', 0.02, 5.0)
    error_folds: int = setting(
        1, '1: the depth error uses all points; from 2 on: the points are split into so many '
           'parts (folds), and the depth error is the mean of so many errors; each error leaves '
           'out one part', 1, 16)

    def __post_init__(self) -> None:
        """Refuse depth maps that would fill the memory."""
        if self.error_rows ** 2 * self.error_folds > MOST_ROWS:
            raise ConfigurationError(
                f'engine: found error_rows {self.error_rows} with error_folds {self.error_folds}; '
                f'expected error_rows x error_rows x error_folds up to {MOST_ROWS:,}; lower one '
                'of the two')


#: The engine that searches end with and that promises are made by. Maps of the error that are
#: finer than the points are apart, or that hold all points at once, fit the scan and not the room.
PROMISING = EngineConfig(preset='fine', error_rows=64, error_folds=4)
