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
States and labels of the map actor: what it reads, and what each place is truly worth.

A rig walks through a room, and at some turns what it has seen is turned into a map. The label is
dense and privileged: for a camera and some hundred places at once, by how much the depth error of
the *true* room changes if the camera goes there, given where the others go; of cameras that do not
see all around, for some headings at each place. It does not depend on where the camera is. Truth
is ray casting of the room's mesh, on a scan that the rig never sees; where there is no mesh, the
engine at its best on the points of the scan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from ocp_ros.geometry.cameras import OMNIDIRECTIONAL, PINHOLE, Pose
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.geometry.packed_bits import no_bits
from ocp_ros.geometry.visibility import SurfelVisibility
from ocp_ros.online.observation_map import (
    CELLS,
    EDGE,
    FLOOR,
    lens_features,
    NUMBERS,
    ObservationMap,
    OF_LENS,
    OF_OTHERS,
    OF_ROOM,
    yaws_of,
)
from ocp_ros.online.online_planner import settings_of
from ocp_ros.online.partial_map import LookHistory, PartialMap
from ocp_ros.online.rig_state import record_views
from ocp_ros.online.rollout import state_of
from ocp_ros.policy.map_actor import MapActor, PLAIN_POINTS, PLAIN_ROWS
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

#: Places that are labelled, points of the scan that is true, and rows of its depth maps.
PLACES, TRUE_POINTS, TRUE_ROWS = 450, 40_000, 64
#: Places where cameras are turned; those that do not see all around, and how they are turned up
#: or down there: the middle of a range of pitches that starts level.
AIMED_PLACES = 150
AIMED = tuple(name for name, sensor in SENSORS.items() if sensor.model.lens.kind == PINHOLE)
AIMED_PITCH = float(np.deg2rad(15.0))
#: Points of the scans that are walked through.
SCANS = (8_000, 15_000, 25_000, 40_000)
#: Episodes of a room, maps of an episode, and choices of one camera after the other on each map.
EPISODES, MAPS, CHOICES = 3, 3, 8
#: How many cameras there are, how often.
CAMERAS, OFTEN = np.arange(1, 9), np.array([1, 2, 3, 5, 3, 3, 1, 1]) / 19.0
#: The shortest and the longest step, metres; turns before a map; metres that cameras see; metres
#: that they are above the floor.
STEPS, TURNS, RANGES, HEIGHTS = (0.5, 2.0), 14, (3.0, 6.0), (1.0, 2.3)
#: How far cameras are turned in a turn at least and at most, radians.
TURNED = 0.5, 2.0
#: How often a camera goes anywhere, and how near to the best, in the label, another one goes.
AT_RANDOM, NEARLY = 0.15, 0.04
#: How often range and height are those of the default rig, and cells are larger, and how much at
#: most.
PLAIN, COARSE, COARSEST = 0.5, 0.2, 2.0


def shapes_of(headings: int) -> dict[str, tuple[type, tuple[int, ...]]]:
    """
    Return what the states of a room are: kinds, and shapes of one map or of one choice.

    :param headings: how many cameras are turned to at a place; 0 for those that see all around.
    """
    places = AIMED_PLACES if headings else PLACES
    return {'room': (np.uint8, (OF_ROOM, CELLS, CELLS)), 'of': (np.int32, ()),
            'others': (np.uint8, (OF_OTHERS, CELLS, CELLS)), 'numbers': (np.float32, (NUMBERS,)),
            'lens': (np.float32, (OF_LENS,)), 'places': (np.float32, (places, 2)),
            'values': (np.float16, (places, max(headings, 1)))}


@dataclass(frozen=True)
class StateTask:
    """
    A room to walk through.

    :ivar rooms: how it is made.
    :ivar room: its name; see :mod:`ocp_ros.training.training_rooms`.
    :ivar seed: of everything that is drawn.
    :ivar weights: of the policy that plays, as one blob; empty for walks to drawn places.
    :ivar headings: how many are valued at each place; 0 for cameras that see all around.
    """

    rooms: RoomsConfig
    room: str
    seed: tuple[int, ...]
    weights: bytes = b''
    headings: int = 0


class TrueRoom:
    """
    What places of a room are truly worth.

    :param scene: the room, with its mesh if there is one.
    :param config: range and height of the cameras, and their lens.
    :param headings: D, how many are valued at each place; 0 for cameras that see all around.
    :ivar engine: the nearest to the truth that there is.
    :ivar space: where cameras may be.
    :ivar places: (P, 2) metres, those of a grid.
    :ivar poses: (P * D, 6) metres, map frame, and radians: the headings of a place in a row.
    """

    def __init__(self, scene: Scene, config: SimulationConfig, headings: int = 0) -> None:
        engine = EngineConfig(preset='fine', error_rows=TRUE_ROWS, coverage_cell=1.0)
        self.engine = Simulator(scene, replace(config, engine=with_rays(engine, scene)))
        self.space = space_of(self.engine, 1)
        self.places = self.space.grid(AIMED_PLACES if headings else PLACES)
        turned = np.zeros((max(headings, 1), 3))
        if headings:
            turned[:, 0], turned[:, 1] = yaws_of(headings), AIMED_PITCH
        at = self.space.placement(self.places)
        self.poses = np.hstack([np.repeat(at, len(turned), axis=0), np.tile(turned, (len(at), 1))])
        self._seen = [seen for place in at for seen in self._looks(place, turned)]

    def _looks(self, place: np.ndarray, turned: np.ndarray) -> list[np.ndarray]:
        """Return the packed bits of what a camera sees at a place, turned (D, 3) radians."""
        lens = self.engine.models[0].lens
        # Points as cubes, the other kind, are those of another preset.
        look = cast(SurfelVisibility, self.engine.visibility)
        seen, covered = no_bits(len(self.engine.scene)), no_bits(len(self.engine.grid))
        look.look(Pose.of(place), lens._replace(kind=OMNIDIRECTIONAL), seen, covered)
        if lens.kind == OMNIDIRECTIONAL:
            return [seen] * len(turned)
        return [look.narrowed(Pose.of(np.append(place, one)), lens, seen, covered)[0]
                for one in turned]

    def nearest(self, targets: np.ndarray, headings: np.ndarray | None = None) -> np.ndarray:
        """
        Return the numbers (K,) of the poses next to some others.

        :param targets: (K, 2) metres.
        :param headings: (K, 3) radians; None for cameras that see all around.
        """
        away = np.linalg.norm(targets[:, None] - self.places[None], axis=2)
        count = len(self.poses) // len(self.places)
        turned = 0 if headings is None else np.rint(
            headings[:, 0] * (count / (2.0 * np.pi))).astype(np.int64) % count
        return np.argmin(away, axis=1) * count + turned

    def values(self, others: Sequence[int]) -> np.ndarray:
        """
        Value all poses for a camera, given where the others go.

        :param others: numbers of their poses.
        :returns: (P * D,) ln((E with the camera + e) / (E of the others + e)) of the depth error
            E, less is better.
        """
        return self.engine.depth_error.changes(
            [self._seen[other] for other in others], self._seen, FLOOR)


def play_states(task: StateTask) -> dict[str, np.ndarray]:
    """
    Walk through a room some times.

    :returns: of M maps ``room`` (M, ...) and of S choices ``others`` (S, ...) and ``numbers``
        (S, ...), see :class:`~ocp_ros.online.observation_map.ObservationMap`; ``lens`` (S, ...),
        see :func:`~ocp_ros.online.observation_map.lens_features`; ``of`` (S,), the map of each
        choice; ``places`` (M, P, 2), the places that are labelled, in cells of the map; and
        ``values`` (S, P, D) float16, the labels, NaN beyond the last.
    """
    rng = np.random.default_rng(task.seed)
    rotation = float(rng.uniform(0.0, 360.0)) if rng.random() < 0.5 else 0.0
    true = make(replace(task.rooms, points=TRUE_POINTS), task.room, rotation)
    scan = make(replace(task.rooms, points=int(rng.choice(SCANS))), task.room, rotation)
    plain = rng.random() < PLAIN or true.size[2] < HEIGHTS[1]
    rig = RigConfig(cameras=CAMERAS[-1]) if plain else RigConfig(
        cameras=CAMERAS[-1], max_range=float(rng.uniform(*RANGES)),
        height=float(rng.uniform(*HEIGHTS)))
    if task.headings:
        rig = replace(rig, sensors=str(rng.choice(AIMED)))
    config = SimulationConfig(rig, EngineConfig(preset='fine', error_rows=16))
    room = TrueRoom(true, config, task.headings)
    problem = PlaneProblem(Simulator(scan, config))
    states = _States(room, rng, task)
    for _ in range(EPISODES):
        cameras = int(rng.choice(CAMERAS, p=OFTEN))
        states.play(problem, cameras, float(rng.uniform(*STEPS)), task.weights)
    return states.arrays()


class _States:
    """The maps and choices of a room so far."""

    def __init__(self, room: TrueRoom, rng: np.random.Generator, task: StateTask) -> None:
        self._room, self._rng, self._headings = room, rng, task.headings
        self._lens = room.engine.models[0].lens if task.headings else None
        self._maps: list[np.ndarray] = []
        self._places: list[np.ndarray] = []
        self._choices: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        #: Poses that cameras would go to, as the last choices have them.
        self._good: list[int] = []

    def play(self, problem: Problem, cameras: int, step: float, weights: bytes) -> None:
        """Play an episode; at some turns read the map and choose."""
        rng, memory = self._rng, LookHistory()
        due = np.sort(rng.choice(TURNS, MAPS, replace=False))
        turns = int(due[-1]) + 1 + int(rng.integers(6))
        simulator = problem.simulator
        simulator.config = replace(simulator.config, episode=EpisodeConfig(
            turns=turns, max_step=step, start_radius=float(rng.choice([0.5, 3.0])),
            max_turn=float(rng.uniform(*TURNED)) if self._headings else EpisodeConfig.max_turn))
        settings = settings_of(simulator.config.episode, problem.rig, rng)
        actor = MapActor(policy_of(weights), *settings) if weights else None
        episode = Episode(problem, rng, cameras)
        going = self._drawn(cameras)
        for turn in range(int(due[-1]) + 1):
            positions, cloud = episode.turn.positions, episode.observed_cloud
            rig_state = state_of(episode) if self._headings else None
            record_views(memory, positions, rig_state)
            if turn in due:
                if actor is not None and actor.targets is not None:
                    going = self._room.nearest(actor.targets, actor.headings)
                going = self._choose(cloud, positions, memory, going, settings[2])
            goals = self._room.poses[going]
            moves, headings = self._walked(positions, goals[:, :2], step), goals[:, 3:]
            if actor is not None:
                actor.set_rig_state(rig_state)
                moves = actor.move(cloud, positions, turn, turns)
                headings = headings if actor.headings is None else actor.headings
            episode.move(moves, None if rig_state is None else turned_towards(
                episode.turn.headings, headings, episode.config.max_turn))

    def _walked(self, positions: np.ndarray, places: np.ndarray, step: float) -> np.ndarray:
        """Walk to places, past what the rig may not have seen yet: moves (K, 2) metres."""
        flat = positions[:, :2]
        way = towards(flat, places, step) - flat
        return self._room.space.moved(flat, way, step) - flat

    def _drawn(self, cameras: int) -> np.ndarray:
        """Draw poses for cameras to go to: good ones at times."""
        drawn = self._rng.integers(len(self._room.poses), size=cameras)
        if self._good and self._rng.random() < 0.5:
            count = min(cameras, len(self._good))
            drawn[:count] = self._rng.permutation(self._good)[:count]
        return drawn

    def _choose(self, cloud: np.ndarray, positions: np.ndarray, memory: LookHistory,
                going: np.ndarray, max_range: float) -> np.ndarray:
        """Read the map of a turn and let cameras choose; return where they then go."""
        rng, places, cameras = self._rng, self._room.places, len(positions)
        poses = self._room.poses
        coarse = rng.uniform(1.0, COARSEST) if rng.random() < COARSE else 1.0
        try:
            model = PartialMap(cloud, positions, max_range, PLAIN_POINTS, PLAIN_ROWS)
        except SceneError:
            return going
        known = ObservationMap(model, memory.unseen(model), cameras, max_range,
                               float(positions[0, 2]), coarse * EDGE)
        going = (going if rng.random() < 0.5 else self._drawn(cameras)).copy()
        views = [self._look(model, poses[pose], positions) for pose in going]
        number = len(self._maps)
        self._maps.append(known.room)
        self._places.append(((places - known.window.low) / known.window.edge).astype(np.float32))
        first = int(rng.integers(cameras))
        for camera in (first + np.arange(CHOICES)) % cameras:
            others = np.delete(going, camera)
            values = self._room.values(others)
            channels, numbers = known.others(
                views[:camera] + views[camera + 1:], poses[others])
            self._choices.append((number, channels, numbers, values))
            if rng.random() < AT_RANDOM:
                going[camera] = rng.integers(len(poses))
            else:
                going[camera] = np.argmin(values + rng.normal(0.0, NEARLY, len(values)))
            views[camera] = self._look(model, poses[going[camera]], positions)
        self._good = going.tolist()
        return going

    def _look(self, model: PartialMap, pose: np.ndarray, positions: np.ndarray) -> View:
        """Look from a pose (6,) at the height of the cameras."""
        row = np.array([*pose[:2], positions[0, 2], *pose[3:]])
        return model.look(row[:3] if self._lens is None else row, self._lens)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all maps and choices; see :func:`play_states`."""
        if not self._choices:
            # Nothing was seen that could be a room.
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
