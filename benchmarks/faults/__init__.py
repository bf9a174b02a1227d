# SPDX-License-Identifier: Apache-2.0
"""Faults injected into the real graph: a staged room, cameras that misbehave, a watcher, and the list of scenarios."""
