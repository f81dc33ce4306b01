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

"""Own planner: a search method of your own, beside those of the package."""

import ocp_ros


class RandomMoves(ocp_ros.Planner):
    """Move the cameras of the best placement at random, again and again."""

    def search(self):
        """Yield batches of placements, positions (n, 2) in metres, and receive their scores."""
        batch = [self.space.random(self.rng) for _ in range(8)]
        best, lowest = batch[0], float('inf')
        while True:
            scores = yield batch
            index = scores.error.argmin()
            if scores.error[index] < lowest:
                best, lowest = batch[index], scores.error[index]
            moved = best + self.rng.normal(0.0, 0.3, (8, *best.shape))
            batch = list(self.space.inside(moved))  # no camera outside of the room


# In this process only. A package adds its planner to all commands by an entry point:
# [project.entry-points."ocp_ros.planners"]
# random_moves = "my_package.my_module:RandomMoves"
ocp_ros.register_planner('random_moves', RandomMoves)

room = ocp_ros.generate_room(11, 5000)
for planner in ('random', 'random_moves'):
    plan = ocp_ros.plan(room, cameras=2, sensor='d455', planner=planner, evaluations=60)
    print(f'{plan.planner}: objective value {plan.loss:.3f}')
