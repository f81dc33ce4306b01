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

from dataclasses import replace
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
from ocp_ros.simulation.room_gains import RoomGoal
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator, View
from ocp_ros.util.settings import ConfigurationError


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
    Return the feasible region of cameras that move freely on a plane in a room.

    :param cameras: the number of cameras; that of the simulator's settings by default.
    :param config: has the distances to walls and surfaces; the simulator's settings by default.
    """
    config = config or simulator.config.episode
    return FreePlane.of(simulator.scene.points, simulator.height,
                        cameras or simulator.config.rig.cameras, config.wall_margin,
                        config.clearance)


class Problem:
    """
    A rig in a room.

    :param objective: the objective of placements; its simulator evaluates them.
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

    def with_range(self, max_range: float) -> 'Problem':
        """Refuse another range of the cameras; see :meth:`PlaneProblem.with_range`."""
        raise ConfigurationError(
            f'max_range: found {max_range:g} m with a rig file; expected none, as its cameras '
            'have ranges of their own')

    def with_rig(self, rig: Rig, config: SimulationConfig, room_goal: RoomGoal | None = None
                 ) -> 'Problem':
        """
        Return the problem of another rig in the same room, which shares the engine.

        :param rig: from a rig file.
        :param config: its settings, with the same engine.
        :param room_goal: what a search has to reach in each room of a floor.
        :raises ConfigurationError: if the rig does not fit the room.
        """
        simulator = self.simulator.with_models(rig.models, config)
        return Problem(Objective(simulator, rig, room_goal), FeasibleRegion(simulator.scene, rig))

    def seen_by_fixed(self) -> Subset:
        """Return the points visible to the cameras in place."""
        seen = self.simulator.nothing()
        for view in self.objective.fixed:
            seen |= Subset(view.seen, self.simulator.visibility.order)
        return seen

    @cached_property
    def _start_positions(self) -> dict[CameraModel, np.ndarray]:
        """Return feasible positions (P, 3), metres, for each camera model."""
        # 166 is 4000 / 24: this number of positions makes about 4000 poses with 24 headings each.
        # Here only the positions are used.
        return {model: self.region.places(
            model, max_count=4000 if model.omnidirectional else 166)[0].positions
            for model in self.rig.placed_models}

    @cached_property
    def _centre(self) -> np.ndarray:
        """
        Return the room's centre (3,), metres, at the mount's least height.

        If the mount has no heights, it is at the top of the room.
        """
        region, heights = self.region, self.rig.mount.heights
        z = region.top if heights is None else region.floor + heights[0]
        return np.array([*self.simulator.scene.bounds.mean(axis=0)[:2], z])

    def start(self, rng: np.random.Generator, config: EpisodeConfig, cameras: int) -> np.ndarray:
        """
        Draw the start of an episode: feasible poses near random points around the room's centre.

        :param cameras: K. It is a parameter because :class:`PlaneProblem` can also start with
            another number; here it has to be the number of cameras of the rig.
        :returns: (K, 6) metres, map frame, and radians.
        :raises ConfigurationError: if there is no room for all cameras.
        """
        rig, centre = self.rig, self._centre
        targets = centre[:2] + drawn_near(rng, cameras, config.start_radius)
        # First the positions of the fixed cameras; the loop adds one for each other camera.
        occupied = self.fixed_poses[:, :3]
        for camera, target in zip(rig.cameras, targets):
            mounted = self.region.onto_mount(np.array([[*target, centre[2]]]))
            # Candidates: the target moved onto the mount, if the camera may be there, and allowed
            # positions all over the room.
            candidates = np.vstack([mounted[self.region.allowed(mounted, camera.model)],
                                    self._start_positions[camera.model]])
            candidates = candidates[satisfies_spacing(candidates, occupied, rig.spacing)]
            if len(candidates) == 0:
                raise rig.document.error(
                    ('spacing',), f'{rig.spacing:g} m, at which not all of the '
                    f'{len(rig.cameras)} cameras find room in {self.simulator.scene.name}',
                    'a distance at which all do', 'lower it or use fewer cameras')
            nearest = np.argmin(np.linalg.norm(candidates[:, :2] - target, axis=1))
            occupied = np.vstack([occupied, candidates[nearest]])
        positions = occupied[len(self.fixed_poses):]
        return np.hstack([positions, first_headings(rig, positions, centre[:2])])

    def reached_poses(self, poses: np.ndarray, targets: np.ndarray, config: EpisodeConfig
                      ) -> tuple[np.ndarray, bool]:
        """
        Return the poses that K cameras reach: the feasible positions nearest to their targets.

        The headings are those of the targets, with the pitch limited to that of the rig. A camera
        that can reach no feasible position stays where it is.

        :param poses: (K, 6) metres, map frame, and radians: the poses before the move.
        :param targets: (K, 6), no farther than a turn reaches.
        :returns: (K, 6), and whether any target was not allowed.
        """
        any_refused = False
        reached = poses.copy()
        reached[:, 3:] = targets[:, 3:]
        reached[:, 4] = np.clip(reached[:, 4], *self.rig.pitch)
        for k, (position, target) in enumerate(zip(poses[:, :3], targets[:, :3])):
            if (target == position).all():
                continue
            # Cameras move one after the other: in ``reached``, cameras with smaller numbers are at
            # their new positions, and all others at their old ones.
            others = np.vstack([np.delete(reached, k, axis=0), self.fixed_poses])[:, :3]

            # The defaults are the values for this camera.
            def are_allowed(positions: np.ndarray, k: int = k, others: np.ndarray = others
                            ) -> np.ndarray:
                headings = np.broadcast_to(reached[k, 3:], positions.shape)
                return (satisfies_spacing(positions, others, self.rig.spacing)
                        & self.region.allowed(np.hstack([positions, headings]),
                                              self.rig.cameras[k].model))

            nearest = nearest_place(position, target, config.max_step, self.region.onto_mount,
                                    are_allowed)
            if nearest is not None:
                reached[k, :3] = nearest
            mounted_target = self.region.onto_mount(target[None])[0]
            # A target counts as allowed if the camera ends within a centimetre of it.
            any_refused |= bool(np.linalg.norm(reached[k, :3] - mounted_target) > 0.01)
        return reached, any_refused

    def look(self, poses: np.ndarray) -> list[View]:
        """Compute the view of each camera to be placed, given poses (K, 6), metres and radians."""
        return self.objective.look(poses)

    def evaluate_views(self, views: list[View]) -> RigEvaluation:
        """Evaluate cameras, given their views; the cameras in place are added."""
        return self.objective.evaluate_views(views)

    def error(self, evaluation: RigEvaluation) -> float:
        """
        Return the error that rewards are computed from, metres.

        This error is the loss x the depth error of seeing nothing. If the rig has no further
        requirements, it equals the depth error.
        """
        worst = self.simulator.depth_error.worst
        # This formula has no rounding errors if the loss has no further terms.
        return evaluation.depth_error + (evaluation.loss - evaluation.depth_error / worst) * worst


class PlaneProblem(Problem):
    """
    Cameras that move freely on a horizontal plane, within the bounding box of the room.

    :param simulator: the engine, with the settings of rig, episode and reward.
    """

    dimensions = 2

    def __init__(self, simulator: Simulator) -> None:
        rig = Rig.plane(simulator.config.rig)
        self.objective = Objective(simulator, rig)
        self.simulator, self.rig = simulator, rig
        self.axes, self.models, self.fixed_poses = rig.axes, rig.models, rig.fixed_poses
        #: Cached feasible regions, by the distances to walls and surfaces, metres.
        self._spaces: dict[tuple[float, float], FreePlane] = {}

    def with_range(self, max_range: float) -> 'PlaneProblem':
        """Return the same problem with another range of the cameras, metres."""
        config = self.simulator.config
        config = replace(config, rig=replace(config.rig, max_range=max_range))
        other = PlaneProblem(self.simulator.with_models([config.rig.model], config))
        other._spaces = self._spaces
        return other

    def start(self, rng: np.random.Generator, config: EpisodeConfig, cameras: int) -> np.ndarray:
        """
        Draw the start of an episode: random poses around the centre of the room.

        A camera too close to a surface is moved to the nearest position that planners allow.

        :param cameras: the number of cameras, K.
        :returns: (K, 6) metres, map frame, and radians.
        """
        simulator = self.simulator
        bounds = simulator.scene.bounds
        poses = np.empty((cameras, 6))
        poses[:, :2] = bounds.mean(axis=0)[:2] + drawn_near(rng, cameras, config.start_radius)
        poses[:, 2] = simulator.height
        poses[:, :3], _ = kept_inside(poses[:, :3], bounds, config.wall_margin)
        if config.clearance:
            # The number of cameras has no effect on ``inside``, so it is not in the key.
            key = config.wall_margin, config.clearance
            if key not in self._spaces:
                self._spaces[key] = space_of(simulator, cameras, config)
            poses[:, :2] = self._spaces[key].inside(poses[:, :2])
        poses[:, 3:] = outwards(cameras)
        return poses

    def reached_poses(self, poses: np.ndarray, targets: np.ndarray, config: EpisodeConfig
                      ) -> tuple[np.ndarray, bool]:
        """
        Return the poses that K cameras reach: their targets, moved into the bounding box.

        :param poses: (K, 6), a parameter of :class:`Problem`, without effect on a plane.
        :param targets: (K, 6) metres, map frame, and radians, no farther than a turn reaches.
        :returns: (K, 6), and whether any target was outside.
        """
        reached = targets.copy()
        reached[:, :3], any_outside = kept_inside(
            targets[:, :3], self.simulator.scene.bounds, config.wall_margin)
        return reached, any_outside
