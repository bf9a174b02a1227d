# SPDX-License-Identifier: Apache-2.0
"""A person of whom only a part is in the carve volume: no error, and no pose that claims to be right."""

from __future__ import annotations

import numpy as np
import pytest

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.pose import JOINT
from limbloc_ros.simulation.room import SimulatedRoom, default_rig


@pytest.mark.parametrize(
    ("low", "high"),
    [((-1.5, None, 0.0), (1.5, 1.5, 2.4)), ((-1.5, -1.5, 1.1), (1.5, 1.5, 2.4)), ((-1.5, -1.5, 0.0), (1.5, 1.5, 0.8))],
    ids=["left half", "head and chest", "legs"],
)
def test_a_person_half_out_of_the_volume_is_not_claimed_to_be_known(low, high):
    whole = default_rig(8, 320, 240)
    room = SimulatedRoom(whole, empty_s=0.0)
    masks = {name: room.render_with_mask(name, 3.0)[1] for name in whole.names}
    middle = room.joints(3.0)[JOINT["pelvis_centre"]]
    corner = np.array([value if value is not None else middle[axis] for axis, value in enumerate(low)])
    hull = Carver(Rig(whole.cameras, corner, np.array(high))).carve(masks)
    outcome = hull if isinstance(hull, NoPerson) else PoseEstimator().estimate(hull)
    assert isinstance(outcome, NoPerson) or (not outcome.reliable and np.isfinite(outcome.joints).all())
