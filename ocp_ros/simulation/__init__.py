# SPDX-License-Identifier: Apache-2.0
"""A rig in a scene: state, reward, the Gymnasium environment."""
