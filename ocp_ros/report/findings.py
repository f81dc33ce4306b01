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
Findings on a placement: scores, violated constraints, missed points, one more camera.

A search fits the placement to the scan, so the depth error in the room itself is mostly a little
larger than the engine's error on the scan. A scan without ceiling or floor has no points there, so
the engine does not count what the cameras miss on them. The ratio of both errors was measured in
generated rooms, whose meshes are known. The table is ``promise.json``, written by
``benchmarks/promise.py``; :func:`expected` reads it.
"""

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
import json
from operator import itemgetter
from typing import Any

import numpy as np
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.rig.feasible_region import FeasibleRegion, satisfies_spacing
from ocp_ros.rig.plausibility import missing_surfaces, room_notes
from ocp_ros.simulation.objective import Objective, RigEvaluation
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulator import View
from ocp_ros.util.settings import ConfigurationError

#: Number of candidates for one more camera.
CANDIDATES = 480
#: Edge of the cells in which missed points are counted, metres.
MISSED_CELL = 1.0
#: Number of reported cells.
REPORTED_CELLS = 3
#: Share of points that all candidates miss, above which there is a note.
HOPELESS_SHARE = 0.3
#: Share of points that the cameras miss, above which there is a note.
MISSED_SHARE = 0.9


def evaluate_placement(problem: Problem, poses: np.ndarray) -> dict[str, Any]:
    """
    Return all findings on a placement as plain data.

    :param problem: the rig in the room.
    :param poses: (K, 6) metres, map frame, and radians.
    :returns: ``scores``, ``broken``, ``missed`` and ``one_more``; ``expected``: the depth error
        in the room itself, see :func:`expected`; ``notes``: doubts about
        the room or the result; and ``remarks``: corrections of the scan.
    """
    views = problem.look(poses)
    scores = scores_of(problem.objective, views)
    better = improvements(problem, poses, views)
    scene = problem.objective.simulator.scene
    missing = missing_surfaces(scene)
    return {'scores': scores, 'broken': broken_by(problem.region, poses, scores), **better,
            'expected': expected(scores['depth_error'], scores['depth_error_of_nothing'], missing),
            'notes': [*room_notes(scene), *notes_on(missing), *scene.notes,
                      *_share_notes(better['missed'])],
            'remarks': list(scene.remarks)}


def _share_notes(missed: dict[str, Any]) -> list[str]:
    """Return a note if a large share of the points is missed."""
    if missed['hopeless'] > HOPELESS_SHARE:
        return [f'found {100.0 * missed["hopeless"]:.0f} % of the points out of sight from '
                'everywhere that cameras may be; expected one room that they are in; the scan may '
                'have several, or cameras may be kept out of most of it']
    if missed['share'] > MISSED_SHARE:
        return [f'found {100.0 * missed["share"]:.0f} % of the points seen by too few cameras; '
                'expected most of them seen; use more cameras, or of longer range']
    return []


def scores_of(objective: Objective, views: Sequence[View]) -> dict[str, Any]:
    """
    Return the scores of a placement as plain data, as in placement files.

    :param views: views of the placed cameras.
    """
    return {**rig_scores(objective, views, objective.judge(views)),
            **camera_scores(objective, views)}


def camera_scores(objective: Objective, views: Sequence[View]) -> dict[str, Any]:
    """Return the scores of :func:`scores_of` that are about single cameras and their pairs."""
    added = zip(objective.rig.all_cameras, objective.contributions(views))
    return {**_links_of(objective, views), 'cameras': [
        {'name': camera.name, 'depth_error': gain.depth_error, 'only': gain.only}
        for camera, gain in added]}


def rig_scores(objective: Objective, views: Sequence[View], evaluation: RigEvaluation
               ) -> dict[str, Any]:
    """Return the scores of :func:`scores_of` that are about the cameras together."""
    simulator, rig = objective.simulator, objective.rig
    points = len(simulator.scene)
    return {
        'loss': evaluation.loss, 'depth_error': evaluation.depth_error,
        'depth_error_of_nothing': simulator.depth_error.worst,
        'space_coverage': evaluation.space_coverage, 'volume': simulator.volume,
        'seen_by': rig.seen_by, 'seen': len(evaluation.seen) / points, 'points': points,
        'overlap': dict(zip(('0', '1', '2', '3 or more'), objective.overlap(views))),
        'regions': [{'name': region.name, 'of': region.parts, 'seen': float(share),
                     'must_see': region.must_see, 'weight': region.weight,
                     'met': bool(share >= region.must_see)}
                    for region, share in zip(rig.regions, evaluation.regions)]}


def _links_of(objective: Objective, views: Sequence[View]) -> dict[str, Any]:
    """Return which cameras can be calibrated to each other; {} if the rig does not require it."""
    found, asked = objective.covisibility(views), objective.rig.calibratable
    if found is None:
        return {}
    names, count = [camera.name for camera in objective.rig.all_cameras], len(found.shares)
    movable = count - len(objective.fixed)
    pairs = [(one, other) for one in range(min(movable, count)) for other in range(one + 1, count)]
    tree = {tuple(sorted(link)) for link in found.tree}
    return {'calibratable': {
        'overlap': asked.overlap, 'angle': float(np.rad2deg(asked.angle)),
        'groups': [[names[camera] for camera in group] for group in found.groups],
        'pairs': [{'cameras': [names[one], names[other]],
                   'overlap': float(found.shares[one, other]),
                   'linked': found.linked(one, other)}
                  for one, other in pairs if found.linked(one, other) or (one, other) in tree]}}


def broken_by(region: FeasibleRegion, poses: np.ndarray, scores: dict[str, Any]) -> list[str]:
    """
    Return a sentence for each violated constraint of a placement, regions included.

    :param poses: (K, 6) metres, map frame, and radians.
    :param scores: from :func:`scores_of`.
    """
    return region.broken(poses) + [
        f'{part["name"]}: found {100.0 * part["seen"]:.1f} % of its {part["of"]} seen; expected '
        f'{100.0 * part["must_see"]:.1f} % (must_see); turn or move a camera towards it'
        for part in scores['regions'] if not part['met']] + _split_groups(scores)


def _split_groups(scores: dict[str, Any]) -> list[str]:
    """Return a sentence on groups of cameras that cannot be calibrated to each other."""
    links = scores.get('calibratable', {'groups': []})
    if len(links['groups']) < 2:
        return []
    lacking = [pair for pair in links['pairs'] if not pair['linked']]
    nearest = max(lacking, key=lambda pair: pair['overlap'])
    first, second = nearest['cameras']
    groups = ' and '.join(f'({", ".join(group)})' for group in links['groups'])
    return [f'calibratable: found {len(links["groups"])} groups of cameras, {groups}, between '
            f'which no two share enough, at most {first} and {second} with '
            f'{100.0 * nearest["overlap"]:.1f} % of their points; expected '
            f'{100.0 * links["overlap"]:.0f} % under at most {links["angle"]:.0f} degrees; '
            'let these two look at the same surfaces, or add a camera']


def improvements(problem: Problem, poses: np.ndarray, views: Sequence[View]) -> dict[str, Any]:
    """
    Return the missed points and the best pose of one more camera, as plain data.

    :param problem: the rig in the room.
    :param poses: (K, 6) metres, map frame, and radians.
    :param views: views of these cameras.
    :returns: ``missed``: share of missed points, share that all candidates miss too, and the cells
        with most missed points; ``one_more``: the best candidate, None if none is feasible.
    """
    objective, simulator, rig = problem.objective, problem.simulator, problem.rig
    evaluation = objective.judge(views)
    models = [rig.models.index(model) for model in rig.placed_models]
    candidates = []
    reachable = evaluation.seen.bits.copy()
    for number in models:
        try:
            offered = problem.region.candidates(rig.models[number], CANDIDATES // len(models))
        except ConfigurationError:
            continue
        offered = offered[satisfies_spacing(offered[:, :3], poses[:, :3], rig.spacing)]
        more = simulator.look_many(offered, number)
        for view in more:
            reachable |= view.seen
        errors = objective.with_one_more(views, more)
        if len(errors):
            candidates.append((float(errors.min()), rig.cameras[number],
                               offered[int(errors.argmin())]))
    missed = ~evaluation.seen.mask
    hopeless = ~Subset(reachable, simulator.visibility.order).mask
    one_more = None
    if candidates:
        error, camera, pose = min(candidates, key=itemgetter(0))
        yaw, pitch, roll = np.round(np.rad2deg(pose[3:]), 1).tolist()
        one_more = {'sensor': camera.sensor or camera.name,
                    'position': np.round(pose[:3], 3).tolist(),
                    'yaw': yaw, 'pitch': pitch, 'roll': roll, 'depth_error': error,
                    'gain': float(evaluation.depth_error - error)}
    return {'missed': {'share': float(missed.mean()), 'hopeless': float(hopeless.mean()),
                       'places': _cells_of(simulator.scene.points[missed], len(simulator.scene))},
            'one_more': one_more}


def _cells_of(points: np.ndarray, total: int) -> list[dict[str, Any]]:
    """Return the cells with most of some points (M, 3), metres, as shares of ``total`` points."""
    if len(points) == 0:
        return []
    points = points.astype(np.float64)
    cells = np.floor((points - points.min(axis=0)) / MISSED_CELL).astype(int)
    _, cell, sizes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    found = []
    for number in np.argsort(-sizes, kind='stable')[:REPORTED_CELLS]:
        inside = points[cell.ravel() == number]
        found.append({'share': float(sizes[number] / total),
                      'low': np.round(inside.min(axis=0), 2).tolist(),
                      'high': np.round(inside.max(axis=0), 2).tolist()})
    return found


@cache
def _table() -> dict[str, Any]:
    """Return the table of ratios."""
    return json.loads(files(__package__).joinpath('promise.json').read_text())


def ratios_for(error: float, nothing: float, missing: Sequence[str]) -> list[float]:
    """Return the smallest, the median and the largest ratio for :func:`expected`."""
    for surface in missing:
        if surface in _table():
            return _table()[surface]['ratios']
    levels = _table()['levels']
    number = np.searchsorted([level['from'] for level in levels], error / nothing, side='right')
    return levels[max(int(number) - 1, 0)]['ratios']


def expected(error: float, nothing: float, missing: Sequence[str] = ()) -> dict[str, float]:
    """
    Return the depth error that a placement is expected to have in the room itself.

    :param error: depth error by the engine, metres.
    :param nothing: depth error without any visible point, metres.
    :param missing: surfaces without points in the scan, from
        :func:`~ocp_ros.rig.plausibility.missing_surfaces`.
    :returns: ``depth_error``, ``low`` and ``high``, metres; in nine of ten rooms the error was
        between ``low`` and ``high``.
    """
    offset = _table()['offset'] * nothing
    low, middle, high = (float(np.clip(ratio * (error + offset) - offset, 0.0, nothing))
                         for ratio in ratios_for(error, nothing, missing))
    return {'depth_error': middle, 'low': low, 'high': high}


def notes_on(missing: Sequence[str]) -> list[str]:
    """Return a note on the effect of each missing surface on the expected error."""
    return [f'without the {surface} in the scan, what the cameras miss there is not known: in '
            f'{_table()[surface]["plans"]} rooms whose {surface} was left out the true depth '
            f'error was {_table()[surface]["times"][0]:.1f} to {_table()[surface]["times"][1]:.1f}'
            f' times that of the scan; scan the {surface} as well'
            for surface in missing if surface in _table()]
