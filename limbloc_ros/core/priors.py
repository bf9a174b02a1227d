# SPDX-License-Identifier: Apache-2.0
"""What earlier frames say of the next one, as terms beside the energy: a person's size, and where joints should be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import figure
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.lm import System

Array = NDArray[np.float64]


class Prior(Protocol):
    """A term of a figure's state alone."""

    def added_to(self, system: System, state: FigureState) -> System:
        """The energy's system at a state, with this term."""
        ...


@dataclass(frozen=True)
class KnownSize:
    """The size that earlier frames agreed on.

    Attributes:
        shape: as in FigureState.
        weight: what a deviation of one standard deviation between people costs, m^2.
    """

    shape: Array
    weight: float

    def cost(self, shape: Array) -> float:
        """What a shape costs, m^2."""
        deviation = shape - self.shape
        return self.weight * float(deviation @ (_per_person() * deviation))

    def added_to(self, system: System, state: FigureState) -> System:
        """See Prior."""
        gradient, matrix = system.gradient.copy(), system.matrix.copy()
        rows = np.arange(len(gradient) - len(state.shape), len(gradient))
        weights = self.weight * _per_person()
        gradient[rows] += weights * (state.shape - self.shape)
        matrix[rows, rows] += weights
        return System(system.cost + self.cost(state.shape), gradient, matrix)


@cache
def _per_person() -> Array:
    """[1 + K] one over the variance of each component of a shape between people."""
    table = figure.proportions()
    scale = np.ones(table.n_shape)  # of modes and clothes, which are counted in standard deviations
    scale[0] = table.log_stature_std**-2
    return scale


@dataclass(frozen=True)
class Inertia:
    """Joints go on as they moved; robust, for people start and stop.

    Attributes:
        joints: [25, 3] where they should be, m.
        weight: what a joint's squared distance from there (m^2) counts, as a mean over the joints.
        width_m: distances beyond this say that somebody moves otherwise, and count little (Geman-McClure).
    """

    joints: Array
    weight: float
    width_m: float

    def added_to(self, system: System, state: FigureState) -> System:
        """See Prior. The size's derivatives are left out: nobody shrinks to keep a hand in its place."""
        off = figure.place(state).joints - self.joints
        squared, width2 = (off**2).sum(axis=1), self.width_m**2
        cost = self.weight * float((width2 * squared / (width2 + squared)).mean())
        J = figure.place_jacobian(state)[figure.N_SPHERES :, :3].reshape(off.size, -1)
        J[:, 3 + figure.N_DOF :] = 0.0
        believed = np.repeat(self.weight / len(off) * (width2 / (width2 + squared)) ** 2, 3)
        weighted = J.T * believed
        return System(system.cost + cost, system.gradient + weighted @ off.ravel(), system.matrix + weighted @ J)
