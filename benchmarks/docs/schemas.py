# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
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
