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
Find out whether a camera has moved, by its own earlier cloud, and how to put it back.

The earlier cloud is the reference: what the camera measures now is registered to it. Errors that a
sensor makes in every frame are the same in both, so that a camera that has not moved is found to
the millimetre, and no scan is needed.
"""

from collections.abc import Hashable, Mapping
from contextlib import suppress
import io
from pathlib import Path
from typing import NamedTuple
import zipfile

import numpy as np
from ocp_ros.geometry.cameras import CameraModel, heading_of, Pose, rotation_matrix
from ocp_ros.registration.alignment import (
    aligned_poses,
    AlignmentStage,
    Certainty,
    moved_poses,
    Poses,
)
from ocp_ros.registration.camera_registration import comparison, FINEST_STAGE, sampled
from ocp_ros.registration.joint_alignment import (
    all_constraints,
    certainties,
    HERE,
    joint_poses,
    relative_pose,
    RigCamera,
)
from ocp_ros.registration.live_view import LiveView
from ocp_ros.registration.mutual_registration import register_mutually
from ocp_ros.registration.steady_cloud import Frames
from ocp_ros.scenes.scene import SceneError
from ocp_ros.util.files import read_regular, write_atomically
from ocp_ros.util.settings import ConfigurationError
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

#: Metres and degrees: a camera that moved by more than either has moved.
MOVED = 0.01, 0.5
#: The least agreement with the reference at which a movement is certain.
MIN_AGREEMENT = 0.25
#: The name of the file of references, beside the placement.
REFERENCES = 'references.npz'
#: What the names of arrays in it begin with, before that of the camera: clouds, and (4, 3): the
#: position and the rotation matrix of the camera.
CLOUD, POSE = 'camera_', 'pose_'
#: The largest number of points of a reference.
MAX_POINTS = 60_000


class Movement(NamedTuple):
    """
    How a camera has moved since its reference.

    :ivar pose: where it is now, in the body frame of the reference.
    :ivar metres: how far it has moved in directions that the surfaces hold.
    :ivar degrees: how far it has turned about axes that the surfaces hold.
    :ivar agreement: the share of what it sees that is in the reference, less contradictions.
    :ivar by_others: whether the pose and the agreement are by what other cameras see.
    """

    pose: Pose
    metres: float
    degrees: float
    agreement: float
    by_others: bool = False

    @property
    def is_lost(self) -> bool:
        """Return whether the camera sees too little of its reference for its pose to be known."""
        return not self.by_others and self.agreement < MIN_AGREEMENT

    @property
    def has_moved(self) -> bool:
        """Return whether the camera has moved, or is lost."""
        return self.is_lost or self.metres > MOVED[0] or self.degrees > MOVED[1]

    def pose_now(self, reference: Pose) -> Pose:
        """Return the present pose in the map frame, given that of the reference."""
        return self.pose.within(reference)


def movement_since(reference: LiveView, view: LiveView) -> Movement:
    """
    Register what a camera sees to what it saw before.

    :param reference: what it saw before.
    :param view: what it sees now.
    """
    start, surfaces = Poses.of(HERE), reference.surfaces
    # The pose itself, and 32 around it, up to 0.3 m and 12 degrees away.
    steps = (2.0 * qmc.Sobol(6, seed=0).random(32) - 1.0) * np.repeat([np.deg2rad(12.0), 0.3], 3)
    starts = moved_poses(Poses(*(np.repeat(values, 33, axis=0) for values in start)),
                         np.vstack([np.zeros((1, 6)), steps]))
    ends = aligned_poses(surfaces, sampled(view.patches, 300), starts,
                         AlignmentStage((0.4, 0.15), (16.0, 4.0), 12))
    scores = [comparison(view, Pose(position, rotation), reference, HERE).agreement
              for rotation, position in zip(*ends)]
    # A distant pose has to be better than that from the place of the reference.
    scores[0] += 0.02
    best = ends.subset(np.array([int(np.argmax(scores))]))
    pair = [RigCamera.of(reference.patches), RigCamera.of(view.patches)]
    poses = [HERE, Pose(best.positions[0], best.rotations[0])]
    for stage in (AlignmentStage((0.15, 0.06), (4.0, 1.5), 12), FINEST_STAGE):
        poses = joint_poses(pair, poses, stage, anchors=[0])
    constraints = all_constraints(pair, poses, [(0, 1), (1, 0)], FINEST_STAGE.max_distances[1],
                                  FINEST_STAGE.kernel_widths[1])
    certainty = certainties(constraints, ['reference', 'now'], anchors=[0])[1]
    metres, degrees = _held_movement(poses[1], certainty)
    return Movement(poses[1], metres, degrees,
                    comparison(view, poses[1], reference, HERE).agreement)


def movements_since(references: Mapping[str, LiveView], views: Mapping[str, LiveView],
                    poses: Mapping[str, Pose]) -> dict[str, Movement]:
    """
    Register what cameras see to what they saw before; those that are lost, to the other cameras.

    :param references: what each camera saw before, by name.
    :param views: what they see now; those without a reference are left out.
    :param poses: their poses before, z up.
    """
    found = {name: movement_since(references[name], view) for name, view in views.items()
             if name in references}
    known = {name: one.pose_now(poses[name]) for name, one in found.items() if not one.is_lost}
    if known and len(known) < len(found):
        again, _ = register_mutually({name: views[name] for name in found}, known=known)
        for name, one in again.items():
            if not one.refused:
                metres, radians = one.pose.away_from(poses[name])
                found[name] = Movement(relative_pose(one.pose, poses[name]), metres,
                                       float(np.rad2deg(radians)), one.overlap, by_others=True)
    return found


def movement_within(frames: Frames) -> tuple[np.ndarray, Movement] | None:
    """
    Find out whether a camera was moved while its F frames were taken.

    :returns: (F,) bool, which frames are not of the pose of the first one, and how the camera has
        moved between both; None if it stood still.
    :raises SceneError: if frames have too few points.
    """
    if (others := frames.two_groups()) is None:
        return None
    first, second = (LiveView(frames.subset(others == one).steady_cloud(), CameraModel(0.0, 1e6))
                     for one in (False, True))
    movement = movement_since(first, second)
    return (others, movement) if movement.has_moved else None


def still_cloud(name: str, frames: Mapping[Hashable, np.ndarray]) -> np.ndarray:
    """
    Return what most clouds of a camera show.

    :param name: the name of the camera in errors.
    :param frames: by file name, time or number: clouds (N, 3), metres, body frame, N may differ.
    :returns: (S, 3) metres, body frame; see
        :func:`~ocp_ros.registration.steady_cloud.steady_cloud`.
    :raises ConfigurationError: if they are of two poses or cameras.
    """
    if len(frames) == 1:
        return np.asarray(*frames.values())
    taken = Frames.of([*frames.values()])
    with suppress(SceneError):
        if found := movement_within(taken):
            others, movement = found
            first = int(others.argmax())
            which = f'from cloud {[*frames][first]} on' if others[first:].all() else (
                f'in {others.sum()} of {len(others)} clouds, {[*frames][first]} first')
            what = 'shows something else' if movement.is_lost else (
                f'hangs {100.0 * movement.metres:.1f} cm and {movement.degrees:.1f} degrees from '
                'where it hung before')
            raise ConfigurationError(
                f'{name}: found that it {what} {which}; expected clouds of one camera that does '
                'not move; leave out those before or after that, or take them again')
    return taken.steady_cloud()


def _held_movement(pose: Pose, certainty: Certainty) -> tuple[float, float]:
    """Return the metres and degrees of a movement along the axes on which it is certain."""
    turn = Rotation.from_matrix(pose.rotation).as_rotvec(degrees=True)
    along, about = certainty.slide_axes @ pose.position, certainty.turn_axes @ turn
    return (float(np.linalg.norm(along[np.abs(along) > 3.0 * certainty.metres])),
            float(np.linalg.norm(about[np.abs(about) > 3.0 * certainty.degrees])))


def way_back(movement: Movement, reference: Pose) -> str:
    """
    Return in words how a person puts a camera back.

    :param movement: how it has moved.
    :param reference: its former pose, map frame.
    :returns: turns first, in degrees, as seen from behind the camera; then displacements, in cm,
        as seen from there; those below 0.2 degrees and 0.5 cm are left out.
    """
    now = movement.pose_now(reference)
    yaw, pitch, roll = np.rad2deg(heading_of(reference.rotation) - heading_of(now.rotation))
    # Turns are at most half a circle.
    yaw, roll = (yaw + 180.0) % 360.0 - 180.0, (roll + 180.0) % 360.0 - 180.0
    # About the vertical first, or about the camera's own axes where that is less, as for one that
    # looks straight down.
    own = Rotation.from_matrix(now.rotation.T @ reference.rotation).as_rotvec(degrees=True)
    yaw, pitch, roll = min([(yaw, pitch, roll), tuple(own[::-1])],
                           key=lambda turns: sum(map(abs, turns)))
    heading = heading_of(reference.rotation)[0]
    ahead, left, up = 100.0 * rotation_matrix(heading).T @ (reference.position - now.position)
    turns = [f'{abs(value):.1f} degrees {words[int(value < 0.0)]}' for value, words in (
        (yaw, ('to the left', 'to the right')), (pitch, ('down', 'up')),
        (roll, ('clockwise', 'anticlockwise'))) if abs(value) >= 0.2]
    slides = [f'{words[int(value < 0.0)]} by {abs(value):.1f} cm' for value, words in (
        (up, ('raise it', 'lower it')), (left, ('move it left', 'move it right')),
        (ahead, ('move it forward', 'move it back'))) if abs(value) >= 0.5]
    return '; '.join([*([f'turn it {", ".join(turns)}'] if turns else []), *slides])


def save_references(path: Path, clouds: Mapping[str, np.ndarray], poses: Mapping[str, Pose]
                    ) -> None:
    """
    Write the clouds of cameras as references for later.

    :param clouds: by the name of the camera: (N, 3) metres, body frame.
    :param poses: where the cameras were, map frame, by name.
    """
    content = io.BytesIO()
    np.savez_compressed(content, **{
        CLOUD + name: cloud[::max(1, -(-len(cloud) // MAX_POINTS))].astype(np.float32)
        for name, cloud in clouds.items()}, **{
        POSE + name: np.vstack(poses[name]) for name in clouds})
    write_atomically(path, content.getvalue())


def load_references(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Pose]]:
    """
    Read the references that :func:`save_references` has written.

    :returns: clouds and poses by the name of the camera; files of earlier versions have no poses.
    :raises ConfigurationError: if the file cannot be read.
    """
    try:
        with np.load(io.BytesIO(read_regular(path)), allow_pickle=False) as file:
            clouds, poses = ({name.removeprefix(kind): np.asarray(file[name], dtype=np.float64)
                              for name in file.files if name.startswith(kind)}
                             for kind in (CLOUD, POSE))
        if (any(cloud.ndim != 2 or cloud.shape[1] != 3 for cloud in clouds.values())
                or any(pose.shape != (4, 3) for pose in poses.values())):
            raise ValueError('arrays of another shape than (N, 3)')
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise ConfigurationError(
            f'{path}: found no references of cameras ({error}); expected the file that ocp '
            'calibrate has written beside the placement; run it once without --against, or remove '
            'the file') from error
    return clouds, {name: Pose(pose[0], pose[1:]) for name, pose in poses.items()}


def sentence_of(name: str, movement: Movement, reference: Pose) -> str:
    """
    Return a sentence on a camera that has moved.

    :param reference: its former pose, map frame.
    """
    if movement.is_lost:
        return (f'{name} sees {max(100.0 * movement.agreement, 0.0):.0f} % of what it saw before, '
                'and the other cameras do not show where it hangs: it was turned away or covered, '
                'or the room was changed; calibrate it again')
    by, now = ' by what the other cameras see' * movement.by_others, movement.pose_now(reference)
    yaw, pitch, roll = np.rad2deg(heading_of(now.rotation))
    return (f'{name} has moved by {100.0 * movement.metres:.1f} cm and {movement.degrees:.1f} '
            f'degrees{by}, to {", ".join(f"{value:.3f}" for value in now.position)} m, yaw '
            f'{yaw:.1f}, pitch {pitch:.1f}, roll {roll:.1f} degrees; to put it back, '
            f'{way_back(movement, reference)}')
