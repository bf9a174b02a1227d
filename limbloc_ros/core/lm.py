# SPDX-License-Identifier: Apache-2.0
"""A damped Gauss-Newton (Levenberg-Marquardt) minimiser on any manifold; it knows nothing of bodies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core._lm_kernels import damped_step

Array = NDArray[np.float64]
State = TypeVar("State")


@dataclass(frozen=True)
class System:
    """The local quadratic model of a cost: cost + 2 gradient.x + x.matrix.x for a small step x.

    Attributes:
        cost: the cost itself.
        gradient: [P] half the derivative.
        matrix: [P, P] Gauss-Newton matrix, symmetric and positive semi-definite.
    """

    cost: float
    gradient: Array
    matrix: Array

    def __add__(self, other: System) -> System:
        """Of the sum of two costs."""
        return System(self.cost + other.cost, self.gradient + other.gradient, self.matrix + other.matrix)


@dataclass(frozen=True)
class LmResult(Generic[State]):
    """What a minimisation found.

    Attributes:
        state: the best state.
        system: cost, gradient and matrix there.
        iterations: steps tried.
        stop: `converged` (the cost no longer falls by `tolerance`), `stuck` (no step falls) or `iterations`.
    """

    state: State
    system: System
    iterations: int
    stop: str


def minimise(
    evaluate: Callable[[State], System],
    retract: Callable[[State, Array], State],
    start: State,
    *,
    iterations: int = 20,
    tolerance: float = 1e-3,
    damping: float = 1e-2,
    largest_step: Array | None = None,
    known: System | None = None,
) -> LmResult[State]:
    """Minimise a sum of (robust) squares.

    Every trial is evaluated once, with its matrix, which the next iteration then uses.

    Args:
        evaluate: the system at a state.
        retract: the state after a step [P].
        start: where to begin.
        iterations: most steps to try.
        tolerance: stop when an accepted step lowers the cost by less than this fraction.
        damping: first weight of Marquardt's diagonal.
        largest_step: [P] no component may exceed it; the step is shortened as a whole.
        known: the system at `start`, if it has been evaluated.
    """
    state, system = start, evaluate(start) if known is None else known
    stop = "iterations"
    count = 0
    while count < iterations:
        count += 1
        step = np.asarray(damped_step(system.matrix, system.gradient, damping), np.float64)
        if largest_step is not None:
            step /= max(1.0, float((np.abs(step) / largest_step).max()))
        trial_state = retract(state, step)
        trial = evaluate(trial_state)
        if trial.cost < system.cost:
            fell = system.cost - trial.cost
            state, before, system = trial_state, system.cost, trial
            damping = max(damping * 0.3, 1e-6)
            if fell < tolerance * before:
                stop = "converged"
                break
        else:
            damping *= 5.0
            if damping > 1e5:
                stop = "stuck"
                break
    return LmResult(state, system, count, stop)
