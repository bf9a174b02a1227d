# SPDX-License-Identifier: Apache-2.0
"""The energy: every term's gradient against finite differences, and eq. 2 on balls."""

import dataclasses

import figure_poses
import numpy as np
import pytest

from limbloc_ros.core import energy, figure
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.figure import BONE, FigureState, place
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import Flesh

NOTHING = Weights(
    surface=0.0, inclusion=0.0, penetration=0.0, posture=0.0, limits=0.0, spine=0.0, proportions=0.0, clothing=0.0
)
VOXEL = 0.02


def only(**weights):
    return dataclasses.replace(NOTHING, **weights)


def flesh_grid(state, margin_m=0.3):
    """The signed distance of a person's own flesh on a lattice: float32 grid and its origin."""
    placed = place(state)
    low = np.floor((placed.spheres.min(axis=0) - margin_m) / VOXEL).astype(int)
    high = np.ceil((placed.spheres.max(axis=0) + margin_m) / VOXEL).astype(int)
    index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), axis=-1)
    centres = (index + 0.5) * VOXEL
    d, _ = figure.flesh_distance(centres.reshape(-1, 3), placed.flesh())
    return d.reshape(index.shape[:3]).astype(np.float32), (low + 0.5) * VOXEL


def surface_points(state, count, rng):
    """Points on a person's skin and their normals."""
    placed = place(state)
    flesh = placed.flesh()
    direction = rng.normal(size=(20 * count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    s = rng.integers(0, figure.N_SPHERES, len(direction))
    points = placed.spheres[s] + placed.radii[s, None] * direction
    outer = np.abs(figure.flesh_distance(points, flesh)[0]) < 1e-9
    return points[outer][:count], direction[outer][:count]


def evidence_of(state, rng, count=200):
    points, normals = surface_points(state, count, rng)
    weights = rng.uniform(0.5, 1.5, len(points))
    sdf, origin = flesh_grid(state)
    return Evidence(points, normals, np.zeros_like(points), weights / weights.sum(), sdf, origin, VOXEL)


def size(state):
    return 3 + figure.N_DOF + len(state.shape)


def ray_distances(points, rays, placed):
    """Signed distance [Q] of rays (points where they are zero) to the flesh: that of circles, seen along the ray."""
    out = np.empty(len(points))
    for q, (point, ray) in enumerate(zip(points, rays, strict=True)):
        flat = placed.spheres - np.outer((placed.spheres - point) @ ray, ray)
        flesh = Flesh(flat, placed.radii, figure.PART_SPHERES, figure.PART_NAMES)
        out[q] = figure.flesh_distance(point[None], flesh)[0][0]
    return out


@pytest.fixture(scope="module")
def case():
    """A person's evidence, and the same person a little off."""
    rng = np.random.default_rng(0)
    truth = figure_poses.random_state(rng, 0.5)
    step = 0.1 * rng.normal(size=size(truth))
    step[:3] *= 0.3
    step[3 + figure.N_DOF] *= 0.3
    return truth, evidence_of(truth, rng), truth.moved(step)


@pytest.fixture(scope="module")
def seen(case):
    """The same case, but three of four points are asked for along some ray only that touches the skin there."""
    truth, evidence, state = case
    rays = np.cross(evidence.normals, np.random.default_rng(5).normal(size=evidence.points.shape))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays[::4] = 0.0
    assert rays.any(axis=1).sum() > 100
    return truth, dataclasses.replace(evidence, rays=rays), state


def finite_difference(state, evidence, weights, h=1e-6):
    """The cost's derivative, by central differences of `moved`."""
    unit = np.eye(size(state))
    return np.array(
        [
            energy.system(state.moved(h * e), evidence, weights).cost
            - energy.system(state.moved(-h * e), evidence, weights).cost
            for e in unit
        ]
    ) / (2 * h)


# derivatives

TERMS = {
    "surface": only(surface=1.0, normal_gate_m=0.0),
    "gated surface": only(surface=1.0),
    "inclusion": only(inclusion=1.0),
    "penetration": only(penetration=1.0),
    "proportions": only(proportions=1.0),
}


@pytest.mark.parametrize("name", TERMS)
def test_gradient_of_a_term(case, name):
    _, evidence, state = case
    if name == "penetration":
        state = entangled()
    system = energy.system(state, evidence, TERMS[name])
    assert system.cost > 0
    numeric = finite_difference(state, evidence, TERMS[name])
    np.testing.assert_allclose(2 * system.gradient, numeric, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("name", ["surface", "gated surface"])
def test_gradient_of_the_surface_term_along_rays(seen, case, name):
    _, evidence, state = seen
    system = energy.system(state, evidence, TERMS[name])
    assert system.cost > 0
    assert system.cost != pytest.approx(energy.system(state, case[1], TERMS[name]).cost, rel=0.01)
    numeric = finite_difference(state, evidence, TERMS[name])
    np.testing.assert_allclose(2 * system.gradient, numeric, atol=1e-6 * np.abs(numeric).max())


def entangled():
    """Someone whose arms and legs run through each other."""
    rng = np.random.default_rng(1)
    people = [figure_poses.random_state(rng) for _ in range(30)]
    return max(people, key=lambda state: energy.system(state, BARE, TERMS["penetration"]).cost)


AIR = np.ones((3, 3, 3), np.float32)
BARE = Evidence(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), AIR, np.zeros(3), VOXEL)


@pytest.mark.parametrize("name", ["posture", "limits"])
def test_gradient_of_a_posture_term_by_each_joint_alone(name):
    # Exact when a bone turns about one axis only: then the turns do not mix.
    rng = np.random.default_rng(2)
    weights = only(**{name: 1.0})
    axis = {}
    for d in rng.permutation(figure.N_DOF):
        axis.setdefault(int(figure.DOF_BONES[d]), int(d))
    angles = np.zeros(figure.N_DOF)
    alone = [d for bone, d in axis.items() if bone != BONE["pelvis"]]
    angles[alone] = energy.HIGH[alone] + 0.1
    state = turned_from_rest(angles)
    numeric = finite_difference(state, BARE, weights)[[3 + d for d in alone]]
    gradient = 2 * energy.system(state, BARE, weights).gradient[[3 + d for d in alone]]
    assert np.abs(numeric).min() > 0
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5)


@pytest.mark.parametrize("name", ["posture", "limits", "spine"])
def test_gradient_of_a_posture_term_points_uphill(name):
    # About several axes at once it leaves out how turns of one bone mix, yet a step against it must lower the cost.
    rng = np.random.default_rng(2)
    weights = only(**{name: 1.0})
    for _ in range(10):
        state = figure_poses.random_state(rng, 1.3)
        numeric = finite_difference(state, BARE, weights)
        gradient = 2 * energy.system(state, BARE, weights).gradient
        assert gradient @ numeric > 0.4 * np.linalg.norm(gradient) * np.linalg.norm(numeric)


def test_clothes_add_to_a_body_and_do_not_take_away():
    first = figure.proportions().clothing_from
    state = FigureState.standing(np.zeros(3), stature=1.7)
    for amount, expected in ((0.5, 0.25), (2.0, 4.0), (-2.0, 25.0 * 4.0)):
        state.shape[first] = amount
        found = energy.system(state, BARE, only(clothing=1.0))
        assert found.cost == pytest.approx(expected)
        at = 3 + figure.N_DOF + first
        assert 2.0 * found.gradient[at] == pytest.approx(finite_difference(state, BARE, only(clothing=1.0))[at])
        assert energy.system(state, BARE, only(proportions=1.0)).cost == pytest.approx(
            energy.system(FigureState.standing(np.zeros(3), stature=1.7), BARE, only(proportions=1.0)).cost
        )


def test_gradient_of_everything_but_posture(case):
    _, evidence, state = case
    weights = dataclasses.replace(Weights(), posture=0.0, limits=0.0, spine=0.0)
    numeric = finite_difference(state, evidence, weights)
    gradient = 2 * energy.system(state, evidence, weights).gradient
    np.testing.assert_allclose(gradient, numeric, atol=1e-6 * np.abs(numeric).max())


def test_matrix_is_symmetric_and_positive(case):
    _, evidence, state = case
    for weights in (*TERMS.values(), Weights()):
        matrix = energy.system(state, evidence, weights).matrix
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.abs(matrix).max())
        assert np.linalg.eigvalsh(matrix).min() >= -1e-9 * np.abs(matrix).max()


@pytest.mark.parametrize("along", ["points", "rays"])
def test_matrix_of_the_surface_term_against_its_residuals(case, seen, along):
    _, evidence, state = case if along == "points" else seen
    wide = only(surface=1.0, normal_gate_m=0.0, surface_width_m=1e6, surface_inside=3.0)  # in effect no robustness

    def residuals(step):
        return ray_distances(evidence.points, evidence.rays, place(state.moved(step)))

    h = 1e-6
    J = np.stack([(residuals(h * e) - residuals(-h * e)) / (2 * h) for e in np.eye(size(state))], axis=1)
    d = residuals(np.zeros(size(state)))
    weight = evidence.point_weights * np.where(d < 0, 3.0, 1.0)
    system = energy.system(state, evidence, wide)
    assert (d < 0).any()
    assert system.cost == pytest.approx((weight * d * d).sum(), rel=1e-6)
    matrix = J.T @ (weight[:, None] * J)
    np.testing.assert_allclose(system.matrix, matrix, atol=1e-6 * np.abs(matrix).max())
    np.testing.assert_allclose(system.gradient, J.T @ (weight * d), atol=1e-6 * np.abs(J.T @ (weight * d)).max())


def test_blocks_are_gathered_as_a_dense_product():
    """Some parts without evidence, spheres that repeat within a part, parameters that move no part."""
    rng = np.random.default_rng(6)
    spheres, parameters = 9, 14
    parts = np.array([[0, 1, 2], [3, 4, 4], [5, 5, 5], [6, 7, 8], [2, 3, 6]])
    J = rng.normal(size=(spheres, 4, parameters)) * (rng.random((spheres, 1, parameters)) < 0.4)
    J[:, :, [0, 5, 13]] = 0.0
    J[2, :, 7] = [0.0, 0.0, 0.0, 0.3]  # only its radius changes
    half = rng.normal(size=(len(parts), 12, 12))
    full = half @ half.transpose(0, 2, 1)
    full[3] = 0.0
    slopes = rng.normal(size=(len(parts), 12)) * full.any(axis=(1, 2))[:, None]
    dense, gradient = np.zeros((parameters, parameters)), np.zeros(parameters)
    for part, block, slope in zip(parts, full, slopes, strict=True):
        rows = J[part].reshape(12, parameters)
        dense += rows.T @ block @ rows
        gradient += rows.T @ slope
    A, g = np.zeros((parameters, parameters)), np.zeros(parameters)
    below = np.kron(np.tri(3, k=-1), np.ones((4, 4))) == 1.0  # which the terms leave out
    energy.kernels.gather(np.where(below[None], 0.0, full), slopes, parts, J, A, g)
    np.testing.assert_allclose(A, dense, atol=1e-12 * np.abs(dense).max())
    np.testing.assert_allclose(g, gradient, atol=1e-12 * np.abs(gradient).max())
    assert np.abs(dense).max() > 1
    np.testing.assert_array_equal(A, A.T)


# what the terms mean


def test_the_true_figure_explains_its_own_surface(case):
    truth, evidence, state = case
    assert energy.system(truth, evidence, only(surface=1.0)).cost < 1e-12
    assert energy.system(state, evidence, only(surface=1.0)).cost > 1e-4


def surface_cost(point, normal, gate=0.0, inside=2.0, width=0.1, ray=(0.0, 0.0, 0.0), hint=-1):
    hints = np.array([hint])
    spheres, radii = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]), np.array([0.1, 0.1])
    parts = np.array([[0, 0, 0], [1, 1, 1]])
    blocks, slopes = np.zeros((2, 12, 12)), np.zeros((2, 12))
    cost = energy.surface_term(
        np.array([point]), np.array([normal]), np.array([ray]), np.ones(1), hints,
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


def turned_from_rest(angles):
    state = FigureState(np.zeros(3), energy.REST_ROTATIONS, FigureState.standing(np.zeros(3)).shape)
    return state.moved(np.concatenate([np.zeros(3), angles, np.zeros(len(state.shape))]))


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
    assert energy.kernels.xor_counts(sdf, origin, 1.0, one, origin + np.array([[2.0, 2.0, 2.0]]), ball) == (1, 5, 3)
    # beyond the grid: flesh in the world outside counts, too
    assert energy.kernels.xor_counts(sdf, origin, 1.0, one, origin + np.array([[-7.0, 2.0, 9.0]]), ball) == (3, 7, 3)
    # across its border
    assert energy.kernels.xor_counts(sdf, origin, 1.0, one, origin + np.array([[0.0, 0.0, 0.0]]), ball) == (2, 6, 3)
    # spheres that overlap count once
    two = np.array([[0, 0, 0], [1, 1, 1]])
    spheres = origin + np.array([[2.0, 2.0, 2.0], [3.0, 2.0, 2.0]])
    assert energy.kernels.xor_counts(sdf, origin, 1.0, two, spheres, np.array([1.1, 1.1])) == (1, 10, 3)


@pytest.mark.parametrize("offset", [0.0, 0.5, 1.0, 2.5])
def test_xor_of_two_balls(offset):
    # volume of the lens of two unit balls: pi (2 - d)^2 (d + 4) / 12 (Weisstein, Sphere-Sphere Intersection)
    voxel, r = 0.05, 1.0
    axis = (np.arange(-30, 30) + 0.5) * voxel
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    sdf = (np.sqrt(x * x + y * y + z * z) - r).astype(np.float32)
    counts = energy.kernels.xor_counts(
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


def test_no_hull_is_as_bad_as_can_be():
    hull = Hull(VOXEL, (0, 0, 0), np.ones((3, 3, 3), np.float32), 0.06)
    energy_of_nothing = energy.xor_energy(hull, place(FigureState.standing(np.zeros(3))))
    assert np.isfinite(energy_of_nothing)
    assert energy_of_nothing > 100
