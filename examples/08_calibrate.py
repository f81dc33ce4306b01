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

"""Calibrate: find the exact poses of mounted cameras by what they see of the scan."""

import json
from pathlib import Path
import subprocess
import sys

import numpy as np
import ocp_ros
from scipy.spatial.transform import Rotation

room = ocp_ros.generate_room(11, 60000)
ocp_ros.save_scene(room, 'room.ply')
plan = ocp_ros.plan(room, cameras=2, sensor='d455', seed=1, evaluations=60)
plan.save('placement.yaml')

# The cameras were mounted 8 cm and 3 degrees beside the plan. What they measure there replaces
# the recorded clouds, in the frame of the camera body: x forward, y left, z up.
simulator = ocp_ros.Simulator(room, ocp_ros.SimulationConfig(), plan.placement.rig.models)
rng = np.random.default_rng(0)
true = plan.poses + [0.05, -0.05, 0.03, 0.05, 0.0, 0.0]
clouds = []
for placed, pose in zip(plan.placement.cameras, true):
    points = room.points[simulator.evaluate(pose[None]).visible]
    body = (points - pose[:3]) @ Rotation.from_euler('ZYX', pose[3:]).as_matrix()
    clouds.append(f'{placed.camera.name}.npy')
    np.save(clouds[-1], body + rng.normal(0.0, 0.003, body.shape))

subprocess.run([sys.executable, '-m', 'ocp_ros.cli.main', 'calibrate', 'room.ply',
                'placement.yaml', '--clouds', *clouds, '--cloud-frame', 'body', '--out', 'built'],
               check=True)
for found, pose in zip(json.loads(Path('built/calibration.json').read_text())['cameras'], true):
    if not found['refused']:
        error = np.linalg.norm(found['position'] - pose[:3])
        print(f'{found["camera"]}: {1000.0 * error:.1f} mm from its true position')
