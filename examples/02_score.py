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

"""Score: evaluate a placement of cameras that you have, and see which input is rejected."""

import ocp_ros

room = ocp_ros.generate_room(11, 5000)

# An array of poses: x, y, z in metres, then yaw, pitch and roll in radians.
POSES = [[1.5, 2.0, 1.9, 0.8, 0.4, 0.0], [3.5, 4.5, 1.9, -2.4, 0.4, 0.0]]
result = ocp_ros.score(room, POSES, sensor='d455')
print(result)  # what the command `ocp score` prints
print(f'{result.seen:.0%} of the points seen, depth error {result.depth_error:.1f} m')

# The content of a placement file, with angles in degrees; its path works too.
placement = {'cameras': [
    {'sensor': 'realsense_d455', 'position': [1.5, 2.0, 1.9], 'yaw': 45, 'pitch': 20}]}
alone = ocp_ros.score(room, placement)
print(f'one camera: {alone.seen:.0%}, {alone.depth_error:.1f} m')

try:
    ocp_ros.score(room, [1, 2, 3])
except ocp_ros.UserError as error:  # one sentence: found, expected
    print(error)
