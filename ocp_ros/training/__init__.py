# Copyright 2026 The ocp_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Soft actor-critic from stable-baselines3: replay, augmentation, runs, learner."""
