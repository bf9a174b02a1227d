# SPDX-License-Identifier: Apache-2.0
"""The searches' mechanics, on hulls made of the figure's own flesh, and their kernels against brute force.

Such hulls say nothing of real people (see test_engine_robust.py); they say whether a search finds what is there.
"""

import itertools
import math

import figure_poses
import numpy as np
import pytest
from flesh_hulls import POSTURES, VOXEL, hull_where, person_in

from limbloc_ros.core import _part_kernels as part_kernels
from limbloc_ros.core import figure, search
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
    sdf = rng.normal(size=(4, 5, 6)).astype(np.float32)
    points = origin + voxel * rng.uniform(-2.0, 7.0, (kernels.CHUNK, 3))
    work, cells, corners = kernels.chunk_scratch()
    work[: points.size] = points.T.ravel()
    kernels.depths_at(sdf, origin, voxel, work, cells, corners)
    one_by_one = [kernels.depth_at(sdf, origin, voxel, *point) for point in points]
    assert work[points.size : points.size + kernels.CHUNK].tolist() == pytest.approx(one_by_one, abs=1e-12)


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


def test_points_near_another():
    points = np.random.default_rng(16).normal(size=(500, 4))
    base = np.array([0.3, 0.1, -0.2])
    expected = points[np.linalg.norm(points[:, :3] - base, axis=1) < 1.1]
    assert 50 < len(expected) < 450
    np.testing.assert_array_equal(kernels.points_near(points, base, 1.1), expected)


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
    assert min(gaps) < 0.07  # left and right where they belong: the better facing
    best = place(found[0][0]).origins[bones[:3]]
    off = np.linalg.norm(best - person.placed.origins[bones[:3]], axis=1)
    assert (off < [0.15, 0.06, 0.04]).all()  # a torso that is too short hangs from the head
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


def torso_score(grid, points, radii, clip):
    """How badly spheres [S, 3] of a torso match the hull: 0 perfect, 1 a complete miss."""
    table = search._torso_table()
    phi = np.array([kernels.depth_at(*grid, *point) for point in points])
    off = phi + radii
    solid = np.where(off > 0, 1.5 * off, off)
    missed = np.where(np.arange(len(points)) < table.n_solid, solid, np.maximum(0.0, radii - phi))
    return np.average(np.clip(missed, -clip, clip) ** 2, weights=table.weights) / clip**2


def torsos_one_by_one(person, pelvis, skull, headings):
    """All torsos [N, 14] between seeds, each placed and scored by itself."""
    hull, table = person.hull, search._torso_table()
    grid = (hull.sdf, hull.origin_m, hull.voxel_m)
    exp = figure.kernels.exp_so3
    rows = []
    for a, b in itertools.product(pelvis[:, :3], skull[:, :3]):
        chord = [kernels.depth_at(*grid, *(a + t * (b - a))) for t in (0.3, 0.5, 0.7)]
        length = np.linalg.norm(b - a)
        if not 0.3 <= length <= 0.95 or max(chord) > 0.03:
            continue
        v = (b - a) / length
        for bend, base, tip in zip(table.bends, table.axis_base, table.axis_tip, strict=True):
            u = (tip - base) / np.linalg.norm(tip - base)
            stature = length / np.linalg.norm(tip - base)
            axis = np.cross(u, v)
            align = exp(axis / np.linalg.norm(axis) * np.arctan2(np.linalg.norm(axis), u @ v))
            for y in range(headings if 1.0 <= stature <= 2.15 else 0):
                R = exp(v * math.pi * y / headings) @ align
                pose = np.concatenate(
                    [a - stature * R @ base, figure.kernels.log_so3(R), bend, np.zeros(3), [np.log(stature)]]
                )
                spheres = search.torso_kernels.place_torso(pose, *table.arrays)
                score = torso_score(grid, *spheres, 0.04 * stature)
                rows.append([*pose, score])
    return np.array(rows)


def test_torsos_between_seeds_against_one_by_one(person):
    hull, table, points = person.hull, search._torso_table(), person.medial.points
    depth = np.argsort(-points[:, 3], kind="stable")
    pelvis = points[kernels.spread_out(points, depth, 0.15, 7)]
    skull = points[kernels.spread_out(points, depth, 0.11, 11)]
    expected = torsos_one_by_one(person, pelvis, skull, 5)
    expected = expected[np.argsort(expected[:, 13])]
    assert len(expected) > 4 * kernels.CHUNK
    for most in (20, 150, len(expected) + 5):  # some queues end full, some begun
        found = search.torso_kernels.torso_from_pairs(
            pelvis, skull, table.axis_base, table.axis_tip, table.bends, 5, 0.3, 0.95,
            hull.sdf, hull.origin_m, hull.voxel_m, table.arrays, table.weights, table.n_solid, most,
        )  # fmt: skip
        found = found[np.argsort(found[:, 13])]
        np.testing.assert_allclose(found[:, 13], expected[:most, 13], atol=1e-6)
        assert len(found) == min(most, len(expected))
        for row in found:  # wherever equals stand
            same = expected[np.abs(expected[:, 13] - row[13]) < 1e-6]
            assert np.abs(same - row).max(axis=1).min() < 1e-6


def random_torsos(count):
    rng = np.random.default_rng(17)
    spread = np.array([0.3] * 3 + [0.8] * 3 + [0.4] * 6 + [0.1, 0.0])
    return rng.normal(size=(count, 14)) * spread + np.array([0.0] * 12 + [0.5, 9.0])


def test_a_placed_torso_against_the_figure():
    """The torso of the mean figure, which is placed bone by bone with all its turns."""
    table = search._torso_table()
    parents = table.arrays[0]
    exp = figure.kernels.exp_so3
    for pose in random_torsos(20):
        third, head, rest = exp(pose[6:9] / 3), exp(pose[9:12]), np.eye(3)
        turns = np.array([exp(pose[3:6]), third, third, third, head] + [rest] * (len(parents) - 5))
        expected = figure.kernels.forward(pose[:3], turns, pose[12:13], *table.arrays)[2:]
        for here, there in zip(search.torso_kernels.place_torso(pose, *table.arrays), expected, strict=True):
            np.testing.assert_allclose(here, there, atol=1e-12)


def test_climbing_torsos_against_all_steps_in_full(person):
    hull, table, torso_kernels = person.hull, search._torso_table(), search.torso_kernels
    grid = (hull.sdf, hull.origin_m, hull.voxel_m)
    spread = np.array([0.02] * 3 + [0.15] * 9 + [0.04])
    better = 0
    for n, start in enumerate(random_torsos(4)):
        start[:3] = person.placed.origins[0] + 0.1 * start[:3]
        noise = np.random.default_rng(n).normal(size=(60, 13))
        best = start
        for step, draw in enumerate(noise):
            active = [range(13), range(6), (6, 7, 8, 12), (3, 4, 5, 9, 10, 11)][step % 4]
            trial = best.copy()
            trial[list(active)] += (draw * spread * (1 - 0.8 * step / 60))[list(active)]
            spheres = torso_kernels.place_torso(trial, *table.arrays)
            clip = 0.04 * np.exp(trial[12])
            trial[13] = torso_score(grid, *spheres, clip)
            bend, turn = (trial[6:9] ** 2).sum(), (trial[9:12] ** 2).sum()
            trial[13] += 0.01 * (bend + turn) + 0.3 * (max(0.0, bend - 1.2) + max(0.0, turn - 0.8))
            if trial[13] < best[13]:
                best, better = trial, better + 1
        found = torso_kernels.climb_torso(start, noise, *grid, table.arrays, table.weights, table.n_solid, spread)
        np.testing.assert_allclose(found, best, atol=1e-9)
    assert 8 < better < 200


def test_different_torsos_against_numpy():
    rng = np.random.default_rng(15)
    poses = rng.normal(size=(300, 14)) * ([0.06] * 3 + [0.4] * 11)
    turns = np.array([figure.kernels.exp_so3(pose[3:6]) for pose in poses])
    turns[::3, :, :2] *= -1.0  # which way it looks does not matter
    poses[::3, 3:6] = [figure.kernels.log_so3(R) for R in turns[::3]]
    kept = []
    for n, (pose, R) in enumerate(zip(poses, turns, strict=True)):
        near = np.linalg.norm(poses[kept, :3] - pose[:3], axis=1) < 0.1
        side, axis = (np.einsum("nij,ij->nj", turns[kept], R).T)[1:]
        if not (near & (axis > np.cos(0.4)) & (np.abs(side) > np.cos(0.4))).any():
            kept.append(n)
    assert 40 < len(kept) < 280
    for most in (1, 40, 300):
        assert search.torso_kernels.distinct(poses, most, 0.1, 0.4).tolist() == kept[:most]


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
    eaten = np.clip(miss, 0.0, limb_kernels.EATEN * radius)  # by ragged masks, which is all but forgiven
    rest = np.clip(np.where(miss > 0, 2 * (miss - eaten), miss), -clip, 2 * clip)
    return (rest**2 + limb_kernels.EATEN_WEIGHT * eaten**2).mean() / clip**2


def tube_scores(grid, start, ends, ra, rb, steps, clip, skip):
    """What `score_tubes` says of cones from one point to several."""
    ways = np.zeros((7, len(ends) + kernels.CHUNK))
    ways[3:6, : len(ends)] = np.transpose(ends)
    scratch = kernels.chunk_scratch()
    limb_kernels.score_tubes(*grid, np.array(start), ra, rb, steps, clip, skip, ways, len(ends), scratch)
    return ways[6, : len(ends)]


def test_score_of_a_tube_against_numpy():
    rng = np.random.default_rng(9)
    radius = 0.06
    hull = hull_where(lambda p: np.hypot(p[:, 0] - 0.01, p[:, 1] - 0.01) - radius, [-0.3] * 3, [0.3] * 3)
    grid = (hull.sdf, hull.origin_m, VOXEL)

    def depth(point):
        return kernels.depth_at(*grid, *point)

    seen = []
    for n in range(60):
        count = 1 + 7 * n
        start, ends = rng.uniform(-0.25, 0.25, 3), rng.uniform(-0.25, 0.25, (count, 3)) * [0.3, 0.3, 1.0]
        ra, rb, clip, skip = rng.uniform([0.02, 0.02, 0.02, 0.0], [0.1, 0.1, 0.06, 0.5])
        steps = 4 + n % 5
        expected = [tube_by_hand(depth, start, end, ra, rb, steps, clip, skip) for end in ends]
        scores = tube_scores(grid, start, ends, ra, rb, steps, clip, skip)
        np.testing.assert_allclose(scores, expected, rtol=1e-9, atol=1e-12)
        seen += expected
    assert min(seen) < 0.1
    assert max(seen) > 3.5


def test_a_tube_may_be_thinner_but_not_thicker_than_expected():
    hull = hull_where(lambda p: np.hypot(p[:, 0] - 0.01, p[:, 1] - 0.01) - 0.05, [-0.3] * 3, [0.3] * 3)

    def score(radius, x=0.01):
        grid = (hull.sdf, hull.origin_m, VOXEL)
        return tube_scores(grid, (x, 0.01, -0.2), [(x, 0.01, 0.2)], radius, radius, 6, 0.04, 0.0)[0]

    assert score(0.05) == pytest.approx(0.0, abs=1e-6)
    eaten = 0.05 / (1 - limb_kernels.EATEN)  # so thick was the limb of which the masks left 5 cm
    little = limb_kernels.EATEN_WEIGHT * ((eaten - 0.05) / 0.04) ** 2
    assert score(eaten) == pytest.approx(little, rel=1e-4)
    assert 0.0 < score(0.052) < score(0.06) < score(eaten)  # of limbs that fit, that which fits best
    assert score(eaten + 0.01) > little + 0.02
    assert score(0.03) == pytest.approx((0.02 / 0.04) ** 2, rel=1e-4)  # thin in a thick hull: something else is there
    assert score(0.05, x=0.25) > 4.0  # outside: as bad as can be


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
    ways = np.zeros((7, kernels.CHUNK))
    ways[3:6, :2] = np.array([[0.02, 0.0, 0.0], [0.9, 0.0, 0.0]]).T
    ways[6] = 0.5
    cells = np.zeros(3 * kernels.CHUNK, np.int32)
    limb_kernels.add_explained(grid, hull.origin_m, 2 * VOXEL, np.zeros(3), 0.0, 2.0, ways, 2, cells)
    assert ways[6, 0] == pytest.approx(0.5 + 2.0)
    assert ways[6, 1] == pytest.approx(0.5)  # from 11 cm on: where nothing is explained, and beyond the grid


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_explained_volume_against_the_distance_to_all_parts(person, stride):
    hull, (spheres, radii) = person.hull, (person.placed.spheres, person.placed.radii)
    parts = figure.PART_SPHERES[::2]
    assert {len(set(part)) for part in parts.tolist()} >= {2, 3}
    args = (hull.origin_m, hull.voxel_m, stride, parts, spheres, radii)
    grid = limb_kernels.explained_grid(hull.sdf, *args)
    assert grid.dtype == np.float32
    sparse = hull.sdf[::stride, ::stride, ::stride]
    cells = hull.origin_m + stride * VOXEL * np.indices(sparse.shape).reshape(3, -1).T
    depth = -part_kernels.flesh_distance(cells, parts, spheres, radii)[0].reshape(sparse.shape)
    expected = np.where(sparse <= 0.02, np.clip(depth / 0.05, 0.0, 1.0), 0.0)
    assert (expected == 1.0).any()
    np.testing.assert_allclose(grid, expected, atol=1e-6)
    beyond = limb_kernels.explained_grid(hull.sdf, hull.origin_m + 9.0, *args[1:])
    assert not beyond.any()
    assert not limb_kernels.explained_grid(hull.sdf, hull.origin_m - 9.0, *args[1:]).any()
    assert not limb_kernels.explained_grid(np.full_like(hull.sdf, 0.5), *args).any()


def test_ways_from_a_point_against_numpy():
    rng = np.random.default_rng(12)
    for count in (0, 1, 63, 64, 65, 300):
        points, uniform = rng.uniform(-1, 1, (count, 3)), sphere_directions(70)
        start, cone = rng.uniform(-0.1, 0.1, 3), np.append(uniform[5], 0.6)
        away = points - start
        far = np.linalg.norm(away, axis=1)
        near = away[(far >= 0.85 * 0.7) & (far <= 1.15 * 0.7)]
        expected = np.vstack([near / np.linalg.norm(near, axis=1, keepdims=True), uniform])
        expected = expected[expected @ cone[:3] <= cone[3]]
        ways, work = np.zeros((7, 500)), kernels.chunk_scratch()[0]
        found = limb_kernels.ways_from(
            start, 0.7, cone, np.ascontiguousarray(points.T), np.ascontiguousarray(uniform.T), ways, work
        )
        assert found == len(expected)
        np.testing.assert_allclose(ways[:3, :found].T, expected, atol=1e-12)
        np.testing.assert_allclose(ways[3:6, :found].T, start + 0.7 * expected, atol=1e-12)


def test_rows_leave_a_heap_in_order_of_their_scores():
    rng = np.random.default_rng(13)
    scores = rng.integers(0, 40, 200) / 8  # many are equal: the first comes first
    heap, order = np.zeros(200, np.int64), rng.permutation(200)
    for count, row in enumerate(order):
        kernels.push(heap, count, scores, row)
    left = [kernels.pop(heap, count, scores) for count in range(200, 0, -1)]
    assert left == np.argsort(scores, kind="stable").tolist()


@pytest.mark.parametrize("equal", ["no", "two", "all"])
def test_limbs_against_a_search_without_short_cuts(person, equal):
    """All middles with all their ends, sorted by score (equals as they come); those are taken that lie apart."""
    hull, placed = person.hull, person.placed
    grid = (hull.sdf, hull.origin_m, hull.voxel_m)
    explained = search.explained_volume(hull, placed, search.UPPER_TRUNK_PARTS)
    if equal == "all":  # the same hull wherever a bone goes
        grid, explained = (np.full_like(hull.sdf, -0.03), *grid[1:]), np.zeros_like(explained)
    base, lengths, radii = placed.origins[BONE["thigh_L"]], np.array([0.4, 0.38]), np.array([0.07, 0.05, 0.04])
    near, uniform = person.medial.points[::7][:200], sphere_directions(60)
    forbidden, skip, tip, clip, weight, keep = np.array([0.0, 0.0, 1.0, 0.6]), 0.3, 0.05, 0.04, 1.5, 40
    if equal == "two":  # two ends of one score
        near = np.repeat(near, 2, axis=0)
    points, directions = (np.ascontiguousarray(a.T) for a in (near[:, :3], uniform))

    def bones(start, length, ra, rb, cone, hidden):
        ways, scratch = np.zeros((7, 1000)), kernels.chunk_scratch()
        count = limb_kernels.ways_from(start, length, cone, points, directions, ways, scratch[0])
        limb_kernels.score_tubes(*grid, start, ra, rb, 6, clip, hidden[0], ways, count, scratch)
        ways = np.ascontiguousarray(ways[:, :count][:, ways[6, :count] <= 3.2])
        out = np.zeros((7, 1000))
        out[:, : ways.shape[1]] = ways
        args = (explained, hull.origin_m, search.STRIDE * hull.voxel_m, start, hidden[1], weight)
        limb_kernels.add_explained(*args, out, ways.shape[1], scratch[1])
        return out[:, : ways.shape[1]].T

    middles = bones(base, lengths[0], radii[0], radii[1], forbidden, (skip, 0.4))[:, 3:]
    first = kernels.spread_out(middles, np.argsort(middles[:, 3], kind="stable"), 0.12 * lengths[0], 24)
    rows = []
    for middle in middles[first]:
        back = np.append(-(middle[:3] - base) / lengths[0], 0.87)
        for way in bones(middle[:3], lengths[1], radii[1], radii[2], back, (0.0, 0.0)):
            phi = kernels.depth_at(*grid, *(way[3:6] + 0.5 * tip * way[:3]))
            rows.append([*middle[:3], *way[3:6], middle[3] + (way[6] + 0.3 * np.clip(phi / clip, 0.0, 1.0))])
    rows = sorted(rows, key=lambda row: row[6])
    kept = []
    for row in np.array(rows):
        gaps = [np.linalg.norm((row - other)[:6].reshape(2, 3), axis=1).max() for other in kept]
        if min(gaps, default=1.0) >= 0.22 * lengths[0]:
            kept.append(row)
    found = limb_kernels.search_limb(
        base, lengths, radii, tip, near, uniform, *grid, explained, search.STRIDE, skip, clip, weight, forbidden, keep
    )
    assert 10 < len(found) == min(len(kept), keep)
    np.testing.assert_allclose(found, kept[:keep], atol=1e-9)
    assert (np.ptp(found[:, 6]) == 0.0) == (equal == "all")
