# SPDX-License-Identifier: Apache-2.0
"""What the terms of the energy mean, worked by hand; eq. 2 on balls and people."""

import dataclasses

import figure_poses
import numpy as np
import pytest
from energy_cases import BARE, NOTHING, VOXEL, a_person, entangled, only, ray_distances, size, turned_from_rest

from limbloc_ros.core import energy, figure, lm
from limbloc_ros.core._part_kernels import flesh_distance
from limbloc_ros.core.energy import Weights
from limbloc_ros.core.figure import BONE, FigureState, place
from limbloc_ros.core.hull import Hull


@pytest.fixture(scope="module")
def case():
    return a_person()


@pytest.mark.parametrize("step_m", [1e-4, 0.01, 0.2])
def test_what_is_remembered_of_the_last_figure_changes_nothing(case, step_m):
    _, evidence, state = case
    rng = np.random.default_rng(7)
    rays = rng.normal(size=evidence.points.shape)
    rays[::3] = 0.0
    rays[rays.any(axis=1)] /= np.linalg.norm(rays[rays.any(axis=1)], axis=1, keepdims=True)
    evidence = dataclasses.replace(evidence, rays=rays)
    terms = only(surface=1.0, normal_gate_m=0.1)
    for _ in range(12):
        state = state.moved(step_m * rng.normal(size=size(state)))
        fresh = dataclasses.replace(evidence)
        assert (fresh.nearest.hints == -1).all()
        known, anew = energy.system(state, evidence, terms), energy.system(state, fresh, terms)
        assert known.cost == anew.cost
        np.testing.assert_array_equal(known.matrix, anew.matrix)


def test_a_figure_that_is_nowhere_leaves_nothing_behind(case):
    """Numbers that are none, as of a step that could not be worked out, cost no number and are forgotten."""
    truth, evidence, state = case
    terms = only(surface=1.0)
    nowhere = dataclasses.replace(state, root=np.full(3, np.nan))
    known = dataclasses.replace(evidence)
    for figure_there in (state, truth):
        assert np.isnan(energy.system(nowhere, known, terms).cost)
        there, anew = (energy.system(figure_there, seen, terms) for seen in (known, dataclasses.replace(evidence)))
        assert there.cost == anew.cost
        np.testing.assert_array_equal(there.matrix, anew.matrix)


def test_the_true_figure_explains_its_own_surface(case):
    truth, evidence, state = case
    assert energy.system(truth, evidence, only(surface=1.0)).cost < 1e-12
    assert energy.system(state, evidence, only(surface=1.0)).cost > 1e-4


def surface_cost(point, normal, gate=0.0, inside=2.0, width=0.1, ray=(0.0, 0.0, 0.0), hint=-1):
    nearest = energy.NearestParts.unknown(1, 2, 2)
    nearest.hints[:] = hint
    spheres, radii = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]), np.array([0.1, 0.1])
    parts = np.array([[0, 0, 0], [1, 1, 1]])
    blocks, slopes = np.zeros((2, 12, 12)), np.zeros((2, 12))
    cost = energy.surface_term(
        np.array([point]), np.array([normal]), np.array([ray]), np.ones(1), *nearest,
        parts, spheres, radii, width, gate, inside, blocks, slopes,
    )  # fmt: skip
    return cost, slopes


def geman_mcclure(d, width=0.1):
    return d * d / (1 + d * d / width**2)


def test_surface_term_worked_by_hand():
    ahead, back = [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]
    assert surface_cost([0.13, 0.0, 0.0], ahead)[0] == pytest.approx(geman_mcclure(0.03))
    assert surface_cost([0.07, 0.0, 0.0], ahead)[0] == pytest.approx(2 * geman_mcclure(0.03))  # inside counts double
    # 14 cm from the first ball, which looks the other way, and 16 cm from the second
    cost, slopes = surface_cost([0.24, 0.0, 0.0], back)
    assert cost == pytest.approx(geman_mcclure(0.14))
    assert slopes[0].any()
    cost, slopes = surface_cost([0.24, 0.0, 0.0], back, gate=0.03)
    assert cost == pytest.approx(geman_mcclure(0.16))
    assert not slopes[0].any()
    slopes_far = slopes
    cost, slopes = surface_cost([0.24, 0.0, 0.0], ahead, gate=0.03)
    assert cost == pytest.approx(geman_mcclure(0.14))
    # whichever part is asked first
    for hint in (0, 1):
        np.testing.assert_array_equal(surface_cost([0.24, 0.0, 0.0], back, gate=0.03, hint=hint)[1], slopes_far)
    # nothing costs more than the square of the width
    assert surface_cost([90.0, 0.0, 0.0], ahead)[0] == pytest.approx(0.01, rel=1e-4)


def test_a_ball_beside_a_ray_worked_by_hand():
    """Balls of 10 cm at x = 0 and 0.5; rays along y, 13 cm off the first: 3 cm are missing, wherever the point is."""
    ahead, back, y = [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], (0.0, 1.0, 0.0)
    for far in (-4.0, 0.0, 0.2, 50.0):
        cost, slopes = surface_cost([0.13, far, 0.0], ahead, ray=y)
        assert cost == pytest.approx(geman_mcclure(0.03))
        pull = 0.03 / (1 + 0.09) ** 2
        # only across the ray: nothing pulls the ball along it
        np.testing.assert_allclose(slopes[0][:4], [-pull, 0.0, 0.0, -pull], atol=1e-12)
        assert not slopes[1].any()
        assert surface_cost([0.13, far, 0.0], ahead, ray=(0.0, -1.0, 0.0))[0] == pytest.approx(cost)
        assert surface_cost([0.07, far, 0.0], ahead, ray=y)[0] == pytest.approx(2 * geman_mcclure(0.03))
    # without the ray the point itself is asked for
    far_off = np.hypot(0.13, 0.2) - 0.1
    assert surface_cost([0.13, 0.2, 0.0], ahead)[0] == pytest.approx(geman_mcclure(far_off))
    # 14 cm from the first ball, which looks the other way, and 16 cm from the second, as without rays
    assert surface_cost([0.24, 7.0, 0.0], back, ray=y)[0] == pytest.approx(geman_mcclure(0.14))
    cost, slopes = surface_cost([0.24, 7.0, 0.0], back, gate=0.03, ray=y)
    assert cost == pytest.approx(geman_mcclure(0.16))
    assert not slopes[0].any()
    # along x both balls are one behind the other: the ray runs 4 cm beside their centres
    assert surface_cost([9.0, 0.0, 0.14], [0.0, 0.0, 1.0], ray=(1.0, 0.0, 0.0))[0] == pytest.approx(geman_mcclure(0.04))


def test_the_true_figure_explains_rays_that_touch_it(case):
    """A tangent to the skin is explained; one moved outward is not."""
    truth, evidence, _ = case
    rng = np.random.default_rng(8)
    rays = np.cross(evidence.normals, rng.normal(size=evidence.normals.shape))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    outlines = np.abs(ray_distances(evidence.points, rays, place(truth))) < 1e-9  # not through other flesh
    assert outlines.sum() > 20
    weights = outlines / outlines.sum()
    touching = dataclasses.replace(evidence, rays=rays, point_weights=weights)
    assert energy.system(truth, touching, only(surface=1.0)).cost < 1e-12
    slid = dataclasses.replace(touching, points=touching.points + 5.0 * rays)
    assert energy.system(truth, slid, only(surface=1.0)).cost < 1e-12
    lifted = dataclasses.replace(touching, points=touching.points + 0.02 * touching.normals)
    expected = geman_mcclure(0.02, Weights().surface_width_m)
    assert energy.system(truth, lifted, only(surface=1.0, normal_gate_m=0.0)).cost == pytest.approx(expected, rel=0.1)


def inclusion_cost(x, radius, slack=0.01):
    """A ball at x against the half space x < 0.5, sampled at 0, 0.1, ..., 1."""
    sdf = np.broadcast_to(np.linspace(-0.5, 0.5, 11, dtype=np.float32)[:, None, None], (11, 11, 11)).copy()
    blocks, slopes = np.zeros((1, 12, 12)), np.zeros((1, 12))
    cost = energy.kernels.inclusion_term(
        np.array([[1.0, 0.0, 0.0]]),
        np.zeros(1, np.int64),
        np.zeros((1, 3), np.int64),
        np.array([[x, 0.53, 0.57]]),
        np.array([radius]),
        sdf,
        np.zeros(3),
        0.1,
        slack,
        0.1,
        1.0,
        blocks,
        slopes,
    )
    return cost, slopes[0]


def test_inclusion_term_worked_by_hand():
    cost, slope = inclusion_cost(0.45, 0.10)
    assert cost == pytest.approx(geman_mcclure(0.04), rel=1e-5)
    pull = 0.04 / (1 + 0.16) ** 2
    np.testing.assert_allclose(slope[:4], [pull, 0.0, 0.0, pull], rtol=1e-5, atol=1e-9)
    for x, radius in ((0.45, 0.05), (0.39, 0.12), (0.05, 0.4)):
        cost, slope = inclusion_cost(x, radius)
        assert cost == 0.0
        assert not slope.any()


def bending(values, voxel=0.02):
    """What a sphere in the middle of a grid of distances adds to its own 4 x 4 block, pushed with force 1."""
    sdf, block = np.asarray(values, np.float32), np.zeros((12, 12))
    depth = energy.kernels.sample_sdf(sdf, np.zeros(3), voxel, *[3 * voxel] * 3, np.zeros(3))
    w = np.array([1.0, 0.0, 0.0])
    energy.kernels.add_bending(sdf, np.zeros(3), voxel, *[3 * voxel] * 3, depth, w, 1.0 / energy.kernels.STIFFER, block)
    assert not block[3].any()  # the radius bends nothing
    assert not block[:, 3:].any()
    return block[:3, :3]


def test_bending_of_the_distance_worked_by_hand():
    x, y, _ = np.meshgrid(*[0.02 * (np.arange(7) - 3)] * 3, indexing="ij")
    # between two walls the distance is a V: over 15 mm to both sides it rises by 15 mm each
    between = bending(np.abs(x) - 0.05)
    np.testing.assert_allclose(between, np.diag([2 * 0.015 / 0.015**2, 0.0, 0.0]), atol=1e-3)
    np.testing.assert_allclose(bending(x - 0.05), 0.0, atol=1e-3)  # one wall does not bend it
    tube = bending(np.hypot(x, y) - 0.05)
    assert tube[0, 0] > 50.0
    assert tube[1, 1] == pytest.approx(tube[0, 0])
    assert abs(tube[2, 2]) < 1e-3  # nothing holds it along the tube


def test_bending_makes_no_direction_slippery():
    rng = np.random.default_rng(0)
    for _ in range(50):
        bent = bending(0.05 * rng.normal(size=(7, 7, 7)))
        assert np.linalg.eigvalsh(bent).min() > -1e-9


def test_a_figure_thicker_than_the_hull_settles_between_its_walls(case):
    """Pushed from all sides: without the bending of the distance nearly every second step was sent back."""
    truth, evidence, _ = case
    tight = dataclasses.replace(evidence, sdf=evidence.sdf + np.float32(0.02))
    costs = []

    def evaluate(state):
        found = energy.system(state, tight, Weights(inclusion=0.02))
        costs.append(found.cost)
        return found

    lm.minimise(evaluate, lambda state, step: state.moved(step), truth, iterations=8, tolerance=0.0)
    least = np.minimum.accumulate(costs)
    assert (np.array(costs[1:]) < least[:-1]).mean() >= 0.6


def test_nothing_sticks_out_of_a_roomy_hull(case):
    truth, evidence, state = case
    inclusion = only(inclusion=1.0)
    roomy = dataclasses.replace(evidence, sdf=evidence.sdf - np.float32(0.02))
    assert energy.system(truth, roomy, inclusion).cost == 0.0
    assert energy.system(state, roomy, inclusion).cost > 0.0
    tight = dataclasses.replace(evidence, sdf=evidence.sdf + np.float32(0.02))
    assert energy.system(truth, tight, inclusion).cost > energy.system(truth, evidence, inclusion).cost


def test_every_sphere_is_asked_whether_it_sticks_out():
    corners = {
        int(figure.PART_SPHERES[p][w.argmax()])
        for w, p in zip(energy.INCLUSION_SAMPLES, energy.INCLUSION_PARTS, strict=True)
        if w.max() == 1.0
    }
    assert corners == set(range(figure.N_SPHERES))
    np.testing.assert_allclose(energy.INCLUSION_SAMPLES.sum(axis=1), 1.0)
    # no sample twice
    places = {
        tuple(sorted({int(s) for s, share in zip(figure.PART_SPHERES[p], w, strict=True) if share > 0}))
        for w, p in zip(energy.INCLUSION_SAMPLES, energy.INCLUSION_PARTS, strict=True)
    }
    assert len(places) == len(energy.INCLUSION_SAMPLES)


def test_a_hand_in_the_belly_costs_and_a_hanging_one_does_not():
    penetration = only(penetration=1.0)
    apart = {"shoulder_L_abduction": 15, "shoulder_R_abduction": 15}
    assert energy.system(figure_poses.posed(apart), BARE, penetration).cost == 0.0
    assert energy.system(entangled(), BARE, penetration).cost > 1e-3
    for sphere, part in energy.PENETRATION_PAIRS:
        assert sphere not in figure.PART_SPHERES[part]  # a sphere is always inside its own parts


# limits


def test_no_limit_reaches_half_a_turn():
    joints = np.flatnonzero(figure.DOF_BONES)  # all but the pelvis
    assert np.abs(energy.LOW[joints]).max() < np.pi
    assert np.abs(energy.HIGH[joints]).max() < np.pi
    assert (energy.LOW < energy.HIGH).all()
    assert (energy.SPREAD > 0).all()


def dof(bone, axis):
    """Index of a bone's turn about an axis."""
    rows = (figure.DOF_BONES - BONE[bone] == 0) & (figure.DOF_AXES[:, axis] > 0)
    return int(np.flatnonzero(rows)[0])


def test_limits_worked_by_hand():
    limits = only(limits=1.0)
    for d in range(figure.N_DOF):
        if figure.DOF_BONES[d] == BONE["pelvis"]:
            continue
        for end, sign in ((energy.HIGH[d], 1), (energy.LOW[d], -1)):
            for beyond in (-0.1, 0.1):
                angles = np.zeros(figure.N_DOF)
                angles[d] = end + sign * beyond
                cost = energy.system(turned_from_rest(angles), BARE, limits).cost
                assert cost == pytest.approx(0.01 if beyond > 0 else 0.0, abs=1e-9)


def test_postures_within_the_limits_cost_nothing():
    rng = np.random.default_rng(3)
    for _ in range(20):
        assert energy.system(figure_poses.random_state(rng, 0.99), BARE, only(limits=1.0)).cost == 0.0
    for degrees in (
        {},  # standing
        {"knee_L_flexion": 90, "knee_R_flexion": 90, "hip_L_flexion": 90, "hip_R_flexion": 90},  # sitting
        {"shoulder_L_abduction": 90, "shoulder_R_abduction": 90},
        {"shoulder_L_flexion": 130, "elbow_L_flexion": 140},
        {"shoulder_R_abduction": 150},
    ):
        assert energy.system(figure_poses.posed(degrees), BARE, only(limits=1.0)).cost < 1e-6, degrees
    for degrees in ({"knee_L_flexion": -20}, {"elbow_R_flexion": -20}, {"neck_rotation": 110}):
        assert energy.system(figure_poses.posed(degrees), BARE, only(limits=1.0)).cost > 0.01, degrees


def test_left_and_right_cost_the_same(case):
    rng = np.random.default_rng(4)
    mirror = np.diag([1.0, -1.0, 1.0])
    other = {"L": "R", "R": "L"}
    swap = [BONE[n[:-1] + other[n[-1]] if n[-2:] in ("_L", "_R") else n] for n in figure.BONE_NAMES]
    weights = dataclasses.replace(NOTHING, posture=1.0, limits=1.0, spine=1.0, proportions=1.0)
    for _ in range(10):
        state = figure_poses.random_state(rng, 1.4)
        seen = FigureState(mirror @ state.root, mirror @ state.rotations[swap] @ mirror, state.shape)
        here, there = (energy.system(s, BARE, weights).cost for s in (state, seen))
        assert here == pytest.approx(there, rel=1e-9)


def test_an_even_spine_costs_nothing():
    angles = np.zeros(figure.N_DOF)
    for bone in ("abdomen", "thorax", "chest"):
        angles[[dof(bone, k) for k in range(3)]] = 0.2, 0.1, -0.1
    assert energy.system(turned_from_rest(angles), BARE, only(spine=1.0)).cost == pytest.approx(0.0, abs=1e-12)
    angles[dof("thorax", 2)] = 0.0
    assert energy.system(turned_from_rest(angles), BARE, only(spine=1.0)).cost == pytest.approx(2 * 0.1**2)


def test_mean_people_have_the_likeliest_size():
    table = figure.proportions()
    state = FigureState.standing(np.zeros(3), stature=float(np.exp(table.log_stature_mean)))
    proportions = only(proportions=1.0, clothing=1.0)
    assert energy.system(state, BARE, proportions).cost == pytest.approx(0.0, abs=1e-20)
    state.shape[1:] = 1.0
    state.shape[0] += table.log_stature_std
    assert energy.system(state, BARE, proportions).cost == pytest.approx(len(state.shape))


# eq. 2


def test_xor_worked_by_hand():
    # A ball of 1.1 voxels about a voxel's centre fills it and its six neighbours.
    sdf = np.ones((5, 5, 5), np.float32)
    sdf[2, 2, 2] = sdf[3, 2, 2] = sdf[0, 0, 0] = -1.0
    one, ball = np.zeros((1, 3), np.int64), np.array([1.1])
    origin = np.array([10.0, -3.0, 0.0])
    assert energy.xor_counts(sdf, origin, 1.0, one, origin + np.array([[2.0, 2.0, 2.0]]), ball) == (1, 5, 3)
    # beyond the grid: flesh in the world outside counts, too
    assert energy.xor_counts(sdf, origin, 1.0, one, origin + np.array([[-7.0, 2.0, 9.0]]), ball) == (3, 7, 3)
    # across its border
    assert energy.xor_counts(sdf, origin, 1.0, one, origin + np.array([[0.0, 0.0, 0.0]]), ball) == (2, 6, 3)
    # spheres that overlap count once
    two = np.array([[0, 0, 0], [1, 1, 1]])
    spheres = origin + np.array([[2.0, 2.0, 2.0], [3.0, 2.0, 2.0]])
    assert energy.xor_counts(sdf, origin, 1.0, two, spheres, np.array([1.1, 1.1])) == (1, 10, 3)


@pytest.mark.parametrize("offset", [0.0, 0.5, 1.0, 2.5])
def test_xor_of_two_balls(offset):
    # volume of the lens of two unit balls: pi (2 - d)^2 (d + 4) / 12 (Weisstein, Sphere-Sphere Intersection)
    voxel, r = 0.05, 1.0
    axis = (np.arange(-30, 30) + 0.5) * voxel
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    sdf = (np.sqrt(x * x + y * y + z * z) - r).astype(np.float32)
    counts = energy.xor_counts(
        sdf, np.full(3, axis[0]), voxel, np.zeros((1, 3), np.int64), np.array([[offset, 0.0, 0.0]]), np.array([r])
    )
    lens = np.pi * max(2 - offset, 0) ** 2 * (offset + 4) / 12
    ball = 4 / 3 * np.pi
    np.testing.assert_allclose(np.array(counts) * voxel**3, [ball - lens, ball - lens, ball], atol=0.01 * ball)


def test_xor_of_people_against_numpy(case):
    truth, evidence, state = case
    hull = Hull(VOXEL, tuple(np.round(evidence.origin / VOXEL - 0.5).astype(int).tolist()), evidence.sdf, 1.0)
    np.testing.assert_allclose(hull.origin_m, evidence.origin)
    assert energy.xor_energy(hull, place(truth)) == 0.0
    index = np.stack(np.meshgrid(*map(np.arange, hull.sdf.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    d, _ = figure.flesh_distance(hull.origin_m + VOXEL * index, place(state).flesh())
    flesh = d.reshape(hull.sdf.shape) < 0
    core = (slice(1, -1),) * 3
    assert flesh[core].sum() == flesh.sum()  # no flesh beyond the grid
    inside = hull.sdf < 0
    expected = (flesh ^ inside).sum() / inside.sum()
    assert 0.1 < expected < 1.5
    assert energy.xor_energy(hull, place(state)) == expected


def test_xor_of_any_part_against_each_voxels_distance():
    # also parts of which one sphere swallows another, that stand upright or lie flat, and at whole voxels
    rng = np.random.default_rng(5)
    voxel, axis = 0.05, np.arange(-14, 15) * 0.05
    points = np.stack(np.meshgrid(axis, axis, np.arange(-40, 40) * voxel, indexing="ij"), axis=-1)
    grid = (slice(6, -2), slice(1, -6), slice(3, -4))  # flesh lies beyond the hull's grid, too
    sdf = (np.linalg.norm(points[grid] - [0.1, 0.0, 0.2], axis=-1) - 0.5).astype(np.float32)
    inside = np.zeros(points.shape[:3], np.bool_)
    inside[grid] = sdf < 0
    parts = np.array([[0, 0, 0], [0, 1, 1], [2, 3, 4]])
    for kind in range(60):
        centres, radii = rng.uniform(-0.35, 0.35, (5, 3)), rng.uniform(0.04, 0.25, 5)
        if kind % 4 == 1:
            centres[1, :2] = centres[0, :2] + rng.choice([0.0, 1e-9, 1e-4])
            centres[4, :2] = centres[3, :2]
        elif kind % 4 == 2:
            centres[:, 2] = centres[0, 2]
        elif kind % 4 == 3:
            centres, radii = np.round(centres / voxel) * voxel, np.round(radii / voxel + 0.5) * voxel
        for some in (parts, *(parts[p : p + 1] for p in range(3))):
            d, _ = flesh_distance(points.reshape(-1, 3), some, centres, radii)
            flesh = d.reshape(inside.shape) < 0
            if (np.abs(d) < 1e-9).any():  # rounding decides
                continue
            counts = energy.xor_counts(sdf, points[grid][0, 0, 0], voxel, some, centres, radii)
            assert counts == ((inside & ~flesh).sum(), (flesh & ~inside).sum(), inside.sum())


def test_no_hull_is_as_bad_as_can_be():
    hull = Hull(VOXEL, (0, 0, 0), np.ones((3, 3, 3), np.float32), 0.06)
    energy_of_nothing = energy.xor_energy(hull, place(FigureState.standing(np.zeros(3))))
    assert np.isfinite(energy_of_nothing)
    assert energy_of_nothing > 100
