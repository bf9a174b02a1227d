# SPDX-License-Identifier: Apache-2.0
"""The searches' mechanics, on hulls made of the figure's own flesh, and their kernels against brute force.

Such hulls say nothing of real people (see test_engine_robust.py); they say whether a search finds what is there.
"""

import math
from types import SimpleNamespace

import figure_poses
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limbloc_ros.core import figure, search
from limbloc_ros.core.figure import BONE, FigureState, place
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.search import ARM, LEG, Limbs, Medial, kernels, limb_kernels

VOXEL, BAND = 0.02, 0.06


def hull_where(inside_m, low, high):
    """The hull of a signed distance function between two corners."""
    a, b = np.floor(np.array(low) / VOXEL).astype(int), np.ceil(np.array(high) / VOXEL).astype(int)
    index = np.stack(np.meshgrid(*(np.arange(*ab) for ab in zip(a, b, strict=True)), indexing="ij"), axis=-1)
    d = inside_m((index.reshape(-1, 3) + 0.5) * VOXEL).reshape(index.shape[:3])
    return Hull(VOXEL, tuple(a.tolist()), np.minimum(d, BAND).astype(np.float32), BAND)


def flesh_hull(state):
    """The hull that ideal cameras would carve of a figure."""
    placed = place(state)
    flesh = placed.flesh()
    low, high = placed.spheres.min(axis=0) - 0.16, placed.spheres.max(axis=0) + 0.16
    return hull_where(lambda points: figure.flesh_distance(points, flesh)[0], low, high)


POSTURES = {
    "arms out": {"shoulder_L_abduction": 70, "shoulder_R_abduction": 70, "hip_L_abduction": 12, "hip_R_abduction": 12},
    "striding": {
        "shoulder_L_flexion": 60,
        "elbow_L_flexion": 60,
        "shoulder_R_abduction": 40,
        "elbow_R_flexion": 30,
        "hip_L_flexion": 35,
        "knee_L_flexion": 40,
        "hip_R_flexion": -15,
    },
}


@pytest.fixture(scope="module", params=POSTURES)
def person(request):
    """A posed figure somewhere in the room, its hull and the hull's medial axis."""
    posed = figure_poses.posed(POSTURES[request.param])
    turn = Rotation.from_euler("z", 50, degrees=True).as_matrix()
    rotations = posed.rotations.copy()
    rotations[0] = turn @ rotations[0]
    state = FigureState(np.array([0.4, -0.7, 1.0]), rotations, posed.shape)
    hull = flesh_hull(state)
    return SimpleNamespace(state=state, placed=place(state), hull=hull, medial=Medial.of(hull))


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


def bits_of(flags):
    padded = np.zeros(-(-len(flags) // 64) * 64, np.uint8)
    padded[: len(flags)] = flags
    return np.packbits(padded, bitorder="little").view(np.uint64)


def test_popcount():
    rng = np.random.default_rng(2)
    values = [0, 1, 2**63, 2**64 - 1, 0x5555555555555555, *rng.integers(0, 2**63, 50).tolist()]
    # within best_pairs: one pair, nothing taken
    left = np.array([[0.0, 0, 0, 0, 0, 0, 0]])
    for value in values:
        bits = np.array([[value]], np.uint64)
        pairs = limb_kernels.best_pairs(left, left + 9, bits, bits, np.zeros(1, np.uint64), 64, 0.0, 0.1, 1)
        assert pairs[0, 2] == pytest.approx(1 - value.bit_count() / 64)


def test_best_pairs_by_brute_force():
    rng = np.random.default_rng(3)
    left, right = rng.uniform(0, 1, (7, 7)), rng.uniform(0, 1, (9, 7))
    right[:3] = left[:3] + 0.01  # pairs that explain one limb twice
    flags = [rng.random((n, 150)) < 0.2 for n in (7, 9)]
    taken = rng.random(150) < 0.3
    trade, apart = 0.05, 0.2
    expected = []
    for a in range(7):
        for b in range(9):
            cost = 1 - (flags[0][a] | flags[1][b] | taken).mean() + trade * (left[a, 6] + right[b, 6])
            for part in (slice(0, 3), slice(3, 6)):
                gap = np.linalg.norm(left[a, part] - right[b, part])
                cost += 0.05 * (1 - gap / apart) if gap < apart else 0.0
            expected.append((cost, a, b))
    expected.sort()
    bits = [np.array([bits_of(row) for row in f]) for f in flags]
    pairs = limb_kernels.best_pairs(left, right, *bits, bits_of(taken), 150, trade, apart, 10)
    assert len(pairs) == 10
    for (a, b, cost), (best, i, j) in zip(pairs, expected, strict=False):
        assert (a, b) == (i, j)
        assert cost == pytest.approx(best, abs=1e-12)


def test_samples_near_a_limb_by_brute_force():
    rng = np.random.default_rng(4)
    limb = np.array([0.3, 0.0, 0.0, 0.3, 0.3, 0.0, 0.1])
    base, radii, tip = np.zeros(3), np.array([0.06, 0.05, 0.03]), 0.1
    samples = rng.uniform([-0.1, -0.1, -0.1], [0.4, 0.5, 0.1], (200, 3))
    chain = np.array([base, limb[:3], limb[3:6], [0.3, 0.3 + tip, 0.0]])
    thick = np.array([0.06, 0.05, 0.03, 0.03])
    near = np.zeros(200, bool)
    for s in range(3):
        along = chain[s + 1] - chain[s]
        t = np.clip((samples - chain[s]) @ along / (along @ along), 0, 1)
        off = np.linalg.norm(samples - chain[s] - t[:, None] * along, axis=1)
        near |= off < thick[s] + t * (thick[s + 1] - thick[s]) + 0.02
    bits = limb_kernels.covered_by_limb(limb, base, radii, tip, samples, 0.02)
    assert bits.dtype == np.uint64
    assert len(bits) == 4
    assert 10 < near.sum() < 150
    np.testing.assert_array_equal(bits, bits_of(near))


def test_directions_cover_the_sphere_evenly():
    directions = search.sphere_directions(100)
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


@pytest.mark.parametrize("kind", [ARM, LEG], ids=["arm", "leg"])
def test_a_limb_is_turned_to_its_candidate(person, kind):
    rng = np.random.default_rng(7)
    for side in "LR":
        first, second, third = (BONE[f"{name}_{side}"] for name in kind.bones)
        base = person.placed.origins[first]
        lengths = [
            np.linalg.norm(person.placed.origins[b] - person.placed.origins[a])
            for a, b in ((first, second), (second, third))
        ]
        for _ in range(10):
            upper, lower = rng.normal(size=(2, 3))
            middle = base + lengths[0] * upper / np.linalg.norm(upper)
            end = middle + lengths[1] * lower / np.linalg.norm(lower)
            turned = search.with_limb(person.state, person.placed, kind, side, np.concatenate([middle, end, [0.0]]))
            placed = place(turned)
            np.testing.assert_allclose(placed.origins[second], middle, atol=0.012)
            np.testing.assert_allclose(placed.origins[third], end, atol=0.025)
            R = turned.rotations
            np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9)
            others = [b for b in range(figure.N_BONES) if b not in (first, second, third)]
            np.testing.assert_array_equal(R[others], person.state.rotations[others])


def test_pairs_explain_the_surface_together(person):
    """Of all legs, the true pair is among the best: it covers both legs' surface, not one of them twice."""
    explained = search.explained_volume(person.hull, person.placed, search.UPPER_TRUNK_PARTS)
    legs = [search.limb_candidates(person.hull, person.medial, person.placed, LEG, s, explained, 40) for s in "LR"]
    samples = person.placed.spheres[
        [i for i, n in enumerate(figure.SPHERE_NAMES) if n[:-2] in ("calf", "knee", "ankle")]
    ]
    pairs = search.limb_pairs(*legs, samples, np.zeros(len(samples), bool), 0.02, 3)
    assert [cost for *_, cost in pairs] == sorted(cost for *_, cost in pairs)
    a, b, _ = pairs[0]
    for limb, row, side in ((legs[0], a, "L"), (legs[1], b, "R")):
        foot = person.placed.origins[BONE[f"foot_{side}"]]
        assert np.linalg.norm(limb.found[row, 3:6] - foot) < 0.15


def test_no_candidates_no_pairs():
    nothing = Limbs(np.zeros(3), np.ones(2), np.ones(3), 0.1, np.empty((0, 7)))
    some = Limbs(np.zeros(3), np.ones(2), np.ones(3), 0.1, np.ones((1, 7)))
    samples, explained = np.zeros((4, 3)), np.zeros(4, bool)
    assert search.limb_pairs(nothing, some, samples, explained, 0.02, 1) == []
    assert search.limb_pairs(some, nothing, samples, explained, 0.02, 1) == []


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
