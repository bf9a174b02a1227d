# SPDX-License-Identifier: Apache-2.0
"""The robust engine: hypotheses by exhaustive search, refined by least squares, judged by energy and silhouettes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import energy, figure, lm, search
from limbloc_ros.core.energy import Evidence, Weights
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.limb_pairs import best_limbs, limb_pairs, with_limb
from limbloc_ros.core.priors import Prior
from limbloc_ros.core.search import ARM, LEG, Medial
from limbloc_ros.core.surface import Surface
from limbloc_ros.core.views import Views

Array = NDArray[np.float64]
#: Figures that explain the hull nearly as well as the best of them, each with its energy over that one's.
Rivals = tuple[tuple[FigureState, float], ...]
#: How likely (0 to 1) a figure is wrong, by something that the search does not look at.
RiskOf = Callable[[FigureState], float]


USUAL_TORSOS = search.TorsoSearch()


@dataclass(frozen=True)
class Effort:
    """How much is searched; the defaults are for one frame alone.

    Attributes:
        torsos: torso hypotheses, each tried with both facings.
        torso_search: how they are found.
        leg_pairs: pairs of legs tried on each.
        starts: figures with legs and arms, of all these, that are refined.
        survivors, repaired: of these, so many are refined further, and so many get their limbs looked for again ...
        arm_repairs, leg_repairs: ... with so many other pairs of arms, and of legs and arms.
        strict: so many are refined under strict joint limits.
        single_arms, single_legs, rounds: other places that are tried for each limb of the winner, and how many rounds
            of that at most.
        finalists: so many are refined on all points; the one of lowest energy and mismatch is the result.
        last_arms, last_legs, last_rounds: so many other pairs are tried for the best figure of all searches so far, and
            how many rounds of that at most.
        candidates: places that are weighed for each limb.
        quick_points, points: surface points until then, and then.
        iterations: most steps of the refinements: first, survivors, repairs, under strict limits, final.
        lenient_limits: weight of joint limits at first.
        enough: an energy (m^2) below which the figure is believed and nothing more is searched.
        certain, likely: energies below which the winner's limbs are not tried elsewhere: anyhow, and when there is
            next to no risk that is worth a search.
        shown: whether limbs are placed by what the silhouettes show as well; takes as long again.
        dressed: whether figures may wear loose clothes while they are searched; they begin with those of the last fit.
    """

    torsos: int = 4
    torso_search: search.TorsoSearch = USUAL_TORSOS
    leg_pairs: int = 3
    starts: int = 10
    survivors: int = 4
    repaired: int = 1
    arm_repairs: int = 3
    leg_repairs: int = 1
    strict: int = 4
    single_arms: int = 4
    single_legs: int = 2
    rounds: int = 2
    finalists: int = 2
    last_arms: int = 5
    last_legs: int = 2
    last_rounds: int = 0
    candidates: int = 80
    quick_points: int = 350
    points: int = 1000
    iterations: tuple[int, int, int, int, int] = (3, 5, 6, 4, 12)
    lenient_limits: float = 3e-3
    enough: float = 2.6e-4
    certain: float = 0.0
    likely: float = 0.0
    shown: bool = True
    dressed: bool = False


#: Points and steps of the last refinement of what a search found.
POLISH_POINTS, POLISH_STEPS = 2500, 4
#: While the figure is searched, residuals are believed from further off, it is held in the hull more firmly, and nobody
#: wears loose clothes: with the final weights too many wrong figures explain a hull; these make limbs a little short.
SEARCH_WEIGHTS = {"inclusion": 0.006, "surface_width_m": 0.06, "clothing": 1e-2}
#: Weight of clothing when figures are judged, and when it is searched again.
JUDGED_CLOTHING = 2e-5
#: What figures that share nothing with the silhouettes would pay beside their energy, m^2. Of noisy masks the right
#: figure often has the higher energy (a limb that one mask lost is not in the hull), but hardly ever the higher sum.
SEEN_WEIGHT = 1e-2
#: A figure that is as likely wrong as this is searched for once more, and harder; the limbs of one that is less likely
#: wrong than that are left where they are. (Of 167 figures of an energy below `Effort.likely` and that little risk none
#: was wrong, and one had a joint 10 cm off that trying its limbs elsewhere brought back.)
WORTH_A_SEARCH, CALM = 0.05, 0.003
#: One search after the other, until the energy is low and the figure not doubtful: most are found easily. Of 271 frames
#: the first search ended with an energy below `enough` and little doubt in 221; one of these was wrong.
QUICK = Effort(
    torsos=2, leg_pairs=2, starts=3, survivors=2, arm_repairs=1, strict=2, single_arms=2, single_legs=1, rounds=1,
    finalists=1, candidates=32, enough=2.25e-4, certain=1.2e-4, likely=1.9e-4, shown=False,
)  # fmt: skip
HARDER = Effort(
    torsos=14, torso_search=search.TorsoSearch(headings=12, listed=3000, compared=200, climbed=60, steps=480),
    leg_pairs=4, starts=24, survivors=8, repaired=3, finalists=5, last_rounds=2, enough=0.0, dressed=True,
)  # fmt: skip
SEARCHES = (QUICK, Effort(), HARDER)
#: Torsos of one hull that differ and are worth a try.
MOST_TORSOS = 14
#: A limb that all its joints have so near to where it is is not tried there; nor is one that settles so near.
SAME_PLACE_M, SETTLED_M = 0.05, 0.03
#: Figures of up to so many times the least energy are rivals.
RIVAL_COST = 1.5

ARM_BONES = np.array([figure.BONE[f"{name}_{side}"] for side in "LR" for name in ARM.bones])
_LIMB_BASES = ("upper_arm", "forearm", "hand")
BODY_PARTS = np.array([p for p, name in enumerate(figure.PART_NAMES) if not name.startswith(_LIMB_BASES)])


@dataclass(frozen=True)
class Fit:
    """A fitted figure and how it came about.

    Attributes:
        state: the figure.
        system: energy, gradient and matrix there.
        rivals: figures that explain the hull nearly as well, each with its energy over that of the best of them.
        judged: the energy (m^2) of the figure with the weights by which figures are told apart.
        unseen: what its mismatch with the silhouettes adds to that (m^2) when it is compared with others.
    """

    state: FigureState
    system: lm.System
    rivals: Rivals = ()
    judged: float = 0.0
    unseen: float = 0.0

    @property
    def verdict(self) -> float:
        """By this (m^2) fits of one hull are compared."""
        return self.judged + self.unseen


def gather_evidence(
    hull: Hull, surface: Surface, points: int, rng: np.random.Generator, themselves_every: int = 4
) -> Evidence:
    """An even sample of the surface, every so-many-th point, and the signed distance grid.

    Points come in the order of the grid, in which neighbours follow each other: by such a sample joints shake less from
    frame to frame than by as many points taken at random, by 7 %. Where it begins is the random number generator's.

    The hull holds more than the body, the more so the fewer cameras there are; its surface there is phantom. But each
    of its points lies on a viewing ray along the outline of some silhouette, and that ray touches the body. So every
    `themselves_every`-th point asks to be explained itself, which leads from far off, the others that their ray be.
    """
    count = min(points, len(surface))
    rows = ((np.arange(count) + rng.random()) * (len(surface) / count)).astype(np.int64)
    rays = outline_rays(hull, surface, rows)
    rays[::themselves_every] = 0.0
    weights = np.full(len(rows), 1.0 / len(rows))
    return Evidence(surface.points[rows], surface.normals[rows], rays, weights, hull.sdf, hull.origin_m, hull.voxel_m)


def outline_rays(hull: Hull, surface: Surface, rows: NDArray[np.int64]) -> Array:
    """[Q, 3] unit directions in which the cameras that cut the hull there look at points of its surface; 0: unknown."""
    if hull.cut_by is None:
        return np.zeros((len(rows), 3))
    local = surface.indices[rows] - np.asarray(hull.index_min)
    who = hull.cut_by[local[:, 0], local[:, 1], local[:, 2]].astype(np.int64)
    known = who < len(hull.viewpoints)
    rays = surface.points[rows] - hull.viewpoints[np.where(known, who, 0)].astype(np.float64)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.where(known[:, None], rays, 0.0)


@dataclass(frozen=True)
class Refined:
    """What a refinement found.

    Attributes:
        state: the figure.
        system: of energy and priors there.
        energy: of the energy alone.
        stop: of `lm.LmResult`.
    """

    state: FigureState
    system: lm.System
    energy: lm.System
    stop: str


def refine(
    state: FigureState,
    evidence: Evidence,
    weights: Weights,
    iterations: int,
    priors: Sequence[Prior] = (),
    known: lm.System | None = None,
) -> Refined:
    """Levenberg-Marquardt on all parameters at once; `known` is the energy's system at the state, if it is known."""
    step = np.full(3 + figure.N_DOF + len(state.shape), 0.5)
    step[:3] = 0.1
    step[3 + figure.N_DOF] = 0.1
    step[4 + figure.N_DOF :] = 1.0
    energies: list[tuple[FigureState, lm.System]] = []

    def evaluate(at: FigureState, alone: lm.System | None = None) -> lm.System:
        system = alone or energy.system(at, evidence, weights)
        energies.append((at, system))
        for prior in priors:
            system = system + prior.system(at)
        return system

    found = lm.minimise(
        evaluate,
        lambda s, delta: s.moved(delta),
        state,
        iterations=iterations,
        largest_step=step,
        known=evaluate(state, known),
    )
    alone = next(system for at, system in reversed(energies) if at is found.state)
    return Refined(found.state, found.system, alone, found.stop)


@dataclass(frozen=True)
class Scene:
    """One hull, made ready for the search.

    Attributes:
        hull, medial: the volume.
        views: the silhouettes, if limbs are placed by them as well.
        quick, full: few and many surface points.
        lenient, strict, weights: the energy's weights, at first, for the choice among figures, and in the end. Limbs
            are placed with a guess of their turn about themselves, so joint limits give way until that has settled.
    """

    hull: Hull
    medial: Medial
    views: Views | None
    quick: Evidence
    full: Evidence
    lenient: Weights
    strict: Weights
    weights: Weights


def with_legs(state: FigureState, scene: Scene, pairs: int, candidates: int) -> list[FigureState]:
    """The figure with each of the best pairs of legs."""
    return _with_pairs(state, scene, LEG, search.TRUNK_PARTS, search.UPPER_TRUNK_PARTS, pairs, candidates)


def with_arms(state: FigureState, scene: Scene, pairs: int, candidates: int) -> list[FigureState]:
    """The figure, which has legs, with each of the best pairs of arms."""
    return _with_pairs(state, scene, ARM, BODY_PARTS, BODY_PARTS, pairs, candidates)


def _with_pairs(
    state: FigureState,
    scene: Scene,
    kind: search.LimbKind,
    body: NDArray[np.int64],
    solid: NDArray[np.int64],
    pairs: int,
    candidates: int,
) -> list[FigureState]:
    placed = figure.place(state)
    hull = scene.hull
    taken = search.explained_volume(hull, placed, solid)
    left, right = (search.limb_candidates(hull, scene.medial, placed, kind, side, taken, candidates) for side in "LR")
    out = []
    for a, b, _ in limb_pairs(placed, left, right, kind, body, scene.quick, scene.lenient, pairs, scene.views):
        limbed = with_limb(state, placed, kind, "L", left.found[a])
        out.append(with_limb(limbed, placed, kind, "R", right.found[b]))
    return out or [state]


def with_one_limb(
    state: FigureState, scene: Scene, kind: search.LimbKind, side: str, keep: int, candidates: int
) -> list[FigureState]:
    """The figure with each of the best places for one limb, all others where they are."""
    placed = figure.place(state)
    names = {f"{bone}_{side}" for bone in kind.bones}
    body = np.array([p for p, name in enumerate(figure.PART_NAMES) if name not in names])
    solid = body if kind is ARM else search.UPPER_TRUNK_PARTS
    taken = search.explained_volume(scene.hull, placed, solid)
    limbs = search.limb_candidates(scene.hull, scene.medial, placed, kind, side, taken, candidates)
    rows = best_limbs(placed, limbs, kind, side, body, scene.quick, scene.lenient, keep, scene.views)
    return [with_limb(state, placed, kind, side, limbs.found[row]) for row in rows]


def make_scene(hull: Hull, medial: Medial, surface: Surface, seed: int, weights: Weights, effort: Effort) -> Scene:
    """What the search reads of a hull."""
    rng = np.random.default_rng(seed)
    quick = gather_evidence(hull, surface, effort.quick_points, rng, themselves_every=2)
    full = gather_evidence(hull, surface, effort.points, rng)
    strict = replace(weights, **SEARCH_WEIGHTS)
    lenient = replace(strict, limits=effort.lenient_limits)
    if effort.dressed:
        strict, lenient = _dressed(strict), _dressed(lenient)
    return Scene(hull, medial, hull.views if effort.shown else None, quick, full, lenient, strict, weights)


def fit_from_scratch(
    hull: Hull,
    surface: Surface,
    seed: int,
    weights: Weights | None = None,
    searches: Sequence[Effort] = SEARCHES,
    risk_of: RiskOf | None = None,
) -> Fit | None:
    """Fit one frame alone: torso hypotheses, both facings, limbs, refinement, limb repair.

    Args:
        hull, surface: the frame.
        seed: of where samples of surface points begin, and of the torso search.
        weights: of the energy's terms.
        searches: one is made after the other until one ends with an energy that is low enough for it.
        risk_of: tells how likely a figure of low energy is wrong all the same; then the next search is made.

    Returns:
        the fit of lowest energy and mismatch with the silhouettes, or None when no torso fits into the hull.
    """
    medial = Medial.of(hull)
    torsos: list[FigureState] = []
    best: Fit | None = None
    for n, effort in enumerate(searches):
        if n == 0 or effort.torso_search != searches[n - 1].torso_search:
            torsos = _torsos(hull, medial, seed, effort.torso_search)
        if not torsos:
            break
        scene = make_scene(hull, medial, surface, seed, weights or Weights(), effort)
        some = torsos[: 2 * effort.torsos]
        if best is not None and effort.dressed:
            clothes = best.state.shape[figure.proportions().clothing_from :]
            some = [_wearing(torso, clothes) for torso in some]
        found, rivals, judged = _fit_from_torsos(some, scene, effort, risk_of)
        fit = Fit(found.state, found.system, rivals, judged, unseen(found.state, hull))
        if best is None or fit.verdict < best.verdict:
            best = fit
        # of the energy alone: what silhouettes cost depends on how ragged they are
        last = n + 1 == len(searches)
        if best.judged < effort.enough and (last or risk_of is None or risk_of(best.state) < WORTH_A_SEARCH):
            break
        for _ in range(effort.last_rounds):
            better = _with_other_limbs(best, scene, effort)
            if better is best:
                break
            best = better
    return None if best is None else _polished(best, hull, surface, seed, weights or Weights())


def _polished(fit: Fit, hull: Hull, surface: Surface, seed: int, weights: Weights) -> Fit:
    """The fit on more points: the search does not need that many, but joints lie the better the more there are."""
    evidence = gather_evidence(hull, surface, POLISH_POINTS, np.random.default_rng(seed))
    found = refine(fit.state, evidence, weights, POLISH_STEPS)
    return replace(fit, state=found.state, system=found.system)


def _with_other_limbs(best: Fit, scene: Scene, effort: Effort) -> Fit:
    """The best figure of all searches, or it with another pair of arms or legs: each search has seen other trunks."""
    _, _, repair, _, final = effort.iterations
    others = with_arms(best.state, scene, effort.last_arms, effort.candidates)
    others += with_legs(best.state, scene, effort.last_legs, effort.candidates)
    found = best
    for state in others:
        settled = refine(state, scene.quick, scene.lenient, repair)
        other = refine(settled.state, scene.full, scene.weights, final)
        fit = Fit(other.state, other.system, best.rivals, _judged(other, scene), unseen(other.state, scene.hull))
        if fit.verdict < found.verdict:
            found = fit
    return found


def _torsos(hull: Hull, medial: Medial, seed: int, effort: search.TorsoSearch) -> list[FigureState]:
    """Torso hypotheses, the best first, each with both facings."""
    found = search.torso_hypotheses(hull, medial, np.random.default_rng(seed), MOST_TORSOS, effort)
    return [facing for torso, _ in found for facing in (torso, search.turned_about(torso))]


def _judged(fit: Refined, scene: Scene) -> float:
    return refine(fit.state, scene.full, firm(scene.weights), 3).system.cost


def firm(weights: Weights) -> Weights:
    """The weights by which figures are told apart and followed: those of the search, but clothes may be worn."""
    return _dressed(replace(weights, **SEARCH_WEIGHTS))


def _dressed(weights: Weights) -> Weights:
    return replace(weights, clothing=JUDGED_CLOTHING)


def _wearing(state: FigureState, clothes: Array) -> FigureState:
    shape = state.shape.copy()
    shape[-len(clothes) :] = clothes
    return FigureState(state.root, state.rotations, shape)


def _fit_from_torsos(
    torsos: list[FigureState], scene: Scene, effort: Effort, risk_of: RiskOf | None
) -> tuple[Refined, Rivals, float]:
    """The best figure of one search, its rivals, and the energy by which it is judged."""
    first, second, repair, limited, final = effort.iterations
    quick, lenient = scene.quick, scene.lenient
    starts = _with_limbs(torsos, scene, effort)
    tried = [refine(state, quick, lenient, first) for state in _cheapest(starts, scene, effort.starts)]
    tried = [refine(r.state, quick, lenient, second) for r in _best(tried, effort.survivors, scene.hull)]
    # With the trunk in place and sizes adapted, limbs are looked for once more.
    for candidate in _best(tried, effort.repaired, scene.hull):
        others = with_arms(candidate.state, scene, effort.arm_repairs, effort.candidates)
        others += _cheapest(_with_limbs([candidate.state], scene, effort), scene, effort.leg_repairs)
        tried += [refine(state, quick, lenient, repair) for state in others]
    least = min(r.system.cost for r in tried)
    rivals = tuple((r.state, r.system.cost / least) for r in tried if r.system.cost < RIVAL_COST * least)
    tried = [refine(r.state, quick, scene.strict, limited) for r in _best(tried, effort.strict, scene.hull)]
    finals = [refine(r.state, scene.full, scene.strict, final) for r in _best(tried, effort.finalists, scene.hull)]
    winner = _best(finals, 1, scene.hull)[0]
    winner = refine(winner.state, scene.full, scene.weights, final)
    if effort.certain > 0.0:
        judged = _judged(winner, scene)
        # without views the silhouettes have nothing against any figure
        asked = risk_of if judged < effort.likely and scene.hull.views is not None else None
        if judged < effort.certain or (asked is not None and asked(winner.state) < CALM):
            return winner, rivals, judged
    for _ in range(effort.rounds):
        before = winner.system.cost
        for kind, places in ((ARM, effort.single_arms), (LEG, effort.single_legs)):
            for side in "LR":
                winner = _with_better_limb(winner, scene, kind, side, places, effort)
        if winner.system.cost == before:
            break
    return winner, rivals, _judged(winner, scene)


def _with_better_limb(
    winner: Refined, scene: Scene, kind: search.LimbKind, side: str, places: int, effort: Effort
) -> Refined:
    """The winner, or it with one limb elsewhere if that fits better: trunk and sizes are known by now."""
    _, _, repair, limited, final = effort.iterations
    for state in with_one_limb(winner.state, scene, kind, side, places, effort.candidates):
        if apart_m(state, winner.state) < SAME_PLACE_M:
            continue
        settled = refine(state, scene.quick, scene.lenient, repair).state
        if apart_m(settled, winner.state) < SETTLED_M:
            continue
        other = refine(settled, scene.full, scene.weights, limited)
        if other.system.cost + unseen(other.state, scene.hull) < winner.system.cost + unseen(winner.state, scene.hull):
            winner = refine(other.state, scene.full, scene.weights, final)
    return winner


def apart_m(a: FigureState, b: FigureState) -> float:
    """The largest distance between the same joints of two figures, m."""
    return float(np.linalg.norm(figure.place(a).joints - figure.place(b).joints, axis=1).max())


def _with_limbs(states: list[FigureState], scene: Scene, effort: Effort) -> list[FigureState]:
    """Each state with several pairs of legs, and with the arms that go with the best of them."""
    out = []
    for state in states:
        standing = with_legs(state, scene, effort.leg_pairs, effort.candidates)
        armed = with_arms(standing[0], scene, 1, effort.candidates)[0]
        for legged in standing:
            rotations = legged.rotations.copy()
            rotations[ARM_BONES] = armed.rotations[ARM_BONES]
            out.append(FigureState(legged.root, rotations, legged.shape))
    return out


def _cheapest(states: list[FigureState], scene: Scene, keep: int) -> list[FigureState]:
    costs = [energy.system(state, scene.quick, scene.lenient).cost for state in states]
    return [states[i] for i in np.argsort(costs, kind="stable")[:keep]]


def unseen(state: FigureState, hull: Hull) -> float:
    """What a figure's mismatch with the silhouettes adds to its energy when it is compared with others, m^2."""
    if hull.views is None:
        return 0.0
    placed = figure.place(state)
    return SEEN_WEIGHT * hull.views.mismatch(figure.PART_SPHERES, placed.spheres, placed.radii)


def _best(results: list[Refined], keep: int, hull: Hull) -> list[Refined]:
    return sorted(results, key=lambda r: r.system.cost + unseen(r.state, hull))[:keep]
