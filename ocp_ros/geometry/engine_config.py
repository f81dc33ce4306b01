# Copyright 2026 The ocp_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Settings of the engine: resolution and rules of the shadow maps."""

from dataclasses import dataclass

from ocp_ros.geometry.visibility import MESH, PRESETS
from ocp_ros.util.settings import setting


@dataclass(frozen=True)
class EngineConfig:
    """Resolution and rules of the shadow maps."""

    preset: str = setting(
        'fine', 'visibility rules: fine, fast or paper; mesh: rays cast at the faces of a mesh',
        choices=(*PRESETS, MESH))
    error_rows: int = setting(
        128, 'rows of the depth maps of the error; they have twice as many columns', 16, 1024)
    coverage_cell: float = setting(0.25, 'edge of a cell of the coverage grid, metres', 0.02, 5.0)
    error_folds: int = setting(
        1, 'number of parts (folds) of the points; from 2 on, each viewpoint in turn leaves out '
           'one part; 1: the depth error uses all points', 1, 16)
    viewpoints: str = setting(
        'air', 'viewpoints of the depth error: air (16 places in the air of the room) or paper '
               '(its five, in the rectangle along the walls)', choices=('air', 'paper'))


#: The engine settings of plans and comparisons, for which the expected error in the room itself
#: was measured (:mod:`ocp_ros.report.findings`). Searches overfit the scan if depth maps are
#: finer than the point spacing, or use all points at once.
PROMISING = EngineConfig(preset='fine', error_rows=64, error_folds=4)
