# SPDX-License-Identifier: Apache-2.0
"""Thin ROS 2 nodes: convert, call the core once, publish."""
