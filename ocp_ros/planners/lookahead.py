# SPDX-License-Identifier: Apache-2.0
"""
Lookahead: plan on what has been seen as if it were the room, and plan again as more is seen.

While it explores, a plan is worth the depth error of the observed cloud, less a bonus for the
unseen cells of the air that it would cover. The bonus falls to nothing early: what a plan is then
worth is the depth error alone. Plans are sought among candidates on a grid, whose views are
computed once for some turns, by annealing on unions of packed bits; one-camera exchanges alone
end in worse plans. In the last turns the best plan is annealed in small steps on a model at full
resolution, among places that the cameras can still reach: a model of thinned points promises
what the room does not keep.
"""

import numpy as np

from ocp_ros.agent.observed import KeptModel, Memory, Observed
from ocp_ros.geometry.blocks import count_bits
from ocp_ros.geometry.visibility import FINE
from ocp_ros.planners.annealing import accepted, annealed, between
from ocp_ros.planners.online import cell_weight, Online, REFINING, shared_out
from ocp_ros.scenes.scene import SceneError
from ocp_ros.simulation.space import Space

#: Metres between candidates, and the most there are: in a larger room they are farther apart.
SPACING, CANDIDATES = 0.5, 400
#: Points and rows of depth maps of the model that candidates are compared on.
QUICK_POINTS, QUICK_ROWS = 6000, 32
#: Turns that candidates are kept for; the first computes their views, the others anneal.
KEPT = 3
#: Proposals of a turn of annealing among candidates.
EXCHANGES = 3000
#: Its first and last temperature, in multiples of the error of seeing nothing.
HOT, COLD = 0.04, 2e-4
#: Share of its proposals that go anywhere; the others go to one of so many nearest candidates.
ANYWHERE, NEIGHBOURS = 0.3, 12
#: Points and rows of depth maps of the model to refine on, and turns that it is kept for at least.
REFINING_POINTS, REFINING_ROWS, REFINING_KEPT = 25000, 64, 4
#: Proposals of a turn of refinement, and of one that makes a model as well.
STEPS, FEWER_STEPS = 80, 20
#: First and last temperature of the refinement, in multiples of the best plan's error, and the
#: error from which these are taken at least, metres.
WARM, COOL, LEAST = 0.1, 0.003, 1e-3
#: Metres: standard deviation of its first and last steps.
FAR, NEAR = 0.5, 0.02


class Candidates:
    """
    Places where cameras might be, with what each would see.

    A choice of them is a list of indices, one per camera.

    :param model: the engine on what has been seen.
    :param places: (M, 2) metres, M >= 1.
    :param space: where cameras may be.
    :param unseen: packed bits of the model's cells that count as unseen.
    :param weight: what covering one of them is worth, metres of depth error.
    """

    def __init__(self, model: Observed, places: np.ndarray, space: Space, unseen: np.ndarray,
                 weight: float) -> None:
        self.model, self.places, self.weight = model, places, weight
        views = [model.look(position) for position in space.placement(places)]
        self._seen = np.array([view.seen for view in views])
        self._covered = np.array([view.covered for view in views]) & unseen
        apart = ((places[:, None] - places[None]) ** 2).sum(axis=-1)
        self._near = np.argsort(apart, axis=1, kind='stable')[:, 1:NEIGHBOURS + 1]

    def value(self, chosen: list[int]) -> float:
        """Return what a choice is worth, metres; less is better."""
        return self._value(np.bitwise_or.reduce(self._seen[chosen], axis=0),
                           np.bitwise_or.reduce(self._covered[chosen], axis=0))

    def _value(self, seen: np.ndarray, covered: np.ndarray) -> float:
        """Return what seeing points and covering cells, packed bits each, is worth, metres."""
        error = self.model.depth_error(seen)
        return error - self.weight * int(count_bits(covered)) if self.weight else error

    def fill(self, cameras: int) -> list[int]:
        """Choose so many, one after the other, each the best that is left."""
        chosen: list[int] = []
        seen, covered = np.zeros_like(self._seen[0]), np.zeros_like(self._covered[0])
        for _ in range(cameras):
            values = [self._value(seen | one, covered | other)
                      for one, other in zip(self._seen, self._covered)]
            chosen.append(int(np.argmin(values)))
            seen, covered = seen | self._seen[chosen[-1]], covered | self._covered[chosen[-1]]
        return chosen

    def anneal(self, chosen: list[int], rng: np.random.Generator) -> list[int]:
        """Return the best choice that annealing from another one finds, which may be that one."""
        worst = self.model.depth_error.worst
        temperatures = (worst * between(HOT, COLD, step / EXCHANGES) for step in range(EXCHANGES))
        return annealed(chosen, self.value, lambda trial: self._exchanged(trial, rng),
                        temperatures, rng)

    def _exchanged(self, chosen: list[int], rng: np.random.Generator) -> list[int]:
        """Exchange one of a choice for a neighbour or for any other place."""
        trial, camera = list(chosen), int(rng.integers(len(chosen)))
        if rng.random() < ANYWHERE:
            trial[camera] = int(rng.integers(len(self.places)))
        else:
            near = self._near[trial[camera]]
            trial[camera] = int(near[rng.integers(len(near))])
        return trial


class Lookahead(Online):
    """Explore, plan on what has been seen, and refine the plan while walking to it."""

    def __init__(self, *settings) -> None:
        super().__init__(*settings)
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._memory = Memory()
        #: Where each camera goes: (K, 2) metres.
        self._plan: np.ndarray | None = None
        self._candidates: Candidates | None = None
        self._chosen: list[int] = []
        self._kept = KeptModel(self.max_range, self.wall_margin, REFINING_POINTS, REFINING_ROWS)
        #: Turn of the last model or of the last candidates.
        self._made = 0

    def move(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> np.ndarray:
        """Choose the next moves; see :meth:`Online.move`."""
        self._memory.visit(positions)
        try:
            if turn >= REFINING * turns:
                self._refine(cloud, positions, turn, turns)
            elif self._candidates is None or turn - self._made >= KEPT:
                self._look_around(cloud, positions, turn, turns)
            else:
                self._chosen = self._candidates.anneal(self._chosen, self.rng)
                self._settle(positions)
        except SceneError:
            return self.wander(cloud, positions)
        return self.towards(positions, self._plan) - positions[:, :2]

    def _look_around(self, cloud: np.ndarray, positions: np.ndarray, turn: int,
                     turns: int) -> None:
        """Compute what would be seen from where; the plan so far is among the candidates."""
        model = Observed(cloud, positions, self.max_range, QUICK_POINTS, QUICK_ROWS)
        space, unseen = self.space(cloud, positions), self._memory.unseen(model)
        weight = cell_weight(model, unseen, turn, turns)
        count = int(np.clip(space.area / SPACING ** 2, 4, CANDIDATES))
        places = space.grid(count)
        if self._plan is not None:
            places = np.vstack([space.inside(self._plan), places])
        self._candidates, self._made = Candidates(model, places, space, unseen, weight), turn
        if self._plan is None:
            self._chosen = self._candidates.fill(len(positions))
        else:
            self._chosen = list(range(len(positions)))
        self._settle(positions)

    def _settle(self, positions: np.ndarray) -> None:
        """Match the cameras with the chosen places, so that they walk least."""
        self._plan = shared_out(positions, self._candidates.places[self._chosen])

    def _refine(self, cloud: np.ndarray, positions: np.ndarray, turn: int, turns: int) -> None:
        """Anneal the plan, or the placement where there is none, among what can be reached."""
        steps = STEPS
        if self._kept.made is None or (turn - self._made >= REFINING_KEPT
                                       and not self._kept.lasts(cloud, positions)):
            self._kept.make(cloud, positions, FINE)
            self._made, steps = turn, FEWER_STEPS
        (model, space), first = self._kept.made, REFINING * turns
        placed = positions[:, :2] if self._plan is None else self._plan
        placed = best = self.towards(positions, space.inside(placed), turns - turn)
        views = [model.look(position) for position in space.placement(placed)]
        error = best_error = model.error(views)
        for step in range(steps):
            share = (turn - first + step / steps) / (turns - first)
            temperature = max(best_error, LEAST) * between(WARM, COOL, share)
            trial, camera = placed.copy(), int(self.rng.integers(len(placed)))
            trial[camera] = space.reflected(
                trial[camera] + self.rng.normal(0.0, between(FAR, NEAR, share), 2))
            trial = self.towards(positions, trial, turns - turn)
            trial_views = views.copy()
            trial_views[camera] = model.look(space.placement(trial)[camera])
            trial_error = model.error(trial_views)
            if accepted(trial_error - error, temperature, self.rng):
                placed, views, error = trial, trial_views, trial_error
                if error < best_error:
                    best, best_error = placed, error
        self._plan = best
