# SPDX-License-Identifier: Apache-2.0
"""How much of what the cameras saw a figure leaves unexplained: a limb of the silhouettes where the figure has none.

An arm that was put into the trunk, or a box in somebody's hands, hardly changes the XOR energy: a forearm is a
fiftieth of the body. But it shows in the outlines. Each point of the hull's surface lies on a viewing ray along the
outline of some silhouette, and the body touches that ray; so does a figure that is right, to some centimetres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from limbloc_ros.core._unexplained_kernels import farthest
from limbloc_ros.core.engine_robust import outline_rays
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import Flesh
from limbloc_ros.core.surface import Surface

#: Of the surface's points, so many are looked at: a limb has hundreds.
EVERY = 2
#: Distances beyond this are this, m.
REACH_M = 0.20
#: Parts around which hangs what the figure has not: skirts and coats.
_DRAPED = ("thigh_L", "thigh_R")


def unexplained_m(hull: Hull, surface: Surface, flesh: Flesh, others: Sequence[Flesh] = ()) -> float:
    """The largest distance, m, at which the outline of a silhouette passes a figure, at most REACH_M.

    Outlines nearest to the thighs are not asked: there a skirt may hang.

    Args:
        hull, surface: what the figure was fitted to. Where nobody knows which camera cut the hull, nothing is asked.
        flesh: of the figure.
        others: of other people in the room, whose outlines cut this hull as well.
    """
    everybody = (flesh, *others)
    firsts = np.cumsum([0, *(len(body.centres) for body in everybody)])
    parts = np.concatenate([body.parts + first for body, first in zip(everybody, firsts, strict=False)])
    centres = np.concatenate([body.centres for body in everybody])
    radii = np.concatenate([body.radii for body in everybody])
    counts = np.ones(len(parts), np.bool_)
    counts[: len(flesh.parts)] = [name not in _DRAPED for name in flesh.part_names]
    rows = np.arange(0, len(surface), EVERY)
    rays = outline_rays(hull, surface, rows)
    known = rays.any(axis=1)
    return min(REACH_M, float(farthest(surface.points[rows[known]], rays[known], parts, centres, radii, counts)))
