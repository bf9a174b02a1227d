# SPDX-License-Identifier: Apache-2.0
"""What the outlines of the silhouettes show and a figure does not, which arms they show, and arms in other flesh."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core._part_kernels import distance_to_part, lay_out
from limbloc_ros.core._unexplained_kernels import meet
from limbloc_ros.core.confidence import describe_pose
from limbloc_ros.core.figure import BONE, PART_NAMES, PART_SPHERES, FigureState, place
from limbloc_ros.core.parts import Part
from limbloc_ros.core.pipeline import Carver, PoseEstimator
from limbloc_ros.core.search import turned_about
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.core.unexplained import REACH_M, Outlines, forearm_depths_m, meet_outlines
from limbloc_ros.recordings.cases import load_case

WALK = Path(__file__).parent / "data" / "benchmark" / "public" / "seq_walk_circle"
LEFT, RIGHT = 0, 1


@pytest.fixture(scope="module")
def walking():
    """A hull, its surface, and the figure that was fitted to it."""
    case = load_case(WALK)
    hull = Carver(case.rig).carve(case.masks(20))
    pose = PoseEstimator().estimate(hull)
    return hull, extract_surface(hull), pose


def turned(pose, bone: str, degrees: tuple[float, float, float]) -> FigureState:
    """The pose's figure with one bone, and all that hangs on it, turned about its own axes."""
    state = FigureState.from_vector(pose.parameters)
    state.rotations[BONE[bone]] = state.rotations[BONE[bone]] @ exp_so3(np.radians(degrees))
    return state


def described(state, walking, **more):
    hull, surface, _ = walking
    return describe_pose(state, hull, None, {}, surface=surface, **more)


def test_rays_beside_two_balls_and_through_one():
    balls = np.array([[0, 0, 0], [1, 1, 1]]), np.array([0, 1]), np.array([[0.0, 0, 0], [0.0, 0, 1.0]]), np.full(2, 0.1)
    points = np.array([[0.12, 0.0, 0.0], [0.0, 0.0, 0.9], [0.15, 0.0, 1.0], [0.0, 0.0, 5.0]])
    along_y = np.tile([0.0, 1.0, 0.0], (4, 1))
    farthest, cost, gains = meet(points, along_y, *balls, 2, 0.03, 0.2)

    def robust(d):
        u = (d / 0.03) ** 2
        return 0.03**2 * u / (1 + u)

    assert farthest == pytest.approx([0.2, 0.05])  # what is near to neither counts as the first one's
    assert cost == pytest.approx((robust(0.02) + robust(0.0) + robust(0.05) + robust(0.2)) / 4)
    assert gains == pytest.approx([(robust(0.2) - robust(0.02)) / 4, (2 * robust(0.2) - robust(0.05)) / 4])
    farthest, cost, gains = meet(points[:0], along_y[:0], *balls, 2, 0.03, 0.2)
    assert cost == 0.0 and not farthest.any() and not gains.any()


def test_the_kernel_leaves_out_no_part_that_counts(walking):
    _, surface, pose = walking
    rng = np.random.default_rng(0)
    points = surface.points[rng.permutation(len(surface))[:60]]
    rays = rng.normal(size=(60, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    groups = rng.integers(0, 4, len(PART_NAMES))
    flesh = pose.flesh
    farthest, _, _ = meet(points, rays, PART_SPHERES, groups, flesh.centres, flesh.radii, 4, 0.03, 0.2)
    rows, _ = lay_out(PART_SPHERES, flesh.centres, flesh.radii)
    all_of_them = np.array(
        [[distance_to_part(row, *point, ray)[0] for row in rows] for point, ray in zip(points, rays, strict=True)]
    )
    nearest = groups[all_of_them.argmin(axis=1)]
    least = np.clip(all_of_them.min(axis=1), 0.0, 0.2)
    np.testing.assert_allclose(farthest, [least[nearest == g].max(initial=0.0) for g in range(4)], atol=1e-9)


def test_a_good_fit_is_reliable_and_all_of_it_shows(walking):
    hull, surface, pose = walking
    assert pose.reliable and not pose.doubt
    outlines = meet_outlines(hull, surface, pose.flesh)
    assert outlines.passed_m < 0.06
    assert (outlines.support > 0.1).all()


def test_an_arm_elsewhere_is_not_explained_and_the_pose_not_reliable(walking):
    hull, surface, pose = walking
    wrong = described(turned(pose, "upper_arm_L", (0.0, -70.0, 0.0)), walking)
    assert not wrong.reliable and "left arm" in wrong.doubt
    outlines, right = (meet_outlines(hull, surface, each.flesh) for each in (wrong, pose))
    assert outlines.passed_m > 0.11
    assert (outlines.support[LEFT] < 0.3 * right.support[LEFT]).any()
    # What somebody else explains, this figure need not; a part of a hull explains its own outlines.
    assert meet_outlines(hull, surface, wrong.flesh, [pose.flesh]).passed_m < 0.06
    assert meet_outlines(hull, surface, wrong.flesh, [Part.of(hull).filling()]).passed_m < 0.06


@pytest.mark.parametrize("side", [LEFT, RIGHT])
def test_an_arm_in_the_trunk_shows_nowhere_and_the_pose_is_not_reliable(walking, side):
    hull, surface, pose = walking
    name = "LR"[side]
    state = FigureState.from_vector(pose.parameters)
    state.rotations[BONE[f"upper_arm_{name}"]] = exp_so3(np.radians([30.0 if side else -30.0, 0.0, 0.0]))
    state.rotations[BONE[f"forearm_{name}"]] = np.eye(3)
    wrong = described(state, walking)
    outlines, right = (meet_outlines(hull, surface, each.flesh) for each in (wrong, pose))
    assert outlines.support[side].min() < 0.1 * right.support[side].min()
    assert forearm_depths_m(wrong.flesh)[side] > 0.0 > forearm_depths_m(pose.flesh)[side]
    assert forearm_depths_m(wrong.flesh)[1 - side] == forearm_depths_m(pose.flesh)[1 - side]
    assert not wrong.reliable


def test_a_figure_that_looks_the_other_way_is_not_reliable(walking):
    state = turned_about(FigureState.from_vector(walking[2].parameters))
    assert not described(state, walking).reliable


def test_where_nobody_knows_who_cut_the_hull_outlines_are_not_asked(walking):
    hull, surface, pose = walking
    unknown = dataclasses.replace(hull, cut_by=None)
    assert meet_outlines(unknown, surface, pose.flesh) is None
    state = turned(pose, "upper_arm_L", (0.0, -70.0, 0.0))
    assert describe_pose(state, unknown, None, {}, surface=surface).reliable


def test_outlines_beyond_reach_are_at_reach(walking):
    hull, surface, pose = walking
    state = FigureState.from_vector(pose.parameters)
    away = FigureState(state.root + np.array([0.0, 0.0, 1.0]), state.rotations, state.shape)
    outlines = meet_outlines(hull, surface, place(away).flesh())
    assert isinstance(outlines, Outlines) and outlines.passed_m == REACH_M
