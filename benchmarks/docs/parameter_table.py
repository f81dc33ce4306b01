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
Write docs/reference/parameters_<node>.md from the classes that own the parameters.

    python -m benchmarks.docs.parameter_table
"""

from benchmarks.results import ROOT
from ocp_ros.ros.guide_node import GuideNodeConfig
from ocp_ros.ros.policy.policy_config import PolicyNodeConfig
from ocp_ros.ros.sim_node import SimNodeConfig
from ocp_ros.ros.trainer_node import TrainerNodeConfig
from ocp_ros.util.settings import leaves

NODES = {'sim_node': SimNodeConfig, 'policy_node': PolicyNodeConfig,
         'trainer_node': TrainerNodeConfig, 'guide_node': GuideNodeConfig}
#: What explains the terms of a node's parameters.
MORE = {'trainer_node': ' [The network](../explanation/policy.md#the-network) explains '
                        'the extraction units of `agent.*`.'}
FOLDER = ROOT / 'docs' / 'reference'


def page(node: str, cls: type) -> str:
    """Return the page of one node as Markdown, with a row for each parameter."""
    sections = []
    for heading, running in (('Read at the start', False), ('Read at any time', True)):
        rows = [f'| `{name}: {item.default!r}` | {item.metadata["description"]} |'
                for name, item in leaves(cls).items() if item.metadata['running'] == running]
        if rows:
            sections += [f'## {heading}', '', '| parameter and default | meaning |', '|---|---|',
                         *rows, '']
    return '\n'.join([
        f'# Parameters of {node}', '',
        '[Node parameters](parameters.md) explains the sections. `python -m '
        f'benchmarks.docs.parameter_table` writes this page.{MORE.get(node, "")}', '', *sections])


if __name__ == '__main__':
    for node, cls in NODES.items():
        path = FOLDER / f'parameters_{node}.md'
        path.write_text(page(node, cls))
        print(f'wrote {path}')
