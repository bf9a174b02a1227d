# SPDX-License-Identifier: Apache-2.0
"""What a person does, in one word, as ROS4HRI's `hri_msgs/BodyPosture` knows it: from the joints alone.

Angles are taken against the vertical (z is up), heights as shares of the person's own leg: a child sits as an adult
does, and a chair may have any height.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.pose import JOINT

Array = NDArray[np.float64]

#: The words, in the order of the message's constants (0 to 4).
POSTURES = ("other", "standing", "sitting", "crouching", "laying")

#: The trunk is upright up to this slant, and lies from the other on.
UPRIGHT, LYING = np.radians(45.0), np.radians(60.0)
#: Hips stand this high over the lower ankle, as a share of thigh and shin, when the leg that carries is straight.
STRAIGHT = 0.85
#: Who lies has the hips no higher over the lower ankle than this.
FLAT = 0.4
#: A thigh is level within this much of the horizontal.
LEVEL = np.radians(40.0)
#: A knee that is bent further than this is a squatting one.
SQUATTING = np.radians(112.0)
#: Who carries themselves has the trunk's middle this near above the feet's, as a share of the leg; a seat carries those
#: who lean back further.
BALANCED = 0.33


def posture_of(joints: Array) -> str:
    """The posture that joints [25, 3] m (z up) show: one of POSTURES.

    Standing is a straight leg below an upright trunk, also in a step. Sitting is two level thighs with the trunk behind
    the feet, on a chair or on the floor; crouching is with the trunk above the feet, or knees that are fully bent.
    Lying is a lying trunk with the hips down. What is none of these (bent forward, kneeling, on all fours, a leap) is
    `other`.
    """
    hips = [joints[JOINT[f"hip_{side}"]] for side in "LR"]
    trunk = joints[JOINT["neck_base"]] - np.mean(hips, axis=0)
    slant = _angle(trunk, np.array([0.0, 0.0, 1.0]))
    thighs, shins = [], []
    for side, hip in zip("LR", hips, strict=True):
        knee, ankle = joints[JOINT[f"knee_{side}"]], joints[JOINT[f"ankle_{side}"]]
        thighs.append(knee - hip)
        shins.append(ankle - knee)
    leg_m = float(np.mean([np.linalg.norm(t) + np.linalg.norm(s) for t, s in zip(thighs, shins, strict=True)]))
    lower_m = min(float(joints[JOINT[f"ankle_{side}"], 2]) for side in "LR")
    height = (float(np.mean([hip[2] for hip in hips])) - lower_m) / leg_m
    bends = [_angle(thigh, shin) for thigh, shin in zip(thighs, shins, strict=True)]
    if slant > LYING:
        return "laying" if height < FLAT else "other"
    if slant > UPRIGHT:
        return "other"
    if height > STRAIGHT:
        return "standing"
    if all(bend > SQUATTING for bend in bends):
        return "crouching"
    if any(abs(_angle(thigh, np.array([0.0, 0.0, -1.0])) - np.pi / 2) > LEVEL for thigh in thighs):
        return "other"
    feet = np.mean([joints[JOINT[f"{part}_{side}"]] for part in ("ankle", "toe") for side in "LR"], axis=0)
    behind = np.mean(hips, axis=0) + 0.5 * trunk - feet
    return "crouching" if np.linalg.norm(behind[:2]) < BALANCED * leg_m else "sitting"


def _angle(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
