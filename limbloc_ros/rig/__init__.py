# SPDX-License-Identifier: Apache-2.0
"""The calibrated cameras of a room: the rig file and what can be read into it."""
