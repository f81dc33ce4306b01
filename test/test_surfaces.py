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

"""The surfaces that a scene's points stand for: normals and pitch."""

import numpy as np
from ocp_ros.rooms.generator import generate_room
from ocp_ros.scenes.scene import Scene
import pytest


def test_normals_are_sharp_at_edges():
    """On two faces of a box every point but a few has the normal of its own face."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0.0, 2.0, (2, 3000))
    floor = np.stack([u[:1500], v[:1500], np.zeros(1500)], axis=1)
    wall = np.stack([np.zeros(1500), u[1500:], v[1500:]], axis=1)
    scene = Scene(np.concatenate([floor, wall]))
    normals = np.abs(scene.normals_or_estimate)
    assert (normals[:1500, 2] > 0.98).mean() > 0.97
    assert (normals[1500:, 0] > 0.98).mean() > 0.97


def test_an_isolated_point_hides_no_wall():
    room = generate_room(5, 8000)
    stray = room.bounds.mean(axis=0)[None].astype(np.float32)
    scene = Scene(np.concatenate([room.points, stray]))
    assert scene.pitch[-1] <= 4.0 * np.median(scene.pitch) < 1.0


def test_the_pitch_is_that_of_a_grid():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 4, 0.1), np.arange(0, 4, 0.1)))
    scene = Scene(np.stack([x, y, 0.05 * np.sin(x)], axis=1))
    assert np.median(scene.pitch) == pytest.approx(0.1, rel=0.4)
    assert np.median(scene.spacing) == pytest.approx(0.1, rel=0.02)


def test_a_scattered_scene_needs_no_normals():
    points = np.random.default_rng(1).uniform(-3, 3, (300, 3)).astype(np.float32)
    scene = Scene(points)
    assert scene.normals is None
    assert np.allclose(np.linalg.norm(scene.normals_or_estimate, axis=1), 1.0, atol=1e-5)
