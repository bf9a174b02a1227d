# SPDX-License-Identifier: Apache-2.0
"""The energy's derivatives: every term's gradient against finite differences, and how its matrix is gathered."""

import dataclasses

import figure_poses
import numpy as np
import pytest
from energy_cases import BARE, a_person, a_person_and_rays, entangled, only, ray_distances, size, turned_from_rest

from limbloc_ros.core import energy, figure
from limbloc_ros.core.energy import Weights
from limbloc_ros.core.figure import BONE, FigureState, place


@pytest.fixture(scope="module")
def case():
    return a_person()


@pytest.fixture(scope="module")
def seen():
    return a_person_and_rays()


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
    without_rays = energy.system(state, case[1], TERMS[name])
    assert np.linalg.norm(system.gradient - without_rays.gradient) > 0.1 * np.linalg.norm(system.gradient)
    numeric = finite_difference(state, evidence, TERMS[name])
    np.testing.assert_allclose(2 * system.gradient, numeric, atol=1e-6 * np.abs(numeric).max())


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

    h = 1e-5  # smaller steps drown in the distances' rounding, larger ones bend
    J = np.stack([(residuals(h * e) - residuals(-h * e)) / (2 * h) for e in np.eye(size(state))], axis=1)
    d = residuals(np.zeros(size(state)))
    weight = evidence.point_weights * np.where(d < 0, 3.0, 1.0)
    system = energy.system(state, evidence, wide)
    assert (d < 0).any()
    assert system.cost == pytest.approx((weight * d * d).sum(), rel=1e-6)
    matrix = J.T @ (weight[:, None] * J)
    # (along rays triangles become slivers, whose distances are good to some nanometres only)
    close = 2e-6 if along == "points" else 2e-5
    np.testing.assert_allclose(system.matrix, matrix, atol=close * np.abs(matrix).max())
    np.testing.assert_allclose(system.gradient, J.T @ (weight * d), atol=close * np.abs(J.T @ (weight * d)).max())


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
