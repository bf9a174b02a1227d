# SPDX-License-Identifier: Apache-2.0
"""A moving skeleton -> BVH, as Blender, MotionBuilder and game engines read it.

Axes: y up, z forward. Zero rotations are a person who stands straight with hanging arms. Where lengths change from
frame to frame, every node has position channels, which hold its place in its parent (they replace OFFSET, as Blender
reads them); otherwise only the root has.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.figure import N_BONES
from limbloc_ros.core.joint_angles import Range, solve_triple
from limbloc_ros.export.skeleton import Skeleton

Array = NDArray[np.float64]

#: Order in which a node turns: heading first, and the pole at an arm held straight out to the side or a body on its
#: side, not at a bent hip.
ORDER = "YZX"
_AXES = np.array([np.eye(3)["XYZ".index(axis)] for axis in ORDER])
_RANGES = [Range(-np.pi, np.pi, True), Range(-np.pi / 2, np.pi / 2), Range(-np.pi, np.pi, True)]
_POSITION = ("Xposition", "Yposition", "Zposition")
_ROTATION = tuple(f"{axis}rotation" for axis in ORDER)

UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}


def bvh_text(skeleton: Skeleton, unit: str = "m", progress: Callable[[], object] = lambda: None) -> str:
    """The file's text.

    Args:
        skeleton: from `skeleton_of`.
        unit: of lengths, a key of UNITS; BVH itself has no place to say it.
        progress: called after each frame.
    """
    scale = UNITS[unit]
    moving = [n for n in range(len(skeleton.names)) if n < N_BONES or skeleton.stretches]
    lines = ["HIERARCHY"]
    order: list[int] = []
    _node(skeleton, 0, 0, scale, set(moving), lines, order)
    lines += ["MOTION", f"Frames: {len(skeleton.places)}", f"Frame Time: {1.0 / skeleton.rate_hz:.9g}"]
    previous: dict[int, Array] = {}
    for places, rotations in zip(scale * skeleton.places, skeleton.rotations, strict=True):
        values: list[float] = []
        for node in order:
            if node == 0 or skeleton.stretches:
                values.extend(places[node])
            angles = solve_triple(rotations[node], _AXES, _RANGES, previous.get(node))
            previous[node] = angles
            values.extend(np.degrees(angles))
        lines.append(" ".join(f"{value + 0.0:.6f}" for value in values))
        progress()
    return "\n".join([*lines, ""])


def _node(
    skeleton: Skeleton, node: int, depth: int, scale: float, moving: set[int], lines: list[str], order: list[int]
) -> None:
    """Append a node with its children; `order` takes those with channels, as MOTION lists them."""
    pad = "  " * depth
    # The root's OFFSET is zero: its place stands in its channels, and readers that add both must not count it twice.
    offset = np.zeros(3) if node == 0 else scale * skeleton.rest[node]
    numbers = " ".join(f"{value + 0.0:.6f}" for value in offset)
    if node not in moving:
        lines += [f"{pad}End Site", f"{pad}{{", f"{pad}  OFFSET {numbers}", f"{pad}}}"]
        return
    channels = (*_POSITION, *_ROTATION) if node == 0 or skeleton.stretches else _ROTATION
    order.append(node)
    lines += [f"{pad}{'JOINT' if depth else 'ROOT'} {skeleton.names[node]}", f"{pad}{{", f"{pad}  OFFSET {numbers}"]
    lines.append(f"{pad}  CHANNELS {len(channels)} {' '.join(channels)}")
    children = [child for child, parent in enumerate(skeleton.parents) if parent == node]
    for child in children:
        _node(skeleton, child, depth + 1, scale, moving, lines, order)
    if not children:  # every branch must end in a site; it goes a little on in the direction of the bone
        end = 0.1 * offset
        numbers = " ".join(f"{value + 0.0:.6f}" for value in end)
        lines += [f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET {numbers}", f"{pad}  }}"]
    lines.append(f"{pad}}}")
