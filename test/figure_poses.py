# SPDX-License-Identifier: Apache-2.0
"""Figures in many postures, for tests: random ones within the joints' limits, and real fits."""

from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from limbloc_ros.core import energy
from limbloc_ros.core.figure import BONE_NAMES, N_BONES, N_DOF, FigureState, place, proportions
from limbloc_ros.core.joint_angles import NATIVE_ANGLES, native_angles, native_rotations
from limbloc_ros.core.pose import Pose


def random_state(rng: np.random.Generator, share: float = 1.0) -> FigureState:
    """A person of random size anywhere, facing anywhere, every joint within `share` of its limits."""
    body = rng.uniform(np.log(1.1), np.log(2.0)), *rng.normal(0, 1, proportions().clothing_from - 1)
    shape = np.array([*body, 0.5, 0.3])  # and clothes
    state = FigureState(rng.normal(0, 1, 3), energy.REST_ROTATIONS.copy(), shape)
    step = np.zeros(3 + N_DOF + len(shape))
    step[3 : 3 + N_DOF] = share * rng.uniform(energy.LOW, energy.HIGH)
    return state.moved(step)


@cache
def fitted_states() -> tuple[FigureState, ...]:
    """79 postures that the pipeline fitted to benchmark people; see data/make_figure_states.py."""
    with np.load(Path(__file__).parent / "data" / "figure_states.npz") as file:
        rows = file["states"].astype(np.float64)
    split = 3 + 3 * N_BONES
    return tuple(
        FigureState(row[:3], Rotation.from_rotvec(row[3:split].reshape(-1, 3)).as_matrix(), row[split:]) for row in rows
    )


def posed(degrees: dict[str, float], stature: float = 1.7) -> FigureState:
    """Someone who stands at the origin, looks along x and bends only the joints named."""
    unknown = set(degrees) - {angle.name for angle in NATIVE_ANGLES}
    assert not unknown, unknown
    angles = {angle.name: np.radians(degrees.get(angle.name, 0.0)) for angle in NATIVE_ANGLES}
    standing = FigureState.standing(np.array([0.0, 0.0, 1.0]), stature=stature)
    return FigureState(standing.root, native_rotations(angles), standing.shape)


def pose_of(state: FigureState) -> Pose:
    """The pose that the pipeline would publish for a state."""
    placed = place(state)
    angles = native_angles(placed.rotations, shape=state.shape)
    vector = state.to_vector()
    return Pose(placed.joints, placed.rotations, BONE_NAMES, angles, {}, placed.flesh(), vector, 0.1, np.full(25, 0.02))
