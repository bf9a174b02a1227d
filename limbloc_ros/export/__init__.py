# SPDX-License-Identifier: Apache-2.0
"""A run -> files that other programs open: tables, markers, skeletons, meshes, videos."""
