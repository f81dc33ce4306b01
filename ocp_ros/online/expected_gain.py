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

"""Expected change of the depth error by moves of the cameras, computed on the observed cloud."""

from typing import NamedTuple

import numpy as np
from ocp_ros.geometry.visibility import FINE
from ocp_ros.online.partial_map import PartialMap
from ocp_ros.online.rig_state import RigState


class ExpectedGain(NamedTuple):
    """
    The depth error of the observed cloud before and after moves; unseen space is not included.

    :ivar before: metres, with the cameras at their current poses.
    :ivar after: metres, with the cameras at their targets.
    """

    before: float
    after: float

    @classmethod
    def of(cls, cloud: np.ndarray, state: RigState, placement: np.ndarray, max_range: float
           ) -> 'ExpectedGain':
        """
        Compute both errors on the observed cloud.

        :param cloud: (M, 3) float32, metres, map frame: the observed cloud.
        :param state: current state of the cameras.
        :param placement: (K + F, 6) metres and radians: the K movable and F fixed cameras after
            the moves.
        :param max_range: effective range of the omnidirectional cameras, metres.
        :raises SceneError: if the points are too few or too flat to be a room.
        """
        # An operator waits for the result, so the model has few points, and the depth maps of the
        # error have few rows. The maps of visibility are other maps, with the size in ``FINE``.
        model = PartialMap(cloud, state.placement[:, :3], max_range, max_points=12000, rows=64,
                           settings=FINE)

        def error(poses: np.ndarray) -> float:
            return model.error([model.look(pose, lens)
                                for pose, lens in zip(poses, state.lenses, strict=True)])

        return cls(error(state.placement), error(placement))

    def __str__(self) -> str:
        """Return the comparison as a sentence."""
        if not self.after < self.before:
            return ('expected: no gain in the part of the room that has been seen so far; these '
                    'moves look at the rest')
        share = 1.0 - self.after / self.before
        return (f'expected: {100.0 * share:.0f} % of what is missing in the part of the room that '
                'has been seen so far is gone')
