# SPDX-License-Identifier: Apache-2.0
"""The minimiser on problems whose answers are known."""

from itertools import pairwise

import numpy as np
import pytest

from limbloc_ros.core._lm_kernels import damped_step
from limbloc_ros.core.figure import kernels
from limbloc_ros.core.lm import System, minimise


def added(x, step):
    return x + step


def least_squares(residuals, jacobian):
    """The system of a sum of squares."""

    def evaluate(x):
        r, J = residuals(x), jacobian(x)
        return System(float(r @ r), J.T @ r, J.T @ J)

    return evaluate


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def rosenbrock_jacobian(x):
    return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


@pytest.mark.parametrize("size", [1, 2, 7, 81])
def test_the_damped_step_against_lapack(size):
    rng = np.random.default_rng(size)
    rows = rng.normal(size=(size // 2 + 1, size)) * np.exp(3 * rng.normal(size=size))  # of half the rank
    matrix, gradient = rows.T @ rows, rng.normal(size=len(rows)) @ rows
    for damping in (1e-4, 1e-2, 10.0):
        diagonal = np.maximum(matrix.diagonal(), 1e-6 * matrix.diagonal().max())
        expected = -np.linalg.solve(matrix + damping * np.diag(diagonal), gradient)
        scale = np.sqrt(diagonal)  # parameters have units of their own
        np.testing.assert_allclose(
            damped_step(matrix, gradient, damping) * scale, expected * scale, rtol=1e-6, atol=1e-9
        )
    assert not damped_step(np.zeros((size, size)), np.zeros(size), 1e-2).any()


@pytest.mark.parametrize("start", [(-1.2, 1.0), (0.0, 0.0), (3.0, -4.0)])
def test_rosenbrock(start):
    evaluate = least_squares(rosenbrock, rosenbrock_jacobian)
    result = minimise(evaluate, added, np.array(start), iterations=200, tolerance=1e-12)
    np.testing.assert_allclose(result.state, [1.0, 1.0], atol=1e-6)
    assert result.system.cost < 1e-12
    assert result.iterations < 60


def test_linear_least_squares_is_solved_in_one_step():
    rng = np.random.default_rng(1)
    M, y = rng.normal(size=(30, 5)), rng.normal(size=30)
    evaluate = least_squares(lambda x: M @ x - y, lambda x: M)
    result = minimise(evaluate, added, np.zeros(5), iterations=1, damping=0.0)
    best, squares, _, _ = np.linalg.lstsq(M, y, rcond=None)
    np.testing.assert_allclose(result.state, best, atol=1e-12)
    assert result.system.cost == pytest.approx(squares[0])
    assert result.stop == "iterations"


def test_every_evaluation_is_counted_and_none_is_wasted():
    calls = []
    system = least_squares(rosenbrock, rosenbrock_jacobian)

    def evaluate(x):
        calls.append(x)
        return system(x)

    result = minimise(evaluate, added, np.array([-1.2, 1.0]), iterations=7, tolerance=0.0)
    assert result.stop == "iterations"
    assert len(calls) == 1 + result.iterations == 8


def test_the_cost_never_rises_and_the_best_state_is_returned():
    accepted = []
    system = least_squares(rosenbrock, rosenbrock_jacobian)
    for iterations in range(25):
        accepted.append(minimise(system, added, np.array([-1.2, 1.0]), iterations=iterations, tolerance=0.0))
    costs = [result.system.cost for result in accepted]
    assert all(after <= before for before, after in pairwise(costs))
    for result in accepted:
        assert system(result.state).cost == result.system.cost
    assert accepted[0].iterations == 0


def test_converged_when_the_cost_falls_by_less_than_the_tolerance():
    # (x - 3)^2 + 1: the first step ends within the damping of the minimum, the second gains almost nothing.
    evaluate = least_squares(lambda x: np.array([x[0] - 3.0, 1.0]), lambda x: np.array([[1.0], [0.0]]))
    result = minimise(evaluate, added, np.zeros(1), tolerance=1e-3)
    assert result.stop == "converged"
    assert result.iterations == 2
    np.testing.assert_allclose(result.state, [3.0], atol=1e-3)


def test_stuck_at_a_minimum():
    evaluate = least_squares(lambda x: np.array([x[0], 1.0]), lambda x: np.array([[1.0], [0.0]]))
    result = minimise(evaluate, added, np.zeros(1), iterations=100)
    assert result.stop == "stuck"
    assert result.iterations < 20
    assert result.state[0] == 0.0


def test_stuck_when_the_gradient_points_uphill():
    result = minimise(lambda x: System(float(1.0 + x @ x), -x, np.eye(2)), added, np.array([1.0, 2.0]), iterations=100)
    assert result.stop == "stuck"
    np.testing.assert_array_equal(result.state, [1.0, 2.0])


def test_a_trial_without_a_number_is_not_taken():
    # The cost is the log's only where it exists; too long a step leaves its domain.
    def evaluate(x):
        if x[0] <= 0.0:
            return System(float("nan"), np.full(1, np.nan), np.full((1, 1), np.nan))
        r, slope = np.log(x[0]), 1.0 / x[0]
        return System(float(r * r), np.array([r * slope]), np.array([[slope * slope]]))

    result = minimise(evaluate, added, np.array([8.0]), iterations=60, tolerance=1e-12)
    np.testing.assert_allclose(result.state, [1.0], atol=1e-5)


def test_the_longest_step_shortens_the_whole_step():
    evaluate = least_squares(lambda x: x - np.array([10.0, 5.0]), lambda x: np.eye(2))
    result = minimise(evaluate, added, np.zeros(2), iterations=1, damping=0.0, largest_step=np.array([2.0, 4.0]))
    np.testing.assert_allclose(result.state, [2.0, 1.0])  # the direction stays


def test_a_parameter_without_influence_stays():
    evaluate = least_squares(lambda x: np.array([x[0] - 1.0]), lambda x: np.array([[1.0, 0.0]]))
    result = minimise(evaluate, added, np.array([0.0, 7.0]), tolerance=1e-12)
    np.testing.assert_allclose(result.state, [1.0, 7.0], atol=1e-6)


def geman_mcclure(x, points, width):
    """Robust mean of numbers: cost, half its derivative, Gauss-Newton matrix."""
    u = ((x[0] - points) / width) ** 2
    weight = 1 / (1 + u) ** 2
    cost = float((width**2 * u / (1 + u)).sum())
    return System(cost, np.array([(weight * (x[0] - points)).sum()]), np.array([[weight.sum()]]))


def test_robust_cost_ignores_outliers():
    points = np.concatenate([np.linspace(-0.1, 0.1, 11) + 2.0, [50.0, 80.0, -60.0]])
    result = minimise(lambda x: geman_mcclure(x, points, 0.5), added, np.array([2.6]), iterations=50, tolerance=1e-12)
    assert abs(result.state[0] - 2.0) < 0.01
    assert abs(points.mean() - 2.0) > 3


def test_rotation_fit_on_the_manifold():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(20, 3))
    truth = kernels.exp_so3(np.array([1.9, -1.2, 0.8]))
    seen = points @ truth.T

    def evaluate(R):
        r = (points @ R.T - seen).ravel()
        # d(R exp(w) p) / dw = -R [p]x
        J = np.concatenate([-R @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) for x, y, z in points])
        return System(float(r @ r), J.T @ r, J.T @ J)

    result = minimise(evaluate, lambda R, w: R @ kernels.exp_so3(w), np.eye(3), iterations=50, tolerance=1e-12)
    np.testing.assert_allclose(result.state, truth, atol=1e-7)
    np.testing.assert_allclose(result.state @ result.state.T, np.eye(3), atol=1e-12)
