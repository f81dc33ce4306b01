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

"""
The placement problem in a room: the cameras, their feasible region and the objective.

A :class:`Problem` is a rig in a room; :class:`PlaneProblem` is the case of cameras that move
freely on a plane.
"""

from functools import cached_property

import numpy as np
from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.rig.feasible_region import FeasibleRegion, satisfies_spacing
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.rig.motion import drawn_near, kept_inside, nearest_place, outwards
from ocp_ros.rig.mounts import first_headings
from ocp_ros.rig.rig_file import Rig
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.objective import Objective, RigEvaluation
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator, View


def make_problem(scene: Scene, config: SimulationConfig) -> 'Problem':
    """
    Build the problem that settings describe.

    :raises ConfigurationError: if the rig file cannot be used in this room.
    :raises SceneError: if the cameras' plane is not inside the room.
    """
    if config.placed_rig.free:
        return PlaneProblem(Simulator(scene, config))
    return Problem.of(scene, config.placed_rig, config)


def space_of(simulator: Simulator, cameras: int | None = None,
             config: EpisodeConfig | None = None) -> FreePlane:
    """
    Return the space of cameras that move freely on a plane in a room.

    :param cameras: the number of cameras; that of the simulator's settings by default.
    :param config: the distance to surfaces; that of the simulator's settings by default.
    """
    config = config or simulator.config.episode
    return FreePlane.of(simulator.scene.points, simulator.height,
                        cameras or simulator.config.rig.cameras, config.wall_margin,
                        config.clearance)


class Problem:
    """
    A rig in a room.

    :param objective: the objective of placements; its simulator is the engine.
    :param region: the feasible region of its cameras.
    :ivar axes: the components of an action, see :attr:`ocp_ros.rig.rig_file.Rig.axes`.
    :ivar dimensions: the number of dimensions in which cameras move.
    :ivar models: the models of all cameras: K to be placed, then F in place.
    :ivar fixed_poses: (F, 6) metres, map frame, and radians, of the cameras in place.
    """

    dimensions = 3

    def __init__(self, objective: Objective, region: FeasibleRegion) -> None:
        self.objective, self.region = objective, region
        self.simulator, self.rig = objective.simulator, objective.rig
        self.axes, self.models = self.rig.axes, self.rig.models
        self.fixed_poses = self.rig.fixed_poses

    @classmethod
    def of(cls, scene: Scene, rig: Rig, config: SimulationConfig | None = None) -> 'Problem':
        """
        Build the problem of a rig in a room.

        :param config: the settings of engine, episode and reward.
        :raises ConfigurationError: if the rig does not fit the room.
        """
        region = FeasibleRegion(scene, rig)
        simulator = Simulator(scene, config or SimulationConfig(), rig.models)
        return cls(Objective(simulator, rig), region)

    def nothing(self) -> Subset:
        """Return the points visible to the cameras in place."""
        seen = self.simulator.nothing()
        for view in self.objective.fixed:
            seen |= Subset(view.seen, self.simulator.visibility.order)
        return seen

    @cached_property
    def _starts(self) -> dict[CameraModel, np.ndarray]:
        """Return feasible positions of each camera model: (M, 3) metres."""
        # The number of start positions to choose from.
        return {model: self.region.places(
            model, 4000 if model.omnidirectional else 166)[0].positions
            for model in self.rig.placed_models}

    @cached_property
    def _middle(self) -> np.ndarray:
        """Return the room's middle at the mount's lowest height, else its top: (3,) metres."""
        region, heights = self.region, self.rig.mount.heights
        level = region.top if heights is None else region.floor + heights[0]
        return np.array([*self.simulator.scene.bounds.mean(axis=0)[:2], level])

    def start(self, rng: np.random.Generator, config: EpisodeConfig, cameras: int) -> np.ndarray:
        """
        Draw the start of an episode, as near to the centre of the room as the cameras may be.

        :param cameras: the number of cameras: all K of the rig.
        :returns: (K, 6) metres, map frame, and radians.
        :raises ConfigurationError: if there is no room for all cameras.
        """
        wanted = self._middle[:2] + drawn_near(rng, cameras, config.start_radius)
        taken, rig = self.fixed_poses[:, :3], self.rig
        level = self._middle[2]
        for camera, place in zip(rig.cameras, wanted):
            there = self.region.onto_mount(np.array([[*place, level]]))
            places = there if self.region.allowed(there, camera.model)[0] else np.empty((0, 3))
            places = np.vstack([places, self._starts[camera.model]])
            places = places[satisfies_spacing(places, taken, rig.spacing)]
            if len(places) == 0:
                raise rig.document.error(
                    ('spacing',), f'{rig.spacing:g} m, at which not all of the '
                    f'{len(rig.cameras)} cameras find room in {self.simulator.scene.name}',
                    'a distance at which all do', 'lower it or use fewer cameras')
            nearest = np.argmin(np.linalg.norm(places[:, :2] - place, axis=1))
            taken = np.vstack([taken, places[nearest]])
        positions = taken[len(self.fixed_poses):]
        return np.hstack([positions, first_headings(rig, positions, self._middle[:2])])

    def reached(self, poses: np.ndarray, targets: np.ndarray, config: EpisodeConfig
                ) -> tuple[np.ndarray, bool]:
        """
        Return the poses that cameras reach: the feasible ones nearest to their targets.

        :param poses: (K, 6) metres, map frame, and radians, where they are.
        :param targets: (K, 6), no farther than a time step reaches.
        :returns: (K, 6), and whether any target was not allowed.
        """
        ended, refused = poses.copy(), False
        ended[:, 3:] = targets[:, 3:]
        ended[:, 4] = np.clip(ended[:, 4], *self.rig.pitch)
        for k, (here, target) in enumerate(zip(poses[:, :3], targets[:, :3])):
            if (target == here).all():
                continue
            others = np.vstack([np.delete(ended, k, axis=0), self.fixed_poses])[:, :3]

            def allowed(places: np.ndarray, k: int = k, others: np.ndarray = others
                        ) -> np.ndarray:
                headings = np.broadcast_to(ended[k, 3:], places.shape)
                return (satisfies_spacing(places, others, self.rig.spacing)
                        & self.region.allowed(np.hstack([places, headings]),
                                              self.rig.cameras[k].model))

            place = nearest_place(here, target, config.max_step, self.region.onto_mount, allowed)
            if place is not None:
                ended[k, :3] = place
            wanted = self.region.onto_mount(target[None])[0]
            # A camera that ends within a centimetre of its target was not stopped.
            refused |= bool(np.linalg.norm(ended[k, :3] - wanted) > 0.01)
        return ended, refused

    def look(self, poses: np.ndarray) -> list[View]:
        """Compute the views of the cameras to be placed from poses (K, 6), metres and radians."""
        return self.objective.look(poses)

    def judge(self, views: list[View]) -> RigEvaluation:
        """Evaluate cameras, given their views; those in place are included."""
        return self.objective.judge(views)

    def error(self, result: RigEvaluation) -> float:
        """
        Return the error that rewards are computed from, metres.

        It is the loss in units of the depth error of seeing nothing. Without additional
        requirements it is the depth error itself.
        """
        worst = self.simulator.depth_error.worst
        # This form is free of rounding errors if the loss has no other terms.
        return result.depth_error + (result.loss - result.depth_error / worst) * worst


class PlaneProblem(Problem):
    """
    Cameras that move freely on a horizontal plane, within the bounding box of the room.

    :param simulator: the engine, with the settings of rig, episode and reward.
    """

    dimensions = 2

    def __init__(self, simulator: Simulator) -> None:
        rig = Rig.plane(simulator.config.rig)
        self.objective = Objective(simulator, rig)
        self.simulator = simulator
        self.rig = rig
        self.axes, self.fixed_poses = rig.axes, rig.fixed_poses
        self.models = simulator.models * (len(rig.cameras) // len(simulator.models))

    def start(self, rng: np.random.Generator, config: EpisodeConfig, cameras: int) -> np.ndarray:
        """
        Draw the start of an episode around the centre of the room.

        A camera inside furniture is moved to the nearest position that planners allow.

        :param cameras: the number of cameras, K.
        :returns: (K, 6) metres, map frame, and radians.
        """
        simulator, poses = self.simulator, np.empty((cameras, 6))
        bounds = simulator.scene.bounds
        poses[:, :2] = bounds.mean(axis=0)[:2]
        poses[:, :2] += drawn_near(rng, cameras, config.start_radius)
        poses[:, 2] = simulator.height
        poses[:, :3], _ = kept_inside(poses[:, :3], bounds, config.wall_margin)
        if config.clearance:
            poses[:, :2] = space_of(simulator, cameras, config).inside(poses[:, :2])
        poses[:, 3:] = outwards(cameras, simulator.config.rig.tilt)
        return poses

    def reached(self, poses: np.ndarray, targets: np.ndarray, config: EpisodeConfig
                ) -> tuple[np.ndarray, bool]:
        """
        Return the poses that cameras reach.

        :param poses: (K, 6) metres, map frame, and radians, where they are.
        :param targets: (K, 6), no farther than a time step reaches.
        :returns: (K, 6), and whether any target was not allowed.
        """
        ended = targets.copy()
        ended[:, :3], outside = kept_inside(
            targets[:, :3], self.simulator.scene.bounds, config.wall_margin)
        return ended, outside
