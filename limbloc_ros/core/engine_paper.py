# SPDX-License-Identifier: Apache-2.0
"""The `paper` engine: hull -> pose by the paper's own chain (sections 2.1 to 2.5), each frame alone.

What the paper leaves open is settled in the simplest way that works: where a step has several plausible answers
(which sphere is the head, which way the torso faces), the few best are carried on as branches, and the energy of the
posed figure (eq. 2 with constraints 1 to 5) picks the winner.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import anchors as anchor
from limbloc_ros.core import limb_search as limbs
from limbloc_ros.core.anchors import Grid, Head, Limb
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.figure import PART_NAMES, FigureState, place
from limbloc_ros.core.geodesic import Maxima, centre_of_mass, geodesic_map, wide_maxima
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.paper_energy import PaperEnergy, PaperTerms, block_of, stage_of
from limbloc_ros.core.pose import Flesh
from limbloc_ros.core.simplex import SimplexResult
from limbloc_ros.core.surface import Surface, curvature_variability, extract_surface

Array = NDArray[np.float64]

_TORSO_ROWS: list[dict[str, float]] = [
    *({f"root_{axis}": 0.03} for axis in "xyz"),
    *({f"pelvis_{axis}": 0.12} for axis in "xyz"),
    *({f"{bone}_{axis}": 0.06 for bone in ("abdomen", "thorax", "chest")} for axis in "xyz"),
    {"head_x": 0.15},
    {"head_y": 0.15},
    {"shape_0": 0.05},
]
TORSO = block_of("torso", _TORSO_ROWS)
#: Before the limbs are there, only the head tells the size: a torso alone would grow to fill a stout hull.
TORSO_POSE = block_of("torso", _TORSO_ROWS[:-1])
SIZES = block_of("sizes", [{"shape_0": 0.04}, *({f"shape_{k}": 0.7} for k in (1, 2, 3, 4))])


def _limb_rows(kind: str, side: str) -> list[dict[str, float]]:
    if kind == "leg":
        rows = [{f"thigh_{side}_{axis}": 0.15} for axis in "xyz"]
        return [*rows, {f"shin_{side}_y": 0.2}, {f"foot_{side}_x": 0.15}, {f"foot_{side}_y": 0.15}]
    rows = [{f"clavicle_{side}_x": 0.12}, {f"clavicle_{side}_z": 0.12}]
    rows += [{f"upper_arm_{side}_{axis}": 0.2} for axis in "xyz"]
    return [*rows, {f"forearm_{side}_y": 0.25}, {f"hand_{side}_x": 0.2}, {f"hand_{side}_y": 0.2}]


_LIMBS = [(kind, side) for kind in ("leg", "arm") for side in "LR"]
LIMBS = {(kind, side): block_of(f"{kind}_{side}", _limb_rows(kind, side)) for kind, side in _LIMBS}
#: Everything at once, in small steps: 40 parameters, near the paper's 43.
WHOLE = block_of(
    "whole",
    [
        {name: 0.3 * amount for name, amount in row.items()}
        for row in (*_TORSO_ROWS, *(row for kind, side in _LIMBS for row in _limb_rows(kind, side)))
    ],
)
#: A larger hull is no person, and would take long: four heavy people's bodies, three times the largest hull in dresses
#: and before few cameras.
LARGEST_M3 = 0.4
#: A reading whose energy is higher than this is probably wrong: more heads are tried.
DOUBTFUL = 0.36
#: So many pairs of limbs are posed and compared by their energy.
PAIRS = 30
#: How much a limb's gain in the search counts against the energy of the posed figure.
TRUST = 0.2
#: An arm in contact may share this much of the torso's or legs' outermost flesh.
CONTACT_M = 0.05
#: Legs that gain less than this per voxel make other sizes be tried.
POOR = 0.25
WITH_TORSO, WITH_LEGS, WITH_ALL = stage_of(), stage_of("leg"), stage_of("leg", "arm")


@dataclass(frozen=True)
class Description:
    """What section 2.1 computes from a hull: the pictures of figs. 1, 3 and 4.

    Attributes:
        surface: points, normals, curvature.
        centre_of_mass: [3] m.
        geodesic: [N] m, distance over the surface from its point nearest the centre of mass.
        patch_curvature, variability: [N] rad, mean and standard deviation of the curvature over a head-sized patch.
        maxima: wide maxima of the geodesic distance.
    """

    surface: Surface
    centre_of_mass: Array
    geodesic: Array
    patch_curvature: Array
    variability: Array
    maxima: Maxima


@dataclass(frozen=True)
class Branch:
    """One way to read the hull, as far as the fitting sequence has come.

    Attributes:
        head: where it began.
        state: the figure so far.
        energy: the energy that judges it.
        terms: its value, term by term.
        limbs: the anchor points of each limb by `leg_L`, `leg_R`, `arm_L`, `arm_R` (figs. 6 and 7).
        search: how the global refinement ended; None before it.
    """

    head: Head
    state: FigureState
    energy: PaperEnergy
    terms: PaperTerms
    limbs: dict[str, Limb]
    search: SimplexResult | None = None


def describe(hull: Hull) -> Description:
    """Surface, curvature and geodesic map of a hull (section 2.1)."""
    surface = extract_surface(hull)
    geodesic = geodesic_map(hull, surface)
    mean, deviation = curvature_variability(surface, 0.08)
    return Description(surface, centre_of_mass(hull), geodesic, mean, deviation, wide_maxima(surface, geodesic, 0.10))


def fit_state(hull: Hull) -> tuple[Branch, Description] | NoPerson:
    """The fitting sequence: head, torso, legs, arms, then everything at once.

    Args:
        hull: the visual hull of one person, one frame.

    Returns:
        the reading of the hull with the lowest energy and what section 2.1 computes from the hull, or why there is
        none. A poor reading is no error: its energy says so.
    """
    volume = hull.inside_count * hull.voxel_m**3
    if volume > LARGEST_M3:
        return NoPerson(f"the hull's volume is {volume:.2f} m3: expected at most {LARGEST_M3} m3 of a person")
    seen = describe(hull)
    grid = Grid.of(hull)
    heads = anchor.find_heads(grid, seen.surface, seen.patch_curvature, seen.centre_of_mass)
    if not heads:
        return NoPerson("no sphere of a head's size with a torso below it fits into the hull")
    likely = [head for head in heads[:2] if head.explained >= 0.85]
    best = _from_heads(grid, likely, seen)
    if best.terms.total > DOUBTFUL and len(likely) < len(heads):
        best = _best([best, _from_heads(grid, heads[len(likely) :], seen)], 1)[0]
    return _refine_whole(_refine(best)), seen


def _from_heads(grid: Grid, heads: list[Head], seen: Description) -> Branch:
    """The best reading of the hull that starts from one of these heads (sections 2.3 and 2.4)."""
    cues = limbs.cues_of(grid, seen.surface, seen.patch_curvature, seen.maxima)
    branches = [branch for head in heads for branch in _torsos(grid, head, seen)]
    branches = [_add_limbs(grid, branch, "leg", cues) for branch in _best(branches, 6)]
    branches = [_fit_size(grid, branch, cues) for branch in _best(branches, 3)]
    branches = [_add_limbs(grid, branch, "arm", cues) for branch in branches]
    branches = [_refine(branch) for branch in _best(branches, 2)]
    return _best(branches, 1)[0]


def _torsos(grid: Grid, head: Head, seen: Description) -> list[Branch]:
    energy = PaperEnergy(grid.hull, head.radius / anchor.HEAD_RADIUS)
    out = []
    for torso in anchor.find_torsos(grid, head, seen.centre_of_mass, 2):
        state, _ = energy.refine(torso.state, TORSO_POSE, 160, WITH_TORSO)
        out.append(Branch(head, state, energy, energy.terms(state, WITH_TORSO), {}))
    return out


def _fit_size(grid: Grid, branch: Branch, cues: limbs.Cues) -> Branch:
    """Try a smaller and a larger figure too: legs that fit badly tell that the head misled on the size."""
    if branch.limbs and min(limb.gain for limb in branch.limbs.values()) >= POOR:
        return branch
    bare = [replace(branch, state=_resized(branch, scale), limbs={}) for scale in (0.88, 1.1)]
    return min([branch, *(_add_limbs(grid, b, "leg", cues) for b in bare)], key=lambda b: _judged(b, "leg"))


def _resized(branch: Branch, scale: float) -> FigureState:
    """The figure made larger or smaller with the head's centre in place."""
    state = branch.state
    shape = state.shape.copy()
    shape[0] += np.log(scale)
    return FigureState(branch.head.centre + scale * (state.root - branch.head.centre), state.rotations, shape)


def _add_limbs(grid: Grid, branch: Branch, kind: str, cues: limbs.Cues) -> Branch:
    """Find both legs, or both arms, in what torso, or torso and legs, leave of the hull."""
    before, after = (WITH_TORSO, WITH_LEGS) if kind == "leg" else (WITH_LEGS, WITH_ALL)
    names = tuple(PART_NAMES[p] for p in before.parts)
    flesh = anchor.part_of(place(branch.state).flesh(), names)
    free = grid.without(flesh, limbs.PRICE)
    found = {side: limbs.find_limbs(free, branch.state, kind, side, cues) for side in "LR"}
    if kind == "arm":
        found = {side: _with_contact(grid, flesh, branch.state, side, cues, arms) for side, arms in found.items()}
    readings = [replace(branch, terms=branch.energy.terms(branch.state, after))]
    for pair in limbs.best_pairs(free, found["L"], found["R"], branch.state, kind, PAIRS):
        state, points = branch.state, dict(branch.limbs)
        for side, limb in zip("LR", pair, strict=True):
            state = limbs.bend_to(state, kind, side, limb.points)
            points[f"{kind}_{side}"] = limb
        readings.append(replace(branch, state=state, terms=branch.energy.terms(state, after), limbs=points))
    return min(readings, key=lambda b: _judged(b, kind))


def _with_contact(
    grid: Grid, flesh: Flesh, state: FigureState, side: str, cues: limbs.Cues, arms: list[Limb]
) -> list[Limb]:
    """The contact rule (section 2.4): an arm that shows nowhere else is assumed to lie against torso or legs."""
    if arms and arms[0].gain >= limbs.FUSED_BELOW:
        return arms
    touching = limbs.find_limbs(grid.without(flesh, limbs.PRICE, CONTACT_M), state, "arm", side, cues)
    return arms + [replace(limb, fused=True) for limb in touching]


def _judged(branch: Branch, kind: str) -> float:
    """The energy, and what the search says of the limbs: the posed figure only follows the found points roughly."""
    gains = [limb.gain for name, limb in branch.limbs.items() if name.startswith(kind)]
    return branch.terms.total - TRUST * (sum(gains) if gains else -2.0)


def _refine(branch: Branch) -> Branch:
    """Block by block from the trunk to the leaves (section 2.3), then sizes."""
    state = branch.state
    for block, budget in ((TORSO, 150), *((block, 120) for block in LIMBS.values()), (SIZES, 60)):
        state, _result = branch.energy.refine(state, block, budget, WITH_ALL)
    return replace(branch, state=state, terms=branch.energy.terms(state, WITH_ALL))


def _refine_whole(branch: Branch) -> Branch:
    """The global refinement (section 2.5)."""
    state, result = branch.energy.refine(branch.state, WHOLE, 600, WITH_ALL)
    return replace(branch, state=state, terms=branch.energy.terms(state, WITH_ALL), search=result)


def _best(branches: list[Branch], count: int) -> list[Branch]:
    return sorted(branches, key=lambda branch: branch.terms.total)[:count]
