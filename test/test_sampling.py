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

"""Key points of a cloud and the groups around them."""

from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
from ocp_ros.policy.sampling import ball_query, farthest_points, nearest_in_ball

seeds = st.integers(0, 2 ** 32 - 1)


@given(seed=seeds, count=st.integers(1, 60), wanted=st.integers(1, 40))
@budget(max_examples=40, deadline=None)
def test_farthest_points_agree_with_their_twin(seed, count, wanted):
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    chosen = [0]
    for _ in range(wanted - 1):
        nearest = ((points[:, None] - points[chosen][None]) ** 2).sum(-1).min(axis=1)
        chosen.append(int(nearest.argmax()))
    found = farthest_points(points, wanted)
    distances = ((points[:, None] - points[found][None]) ** 2).sum(-1)
    expected = ((points[:, None] - points[chosen][None]) ** 2).sum(-1)
    # Equal distances may be chosen in either order; how far apart the choices are may not differ.
    np.testing.assert_allclose(np.sort(distances.min(1)), np.sort(expected.min(1)), atol=1e-5)


@given(seed=seeds, radius=st.floats(0.1, 3.0), size=st.integers(1, 12))
@budget(max_examples=40, deadline=None)
def test_ball_query_agrees_with_its_twin(seed, radius, size):
    points = np.random.default_rng(seed).normal(size=(50, 3)).astype(np.float32)
    keys = np.arange(0, 50, 7)
    groups = ball_query(points, keys, radius, size)
    for key, group in zip(keys, groups, strict=True):
        difference = (points - points[key]).astype(np.float64)
        near = np.flatnonzero((difference ** 2).sum(axis=1) <= radius ** 2)
        # Points on the very rim may fall to either side in single precision.
        rim = np.abs(np.linalg.norm(difference, axis=1) - radius) < 1e-5
        if not rim.any():
            expected = np.full(size, near[0])
            expected[:min(size, len(near))] = near[:size]
            assert group.tolist() == expected.tolist()


@given(seed=seeds, radius=st.floats(0.1, 3.0), size=st.integers(1, 12))
@budget(max_examples=40, deadline=None)
def test_the_nearest_points_of_a_ball_agree_with_their_twin(seed, radius, size):
    points = np.random.default_rng(seed).normal(size=(50, 3)).astype(np.float32)
    keys = np.arange(0, 50, 7)
    groups = nearest_in_ball(points, keys, radius, size)
    for key, group in zip(keys, groups, strict=True):
        away = np.linalg.norm((points - points[key]).astype(np.float64), axis=1)
        near = [point for point in np.argsort(away) if away[point] <= radius][:size]
        if not (np.abs(away - radius) < 1e-5).any():
            assert group[0] == key
            assert group.tolist() == near + [key] * (size - len(near))


def test_sampling_and_grouping_count_beyond_sixteen_bits():
    points = np.zeros((40000, 3), dtype=np.float32)
    points[-2:, 0] = 7.0, 9.0
    keys = farthest_points(points, 3)
    assert keys.tolist() == [0, 39999, 39998]
    assert ball_query(points, keys, 1.0, 2).tolist() == [[0, 1], [39999] * 2, [39998] * 2]
    assert nearest_in_ball(points, keys, 3.0, 2).tolist() == [
        [0, 1], [39999, 39998], [39998, 39999]]
