# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The best placement on candidates, proved, then better ones near it.

The candidates are solved by branch and Benders cut. Poses near the best choice are then offered,
again and again and ever nearer, and at last all of them together with the candidates, so that the
bound holds for all.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import time

import numpy as np

from ocp_ros.planners.benders import Proof, STARTS
from ocp_ros.planners.budget import Budget
from ocp_ros.planners.candidate_pool import check_room, Pool, quick_of, Site
from ocp_ros.planners.candidate_proof import (
    CandidatePoses,
    Certificate,
    Question,
    refined,
    size_for,
)
from ocp_ros.planners.rig_search import Answer, answered, poses_around, Progress, Search, views_of
from ocp_ros.rig.free_plane import FreePlane
from ocp_ros.simulation.objective import Objective
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulator import Simulator
from ocp_ros.util.settings import ConfigurationError

#: Shares of the time at which the candidates, poses near the best of them, and a descent between
#: poses have to be done; the rest is for the proof for all.
CANDIDATES, NEARER, DESCENDED = 0.5, 0.65, 0.8
#: Metres: first and last step of the poses near a choice; directions on a plane.
FAR, NEAR, DIRECTIONS = 0.2, 0.02, 8
#: Poses that are drawn near each camera of a rig, and radians that it is turned per metre.
DRAWN, TURNED = 16, 0.75
#: Metres: how far from a placement poses are drawn that it is compared with.
NEIGHBOURHOOD = (0.2, 0.05)
#: Entries of the lists of customers for each second of a proof, and the most.
ENTRIES, LARGEST = 1e6, 3e7
#: Subproblems where evaluations are counted and not seconds.
NODES = 40


@dataclass(frozen=True, eq=False)
class PlaneAnswer:
    """
    The best placement on a plane.

    :ivar placement: (K, 3) metres, map frame.
    :ivar certificate: what was proved of it; in metres of depth error.
    """

    placement: np.ndarray
    certificate: Certificate


def exact_plane(simulator: Simulator, space: FreePlane, candidates: int = 400,
                seconds: float = 60.0, rows: int = 64, near: bool = True,
                over: Callable[[], bool] = lambda: False) -> PlaneAnswer:
    """
    Find the best placement of omnidirectional cameras, on a grid and then near it.

    :param simulator: the engine in the room.
    :param space: where the cameras may be, and how many there are.
    :param candidates: places of the grid at most; fewer where there is no time to look from all.
    :param seconds: the most time to take, that of looking included; a proof that is not complete
        by then gives the bound so far.
    :param rows: of the depth maps.
    :param near: whether to go on near the best on the grid; the certificate then is for all places
        that were tried.
    :param over: tells whether somebody has had enough.
    """
    began = time.monotonic()

    def by(share: float) -> Callable[[], bool]:
        return lambda: over() or time.monotonic() - began >= share * seconds

    error = simulator.error_at(rows)
    question = Question(error, len(simulator.scene), np.array([space.cameras]))
    places = space.grid(max(candidates, space.cameras))
    places = np.resize(places, (max(len(places), space.cameras), 2))
    # Any beginning of it is spread over the room.
    places = np.random.default_rng(0).permutation(places)
    offered = _on_plane(simulator, places, space, by(CANDIDATES))
    proof = question.solve(offered, by(CANDIDATES if near else 1.0), more=STARTS)
    found, everything = offered.some(proof.chosen or range(space.cameras)), offered
    if near:
        def drawn(around: CandidatePoses, step: float) -> CandidatePoses:
            return _on_plane(simulator, _rings(around.poses[:, :2], step), space, by(NEARER))

        found, tried = refined(question, found, drawn, (FAR, NEAR), by(NEARER))
        everything = offered + tried
    certificate = _certificate(question, offered, proof, rows, found)
    if near and not by(NEARER)():
        last = question.solve(everything, by(1.0), known=certificate.found)
        if last.chosen and last.loss < certificate.found:
            found = everything.some(last.chosen)
        certificate = _better(certificate, _certificate(question, everything, last, rows, found))
    return PlaneAnswer(space.placement(found.poses[:, :2]),
                       replace(certificate, seconds=time.monotonic() - began))


def _rings(places: np.ndarray, step: float) -> np.ndarray:
    """Return two rings of places (M, 2) around each of some (K, 2)."""
    angles = np.arange(DIRECTIONS) * (2.0 * np.pi / DIRECTIONS)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    turned = np.stack([np.cos(angles + angles[1] / 2), np.sin(angles + angles[1] / 2)], axis=1)
    return (places[:, None] + step * np.concatenate([ring, 0.5 * turned])).reshape(-1, 2)


def _on_plane(simulator: Simulator, places: np.ndarray, space: FreePlane,
              over: Callable[[], bool]) -> CandidatePoses:
    """Look from places (M, 2), from as many as there is time for and from K at least."""
    poses, views = space.placement(space.inside(places)), []
    for pose in poses:
        if over() and len(views) >= space.cameras:
            break
        views.append(simulator.look(pose).seen)
    return CandidatePoses(poses[:len(views)], views, np.zeros(len(views), dtype=np.int64))


def _certificate(question: Question, offered: CandidatePoses, proof: Proof, rows: int,
                 found: CandidatePoses) -> Certificate:
    """Return what was proved of a choice, metres."""
    return Certificate(len(offered.poses), rows, question.loss(found.views), proof.bound,
                       proof.proved, proof.seconds, proof.nodes)


def _better(one: Certificate, other: Certificate) -> Certificate:
    """Return the later one of two, unless it proves less: time may have run out."""
    return other if other.gap <= one.of(other.found).gap or other.proved else one.of(other.found)


class RigQuestion:
    """
    The best choice of poses for the cameras of a rig.

    :param problem: the rig in the room.
    :param pool: candidates of all its models; the first ones of each are taken, and coarser depth
        maps, as there is time for.
    :param seconds: how long a proof may take; None where no clock ends it.
    :raises ConfigurationError: if several cameras have to see a place.
    """

    def __init__(self, problem: Problem, pool: Pool, seconds: float | None) -> None:
        if (reason := not_covered(problem.objective)) is not None:
            raise ConfigurationError(f'--planner: exact {reason}; name another planner')
        self.problem, rig, objective = problem, problem.rig, problem.objective
        self.models = list(dict.fromkeys(camera.model for camera in rig.cameras))
        kinds = [pool.kind(model) for model in self.models]
        simulator = problem.simulator
        self.rows, count = size_for(
            simulator.depth_error, simulator.config.engine.error_rows,
            [view.seen for kind in kinds for view in kind.views], len(simulator.scene),
            LARGEST if seconds is None else min(ENTRIES * seconds, LARGEST))
        share = count / len(pool)
        counts = [int(np.ceil(share * len(kind.poses))) for kind in kinds]
        self.offered = CandidatePoses(
            np.vstack([kind.poses[:count] for kind, count in zip(kinds, counts)]),
            [view.seen for kind, count in zip(kinds, counts) for view in kind.views[:count]],
            np.repeat(np.arange(len(kinds)), counts))
        error = simulator.error_at(self.rows)
        #: Metres of a loss of 1.
        self.unit = error.worst
        fixed = [view.seen for view in objective.fixed]
        self.question = Question(
            error, len(simulator.scene),
            np.array([sum(camera.model == model for camera in rig.cameras)
                      for model in self.models]), rig.spacing,
            np.bitwise_or.reduce(fixed) if fixed else None, objective.costs * error.worst)

    def candidates_of(self, sites: Sequence[Site]) -> CandidatePoses:
        """Return the sites of a placement as candidates."""
        group = [self.models.index(camera.model) for camera in self.problem.rig.cameras]
        return CandidatePoses(np.array([site.pose for site in sites]),
                              [site.view.seen for site in sites], np.array(group))

    def sites_of(self, chosen: CandidatePoses) -> tuple[Site, ...]:
        """Return a choice as sites, in the order of the rig's cameras."""
        poses = defaultdict(list)
        for pose, group in zip(chosen.poses, chosen.group):
            poses[int(group)].append(pose)
        simulator = self.problem.simulator
        return tuple(Site(pose, simulator.look(pose, camera)) for camera, pose in enumerate(
            poses[self.models.index(one.model)].pop(0) for one in self.problem.rig.cameras))

    def drawn(self, around: CandidatePoses, step: float, rng: np.random.Generator
              ) -> CandidatePoses:
        """Return allowed poses near those of a choice."""
        problem, parts = self.problem, []
        for pose, group in zip(around.poses, around.group):
            model = self.models[group]
            poses = poses_around(problem.region, pose, model, step, TURNED * step, DRAWN, rng)
            poses = poses[problem.region.allowed(poses, model)]
            camera = problem.rig.models.index(model)
            parts.append(CandidatePoses(
                poses, [view.seen for view in problem.simulator.look_many(poses, camera)],
                np.full(len(poses), group)))
        return sum(parts[1:], parts[0])

    def certified(self, offered: CandidatePoses, sites: Sequence[Site], budget: Budget,
                  rng: np.random.Generator) -> tuple[Certificate, tuple[Site, ...]]:
        """Bound what a placement, those on candidates and those of poses near it may be worth."""
        found, objective = self.candidates_of(sites), self.problem.objective
        offered += found
        for step in NEIGHBOURHOOD:
            offered += self.drawn(found, step, rng)
        proof = self.question.solve(
            offered, lambda: budget.share(0, None) >= 1.0, _most(budget),
            self.question.loss(found.views))
        if proof.chosen:
            other = self.sites_of(offered.some(proof.chosen))
            if objective.loss(views_of(other)) < objective.loss(views_of(sites)):
                sites, found = other, self.candidates_of(other)
        return Certificate(
            len(offered.poses), self.rows, self.question.loss(found.views) / self.unit,
            proof.bound / self.unit, proof.proved, budget.elapsed, proof.nodes), tuple(sites)


def not_covered(objective: Objective) -> str | None:
    """Say why no bound can be proved for a rig; None where one can."""
    if objective.rig.seen_by > 1:
        return (f'found seen_by: {objective.rig.seen_by}; expected 1, for bounds are known where '
                'one camera has to see a place')
    if objective.rig.calibratable is not None:
        return 'found calibratable; expected a rig without it, for bounds do not know of pairs'
    return None


def certify(problem: Problem, pool: Pool, sites: Sequence[Site], budget: Budget, seed: int = 0
            ) -> tuple[Certificate, tuple[Site, ...]]:
    """
    Prove how much better than a placement others may be: on the candidates and on poses near it.

    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param sites: the placement.
    :param budget: of the proof.
    :param seed: of the poses near the placement.
    :returns: the certificate, and a placement that was found to be better; else the one given.
    :raises ConfigurationError: if several cameras have to see a place.
    """
    asked = RigQuestion(problem, pool, budget.seconds)
    return asked.certified(asked.offered, sites, budget, np.random.default_rng([seed, 1]))


def _most(budget: Budget) -> int | None:
    """Return how many subproblems to look into where no clock ends the search."""
    return NODES if budget.seconds is None else None


def search_exact(problem: Problem, pool: Pool, budget: Budget, seed: int,
                 progress: Progress | None = None) -> Answer:
    """
    Find the best placement of a rig's cameras on the candidates, then a better one near it.

    :param problem: the rig in the room.
    :param pool: candidates of all its models.
    :param budget: how long to go on; where only evaluations are counted, they are those of the
        descent, and so many subproblems are looked into that the answer does not hang on the
        machine.
    :param seed: random seed.
    :param progress: called now and then.
    :raises ConfigurationError: if there is no placement, or several cameras have to see a place.
    """
    check_room(problem.objective, pool)
    seconds = None if budget.seconds is None else CANDIDATES * budget.seconds
    asked, rng = RigQuestion(problem, pool, seconds), np.random.default_rng([seed, 0])

    def by(share: float) -> Callable[[], bool]:
        return lambda: budget.share(0, None) >= share

    def report(bound: float, loss: float) -> None:
        if progress is not None:
            progress(budget.share(0, None), loss / asked.unit)

    proof = asked.question.solve(asked.offered, by(CANDIDATES), _most(budget), more=STARTS,
                                 progress=report)
    search = Search(problem, quick_of(problem.objective), pool, budget, rng)
    sites = asked.sites_of(asked.offered.some(proof.chosen)) if proof.chosen else search.fill()
    found, tried = refined(
        asked.question, asked.candidates_of(sites),
        lambda around, step: asked.drawn(around, step, rng), (FAR, NEAR), by(NEARER))
    best = min((sites, asked.sites_of(found)),
               key=lambda sites: problem.objective.loss(views_of(sites)))
    best = search.descend(best, problem.objective.loss(views_of(best)), search.used(), DESCENDED)
    certificate, best = asked.certified(asked.offered + tried, best, budget, rng)
    first = replace(certificate, candidates=len(asked.offered.poses), proved=proof.proved,
                    bound=proof.bound / asked.unit, nodes=proof.nodes)
    return answered(problem.objective, best, search.evaluations, _better(first, certificate))
