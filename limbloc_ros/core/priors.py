# SPDX-License-Identifier: Apache-2.0
"""What earlier frames say of the next one, as terms beside the energy: a person's size, and where joints should be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import figure
from limbloc_ros.core.figure import BONE, FigureState
from limbloc_ros.core.lm import System

Array = NDArray[np.float64]

_N_POSE = 3 + figure.N_DOF

#: Arms and legs: by where these bones point, postures are told apart.
_POINTERS = tuple(
    np.array([BONE[f"{bone}_{side}"] for bone in bones for side in "LR"])
    for bones in (("upper_arm", "forearm"), ("thigh", "shin"))
)


class Prior(Protocol):
    """A term of a figure's state alone."""

    def system(self, state: FigureState) -> System:
        """Its cost, gradient and matrix at a state, as those of the energy."""
        ...


@dataclass(frozen=True)
class KnownSize:
    """A person's size as far as it is known.

    Attributes:
        shape: [1 + K] the likeliest one, as in FigureState.
        information: [1 + K, 1 + K] what a deviation from it costs: deviation @ information @ deviation, m^2.
    """

    shape: Array
    information: Array

    def cost(self, shape: Array) -> float:
        """What a shape costs, m^2."""
        deviation = shape - self.shape
        return float(deviation @ self.information @ deviation)

    def system(self, state: FigureState) -> System:
        """See Prior."""
        n = _N_POSE + len(self.shape)
        gradient, matrix = np.zeros(n), np.zeros((n, n))
        gradient[_N_POSE:] = self.information @ (state.shape - self.shape)
        matrix[_N_POSE:, _N_POSE:] = self.information
        return System(self.cost(state.shape), gradient, matrix)


@dataclass(frozen=True)
class SizeMemory:
    """What the frames so far say of a person's size.

    One hull shows some sizes badly (of an arm that hangs straight, where its elbow is), another posture shows them
    well. So it is no mean of shapes that is remembered, but how each frame's energy rises when the shape changes and
    the posture follows: a quadratic of the shape alone, and of these the mean. Where that is least, one figure explains
    all frames at once.

    How people differ (constraint 1) is in every frame's energy, though it is known only once. In frames of one posture
    that is as it should be: figure and hull differ there in the same way each time, and many such frames say no more
    than one. In many postures these differences cancel, and then the frames have more to say.

    Attributes:
        frames: how many are in the mean, as far as they count: older ones fade.
        information: [1 + K, 1 + K] the mean of their matrices, m^2.
        pull: [1 + K] the mean of information @ likeliest shape, m^2.
        pointing: two [4, 3], the mean of the directions of arms and legs, in the pelvis's axes.
    """

    frames: int
    information: Array
    pull: Array
    pointing: tuple[Array, Array]

    #: As many frames count at most.
    REMEMBERED = 20
    #: How many more postures frames count as when the directions of arms and legs vary by all that they can.
    POSTURES = 20.0
    #: The frames before were of another size, or of a wrong figure, when holding on to it costs this share of a frame's
    #: energy: of a size that fits it is 0.5 to 3.4 %. (A quadratic is that of the energy only near its least: from far
    #: off each frame would move the size a little, and all that were remembered hold it back.)
    CONTRADICTED = 0.10

    @staticmethod
    def nothing() -> SizeMemory:
        """Before the first frame."""
        n_shape = figure.proportions().n_shape
        return SizeMemory(0, np.zeros((n_shape, n_shape)), np.zeros(n_shape), (np.zeros((4, 3)), np.zeros((4, 3))))

    def after(self, size: KnownSize, state: FigureState, system: System) -> SizeMemory:
        """After one more frame, fitted with this size: of that frame alone when it contradicts the size.

        Args:
            size: what was known before the frame.
            state, system: its figure, and the energy's system there, without that of the size.
        """
        contradicted = size.cost(state.shape) > self.CONTRADICTED * system.cost
        return (SizeMemory.nothing() if contradicted else self).with_frame(state, system)

    def with_frame(self, state: FigureState, system: System) -> SizeMemory:
        """After one more frame: its figure, and the energy's system there."""
        information, pull = _of_the_shape(state.shape, system)
        if not (np.isfinite(information).all() and np.isfinite(pull).all()):
            return self  # a mean would never get rid of it
        frames = min(self.frames + 1, self.REMEMBERED)
        new = 2.0 / (frames + 1)  # a mean that fades, of as much as so many frames with equal weights
        kept = 1.0 - new
        world = figure.place(state).rotations
        directions = (world[bones, :, 2] @ world[0] for bones in _POINTERS)
        arms, legs = (kept * mean + new * now for mean, now in zip(self.pointing, directions, strict=True))
        return SizeMemory(
            frames, kept * self.information + new * information, kept * self.pull + new * pull, (arms, legs)
        )

    @property
    def postures(self) -> float:
        """How many postures the frames count as: 1 when nothing moved. The less varied of arms and legs decides."""
        return 1.0 + self.POSTURES * min(1.0 - float((mean**2).sum(axis=1).mean()) for mean in self.pointing)

    def known(self, proportions: float) -> KnownSize:
        """What is known after the remembered frames, in whose energies `Weights.proportions` was this.

        One frame's figure may be a wrong one: its size is believed when the next one has agreed.
        """
        once = proportions * _per_person()
        surplus = 1.0 - 1.0 / self.postures
        information = self.information - surplus * np.diag(once) + 1e-12 * np.eye(len(once))
        pull = self.pull - surplus * once * _mean_shape()
        shape = np.asarray(np.linalg.solve(information, pull), np.float64)
        return KnownSize(shape, max(self.frames - 1, 0) * information)


def _of_the_shape(shape: Array, system: System) -> tuple[Array, Array]:
    """Information and pull of the energy as a function of the shape, the posture being the best for each shape."""
    posture = system.matrix[:_N_POSE, :_N_POSE] + 1e-12 * np.eye(_N_POSE)  # some turns hardly change anything
    across = system.matrix[:_N_POSE, _N_POSE:]
    solved = np.linalg.solve(posture, np.column_stack([across, system.gradient[:_N_POSE]]))
    information = system.matrix[_N_POSE:, _N_POSE:] - across.T @ solved[:, :-1]
    slope = system.gradient[_N_POSE:] - across.T @ solved[:, -1]
    return information, information @ shape - slope


@cache
def _per_person() -> Array:
    """[1 + K] one over the variance of each component of a shape between people, as in the energy; of clothes 0."""
    table = figure.proportions()
    scale = np.ones(table.n_shape)  # modes are counted in standard deviations
    scale[0] = table.log_stature_std**-2
    scale[table.clothing_from :] = 0.0
    return scale


@cache
def _mean_shape() -> Array:
    """[1 + K] of all people."""
    table = figure.proportions()
    shape = np.zeros(table.n_shape)
    shape[0] = table.log_stature_mean
    return shape


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

    def system(self, state: FigureState) -> System:
        """See Prior. The size's derivatives are left out: nobody shrinks to keep a hand in its place."""
        off = figure.place(state).joints - self.joints
        squared, width2 = (off**2).sum(axis=1), self.width_m**2
        cost = self.weight * float((width2 * squared / (width2 + squared)).mean())
        J = figure.place_jacobian(state)[figure.N_SPHERES :, :3].reshape(off.size, -1)
        J[:, _N_POSE:] = 0.0
        believed = np.repeat(self.weight / len(off) * (width2 / (width2 + squared)) ** 2, 3)
        weighted = J.T * believed
        return System(cost, weighted @ off.ravel(), weighted @ J)
