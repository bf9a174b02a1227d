# SPDX-License-Identifier: Apache-2.0
"""A fitted figure -> the published pose, with what is known about its errors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import figure
from limbloc_ros.core.energy import xor_energy
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.joint_angles import native_angles
from limbloc_ros.core.lm import System
from limbloc_ros.core.pose import JOINT, JOINT_NAMES, STICK_BONES, Pose

Array = NDArray[np.float64]

#: XOR energy, smooth cost (m^2) and largest joint sigma (m) above which a pose is not to be acted on. On the public
#: and our own suites 5 % of the good frames lie above the cost, and three quarters of the failed ones.
RELIABLE_XOR, RELIABLE_COST, RELIABLE_SIGMA = 0.38, 5.6e-4, 0.11
_LIMB_JOINTS = [JOINT[f"{j}_{s}"] for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in "LR"]


def joint_sigma(state: FigureState, system: System) -> Array:
    """Expected error of each joint [25], m.

    The inverse of the energy's curvature, scaled by the energy itself, carried to the joints; never below the floor
    that comes from the figure being no person.
    """
    n = len(system.gradient)
    covariance = np.linalg.inv(system.matrix + 1e-9 * np.trace(system.matrix) / n * np.eye(n))
    J = figure.place_jacobian(state)[figure.N_SPHERES :, :3]
    spread = np.einsum("jap,pq,jaq->j", J, covariance, J)
    return np.asarray(np.sqrt(0.012**2 + 0.05 * system.cost * np.maximum(spread, 0.0)))


def describe_pose(state: FigureState, hull: Hull, system: System | None, stage_ms: Mapping[str, float]) -> Pose:
    """Everything that is published about a fitted figure.

    Args:
        state: the figure.
        hull: what it was fitted to.
        system: the smooth energy around the fit, if the engine has one.
        stage_ms: process time of the stages so far, ms.
    """
    placed = figure.place(state)
    energy = xor_energy(hull, placed)
    sigma = joint_sigma(state, system) if system is not None else np.full(len(JOINT_NAMES), 0.05)
    sizes = {
        f"{a}-{b}": float(np.linalg.norm(placed.joints[JOINT[a]] - placed.joints[JOINT[b]])) for a, b in STICK_BONES
    }
    sizes["stature"] = float(np.exp(state.shape[0]))
    return Pose(
        joints=placed.joints,
        rotations=placed.rotations,
        bone_names=figure.BONE_NAMES,
        angles=native_angles(placed.rotations, shape=state.shape),
        sizes=sizes,
        flesh=placed.flesh(),
        parameters=state.to_vector(),
        energy=energy,
        sigma=sigma,
        reliable=energy < RELIABLE_XOR
        and (system is None or (system.cost < RELIABLE_COST and float(sigma[_LIMB_JOINTS].max()) < RELIABLE_SIGMA)),
        stage_ms=dict(stage_ms),
    )
