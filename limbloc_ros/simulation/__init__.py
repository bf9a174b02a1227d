# SPDX-License-Identifier: Apache-2.0
"""A person, a room and cameras that look at it: the demo's input, drawn by a skinned mesh."""
