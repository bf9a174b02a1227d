# SPDX-License-Identifier: Apache-2.0
"""Pairs of limbs: turns of their bones, the choice by brute force, and their energy against that of whole figures."""

import dataclasses
import itertools

import numpy as np
import pytest
from flesh_hulls import POSTURES, person_in

from limbloc_ros.core import _part_kernels, energy, figure, limb_pairs, search
from limbloc_ros.core import _surface_fit_kernels as surface_fit
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.engine_robust import SEARCH_WEIGHTS
from limbloc_ros.core.figure import BONE, place
from limbloc_ros.core.joint_angles import native_angles
from limbloc_ros.core.limb_pairs import kernels, with_limb
from limbloc_ros.core.search import ARM, LEG, Limbs
from limbloc_ros.core.surface import extract_surface

KINDS = pytest.mark.parametrize("kind", [ARM, LEG], ids=["arm", "leg"])


@pytest.fixture(scope="module", params=POSTURES)
def person(request):
    """A posed figure somewhere in the room, its hull and the hull's medial axis."""
    return person_in(request.param)


def unit(vector):
    return vector / np.linalg.norm(vector)


# turns


def turns(upper, lower, parent, rest, sign):
    first, second = np.empty((3, 3)), np.empty((3, 3))
    flexion = kernels.limb_turns(upper, lower, parent, rest, sign, first, second)
    return first, second, flexion


def assert_rotation(R):
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1)


@pytest.mark.parametrize("sign", [-1.0, 1.0], ids=["elbow", "knee"])
def test_bones_lie_along_their_directions_and_flex_about_the_hinge(sign):
    rng = np.random.default_rng(0)
    for _ in range(200):
        upper, lower = unit(rng.normal(size=3)), unit(rng.normal(size=3))
        parent, rest = (figure.kernels.exp_so3(rng.normal(size=3)) for _ in range(2))
        first, second, flexion = turns(upper, lower, parent, rest, sign)
        assert_rotation(first)
        assert_rotation(second)
        assert flexion == pytest.approx(np.arccos(upper @ lower))
        np.testing.assert_allclose(first[:, 2], -upper, atol=1e-12)
        hinge = figure.kernels.log_so3(first.T @ second)
        np.testing.assert_allclose(hinge, [0.0, sign * flexion, 0.0], atol=1e-9)
        bend = np.linalg.norm(np.cross(upper, lower))
        if bend > 0.35 or upper @ lower < 0:  # clearly bent: the hinge is across both bones
            np.testing.assert_allclose(second[:, 2], -lower, atol=1e-9)
            np.testing.assert_allclose(first[:, 1], sign * np.cross(upper, lower) / bend, atol=1e-9)


def test_turns_worked_by_hand():
    down, ahead, back = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])
    # x is ahead, y to the left: forearms bend ahead, shins back, both about y
    first, second, flexion = turns(down, ahead, np.eye(3), np.eye(3), -1.0)
    assert flexion == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(first, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(second, [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-12)
    first, second, _ = turns(down, back, np.eye(3), np.eye(3), 1.0)
    np.testing.assert_allclose(first, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(second, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)
    # a knee that bends the other way is one of a leg turned about
    first, _, _ = turns(down, ahead, np.eye(3), np.eye(3), 1.0)
    np.testing.assert_allclose(first, np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


@pytest.mark.parametrize("sign", [-1.0, 1.0], ids=["elbow", "knee"])
def test_a_straight_limb_gets_the_hinge_of_its_rest(sign):
    rng = np.random.default_rng(1)
    for _ in range(50):
        upper = unit(rng.normal(size=3))
        parent, rest = (figure.kernels.exp_so3(rng.normal(size=3)) for _ in range(2))
        first, second, flexion = turns(upper, upper, parent, rest, sign)
        assert_rotation(first)
        assert flexion == pytest.approx(0.0, abs=1e-7)
        np.testing.assert_allclose(second, first, atol=1e-7)
        y = (parent @ rest)[:, 1]
        np.testing.assert_allclose(first[:, 1], unit(y - (y @ upper) * upper), atol=1e-6)
        # and where that runs along the limb, there still is one
        for along in (y, -y):
            first, second, _ = turns(along, along, parent, rest, sign)
            assert_rotation(first)
            assert_rotation(second)
            np.testing.assert_allclose(first[:, 2], -along, atol=1e-12)


@KINDS
def test_a_limb_is_turned_to_its_candidate(person, kind):
    rng = np.random.default_rng(7)
    for side in "LR":
        first, second, third = (BONE[f"{name}_{side}"] for name in kind.bones)
        base = person.placed.origins[first]
        lengths = [
            np.linalg.norm(person.placed.origins[b] - person.placed.origins[a])
            for a, b in ((first, second), (second, third))
        ]
        for _ in range(10):
            upper, lower = rng.normal(size=(2, 3))
            middle = base + lengths[0] * unit(upper)
            end = middle + lengths[1] * unit(lower)
            turned = with_limb(person.state, person.placed, kind, side, np.concatenate([middle, end, [0.0]]))
            placed = place(turned)
            np.testing.assert_allclose(placed.origins[second], middle, atol=0.012)
            np.testing.assert_allclose(placed.origins[third], end, atol=0.025)
            R = turned.rotations
            np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9)
            others = [b for b in range(figure.N_BONES) if b not in (first, second, third)]
            np.testing.assert_array_equal(R[others], person.state.rotations[others])
            name = ("elbow" if kind is ARM else "knee") + f"_{side}_flexion"
            flexion = native_angles(placed.rotations, shape=turned.shape)[name]
            assert flexion == pytest.approx(np.arccos(unit(upper) @ unit(lower)), abs=1e-6)  # never over-stretched


# the choice by brute force


def random_fits(rng, count, points):
    """Candidates and what each explains: half of the points are nearer to the body."""
    limbs = rng.uniform(0, 1, (count, 7))
    gaps = np.where(rng.random((count, points)) < 0.5, np.inf, rng.uniform(0, 0.1, (count, points)))
    costs = np.where(np.isfinite(gaps), rng.uniform(0, 0.01, (count, points)), 0.0)
    return limbs, gaps, costs, rng.uniform(0, 0.05, count)


def test_best_pairs_by_brute_force():
    rng = np.random.default_rng(3)
    points, weight = 60, 1 / 60
    left, *fit_l = random_fits(rng, 7, points)
    right, *fit_r = random_fits(rng, 9, points)
    right[:3, :6] = left[:3, :6] + 0.01  # both limbs at one place
    left[6, :6] = left[5, :6] + 0.005  # hardly another hypothesis
    body = rng.uniform(0, 0.01, points)
    rows = np.array([0, 2, 1, 5, 6, 3]), np.array([8, 0, 1, 2, 4, 7, 5])
    overlap, price, apart = 0.3, 0.4, 0.2
    expected = []
    for a, b in itertools.product(*rows):
        cost = fit_l[2][a] + fit_r[2][b]
        for q in range(points):
            offers = [(fit_l[0][a, q], fit_l[1][a, q]), (fit_r[0][b, q], fit_r[1][b, q])]
            gap, own = min(offers)
            cost += weight * (own if np.isfinite(gap) else body[q])
        for part in (slice(0, 3), slice(3, 6)):
            cost += price * max(overlap - np.linalg.norm(left[a, part] - right[b, part]), 0.0) ** 2
        expected.append((cost, a, b))
    expected.sort()
    kept = []
    for cost, a, b in expected:
        near = [
            (i, j)
            for _, i, j in kept
            if np.linalg.norm(left[a, 3:6] - left[i, 3:6]) < apart
            and np.linalg.norm(right[b, 3:6] - right[j, 3:6]) < apart
        ]
        if not near:
            kept.append((cost, a, b))
    assert 10 < len(kept) < len(expected)
    for most in (1, 10, 100):
        pairs = kernels.best_pairs(left, right, *fit_l, *fit_r, body, weight, *rows, overlap, price, apart, most)
        assert [(a, b) for a, b, _ in pairs] == [(a, b) for _, a, b in kept[:most]]
        np.testing.assert_allclose(pairs[:, 2], [cost for cost, *_ in kept[:most]], rtol=1e-12)


def test_best_alone_by_brute_force():
    rng = np.random.default_rng(4)
    _, gaps, costs, own = random_fits(rng, 12, 50)
    gaps[5] = np.inf  # explains nothing
    body = rng.uniform(0, 0.01, 50)
    total = own + 0.02 * np.where(np.isfinite(gaps), costs, body).sum(axis=1)
    order = np.argsort(total).tolist()
    assert kernels.best_alone(gaps, costs, own, body, 0.02, 100).tolist() == order
    assert kernels.best_alone(gaps, costs, own, body, 0.02, 5).tolist() == order[:5]


@pytest.mark.parametrize("rays", [False, True], ids=["points", "rays"])
def test_points_are_explained_by_the_nearest_part(rays):
    """Against all parts, asked one by one."""
    rng = np.random.default_rng(14)
    count, surface = 200, np.array([0.06, 0.02, 0.5])
    spheres, radii = rng.uniform(-0.5, 0.5, (12, 3)), rng.uniform(0.02, 0.15, 12)
    parts = np.sort(rng.integers(0, 12, (9, 3)), axis=1)
    query, (normals, directions) = rng.uniform(-0.7, 0.7, (count, 3)), rng.normal(size=(2, count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:: 2 if rays else 1] = 0.0
    within = rng.uniform(0.0, 0.3, count)
    gaps, costs, away = np.empty(count), np.empty(count), np.empty(3)
    scene, scratch = kernels.scene_of(query, normals, directions), np.empty((11, count))
    kernels.explain(scene, query, directions, parts, spheres, radii, surface, within, scratch, gaps, costs)
    rows, _ = _part_kernels.lay_out(parts, spheres, radii)
    for q in range(count):
        point, ray = query[q], directions[q]
        facing = surface_fit.across(normals[q], ray)
        found = [surface_fit.gated_distance(row, *point, ray, *facing, surface[1])[1:] for row in rows]
        p = min(range(len(rows)), key=lambda n: found[n][0])
        gap, wb, wc = found[p]
        if gap >= within[q]:
            assert (gaps[q], costs[q]) == (np.inf, 0.0)
            continue
        w = np.array([1.0 - wb - wc, wb, wc])
        d = surface_fit.offset_from(point, ray, parts[p], w, spheres, radii, away)
        cost = surface_fit.robust_weight(d, surface[0])[0] * (surface[2] if d < 0.0 else 1.0)
        assert (gaps[q], costs[q]) == pytest.approx((gap, cost), abs=1e-12)
    assert 0.2 < np.isfinite(gaps).mean() < 0.8


# the energy of pairs against that of whole figures


def even_evidence(person, count, rng, rays):
    """Points of a person's surface that all weigh the same, three of four asked for along a ray that touches there."""
    surface = extract_surface(person.hull)
    rows = np.sort(rng.permutation(len(surface))[:count])
    directions = np.zeros((count, 3))
    if rays:
        directions = np.cross(surface.normals[rows], rng.normal(size=(count, 3)))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        directions[::4] = 0.0
    weights = np.full(count, 1 / count)
    grid = (person.hull.sdf, person.hull.origin_m, person.hull.voxel_m)
    return Evidence(surface.points[rows], surface.normals[rows], directions, weights, *grid)


def body_without(kind):
    return np.array([p for p, name in enumerate(figure.PART_NAMES) if name[:-2] not in kind.bones])


def random_limbs(person, kind, side, rng, count):
    """Limbs that go down and outward (so that left and right do not meet), and their true one."""
    first, second, third = (BONE[f"{name}_{side}"] for name in kind.bones)
    origins = person.placed.origins
    lengths = np.linalg.norm(np.diff(origins[[first, second, third]], axis=0), axis=1)
    outward = person.placed.rotations[0][:, 1] * (1.0 if side == "L" else -1.0)
    found = np.zeros((count, 7))
    found[0, :6] = origins[[second, third]].ravel()
    for row in found[1:]:
        upper, lower = rng.normal(size=(2, 3)) + 1.2 * outward - np.array([0.0, 0.0, 1.0])
        row[:3] = origins[first] + lengths[0] * unit(upper)
        row[3:6] = row[:3] + lengths[1] * unit(lower)
    return Limbs(origins[first], lengths, found)


@pytest.fixture
def nothing_cut_short(monkeypatch):
    """All points are asked, however far, and all pairs returned."""
    for name, value in (("EXPLAINED_M", 0.0), ("MOST_POINTS", 10**9), ("REACH_M", 1e9), ("APART_M", 0.0)):
        monkeypatch.setattr(limb_pairs, name, value)
    monkeypatch.setattr(limb_pairs, "OVERLAP_M", 0.0)


def costs_of_pairs(person, kind, limbs, evidence, weights):
    """What limb_pairs says of all pairs, and the energies of the figures with those limbs."""
    count = len(limbs[0].found) * len(limbs[1].found)
    pairs = limb_pairs.limb_pairs(person.placed, *limbs, kind, body_without(kind), evidence, weights, count)
    assert len(pairs) == count
    mine = [cost for *_, cost in pairs]
    assert mine == sorted(mine)
    whole = []
    for a, b, _ in pairs:
        state = with_limb(person.state, person.placed, kind, "L", limbs[0].found[a])
        state = with_limb(state, person.placed, kind, "R", limbs[1].found[b])
        whole.append(energy.system(state, evidence, weights).cost)
    return np.array(mine), np.array(whole)


BENT = Weights(**SEARCH_WEIGHTS, penetration=0.0, posture=0.0, limits=0.0, spine=0.0)


@KINDS
@pytest.mark.parametrize("rays", [False, True], ids=["points", "rays"])
def test_pairs_differ_as_whole_figures_do(person, kind, rays, nothing_cut_short):
    """With nothing cut short the energies of two pairs differ by what the whole figures' energies differ."""
    rng = np.random.default_rng(5)
    evidence = even_evidence(person, 300, rng, rays)
    limbs = [random_limbs(person, kind, side, rng, 5) for side in "LR"]
    mine, whole = costs_of_pairs(person, kind, limbs, evidence, BENT)
    assert np.ptp(whole) > 5e-4
    np.testing.assert_allclose(mine - mine[0], whole - whole[0], atol=1e-9 * np.ptp(whole))


def test_an_arm_in_the_trunk_costs_what_it_costs_the_whole_figure(person, nothing_cut_short):
    rng = np.random.default_rng(6)
    evidence = even_evidence(person, 100, rng, False)
    weights = dataclasses.replace(BENT, surface=0.0, inclusion=0.0, penetration=1.0)
    left, right = (random_limbs(person, ARM, side, rng, 4) for side in "LR")
    chest = person.placed.origins[BONE["chest"]]
    for row, aim in zip(left.found[1:], (chest, chest - [0, 0, 0.2], person.placed.origins[0]), strict=True):
        row[3:6] = row[:3] + left.lengths[1] * unit(aim - row[:3])
    mine, whole = costs_of_pairs(person, ARM, (left, right), evidence, weights)
    assert np.ptp(whole) > 1e-4
    np.testing.assert_allclose(mine - mine[0], whole - whole[0], atol=1e-9 * np.ptp(whole))


def test_limits_cost_what_they_cost_the_whole_figure_up_to_a_bound(person, nothing_cut_short):
    rng = np.random.default_rng(7)
    evidence = even_evidence(person, 100, rng, False)
    weights = dataclasses.replace(BENT, surface=0.0, inclusion=0.0, limits=1e-4)
    left, right = (random_limbs(person, ARM, side, rng, 6) for side in "LR")
    right = dataclasses.replace(right, found=right.found[:1])  # its true one
    most = kernels.MOST_FOR_LIMITS
    mine, whole = costs_of_pairs(person, ARM, (left, right), evidence, weights)
    least = energy.system(person.state, evidence, weights).cost
    np.testing.assert_allclose(mine, np.minimum(whole - least, most) + mine[0], atol=1e-9)
    assert mine[0] == pytest.approx(0.0, abs=1e-9)
    assert mine[-1] > 1e-6


def test_limbs_at_one_place_pay(person, monkeypatch):
    """The nearer middles are to each other, and ends, below 6 cm, the more."""
    rng = np.random.default_rng(8)
    evidence = even_evidence(person, 50, rng, False)
    weights = dataclasses.replace(BENT, penetration=3.0)
    left = random_limbs(person, ARM, "L", rng, 1)
    first = person.placed.origins[BONE["upper_arm_R"]]

    def cost(middle_gap, end_gap):
        apart = np.array([middle_gap, 0, 0, 0, end_gap, 0, 0])
        right = dataclasses.replace(left, base=first, found=left.found + apart)
        args = (person.placed, left, right, ARM, body_without(ARM), evidence, weights, 1)
        ((_, _, with_price),) = limb_pairs.limb_pairs(*args)
        with monkeypatch.context() as free:
            free.setattr(limb_pairs, "OVERLAP_M", 0.0)
            ((_, _, without),) = limb_pairs.limb_pairs(*args)
        return with_price - without

    assert cost(0.02, 0.3) == pytest.approx(3.0 * (limb_pairs.OVERLAP_M - 0.02) ** 2)
    assert cost(0.3, 0.05) == pytest.approx(3.0 * 0.01**2)
    assert cost(0.0, 0.03) == pytest.approx(3.0 * (0.06**2 + 0.03**2))
    assert cost(0.061, 0.07) == pytest.approx(0.0, abs=1e-15)


# the choice on hulls made of flesh


@KINDS
def test_the_true_pair_wins(person, kind):
    """Of all candidates of the search, one near the true limbs comes first; so does the truth."""
    rng = np.random.default_rng(9)
    evidence = even_evidence(person, 350, rng, True)
    body = body_without(kind)
    taken = search.explained_volume(person.hull, person.placed, search.UPPER_TRUNK_PARTS if kind is LEG else body)
    limbs, truth = [], []
    for side in "LR":
        found = search.limb_candidates(person.hull, person.medial, person.placed, kind, side, taken, 40)
        _, second, third = (BONE[f"{name}_{side}"] for name in kind.bones)
        truth.append(person.placed.origins[[second, third]].ravel())
        limbs.append(found)
    pairs = limb_pairs.limb_pairs(person.placed, *limbs, kind, body, evidence, Weights(), 3)
    assert len(pairs) == 3
    for side, limb, row in zip("LR", limbs, pairs[0][:2], strict=True):
        middle, end = limb.found[row, :3], limb.found[row, 3:6]
        true = truth["LR".index(side)]
        assert np.linalg.norm(middle - true[:3]) < 0.08, side
        assert np.linalg.norm(end - true[3:]) < 0.12, side
    # pairs are different hypotheses
    for (a, b, _), (i, j, _) in itertools.combinations(pairs, 2):
        ends = [np.linalg.norm(limb.found[m, 3:6] - limb.found[n, 3:6])
                for limb, m, n in zip(limbs, (a, b), (i, j), strict=True)]  # fmt: skip
        assert max(ends) >= limb_pairs.APART_M
    # the truth, or what lies next to it, beats all that the search found, whatever its own score was; next to it, as
    # how the hand is turned is only guessed
    whole = [
        dataclasses.replace(limb, found=np.concatenate([limb.found, [[*true, 99.0]]]))
        for limb, true in zip(limbs, truth, strict=True)
    ]
    a, b, cost = limb_pairs.limb_pairs(person.placed, *whole, kind, body, evidence, Weights(), 1)[0]
    assert len(limbs[0].found) == a or len(limbs[1].found) == b
    for limb, row, true in zip(whole, (a, b), truth, strict=True):
        assert np.abs(limb.found[row, :6] - true).max() < 0.01
    assert cost < pairs[0][2]


def test_pairs_are_the_same_every_time(person):
    rng = np.random.default_rng(10)
    evidence = even_evidence(person, 350, rng, True)
    limbs = [random_limbs(person, ARM, side, rng, 30) for side in "LR"]
    before = person.placed.spheres.copy()
    answers = [
        limb_pairs.limb_pairs(person.placed, *limbs, ARM, body_without(ARM), evidence, Weights(), 5) for _ in range(2)
    ]
    assert answers[0] == answers[1]
    np.testing.assert_array_equal(person.placed.spheres, before)


def test_no_candidates_no_pairs(person):
    rng = np.random.default_rng(11)
    evidence = even_evidence(person, 50, rng, False)
    some = random_limbs(person, ARM, "L", rng, 3)
    nothing = dataclasses.replace(some, found=np.empty((0, 7)))
    for left, right in ((nothing, some), (some, nothing), (nothing, nothing)):
        assert limb_pairs.limb_pairs(person.placed, left, right, ARM, body_without(ARM), evidence, Weights(), 3) == []


def test_nothing_left_to_explain(person, monkeypatch):
    """Where the body explains every point the limbs' own costs decide."""
    monkeypatch.setattr(limb_pairs, "EXPLAINED_M", 1e9)
    rng = np.random.default_rng(12)
    evidence = even_evidence(person, 50, rng, False)
    limbs = [random_limbs(person, ARM, side, rng, 6) for side in "LR"]
    pairs = limb_pairs.limb_pairs(person.placed, *limbs, ARM, body_without(ARM), evidence, Weights(), 1)
    assert pairs[0][:2] == (0, 0)  # the true ones stick out of the hull least


@KINDS
@pytest.mark.parametrize("side", "LR")
def test_one_limb_is_chosen_by_the_energy_of_the_whole_figure(person, kind, side, nothing_cut_short):
    rng = np.random.default_rng(8)
    evidence = even_evidence(person, 300, rng, True)
    limbs = random_limbs(person, kind, side, rng, 12)
    names = {f"{name}_{side}" for name in kind.bones}
    body = np.array([p for p, name in enumerate(figure.PART_NAMES) if name not in names])
    rows = limb_pairs.best_limbs(person.placed, limbs, kind, side, body, evidence, BENT, 12)
    states = [with_limb(person.state, person.placed, kind, side, limb) for limb in limbs.found]
    costs = [energy.system(state, evidence, BENT).cost for state in states]
    assert np.ptp(costs) > 1e-4
    assert rows == np.argsort(costs).tolist()


def test_places_for_one_limb_lie_apart(person):
    rng = np.random.default_rng(9)
    evidence = even_evidence(person, 100, rng, False)
    limbs = random_limbs(person, ARM, "L", rng, 30)
    body = np.arange(figure.N_PARTS)
    rows = limb_pairs.best_limbs(person.placed, limbs, ARM, "L", body, evidence, BENT, 5)
    assert len(rows) == len(set(rows)) == 5
    ends = limbs.found[rows, 3:6]
    gaps = np.linalg.norm(ends[:, None] - ends, axis=2)[np.triu_indices(5, 1)]
    assert gaps.min() >= limb_pairs.APART_M
    none = dataclasses.replace(limbs, found=np.empty((0, 7)))
    assert limb_pairs.best_limbs(person.placed, none, ARM, "L", body, evidence, BENT, 5) == []
