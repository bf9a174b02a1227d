# SPDX-License-Identifier: Apache-2.0
"""What the outlines of the silhouettes say of a figure: what they show and it has not, and which arm they show at all.

An arm that was put into the trunk, or a box in somebody's hands, hardly changes the XOR energy: a forearm is a
fiftieth of the body. But it shows in the outlines. Each point of the hull's surface lies on a viewing ray along the
outline of some silhouette, and the body touches that ray; so does a figure that is right, to some centimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _unexplained_kernels as kernels
from limbloc_ros.core._part_kernels import flesh_distance
from limbloc_ros.core.engine_robust import outline_rays
from limbloc_ros.core.figure import PART_NAMES, PART_SPHERES, SPHERE
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import Flesh
from limbloc_ros.core.surface import Surface

Array = NDArray[np.float64]

#: Of the surface's points, so many are looked at: a limb has hundreds.
EVERY = 2
#: Width of the robust cost of a ray's distance (as in `energy.Weights`), and how far a ray is looked after, m.
WIDTH_M, REACH_M = 0.03, 0.20

SIDES = ("left", "right")
_REST, _THIGHS = 0, 1
_GROUPS = {
    "thigh_L": _THIGHS, "thigh_R": _THIGHS, "upper_arm_L": 2, "upper_arm_R": 3,
    "forearm_L": 4, "hand_L": 4, "forearm_R": 5, "hand_R": 5,
}  # fmt: skip
_GROUP_OF_PART = np.array([_GROUPS.get(name, _REST) for name in PART_NAMES])
_COUNT = 6
_UPPER_ARMS, _LOWER_ARMS = [2, 3], [4, 5]
_FOREARMS = np.array([[SPHERE[f"{name}_{side}"] for name in ("bulge", "wrist")] for side in "LR"])
#: Parts that an arm does not belong to: the girdles hold the shoulder on.
_NOT_THIS_ARM = [
    np.array([not name.endswith(side) or _GROUPS.get(name, 0) < 2 for name in PART_NAMES])
    & np.array([not name.startswith("girdle") for name in PART_NAMES])
    for side in "LR"
]


@dataclass(frozen=True)
class Outlines:
    """How the outlines of the silhouettes meet a figure.

    Attributes:
        passed_m: the largest distance at which one passes the figure, at most REACH_M. Those nearest to the thighs are
            not asked: there a skirt or a coat hangs, which the figure has not.
        support: [2, 2] of the left and the right arm, how much worse the figure would explain the outlines if it had
            no upper arm, and no forearm and hand: the rise of the mean cost of a ray, over that cost. An arm that
            shows in the silhouettes has some tenths, one that lies before the trunk next to nothing: so far as the
            silhouettes go it may as well be elsewhere.
    """

    passed_m: float
    support: Array


def meet_outlines(hull: Hull, surface: Surface, flesh: Flesh, others: Sequence[Flesh] = ()) -> Outlines | None:
    """Hold a figure against the outlines of the silhouettes.

    Args:
        hull, surface: what the figure was fitted to.
        flesh: of the figure.
        others: of other people in the room, whose outlines cut this hull as well.

    Returns:
        None where nobody knows which camera cut the hull.
    """
    rows = np.arange(0, len(surface), EVERY)
    rays = outline_rays(hull, surface, rows)
    known = rays.any(axis=1)
    if not known.any():
        return None
    everybody = (flesh, *others)
    firsts = np.cumsum([0, *(len(body.centres) for body in everybody)])
    parts = np.concatenate([body.parts + first for body, first in zip(everybody, firsts, strict=False)])
    groups = np.full(len(parts), _REST)
    groups[: len(_GROUP_OF_PART)] = _GROUP_OF_PART
    farthest, cost, gains = kernels.meet(
        surface.points[rows[known]],
        rays[known],
        parts,
        groups,
        np.concatenate([body.centres for body in everybody]),
        np.concatenate([body.radii for body in everybody]),
        _COUNT,
        WIDTH_M,
        REACH_M,
    )
    support = np.stack([gains[_UPPER_ARMS], gains[_LOWER_ARMS]], axis=1) / max(cost, 1e-12)
    return Outlines(float(np.delete(farthest, _THIGHS).max()), support)


def forearm_depths_m(flesh: Flesh) -> Array:
    """[2] how deep the left and the right forearm lie in the flesh of the figure's other parts, m.

    Its middle and its end both do; where one is outside, minus its distance from them.
    """
    depths = [
        -flesh_distance(flesh.centres[spheres], PART_SPHERES[others], flesh.centres, flesh.radii)[0].max()
        for spheres, others in zip(_FOREARMS, _NOT_THIS_ARM, strict=True)
    ]
    return np.array(depths)
