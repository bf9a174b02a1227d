# SPDX-License-Identifier: Apache-2.0
"""What the figure is made of: bones, joints, spheres and parts, by name. No numbers that a person's size changes.

All bones have x forward, y left, z up when the person stands straight with hanging arms.
"""

from __future__ import annotations

from typing import Any


def _both(rows: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """Rows written for the left side (names ending in _L), followed by their mirror images."""

    def mirrored(item: Any) -> Any:
        if isinstance(item, str):
            return item[:-2] + "_R" if item.endswith("_L") else item
        if isinstance(item, tuple) and len(item) == 3 and isinstance(item[0], float):
            return (item[0], -item[1], item[2])
        if isinstance(item, tuple):
            return tuple(mirrored(x) for x in item)
        return item

    return rows + [tuple(mirrored(item) for item in row) for row in rows]


#: name, parent, axes about which it turns in its parent.
BONES: list[tuple[str, str, str]] = [
    ("pelvis", "", "xyz"),
    ("abdomen", "pelvis", "xyz"),
    ("thorax", "abdomen", "xyz"),
    ("chest", "thorax", "xyz"),
    ("head", "chest", "xyz"),
    *_both(
        [
            ("clavicle_L", "chest", "xz"),
            ("upper_arm_L", "clavicle_L", "xyz"),
            ("forearm_L", "upper_arm_L", "y"),
            ("hand_L", "forearm_L", "xyz"),
            ("thigh_L", "pelvis", "xyz"),
            ("shin_L", "thigh_L", "y"),
            ("foot_L", "shin_L", "xyz"),
        ]
    ),
]

#: The bone that carries each published joint.
JOINT_BONES: dict[str, str] = {
    "head_centre": "head",
    "head_top": "head",
    "neck_base": "head",
    "torso_centre": "thorax",
    "pelvis_centre": "pelvis",
    **dict(
        row
        for pair in (
            ("shoulder_L", "upper_arm_L"),
            ("elbow_L", "forearm_L"),
            ("wrist_L", "hand_L"),
            ("hand_L", "hand_L"),
            ("fingertip_L", "hand_L"),
            ("hip_L", "thigh_L"),
            ("knee_L", "shin_L"),
            ("ankle_L", "foot_L"),
            ("toe_L", "foot_L"),
            ("heel_L", "foot_L"),
        )
        for row in (pair, (pair[0][:-1] + "R", pair[1][:-1] + "R"))
    ),
}

#: name, bone, rough place (m, for a stature of 1.75 m), rough radius (m) [, child bone, fraction of the way to it].
#: The exact values are in proportions.npz; these are where its making starts.
SPHERES: list[tuple[Any, ...]] = [
    ("belly", "abdomen", (0.06, 0.0, 0.11), 0.09),
    ("neck_low", "chest", (0.0, 0.0, 0.14), 0.06),
    ("neck_high", "head", (0.01, 0.0, 0.06), 0.055),
    ("cranium", "head", (0.03, 0.0, 0.17), 0.09),
    ("occiput", "head", (0.0, 0.0, 0.16), 0.08),
    ("face", "head", (0.06, 0.0, 0.10), 0.06),
    *_both(
        [
            ("hip_L", "pelvis", (0.0, 0.09, -0.01), 0.09),
            ("glute_L", "pelvis", (-0.04, 0.065, -0.02), 0.08),
            ("iliac_L", "pelvis", (0.01, 0.08, 0.10), 0.085),
            ("waist_L", "abdomen", (0.01, 0.065, 0.20), 0.085),
            ("ribs_L", "thorax", (0.02, 0.075, 0.14), 0.09),
            ("chest_L", "chest", (0.05, 0.08, 0.0), 0.09),
            ("back_L", "chest", (0.0, 0.08, 0.05), 0.08),
            ("upper_chest_L", "chest", (0.02, 0.08, 0.08), 0.07),
            ("shoulder_L", "clavicle_L", (0.0, -0.005, 0.0), 0.055, "upper_arm_L", 1.0),
            ("deltoid_L", "upper_arm_L", (0.0, 0.01, -0.05), 0.05),
            ("biceps_L", "upper_arm_L", (0.0, 0.0, 0.0), 0.045, "forearm_L", 0.6),
            ("elbow_L", "upper_arm_L", (0.0, 0.0, 0.0), 0.04, "forearm_L", 1.0),
            ("bulge_L", "forearm_L", (0.0, 0.0, 0.0), 0.04, "hand_L", 0.25),
            ("wrist_L", "forearm_L", (0.0, 0.0, 0.0), 0.027, "hand_L", 1.0),
            ("palm_L", "hand_L", (0.0, 0.0, -0.05), 0.027),
            ("thumb_L", "hand_L", (0.05, -0.01, -0.07), 0.016),
            ("knuckles_L", "hand_L", (0.0, -0.01, -0.10), 0.027),
            ("tips_L", "hand_L", (0.005, -0.01, -0.17), 0.017),
            ("thigh_top_L", "thigh_L", (0.0, 0.0, 0.0), 0.085, "shin_L", 0.15),
            ("thigh_mid_L", "thigh_L", (0.0, 0.0, 0.0), 0.07, "shin_L", 0.55),
            ("knee_L", "thigh_L", (0.0, 0.0, 0.0), 0.055, "shin_L", 1.0),
            ("calf_L", "shin_L", (-0.02, 0.0, 0.0), 0.055, "foot_L", 0.3),
            ("shin_low_L", "shin_L", (0.0, 0.0, 0.0), 0.04, "foot_L", 0.7),
            ("ankle_L", "shin_L", (0.0, 0.0, 0.0), 0.037, "foot_L", 1.0),
            ("heel_L", "foot_L", (-0.03, 0.0, -0.04), 0.035),
            ("ball_L", "foot_L", (0.11, 0.0, -0.05), 0.035),
            ("toe_L", "foot_L", (0.17, 0.0, -0.055), 0.025),
        ]
    ),
]

#: name, the one to three spheres whose convex hull it is.
PARTS: list[tuple[str, tuple[str, ...]]] = [
    ("pelvis", ("hip_L", "hip_R", "iliac_L")),
    ("pelvis", ("hip_R", "iliac_L", "iliac_R")),
    ("pelvis", ("glute_L", "glute_R")),
    ("belly", ("belly", "iliac_L", "iliac_R")),
    ("belly", ("belly", "waist_L", "waist_R")),
    ("abdomen", ("iliac_L", "iliac_R", "waist_L")),
    ("abdomen", ("iliac_R", "waist_L", "waist_R")),
    ("thorax", ("waist_L", "waist_R", "ribs_L")),
    ("thorax", ("waist_R", "ribs_L", "ribs_R")),
    ("chest", ("ribs_L", "ribs_R", "chest_L")),
    ("chest", ("ribs_R", "chest_L", "chest_R")),
    ("chest", ("ribs_L", "ribs_R", "back_L")),
    ("chest", ("ribs_R", "back_L", "back_R")),
    ("chest", ("chest_L", "chest_R", "upper_chest_L")),
    ("chest", ("chest_R", "upper_chest_L", "upper_chest_R")),
    ("chest", ("back_L", "back_R", "upper_chest_L")),
    ("chest", ("back_R", "upper_chest_L", "upper_chest_R")),
    ("neck", ("neck_low", "neck_high")),
    ("head", ("cranium", "occiput", "face")),
    ("head", ("neck_high", "occiput", "face")),
    *_both(
        [
            ("pelvis", ("glute_L", "hip_L", "thigh_top_L")),
            ("girdle_L", ("neck_low", "upper_chest_L", "shoulder_L")),
            ("girdle_L", ("back_L", "upper_chest_L", "shoulder_L")),
            ("upper_arm_L", ("shoulder_L", "deltoid_L")),
            ("upper_arm_L", ("deltoid_L", "biceps_L")),
            ("upper_arm_L", ("biceps_L", "elbow_L")),
            ("forearm_L", ("elbow_L", "bulge_L")),
            ("forearm_L", ("bulge_L", "wrist_L")),
            ("hand_L", ("wrist_L", "palm_L")),
            ("hand_L", ("palm_L", "knuckles_L")),
            ("hand_L", ("knuckles_L", "tips_L")),
            ("hand_L", ("palm_L", "thumb_L")),
            ("thigh_L", ("hip_L", "thigh_top_L")),
            ("thigh_L", ("thigh_top_L", "thigh_mid_L")),
            ("thigh_L", ("thigh_mid_L", "knee_L")),
            ("shin_L", ("knee_L", "calf_L")),
            ("shin_L", ("calf_L", "shin_low_L")),
            ("shin_L", ("shin_low_L", "ankle_L")),
            ("foot_L", ("ankle_L", "heel_L", "ball_L")),
            ("foot_L", ("ball_L", "toe_L")),
        ]
    ),
]

#: What loose clothes add to radii, m for a stature of 1.75 m, per unit of that kind of clothing; both sides alike.
CLOTHING: dict[str, dict[str, float]] = {
    "upper": {
        "iliac": 0.0175,
        "belly": 0.0175,
        "waist": 0.0175,
        "ribs": 0.0175,
        "chest": 0.0175,
        "back": 0.0175,
        "upper_chest": 0.014,
        "shoulder": 0.014,
        "deltoid": 0.014,
        "biceps": 0.014,
        "elbow": 0.01,
        "bulge": 0.01,
    },
    "lower": {
        "iliac": 0.01,
        "hip": 0.0175,
        "glute": 0.0175,
        "thigh_top": 0.021,
        "thigh_mid": 0.026,
        "knee": 0.026,
        "calf": 0.014,
    },
}
