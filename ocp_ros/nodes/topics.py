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

#: A 64-bit float cannot hold today's nanoseconds, so stamps come in two numbers each:
#: the turn this message describes, and the one before it, whose command led here.
REWARD_FIELDS = (
    'stamp_sec', 'stamp_nanosec', 'previous_sec', 'previous_nanosec', 'episode', 'step', 'reward',
    'delta_space_coverage', 'delta_depth_error', 'penalty', 'space_coverage', 'depth_error',
    'terminated', 'truncated')
