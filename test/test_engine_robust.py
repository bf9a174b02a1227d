# SPDX-License-Identifier: Apache-2.0
"""The robust engine on people that our figure did not draw, and on hulls that hold nobody."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from limbloc_ros.core import engine_robust, figure
from limbloc_ros.core._figure_kernels import exp_so3
from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.energy import Weights, system
from limbloc_ros.core.engine_robust import fit_from_scratch, gather_evidence, outline_rays, refine
from limbloc_ros.core.hull import NOBODY as NOBODY_CUT
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.core.search import Medial
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.core.tracker import Tracker
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
    assert len(again.rivals) == len(first.rivals)
    for (mine, share), (other, same) in zip(again.rivals, first.rivals, strict=True):
        np.testing.assert_array_equal(mine.to_vector(), other.to_vector())
        assert share == same


@pytest.mark.parametrize(("name", "frame"), PEOPLE)
def test_rivals_explain_the_hull_nearly_as_well(name, frame):
    fit = fit_of(name, frame)
    shares = [share for _, share in fit.rivals]
    assert min(shares) == 1.0  # the best of them, of which the fit itself comes
    assert max(shares) < engine_robust.RIVAL_COST
    best = fit.rivals[int(np.argmin(shares))][0]
    shift = figure.place(best).joints - figure.place(fit.state).joints
    assert np.median(np.linalg.norm(shift, axis=1)) < 0.05


def test_of_figures_of_one_energy_the_one_that_the_cameras_saw_wins():
    """An arm elsewhere, which the hull may allow where a mask lost the right one, is not where the silhouettes are."""
    hull, right = hull_of(*PEOPLE[0]), fit_of(*PEOPLE[0]).state
    rotations = right.rotations.copy()
    bone = figure.BONE["upper_arm_L"]
    rotations[bone] = rotations[bone] @ exp_so3(np.array([0.0, 1.2, 0.0]))
    wrong = figure.FigureState(right.root, rotations, right.shape)
    of_cost = [SimpleNamespace(state=state, system=SimpleNamespace(cost=2e-4)) for state in (wrong, right)]
    assert engine_robust._best(of_cost, 1, hull)[0].state is right
    assert engine_robust._best(of_cost[::-1], 1, hull)[0].state is right
    # by more than energies of right and wrong figures differ, which a hull alone does not tell
    assert engine_robust.unseen(wrong, hull) > engine_robust.unseen(right, hull) + 2e-4
    assert engine_robust._best(of_cost, 1, replace(hull, views=None))[0].state is wrong
    costly = SimpleNamespace(state=right, system=SimpleNamespace(cost=1.0))
    assert engine_robust._best([costly, of_cost[0]], 2, hull) == [of_cost[0], costly]  # energy counts as well


def test_another_seed_finds_the_same_person():
    name, frame = PEOPLE[0]
    hull = hull_of(name, frame)
    other = fit_from_scratch(hull, extract_surface(hull), seed=12345)
    joints = [figure.place(fit.state).joints for fit in (other, fit_of(name, frame))]
    assert np.median(np.linalg.norm(joints[0] - joints[1], axis=1)) < 0.02


def test_a_doubtful_figure_is_searched_for_once_more():
    name, frame = PEOPLE[0]
    hull = hull_of(name, frame)
    surface = extract_surface(hull)
    first = replace(engine_robust.QUICK, torsos=1, leg_pairs=1, starts=1, arm_repairs=1, certain=1.0, enough=1.0)
    second = replace(first, torsos=2, starts=2)
    asked = []

    def fit(risk_of):
        return fit_from_scratch(hull, surface, 0, None, (first, second), risk_of)

    def risky(state):
        asked.append(state)
        return engine_robust.WORTH_A_SEARCH

    once = fit(lambda state: 0.9 * risky(state))
    assert len(asked) == 1
    assert engine_robust.apart_m(asked[0], once.state) < 0.02  # before it was polished
    np.testing.assert_array_equal(once.state.rotations, fit(None).state.rotations)
    asked.clear()
    fit(risky)
    assert len(asked) == 1  # nobody is asked after the last search
    thrice = fit_from_scratch(hull, surface, 0, None, (first, first, second), risky)
    alone = fit_from_scratch(hull, surface, 0, None, (second,))
    assert len(asked) == 3
    assert thrice.verdict == min(once.verdict, alone.verdict)


@pytest.mark.parametrize(
    ("likely", "risk", "seen", "tried"),
    [(1.0, 0.5, True, False), (1.0, 1.5, True, True), (0.0, 0.5, True, True), (1.0, 0.0, False, True)],
)
def test_limbs_of_a_figure_that_is_hardly_wrong_stay_where_they_are(monkeypatch, likely, risk, seen, tried):
    trials = []
    monkeypatch.setattr(engine_robust, "_with_better_limb", lambda winner, *_: trials.append(winner) or winner)
    name, frame = PEOPLE[0]
    hull = hull_of(name, frame)
    if not seen:  # nobody knows what the cameras saw: a risk of 0 says nothing
        hull = replace(hull, views=None)
    effort = replace(engine_robust.QUICK, torsos=1, leg_pairs=1, starts=1, certain=1e-9, likely=likely, enough=1.0)
    fit_from_scratch(hull, extract_surface(hull), 0, None, (effort,), lambda state: risk * engine_robust.CALM)
    assert bool(trials) == tried


def test_a_polished_figure_explains_the_whole_surface_better(monkeypatch):
    hull = hull_of(*PEOPLE[0])
    surface = extract_surface(hull)
    every = gather_evidence(hull, surface, 10**9, np.random.default_rng(0))
    effort = replace(engine_robust.QUICK, torsos=1, leg_pairs=1, starts=1, points=300, enough=1.0)
    costs = []
    for steps in (0, engine_robust.POLISH_STEPS):
        monkeypatch.setattr(engine_robust, "POLISH_STEPS", steps)
        fit = fit_from_scratch(hull, surface, 0, None, (effort,))
        costs.append(system(fit.state, every, Weights()).cost)
    assert costs[1] < 0.99 * costs[0]


def test_what_an_earlier_search_found_is_polished_when_a_later_one_finds_no_torso(monkeypatch):
    hull = hull_of(*PEOPLE[0])
    surface = extract_surface(hull)
    first = replace(engine_robust.QUICK, torsos=1, leg_pairs=1, starts=1, enough=0.0)
    second = replace(first, torso_search=replace(first.torso_search, listed=first.torso_search.listed + 1))
    found = engine_robust._torsos

    def torsos(hull, medial, seed, effort):
        return found(hull, medial, seed, effort) if effort == first.torso_search else []

    monkeypatch.setattr(engine_robust, "_torsos", torsos)
    alone = fit_from_scratch(hull, surface, 0, None, (first,))
    both = fit_from_scratch(hull, surface, 0, None, (first, second))
    np.testing.assert_array_equal(both.state.to_vector(), alone.state.to_vector())


def test_evidence_is_a_fair_sample():
    hull = hull_of(*PEOPLE[0])
    surface = extract_surface(hull)
    evidence = gather_evidence(hull, surface, 350, np.random.default_rng(0))
    assert evidence.points.shape == evidence.normals.shape == (350, 3)
    assert evidence.point_weights.sum() == pytest.approx(1)
    rows = {tuple(point) for point in surface.points}
    assert len({tuple(point) for point in evidence.points} & rows) == 350  # no point twice
    assert np.linalg.norm(evidence.points.mean(axis=0) - surface.points.mean(axis=0)) < 0.03
    place_of = {tuple(point): row for row, point in enumerate(surface.points)}
    gaps = np.diff([place_of[tuple(point)] for point in evidence.points])
    assert set(gaps) <= {len(surface) // 350, len(surface) // 350 + 1}  # evenly
    every = gather_evidence(hull, surface, 10**9, np.random.default_rng(0))
    np.testing.assert_array_equal(every.points, surface.points)
    # some points ask for themselves, the others for their ray only
    for step in (1, 2, 4):
        evidence = gather_evidence(hull, surface, 350, np.random.default_rng(0), themselves_every=step)
        lengths = np.linalg.norm(evidence.rays, axis=1)
        assert not lengths[::step].any()
        np.testing.assert_allclose(np.delete(lengths, np.s_[::step]), 1.0)


# outlines


def seen_by(hull, surface, rows):
    """Centres [Q, 3] of the cameras that cut the hull at points of its surface."""
    at = surface.indices[rows] - np.asarray(hull.index_min)
    return hull.viewpoints[hull.cut_by[tuple(at.T)]].astype(np.float64)


def test_rays_go_from_cameras_to_points_of_the_surface():
    hull = hull_of(*PEOPLE[0])
    surface = extract_surface(hull)
    rows = np.random.default_rng(0).permutation(len(surface))[:400]
    rays = outline_rays(hull, surface, rows)
    offsets = surface.points[rows] - seen_by(hull, surface, rows)
    np.testing.assert_allclose(rays, offsets / np.linalg.norm(offsets, axis=1, keepdims=True), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
    names = [camera.name for camera in case(PEOPLE[0][0]).rig.cameras]
    places = {name: case(PEOPLE[0][0]).rig.camera(name).T_world_camera[:3, 3] for name in names}
    known = np.array([places[name] for name in hull.cameras])
    gaps = np.linalg.norm(seen_by(hull, surface, rows)[:, None] - known, axis=-1).min(axis=1)
    assert gaps.max() < 1e-5


def test_rays_touch_the_hull():
    """A silhouette's outline is where viewing rays graze: the hull's surface runs along the ray that cut it."""
    for name, frame in PEOPLE:
        hull = hull_of(name, frame)
        surface = extract_surface(hull)
        rays = outline_rays(hull, surface, np.arange(len(surface)))
        steepness = np.degrees(np.arcsin(np.abs((rays * surface.normals).sum(axis=1))))
        assert np.median(steepness) < 8
        assert np.percentile(steepness, 85) < 30  # the rest lies at edges, where two cameras meet


def test_rays_touch_a_ball():
    """The ball itself touches every ray along the outline, also where the hull's surface is not the ball's."""
    centre, radius = np.array([0.1, -0.1, 1.0]), 0.4
    hull = ball_hull(centre, radius)
    surface = extract_surface(hull)
    rays = outline_rays(hull, surface, np.arange(len(surface)))
    to_ball = centre - surface.points
    off = np.linalg.norm(to_ball - (to_ball * rays).sum(axis=1, keepdims=True) * rays, axis=1)
    np.testing.assert_allclose(off, radius, atol=VOXEL)  # a pixel is 1.4 cm
    assert np.abs(off - radius).mean() < 0.4 * VOXEL
    phantom = np.linalg.norm(to_ball, axis=1) - radius
    assert phantom.max() > 2 * VOXEL  # four cameras leave much that is no ball, and rays do not ask for that
    assert np.degrees(np.arcsin(np.abs((rays * surface.normals).sum(axis=1)))).mean() < 10


def ball_hull(centre, radius):
    """The hull of a ball that four cameras, 3 m away, see."""
    cameras, masks = [], {}
    for i, (x, y, z) in enumerate(((3.0, 0.0, 1.5), (0.0, 3.0, 0.7), (-2.2, -2.0, 2.2), (1.8, -2.4, 1.0))):
        forward = np.array([-x, -y, 1.0 - z]) / np.linalg.norm([x, y, z - 1.0])
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        T[:3, 3] = x, y, z
        K = np.array([[220.0, 0.0, 119.5], [0.0, 220.0, 119.5], [0.0, 0.0, 1.0]])
        cameras.append(Camera(f"cam{i}", 240, 240, K, T))
        v, u = np.mgrid[:240, :240]
        rays = np.stack([(u - 119.5) / 220, (v - 119.5) / 220, np.ones_like(u)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        at = T[:3, :3].T @ (centre - T[:3, 3])
        masks[f"cam{i}"] = np.where(at @ at - (rays @ at) ** 2 < radius**2, 255, 0).astype(np.uint8)
    rig = Rig(tuple(cameras), np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 2.0]))
    hull = Carver(rig, HullConfig(voxel_m=VOXEL, min_share=0.0)).carve(masks)
    assert isinstance(hull, Hull)
    return hull


def test_no_rays_where_nobody_is_known_to_have_cut():
    hull = hull_of(*PEOPLE[0])
    surface = extract_surface(hull)
    rows = np.arange(0, len(surface), 7)
    rays = outline_rays(hull, surface, rows)
    assert not outline_rays(replace(hull, cut_by=None), surface, rows).any()
    forgotten = hull.cut_by.copy()
    forgotten[forgotten == 0] = NOBODY_CUT
    at = tuple((surface.indices[rows] - np.asarray(hull.index_min)).T)
    gone = hull.cut_by[at] == 0
    assert 0 < gone.sum() < len(rows)
    expected = np.where(gone[:, None], 0.0, rays)
    np.testing.assert_array_equal(outline_rays(replace(hull, cut_by=forgotten), surface, rows), expected)
    # a hull without any of it is fitted by its points alone
    bare = gather_evidence(replace(hull, cut_by=None), surface, 300, np.random.default_rng(0))
    assert not bare.rays.any()


def test_refinement_lowers_the_energy_and_keeps_a_fit():
    name, frame = PEOPLE[0]
    hull, fit = hull_of(name, frame), fit_of(name, frame)
    evidence = gather_evidence(hull, extract_surface(hull), 600, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    for _ in range(3):
        step = rng.normal(0, 0.03, 3 + figure.N_DOF + len(fit.state.shape))  # the final weights lead from near by only
        step[:3] *= 0.3
        step[3 + figure.N_DOF :] = 0.0
        start = fit.state.moved(step)
        result = refine(start, evidence, Weights(), 20)
        assert result.system.cost < 0.7 * system(start, evidence, Weights()).cost
        assert result.system.cost == system(result.state, evidence, Weights()).cost
        shift = figure.place(result.state).joints - figure.place(fit.state).joints
        assert np.median(np.linalg.norm(shift, axis=1)) < 0.01


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
    assert engine_robust.search.torso_hypotheses(hull, nothing, np.random.default_rng(0), 6) == []
