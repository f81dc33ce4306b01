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

"""Own rig: your cameras, where they may be mounted, and what they must see."""

import ocp_ros

room = ocp_ros.generate_room(11, 5000)
(left, front, floor), (right, back, ceiling) = room.bounds

# The content of a rig file (docs/reference/rig.md); load_rig reads such a file.
RIG = {
    'cameras': [{'horizontal_fov': 90, 'vertical_fov': 60, 'min_range': 0.3, 'max_range': 5.0,
                 'count': 2}],
    'mount': {'on': 'walls', 'height': [1.8, 2.4]},
    'pitch': [0, 60],
    'keep_out': [{'box': [[left, front, floor], [left + 1.0, back, ceiling]]}],
    'regions': [{'name': 'table', 'box': [[2.0, 2.0, 0.5], [3.5, 4.0, 1.2]], 'weight': 3.0}]}

plan = ocp_ros.plan(room, RIG, evaluations=60)
for camera, pose in zip(plan.placement.cameras, plan.poses):
    print(camera.camera.name, pose.round(2))
print('regions:', plan.found['scores']['regions'])
print('violated constraints:', plan.broken or 'none')

# Without a fixed number of cameras: how many reduce the depth error by half?
counted = ocp_ros.plan(room, RIG, cameras='auto', target=0.5, most=3, evaluations=20)
print(f'{len(counted.poses)} cameras, target reached: {counted.reached}')
