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

"""
Online optimal placement of depth cameras in indoor rooms.

These names are the public Python interface; ``examples/`` shows how to use them. All other modules
may change without notice.
"""

from importlib import import_module
from typing import Any

__version__ = '0.1.0'
#: Public names and the modules from which they are imported at first use: the engine takes seconds
#: to import.
_HOMES = {
    'plan': 'api', 'score': 'api', 'PlanResult': 'api', 'ScoreResult': 'api',
    'Scene': 'scenes.scene', 'generate_room': 'rooms.generator',
    'load_scene': 'scenes.scene_files', 'scene_of': 'scenes.scene_files',
    'save_scene': 'scenes.scene_files',
    'Rig': 'rig.rig_file', 'load_rig': 'rig.rig_file', 'rig_of': 'rig.rig_file',
    'Simulator': 'simulation.simulator', 'SimulationConfig': 'simulation.simulation_config',
    'CameraPlacementEnv': 'simulation.environment', 'environment_of': 'simulation.environment',
    'Planner': 'search.planner', 'Online': 'online.online_planner',
    'register_planner': 'search.registry', 'UserError': 'util.settings'}
__all__ = ['__version__', *_HOMES]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)


def __dir__() -> list[str]:
    """Return all public names, imported or not."""
    return sorted({*globals(), *_HOMES})
