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

"""What moves are expected to bring is what the engine says of what has been seen."""

import re

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.online.expected_gain import ExpectedGain
from ocp_ros.online.rig_state import RigState
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene import SceneError
import pytest

RANGE = 4.0


@pytest.fixture(scope='module')
def cloud():
    """Return a room that has been seen whole."""
    return generate_room(3, 8000).points


def state_at(cloud, *shares):
    """Return cameras at shares of the way from corner to corner, 1.5 m high."""
    low, high = cloud.min(axis=0)[:2] + 0.4, cloud.max(axis=0)[:2] - 0.4
    rows = np.zeros((len(shares), 6))
    rows[:, :2], rows[:, 2] = low + np.array(shares)[:, None] * (high - low), 1.5
    return RigState(rows, (CameraModel(0.0, RANGE),) * len(shares), len(shares))


def test_there_and_back_again(cloud):
    crowded, spread = state_at(cloud, 0.01, 0.03), state_at(cloud, 0.2, 0.8)
    there = ExpectedGain.of(cloud, crowded, spread.placement, RANGE)
    back = ExpectedGain.of(cloud, spread, crowded.placement, RANGE)
    assert there.after < there.before
    # The rectangle of what was seen is closed by where the cameras look from.
    assert (back.before, back.after) == pytest.approx((there.after, there.before), rel=0.05)


def test_cameras_that_stay_change_nothing_and_words_have_the_numbers(cloud):
    state = state_at(cloud, 0.3, 0.7)
    gain = ExpectedGain.of(cloud, state, state.placement, RANGE)
    assert gain.before == gain.after and f'{gain.before:.2f}' in str(gain)
    with pytest.raises(SceneError):
        ExpectedGain.of(cloud[:3], state, state.placement, RANGE)
    text = str(ExpectedGain(2.0, 1.5))
    assert re.findall(r'\d+(?:\.\d+)?', text) == ['2.00', '1.50', '25']
    assert '3.00' in str(ExpectedGain(3.0, 3.5)) and '3.50' not in str(ExpectedGain(3.0, 3.5))
