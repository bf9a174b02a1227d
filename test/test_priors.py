# SPDX-License-Identifier: Apache-2.0
"""What earlier frames say of the next: derivatives, sizes in standard deviations, joints that go on moving."""

from functools import cache
from pathlib import Path

import figure_poses
import numpy as np
import pytest

from limbloc_ros.core import figure
from limbloc_ros.core.energy import Weights, system
from limbloc_ros.core.engine_robust import fit_from_scratch, gather_evidence, refine
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.lm import System
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.priors import Inertia, KnownSize
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.recordings.cases import load_case

BENCHMARK = Path(__file__).parent / "data" / "benchmark"
N = 3 + figure.N_DOF + figure.proportions().n_shape
NOTHING = System(0.0, np.zeros(N), np.zeros((N, N)))
POSE = slice(0, 3 + figure.N_DOF)
SIZE = slice(3 + figure.N_DOF, N)


@cache
def seen():
    """Evidence of a person, and the figure found in it."""
    case = load_case(BENCHMARK / "public/poses_p_man_avg")
    hull = Carver(case.rig).carve(case.masks(0))
    surface = extract_surface(hull)
    evidence = gather_evidence(hull, surface, 600, np.random.default_rng(1))
    return evidence, fit_from_scratch(hull, surface, seed=0).state


def numeric_gradient(prior, state, h=1e-6):
    steps = h * np.eye(N)
    return np.array(
        [
            prior.added_to(NOTHING, state.moved(step)).cost - prior.added_to(NOTHING, state.moved(-step)).cost
            for step in steps
        ]
    ) / (4 * h)


def test_gradients():
    state = figure_poses.random_state(np.random.default_rng(2))
    size = KnownSize(state.shape + np.linspace(-0.3, 0.3, len(state.shape)), 1e-3)
    np.testing.assert_allclose(size.added_to(NOTHING, state).gradient, numeric_gradient(size, state), atol=1e-9)
    there = figure.place(state).joints + np.random.default_rng(3).normal(0.0, 0.03, (25, 3))
    inertia = Inertia(there, 0.03, 0.03)
    added = inertia.added_to(NOTHING, state)
    np.testing.assert_allclose(added.gradient[POSE], numeric_gradient(inertia, state)[POSE], atol=1e-9)
    assert not added.gradient[SIZE].any()
    np.testing.assert_allclose(added.matrix, added.matrix.T, atol=1e-15)
    assert np.linalg.eigvalsh(added.matrix).min() > -1e-12


def test_inertia_is_a_mean_over_joints_and_believes_little_from_far_off():
    state = FigureState.standing([0.0, 0.0, 1.0])
    joints = figure.place(state).joints
    for off, squared in ((0.03, 0.5 * 0.03**2), (3.0, 0.03**2)):  # at the width half of the square, far off the width's
        there = joints.copy()
        there[7, 1] += off
        cost = Inertia(there, 0.05, 0.03).added_to(NOTHING, state).cost
        assert cost == pytest.approx(0.05 * squared / 25, rel=1e-3)


def test_sizes_are_weighed_by_how_people_differ():
    shape = np.zeros(figure.proportions().n_shape)
    taller, otherwise = shape.copy(), shape.copy()
    taller[0] += figure.proportions().log_stature_std
    otherwise[3] += 1.0
    assert KnownSize(shape, 2e-4).cost(taller) == pytest.approx(2e-4)
    assert KnownSize(shape, 2e-4).cost(otherwise) == pytest.approx(2e-4)


def test_a_known_size_is_kept_as_far_as_it_weighs():
    evidence, state = seen()
    known = state.shape + np.linspace(-0.2, 0.2, len(state.shape))
    off = []
    for weight in (0.0, 1e-5, 1e-3, 1.0):
        size = KnownSize(known, weight)
        result = refine(state, evidence, Weights(), 40, (size,))
        off.append(np.linalg.norm(result.state.shape - known))
        plain = system(result.state, evidence, Weights()).cost
        assert result.system.cost == pytest.approx(plain + size.cost(result.state.shape))
    assert off == sorted(off, reverse=True)
    assert off[-1] < 0.01
    assert off[0] > 0.3
    free = refine(state, evidence, Weights(), 40)
    weightless = refine(state, evidence, Weights(), 40, (KnownSize(known, 0.0),))
    np.testing.assert_array_equal(free.state.to_vector(), weightless.state.to_vector())


def test_joints_are_held_where_they_should_be_as_far_as_that_weighs():
    evidence, state = seen()
    there = figure.place(state).joints + 0.01
    off = []
    for weight in (0.0, 0.03, 1.0, 1e3):
        result = refine(state, evidence, Weights(), 40, (Inertia(there, weight, 0.03),))
        off.append(np.linalg.norm(figure.place(result.state).joints - there, axis=1).mean())
    assert off == sorted(off, reverse=True)
    assert off[0] > 0.012
    assert off[-1] < 0.5 * off[0]
