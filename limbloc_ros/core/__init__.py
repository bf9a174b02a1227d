# SPDX-License-Identifier: Apache-2.0
"""The method in numbers: no ROS, no files, no clock. Imports run down the data flow."""
