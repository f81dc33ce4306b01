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
What there is to solve in a room: which cameras, where they may be, what placements are worth.

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

#: Metres: who ends this near to where it was sent was not stopped.
NEAR = 0.01
#: Places that starts are drawn of, for cameras that are turned and for those that see all around.
STARTS, ALL_ROUND = 166, 4000


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
    Return where cameras that move freely on a plane may be in a room.

    :param cameras: how many there are; those of the simulator's settings by default.
    :param config: their distance to surfaces; that of the simulator's settings by default.
    """
    config = config or simulator.config.episode
    return FreePlane.of(simulator.scene.points, simulator.height,
                        cameras or simulator.config.rig.cameras, config.wall_margin,
                        config.clearance)


class Problem:
    """
    A rig in a room.

    :param objective: judges placements; its simulator is the engine.
    :param region: where its cameras may be.
    :ivar axes: what an action changes, see :attr:`ocp_ros.rig.rig_file.Rig.axes`.
    :ivar dimensions: in which cameras move.
    :ivar models: what each camera sees: K to be placed, then F in place.
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
        Put a rig into a room.

        :param config: the settings of engine, episode and reward.
        :raises ConfigurationError: if the rig does not go with the room.
        """
        region = FeasibleRegion(scene, rig)
        simulator = Simulator(scene, config or SimulationConfig(), rig.models)
        return cls(Objective(simulator, rig), region)

    def nothing(self) -> Subset:
        """Return what is seen before the cameras look: what those in place see."""
        seen = self.simulator.nothing()
        for view in self.objective.fixed:
            seen |= Subset(view.seen, self.simulator.visibility.order)
        return seen

    @cached_property
    def _starts(self) -> dict[CameraModel, np.ndarray]:
        """Return places where a camera of each model may be: (M, 3) metres."""
        return {model: self.region.places(
            model, ALL_ROUND if model.omnidirectional else STARTS)[0].positions
            for model in self.rig.placed_models}

    @cached_property
    def _middle(self) -> np.ndarray:
        """Return the middle of the room, as high as cameras hang lowest: (3,) metres."""
        region, heights = self.region, self.rig.mount.heights
        level = region.top if heights is None else region.floor + heights[0]
        return np.array([*self.simulator.scene.bounds.mean(axis=0)[:2], level])

    def start(self, rng: np.random.Generator, config: EpisodeConfig, cameras: int) -> np.ndarray:
        """
        Draw where an episode begins, as near to the centre of the room as cameras may be.

        :param cameras: how many there are; all K of the rig.
        :returns: (K, 6) metres, map frame, and radians.
        :raises ConfigurationError: if the cameras do not find room.
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
        Tell where cameras end that are sent somewhere: as near to it as they may be.

        :param poses: (K, 6) metres, map frame, and radians, where they are.
        :param targets: (K, 6), no farther than a time step reaches.
        :returns: (K, 6), and whether one of them was sent to where it must not be.
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
            refused |= bool(np.linalg.norm(ended[k, :3] - wanted) > NEAR)
        return ended, refused

    def look(self, poses: np.ndarray) -> list[View]:
        """Compute what the cameras to be placed see from poses (K, 6), metres and radians."""
        return self.objective.look(poses)

    def judge(self, views: list[View]) -> RigEvaluation:
        """Judge cameras by what they see, those in place included."""
        return self.objective.judge(views)

    def error(self, result: RigEvaluation) -> float:
        """
        Return the error that rewards are made of, metres.

        It is the loss in units of the depth error of seeing nothing: the depth error itself where
        no region matters more than the rest.
        """
        worst = self.simulator.depth_error.worst
        # Without any rounding where nothing else counts.
        return result.depth_error + (result.loss - result.depth_error / worst) * worst


class PlaneProblem(Problem):
    """
    Cameras that move freely on a horizontal plane, within the bounding box of the room.

    :param simulator: the engine, with the settings of rig, episode and reward.
    """

    dimensions = 2

    def __init__(self, simulator: Simulator) -> None:
        rig = Rig.plane(simulator.config.rig)
        self.objective, self.simulator, self.rig = Objective(simulator, rig), simulator, rig
        self.axes, self.fixed_poses = rig.axes, rig.fixed_poses
        self.models = simulator.models * (len(rig.cameras) // len(simulator.models))

    def start(self, rng: np.random.Generator, config: EpisodeConfig, cameras: int) -> np.ndarray:
        """
        Draw where an episode begins, around the centre of the room.

        Who would stand in furniture begins at the nearest place where planners may put it.

        :param cameras: how many there are, K.
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
        Tell where cameras end that are sent somewhere.

        :param poses: (K, 6) metres, map frame, and radians, where they are.
        :param targets: (K, 6), no farther than a time step reaches.
        :returns: (K, 6), and whether one of them was sent to where it must not be.
        """
        ended = targets.copy()
        ended[:, :3], outside = kept_inside(
            targets[:, :3], self.simulator.scene.bounds, config.wall_margin)
        return ended, outside
