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

"""Own room: from measures, from points in an array, or from a file."""

from pathlib import Path

import ocp_ros

# Measures, as in a room file (docs/reference/room.md): length, width, height in metres.
Path('room.yaml').write_text("""
size: [6, 4.5, 2.7]
openings:
  - {wall: south, at: 1.0, width: 0.9, height: 2.1}
boxes:
  - {box: [[2, 1, 0], [4, 2, 0.75]]}
""")
measured = ocp_ros.load_scene('room.yaml', max_points=5000)

# Points (N, 3) of your own program. These are in millimetres, with y up.
points = 1000.0 * measured.points[:, [1, 2, 0]]
scanned = ocp_ros.scene_of(points, scale=0.001, up='y')

# A file: .ply, .pcd, .e57, .las, .xyz, .obj, .glb and others.
ocp_ros.save_scene(measured, 'room.ply')
for room in (measured, scanned, ocp_ros.load_scene('room.ply')):
    print(f'{room.name}: {len(room)} points, {room.size.round(2)} m')
plan = ocp_ros.plan(measured, cameras=2, sensor='d455', evaluations=30)
print(f'{plan.seen:.0%} of the points seen')
