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

"""The fused cloud: bounded, stable, and never two points in one voxel."""

from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.clouds import FusedCloud, MIN_POINTS
import pytest


@st.composite
def clouds(draw):
    """Draw a cloud as a robot may meet it: of any extent, on planes, with points that repeat."""
    count, spread = draw(st.integers(0, 300)), draw(st.sampled_from([0.1, 1.0, 8.0, 1000.0]))
    rng = np.random.default_rng(draw(st.integers(0, 2 ** 32 - 1)))
    points = rng.normal(draw(st.sampled_from([0.0, 3.0, -40.0])), spread, (count, 3))
    flat = rng.random(points.shape) < draw(st.floats(0.0, 1.0))
    points[flat] = np.round(points[flat], 1)
    return points.astype(np.float32)


def voxels(points, edge):
    """Return the voxel of each point, found the slow way."""
    return [tuple(int(np.floor(float(x) / edge)) for x in point) for point in points]


@given(added=st.lists(clouds(), max_size=5), voxel=st.sampled_from([0.01, 0.05, 0.3, 1.0]),
       most=st.one_of(st.integers(MIN_POINTS, 200), st.just(10000)))
@budget(max_examples=50, deadline=None)
def test_it_is_bounded_whatever_is_added_and_has_one_point_per_voxel(added, voxel, most):
    fused = FusedCloud(voxel, most)
    for cloud in added:
        before, edge = fused.points, fused.edge
        fused.add(cloud)
        assert len(fused) == len(fused.points) <= most
        found = voxels(fused.points, fused.edge)
        assert len(set(found)) == len(found)
        assert fused.points.dtype == np.float32
        if fused.edge == edge:
            # Those that were there stay, in their order.
            np.testing.assert_array_equal(fused.points[:len(before)], before)
    assert fused.edge == voxel or most < 10000
    # Every voxel that something was seen in has a point: what has been seen stays seen.
    seen = {voxel for cloud in added for voxel in voxels(cloud, fused.edge)}
    assert set(voxels(fused.points, fused.edge)) == seen
    # The same clouds again change nothing.
    points, edge = fused.points.copy(), fused.edge
    for cloud in added:
        fused.add(cloud)
        np.testing.assert_array_equal(fused.points, points)
        assert fused.edge == edge


def test_the_first_point_of_a_voxel_is_kept_and_voxels_grow_no_more_than_they_must():
    fused = FusedCloud(1.0, 100)
    fused.add([[0.5, 0.5, 0.5], [0.1, 0.1, 0.1], [-0.1, 0.5, 0.5]])
    fused.add([[0.2, 0.2, 0.2], [1.5, 0.5, 0.5]])
    np.testing.assert_allclose(fused.points, [[0.5, 0.5, 0.5], [-0.1, 0.5, 0.5], [1.5, 0.5, 0.5]])
    fused = FusedCloud(0.5, 8)
    fused.add(np.column_stack([np.arange(16) * 0.5, np.zeros(16), np.zeros(16)]))
    assert (len(fused), fused.edge) == (8, 1.0)
    fused.clear()
    assert (len(fused), fused.edge) == (0, 0.5)
    fused.add(np.zeros((1, 3)))
    assert len(fused) == 1


@pytest.mark.parametrize('far', [np.nan, np.inf, -1e30, 2.0 ** 20])
def test_points_that_are_nowhere_are_refused_and_nothing_is_added(far):
    fused = FusedCloud(0.05, 100)
    with pytest.raises(ValueError, match='points: found'):
        fused.add([[0.0, 0.0, 0.0], [0.0, far, 0.0]])
    assert len(fused) == 0


@pytest.mark.parametrize(('voxel', 'most'), [(0.0, 100), (np.nan, 100), (0.1, 7)])
def test_limits_that_cannot_be_kept_are_refused(voxel, most):
    with pytest.raises(ValueError, match='found .*; expected'):
        FusedCloud(voxel, most)
