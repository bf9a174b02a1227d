# SPDX-License-Identifier: Apache-2.0
"""From frame to frame: what is carried along, when a fit is doubted, and how an arm that slipped comes back."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import figure_poses
import numpy as np
import pytest
from flesh_hulls import moved

from limbloc_ros.core import figure, tracker
from limbloc_ros.core.engine_robust import SETTLED_M, Fit, Refined
from limbloc_ros.core.figure import BONE, FigureState, place
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.limb_pairs import with_limb
from limbloc_ros.core.lm import System
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.core.priors import SizeMemory
from limbloc_ros.core.search import ARM
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.core.tracker import Tracker
from limbloc_ros.recordings.cases import load_case

BENCHMARK = Path(__file__).parent / "data" / "benchmark"
WALK = "public/seq_walk_circle"
FRAMES = range(20, 24)


@cache
def case():
    return load_case(BENCHMARK / WALK)


@cache
def hull_of(frame):
    hull = Carver(case().rig).carve(case().masks(frame))
    assert isinstance(hull, Hull)
    return hull


@cache
def surface_of(frame):
    return extract_surface(hull_of(frame))


def truth_of(frame):
    """[25, 3] true joints, m."""
    return np.array([case().truth[joint][frame] for joint in JOINT_NAMES])


def errors(fit, frame):
    return np.linalg.norm(place(fit.state).joints - truth_of(frame), axis=1)


def follow(follower, frame):
    return follower.follow(hull_of(frame), surface_of(frame))


# on a walk


def test_the_tracker_follows_a_walk():
    follower = Tracker(seed=0)
    for frame in FRAMES:
        error = errors(follow(follower, frame), frame)
        assert np.median(error) < 0.03, frame
        assert error.mean() < 0.05, frame


def test_a_person_keeps_the_size_while_being_followed(monkeypatch):
    def spread():
        follower = Tracker(seed=0)
        shapes = [follow(follower, frame).state.shape for frame in FRAMES]
        return np.std(shapes[1:], axis=0).mean()

    remembered = spread()
    monkeypatch.setattr(SizeMemory, "REMEMBERED", 1)
    assert remembered < 0.56 * spread()  # at first it learns, too


def test_a_wrong_size_is_given_up():
    follower = Tracker(seed=0)
    true = follow(follower, 20)
    small = replace(true.state, shape=true.state.shape - np.eye(len(true.state.shape))[0] * 0.25)
    follower._last = small
    follower._sizes = SizeMemory.nothing().with_frame(small, true.system)
    statures = [np.exp(follow(follower, frame).state.shape[0]) for frame in range(21, 33)]
    assert statures[-1] == pytest.approx(np.exp(true.state.shape[0]), rel=0.03)
    assert max(errors(follow(follower, 33), 33)) < 0.1


@pytest.fixture
def sightless(monkeypatch):
    """Limbs are checked without a hull."""
    monkeypatch.setattr(tracker, "make_scene", lambda *args: SimpleNamespace(quick=None, lenient=None))
    monkeypatch.setattr(tracker.Medial, "of", lambda hull: None)
    monkeypatch.setattr(tracker, "unseen", lambda state, hull: 0.0)


@pytest.mark.parametrize(
    ("jump_m", "cost", "gain", "believed"),
    [
        (0.06, 2e-4, 0.04, True),
        (0.06, 2e-4, 0.03, False),  # of 3 % and a fifth as much again
        (0.30, 2e-4, 0.04, False),  # far off: six times as much
        (0.30, 2e-4, 0.20, True),
        (0.06, 3 * Tracker.DOUBTFUL_COST, 0.04, False),  # a ragged hull: three times as much
        (0.06, 3 * Tracker.DOUBTFUL_COST, 0.12, True),
    ],
)
def test_a_limb_must_explain_the_more_the_further_it_jumps_and_the_worse_the_hull_is(
    monkeypatch, sightless, jump_m, cost, gain, believed
):
    here = FigureState.standing([0.0, 0.0, 1.0])
    there = FigureState.standing([jump_m, 0.0, 1.0])
    monkeypatch.setattr(tracker, "with_one_limb", lambda *args: [there])
    found = SimpleNamespace(state=there, system=costing((1.0 - gain) * cost), energy=costing(cost))
    monkeypatch.setattr(tracker, "refine", lambda *args: found)
    followed = SimpleNamespace(state=here, system=costing(cost))
    checked = Tracker(seed=0)._check_limbs([(ARM, "L")], 1, followed, None, None, None, None, 0.0, 0.0)
    assert (checked is found) == believed


def test_no_further_limb_is_looked_for_when_the_energy_is_bearable_again(monkeypatch, sightless):
    here, there = FigureState.standing([0.0, 0.0, 1.0]), FigureState.standing([0.06, 0.0, 1.0])
    monkeypatch.setattr(tracker, "refine", lambda *args: Refined(there, costing(1e-4), costing(1e-4), "converged"))
    for bearable, expected in ((1.01e-4, ["L"]), (0.99e-4, ["L", "R"])):
        asked = []
        monkeypatch.setattr(
            tracker, "with_one_limb", lambda s, scene, kind, side, *args, a=asked: a.append(side) or [there]
        )
        followed = Refined(here, costing(2e-4), costing(2e-4), "converged")
        Tracker(seed=0)._check_limbs([(ARM, "L"), (ARM, "R")], 1, followed, None, None, None, None, 0.0, bearable)
        assert asked == expected


@pytest.mark.parametrize(("ratio", "steps"), [(1.01, 2), (0.99, 3)])
def test_a_limb_of_far_too_high_an_energy_is_given_up_after_some_steps(monkeypatch, sightless, ratio, steps):
    here, there = FigureState.standing([0.0, 0.0, 1.0]), FigureState.standing([0.06, 0.0, 1.0])
    monkeypatch.setattr(tracker, "with_one_limb", lambda *args: [there])
    asked = []

    def refine(state, evidence, weights, iterations, *others):
        asked.append(iterations)
        cost = ratio * Tracker.GIVEN_UP * 2e-4 if len(asked) == 2 else 1e-4
        return Refined(there, costing(cost), costing(cost), "iterations")

    monkeypatch.setattr(tracker, "refine", refine)
    followed = Refined(here, costing(2e-4), costing(2e-4), "converged")
    found = Tracker(seed=0)._check_limbs([(ARM, "L")], 1, followed, None, None, None, None, 0.0, 0.0)
    assert len(asked) == steps
    assert asked[1] == Tracker.FIRST_STEPS
    assert (found is followed) == (ratio > 1)


def test_what_is_published_is_refined_on_more_points(stand):
    stand.run(Tracker(seed=0), 2)
    assert stand.points == [(Tracker.STEPS, Tracker.POINTS), (Tracker.FINAL_STEPS, Tracker.FINAL_POINTS)]


def test_inertia_steadies_the_joints(monkeypatch):
    frames = range(20, 36)
    truth = np.array([truth_of(frame) for frame in frames])

    def jitter():
        follower = Tracker(seed=0)
        joints = np.array([place(follow(follower, frame).state).joints for frame in frames])
        return np.linalg.norm(np.diff(joints - truth, 2, axis=0), axis=2).mean(), np.linalg.norm(joints - truth, axis=2)

    steady, near = jitter()
    monkeypatch.setattr(Tracker, "INERTIA", 0.0)
    loose, near_without = jitter()
    assert steady < 0.95 * loose
    assert np.median(near) < 1.1 * np.median(near_without)


def test_the_tracker_starts_from_the_frame_before_until_it_is_reset():
    follower = Tracker(seed=0)
    alone = follow(follower, 20).state.to_vector()
    followed = follow(follower, 20).state.to_vector()
    assert not np.array_equal(followed, alone)
    follower.reset()
    np.testing.assert_array_equal(follow(follower, 20).state.to_vector(), alone)


def test_the_same_frames_give_the_same_bits():
    runs = []
    for _ in range(2):
        follower = Tracker(seed=3)
        runs.append([follow(follower, frame).state.to_vector() for frame in FRAMES[:3]])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_bones_keep_turning_without_shrinking():
    """A turn that goes on is a product of three rotations, which triples what rounding left of their lengths."""
    follower = Tracker(seed=0)
    back_and_forth = [*FRAMES, *FRAMES[::-1]]
    for frame in 8 * back_and_forth:
        R = follow(follower, frame).state.rotations
    np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-9)


def test_a_jump_is_followed_by_the_centre_of_the_surface():
    follower = Tracker(seed=0)
    follow(follower, 20)
    voxels = np.array([-70, 40, 0])
    hull = moved(hull_of(21), voxels)
    jumped = follower.follow(hull, extract_surface(hull))
    error = np.linalg.norm(place(jumped.state).joints - truth_of(21) - 0.02 * voxels, axis=1)
    assert np.median(error) < 0.03


# an arm that has slipped


def test_an_arm_that_slipped_into_the_trunk_is_found_again(monkeypatch):
    start = follow(Tracker(seed=0), 20)
    placed = place(start.state)
    shoulder, elbow, hand = (placed.origins[BONE[f"{name}_L"]] for name in ARM.bones)
    belly = placed.origins[BONE["abdomen"]]

    def towards(a, b, length):
        return a + length * (b - a) / np.linalg.norm(b - a)

    middle = towards(shoulder, belly, np.linalg.norm(elbow - shoulder))
    end = towards(middle, belly, np.linalg.norm(hand - elbow))
    slipped = with_limb(start.state, placed, ARM, "L", np.concatenate([middle, end, [0.0]]))
    wrist = []
    for checks in (True, False):
        if not checks:
            monkeypatch.setattr(Tracker, "_check_limbs", lambda self, limbs, places, result, *others: result)
        follower = Tracker(seed=0)
        follow(follower, 20)
        follower._last = slipped
        wrist.append(errors(follow(follower, 20), 20)[JOINT["wrist_L"]])
    assert wrist[0] < 0.06
    assert wrist[1] > 0.15


def test_a_limb_that_moves_fast_is_not_lost():
    """Every third frame of a waving person: the hand moves by half a forearm from one to the next."""
    waving = load_case(BENCHMARK / "public/seq_wave")
    carver = Carver(waving.rig)
    frames = range(0, 24, 3)
    wrists = [JOINT["wrist_L"], JOINT["wrist_R"]]
    truth = np.stack([waving.truth[JOINT_NAMES[wrist]] for wrist in wrists], axis=1)[list(frames)]
    assert np.linalg.norm(np.diff(truth, axis=0), axis=2).max() > 0.15
    hulls = [carver.carve(waving.masks(frame)) for frame in frames]
    surfaces = [extract_surface(hull) for hull in hulls]
    lost = 0
    for seed in range(4):
        follower = Tracker(seed=seed)
        joints = [place(follower.follow(*seen).state).joints[wrists] for seen in zip(hulls, surfaces, strict=True)]
        off = np.linalg.norm(np.array(joints) - truth, axis=2).max(axis=1) > 0.10
        assert not (off[1:] & off[:-1]).any()  # a hand that was left behind once is back in the next frame
        lost += off.sum()
    assert lost <= 1


# when a fit is doubted


ALL_LIMBS = ["upper_arm_L", "upper_arm_R", "thigh_L", "thigh_R"]


def costing(cost):
    """The system of an energy of this cost, wherever the figure is."""
    n = 3 + figure.N_DOF + figure.proportions().n_shape
    return System(cost, np.zeros(n), 1e-4 * np.eye(n))


class Stand:
    """Stands in for searches and refinements: hands out figures of the costs that it is told, and counts."""

    def __init__(self, monkeypatch):
        self.scratch_cost, self.costs, self.of_size = 1e-4, {}, {}  # what the known size costs besides
        self.searched, self.refined, self.checked, self.guessed, self.priors = [], [], [], [], []
        self.found, self.cut, self.points = set(), set(), []
        self.frame = 0
        monkeypatch.setattr(tracker, "fit_from_scratch", self.search)
        monkeypatch.setattr(tracker, "refine", self.refine)
        monkeypatch.setattr(tracker, "unseen", lambda state, hull: 0.0)
        monkeypatch.setattr(tracker, "gather_evidence", lambda *args: SimpleNamespace(args=args))
        monkeypatch.setattr(Tracker, "_check_limbs", self.check)
        monkeypatch.setattr(tracker.energy, "system", self.system)

    def search(self, hull, surface, seed, weights, searches, risk_of):
        self.searched.append((self.frame, seed, weights, searches))
        if self.scratch_cost is None:
            return None
        return Fit(FigureState.standing([0.0, 0.0, 1.0]), costing(self.scratch_cost), judged=self.scratch_cost)

    def refine(self, state, evidence, weights, iterations, priors=(), known=None):
        self.points.append((iterations, evidence.args[2]))
        if iterations != Tracker.FINAL_STEPS:
            self.refined.append((self.frame, state, iterations))
        self.priors.append(priors)
        cost = self.costs.get(self.frame, 1e-4)
        settled = FigureState.standing(state.root)
        return Refined(settled, costing(cost + self.of_size.get(self.frame, 0.0)), costing(cost), "iterations")

    def system(self, state, evidence, weights):
        self.guessed.append((self.frame, state))
        return costing(self.costs.get(self.frame, 1e-4))

    def check(self, limbs, places, result, hull, surface, evidence, size, settled_m, bearable):
        hasty = len(limbs) == 4
        assert (settled_m, places) == ((0.0, Tracker.HASTY_PLACES) if hasty else (SETTLED_M, Tracker.PLACES))
        self.checked.append((self.frame, [f"{kind.bones[0]}_{side}" for kind, side in limbs]))
        return replace(result) if self.frame in self.found else result

    def run(self, follower, frames, centres=None):
        costs = []
        for _ in range(frames):
            self.frame += 1
            centre = np.zeros(3) if centres is None else centres[self.frame]
            hull = SimpleNamespace(cut_area_m2=0.1 if self.frame in self.cut else 0.0)
            fit = follower.follow(hull, SimpleNamespace(points=centre + np.array([[1.0, 0, 0], [-1.0, 0, 0]])))
            costs.append(None if fit is None else fit.system.cost)
        return costs

    @property
    def search_frames(self):
        return [frame for frame, *_ in self.searched]


@pytest.fixture
def stand(monkeypatch):
    return Stand(monkeypatch)


def test_calm_frames_are_followed_and_each_limb_checked_now_and_then(stand):
    turn = Tracker.TURN
    stand.run(Tracker(seed=0), 6 * turn)
    assert stand.search_frames == [1]
    assert [frame for frame, *_ in stand.refined] == list(range(2, 6 * turn + 1))
    in_turn = ALL_LIMBS + ALL_LIMBS[:2]
    assert stand.checked == [(turn * n, [limb]) for n, limb in enumerate(in_turn, start=1)]


def test_all_limbs_are_checked_at_once_when_the_cost_rises_and_ever_less_often_in_vain(stand, monkeypatch):
    monkeypatch.setattr(Tracker, "TURN", 99)
    monkeypatch.setattr(Tracker, "_doubts", lambda self, cost, cut: False)
    stand.costs = dict.fromkeys(range(3, 9), 2e-4) | {9: 3.9e-4, 10: 3.9e-4} | dict.fromkeys(range(11, 20), 6e-4)
    stand.run(Tracker(seed=0), 19)
    # at 9 the wait is over; at 11 it is not, but the cost has risen once more
    assert stand.checked == [(frame, ALL_LIMBS) for frame in (3, 5, 9, 11, 19)]
    assert [frame for frame, _, steps in stand.refined if steps == Tracker.MORE_STEPS] == [3, 5, 9, 11, 19]


def test_when_a_limb_was_found_elsewhere_the_next_frame_is_asked_as_well(stand, monkeypatch):
    monkeypatch.setattr(Tracker, "TURN", 99)
    stand.costs = dict.fromkeys(range(3, 9), 2e-4)
    stand.found = {5}
    stand.run(Tracker(seed=0), 8)
    assert [frame for frame, _ in stand.checked] == [3, 5, 6, 8]


def test_what_is_searched_can_be_said(stand):
    searches, weights = (replace(Tracker.SEARCHES[0], torsos=1),), tracker.Weights(surface=2.0)
    stand.run(Tracker(seed=5, weights=weights, searches=searches), 1)
    stand.run(Tracker(seed=6), 1)
    assert stand.searched == [(1, 5, weights, searches), (2, 6, tracker.Weights(), Tracker.SEARCHES)]


def test_the_figure_is_carried_with_the_surface(stand):
    centres = {1: np.zeros(3), 2: np.array([0.05, 0.0, 0.0]), 3: np.array([0.05, 0.2, 0.0])}
    stand.run(Tracker(seed=0), 3, centres)
    (_, near, few), (_, far, many) = stand.refined
    np.testing.assert_allclose(near.root, [0.05, 0.0, 1.0])
    np.testing.assert_allclose(far.root, [0.05, 0.2, 1.0])
    assert few < many  # the further it moved, the longer it takes to settle


@pytest.mark.parametrize(
    ("first", "cost", "searched"),
    [
        (8, 2.0e-4, [1, 9]),  # twice the usual, until that has become usual
        (8, 1.3e-4, [1]),
        (3, 5.0e-4, [1, 9, 25]),  # high, however long; in vain, so the wait doubles
    ],
)
def test_a_doubted_fit_is_searched_anew_but_not_in_every_frame(stand, first, cost, searched):
    stand.costs = dict.fromkeys(range(first, 99), cost)
    follower = Tracker(seed=0)
    stand.run(follower, first - 1)
    stand.scratch_cost = (1.01 - Tracker.BETTER) * cost  # hardly better: the figure that was followed stays
    assert stand.run(follower, 29 - first) == [cost] * (29 - first)
    assert stand.search_frames == searched


def test_what_the_known_size_costs_makes_no_figure_doubtful(stand):
    """It is the energy by which figures are told apart: one of another size explains its hull as well."""
    stand.of_size = dict.fromkeys(range(5, 40), 5e-4)
    assert Tracker.DOUBTFUL_COST < 5e-4
    stand.run(Tracker(seed=0), 39)
    assert stand.search_frames == [1]
    assert all(len(limbs) == 1 for _, limbs in stand.checked)  # those whose turn it is


def test_a_size_is_remembered_by_what_the_hull_says_not_by_what_was_known_before(stand, monkeypatch):
    told, after = [], SizeMemory.after
    monkeypatch.setattr(SizeMemory, "after", lambda self, *args: (told.append(args[2].cost), after(self, *args))[1])
    stand.of_size = {2: 5e-4, 3: 5e-4}
    stand.run(Tracker(seed=0), 3)
    assert told == [1e-4, 1e-4]


def test_sizes_are_known_by_the_weights_of_which_the_frames_energies_are(stand):
    weights = tracker.Weights(proportions=3e-7)
    follower = Tracker(seed=0, weights=weights)
    stand.run(follower, 2)
    rng = np.random.default_rng(0)
    for _ in range(5):  # in one posture all the time the weight would not matter
        follower._sizes = follower._sizes.with_frame(figure_poses.random_state(rng), costing(1e-4))
    memory = follower._sizes
    stand.priors.clear()
    stand.run(follower, 1)
    expected, of_others = memory.known(weights.proportions), memory.known(tracker.Weights().proportions)
    assert np.abs(expected.information - of_others.information).max() > 1e-6
    assert len(stand.priors) == 2  # carried along, and put in its place
    for size, *_ in stand.priors:
        np.testing.assert_array_equal(size.information, expected.information)
        np.testing.assert_array_equal(size.shape, expected.shape)


def test_a_clearly_better_fit_replaces_the_followed_one(stand):
    stand.costs = dict.fromkeys(range(9, 12), 6e-4)
    follower = Tracker(seed=0)
    stand.run(follower, 8)
    stand.scratch_cost = (0.99 - Tracker.BETTER) * 6e-4
    assert follower._sizes.frames == 8
    assert stand.run(follower, 1) == [stand.scratch_cost]
    assert stand.search_frames == [1, 9]
    assert follower._sizes.frames == 1  # the wrong figure's size means nothing


def test_a_figure_found_anew_is_not_carried_on_as_the_wrong_one_turned(stand):
    stand.costs = {9: 6e-4}
    stand.scratch_cost = 1e-4
    follower = Tracker(seed=0)
    stand.run(follower, 11)
    assert stand.search_frames == [1, 9]
    guesses = {frame: [f for f, _ in stand.guessed].count(frame) for frame in range(2, 12)}
    assert guesses == {2: 1} | dict.fromkeys(range(3, 10), 2) | {10: 1, 11: 2}


@pytest.mark.parametrize(("above", "searched"), [(0.999, [1, 9]), (1.001, [1, 9, 25])])
def test_one_odd_frame_hardly_changes_what_is_usual(stand, above, searched):
    usual = 1e-4 * (1 + 0.2 * 0.9**15)  # 3e-4 counted for a tenth, and then fifteen calm frames
    stand.costs = {9: 3e-4, 25: above * Tracker.DOUBT * usual}
    follower = Tracker(seed=0)
    stand.run(follower, 8)
    stand.scratch_cost = None
    stand.run(follower, 17)
    assert stand.search_frames == searched


def test_nobody_and_somebody_again(stand):
    stand.scratch_cost = None
    follower = Tracker(seed=0)
    assert stand.run(follower, 3) == [None] * 3
    assert stand.search_frames == [1, 2, 3]  # nothing to follow: every frame is searched
    stand.scratch_cost = 2e-4
    assert stand.run(follower, 2) == [2e-4, 1e-4]
    assert stand.search_frames == [1, 2, 3, 4]


def test_who_comes_in_is_searched_when_wholly_there(stand):
    stand.cut = set(range(1, 6))
    assert stand.run(Tracker(seed=0), 7) == [None] * 5 + [1e-4] * 2
    assert [(frame, len(searches)) for frame, *_, searches in stand.searched] == [(6, 1)]  # quickly


def test_who_stays_in_the_doorway_is_searched_quickly_and_again_when_whole(stand):
    long = Tracker.DOORWAY
    stand.cut = set(range(1, long + 5))
    stand.scratch_cost = 6.5e-4  # hopeless
    stand.costs = dict.fromkeys(range(1, long + 20), 10e-4)
    costs = stand.run(Tracker(seed=0), long + 6)
    assert [cost is None for cost in costs] == [True] * long + [False] * 6
    searched = [(frame, len(searches)) for frame, *_, searches in stand.searched]
    assert searched == [(long + 1, 1), (long + 5, 1), (long + 6, 1)]


def test_who_was_followed_while_half_outside_is_searched_harder_when_whole(stand):
    """Coming in means that there was nobody before."""
    follower = Tracker(seed=0)
    stand.run(follower, 4)
    stand.costs, stand.cut = dict.fromkeys(range(5, 40), 10e-4), set(range(5, 12))
    stand.scratch_cost = 10e-4  # in vain
    stand.run(follower, 26)
    searched = [(frame, len(searches)) for frame, *_, searches in stand.searched]
    assert searched == [(1, 3), (9, 1), (12, 2)]


def test_who_is_followed_out_of_the_room_stays_followed(stand):
    stand.cut = set(range(5, 9))
    assert None not in stand.run(Tracker(seed=0), 10)


def test_when_all_is_wrong_and_a_search_is_due_no_limb_is_looked_for(stand):
    """Of an energy that no limb explains: the search comes at once, in this frame."""
    hopeless = 1.01 * Tracker.HOPELESS * Tracker.DOUBTFUL_COST
    stand.costs = dict.fromkeys(range(9, 12), hopeless)
    stand.scratch_cost = 0.99 * hopeless  # in vain
    stand.run(Tracker(seed=0), 10)
    assert stand.search_frames == [1, 9]
    assert [frame for frame, limbs in stand.checked if limbs == ALL_LIMBS] == [10]  # while the next search is not due


def test_reset_forgets_everything(stand):
    follower = Tracker(seed=0)
    stand.run(follower, 5)
    follower.reset()
    fresh = Tracker(seed=0)
    assert follower._sizes.frames == fresh._sizes.frames == 0
    plain = vars(fresh).keys() - {"_centre", "_sizes"}
    assert {name: getattr(follower, name) for name in plain} == {name: getattr(fresh, name) for name in plain}
    stand.run(follower, 1)
    assert stand.search_frames == [1, 6]
