# SPDX-License-Identifier: Apache-2.0
"""What only the limbs explain of the silhouettes, arms in other flesh, and what both say of a pose."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core._shown_kernels import closed, compare_silhouettes, draw_part, looking_at
from limbloc_ros.core.confidence import describe_pose
from limbloc_ros.core.figure import BONE, PART_SPHERES, FigureState, flesh_distance
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
    return describe_pose(state, hull, None, {}, surface=surface)


def arm_in_the_trunk(pose, side):
    """The pose's figure with one arm straight through its trunk."""
    state = FigureState.from_vector(pose.parameters)
    state.rotations[BONE[f"upper_arm_{'LR'[side]}"]] = exp_so3(np.radians([30.0 if side else -30.0, 0.0, 0.0]))
    state.rotations[BONE[f"forearm_{'LR'[side]}"]] = np.eye(3)
    return state


def ball(centre, radius):
    """Points on a ball's surface, 1 cm apart."""
    n = int(4 * np.pi * radius**2 / 1e-4)
    z = (np.arange(n) + 0.5) / n * 2 - 1
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    ring = np.sqrt(1 - z * z)
    return centre + radius * np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def test_two_balls_that_hide_each_other_from_one_camera_and_not_from_another():
    balls = np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 1.0]])
    radii = np.array([0.2, 0.1])
    surface = np.concatenate([ball(*each) for each in zip(balls, radii, strict=True)])
    parts, groups = np.array([[0, 0, 0], [1, 1, 1]]), np.array([0, 1])
    beside, behind = np.array([[30.0, 0.0, 1.0]]), np.array([[0.0, -30.0, 1.0]])
    cell = 0.01

    def cells(viewpoints, spheres=balls):
        return compare_silhouettes(surface, viewpoints, parts, groups, spheres, radii, 2, cell, 30)

    large, small, rims = cells(beside) * cell**2
    assert large == pytest.approx(np.pi * 0.2**2, rel=0.06)
    assert small == pytest.approx(np.pi * 0.1**2, rel=0.10)
    assert rims < 0.10 * large
    large, small, _ = cells(behind) * cell**2
    assert small == 0.0
    assert large == pytest.approx(np.pi * (0.2**2 - 0.1**2), rel=0.08)
    np.testing.assert_array_equal(cells(np.concatenate([beside, behind])), cells(beside) + cells(behind))
    elsewhere = balls + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.4]])
    _, small, apart = cells(beside, elsewhere) * cell**2
    assert small == 0.0  # where it is now, nobody sees anything
    assert apart - rims == pytest.approx(2 * np.pi * 0.1**2, rel=0.10)


def test_a_part_is_drawn_where_a_ray_meets_it(walking):
    flesh = walking[2].flesh
    rng = np.random.default_rng(0)
    for part in PART_SPHERES[rng.permutation(len(PART_SPHERES))[:12]]:
        discs = np.column_stack([flesh.centres[:, :2], flesh.radii]) * 100.0  # from far above, in cells of a centimetre
        left, top = (np.floor(discs[part, :2].min(axis=0)) - 25).astype(int)
        image = np.zeros((120, 120), np.uint8)
        draw_part(part, discs, np.uint8(4), left, top, np.empty((120, 2)), image)
        columns, rows = np.meshgrid(left + np.arange(120), top + np.arange(120))
        flat = np.column_stack([discs[:, :2], np.zeros(len(discs))])
        cells = np.column_stack([columns.ravel(), rows.ravel(), np.zeros(columns.size)]).astype(float)
        outside = flesh_distance(cells, dataclasses.replace(flesh, parts=part[None], centres=flat, radii=discs[:, 2]))[
            0
        ].reshape(image.shape)
        assert (image[outside < -0.3] == 4).all()  # between two discs of a side the row ends a little early
        assert not image[outside > 0.01].any()


def test_gaps_between_points_are_closed_and_nothing_grows():
    marks = np.zeros((20, 20), np.uint8)
    marks[5:15:3, 5:15:3] = 1
    full = np.zeros_like(marks)
    full[5:15, 5:15] = 1
    np.testing.assert_array_equal(closed(marks), full)
    np.testing.assert_array_equal(closed(full), full)


@pytest.mark.parametrize("viewpoint", [[3.0, 1.0, 2.0], [0.0, 0.0, 5.0]])
def test_a_camera_that_looks_at_the_middle(viewpoint):
    axes = looking_at(np.array(viewpoint), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(np.cross(axes[2], np.array([0.0, 0.0, 1.0]) - viewpoint), 0.0, atol=1e-12)


def test_a_good_fit_is_reliable_and_its_limbs_show(walking):
    hull, surface, pose = walking
    assert pose.reliable and not pose.doubt and pose.risk < 0.03
    assert (limbs_shown(hull, surface, pose.flesh) > 0.05).all()


@pytest.mark.parametrize("side", [LEFT, RIGHT])
def test_an_arm_in_the_trunk_shows_nowhere_and_the_pose_is_not_reliable(walking, side):
    hull, surface, pose = walking
    wrong = described(arm_in_the_trunk(pose, side), walking)
    shown = limbs_shown(hull, surface, wrong.flesh)
    assert shown[side, :2].min() < 0.01 < 0.03 < shown[1 - side].min()
    depths, right = forearm_depths_m(wrong.flesh), forearm_depths_m(pose.flesh)
    assert depths[side] > 0.0 > right[side]
    assert depths[1 - side] == right[1 - side]
    assert not wrong.reliable and wrong.risk > 0.9
    assert wrong.doubt == f"the {('left', 'right')[side]} arm hardly shows in the silhouettes"


@pytest.mark.parametrize("side", [LEFT, RIGHT])
def test_a_leg_that_is_folded_away_is_not_reliable(walking, side):
    """As when the hull has lost it."""
    hull, surface, pose = walking
    state = FigureState.from_vector(pose.parameters)
    state.rotations[BONE[f"thigh_{'LR'[side]}"]] = exp_so3(np.radians([0.0, -60.0, 0.0]))
    state.rotations[BONE[f"shin_{'LR'[side]}"]] = exp_so3(np.radians([0.0, 165.0, 0.0]))
    wrong = described(state, walking)
    assert limbs_shown(hull, surface, wrong.flesh)[side, 2] < 0.3 * limbs_shown(hull, surface, pose.flesh)[side, 2]
    assert not wrong.reliable


def test_an_arm_in_the_air_is_not_reliable(walking):
    state = FigureState.from_vector(walking[2].parameters)
    state.rotations[BONE["upper_arm_L"]] = state.rotations[BONE["upper_arm_L"]] @ exp_so3(np.radians([0.0, -70.0, 0.0]))
    wrong = described(state, walking)
    assert not wrong.reliable and "left arm" in wrong.doubt


def test_a_figure_that_looks_the_other_way_is_not_reliable(walking):
    state = turned_about(FigureState.from_vector(walking[2].parameters))
    assert not described(state, walking).reliable


def test_where_nobody_knows_the_cameras_limbs_are_not_asked(walking):
    hull, surface, pose = walking
    unknown = dataclasses.replace(hull, cut_by=None, viewpoints=hull.viewpoints[:0])
    assert limbs_shown(unknown, surface, pose.flesh) is None
    assert describe_pose(arm_in_the_trunk(pose, LEFT), unknown, None, {}, surface=surface).reliable
