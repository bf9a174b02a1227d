# SPDX-License-Identifier: Apache-2.0
"""Markerless 3D human posture from a few calibrated cameras, live, as a ROS 2 node graph."""

__version__ = "0.1.0"
