# SPDX-License-Identifier: Apache-2.0
"""A fitted figure -> the published pose, with what is known about its errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
Rivals = Sequence[tuple[FigureState, float]]

#: XOR energy, smooth cost (m^2) and largest joint sigma (m) above which a pose is not to be acted on. Over the public
#: suites this catches a third of the few frames that fail, at 4 false alarms in 100 (see docs/benchmarks.md).
RELIABLE_XOR, RELIABLE_COST, RELIABLE_SIGMA = 0.62, 2.8e-4, 0.25
#: Error that remains where nothing is in doubt, m; how far the energy's curvature is believed; by how much the energy
#: of a rival (as a fraction of the least) may be above that before it hardly counts.
FLOOR_M, BELIEF, RIVAL_WIDTH = 0.010, 0.015, 0.08
_LIMB_JOINTS = [JOINT[f"{j}_{s}"] for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in "LR"]


def joint_sigma(state: FigureState, system: System, rivals: Rivals = ()) -> Array:
    """Expected error of each joint [25], m.

    Three parts, squared and added: a floor, for the figure is no person; the inverse of the energy's curvature, scaled
    by the energy itself and carried to the joints; and how far the joints of rival figures are, which explain the
    hull nearly as well: an arm that may as well be elsewhere.
    """
    n = len(system.gradient)
    information = system.matrix + 1e-9 * np.trace(system.matrix) / n * np.eye(n)
    J = figure.place_jacobian(state)[figure.N_SPHERES :, :3].reshape(-1, n)
    variances = (J * np.linalg.solve(information, J.T).T).sum(axis=1)
    curved = np.maximum(variances.reshape(-1, 3).sum(axis=1), 0.0)
    joints = figure.place(state).joints
    weight, apart = 1.0, np.zeros(len(joints))
    for rival, ratio in rivals:
        w = float(np.exp(-(ratio - 1.0) / RIVAL_WIDTH))
        weight += w
        apart += w * ((figure.place(rival).joints - joints) ** 2).sum(axis=1)
    return np.asarray(np.sqrt(FLOOR_M**2 + BELIEF * system.cost * curved + apart / weight))


def describe_pose(
    state: FigureState, hull: Hull, system: System | None, stage_ms: Mapping[str, float], rivals: Rivals = ()
) -> Pose:
    """Everything that is published about a fitted figure.

    Args:
        state: the figure.
        hull: what it was fitted to.
        system: the smooth energy around the fit, if the engine has one.
        stage_ms: process time of the stages so far, ms.
        rivals: figures that explain the hull nearly as well, with their energy over the least.
    """
    placed = figure.place(state)
    energy = xor_energy(hull, placed)
    sigma = joint_sigma(state, system, rivals) if system is not None else np.full(len(JOINT_NAMES), 0.05)
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
