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

"""Plan: find poses of two depth cameras on the walls of a room."""

import ocp_ros

# The seed of a generated room; for your own room the path of its scan, such as 'room.ply'.
ROOM = 11

plan = ocp_ros.plan(ROOM, cameras=2, sensor='d455', evaluations=60, points=5000)
print(plan)  # what the command `ocp plan` prints
for x, y, z, yaw, pitch, _roll in plan.poses:
    print(f'position {x:.2f}, {y:.2f}, {z:.2f} m; yaw {yaw:.2f}, pitch {pitch:.2f} rad')
print(f'depth error {plan.depth_error:.1f} m, optimality gap {plan.gap}')
plan.save('placement.yaml')  # for ocp score, ocp view and ocp studio
