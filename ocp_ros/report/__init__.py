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

"""A rig planned in a room: what is found about a placement, and its pages, pictures and files."""

from importlib import resources
from string import Template
from typing import Any


def fill_template(name: str, **values: Any) -> str:
    """Return the text of a file in the folder ``templates``, with its ``$names`` replaced."""
    template = resources.files(__package__).joinpath('templates', name).read_text('utf-8')
    return Template(template).substitute(values)
