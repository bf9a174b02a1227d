# SPDX-License-Identifier: Apache-2.0
"""Whether arms show: how much of the silhouettes nothing else explains, and whether they lie in other flesh.

An arm that shows nowhere may as well be elsewhere: before the trunk, in its flesh, or where a ragged mask has lost it,
it hardly changes how well a figure matches its hull. So it is asked what the cameras see of each arm that they see of
nothing else, and that is held against what figure and hull do not share there: the noise of the masks, clothes, and
limbs in wrong places.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._part_kernels import flesh_distance
from limbloc_ros.core._shown_kernels import compare_silhouettes
from limbloc_ros.core.figure import PART_NAMES, PART_SPHERES, SPHERE
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import Flesh
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]

#: The silhouettes' cells are no finer than this, m, nor than the hull's voxels.
CELL_M = 0.02
#: A figure is looked at so far beyond the hull's silhouettes, m.
MARGIN_M = 0.3

SIDES = ("left", "right")
_REST = 0
_GROUPS = {
    "upper_arm_L": 1, "forearm_L": 2, "hand_L": 2,
    "upper_arm_R": 3, "forearm_R": 4, "hand_R": 4,
}  # fmt: skip
_GROUP_OF_PART = np.array([_GROUPS.get(name, _REST) for name in PART_NAMES])
_COUNT = 5
_FOREARMS = np.array([[SPHERE[f"{name}_{side}"] for name in ("bulge", "wrist")] for side in "LR"])
#: All parts but one arm and the girdles, which hold the shoulders on.
_BUT_THIS_ARM = [
    np.array([not (name in _GROUPS and name.endswith(side)) and not name.startswith("girdle") for name in PART_NAMES])
    for side in "LR"
]


def arms_shown(hull: Hull, surface: Surface, flesh: Flesh) -> Array | None:
    """What only the arms explain of the silhouettes.

    Args:
        hull, surface: what the figure was fitted to.
        flesh: of the figure.

    Returns:
        [2, 2] of the left and the right arm (SIDES), the area that only the upper arm covers in the hull's silhouettes,
        and that only forearm and hand do, summed over all cameras, over the area that figure and hull do not share;
        usually a tenth. None where nobody knows where the cameras are.
    """
    if len(hull.viewpoints) == 0:
        return None
    cell = max(CELL_M, hull.voxel_m)
    cells = compare_silhouettes(
        surface.points, np.array(hull.viewpoints, np.float64), PART_SPHERES, _GROUP_OF_PART, flesh.centres, flesh.radii,
        _COUNT, cell, round(MARGIN_M / cell),
    )  # fmt: skip
    return np.asarray(cells[1:_COUNT].reshape(2, 2) / max(int(cells[_COUNT]), 1))


def forearm_depths_m(flesh: Flesh) -> Array:
    """[2] how deep the left and the right forearm lie in the flesh of the figure's other parts, m.

    Its middle and its end both do; where one is outside, minus its distance from them.
    """
    depths = [
        -flesh_distance(flesh.centres[spheres], PART_SPHERES[others], flesh.centres, flesh.radii)[0].max()
        for spheres, others in zip(_FOREARMS, _BUT_THIS_ARM, strict=True)
    ]
    return np.array(depths)
