# SPDX-License-Identifier: Apache-2.0
"""The one place that knows both numpy and ROS: topics and QoS, messages, parameters, URDF."""
