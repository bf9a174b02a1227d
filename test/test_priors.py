# SPDX-License-Identifier: Apache-2.0
"""What earlier frames say of the next: derivatives, sizes that all frames agree on, joints that go on moving."""

from functools import cache
from pathlib import Path

import figure_poses
import numpy as np
import pytest

from limbloc_ros.core import figure
from limbloc_ros.core.energy import Evidence, Weights, system
from limbloc_ros.core.engine_robust import fit_from_scratch, gather_evidence, refine
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.lm import System
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.priors import Inertia, KnownSize, SizeMemory
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.recordings.cases import load_case

BENCHMARK = Path(__file__).parent / "data" / "benchmark"
N = 3 + figure.N_DOF + figure.proportions().n_shape
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
        [prior.system(state.moved(step)).cost - prior.system(state.moved(-step)).cost for step in steps]
    ) / (4 * h)


def some_information(rng):
    """A positive definite [1 + K, 1 + K]."""
    root = rng.normal(0.0, 0.01, (SIZE.stop - SIZE.start,) * 2)
    return root @ root.T + 1e-5 * np.eye(len(root))


def test_gradients():
    rng = np.random.default_rng(3)
    state = figure_poses.random_state(np.random.default_rng(2))
    size = KnownSize(state.shape + np.linspace(-0.3, 0.3, len(state.shape)), some_information(rng))
    np.testing.assert_allclose(size.system(state).gradient, numeric_gradient(size, state), atol=1e-9)
    there = figure.place(state).joints + rng.normal(0.0, 0.03, (25, 3))
    inertia = Inertia(there, 0.03, 0.03)
    term = inertia.system(state)
    np.testing.assert_allclose(term.gradient[POSE], numeric_gradient(inertia, state)[POSE], atol=1e-9)
    assert not term.gradient[SIZE].any()
    np.testing.assert_allclose(term.matrix, term.matrix.T, atol=1e-15)
    assert np.linalg.eigvalsh(term.matrix).min() > -1e-12


def test_inertia_is_a_mean_over_joints_and_believes_little_from_far_off():
    state = FigureState.standing([0.0, 0.0, 1.0])
    joints = figure.place(state).joints
    for off, squared in ((0.03, 0.5 * 0.03**2), (3.0, 0.03**2)):  # at the width half of the square, far off the width's
        there = joints.copy()
        there[7, 1] += off
        cost = Inertia(there, 0.05, 0.03).system(state).cost
        assert cost == pytest.approx(0.05 * squared / 25, rel=1e-3)


def test_a_known_size_is_kept_as_far_as_it_weighs():
    evidence, state = seen()
    known = state.shape + np.linspace(-0.2, 0.2, len(state.shape))
    off = []
    for weight in (0.0, 1e-5, 1e-3, 1.0):
        size = KnownSize(known, weight * np.eye(len(known)))
        result = refine(state, evidence, Weights(), 40, (size,))
        off.append(np.linalg.norm(result.state.shape - known))
        plain = system(result.state, evidence, Weights()).cost
        assert result.system.cost == pytest.approx(plain + size.cost(result.state.shape))
    assert off == sorted(off, reverse=True)
    assert off[-1] < 0.01
    assert off[0] > 0.3
    free = refine(state, evidence, Weights(), 40)
    weightless = refine(state, evidence, Weights(), 40, (KnownSize(known, np.zeros((len(known),) * 2)),))
    np.testing.assert_array_equal(free.state.to_vector(), weightless.state.to_vector())


def quadratic(rng, state, shape):
    """The system at a state of an energy that is a quadratic of posture and shape, and least at this shape."""
    root = rng.normal(0.0, 0.01, (N, N))
    matrix = root @ root.T
    away = np.concatenate([rng.normal(0.0, 0.1, POSE.stop), state.shape - shape])
    return System(float(away @ matrix @ away), matrix @ away, matrix)


def memory_of(*frames):
    memory = SizeMemory.nothing()
    for state, energy in frames:
        memory = memory.with_frame(state, energy)
    return memory


def test_a_frame_says_what_its_energy_says_of_the_shape_once_the_posture_has_followed():
    rng = np.random.default_rng(4)
    state = figure_poses.random_state(rng)
    best = state.shape + rng.normal(0.0, 0.3, len(state.shape))
    energy = quadratic(rng, state, best)
    assert not memory_of((state, energy)).known(0.0).information.any()  # one alone is not believed
    known = memory_of((state, energy), (state, energy)).known(0.0)
    np.testing.assert_allclose(known.shape, best, atol=1e-6)
    # along any other shape: the least of the whole quadratic over all postures
    shape = best + rng.normal(0.0, 0.3, len(best))
    away = shape - best
    follow = -np.linalg.solve(energy.matrix[POSE, POSE], energy.matrix[POSE, SIZE] @ away)
    whole = np.concatenate([follow, away])
    assert known.cost(shape) == pytest.approx(float(whole @ energy.matrix @ whole), rel=1e-4)


def test_frames_that_disagree_are_weighed_by_how_well_they_show_each_size():
    rng = np.random.default_rng(5)
    state = figure_poses.random_state(rng)
    n = len(state.shape)
    diagonal = np.diag(np.concatenate([np.ones(POSE.stop), np.r_[9.0, np.ones(n - 1)]]))
    off = np.zeros(N)
    off[SIZE.start] = -1.0
    first = System(0.0, np.zeros(N), np.eye(N))  # least at the shape that it has
    second = System(9.0, diagonal @ off, diagonal)  # one larger by 1 in the first number, nine times as sure
    # of two frames the later one counts twice
    memory = memory_of((state, first), (state, second))
    known = memory.known(0.0)
    np.testing.assert_allclose(known.shape - state.shape, np.r_[18 / 19, np.zeros(n - 1)], atol=1e-6)
    np.testing.assert_allclose(known.information, np.diag(np.r_[19 / 3, np.ones(n - 1)]), atol=1e-6)


def test_old_frames_are_forgotten():
    state = figure_poses.random_state(np.random.default_rng(6))
    smaller, larger = np.zeros(N), np.zeros(N)
    smaller[SIZE], larger[SIZE] = 1.0, -1.0
    frames = [(state, System(0.0, smaller, np.eye(N)))] * 50 + [(state, System(0.0, larger, np.eye(N)))] * 100
    memory = memory_of(*frames)
    assert memory.frames == SizeMemory.REMEMBERED
    assert np.all(memory.known(0.0).shape - state.shape > 0.95)
    assert np.linalg.eigvalsh(memory.known(0.0).information).max() == pytest.approx(SizeMemory.REMEMBERED - 1)


@pytest.mark.parametrize(("share", "remembered"), [(0.999, 4), (1.001, 1)])
def test_a_size_that_a_frame_contradicts_is_forgotten(share, remembered):
    """When holding on to it cost more than a share of the frame's energy; that frame itself is always remembered."""
    rng = np.random.default_rng(9)
    state = figure_poses.random_state(rng)
    memory = memory_of(*[(state, quadratic(rng, state, state.shape)) for _ in range(3)])
    frame = quadratic(rng, state, state.shape + 0.2)
    size = KnownSize(state.shape - rng.normal(0.0, 0.2, len(state.shape)), some_information(rng))
    scale = share * SizeMemory.CONTRADICTED * frame.cost / size.cost(state.shape)
    after = memory.after(KnownSize(size.shape, scale * size.information), state, frame)
    kept = memory if remembered > 1 else SizeMemory.nothing()
    expected = kept.with_frame(state, frame)
    assert after.frames == expected.frames == remembered
    np.testing.assert_array_equal(after.information, expected.information)
    np.testing.assert_array_equal(after.pull, expected.pull)
    np.testing.assert_array_equal(after.pointing, expected.pointing)


def test_a_frame_that_is_no_number_is_not_remembered():
    state = figure_poses.random_state(np.random.default_rng(8))
    memory = memory_of((state, System(0.0, np.zeros(N), np.eye(N))))
    assert memory.with_frame(state, System(0.0, np.full(N, np.nan), np.eye(N))) is memory


def test_of_no_frame_nothing_is_known():
    """As after a first frame that was no number."""
    nothing = SizeMemory.nothing().known(2e-6)
    assert not nothing.information.any()
    assert np.isfinite(nothing.shape).all()


def test_how_people_differ_counts_once_for_all_postures():
    """The energy of each frame holds it; of frames in many postures most of these are taken away again."""
    rng = np.random.default_rng(7)
    still = FigureState.standing([0.0, 0.0, 1.0])
    weights = Weights(surface=0.0, inclusion=0.0, penetration=0.0, posture=0.0, limits=0.0, spine=0.0)
    nothing_seen = system(still, evidence_of_nothing(), weights)
    one = memory_of(*[(still, nothing_seen)] * 5)
    assert one.postures == pytest.approx(1.0)
    mean = one.known(weights.proportions)
    assert mean.shape[0] == pytest.approx(figure.proportions().log_stature_mean)
    np.testing.assert_allclose(mean.shape[1:], 0.0, atol=1e-6)
    moving = [figure_poses.random_state(rng) for _ in range(12)]
    many = memory_of(*[(s, system(s, evidence_of_nothing(), weights)) for s in moving])
    assert many.postures > 3.0
    body = figure.proportions().clothing_from
    in_one, in_many = (np.diag(m.known(weights.proportions).information) / (m.frames - 1) for m in (one, many))
    variance = np.r_[figure.proportions().log_stature_std ** 2, np.ones(body - 1)]
    np.testing.assert_allclose(in_one[:body] * variance, weights.proportions, rtol=1e-3)
    np.testing.assert_allclose(in_many[:body] * many.postures, in_one[:body], rtol=1e-3)
    np.testing.assert_allclose(in_many[body:], in_one[body:], rtol=1e-9)  # clothes are no proportions
    likeliest = many.known(weights.proportions).shape
    assert likeliest[0] == pytest.approx(figure.proportions().log_stature_mean)
    np.testing.assert_allclose(likeliest[1:body], 0.0, atol=1e-5)
    arms_only = []
    for s in moving:
        rotations = s.rotations.copy()
        legs = [figure.BONE[f"{bone}_{side}"] for bone in ("thigh", "shin") for side in "LR"]
        rotations[legs] = still.rotations[legs]
        arms_only.append((FigureState(s.root, rotations, s.shape), nothing_seen))
    assert memory_of(*arms_only).postures == pytest.approx(1.0)  # of the legs they say what one posture says


def evidence_of_nothing():
    """A hull that is far away and tells nothing."""
    far = np.full((1, 3), 100.0)
    sdf = np.full((2, 2, 2), -1.0, np.float32)
    return Evidence(far, np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3)), np.zeros(1), sdf, np.full(3, -10.0), 20.0)


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
