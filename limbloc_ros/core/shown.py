# SPDX-License-Identifier: Apache-2.0
"""Whether limbs show: how much of the silhouettes nothing else explains, and whether arms lie in other flesh.

An arm that shows nowhere may as well be elsewhere: before the trunk, in its flesh, or where a ragged mask has lost it,
it hardly changes how well a figure matches its hull. A leg that the hull has lost is folded into the other flesh. So it
is asked what the cameras see of each limb that they see of nothing else, and that is held against what figure and
silhouettes do not share: the noise of the masks, clothes, and limbs in wrong places.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._part_kernels import flesh_distance
from limbloc_ros.core.figure import PART_NAMES, PART_SPHERES, SPHERE
from limbloc_ros.core.pose import Flesh
from limbloc_ros.core.views import Views

Array = NDArray[np.float64]

#: A figure that shares all but this with the silhouettes could not share more: cells are cells.
LEAST_MISMATCH = 1e-3

SIDES = ("left", "right")
_REST = 0
_GROUPS = {
    "upper_arm_L": 1, "forearm_L": 2, "hand_L": 2, "shin_L": 3, "foot_L": 3,
    "upper_arm_R": 4, "forearm_R": 5, "hand_R": 5, "shin_R": 6, "foot_R": 6,
}  # fmt: skip
_GROUP_OF_PART = np.array([_GROUPS.get(name, _REST) for name in PART_NAMES])
_GIRDLES = ("girdle_L", "girdle_R")
_FOREARMS = np.array([[SPHERE[f"{name}_{side}"] for name in ("bulge", "wrist")] for side in "LR"])
#: All parts but one arm and the girdles, which hold the shoulders on.
_BUT_THIS_ARM = [
    np.array([name not in (f"upper_arm_{side}", f"forearm_{side}", f"hand_{side}", *_GIRDLES) for name in PART_NAMES])
    for side in "LR"
]


def limbs_shown(views: Views, flesh: Flesh) -> Array:
    """What only the limbs explain of the silhouettes.

    Args:
        views: what the cameras saw.
        flesh: of the figure.

    Returns:
        [2, 3] of the left and the right side (SIDES), the area of the silhouettes that only the upper arm covers, that
        only forearm and hand do, and that only shin and foot do, over the area that figure and silhouettes do not
        share; mean of the cameras, as `Views.mismatch` weighs them. Usually 0.15, 0.25 and 0.65.
    """
    alone, mismatch = views.shares(PART_SPHERES, _GROUP_OF_PART, flesh.centres, flesh.radii)
    return np.asarray(alone[1:].reshape(2, 3) / max(mismatch, LEAST_MISMATCH))


def forearm_depths_m(flesh: Flesh) -> Array:
    """[2] how deep the left and the right forearm lie in the flesh of the figure's other parts, m.

    Its middle and its end both do; where one is outside, minus its distance from them.
    """
    depths = [
        -flesh_distance(flesh.centres[spheres], PART_SPHERES[others], flesh.centres, flesh.radii)[0].max()
        for spheres, others in zip(_FOREARMS, _BUT_THIS_ARM, strict=True)
    ]
    return np.array(depths)
