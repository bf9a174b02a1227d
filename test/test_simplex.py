# SPDX-License-Identifier: Apache-2.0
"""The simplex search against functions with known minima, McKinnon's trap among them."""

from __future__ import annotations

import numpy as np
import pytest

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.core.simplex import minimise


def mckinnon(tau: float, theta: float, phi: float):
    """McKinnon 1999, eq. 1.1: convex, minimum -1/4 at (0, -1/2)."""

    def f(x):
        side = theta * phi if x[0] <= 0 else theta
        return side * abs(x[0]) ** tau + x[1] * (1 + x[1])

    return f


MCKINNON_START = np.array([[0.0, 0.0], [(1 + 33**0.5) / 8, (1 - 33**0.5) / 8], [1.0, 1.0]])


def rosenbrock(x):
    return float(np.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2))


@pytest.mark.parametrize("parameters", [(2, 6, 60), (3, 6, 400), (1, 15, 10)])
def test_plain_method_is_trapped_by_mckinnons_function_and_ours_is_not(parameters):
    options = {
        "simplex": MCKINNON_START,
        "tolerance_x": 1e-8,
        "tolerance_value": 1e-12,
        "max_evaluations": 3000,
        "max_restarts": 40,
    }
    plain = minimise(mckinnon(*parameters), [0, 0], 1.0, adaptive=False, oriented_restart=False, **options)
    assert np.abs(plain.x).max() < 1e-4, "the plain method should collapse onto the origin, which is no minimum"

    ours = minimise(mckinnon(*parameters), [0, 0], 1.0, **options)
    assert ours.value == pytest.approx(-0.25, abs=1e-4)
    assert ours.x == pytest.approx([0, -0.5], abs=1e-2)
    assert ours.restarts > 0


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_finds_the_minimum_of_a_shifted_quadratic(n):
    centre = np.linspace(-1, 2, n)
    scale = np.linspace(1, 10, n)
    result = minimise(
        lambda x: float(scale @ (x - centre) ** 2), np.zeros(n), 0.5, tolerance_value=1e-10, max_evaluations=8000
    )
    assert result.x == pytest.approx(centre, abs=2e-3)
    assert result.value == pytest.approx(0, abs=1e-5)
    assert result.stop == "converged"


def test_finds_rosenbrocks_valley():
    result = minimise(
        rosenbrock, [-1.2, 1, -1.2, 1], 0.5, tolerance_x=1e-6, tolerance_value=1e-12, max_evaluations=5000
    )
    assert result.x == pytest.approx(np.ones(4), abs=1e-3)


def test_adaptive_coefficients_go_further_in_many_dimensions():
    """Gao and Han's own finding, on their quadratic with 24 parameters and the same budget."""
    start = np.full(24, 1.0)
    options = {"oriented_restart": False, "tolerance_x": 1e-9, "tolerance_value": 1e-14, "max_evaluations": 6000}

    def f(x):
        return float(x @ x + 0.2 * (x[:-1] @ x[1:]))

    assert minimise(f, start, 0.05, **options).value < 0.1 * minimise(f, start, 0.05, adaptive=False, **options).value


def test_stays_within_bounds_and_finds_the_constrained_minimum():
    seen = []

    def f(x):
        seen.append(x.copy())
        return float((x[0] - 2) ** 2 + (x[1] + 3) ** 2)

    result = minimise(f, [0.5, 0.5], 0.3, lower=[0, 0], upper=[1, 1])
    assert result.x == pytest.approx([1, 0], abs=1e-3)
    assert np.min(seen) >= 0 and np.max(seen) <= 1


def test_budget_is_kept_and_named():
    result = minimise(rosenbrock, [-1.2, 1], 0.5, max_evaluations=30)
    assert result.stop == "max_evaluations"
    assert 30 <= result.evaluations <= 33


def test_counts_are_the_calls_made():
    calls = 0

    def f(x):
        nonlocal calls
        calls += 1
        return float(x @ x)

    assert minimise(f, [1.0, 2.0, 3.0], 0.5).evaluations == calls


def test_nan_is_infinitely_bad():
    result = minimise(lambda x: float("nan") if x[0] < 0 else float((x[0] - 0.1) ** 2 + x[1] ** 2), [1.0, 1.0], 0.7)
    assert result.x == pytest.approx([0.1, 0], abs=2e-3)


def test_a_staircase_like_a_voxel_count_does_not_trap_it():
    """XOR energies are constant over small steps."""
    result = minimise(lambda x: float(np.floor(40 * np.abs(x - 0.3)).sum()), [1.0, -1.0, 0.6], 0.4, tolerance_value=0.5)
    assert np.abs(result.x - 0.3).max() < 0.05


def test_same_input_same_result():
    a, b = (minimise(rosenbrock, [-1.2, 1, 0.3], 0.5) for _ in range(2))
    assert a.x.tobytes() == b.x.tobytes() and a.evaluations == b.evaluations


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"start": [], "step": 1.0}, "start must be"),
        ({"start": [np.nan], "step": 1.0}, "start must be"),
        ({"start": [0.0, 0.0], "step": [1.0, 0.0]}, "step must be"),
        ({"start": [0.0, 0.0], "step": [1.0]}, "step must be one number or have start's shape"),
        ({"start": [0.0], "step": 1.0, "lower": 1.0, "upper": 1.0}, "lower must be below upper"),
        ({"start": [0.0], "step": 1.0, "simplex": np.zeros((3, 1))}, "simplex must have shape"),
    ],
)
def test_bad_arguments_are_named(kwargs, message):
    with pytest.raises(ConfigError, match=message):
        minimise(lambda x: 0.0, **kwargs)
