# SPDX-License-Identifier: Apache-2.0
"""The final placement of ``policy_node`` as a file, for ``ocp score`` and for installers."""

from geometry_msgs.msg import PoseArray

from ocp_ros.geometry.cameras import CameraModel
from ocp_ros.rig.placement_file import created_by, Placed, Placement, placement_of
from ocp_ros.rig.rig_file import Camera
from ocp_ros.ros.interface.conversions import msg_to_positions
from ocp_ros.ros.policy.rig_constraints import RigConstraints


def placement_from(poses: PoseArray, guard: RigConstraints | None, model: CameraModel, why: str
                   ) -> Placement:
    """
    Make a placement of where cameras are.

    :param poses: of the cameras, in the order of the rig.
    :param guard: the rig file; None where there is none.
    :param model: what each camera sees where there is none.
    :param why: the placement is final.
    """
    created = {**created_by('policy_node'), 'final': why}
    frame = poses.header.frame_id
    if guard is not None:
        sight = guard.sight(poses)
        return placement_of(guard.rig, sight.placement[:sight.movable], created=created,
                            frame=frame)
    placed = tuple(Placed(Camera(f'camera_{number}', '', model), tuple(position), (0.0,) * 3,
                          'free')
                   for number, position in enumerate(msg_to_positions(poses).round(4).tolist()))
    return Placement(placed, created=created, frame=frame)
