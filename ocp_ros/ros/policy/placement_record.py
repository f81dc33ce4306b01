# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The final placement of ``policy_node`` as a file, for ``ocp score`` and for installers."""

from geometry_msgs.msg import PoseArray

from ocp_ros.rig.placement_file import created_by, Placed, Placement, placement_of
from ocp_ros.rig.rig_file import Camera
from ocp_ros.ros.interface.conversions import msg_to_positions
from ocp_ros.ros.policy.decider import Decider


def placement_from(poses: PoseArray, decider: Decider, why: str) -> Placement:
    """
    Make a placement of where cameras are.

    :param poses: of the cameras, in the order of the rig.
    :param decider: knows the rig file, and what each camera sees where there is none.
    :param why: the placement is final.
    """
    created = {**created_by('policy_node'), 'final': why}
    frame = poses.header.frame_id
    if decider.rig is not None:
        state = decider.state(poses)
        return placement_of(decider.rig, state.placement[:state.movable], created=created,
                            frame=frame)
    model = decider.models[0]
    placed = tuple(Placed(Camera(f'camera_{number}', '', model), tuple(position), (0.0,) * 3,
                          'free')
                   for number, position in enumerate(msg_to_positions(poses).round(4).tolist()))
    return Placement(placed, created=created, frame=frame)
