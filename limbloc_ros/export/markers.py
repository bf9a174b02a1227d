# SPDX-License-Identifier: Apache-2.0
"""Joints as the markers of other programs: which of ours is called what there, and where it lies.

`pose2sim` are the names of Pose2Sim's HALPE_26 skeleton, which its OpenSim models and scaling files know: the middle
of the hips is `Hip`, the top of the head `Head`. `Nose` and the small toes have no counterpart and are left out.
`limbloc` are all 25 joints by our names.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.pose import JOINT, JOINT_NAMES

Array = NDArray[np.float64]

_SIDED = {
    "Hip": "hip",
    "Knee": "knee",
    "Ankle": "ankle",
    "BigToe": "toe",
    "Heel": "heel",
    "Shoulder": "shoulder",
    "Elbow": "elbow",
    "Wrist": "wrist",
}

#: Marker -> the joints whose mean it is.
MARKER_SETS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "pose2sim": {"Hip": ("hip_L", "hip_R")}
    | {f"{s}{name}": (f"{joint}_{s}",) for s in "RL" for name, joint in list(_SIDED.items())[:5]}
    | {"Neck": ("neck_base",), "Head": ("head_top",)}
    | {f"{s}{name}": (f"{joint}_{s}",) for s in "RL" for name, joint in list(_SIDED.items())[5:]},
    "limbloc": {name: (name,) for name in JOINT_NAMES},
}

#: Names of others that are read, not written: MediaPipe Pose's landmarks (its foot index is the big toe's tip).
_LANDMARKS = {joint.upper(): joint for joint in ("hip", "knee", "ankle", "heel", "shoulder", "elbow", "wrist")}
_MEDIAPIPE = {
    f"{side}_{name}": (f"{joint}_{side[0]}",)
    for side in ("LEFT", "RIGHT")
    for name, joint in (*_LANDMARKS.items(), ("FOOT_INDEX", "toe"))
}


def marker_places(joints: Array, names: str) -> tuple[tuple[str, ...], Array]:
    """Markers' names and places [F, M, 3] m, from joints [F, 25, 3] m, for a key of MARKER_SETS."""
    chosen = MARKER_SETS[names]
    places = [np.mean([joints[:, JOINT[joint]] for joint in parts], axis=0) for parts in chosen.values()]
    return tuple(chosen), np.stack(places, axis=1)


def joints_of_markers(names: tuple[str, ...], places: Array) -> Array:
    """The other way: joints [F, 25, 3] m from markers [F, M, 3] of any known names; NaN for those not there.

    A joint is taken from the marker that is it alone; the middle of two joints says nothing of either.
    """
    joints = np.full((len(places), len(JOINT_NAMES), 3), np.nan)
    for markers in (*MARKER_SETS.values(), _MEDIAPIPE):
        for marker, parts in markers.items():
            if marker in names and len(parts) == 1:
                joints[:, JOINT[parts[0]]] = places[:, names.index(marker)]
    return joints
