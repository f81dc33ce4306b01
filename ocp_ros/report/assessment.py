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

"""Assessment of a placement in a room: the data that reports show, each computed once."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from ocp_ros.geometry.engine_config import PROMISING
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.geometry.visibility import MESH
from ocp_ros.report.bill import bill_of_materials
from ocp_ros.report.camera_words import aim_text, camera_label, Instructions, instructions_for
from ocp_ros.report.findings import evaluate_placement, scores_of
from ocp_ros.report.wall_references import Corner, nearest_corner, ReferenceWall, WallReferences
from ocp_ros.rig.placement_file import created_by, data_of, FIXED, Placement
from ocp_ros.rig.plausibility import angle_notes
from ocp_ros.rig.structure import Floors, floors_of
from ocp_ros.scenes.scene import Scene
from ocp_ros.scenes.source_frame import SourceFrame
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulation_config import SimulationConfig


@dataclass(frozen=True, eq=False)
class Assessment:
    """
    A placement in a room, with its scores and findings.

    :ivar objective: the engine in the room, and the rig.
    :ivar placement: poses of the K cameras.
    :ivar found: what ``ocp score --json`` prints: scores, broken, missed, one_more, notes,
        and the bill of materials.
    :ivar requested_frame: frame of files and pages, ``'map'`` or ``'source'``; None for data in
        the map frame and pages for people in the frame of the scan.
    """

    objective: Objective
    placement: Placement
    found: dict[str, Any]
    requested_frame: str | None = None

    @classmethod
    def of(cls, problem: Problem, placement: Placement, frame: str | None = None,
           **more: Any) -> 'Assessment':
        """
        Evaluate a placement that has its rig and the record of its room.

        :param problem: the rig in the room.
        :param frame: requested frame of files, ``'map'`` or ``'source'``; None for the default.
        :param more: other data to add to ``found``.
        """
        found = {'room': placement.room, 'cameras': data_of(placement)['cameras'],
                 **evaluate_placement(problem, placement.poses), **more}
        assessed = cls(problem.objective, replace(placement, scores=found['scores']), found, frame)
        found['bill'] = bill_of_materials(assessed)
        return assessed

    @property
    def frame(self) -> SourceFrame:
        """Return the frame of coordinates on pages for people."""
        return SourceFrame() if self.requested_frame == 'map' else self.scene.source

    @property
    def data_frame(self) -> SourceFrame:
        """Return the frame of tables and files for programs."""
        return self.scene.source if self.requested_frame == 'source' else SourceFrame()

    @property
    def scene(self) -> Scene:
        """Return the room."""
        return self.objective.simulator.scene

    @property
    def positions(self) -> np.ndarray:
        """Return the positions of the K cameras: (K, 3) metres, map frame."""
        return np.array([placed.position for placed in self.placement.cameras])

    @property
    def plan_positions(self) -> np.ndarray:
        """Return the camera positions in a plan with wall A at the top: (K, 2) metres."""
        return self.positions @ self.plan_rotation[:2].T

    @cached_property
    def seen(self) -> np.ndarray:
        """Return whether each of the K cameras sees each of the N scene points: (K, N) bool."""
        views = [*self.objective.look(self.placement.poses), *self.objective.fixed]
        order = self.objective.simulator.visibility.order
        return np.array([Subset(view.seen, order).mask for view in views])

    @property
    def counts(self) -> np.ndarray:
        """Return the number of cameras that see each of the N scene points: (N,) int."""
        return np.sum(self.seen, axis=0)

    @property
    def missed_points(self) -> np.ndarray:
        """Return whether each point is seen by fewer cameras than the rig asks for: (N,) bool."""
        return self.counts < self.objective.rig.seen_by

    @cached_property
    def error_by_point(self) -> np.ndarray:
        """Return the depth error at each point: (N,) metres; the sum is the depth error."""
        errors = np.empty(len(self.scene))
        # The engine sorts the points; ``order`` has the number of each in the scene.
        visible = self.objective.evaluate(self.placement.poses).seen
        errors[visible.order] = self.objective.simulator.depth_error.error_by_point(visible.bits)
        return errors

    @cached_property
    def references(self) -> WallReferences:
        """Return the reference walls, from which camera positions are measured."""
        return WallReferences(self.scene, self.positions)

    @property
    def walls(self) -> list[ReferenceWall]:
        """Return the sides of the rectangle around the room, A to D."""
        return self.references.sides

    @property
    def size(self) -> tuple[float, float]:
        """Return the lengths of walls A and B, metres."""
        return self.walls[0].length, self.walls[1].length

    @property
    def floors(self) -> Floors:
        """Return the floors of the room."""
        return floors_of(self.scene)

    @cached_property
    def instructions(self) -> list[Instructions]:
        """Return the mounting instructions of each camera."""
        return [instructions_for(placed, distances, self.walls, floor, self.frame)
                for placed, distances, floor in zip(
                    self.placement.cameras, self.references.distances,
                    self.floors.under(self.positions))]

    @cached_property
    def aims(self) -> list[str]:
        """Return in words, for each camera, the place at the centre of its picture, or ''."""
        return [aim_text(placed, self.scene, self.walls, self.floors)
                for placed in self.placement.cameras]

    @property
    def corner(self) -> Corner:
        """Return the corner of the room that is nearest to the origin of the coordinates."""
        return nearest_corner(self.walls, self.frame.to_map(np.zeros(3))[:2])

    @property
    def rows(self) -> list[list[str]]:
        """Return the installer's table: camera number, then ``INSTRUCTION_COLUMNS``, in rows."""
        return [[str(number), camera_label(name, placed.mount), *texts]
                for number, (placed, (name, *texts)) in enumerate(
                    zip(self.placement.cameras, self.instructions), start=1)]

    @property
    def plan_rotation(self) -> np.ndarray:
        """Return the rotation (3, 3) from the map frame to the plan's, with wall A at the top."""
        rotation = np.eye(3)
        rotation[0, :2] = self.walls[1].outward
        rotation[1, :2] = self.walls[0].outward
        return rotation


def assess(scene: Scene, placement: Placement, room: dict[str, Any], command: str,
           frame: str | None = None) -> Assessment:
    """
    Evaluate a placement in a room.

    :param placement: a placement, with or without its rig's requirements.
    :param room: record of the room, from :func:`~ocp_ros.rooms.scene_source.room_named`.
    :param command: the command line, for the record of the placement.
    :param frame: requested frame of files, ``'map'`` or ``'source'``; None for the default.
    :raises ConfigurationError: if the placement's rig cannot be used in this room.
    """
    rig = placement.rig_in(scene)
    engine = placement.engine
    notes = []
    if engine.preset == MESH and scene.mesh is None:
        # Rays cannot be cast without a mesh, so use the preset of `ocp plan` for such scans.
        engine = replace(engine, preset=PROMISING.preset)
        notes = [f'the placement was planned by rays cast at a mesh, and {scene.name} is none; '
                 f'the scores are those of the preset {engine.preset}']
    if not placement.created:
        notes += angle_notes(angle for placed in placement.cameras if placed.mount != FIXED
                             for angle in placed.angles)
    problem = Problem.of(scene, rig, SimulationConfig(engine=engine))
    created = created_by(command, placement.created.get('planner', ''))
    assessed = Assessment.of(problem, replace(placement, rig=rig, room=room, created=created),
                             frame)
    # If cameras were measured at other poses than planned, add the scores of the plan.
    if (planned := placement.planned_poses) is not None:
        assessed.found['planned'] = scores_of(problem.objective, problem.look(planned))
    loss = assessed.found['scores']['loss']
    assessed.found['notes'] += [*notes, *_mismatch_notes(placement, room, loss)]
    return assessed


def _mismatch_notes(placement: Placement, room: dict[str, Any], loss: float) -> list[str]:
    """Return a note if the scan or the objective value is not as in the placement file."""
    recorded = placement.scores.get('loss')
    # A file without the hash of its scan cannot be compared with this scan.
    if placement.room.get('sha256') not in (None, room['sha256']):
        return ['the file was made for another scan; the scores in the file are not those of '
                'this scan']
    # The note shows six decimals; smaller differences are not visible in it.
    if isinstance(recorded, float) and abs(recorded - loss) > 1e-6:
        return [f'the file has the objective value {recorded:.6f}; found {loss:.6f}: '
                'rig, points or engine are not those that it was scored with']
    return []
