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

"""Environment: train an agent of stable-baselines3 in the Gymnasium environment."""

import gymnasium
from stable_baselines3 import PPO

# Gymnasium does not search packages: the module and a colon come before the name. Other arguments
# are those of ocp_ros.environment_of; rooms are seeds of generated rooms, or paths of scans.
env = gymnasium.make('ocp_ros.simulation.environment:ocp_ros/CameraPlacement-v0',
                     rooms=[11, 12], points=2000, cameras=2)

agent = PPO('MultiInputPolicy', env, n_steps=64, batch_size=32, seed=0)
agent.learn(total_timesteps=128)

observation, info = env.reset(seed=0)
print(f'start: depth error {info["depth_error"]:.2f} m')
truncated = False
while not truncated:
    action, _ = agent.predict(observation, deterministic=True)
    observation, reward, terminated, truncated, info = env.step(action)
print(f'end: depth error {info["depth_error"]:.2f} m, '
      f'space coverage {info["space_coverage"]:.1f} cubic metres')
