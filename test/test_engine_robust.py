# SPDX-License-Identifier: Apache-2.0
"""The robust engine on people that our figure did not draw, and on hulls that hold nobody."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from limbloc_ros.core import engine_robust, figure
from limbloc_ros.core.energy import Weights, system
from limbloc_ros.core.engine_robust import Tracker, fit_from_scratch, gather_evidence, refine
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.core.search import Medial
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.recordings.cases import load_case

BENCHMARK = Path(__file__).parent / "data" / "benchmark"
VOXEL, BAND = 0.02, 0.06


@cache
def case(name):
    return load_case(BENCHMARK / name)


@cache
def hull_of(name, frame):
    loaded = case(name)
    hull = Carver(loaded.rig).carve(loaded.masks(frame))
    assert isinstance(hull, Hull)
    return hull


@cache
def fit_of(name, frame):
    hull = hull_of(name, frame)
    return fit_from_scratch(hull, extract_surface(hull), seed=0)


def truth_of(name, frame):
    """[25, 3] true joints, m."""
    return np.array([case(name).truth[joint][frame] for joint in JOINT_NAMES])


PEOPLE = [
    ("public/poses_p_man_avg", 0),
    ("public/poses_p_woman_heavy", 9),
    ("public/poses_p_elder_heavy", 7),
    ("public_few/cams6_p_child_8y", 0),
]


@pytest.mark.parametrize(("name", "frame"), PEOPLE)
def test_joints_of_people(name, frame):
    joints, truth = figure.place(fit_of(name, frame).state).joints, truth_of(name, frame)
    error = np.linalg.norm(joints - truth, axis=1)
    assert np.median(error) < 0.025
    assert error.mean() < 0.045
    # left and right, and front and back, are not exchanged
    for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"):
        left, right = JOINT[f"{joint}_L"], JOINT[f"{joint}_R"]
        crossed = np.linalg.norm(joints[left] - truth[right]) + np.linalg.norm(joints[right] - truth[left])
        assert error[left] + error[right] < crossed, joint
    for side in "LR":
        feet = [points[JOINT[f"toe_{side}"]] - points[JOINT[f"heel_{side}"]] for points in (joints, truth)]
        assert feet[0] @ feet[1] > 0.5 * np.linalg.norm(feet[0]) * np.linalg.norm(feet[1])


@pytest.mark.parametrize(("name", "frame"), PEOPLE)
def test_size_of_people(name, frame):
    with np.load(BENCHMARK / name / "gt.npz") as file:
        stature = float(file["stature"])
    assert np.exp(fit_of(name, frame).state.shape[0]) == pytest.approx(stature, rel=0.08)


@pytest.mark.parametrize(("name", "frame"), PEOPLE[:1])
def test_the_same_hull_gives_the_same_bits(name, frame):
    hull, first = hull_of(name, frame), fit_of(name, frame)
    again = fit_from_scratch(hull, extract_surface(hull), seed=0)
    np.testing.assert_array_equal(again.state.to_vector(), first.state.to_vector())
    assert again.system.cost == first.system.cost
    assert again.runner_up == first.runner_up >= first.system.cost


def test_another_seed_finds_the_same_person():
    name, frame = PEOPLE[0]
    hull = hull_of(name, frame)
    other = fit_from_scratch(hull, extract_surface(hull), seed=12345)
    joints = [figure.place(fit.state).joints for fit in (other, fit_of(name, frame))]
    assert np.median(np.linalg.norm(joints[0] - joints[1], axis=1)) < 0.02


def test_evidence_is_a_fair_sample():
    hull = hull_of(*PEOPLE[0])
    surface = extract_surface(hull)
    evidence = gather_evidence(hull, surface, 350, np.random.default_rng(0))
    assert evidence.points.shape == evidence.normals.shape == (350, 3)
    assert evidence.point_weights.sum() == pytest.approx(1)
    rows = {tuple(point) for point in surface.points}
    assert len({tuple(point) for point in evidence.points} & rows) == 350  # no point twice
    assert np.linalg.norm(evidence.points.mean(axis=0) - surface.points.mean(axis=0)) < 0.1
    every = gather_evidence(hull, surface, 10**9, np.random.default_rng(0))
    np.testing.assert_array_equal(every.points, surface.points)


def test_refinement_lowers_the_energy_and_keeps_a_fit():
    name, frame = PEOPLE[0]
    hull, fit = hull_of(name, frame), fit_of(name, frame)
    evidence = gather_evidence(hull, extract_surface(hull), 600, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    for _ in range(3):
        step = rng.normal(0, 0.05, 3 + figure.N_DOF + len(fit.state.shape))
        step[:3] *= 0.3
        step[3 + figure.N_DOF :] = 0.0
        start = fit.state.moved(step)
        result = refine(start, evidence, Weights(), 20)
        assert result.system.cost < 0.7 * system(start, evidence, Weights()).cost
        assert result.system.cost == system(result.state, evidence, Weights()).cost
        shift = figure.place(result.state).joints - figure.place(fit.state).joints
        assert np.median(np.linalg.norm(shift, axis=1)) < 0.03


# hulls that hold nobody


def hull_where(distance, half):
    """The hull of a signed distance function in the box -half..half."""
    top = np.ceil(np.broadcast_to(half, 3) / VOXEL).astype(int)
    index = np.stack(np.meshgrid(*(np.arange(-n, n) for n in top), indexing="ij"), axis=-1)
    d = distance((index.reshape(-1, 3) + 0.5) * VOXEL).reshape(index.shape[:3])
    return Hull(VOXEL, tuple((-top).tolist()), np.minimum(d, BAND).astype(np.float32), BAND)


def box(*half):
    def distance(points):
        beyond = np.abs(points) - half
        return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)

    return distance


def ball(radius):
    return lambda points: np.linalg.norm(points, axis=1) - radius


NOBODY = {
    "one voxel": hull_where(lambda points: np.linalg.norm(points - 0.01, axis=1) - 0.009, 0.1),
    "sheet": hull_where(box(1.0, 1.0, 0.011), [1.2, 1.2, 0.2]),
    "wall": hull_where(box(1.0, 0.05, 1.0), [1.2, 0.2, 1.2]),
    "pole": hull_where(box(0.05, 0.05, 0.9), [0.2, 0.2, 1.1]),
    "head alone": hull_where(ball(0.12), 0.3),
    "huge ball": hull_where(ball(0.6), 0.8),
    "full room": hull_where(box(1.5, 1.5, 1.2), [1.6, 1.6, 1.3]),
}


@pytest.mark.parametrize("name", NOBODY)
def test_nobody(name):
    hull = NOBODY[name]
    surface = extract_surface(hull)
    assert fit_from_scratch(hull, surface, seed=0) is None
    assert Tracker(seed=0).follow(hull, surface) is None


def test_no_torso_without_a_medial_axis():
    hull = NOBODY["huge ball"]
    nothing = Medial(np.empty((0, 4)))
    assert engine_robust.search.torso_hypotheses(hull, nothing, np.random.default_rng(0)) == []


# from frame to frame


WALK = "public/seq_walk_circle"


def test_the_tracker_follows_a_walk():
    tracker = Tracker(seed=0)
    for frame in range(20, 24):
        hull = hull_of(WALK, frame)
        fit = tracker.follow(hull, extract_surface(hull))
        error = np.linalg.norm(figure.place(fit.state).joints - truth_of(WALK, frame), axis=1)
        assert np.median(error) < 0.03, frame
        assert error.mean() < 0.05, frame


def test_the_tracker_starts_from_the_frame_before_until_it_is_reset():
    hull = hull_of(WALK, 20)
    surface = extract_surface(hull)
    tracker = Tracker(seed=0)
    alone = tracker.follow(hull, surface).state.to_vector()
    followed = tracker.follow(hull, surface).state.to_vector()
    assert not np.array_equal(followed, alone)
    tracker.reset()
    np.testing.assert_array_equal(tracker.follow(hull, surface).state.to_vector(), alone)
