# SPDX-License-Identifier: Apache-2.0
"""The searches' mechanics, on hulls made of the figure's own flesh, and their kernels against brute force.

Such hulls say nothing of real people (see test_engine_robust.py); they say whether a search finds what is there.
"""

import math

import figure_poses
import numpy as np
import pytest
from flesh_hulls import POSTURES, VOXEL, hull_where, person_in

from limbloc_ros.core import search
from limbloc_ros.core.directions import sphere_directions
from limbloc_ros.core.figure import BONE, place
from limbloc_ros.core.search import ARM, LEG, Medial, kernels, limb_kernels


@pytest.fixture(scope="module", params=POSTURES)
def person(request):
    """A posed figure somewhere in the room, its hull and the hull's medial axis."""
    return person_in(request.param)


# medial axis


def test_medial_axis_of_a_ball_is_its_centre():
    hull = hull_where(lambda p: np.linalg.norm(p - 0.01, axis=1) - 0.2, [-0.4] * 3, [0.4] * 3)
    points = Medial.of(hull).points
    assert 1 <= len(points) <= 40
    assert np.linalg.norm(points[:, :3] - 0.01, axis=1).max() < 2.5 * VOXEL
    assert points[:, 3].max() == pytest.approx(0.2, abs=1e-6)


def test_medial_axis_of_a_rod_runs_along_it():
    def rod(p):
        t = np.clip(p[:, 2], 0.0, 0.8)
        return np.linalg.norm(p - np.column_stack([0 * t + 0.01, 0 * t + 0.01, t]), axis=1) - 0.05

    points = Medial.of(hull_where(rod, [-0.2, -0.2, -0.2], [0.2, 0.2, 1.0])).points
    assert np.hypot(points[:, 0] - 0.01, points[:, 1] - 0.01).max() < 1.5 * VOXEL
    for z in np.arange(0.0, 0.8, VOXEL):
        assert np.abs(points[:, 2] - z).min() < VOXEL  # without a gap
    assert points[:, 2].min() > -0.04
    assert points[:, 2].max() < 0.84


def test_medial_points_are_deep_voxels_in_array_order(person):
    hull, points = person.hull, person.medial.points
    local = np.round((points[:, :3] - hull.origin_m) / VOXEL).astype(int)
    np.testing.assert_allclose(hull.origin_m + local * VOXEL, points[:, :3], atol=1e-9)
    np.testing.assert_allclose(-hull.sdf[tuple(local.T)], points[:, 3])
    assert (points[:, 3] > 0).all()
    rank = np.ravel_multi_index(tuple(local.T), hull.sdf.shape)
    assert (np.diff(rank) > 0).all()


def test_every_limb_has_medial_points_near(person):
    middles = [0.5 * (person.placed.origins[BONE[a]] + person.placed.origins[BONE[b]]) for a, b in CHAIN]
    for middle in middles:
        assert np.linalg.norm(person.medial.points[:, :3] - middle, axis=1).min() < 0.04


CHAIN = [
    (f"{a}_{side}", f"{b}_{side}")
    for side in "LR"
    for a, b in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))
]


def test_depth_is_trilinear_and_constant_beyond_the_grid():
    rng = np.random.default_rng(0)
    a, b, c, d = rng.normal(size=4)
    index = np.indices((4, 5, 6)).astype(float)
    sdf = (a * index[0] + b * index[1] + c * index[2] + d).astype(np.float32)
    origin, voxel = np.array([1.0, -2.0, 3.0]), 0.1
    for _ in range(20):
        at = rng.uniform(0, 2.9, 3)
        value = kernels.depth_at(sdf, origin, voxel, *(origin + voxel * at))
        assert value == pytest.approx(a * at[0] + b * at[1] + c * at[2] + d, abs=1e-5)
    assert kernels.depth_at(sdf, origin, voxel, -90.0, -2.0, 3.0) == pytest.approx(d, abs=1e-6)
    assert kernels.depth_at(sdf, origin, voxel, 90.0, -2.0, 3.0) == pytest.approx(3 * a + d, abs=0.002 * abs(a))


# small kernels by brute force


def test_points_are_spread_out_greedily():
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (300, 4))
    order = rng.permutation(300)
    expected = []
    for n in order:
        if all(np.linalg.norm(points[n, :3] - points[m, :3]) >= 0.25 for m in expected):
            expected.append(n)
    assert kernels.spread_out(points, order, 0.25, 1000).tolist() == expected
    assert kernels.spread_out(points, order, 0.25, 5).tolist() == expected[:5]
    assert len(kernels.spread_out(points[:0], order[:0], 0.25, 5)) == 0


def test_directions_cover_the_sphere_evenly():
    directions = sphere_directions(100)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    rng = np.random.default_rng(6)
    probes = rng.normal(size=(2000, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    assert np.degrees(np.arccos((probes @ directions.T).max(axis=1))).max() < 17
    assert np.linalg.norm(directions.mean(axis=0)) < 0.02


# torsos


def test_torso_hypotheses_contain_the_true_torso(person):
    rng = np.random.default_rng(0)
    found = search.torso_hypotheses(person.hull, person.medial, rng, 8)
    scores = [score for _, score in found]
    assert scores == sorted(scores)
    assert 0 <= scores[0] < 0.15
    names = ["pelvis", "chest", "head", "thigh_L", "thigh_R", "upper_arm_L", "upper_arm_R"]
    bones = [BONE[name] for name in names]
    gaps = []
    for state, _ in found:
        for facing in (state, search.turned_about(state)):
            gaps.append(np.linalg.norm(place(facing).origins[bones] - person.placed.origins[bones], axis=1).max())
    assert min(gaps) < 0.10  # left and right where they belong: the better facing
    best = place(found[0][0]).origins[bones[:3]]
    assert np.linalg.norm(best - person.placed.origins[bones[:3]], axis=1).max() < 0.10
    assert np.exp(found[0][0].shape[0]) == pytest.approx(1.7, rel=0.25)  # the legs will tell more


def test_hypotheses_differ_and_are_the_same_every_time(person):
    found, again = (search.torso_hypotheses(person.hull, person.medial, np.random.default_rng(0), 6) for _ in range(2))
    assert 1 <= len(found) <= 6
    for (a, _), (b, _) in zip(found, again, strict=True):
        np.testing.assert_array_equal(a.to_vector(), b.to_vector())
    for i, (a, _) in enumerate(found):
        for b, _ in found[:i]:
            R, Q = a.rotations[0], b.rotations[0]
            side = math.acos(min(1.0, abs(R[:, 1] @ Q[:, 1])))
            axis = math.acos(min(1.0, R[:, 2] @ Q[:, 2]))
            assert np.linalg.norm(a.root - b.root) >= 0.08 or max(side, axis) >= 0.4


def test_turning_about_keeps_the_volume_and_swaps_the_sides():
    state = figure_poses.posed({"spine_lower_flexion": 25, "spine_upper_bend": 10, "neck_rotation": 30})
    turned = search.turned_about(state)
    here, there = place(state), place(turned)
    assert here.rotations[0][:, 0] @ there.rotations[0][:, 0] == pytest.approx(-1)
    assert here.rotations[0][:, 2] @ there.rotations[0][:, 2] == pytest.approx(1)
    for a, b in (("thigh_L", "thigh_R"), ("upper_arm_L", "upper_arm_R"), ("head", "head")):
        assert np.linalg.norm(here.origins[BONE[a]] - there.origins[BONE[b]]) < 0.07
    twice = search.turned_about(turned)
    np.testing.assert_allclose(twice.root, state.root, atol=1e-9)
    np.testing.assert_allclose(twice.rotations, state.rotations, atol=1e-9)


# limbs


def tube_by_hand(depth, a, b, ra, rb, steps, clip, skip):
    """The mean over a cone's axis: how far its surface misses the hull's, in units of `clip`, squared."""
    t = skip + (1 - skip) * (np.arange(steps) + 0.5) / steps
    phi = np.array([depth(a + s * (b - a)) for s in t])
    radius = ra + t * (rb - ra)
    miss = phi + radius + np.where(phi > 0, clip, 0.0)  # outside the hull altogether
    thin = np.maximum(miss - limb_kernels.EATEN * radius, 0.0)  # what ragged masks may have eaten is forgiven
    return (np.clip(np.where(miss > 0, 2 * thin, miss), -clip, 2 * clip) ** 2).mean() / clip**2


def test_score_of_a_tube_against_numpy():
    rng = np.random.default_rng(9)
    radius = 0.06
    hull = hull_where(lambda p: np.hypot(p[:, 0] - 0.01, p[:, 1] - 0.01) - radius, [-0.3] * 3, [0.3] * 3)
    grid = (hull.sdf, hull.origin_m, VOXEL)

    def depth(point):
        return kernels.depth_at(*grid, *point)

    seen = []
    for n in range(300):
        a, b = rng.uniform(-0.25, 0.25, (2, 3)) * [0.3, 0.3, 1.0]
        ra, rb, clip, skip = rng.uniform([0.02, 0.02, 0.02, 0.0], [0.1, 0.1, 0.06, 0.5])
        steps = 4 + n % 5
        expected = tube_by_hand(depth, a, b, ra, rb, steps, clip, skip)
        score = limb_kernels.tube_score(*grid, *a, *b, ra, rb, steps, clip, skip, 1e9)
        assert score == pytest.approx(expected, rel=1e-9, abs=1e-12)
        seen.append(score)
        # whoever has lost already is not measured to the end
        for most in (0.5 * expected, 1.0001 * expected + 1e-9):
            early = limb_kernels.tube_score(*grid, *a, *b, ra, rb, steps, clip, skip, most)
            if expected > most:
                assert most < early <= score
            else:
                assert early == score
    assert min(seen) < 0.1
    assert max(seen) > 3.5


def test_a_tube_may_be_thinner_but_not_thicker_than_expected():
    hull = hull_where(lambda p: np.hypot(p[:, 0] - 0.01, p[:, 1] - 0.01) - 0.05, [-0.3] * 3, [0.3] * 3)

    def score(radius, x=0.01):
        ends = (x, 0.01, -0.2, x, 0.01, 0.2)
        return limb_kernels.tube_score(hull.sdf, hull.origin_m, VOXEL, *ends, radius, radius, 6, 0.04, 0.0, 1e9)

    assert score(0.05) == pytest.approx(0.0, abs=1e-6)
    eaten = 0.05 / (1 - limb_kernels.EATEN)  # so thick was the limb of which the masks left 5 cm
    assert score(eaten - 1e-4) == pytest.approx(0.0, abs=1e-6)
    assert score(eaten + 0.01) > 0.02
    assert score(0.03) == pytest.approx((0.02 / 0.04) ** 2, rel=1e-4)  # thin in a thick hull: something else is there
    assert score(0.05, x=0.25) == pytest.approx(4.0)  # outside: as bad as can be


@pytest.mark.parametrize("kind", [ARM, LEG], ids=["arm", "leg"])
@pytest.mark.parametrize("side", "LR")
def test_limb_candidates_contain_the_true_limb(person, kind, side):
    parts = search.UPPER_TRUNK_PARTS
    explained = search.explained_volume(person.hull, person.placed, parts)
    limbs = search.limb_candidates(person.hull, person.medial, person.placed, kind, side, explained, 40)
    middle, end = (person.placed.origins[BONE[f"{name}_{side}"]] for name in kind.bones[1:])
    assert 1 <= len(limbs.found) <= 40
    assert (np.diff(limbs.found[:, 6]) >= 0).all()
    gap = np.maximum(
        np.linalg.norm(limbs.found[:, :3] - middle, axis=1), np.linalg.norm(limbs.found[:, 3:6] - end, axis=1)
    )
    assert gap.min() < 0.06
    assert gap.argmin() < 12
    # bones keep their lengths
    upper = np.linalg.norm(limbs.found[:, :3] - limbs.base, axis=1)
    lower = np.linalg.norm(limbs.found[:, 3:6] - limbs.found[:, :3], axis=1)
    np.testing.assert_allclose(upper, limbs.lengths[0])
    np.testing.assert_allclose(lower, limbs.lengths[1])


def test_explained_volume_worked_by_hand():
    hull = hull_where(lambda p: np.full(len(p), -1.0), [-0.2] * 3, [0.2] * 3)
    grid = limb_kernels.explained_grid(
        hull.sdf, hull.origin_m, VOXEL, 2, np.zeros((1, 3), np.int64), np.array([[0.01, 0.01, 0.01]]), np.array([0.1])
    )
    assert grid.shape == (10, 10, 10)
    cells = hull.origin_m + 2 * VOXEL * np.indices(grid.shape).reshape(3, -1).T
    depth = 0.1 - np.linalg.norm(cells - 0.01, axis=1)
    np.testing.assert_allclose(grid.ravel(), np.clip(depth / 0.05, 0, 1), atol=1e-6)
    inside = limb_kernels.explained_fraction(grid, hull.origin_m, 2 * VOXEL, 0.0, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0)
    assert inside == pytest.approx(1.0)
    outside = limb_kernels.explained_fraction(grid, hull.origin_m, 2 * VOXEL, 0.5, 0.5, 0.5, 0.9, 0.5, 0.5, 0.0)
    assert outside == 0.0
