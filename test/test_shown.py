# SPDX-License-Identifier: Apache-2.0
"""What only the limbs explain of the silhouettes, arms in other flesh, and what both say of a pose."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core.confidence import Judge, describe_pose
from limbloc_ros.core.figure import BONE, FigureState
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.search import turned_about
from limbloc_ros.core.shown import forearm_depths_m, limbs_shown
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.recordings.cases import load_case

WALK = Path(__file__).parent / "data" / "benchmark" / "public" / "seq_walk_circle"
LEFT, RIGHT = 0, 1


@pytest.fixture(scope="module")
def walking():
    """A hull, its surface, and the pose that was fitted to it."""
    case = load_case(WALK)
    hull = Carver(case.rig).carve(case.masks(20))
    return hull, extract_surface(hull), PoseEstimator().estimate(hull)


def described(state, walking):
    hull, surface, _ = walking
    return describe_pose(state, Judge(hull, surface), None, {})


def arm_in_the_trunk(pose, side):
    """The pose's figure with one arm straight through its trunk."""
    state = FigureState.from_vector(pose.parameters)
    state.rotations[BONE[f"upper_arm_{'LR'[side]}"]] = exp_so3(np.radians([30.0 if side else -30.0, 0.0, 0.0]))
    state.rotations[BONE[f"forearm_{'LR'[side]}"]] = np.eye(3)
    return state


def test_a_good_fit_is_reliable_and_its_limbs_show(walking):
    hull, _, pose = walking
    assert pose.reliable and not pose.doubt and pose.risk < 0.03
    assert (limbs_shown(hull.views, pose.flesh) > 0.05).all()


@pytest.mark.parametrize("side", [LEFT, RIGHT])
def test_an_arm_in_the_trunk_shows_nowhere_and_the_pose_is_not_reliable(walking, side):
    hull, _, pose = walking
    wrong = described(arm_in_the_trunk(pose, side), walking)
    shown = limbs_shown(hull.views, wrong.flesh)
    assert shown[side, :2].min() < 0.01 < 0.03 < shown[1 - side].min()
    depths, right = forearm_depths_m(wrong.flesh), forearm_depths_m(pose.flesh)
    assert depths[side] > -0.006 > right[side]
    assert depths[1 - side] == right[1 - side]
    assert not wrong.reliable and wrong.risk > 0.9
    assert wrong.doubt == f"the {('left', 'right')[side]} arm hardly shows in the silhouettes"


@pytest.mark.parametrize("side", [LEFT, RIGHT])
def test_a_leg_that_is_folded_away_is_not_reliable(walking, side):
    """As when the hull has lost it."""
    hull, _, pose = walking
    state = FigureState.from_vector(pose.parameters)
    state.rotations[BONE[f"thigh_{'LR'[side]}"]] = exp_so3(np.radians([0.0, -60.0, 0.0]))
    state.rotations[BONE[f"shin_{'LR'[side]}"]] = exp_so3(np.radians([0.0, 165.0, 0.0]))
    wrong = described(state, walking)
    assert limbs_shown(hull.views, wrong.flesh)[side, 2] < 0.3 * limbs_shown(hull.views, pose.flesh)[side, 2]
    assert not wrong.reliable


def test_an_arm_in_the_air_is_not_reliable(walking):
    state = FigureState.from_vector(walking[2].parameters)
    state.rotations[BONE["upper_arm_L"]] = state.rotations[BONE["upper_arm_L"]] @ exp_so3(np.radians([0.0, -70.0, 0.0]))
    wrong = described(state, walking)
    assert not wrong.reliable and "left arm" in wrong.doubt


def test_a_figure_that_looks_the_other_way_is_not_reliable(walking):
    state = turned_about(FigureState.from_vector(walking[2].parameters))
    assert not described(state, walking).reliable


def test_where_nobody_knows_what_the_cameras_saw_limbs_are_not_asked(walking):
    hull, surface, pose = walking
    unknown = dataclasses.replace(hull, views=None)
    assert describe_pose(arm_in_the_trunk(pose, LEFT), Judge(unknown, surface), None, {}).risk == 0.0
