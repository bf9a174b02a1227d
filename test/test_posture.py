# SPDX-License-Identifier: Apache-2.0
"""One word for a posture: posed figures, turned and of any size, and what the simulated people do."""

import numpy as np
import pytest
from figure_poses import pose_of, posed
from scipy.spatial.transform import Rotation

from limbloc_ros.core.posture import POSTURES, posture_of
from limbloc_ros.simulation.motion import Motion
from limbloc_ros.simulation.person import load_person


def legs(hip, knee):
    return {f"{joint}_{side}_flexion": value for joint, value in (("hip", hip), ("knee", knee)) for side in "LR"}


CASES = {
    "standing": [{}, {"knee_L_flexion": 60.0}, {"hip_R_flexion": 90.0, "knee_R_flexion": 90.0}, legs(15.0, 20.0)],
    "sitting": [legs(90.0, 90.0), legs(80.0, 60.0), legs(100.0, 95.0), legs(90.0, 5.0)],
    "crouching": [legs(110.0, 140.0), legs(120.0, 125.0)],
    "other": [legs(0.0, 90.0)],  # on the knees
}


@pytest.mark.parametrize("stature", [1.1, 1.7, 1.95])
@pytest.mark.parametrize("word", CASES)
def test_posed_figures_of_all_sizes_facing_anywhere(word, stature):
    turn = Rotation.from_euler("z", 130, degrees=True).as_matrix()
    for degrees in CASES[word]:
        joints = pose_of(posed(degrees, stature)).joints
        assert posture_of(joints @ turn.T + [3.0, -2.0, 0.5]) == word, degrees


@pytest.mark.parametrize(("motion", "word"), [("sit", "sitting"), ("squat", "crouching"), ("walk", "standing")])
def test_what_the_simulated_people_do(motion, word):
    """Not our figure's joints; on the way down and up they are between two words."""
    for name in ("man", "child"):
        moving = Motion(load_person(name), empty_s=0.0, playlist=(motion,))
        words = [posture_of(moving.pose(t).joints) for t in np.arange(2.0, 14.0, 0.25)]
        assert set(words) <= {word, "standing", "other"}
        assert words.count(word) > 10
        assert words.count("other") < 0.2 * len(words)


@pytest.mark.parametrize("degrees", [90.0, -90.0])
@pytest.mark.parametrize("axis", "xy")
def test_who_lies(axis, degrees):
    joints = pose_of(posed({})).joints
    lying = joints @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix().T
    assert posture_of(lying) == "laying"


def test_bent_forward_is_not_lying():
    joints = pose_of(posed(legs(100.0, 0.0))).joints  # legs to the front: turned back they stand, the trunk is level
    assert posture_of(joints @ Rotation.from_euler("y", 100, degrees=True).as_matrix().T) == "other"


def test_the_words_are_in_the_messages_order():
    assert POSTURES == ("other", "standing", "sitting", "crouching", "laying")
    assert np.all([posture_of(np.random.default_rng(n).normal(size=(25, 3))) in POSTURES for n in range(50)])
