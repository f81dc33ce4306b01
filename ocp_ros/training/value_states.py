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
Training data of the map actor: its inputs, and the true value of each position as a label.

A rig moves through a room, and at some turns a map is made of the observed points. Labels are
computed for several hundred positions on the map, and for cameras with a limited field of view for
several headings at each position. A label is the change of the depth error of the *true* room if a
camera goes there, given the targets of the other cameras; the present position of the camera has
no effect. The true room is a scan that the rig does not observe, and the room's mesh, with ray
casting; without a mesh it is the finest engine on the points of this scan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from ocp_ros.geometry.cameras import OMNIDIRECTIONAL, PINHOLE, Pose
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import no_bits
from ocp_ros.geometry.visibility import SurfelVisibility
from ocp_ros.online.online_planner import settings_of
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.online.rig_state import record_views
from ocp_ros.online.rollout import state_of
from ocp_ros.policy.map_actor import MapActor, MODEL_POINTS, MODEL_ROWS
from ocp_ros.policy.observation_map import (
    CELLS,
    EDGE_M,
    ERROR_FLOOR,
    lens_features,
    NUMBERS,
    ObservationMap,
    OF_LENS,
    OF_OTHERS,
    OF_ROOM,
    yaws_of,
)
from ocp_ros.rig.motion import towards, turned_towards
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.rig.sensors import SENSORS
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import PlaneProblem, Problem, space_of
from ocp_ros.simulation.ray_visibility import with_rays
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator, View
from ocp_ros.training.training_config import RoomsConfig
from ocp_ros.training.training_rooms import make_scene
from ocp_ros.training.validation import policy_of


@dataclass(frozen=True)
class StatesTuning:
    """
    Sizes of the training data.

    :ivar places: number of labelled positions for omnidirectional cameras.
    :ivar aimed_places: the same, for cameras with a limited field of view.
    :ivar aimed_pitch: pitch of cameras with a limited field of view, radians: the middle of the
        range from level to 30 degrees down.
    :ivar scan_points: numbers of points of the scans that the rig observes.
    :ivar true_points: number of points of the scan that gives the labels.
    :ivar episodes: number of episodes in a room.
    :ivar maps: number of maps of an episode.
    :ivar map_turns: number of time steps from the start of an episode, among which the time steps
        of the maps are drawn.
    :ivar choices: number of choices of cameras on a map.
    """

    places: int = 450
    aimed_places: int = 150
    aimed_pitch: float = float(np.deg2rad(15.0))
    scan_points: tuple[int, ...] = 8_000, 15_000, 25_000, 40_000
    true_points: int = 40_000
    episodes: int = 3
    maps: int = 3
    map_turns: int = 14
    choices: int = 8


TUNING = StatesTuning()


def shapes_of(headings: int) -> dict[str, tuple[type, tuple[int, ...]]]:
    """
    Return by name the type and the shape of a room's states, for one map or one choice.

    The names are those of :func:`play_states`.

    :param headings: number of headings at each position; 0 for omnidirectional cameras.
    """
    places = TUNING.aimed_places if headings else TUNING.places
    return {'room': (np.uint8, (OF_ROOM, CELLS, CELLS)), 'of': (np.int32, ()),
            'others': (np.uint8, (OF_OTHERS, CELLS, CELLS)), 'numbers': (np.float32, (NUMBERS,)),
            'lens': (np.float32, (OF_LENS,)), 'places': (np.float32, (places, 2)),
            'values': (np.float16, (places, max(headings, 1)))}


@dataclass(frozen=True)
class StateTask:
    """
    A room in which states are recorded.

    :ivar rooms: options for making the room.
    :ivar room: name of the room; see :mod:`ocp_ros.training.training_rooms`.
    :ivar seed: random seed of the episodes, and of all choices in them.
    :ivar weights: weights of the policy that moves the cameras, as one blob; empty: the cameras go
        to random poses.
    :ivar headings: number of labelled headings at each position; 0 for omnidirectional cameras.
    """

    rooms: RoomsConfig
    room: str
    seed: tuple[int, ...]
    weights: bytes = b''
    headings: int = 0


class TrueRoom:
    """
    The true values of candidate poses in a room, of which P positions have D headings each.

    :param scene: the room, with its mesh if there is one.
    :param config: range and height of the cameras, and their field of view.
    :param headings: number of headings at each position; 0 for omnidirectional cameras: D is 1.
    :ivar engine: the most exact engine for the scene.
    :ivar space: the feasible region of one camera, without regard to others.
    :ivar places: (P, 2) metres, positions on a grid.
    :ivar poses: (P * D, 6) metres, map frame, and radians: first all headings of one position.
    """

    def __init__(self, scene: Scene, config: SimulationConfig, headings: int = 0) -> None:
        # Labels do not use the space coverage, so its cells may be large.
        engine = EngineConfig(preset='fine', error_rows=64, coverage_cell=1.0)
        self.engine = Simulator(scene, replace(config, engine=with_rays(engine, scene)))
        self.space = space_of(self.engine, 1)
        self.places = self.space.grid(TUNING.aimed_places if headings else TUNING.places)
        # Yaw, pitch and roll of each heading.
        rotations = np.zeros((max(headings, 1), 3))
        if headings:
            rotations[:, 0], rotations[:, 1] = yaws_of(headings), TUNING.aimed_pitch
        positions = self.space.placement(self.places)
        self.poses = np.hstack([np.repeat(positions, len(rotations), axis=0),
                                np.tile(rotations, (len(positions), 1))])
        #: Visible points from each of ``poses``, as packed bits.
        self._seen = [seen for row in positions for seen in self._seen_from(row, rotations)]

    def _seen_from(self, position: np.ndarray, rotations: np.ndarray) -> list[np.ndarray]:
        """Return the visible points, as packed bits, for each yaw, pitch and roll (D, 3)."""
        # All cameras of the rig have one model.
        lens = self.engine.models[0].lens
        # The preset of this engine never makes a CubeVisibility.
        visibility = cast(SurfelVisibility, self.engine.visibility)
        seen, covered = no_bits(len(self.engine.scene)), no_bits(len(self.engine.grid))
        # The view in all directions sets the bits of all visible points and cells; each heading
        # sees a part of this view.
        visibility.look(Pose.of(position), lens._replace(kind=OMNIDIRECTIONAL), seen, covered)
        if lens.kind == OMNIDIRECTIONAL:
            return [seen] * len(rotations)
        return [visibility.narrowed(Pose.of(np.append(position, rotation)), lens, seen, covered)[0]
                for rotation in rotations]

    def nearest_poses(self, targets: np.ndarray, headings: np.ndarray | None = None) -> np.ndarray:
        """
        Return the numbers (K,) of the candidate poses nearest to K targets.

        :param targets: (K, 2) metres.
        :param headings: (K, 3) yaw, pitch and roll in radians; None for omnidirectional cameras.
        """
        distances = np.linalg.norm(targets[:, None] - self.places[None], axis=2)
        heading_count = len(self.poses) // len(self.places)
        # The yaws of the poses are evenly spaced and begin at 0: round to the nearest one.
        heading_numbers = 0 if headings is None else np.rint(
            headings[:, 0] * (heading_count / (2.0 * np.pi))).astype(np.int64) % heading_count
        # All headings of one position have successive numbers.
        return np.argmin(distances, axis=1) * heading_count + heading_numbers

    def values(self, others: Sequence[int]) -> np.ndarray:
        """
        Compute the values of all poses for one camera, given the poses of the other cameras.

        :param others: numbers of the poses of the other cameras.
        :returns: (P * D,) ln((E with the camera + e) / (E of the others + e)); E is the depth
            error, e a small constant; lower is better.
        """
        return self.engine.depth_error.changes(
            [self._seen[other] for other in others], self._seen, ERROR_FLOOR)


def play_states(task: StateTask) -> dict[str, np.ndarray]:
    """
    Run several episodes in a room, and record states with labels.

    :returns: of M maps ``room`` (M, ...) and of S choices ``others`` (S, ...) and ``numbers``
        (S, ...), see :class:`~ocp_ros.policy.observation_map.ObservationMap`; ``lens`` (S, ...),
        see :func:`~ocp_ros.policy.observation_map.lens_features`; ``of`` (S,), the number of the
        map of each choice; ``places`` (M, P, 2), the P labelled positions in cells of the map; and
        ``values`` (S, P, D) float16, their labels for D headings, NaN for positions that the room
        lacks.
    """
    rng = np.random.default_rng(task.seed)
    # Half of the rooms are rotated. The labels come from the true scan, the rig observes ``scan``.
    degrees = float(rng.uniform(0.0, 360.0)) if rng.random() < 0.5 else 0.0
    true_scan = make_scene(replace(task.rooms, points=TUNING.true_points), task.room, degrees)
    points = int(rng.choice(TUNING.scan_points))
    scan = make_scene(replace(task.rooms, points=points), task.room, degrees)
    heights_m = (1.0, 2.3)
    # Half of the rooms, and all rooms below the largest height of cameras, have the range and the
    # height of the default rig.
    is_default = rng.random() < 0.5 or true_scan.size[2] < heights_m[1]
    # The rig has the largest number of cameras; an episode has some of them.
    camera_counts = np.arange(1, 9)
    rig = RigConfig(cameras=camera_counts[-1]) if is_default else RigConfig(
        cameras=camera_counts[-1], max_range=float(rng.uniform(3.0, 6.0)),
        height=float(rng.uniform(*heights_m)))
    if task.headings:
        names = [name for name, sensor in SENSORS.items() if sensor.model.lens.kind == PINHOLE]
        rig = replace(rig, sensors=str(rng.choice(names)))
    # The depth error of this engine is not used: labels come from ``TrueRoom``.
    config = SimulationConfig(rig, EngineConfig(preset='fine', error_rows=16))
    problem = PlaneProblem(Simulator(scan, config))
    states = _StateRecorder(TrueRoom(true_scan, config, task.headings), rng, task)
    # Episodes with 4 cameras, as in the default rig, are the most frequent.
    probabilities = np.array([1, 2, 3, 5, 3, 3, 1, 1]) / 19.0
    for _ in range(TUNING.episodes):
        cameras = int(rng.choice(camera_counts, p=probabilities))
        states.play(problem, cameras, max_step=float(rng.uniform(0.5, 2.0)), weights=task.weights)
    return states.arrays()


class _StateRecorder:
    """Run episodes in a room, and record maps and choices of cameras on them."""

    def __init__(self, room: TrueRoom, rng: np.random.Generator, task: StateTask) -> None:
        self._room = room
        self._rng = rng
        self._headings = task.headings
        self._lens = room.engine.models[0].lens if task.headings else None
        #: Of each map: the channels of the room.
        self._maps: list[np.ndarray] = []
        #: Of each map: the labelled positions (P, 2) in cells.
        self._places: list[np.ndarray] = []
        #: Of each choice: the number of its map, the channels and the scalar inputs of the other
        #: cameras, and the labels.
        self._choices: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        #: Numbers of the poses that the cameras chose last.
        self._last_choices: list[int] = []

    def play(self, problem: Problem, cameras: int, max_step: float, weights: bytes) -> None:
        """Run an episode; at some turns record a map, and the choices of some cameras."""
        rng = self._rng
        history = LookHistory()
        # Draw the settings. Only the turns up to the last map are run; the planned end of the
        # episode comes up to 5 turns later.
        map_turns = np.sort(rng.choice(TUNING.map_turns, TUNING.maps, replace=False))
        turns = int(map_turns[-1]) + 1 + int(rng.integers(6))
        simulator = problem.simulator
        simulator.config = replace(simulator.config, episode=EpisodeConfig(
            turns=turns, max_step=max_step, start_radius=float(rng.choice([0.5, 3.0])),
            max_turn=float(rng.uniform(0.5, 2.0)) if self._headings else EpisodeConfig.max_turn))
        settings = settings_of(simulator.config.episode, problem.rig, rng)
        actor = MapActor(policy_of(weights), *settings) if weights else None
        episode = Episode(problem, rng, cameras)
        # Numbers of the target poses. With an actor, the cameras move to its own targets instead.
        chosen = self._draw_poses(cameras)
        for turn in range(int(map_turns[-1]) + 1):
            positions, cloud = episode.turn.positions, episode.observed_cloud
            rig_state = state_of(episode) if self._headings else None
            record_views(history, positions, rig_state)
            if turn in map_turns:
                if actor is not None and actor.targets is not None:
                    # Labels are of candidate poses: take those nearest to the actor's targets.
                    chosen = self._room.nearest_poses(actor.targets, actor.headings)
                chosen = self._record_map(cloud, positions, history, chosen, problem.rig.farthest)
            targets = self._room.poses[chosen]
            moves = self._moves_to(positions, targets[:, :2], max_step)
            headings = targets[:, 3:]
            if actor is not None:
                actor.set_rig_state(rig_state)
                moves = actor.move(cloud, positions, turn, turns)
                headings = headings if actor.headings is None else actor.headings
            episode.move(moves, None if rig_state is None else turned_towards(
                episode.turn.headings, headings, episode.config.max_turn))

    def _moves_to(self, positions: np.ndarray, targets: np.ndarray, reach: float) -> np.ndarray:
        """Return moves (K, 2), metres, of at most ``reach``, within the feasible region."""
        starts = positions[:, :2]
        moves = towards(starts, targets, reach) - starts
        return self._room.space.moved(starts, moves, reach) - starts

    def _draw_poses(self, cameras: int) -> np.ndarray:
        """Draw a pose number for each camera; half of the time, the last choices come first."""
        drawn = self._rng.integers(len(self._room.poses), size=cameras)
        if self._last_choices and self._rng.random() < 0.5:
            count = min(cameras, len(self._last_choices))
            drawn[:count] = self._rng.permutation(self._last_choices)[:count]
        return drawn

    def _record_map(self, cloud: np.ndarray, positions: np.ndarray, history: LookHistory,
                    chosen: np.ndarray, max_range: float) -> np.ndarray:
        """
        Record the map of a turn, and choices of some cameras, one after the other.

        :param cloud: (M, 3) metres, the observed points.
        :param positions: (K, 3) metres, of K cameras.
        :param history: the poses from which cameras have looked so far.
        :param chosen: (K,) numbers of the poses that the cameras chose last.
        :param max_range: the largest range of a camera, metres.
        :returns: (K,) numbers of the poses that the cameras have chosen after this map; ``chosen``
            if there is no map, because the observed points are too few.
        """
        rng, poses, cameras = self._rng, self._room.poses, len(positions)
        # A fifth of the maps have larger cells, as the maps of large rooms have.
        cell_scale = rng.uniform(1.0, 2.0) if rng.random() < 0.2 else 1.0
        try:
            model = PartialMap(cloud, positions, max_range, MODEL_POINTS, MODEL_ROWS)
        except SceneError:
            return chosen
        observed = ObservationMap(model, history.unseen(model), cameras, max_range,
                                  float(positions[0, 2]), cell_scale * EDGE_M)
        # Half of the maps begin with the poses that were chosen last, the others with drawn ones.
        chosen = (chosen if rng.random() < 0.5 else self._draw_poses(cameras)).copy()
        views = [self._view_from(model, poses[pose], positions) for pose in chosen]
        map_number = len(self._maps)
        self._maps.append(observed.room)
        cells = (self._room.places - observed.window.low) / observed.window.edge
        self._places.append(cells.astype(np.float32))
        # Cameras choose one after the other, from a random one on, and again after the last one.
        first = int(rng.integers(cameras))
        for camera in (first + np.arange(TUNING.choices)) % cameras:
            others = np.delete(chosen, camera)
            values = self._room.values(others)
            channels, numbers = observed.others(
                views[:camera] + views[camera + 1:], poses[others])
            self._choices.append((map_number, channels, numbers, values))
            # The labels above are of all poses; the pose chosen here affects later labels only.
            # Some choices are random. The rest are the best pose by labels with noise, so that
            # other good poses are chosen too.
            if rng.random() < 0.15:
                chosen[camera] = rng.integers(len(poses))
            else:
                chosen[camera] = np.argmin(values + rng.normal(0.0, 0.04, len(values)))
            views[camera] = self._view_from(model, poses[chosen[camera]], positions)
        self._last_choices = chosen.tolist()
        return chosen

    def _view_from(self, model: PartialMap, pose: np.ndarray, positions: np.ndarray) -> View:
        """Return the view of the partial map from a pose (6,), moved to the cameras' height."""
        pose = np.array([*pose[:2], positions[0, 2], *pose[3:]])
        return model.look(pose[:3] if self._lens is None else pose, self._lens)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all maps and choices; see :func:`play_states`."""
        if not self._choices:
            # The observed points were never enough for a map.
            return {name: np.empty((0, *shape), kind)
                    for name, (kind, shape) in shapes_of(self._headings).items()}
        map_numbers, others, numbers, values = zip(*self._choices)
        # A small room has fewer positions: pad them at the centre of the map, without labels.
        count = len(self._room.places)
        _, (max_count, _) = shapes_of(self._headings)['places']
        padding = ((0, 0), (0, max_count - count), (0, 0))
        labels = np.stack(values).astype(np.float16).reshape(len(values), count, -1)
        return {'room': np.stack(self._maps), 'of': np.array(map_numbers, dtype=np.int32),
                'others': np.stack(others), 'numbers': np.stack(numbers),
                'lens': np.tile(lens_features(self._lens), (len(values), 1)),
                'places': np.pad(np.stack(self._places), padding, constant_values=0.5 * CELLS),
                'values': np.pad(labels, padding, constant_values=np.nan)}
