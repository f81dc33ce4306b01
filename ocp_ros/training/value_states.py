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

A rig moves through a room, and at some turns a map is made of the observed points. The label is
dense and privileged. For one camera and several hundred positions it is the change of the depth
error of the *true* room if the camera goes there, given the targets of the other cameras; for
cameras with a limited field of view it is computed for several headings at each position. It does
not depend on the present position of the camera. The true room is the room's mesh, with ray
casting, and a scan that the rig does not observe; without a mesh it is the finest engine on the
points of the scan.
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
from ocp_ros.training.training_rooms import make
from ocp_ros.training.validation import policy_of

#: Number of labelled positions.
PLACES = 450
#: Number of labelled positions for cameras with a limited field of view.
AIMED_PLACES = 150
#: Sensors with a limited field of view.
AIMED_SENSORS = tuple(name for name, sensor in SENSORS.items()
                      if sensor.model.lens.kind == PINHOLE)
#: Their pitch in radians, the middle of a range of pitches that begins level.
AIMED_PITCH = float(np.deg2rad(15.0))
#: Numbers of points of the scans that the rig observes.
SCAN_POINTS = (8_000, 15_000, 25_000, 40_000)
#: Number of points of the scan that gives the labels.
TRUE_POINTS = 40_000
#: Episodes in a room, the latest time step with a map, the maps of an episode, and the choices of
#: cameras on a map.
EPISODES, TURNS, MAPS, CHOICES = 3, 14, 3, 8


def shapes_of(headings: int) -> dict[str, tuple[type, tuple[int, ...]]]:
    """
    Return type and shape of each array of a room's states, for one map or one choice.

    :param headings: number of headings at each position; 0 for omnidirectional cameras.
    """
    places = AIMED_PLACES if headings else PLACES
    return {'room': (np.uint8, (OF_ROOM, CELLS, CELLS)), 'of': (np.int32, ()),
            'others': (np.uint8, (OF_OTHERS, CELLS, CELLS)), 'numbers': (np.float32, (NUMBERS,)),
            'lens': (np.float32, (OF_LENS,)), 'places': (np.float32, (places, 2)),
            'values': (np.float16, (places, max(headings, 1)))}


@dataclass(frozen=True)
class StateTask:
    """
    A room in which states are recorded.

    :ivar rooms: options for making the room.
    :ivar room: its name; see :mod:`ocp_ros.training.training_rooms`.
    :ivar seed: of all random choices.
    :ivar weights: of the policy that plays, as one blob; empty: the cameras go to random poses.
    :ivar headings: number of labelled headings at each position; 0 for omnidirectional cameras.
    """

    rooms: RoomsConfig
    room: str
    seed: tuple[int, ...]
    weights: bytes = b''
    headings: int = 0


class TrueRoom:
    """
    The true values of candidate poses in a room.

    :param scene: the room, with its mesh if there is one.
    :param config: range and height of the cameras, and their field of view.
    :param headings: D, number of headings at each position; 0 for omnidirectional cameras.
    :ivar engine: the most exact engine for the scene.
    :ivar space: the feasible region of the cameras.
    :ivar places: (P, 2) metres, positions on a grid.
    :ivar poses: (P * D, 6) metres, map frame, and radians: all headings of a position in sequence.
    """

    def __init__(self, scene: Scene, config: SimulationConfig, headings: int = 0) -> None:
        engine = EngineConfig(preset='fine', error_rows=64, coverage_cell=1.0)
        self.engine = Simulator(scene, replace(config, engine=with_rays(engine, scene)))
        self.space = space_of(self.engine, 1)
        self.places = self.space.grid(AIMED_PLACES if headings else PLACES)
        aims = np.zeros((max(headings, 1), 3))
        if headings:
            aims[:, 0], aims[:, 1] = yaws_of(headings), AIMED_PITCH
        at = self.space.placement(self.places)
        self.poses = np.hstack([np.repeat(at, len(aims), axis=0), np.tile(aims, (len(at), 1))])
        self._seen = [seen for place in at for seen in self._looks(place, aims)]

    def _looks(self, place: np.ndarray, aims: np.ndarray) -> list[np.ndarray]:
        """Return the packed points visible from a position, for each heading (D, 3), radians."""
        lens = self.engine.models[0].lens
        # The preset of this engine never uses the other kind of visibility, points as cubes.
        look = cast(SurfelVisibility, self.engine.visibility)
        seen, covered = no_bits(len(self.engine.scene)), no_bits(len(self.engine.grid))
        look.look(Pose.of(place), lens._replace(kind=OMNIDIRECTIONAL), seen, covered)
        if lens.kind == OMNIDIRECTIONAL:
            return [seen] * len(aims)
        return [look.narrowed(Pose.of(np.append(place, one)), lens, seen, covered)[0]
                for one in aims]

    def nearest(self, targets: np.ndarray, headings: np.ndarray | None = None) -> np.ndarray:
        """
        Return the numbers (K,) of the candidate poses nearest to some targets.

        :param targets: (K, 2) metres.
        :param headings: (K, 3) radians; None for omnidirectional cameras.
        """
        away = np.linalg.norm(targets[:, None] - self.places[None], axis=2)
        count = len(self.poses) // len(self.places)
        number = 0 if headings is None else np.rint(
            headings[:, 0] * (count / (2.0 * np.pi))).astype(np.int64) % count
        return np.argmin(away, axis=1) * count + number

    def values(self, others: Sequence[int]) -> np.ndarray:
        """
        Compute the values of all poses for one camera, given the poses of the other cameras.

        :param others: numbers of the poses of the other cameras.
        :returns: (P * D,) ln((E with the camera + e) / (E of the others + e)) of the depth error
            E; lower is better.
        """
        return self.engine.depth_error.changes(
            [self._seen[other] for other in others], self._seen, ERROR_FLOOR)


def play_states(task: StateTask) -> dict[str, np.ndarray]:
    """
    Run several episodes in a room, and record states with labels.

    :returns: of M maps ``room`` (M, ...) and of S choices ``others`` (S, ...) and ``numbers``
        (S, ...), see :class:`~ocp_ros.policy.observation_map.ObservationMap`; ``lens`` (S, ...),
        see :func:`~ocp_ros.policy.observation_map.lens_features`; ``of`` (S,), the map of each
        choice; ``places`` (M, P, 2), the labelled positions in cells of the map; and ``values``
        (S, P, D) float16, the labels, NaN beyond the last position.
    """
    rng = np.random.default_rng(task.seed)
    rotation = float(rng.uniform(0.0, 360.0)) if rng.random() < 0.5 else 0.0
    true = make(replace(task.rooms, points=TRUE_POINTS), task.room, rotation)
    scan = make(replace(task.rooms, points=int(rng.choice(SCAN_POINTS))), task.room, rotation)
    heights_m = (1.0, 2.3)
    # Half of the rooms have the range and the height of the default rig.
    plain = rng.random() < 0.5 or true.size[2] < heights_m[1]
    counts = np.arange(1, 9)
    rig = RigConfig(cameras=counts[-1]) if plain else RigConfig(
        cameras=counts[-1], max_range=float(rng.uniform(3.0, 6.0)),
        height=float(rng.uniform(*heights_m)))
    if task.headings:
        rig = replace(rig, sensors=str(rng.choice(AIMED_SENSORS)))
    config = SimulationConfig(rig, EngineConfig(preset='fine', error_rows=16))
    room = TrueRoom(true, config, task.headings)
    problem = PlaneProblem(Simulator(scan, config))
    states = _States(room, rng, task)
    # Three episodes in a room.
    probabilities = np.array([1, 2, 3, 5, 3, 3, 1, 1]) / 19.0
    for _ in range(EPISODES):
        cameras = int(rng.choice(counts, p=probabilities))
        # The step is 0.5 to 2 m.
        states.play(problem, cameras, float(rng.uniform(0.5, 2.0)), task.weights)
    return states.arrays()


class _States:
    """The recorded maps and choices of a room."""

    def __init__(self, room: TrueRoom, rng: np.random.Generator, task: StateTask) -> None:
        self._room = room
        self._rng = rng
        self._headings = task.headings
        self._lens = room.engine.models[0].lens if task.headings else None
        self._maps: list[np.ndarray] = []
        self._places: list[np.ndarray] = []
        self._choices: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        #: Numbers of the poses that the cameras chose last.
        self._last_choices: list[int] = []

    def play(self, problem: Problem, cameras: int, step: float, weights: bytes) -> None:
        """Run an episode; at some turns record a map and let the cameras choose."""
        rng, history = self._rng, LookHistory()
        map_turns = np.sort(rng.choice(TURNS, MAPS, replace=False))
        turns = int(map_turns[-1]) + 1 + int(rng.integers(6))
        simulator = problem.simulator
        simulator.config = replace(simulator.config, episode=EpisodeConfig(
            turns=turns, max_step=step, start_radius=float(rng.choice([0.5, 3.0])),
            max_turn=float(rng.uniform(0.5, 2.0)) if self._headings else EpisodeConfig.max_turn))
        settings = settings_of(simulator.config.episode, problem.rig, rng)
        actor = MapActor(policy_of(weights), *settings) if weights else None
        episode = Episode(problem, rng, cameras)
        chosen = self._draw_targets(cameras)
        for turn in range(int(map_turns[-1]) + 1):
            positions, cloud = episode.turn.positions, episode.observed_cloud
            rig_state = state_of(episode) if self._headings else None
            record_views(history, positions, rig_state)
            if turn in map_turns:
                if actor is not None and actor.targets is not None:
                    chosen = self._room.nearest(actor.targets, actor.headings)
                chosen = self._choose(cloud, positions, history, chosen, settings[2])
            goals = self._room.poses[chosen]
            moves, headings = self._moves_towards(positions, goals[:, :2], step), goals[:, 3:]
            if actor is not None:
                actor.set_rig_state(rig_state)
                moves = actor.move(cloud, positions, turn, turns)
                headings = headings if actor.headings is None else actor.headings
            episode.move(moves, None if rig_state is None else turned_towards(
                episode.turn.headings, headings, episode.config.max_turn))

    def _moves_towards(self, positions: np.ndarray, places: np.ndarray, step: float) -> np.ndarray:
        """Return moves (K, 2), metres, towards targets, within the true feasible region."""
        flat = positions[:, :2]
        way = towards(flat, places, step) - flat
        return self._room.space.moved(flat, way, step) - flat

    def _draw_targets(self, cameras: int) -> np.ndarray:
        """Draw target poses; with probability 0.5 some of them are the last good ones."""
        drawn = self._rng.integers(len(self._room.poses), size=cameras)
        if self._last_choices and self._rng.random() < 0.5:
            count = min(cameras, len(self._last_choices))
            drawn[:count] = self._rng.permutation(self._last_choices)[:count]
        return drawn

    def _choose(self, cloud: np.ndarray, positions: np.ndarray, history: LookHistory,
                chosen: np.ndarray, max_range: float) -> np.ndarray:
        """Record the map of a turn and the choices of cameras; return the chosen poses."""
        rng, places, cameras = self._rng, self._room.places, len(positions)
        poses = self._room.poses
        coarse = rng.uniform(1.0, 2.0) if rng.random() < 0.2 else 1.0
        try:
            model = PartialMap(cloud, positions, max_range, MODEL_POINTS, MODEL_ROWS)
        except SceneError:
            return chosen
        observed = ObservationMap(model, history.unseen(model), cameras, max_range,
                                  float(positions[0, 2]), coarse * EDGE_M)
        chosen = (chosen if rng.random() < 0.5 else self._draw_targets(cameras)).copy()
        views = [self._look(model, poses[pose], positions) for pose in chosen]
        number = len(self._maps)
        self._maps.append(observed.room)
        window = observed.window
        self._places.append(((places - window.low) / window.edge).astype(np.float32))
        first = int(rng.integers(cameras))
        # One camera after the other chooses.
        for camera in (first + np.arange(CHOICES)) % cameras:
            others = np.delete(chosen, camera)
            values = self._room.values(others)
            channels, numbers = observed.others(
                views[:camera] + views[camera + 1:], poses[others])
            self._choices.append((number, channels, numbers, values))
            if rng.random() < 0.15:
                chosen[camera] = rng.integers(len(poses))
            else:
                # Noise is added to the labels before the best pose is chosen.
                chosen[camera] = np.argmin(values + rng.normal(0.0, 0.04, len(values)))
            views[camera] = self._look(model, poses[chosen[camera]], positions)
        self._last_choices = chosen.tolist()
        return chosen

    def _look(self, model: PartialMap, pose: np.ndarray, positions: np.ndarray) -> View:
        """Return the view of the partial map from a pose (6,) at the height of the cameras."""
        row = np.array([*pose[:2], positions[0, 2], *pose[3:]])
        return model.look(row[:3] if self._lens is None else row, self._lens)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all maps and choices; see :func:`play_states`."""
        if not self._choices:
            # The observed points were never enough for a map.
            return {name: np.empty((0, *shape), kind)
                    for name, (kind, shape) in shapes_of(self._headings).items()}
        of, others, numbers, values = zip(*self._choices)
        places, count = np.stack(self._places), len(self._room.places)
        most = shapes_of(self._headings)['places'][1][0]
        padding = ((0, 0), (0, most - count), (0, 0))
        labels = np.stack(values).astype(np.float16).reshape(len(values), count, -1)
        return {'room': np.stack(self._maps), 'of': np.array(of, dtype=np.int32),
                'others': np.stack(others), 'numbers': np.stack(numbers),
                'lens': np.tile(lens_features(self._lens), (len(values), 1)),
                'places': np.pad(places, padding, constant_values=0.5 * CELLS),
                'values': np.pad(labels, padding, constant_values=np.nan)}
