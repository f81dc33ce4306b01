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
PLACEMENT_STATUS = 'placement_status'
INSTRUCTIONS = 'instructions'
POLICY_WEIGHTS = 'policy_weights'
EXPERIENCE = 'experience'
TRAINING = 'training'
RIG_MARKERS = 'rig_markers'
COVERAGE_CLOUD = 'coverage_cloud'
ERROR_CLOUD = 'error_cloud'
TRUE_COVERAGE_CLOUD = 'true_coverage_cloud'
TRUE_ERROR_CLOUD = 'true_error_cloud'

#: Message type of each topic, as ROS 2 writes it.
TYPES = {OBSERVATION: 'sensor_msgs/msg/PointCloud2', CAMERA_POSES: 'geometry_msgs/msg/PoseArray',
         CAMERA_COMMANDS: 'geometry_msgs/msg/PoseArray', REWARD: 'std_msgs/msg/Float64MultiArray',
         SPACE_COVERAGE: 'std_msgs/msg/Float64', DEPTH_ERROR: 'std_msgs/msg/Float64',
         SCENE: 'sensor_msgs/msg/PointCloud2', MARKERS: 'visualization_msgs/msg/MarkerArray',
         PLACEMENT: 'geometry_msgs/msg/PoseArray', PLACEMENT_STATUS: 'std_msgs/msg/String',
         INSTRUCTIONS: 'std_msgs/msg/String', POLICY_WEIGHTS: 'std_msgs/msg/UInt8MultiArray',
         EXPERIENCE: 'std_msgs/msg/UInt8MultiArray', TRAINING: 'std_msgs/msg/Float64MultiArray',
         RIG_MARKERS: 'visualization_msgs/msg/MarkerArray',
         COVERAGE_CLOUD: 'sensor_msgs/msg/PointCloud2', ERROR_CLOUD: 'sensor_msgs/msg/PointCloud2',
         TRUE_COVERAGE_CLOUD: 'sensor_msgs/msg/PointCloud2',
         TRUE_ERROR_CLOUD: 'sensor_msgs/msg/PointCloud2'}

#: Fields of ``reward``. A 64-bit float cannot hold today's nanoseconds exactly, so each stamp is
#: two numbers. ``stamp`` is that of the turn that the message describes, ``previous`` that of the
#: turn before, whose command led to it.
REWARD_FIELDS = ('stamp_sec', 'stamp_nanosec', 'previous_sec', 'previous_nanosec', 'episode',
                 'step', 'reward', 'delta_space_coverage', 'delta_depth_error', 'penalty',
                 'space_coverage', 'depth_error', 'terminated', 'truncated')

#: Fields of ``training``: the state of the training, for the policy of a namespace and observers.
TRAINING_FIELDS = ('hold', 'updates', 'behind', 'turns', 'transitions', 'incomplete',
                   'inconsistent', 'refused', 'dropped')


def camera_info_topic(camera: int) -> str:
    """Return the topic on which the CameraInfo messages of a camera are published."""
    return f'camera_{camera}/camera_info'


def camera_info_of_image(image_topic: str) -> str:
    """Return the topic of the CameraInfo of an image: beside the image, as in image_transport."""
    return f'{image_topic.removesuffix("/compressedDepth").rpartition("/")[0]}/camera_info'


def share_field(number: int) -> str:
    """
    Return the name of the field of ``reward`` that has the share of one camera's move.

    The message of step 0 has no such fields.

    :param number: 0 for the camera that chose first, 1 for the second, and so on.
    """
    return f'share_{number}'
