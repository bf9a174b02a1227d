# SPDX-License-Identifier: Apache-2.0
"""Improved Nelder-Mead simplex search (paper section 2.5); it knows nothing of bodies.

The paper refines with "an improved version of the simplex algorithm described by Nelder and Mead" and cites McKinnon
(1999), who shows that the plain method can collapse onto a point that is no minimum. Two remedies:

- coefficients that adapt to the dimension (F. Gao, L. Han, "Implementing the Nelder-Mead simplex algorithm with
  adaptive parameters", Comput. Optim. Appl. 51, 2012): plain ones stop improving beyond some ten parameters;
- oriented restart (C. T. Kelley, "Detection and remediation of stagnation in the Nelder-Mead algorithm using a
  sufficient decrease condition", SIAM J. Optim. 10, 1999): when the mean value over the simplex falls by less than
  its own gradient promises, the simplex has gone flat; it is replaced by a small right-angled one around the best
  vertex whose edges point downhill.

The search is written in plain Python: an iteration costs about 20 us besides the objective.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from limbloc_ros.core.errors import ConfigError

Array = NDArray[np.float64]
StopReason = Literal["converged", "stagnated", "max_evaluations"]

#: Kelley's sufficient decrease: the mean must fall by at least this times the squared simplex gradient.
SUFFICIENT_DECREASE = 1e-4


@dataclass(frozen=True)
class SimplexResult:
    """Where a search ended, and why.

    Attributes:
        x: [n] the best point.
        value: the objective there.
        evaluations: how often the objective was called.
        iterations: steps of the simplex.
        restarts: oriented restarts among them.
        stop: `converged`: the simplex shrank below the tolerances, and a fresh one around its best vertex found
            nothing lower; `stagnated`: it went flat again and again and the restarts are used up;
            `max_evaluations`: the budget is spent.
    """

    x: Array
    value: float
    evaluations: int
    iterations: int
    restarts: int
    stop: StopReason


def minimise(
    objective: Callable[[Array], float],
    start: ArrayLike,
    step: ArrayLike,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    tolerance_x: float = 1e-3,
    tolerance_value: float = 1e-6,
    max_evaluations: int = 2000,
    max_restarts: int = 5,
    adaptive: bool = True,
    oriented_restart: bool = True,
    simplex: ArrayLike | None = None,
) -> SimplexResult:
    """Minimise `objective` without derivatives.

    Args:
        objective: takes [n] (not to be kept or changed), returns the value; NaN counts as infinitely bad.
        start: [n] first vertex, finite, within the bounds.
        step: [n] or one number, not zero: edges of the first simplex along each axis, in the parameter's own unit.
        lower, upper: [n] or one number; trial points are clipped to them. None: unbounded.
        tolerance_x: converged when no vertex is further than this times `step` from the best one, on each axis ...
        tolerance_value: ... and no value is further than this from the best one.
        max_evaluations: the budget of objective calls.
        max_restarts: how many oriented restarts may be made.
        adaptive: Gao and Han's coefficients; False gives the original ones.
        oriented_restart: False gives the plain method, for comparison.
        simplex: [n + 1, n] a first simplex instead of the one from `start` and `step`.

    Raises:
        ConfigError: shapes that do not fit, a zero step, bounds that cross or a start that is not finite.
    """
    x0, edge, low, high = _validated(start, step, lower, upper)
    n = len(x0)
    evaluations = 0

    def evaluate(x: Array) -> float:
        nonlocal evaluations
        evaluations += 1
        value = float(objective(x))
        return value if value == value else np.inf

    if simplex is None:
        vertices = _right_angled(x0, edge, low, high)
    else:
        vertices = np.clip(np.array(simplex, dtype=np.float64), low, high)
        if vertices.shape != (n + 1, n):
            raise ConfigError(f"simplex must have shape {(n + 1, n)}, got {vertices.shape}")
    values = np.array([evaluate(v) for v in vertices])
    vertices, values = _sorted(vertices, values)

    reflect, expand, contract, shrink = _coefficients(n if adaptive else 2)
    iterations = restarts = 0
    since_check, checked_mean = 0, float(values.mean())
    restart_value = np.inf  # best value when the simplex last shrank to nothing and was made anew
    stop: StopReason = "max_evaluations"

    while evaluations < max_evaluations:
        if values[-1] - values[0] <= tolerance_value and bool(
            (np.abs(vertices[1:] - vertices[0]) <= tolerance_x * np.abs(edge)).all()
        ):
            if not oriented_restart or restarts >= max_restarts or restart_value - values[0] <= tolerance_value:
                stop = "converged"
                break
            # Shrunk to a point: believe it only if a fresh simplex of a useful size agrees.
            restart_value = float(values[0])
            restarts += 1
            size = np.abs(edge) * 0.5**restarts
            vertices, values = _restart(vertices, values, size, low, high, evaluate)
            since_check, checked_mean = 0, float(values.mean())
            continue

        iterations += 1
        since_check += 1
        vertices, values = _step(vertices, values, (reflect, expand, contract, shrink), low, high, evaluate)

        if oriented_restart and since_check >= n:
            mean = float(values.mean())
            edges = vertices[1:] - vertices[0]
            gradient = _simplex_gradient(edges / np.abs(edge), values)
            promised = SUFFICIENT_DECREASE * float(gradient @ gradient)
            lengths = np.abs(edges / edge).max(axis=1)
            flat = checked_mean - mean < promised * float(lengths.min()) or not np.isfinite(promised)
            since_check, checked_mean = 0, mean
            if flat and float(lengths.max()) > tolerance_x:
                if restarts >= max_restarts:
                    stop = "stagnated"
                    break
                restarts += 1
                size = 0.5 * np.abs(edge) * max(float(lengths.min()), tolerance_x)
                vertices, values = _restart(vertices, values, size, low, high, evaluate)
                checked_mean = float(values.mean())

    return SimplexResult(vertices[0].copy(), float(values[0]), evaluations, iterations, restarts, stop)


def _coefficients(n: int) -> tuple[float, float, float, float]:
    """Reflection, expansion, contraction, shrinkage for n parameters; n = 2 gives Nelder and Mead's own."""
    n = max(n, 2)
    return 1.0, 1.0 + 2.0 / n, 0.75 - 0.5 / n, 1.0 - 1.0 / n


def _step(
    vertices: Array,
    values: Array,
    coefficients: tuple[float, float, float, float],
    low: Array,
    high: Array,
    evaluate: Callable[[Array], float],
) -> tuple[Array, Array]:
    """One iteration on a simplex sorted by value; returns it sorted."""
    reflect, expand, contract, shrink = coefficients
    worst = vertices[-1]
    centroid = vertices[:-1].mean(axis=0)
    away = centroid - worst
    x = np.minimum(np.maximum(centroid + reflect * away, low), high)
    value = evaluate(x)
    if value < values[0]:
        further = np.minimum(np.maximum(centroid + reflect * expand * away, low), high)
        further_value = evaluate(further)
        if further_value < value:
            x, value = further, further_value
    elif value >= values[-2]:
        if value < values[-1]:  # outside contraction
            bound = value
            x = np.minimum(np.maximum(centroid + reflect * contract * away, low), high)
            value = evaluate(x)
            accepted = value <= bound
        else:
            x = centroid - contract * away
            value = evaluate(x)
            accepted = value < values[-1]
        if not accepted:
            vertices = vertices[0] + shrink * (vertices - vertices[0])
            values = np.array([values[0], *(evaluate(v) for v in vertices[1:])])
            return _sorted(vertices, values)
    # Insert in order instead of sorting everything anew; equal values keep the older vertex in front.
    at = int(np.searchsorted(values[:-1], value, side="right"))
    values[at + 1 :] = values[at:-1].copy()
    vertices[at + 1 :] = vertices[at:-1].copy()
    values[at], vertices[at] = value, x
    return vertices, values


def _restart(
    vertices: Array, values: Array, size: Array, low: Array, high: Array, evaluate: Callable[[Array], float]
) -> tuple[Array, Array]:
    """Kelley's oriented restart: a right-angled simplex around the best vertex, its edges pointing downhill."""
    gradient = _simplex_gradient(vertices[1:] - vertices[0], values)
    uphill = np.where(np.isfinite(gradient) & (gradient != 0), np.sign(gradient), 1.0)
    fresh = _right_angled(vertices[0], -uphill * size, low, high)
    return _sorted(fresh, np.array([values[0], *(evaluate(v) for v in fresh[1:])]))


def _simplex_gradient(edges: Array, values: Array) -> Array:
    """[n] gradient of the linear function through the simplex; least squares where it is degenerate."""
    rise = values[1:] - values[0]
    if not np.isfinite(rise).all():
        return np.full(len(rise), np.nan)
    try:
        return np.asarray(np.linalg.solve(edges, rise))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(edges, rise, rcond=None)[0])


def _right_angled(x0: Array, edge: Array, low: Array, high: Array) -> Array:
    """[n + 1, n] vertices x0 and x0 + edge_i e_i; an edge that would leave the bounds is turned round."""
    vertices = np.tile(x0, (len(x0) + 1, 1))
    tip = x0 + edge
    tip = np.where((tip < low) | (tip > high), x0 - edge, tip)
    np.fill_diagonal(vertices[1:], np.clip(tip, low, high))
    return vertices


def _sorted(vertices: Array, values: Array) -> tuple[Array, Array]:
    order = np.argsort(values, kind="stable")
    return vertices[order], values[order]


def _validated(
    start: ArrayLike, step: ArrayLike, lower: ArrayLike | None, upper: ArrayLike | None
) -> tuple[Array, Array, Array, Array]:
    x0 = np.array(start, dtype=np.float64)
    if x0.ndim != 1 or x0.size == 0 or not np.isfinite(x0).all():
        raise ConfigError(f"start must be a vector of finite numbers, got shape {x0.shape}: {x0}")
    rows = []
    for name, value, default in (("step", step, None), ("lower", lower, -np.inf), ("upper", upper, np.inf)):
        row = np.asarray(default if value is None else value, dtype=np.float64)
        if row.shape not in ((), x0.shape):
            raise ConfigError(f"{name} must be one number or have start's shape {x0.shape}, got {row.shape}")
        rows.append(np.broadcast_to(row, x0.shape).copy())
    edge, low, high = rows
    if not np.isfinite(edge).all() or (edge == 0).any():
        raise ConfigError(f"step must be finite and nowhere zero, got {edge}")
    if (low >= high).any():
        raise ConfigError(f"lower must be below upper everywhere, got {low} and {high}")
    return np.clip(x0, low, high), edge, low, high
