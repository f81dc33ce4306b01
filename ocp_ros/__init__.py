# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Online optimal placement of depth cameras in indoor rooms.

``plan`` and ``score`` do what ``ocp plan`` and ``ocp score`` do; docs/tasks/python.md shows them.
"""

from importlib import import_module
from typing import Any

__version__ = '0.1.0'
#: What is here under its own name, and the module that it is imported from when it is asked for:
#: the engine takes seconds to import.
_HOMES = {
    'plan': 'api', 'score': 'api',
    'PlanResult': 'api', 'ScoreResult': 'api',
    'load_rig': 'rig.rig_file', 'rig_of': 'rig.rig_file',
    'load_scene': 'scenes.scene_files', 'scene_of': 'scenes.scene_files',
    'generate_room': 'rooms.generator', 'register_planner': 'search.registry',
    'UserError': 'util.settings'}
__all__ = ['__version__', *_HOMES]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    """Import what is asked for by its name."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)


def __dir__() -> list[str]:
    """Return what can be asked for, imported or not."""
    return sorted({*globals(), *_HOMES})
