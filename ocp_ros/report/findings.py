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
larger than the error on the scan. If the scan has no ceiling or floor, the error on the scan does
not include what the cameras miss there. The ratio of both errors, each plus an offset, was
measured in generated rooms, whose meshes are known. :func:`expected` reads the ratios and the
offset from ``promise.json``, which ``benchmarks/promise.py`` writes. What a scan does not show in
an aisle, for example, cameras mostly do not see either: a share of it counts as error.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
import json
from operator import itemgetter
from typing import Any

import numpy as np
from ocp_ros.geometry.packed_bits import Subset
from ocp_ros.rig.connections import bandwidth_notes, light_of
from ocp_ros.rig.feasible_region import FeasibleRegion, satisfies_spacing
from ocp_ros.rig.plausibility import angle_notes, missing_surfaces, room_notes
from ocp_ros.scenes.scene import Scene
from ocp_ros.simulation.interference import MAX_LIT_SHARE, time_slots
from ocp_ros.simulation.objective import Objective, RigEvaluation
from ocp_ros.simulation.problem import Problem
from ocp_ros.simulation.simulator import View
from ocp_ros.util.settings import ConfigurationError

#: A smaller seen share of a room is written as 0 %.
MIN_SEEN_SHARE = 0.005
#: A scan is sparse if the median edge of the squares that its points stand for is longer, metres.
SPARSE_PITCH_M = 0.15
#: Generated rooms that were scanned from all sides had at most 4 % without a point.
MAX_UNSCANNED_SHARE = 0.05


def evaluate_placement(problem: Problem, poses: np.ndarray) -> dict[str, Any]:
    """
    Return all findings on a placement as plain data.

    :param problem: the rig in the room.
    :param poses: (K, 6) metres, map frame, and radians, of the K cameras.
    :returns: ``scores`` of :func:`scores_of`; ``broken`` of :func:`broken_by`; ``missed`` and
        ``one_more`` of :func:`improvements`; ``expected``: the depth error in the room itself, of
        :func:`expected`; ``notes``: doubts about the room or the result; and ``remarks``:
        corrections of the scan.
    """
    views = problem.look(poses)
    scores = scores_of(problem.objective, views)
    improvement = improvements(problem, poses, views)
    scene = problem.objective.simulator.scene
    missing = missing_surfaces(scene)
    fixed_angles = np.rad2deg(problem.fixed_poses[:, 3:]).ravel().tolist()
    rig_angles = np.rad2deg([*problem.rig.pitch, *problem.rig.rolls]).tolist()
    return {'scores': scores, 'broken': broken_by(problem.region, poses, scores), **improvement,
            'expected': expected_error(problem.objective, scores),
            'notes': [*problem.region.fixed_notes(),
                      *angle_notes(fixed_angles, problem.rig.models),
                      *angle_notes(rig_angles), *room_notes(scene),
                      *missing_surface_notes(missing),
                      *(() if missing else _unscanned_notes(problem.objective)), *scene.notes,
                      *bandwidth_notes(problem.rig.all_cameras),
                      *_missed_notes(improvement['missed']['share']),
                      *_unseen_room_notes(scores.get('rooms', ()))],
            'remarks': list(scene.remarks)}


def _missed_notes(share: float) -> list[str]:
    """Return a note if the cameras miss too large a share of the points."""
    return [] if share <= 0.9 else [
        f'found {100.0 * share:.0f} % of the points seen by too few cameras; expected most of '
        'them seen; use more cameras, or of longer range']


def _unscanned_notes(objective: Objective) -> list[str]:
    """Return a note if a large share of a room was not scanned."""
    error = objective.validation.simulator.depth_error
    shares = error.unscanned.shares
    if (share := shares.mean()) <= MAX_UNSCANNED_SHARE:
        return []
    place = ', '.join(f'{value:.1f}' for value in error.viewpoints[shares.argmax()])
    return [f'found nothing scanned in {100.0 * share:.0f} % of all directions from places all '
            f'over the room, most from ({place}); expected at most '
            f'{100.0 * MAX_UNSCANNED_SHARE:.0f} %; scan from there too, unless it is a window or '
            f'an open door; {100.0 * _ratio_table()["unscanned"]:.0f} % of it is expected missed']


def _unseen_room_notes(rooms: Sequence[dict[str, Any]]) -> list[str]:
    """Return a note if the cameras see 0 % of some rooms of a floor."""
    names = [room['name'] for room in rooms if room['seen'] < MIN_SEEN_SHARE]
    return [] if not names else [
        f'found {len(names)} of {len(rooms)} rooms that the cameras do not see ('
        f'{", ".join(names)}); expected all seen; use more cameras, or a scan without these rooms']


def scores_of(objective: Objective, views: Sequence[View]) -> dict[str, Any]:
    """
    Return the scores of a placement as plain data, as in placement files.

    :param objective: the engine in the room, and the rig.
    :param views: views of the placed cameras.
    """
    return {**rig_scores(objective, views, objective.evaluate_views(views)),
            **camera_scores(objective, views)}


def camera_scores(objective: Objective, views: Sequence[View]) -> dict[str, Any]:
    """Return those scores of :func:`scores_of` that are about a camera or a pair of cameras."""
    contributions = zip(objective.rig.all_cameras, objective.contributions(views))
    return {**_calibration_links(objective, views), **_interference(objective, views), 'cameras': [
        {'name': camera.name, 'depth_error': gain.depth_error, 'only': gain.only}
        for camera, gain in contributions]}


def rig_scores(objective: Objective, views: Sequence[View], evaluation: RigEvaluation
               ) -> dict[str, Any]:
    """Return those scores of :func:`scores_of` that are about all cameras together."""
    simulator, rig = objective.simulator, objective.rig
    points = len(simulator.scene)
    validated = objective.validation.evaluate_views(views)
    unscanned = objective.validation.simulator.depth_error.unscanned
    return {
        'loss': evaluation.loss, 'depth_error': evaluation.depth_error,
        'validation_error': validated.depth_error,
        'depth_error_of_nothing': simulator.depth_error.worst,
        'unscanned': float(unscanned.shares.mean()), 'unscanned_error': unscanned.error,
        'space_coverage': evaluation.space_coverage,
        # Outside of the room, as through windows, cameras cover space too.
        'volume': max(objective.volume, evaluation.space_coverage),
        'seen_by': rig.seen_by, 'seen': len(evaluation.seen) / points, 'points': points,
        'unproved': 1.0 - len(validated.seen) / max(len(evaluation.seen), 1),
        'overlap': dict(zip(('0', '1', '2', '3 or more'), objective.overlap(views))),
        'regions': [{'name': region.name, 'of': region.parts, 'seen': float(share),
                     **({'around': True} if region.air and region.air.around else {}),
                     'must_see': region.must_see, 'weight': region.weight,
                     'met': bool(share >= region.must_see),
                     **({} if unscanned is None else {'unscanned': unscanned})}
                    for region, share, unscanned in zip(
                        rig.regions, evaluation.regions, objective.unscanned)],
        **({'requirements': [
            {'region': requirement.region, 'require': requirement.text, 'share': float(share),
             'asked': requirement.share, 'met': bool(share >= requirement.share)}
            for requirement, share in zip(rig.requirements, evaluation.requirements)]}
            if rig.requirements else {}),
        **_room_scores(objective, views, evaluation)}


def _room_scores(objective: Objective, views: Sequence[View], evaluation: RigEvaluation
                 ) -> dict[str, Any]:
    """Return the cameras in each room of a floor, and the seen share; {} for one room."""
    scene = objective.simulator.scene
    if (rooms := scene.rooms) is None:
        return {}
    room_of_point = rooms.at(scene.points)
    positions = [view.position for view in (*views, *objective.fixed) if view.position is not None]
    counts = [np.bincount(numbers, minlength=rooms.count + 1)[1:] for numbers in (
        rooms.at(np.reshape(positions, (-1, 3))), room_of_point,
        room_of_point[evaluation.seen.mask])]
    return {'rooms': [
        {'name': f'room {number}', 'area': float(area), 'at': np.round(centre, 2).tolist(),
         'cameras': int(cameras), 'seen': float(seen / max(points, 1))}
        for number, (area, centre, cameras, points, seen) in enumerate(
            zip(rooms.areas, rooms.middles, *counts), start=1)]}


def _calibration_links(objective: Objective, views: Sequence[View]) -> dict[str, Any]:
    """
    Return which cameras can be calibrated to each other; {} if the rig does not require it.

    Only shared points count whose views the scan proves.
    """
    covisibility = objective.validation.covisibility(views)
    required = objective.rig.calibratable
    if covisibility is None:
        return {}
    names = [camera.name for camera in objective.rig.all_cameras]
    count = len(covisibility.shares)
    movable = count - len(objective.fixed)
    # Fixed cameras come last; two of them are no pair.
    pairs = [(i, k) for i in range(movable) for k in range(i + 1, count)]
    # The tree connects all cameras by the best pairs, which are listed even if not linked.
    tree = {tuple(sorted(link)) for link in covisibility.tree}
    return {'calibratable': {
        'overlap': required.overlap, 'angle': float(np.rad2deg(required.angle)),
        'groups': [[names[camera] for camera in group] for group in covisibility.groups],
        'pairs': [{'cameras': [names[i], names[k]], 'overlap': float(covisibility.shares[i, k]),
                   'linked': covisibility.linked(i, k)}
                  for i, k in pairs if covisibility.linked(i, k) or (i, k) in tree]}}


def _interference(objective: Objective, views: Sequence[View]) -> dict[str, Any]:
    """Return which cameras disturb each other, and time slots for them; {} for other sensors."""
    cameras, shares = objective.rig.all_cameras, objective.lit_shares(views)
    conflicts = shares > MAX_LIT_SHARE
    if not shares.any():
        return {}
    slots = time_slots(conflicts)
    return {'interference': {
        'allowed': not objective.rig.no_interference,
        'pairs': [{'cameras': [cameras[i].name, cameras[k].name], 'light': light_of(cameras[i]),
                   'shared': float(shares[i, k])} for i, k in np.argwhere(np.triu(conflicts))],
        # Cameras without a conflict are in the first slot.
        'slots': [[camera.name for camera, own in zip(cameras, slots) if own == slot]
                  for slot in range(max(slots) + 1)]}}


def _interference_sentences(scores: dict[str, Any]) -> list[str]:
    """Return a sentence if cameras disturb each other although the rig forbids it."""
    found = scores.get('interference', {'allowed': True})
    if found['allowed'] or not found['pairs']:
        return []
    worst = max(found['pairs'], key=lambda pair: pair['shared'])
    first, second = worst['cameras']
    return [f'interference: found {len(found["pairs"])} pairs of cameras that light the same '
            f'surfaces, most of all {first} and {second} ({worst["light"]}) with '
            f'{100.0 * worst["shared"]:.1f} % of their points; expected at most '
            f'{100.0 * MAX_LIT_SHARE:.0f} %; turn them apart, or trigger the cameras in '
            f'{len(found["slots"])} time slots and leave out interference: none']


def broken_by(region: FeasibleRegion, poses: np.ndarray, scores: dict[str, Any]) -> list[str]:
    """
    Return a sentence for each violated constraint, regions and requirements included.

    :param region: feasible region of the rig in the room.
    :param poses: (K, 6) metres, map frame, and radians, of the K cameras.
    :param scores: scores of the placement, from :func:`scores_of`.
    """
    return region.broken(poses) + [
        f'{score["name"]}: found {100.0 * score["seen"]:.1f} % of its {score["of"]} seen'
        f'{" from all around" if "around" in score else ""}; '
        f'expected {100.0 * score["must_see"]:.1f} % (must_see); turn or move a camera towards it'
        for score in scores['regions'] if not score['met']] + [
        f'{score["region"] or "the room"}: found {100.0 * score["share"]:.1f} % of the points '
        f'measured as required ({score["require"]}); expected {100.0 * score["asked"]:.1f} % '
        '(require); move cameras nearer, use better ones or more, or lower the requirement'
        for score in scores.get('requirements', ()) if not score['met']] + [
            *_group_sentences(scores), *_interference_sentences(scores)]


def _group_sentences(scores: dict[str, Any]) -> list[str]:
    """Return a sentence if groups of cameras cannot be calibrated to each other."""
    links = scores.get('calibratable', {'groups': []})
    if len(links['groups']) < 2:
        return []
    # With several groups, the pairs of the tree that connect them are listed and not linked.
    unlinked = [pair for pair in links['pairs'] if not pair['linked']]
    best = max(unlinked, key=lambda pair: pair['overlap'])
    first, second = best['cameras']
    groups = ' and '.join(f'({", ".join(group)})' for group in links['groups'])
    return [f'calibratable: found {len(links["groups"])} groups of cameras, {groups}, between '
            f'which no two share enough, at most {first} and {second} with '
            f'{100.0 * best["overlap"]:.1f} % of their points; expected '
            f'{100.0 * links["overlap"]:.0f} % under at most {links["angle"]:.0f} degrees; '
            'let these two look at the same surfaces, or add a camera']


def improvements(problem: Problem, poses: np.ndarray, views: Sequence[View]) -> dict[str, Any]:
    """
    Return the missed points and the best pose of one more camera, as plain data.

    :param problem: the rig in the room.
    :param poses: (K, 6) metres, map frame, and radians, of the K cameras.
    :param views: views of these cameras.
    :returns: ``missed``: share of missed points, share of ``hopeless`` points, which all candidate
        poses miss too, and ``places`` with most missed points; ``one_more``: the best candidate
        pose, None if no candidate is feasible.
    """
    objective, simulator, rig = problem.objective, problem.simulator, problem.rig
    evaluation = objective.evaluate_views(views)
    # One camera of each model: the first one, by its number in the rig.
    numbers = [rig.models.index(model) for model in rig.placed_models]
    # All models together have at most 480 candidates.
    max_count = 480 // len(numbers)
    # For each camera model the best candidate: depth error with it, camera and pose.
    best = []
    # Points that the placement or any candidate sees.
    visible = evaluation.seen.bits.copy()
    for number in numbers:
        try:
            candidates = problem.region.candidates(rig.models[number], max_count)
        except ConfigurationError:
            # This model has no feasible pose.
            continue
        candidates = candidates[satisfies_spacing(candidates[:, :3], poses[:, :3], rig.spacing)]
        candidate_views = simulator.look_many(candidates, number)
        for view in candidate_views:
            visible |= view.seen
        errors = objective.with_one_more(views, candidate_views)
        if len(errors):
            best.append((float(errors.min()), rig.cameras[number],
                         candidates[int(errors.argmin())]))
    missed = ~evaluation.seen.mask
    hopeless = ~Subset(visible, simulator.visibility.order).mask
    one_more = None
    if best:
        error, camera, pose = min(best, key=itemgetter(0))
        yaw, pitch, roll = np.round(np.rad2deg(pose[3:]), 1).tolist()
        one_more = {'sensor': camera.sensor or camera.name,
                    'position': np.round(pose[:3], 3).tolist(),
                    'yaw': yaw, 'pitch': pitch, 'roll': roll, 'depth_error': error,
                    'gain': float(evaluation.depth_error - error)}
    places = _fullest_cubes(simulator.scene.points[missed], len(simulator.scene))
    return {'missed': {'share': float(missed.mean()), 'hopeless': float(hopeless.mean()),
                       'places': places}, 'one_more': one_more}


def _fullest_cubes(points: np.ndarray, total: int) -> list[dict[str, Any]]:
    """
    Return the three cubes of 1 m that contain most points; fewer if the points are in fewer.

    :param points: (M, 3) metres, M points.
    :param total: the number of all points of the room, by which the counts are divided.
    :returns: for each cube the share of the points, and the ``low`` and ``high`` corner of the box
        around its points, metres.
    """
    edge_m = 1.0
    if len(points) == 0:
        return []
    points = points.astype(np.float64)
    cubes = np.floor((points - points.min(axis=0)) / edge_m).astype(int)
    _, numbers, sizes = np.unique(cubes, axis=0, return_inverse=True, return_counts=True)
    largest = []
    for number in np.argsort(-sizes, kind='stable')[:3]:
        # In some versions of NumPy, the numbers have a second axis.
        inside = points[numbers.ravel() == number]
        largest.append({'share': float(sizes[number] / total),
                        'low': np.round(inside.min(axis=0), 2).tolist(),
                        'high': np.round(inside.max(axis=0), 2).tolist()})
    return largest


@cache
def _ratio_table() -> dict[str, Any]:
    """Return the table of ``promise.json``: ratios of errors, each plus ``offset``."""
    return json.loads(files(__package__).joinpath('promise.json').read_text())


def gaps_of(scene: Scene) -> tuple[str, ...]:
    """Return the names of what a scan lacks: surfaces, and ``sparse`` if it has few points."""
    sparse = np.median(scene.pitch) > SPARSE_PITCH_M
    return (*missing_surfaces(scene), *(('sparse',) if sparse else ()))


def ratios_for(missing: Sequence[str], under_ceiling: bool) -> list[float]:
    """
    Return the low, the median and the high ratio of the error in the room to that on the scan.

    The ratios are those of both errors plus the offset of the table, see :func:`expected`. In nine
    of ten rooms the ratio was between the low and the high one.

    :param missing: what the scan lacks, from :func:`gaps_of`.
    :param under_ceiling: whether the cameras hang under the ceiling.
    """
    table = _ratio_table()
    rows = [table[name]['ratios'] for name in missing if name in table and name != 'sparse']
    others, ceiling = table['mount_others']['ratios'], table['mount_ceiling']['ratios']
    # Four cameras that see all around were measured under ceilings; one or two miss more.
    low, median, high = (rows or [[*ceiling[:2], others[2]] if under_ceiling else others])[0]
    if 'sparse' not in missing:
        return [low, median, high]
    # Sparse scans add to the other doubts.
    sparse = table['sparse']['ratios']
    return [min(low, sparse[0]), max(median, sparse[1]), max(high, sparse[2])]


def expected(error: float, worst: float, missing: Sequence[str] = (), unscanned: float = 0.0,
             under_ceiling: bool = False) -> dict[str, float]:
    """
    Return the depth error that a placement is expected to have in the room itself.

    :param error: depth error on the scan, metres.
    :param worst: depth error without any visible point, metres.
    :param missing: what the scan lacks, from :func:`gaps_of`.
    :param unscanned: depth error of what the scan does not show, if no camera sees it, metres.
    :param under_ceiling: whether the cameras hang under the ceiling: they see more than a scan
        proves.
    :returns: ``depth_error``, ``low`` and ``high``, metres; in nine of ten rooms the error was
        between ``low`` and ``high``. ``sparse`` is true if the scan is, which makes them wide.
    """
    table, ratios = _ratio_table(), ratios_for(missing, under_ceiling)
    # The ratios are those of both errors plus an offset, since ratios of small errors say little.
    offset, missed = table['offset'] * worst, error + table['unscanned'] * unscanned
    low, median, high = (float(np.clip(ratio * (missed + offset) - offset, 0.0, worst + unscanned))
                         for ratio in ratios)
    # Less than the offset may still be more than nothing.
    return {'depth_error': max(median, ratios[0] * missed), 'low': low, 'high': high,
            **({'sparse': True} if 'sparse' in missing else {})}


def expected_error(objective: Objective, scores: Mapping[str, Any]) -> dict[str, float]:
    """
    Return :func:`expected` for a placement in a room.

    :param objective: of the rig in the room.
    :param scores: of the placement, from :func:`rig_scores`.
    """
    return expected(scores['validation_error'], scores['depth_error_of_nothing'],
                    gaps_of(objective.simulator.scene), scores['unscanned_error'],
                    objective.rig.mount.on == 'ceiling')


def missing_surface_notes(missing: Sequence[str]) -> list[str]:
    """Return a note on the effect of each missing surface on the expected error."""
    table = _ratio_table()
    # ``times`` is the smallest and the largest ratio of the errors themselves, without the offset.
    return [f'without the {surface} in the scan, what the cameras miss there is not known: in '
            f'{table[surface]["plans"]} rooms whose {surface} was left out the true depth '
            f'error was {table[surface]["times"][0]:.1f} to {table[surface]["times"][1]:.1f}'
            f' times that of the scan; scan the {surface} as well'
            for surface in missing if surface in table]
