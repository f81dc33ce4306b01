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

"""The depth observation error: against its twin and ray casting, and what must hold of it."""

from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
from ocp_ros.geometry.cameras import rotation_matrix
from ocp_ros.geometry.depth_error import DepthError, five_viewpoints, LARGEST_CUBE
from ocp_ros.geometry.packed_bits import no_bits, pack
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.mesh_rays import MeshRays
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.simulation_config import SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.simulation.viewpoints import paper_viewpoints
import pytest
import twins

#: Sides of cubes, in multiples of what they are in the engine.
SHARE = 0.75
#: Sums of single-precision depths, metres.
ROUNDING = 1e-5
seeds = st.integers(0, 2 ** 32 - 1)


@pytest.fixture(scope='module')
def small():
    """Return a small room and its depth error at a low resolution."""
    scene = generate_room(2, 1500)
    return scene, DepthError(scene.points, SHARE * scene.spacing, scene.diameter,
                             paper_viewpoints(scene), 24)


def half_sides(scene):
    """Return half the sides of the points' cubes, metres."""
    return SHARE * np.minimum(scene.spacing, LARGEST_CUBE * np.median(scene.spacing))


def drawn(scene, seed, *shares):
    """Return which points are seen, for shares of them: (N,) bool each."""
    rng = np.random.default_rng(seed)
    return [rng.random(len(scene)) < share for share in shares]


@given(seed=seeds, share=st.floats(0.0, 1.0))
@budget(max_examples=8, deadline=None)
def test_depth_error_agrees_with_its_twins(small, seed, share):
    scene, error = small
    seen, = drawn(scene, seed, share)
    engine = scene.points, half_sides(scene), error.viewpoints, error.far, 24, seen
    assert error(pack(seen)) == pytest.approx(twins.depth_error(*engine), rel=2e-3, abs=2e-3)
    expected, found = twins.depth_error_by_point(*engine), error.error_by_point(pack(seen))
    assert np.abs(found - expected).sum() <= 2e-3 * expected.sum() + ROUNDING
    # All of the error is somewhere, and none where points are seen.
    assert found.sum() == pytest.approx(error(pack(seen)), rel=1e-4, abs=ROUNDING)
    assert (found >= 0.0).all() and not found[seen].any()


@given(seed=seeds, share=st.floats(0.0, 1.0))
@budget(max_examples=30, deadline=None)
def test_depth_error_falls_or_stays_when_more_is_seen(small, seed, share):
    scene, error = small
    some, others = drawn(scene, seed, share, 0.2)
    assert 0.0 <= error(pack(some | others)) <= error(pack(some)) + ROUNDING
    assert error(pack(some)) <= error.worst + ROUNDING
    assert error(pack(np.ones(len(scene), dtype=bool))) == 0.0
    assert error.worst == error(no_bits(len(scene))) > 1.0


@given(seed=seeds, share=st.floats(0.0, 1.0), more=st.floats(0.0, 1.0))
@budget(max_examples=8, deadline=None)
def test_what_is_settled_may_be_left_out(small, seed, share, more):
    scene, error = small
    seen, *views = map(pack, drawn(scene, seed, share, more, 0.1, 0.0))
    expected = [error(seen | view) for view in views]
    given_seen = error.given(seen)
    assert [given_seen(view) for view in views] == pytest.approx(expected, abs=ROUNDING)


def test_viewpoints_are_where_the_paper_puts_them():
    found = five_viewpoints(np.array([[0, 0], [0, 12], [6, 0], [6, 12]]), 1.5)
    assert found.tolist() == [[3, 6, 1.5], [1, 2, 1.5], [1, 10, 1.5], [5, 2, 1.5], [5, 10, 1.5]]


def test_depth_maps_agree_with_ray_casting():
    scene = generate_room(12, 15000, scanned=False)
    engine = Simulator(scene, SimulationConfig()).depth_error
    caster = MeshRays(scene.mesh)
    rays = twins.directions(engine.shape[0]).reshape(-1, 3)
    off = [np.abs(engine.depth_map(k).ravel() - caster.lengths(engine.viewpoints[k], rays)).mean()
           for k in range(5)]
    # Cubes reach a little beyond what they stand for; holes would cost metres.
    assert sum(off) < 0.8
    assert (engine.depth_map(0) == np.float32(engine.far)).mean() < 0.03


@pytest.mark.parametrize('quarters', [1, 2, 3])
def test_a_room_that_turns_with_its_cameras_is_worth_the_same(quarters):
    """By quarters, so that the bounding box and its cells turn as well."""
    scene = generate_room(5, 20_000)
    turn = rotation_matrix(quarters * np.pi / 2)
    turned = Scene((scene.points @ turn.T).astype(np.float32),
                   normals=(scene.normals_or_estimate @ turn.T).astype(np.float32))
    placement = np.random.default_rng(0).uniform(*scene.bounds, (3, 3))
    one = Simulator(scene, SimulationConfig()).evaluate(placement)
    other = Simulator(turned, SimulationConfig()).evaluate(placement @ turn.T)
    assert (one.seen.mask != other.seen.mask).mean() <= 0.002
    assert other.depth_error == pytest.approx(one.depth_error, rel=0.02)
    assert other.space_coverage == pytest.approx(one.space_coverage, rel=0.02)
