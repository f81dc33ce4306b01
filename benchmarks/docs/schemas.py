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

"""Write the schemas of rig and placement files: ``python -m benchmarks.docs.schemas``."""

import json

from benchmarks.results import ROOT
from ocp_ros.rig.schemas import PLACEMENT, RIG

DIALECT = 'https://json-schema.org/draft/2020-12/schema'
#: The files of docs/ and what is in them.
FILES = {'rig.schema.json': {'$schema': DIALECT, 'title': 'A rig of depth cameras', **RIG},
         'placement.schema.json': {
             '$schema': DIALECT, 'title': 'Poses of the cameras of a rig', **PLACEMENT}}

if __name__ == '__main__':
    for name, schema in FILES.items():
        path = ROOT / 'docs' / name
        path.write_text(json.dumps(schema, indent=1) + '\n')
        print(f'wrote {path}')
