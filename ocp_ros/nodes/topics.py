# SPDX-License-Identifier: Apache-2.0
"""Names of the topics and of the fields of the ``reward`` topic, relative to the namespace."""

OBSERVATION = 'observation'
CAMERA_POSES = 'camera_poses'
CAMERA_COMMANDS = 'camera_commands'
REWARD = 'reward'
SPACE_COVERAGE = 'space_coverage'
DEPTH_ERROR = 'depth_error'
SCENE = 'scene'
MARKERS = 'markers'
PLACEMENT = 'placement'
INSTRUCTIONS = 'instructions'
POLICY_WEIGHTS = 'policy_weights'
EXPERIENCE = 'experience'
TRAINING = 'training'
COMMANDERS = 'commanders'

#: A 64-bit float cannot hold today's nanoseconds, so stamps come in two numbers each:
#: the turn this message describes, and the one before it, whose command led here.
REWARD_FIELDS = (
    'stamp_sec', 'stamp_nanosec', 'previous_sec', 'previous_nanosec', 'episode', 'step', 'reward',
    'delta_space_coverage', 'delta_depth_error', 'penalty', 'space_coverage', 'depth_error',
    'terminated', 'truncated')

#: How the training is, as a namespace's policy and whoever watches are told.
TRAINING_FIELDS = ('hold', 'updates', 'behind', 'turns', 'transitions', 'incomplete',
                   'inconsistent', 'refused', 'dropped')


def share(number: int) -> str:
    """
    Name the field of ``reward`` that tells what the move of one camera was worth.

    :param number: 0 for the camera that chose first, and so on; step 0 has no such fields.
    """
    return f'share_{number}'
