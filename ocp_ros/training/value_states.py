# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
States and labels of the map actor: what it reads, and what each place is truly worth.

A rig walks through a room, and at some turns what it has seen is turned into a map. The label is
dense and privileged: for a camera and some hundred places at once, by how much the depth error of
the *true* room changes if the camera goes there, given where the others go. It does not depend on
where the camera is. Truth is ray casting of the room's mesh, on a scan that the rig never sees;
where there is no mesh, the engine at its best on the points of the scan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ocp_ros.agent.observation_map import (
    CELLS,
    EDGE,
    FLOOR,
    NUMBERS,
    ObservationMap,
    OF_OTHERS,
    OF_ROOM,
)
from ocp_ros.agent.partial_map import LookHistory, PartialMap
from ocp_ros.geometry.engine_config import EngineConfig
from ocp_ros.planners.map_actor import MapActor, PLAIN_POINTS, PLAIN_ROWS
from ocp_ros.planners.registry import settings_of
from ocp_ros.rig.motion import towards
from ocp_ros.rig.rig_config import RigConfig
from ocp_ros.scenes.scene import Scene, SceneError
from ocp_ros.simulation.episode import Episode
from ocp_ros.simulation.problem import plane_of, PlaneProblem
from ocp_ros.simulation.simulation_config import EpisodeConfig, SimulationConfig
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.simulation.truth import engine_of
from ocp_ros.training.training_config import RoomsConfig
from ocp_ros.training.training_rooms import make
from ocp_ros.training.validation import policy_of

#: Places that are labelled, points of the scan that is true, and rows of its depth maps.
PLACES, TRUE_POINTS, TRUE_ROWS = 450, 40_000, 64
#: Points of the scans that are walked through.
SCANS = (8_000, 15_000, 25_000, 40_000)
#: Episodes of a room, maps of an episode, and choices of one camera after the other on each map.
EPISODES, MAPS, CHOICES = 3, 3, 8
#: How many cameras there are, how often.
CAMERAS, OFTEN = np.arange(1, 9), np.array([1, 2, 3, 5, 3, 3, 1, 1]) / 19.0
#: The shortest and the longest step, metres; turns before a map; metres that cameras see; metres
#: that they are above the floor.
STEPS, TURNS, RANGES, HEIGHTS = (0.5, 2.0), 14, (3.0, 6.0), (1.0, 2.3)
#: How often a camera goes anywhere, and how near to the best, in the label, another one goes.
AT_RANDOM, NEARLY = 0.15, 0.04
#: How often range and height are those of the default rig, and cells are larger, and how much at
#: most.
PLAIN, COARSE, COARSEST = 0.5, 0.2, 2.0
#: What the states of a room are: kinds, and shapes of one map or of one choice.
SHAPES = {'room': (np.uint8, (OF_ROOM, CELLS, CELLS)), 'of': (np.int32, ()),
          'others': (np.uint8, (OF_OTHERS, CELLS, CELLS)), 'numbers': (np.float32, (NUMBERS,)),
          'places': (np.float32, (PLACES, 2)), 'values': (np.float16, (PLACES,))}


@dataclass(frozen=True)
class StateTask:
    """
    A room to walk through.

    :ivar rooms: how it is made.
    :ivar room: its name; see :mod:`ocp_ros.training.training_rooms`.
    :ivar seed: of everything that is drawn.
    :ivar weights: of the policy that plays, as one blob; empty for walks to drawn places.
    """

    rooms: RoomsConfig
    room: str
    seed: tuple[int, ...]
    weights: bytes = b''


class TrueRoom:
    """
    What places of a room are truly worth.

    :param scene: the room, with its mesh if there is one.
    :param config: range and height of the cameras.
    :ivar engine: the nearest to the truth that there is.
    :ivar space: where cameras may be.
    :ivar places: (P, 2) metres, those of a grid.
    """

    def __init__(self, scene: Scene, config: SimulationConfig) -> None:
        engine = EngineConfig(preset='fine', error_rows=TRUE_ROWS, coverage_cell=1.0)
        self.engine = engine_of(scene)(scene, replace(config, engine=engine))
        self.space = plane_of(self.engine, config.episode, 1)
        self.places = self.space.grid(PLACES)
        self._seen = [self.engine.look(place).seen
                      for place in self.space.placement(self.places)]

    def nearest(self, targets: np.ndarray) -> np.ndarray:
        """Return the numbers (K,) of the places next to some others (K, 2), metres."""
        away = np.linalg.norm(targets[:, None] - self.places[None], axis=2)
        return np.argmin(away, axis=1)

    def values(self, others: Sequence[int]) -> np.ndarray:
        """
        Value all places for a camera, given where the others go.

        :param others: numbers of their places.
        :returns: (P,) ln((D with the camera + e) / (D of the others + e)), less is better.
        """
        return self.engine.depth_error.changes(
            [self._seen[other] for other in others], self._seen, FLOOR)


def play_states(task: StateTask) -> dict[str, np.ndarray]:
    """
    Walk through a room some times.

    :returns: of M maps ``room`` (M, ...) and of S choices ``others`` (S, ...) and ``numbers``
        (S, ...), see :class:`~ocp_ros.agent.observation_map.ObservationMap`; ``of`` (S,), the map
        of each choice; ``places`` (M, P, 2), the places that are labelled, in cells of the map;
        and ``values`` (S, P) float16, the labels, NaN beyond the last.
    """
    rng = np.random.default_rng(task.seed)
    rotation = float(rng.uniform(0.0, 360.0)) if rng.random() < 0.5 else 0.0
    true = make(replace(task.rooms, points=TRUE_POINTS), task.room, rotation)
    scan = make(replace(task.rooms, points=int(rng.choice(SCANS))), task.room, rotation)
    plain = rng.random() < PLAIN or true.size[2] < HEIGHTS[1]
    rig = RigConfig() if plain else RigConfig(
        max_range=float(rng.uniform(*RANGES)), height=float(rng.uniform(*HEIGHTS)))
    config = SimulationConfig(rig, EngineConfig(preset='fine', error_rows=16))
    room, problem = TrueRoom(true, config), PlaneProblem(Simulator(scan, config))
    states = _States(room, rng)
    for _ in range(EPISODES):
        cameras = int(rng.choice(CAMERAS, p=OFTEN))
        states.play(problem, cameras, float(rng.uniform(*STEPS)), task.weights)
    return states.arrays()


class _States:
    """The maps and choices of a room so far."""

    def __init__(self, room: TrueRoom, rng: np.random.Generator) -> None:
        self._room, self._rng = room, rng
        self._maps: list[np.ndarray] = []
        self._places: list[np.ndarray] = []
        self._choices: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        #: Places that cameras would go to, as the last choices have them.
        self._good: list[int] = []

    def play(self, problem: PlaneProblem, cameras: int, step: float, weights: bytes) -> None:
        """Play an episode; at some turns read the map and choose."""
        rng, memory = self._rng, LookHistory()
        due = np.sort(rng.choice(TURNS, MAPS, replace=False))
        turns = int(due[-1]) + 1 + int(rng.integers(6))
        simulator = problem.simulator
        simulator.config = replace(simulator.config, episode=EpisodeConfig(
            turns=turns, max_step=step, start_radius=float(rng.choice([0.5, 3.0]))))
        settings = settings_of(simulator.config, rng)
        actor = MapActor(policy_of(weights), *settings) if weights else None
        episode = Episode(problem, rng, cameras)
        going = self._drawn(cameras)
        for turn in range(int(due[-1]) + 1):
            positions, cloud = episode.turn.positions, episode.observed_cloud
            memory.visit(positions)
            if turn in due:
                if actor is not None and actor.targets is not None:
                    going = self._room.nearest(actor.targets)
                going = self._choose(cloud, positions, memory, going, settings[2])
            episode.move(self._walked(positions, going, step) if actor is None
                         else actor.move(cloud, positions, turn, turns))

    def _walked(self, positions: np.ndarray, going: np.ndarray, step: float) -> np.ndarray:
        """Walk to places, past what the rig may not have seen yet: moves (K, 2) metres."""
        flat = positions[:, :2]
        way = towards(flat, self._room.places[going], step) - flat
        return self._room.space.moved(flat, way, step) - flat

    def _drawn(self, cameras: int) -> np.ndarray:
        """Draw places for cameras to go to: good ones at times."""
        drawn = self._rng.integers(len(self._room.places), size=cameras)
        if self._good and self._rng.random() < 0.5:
            count = min(cameras, len(self._good))
            drawn[:count] = self._rng.permutation(self._good)[:count]
        return drawn

    def _choose(self, cloud: np.ndarray, positions: np.ndarray, memory: LookHistory,
                going: np.ndarray, max_range: float) -> np.ndarray:
        """Read the map of a turn and let cameras choose; return where they then go."""
        rng, places, cameras = self._rng, self._room.places, len(positions)
        coarse = rng.uniform(1.0, COARSEST) if rng.random() < COARSE else 1.0
        try:
            model = PartialMap(cloud, positions, max_range, PLAIN_POINTS, PLAIN_ROWS)
        except SceneError:
            return going
        known = ObservationMap(model, memory.unseen(model), cameras, max_range,
                               float(positions[0, 2]), coarse * EDGE)
        going = (going if rng.random() < 0.5 else self._drawn(cameras)).copy()
        views = [self._look(model, places[place], positions) for place in going]
        number = len(self._maps)
        self._maps.append(known.room)
        self._places.append(((places - known.window.low) / known.window.edge).astype(np.float32))
        first = int(rng.integers(cameras))
        for camera in (first + np.arange(CHOICES)) % cameras:
            others = np.delete(going, camera)
            values = self._room.values(others)
            channels, numbers = known.others(
                [views[other] for other in range(cameras) if other != camera], places[others])
            self._choices.append((number, channels, numbers, values))
            if rng.random() < AT_RANDOM:
                going[camera] = rng.integers(len(places))
            else:
                going[camera] = np.argmin(values + rng.normal(0.0, NEARLY, len(values)))
            views[camera] = self._look(model, places[going[camera]], positions)
        self._good = going.tolist()
        return going

    @staticmethod
    def _look(model: PartialMap, place: np.ndarray, positions: np.ndarray):
        """Look from a place at the height of the cameras."""
        return model.look(np.append(place, positions[0, 2]))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all maps and choices; see :func:`play_states`."""
        if not self._choices:
            # Nothing was seen that could be a room.
            return {name: np.empty((0, *shape), kind) for name, (kind, shape) in SHAPES.items()}
        of, others, numbers, values = zip(*self._choices)
        places, count = np.stack(self._places), len(self._room.places)
        padding = ((0, 0), (0, PLACES - count))
        return {'room': np.stack(self._maps), 'of': np.array(of, dtype=np.int32),
                'others': np.stack(others), 'numbers': np.stack(numbers),
                'places': np.pad(places, (*padding, (0, 0)), constant_values=0.5 * CELLS),
                'values': np.pad(np.stack(values).astype(np.float16), padding,
                                 constant_values=np.nan)}
