# SPDX-License-Identifier: Apache-2.0
"""The paper's energy against plain formulas, and the whole chain on benchmark people that the figure did not draw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from limbloc_ros.core.config import HullConfig
from limbloc_ros.core.energy import xor_energy
from limbloc_ros.core.engine_paper import LIMBS, TORSO, WITH_ALL, WITH_LEGS, WITH_TORSO, Branch, fit_state
from limbloc_ros.core.errors import NoPerson
from limbloc_ros.core.figure import PART_NAMES, FigureState, flesh_distance, place
from limbloc_ros.core.hull import Hull, carve
from limbloc_ros.core.paper_energy import PaperEnergy, block_of
from limbloc_ros.core.pose import JOINT
from limbloc_ros.recordings.cases import load_case

PUBLIC = Path(__file__).parent / "data" / "benchmark" / "public"
LIMB13 = ["head_centre"] + [f"{j}_{s}" for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in "LR"]
VOXEL = 0.02


def hull_of(state):
    """The figure's own hull: the right answer is known, its energy should be near zero."""
    flesh = place(state).flesh()
    first = np.floor((flesh.centres.min(axis=0) - 0.25) / VOXEL).astype(int)
    last = np.ceil((flesh.centres.max(axis=0) + 0.25) / VOXEL).astype(int)
    axes = [(np.arange(a, b) + 0.5) * VOXEL for a, b in zip(first, last, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance, _ = flesh_distance(points.reshape(-1, 3), flesh)
    sdf = np.minimum(distance, 0.06).reshape(points.shape[:3]).astype(np.float32)
    return Hull(VOXEL, tuple(int(i) for i in first), sdf, 0.06, (), {})


@pytest.fixture(scope="module")
def standing():
    state = FigureState.standing(np.array([0.1, -0.2, 0.95]), 0.7, 1.7)
    arms_out = block_of("arms", [{"upper_arm_L_x": 0.9, "upper_arm_R_x": -0.9}])
    state = state.moved(arms_out.steps[0])
    return state, hull_of(state)


def test_distances_are_exact_up_to_the_limit(standing):
    state, hull = standing
    energy = PaperEnergy(hull, 1.7)
    distance, _ = flesh_distance(energy.query, place(state).flesh())
    limit = 0.5 * energy.width
    assert energy.known(state, WITH_ALL.parts) == pytest.approx(np.clip(distance, -limit, limit), abs=1e-9)


def test_the_sublattice_measures_eq_2(standing):
    state, hull = standing
    energy = PaperEnergy(hull, 1.7)
    assert energy.terms(state, WITH_ALL).overlap < 0.01
    rng = np.random.default_rng(0)
    for _ in range(3):
        step = np.zeros(TORSO.steps.shape[1])
        step[3 : 3 + 40] = rng.normal(0, 0.10, 40)
        moved = state.moved(step)
        assert energy.terms(moved, WITH_ALL).overlap == pytest.approx(xor_energy(hull, place(moved)), abs=0.04)


def test_what_stays_may_be_kept_while_a_block_moves(standing):
    state, hull = standing
    energy, block = PaperEnergy(hull, 1.7), LIMBS["arm", "L"]
    moved = state.moved(np.full(len(block.steps), 0.8) @ block.steps)
    rest = np.setdiff1d(WITH_ALL.parts, block.parts)
    kept = energy.terms(moved, WITH_ALL, block.parts, energy.known(state, rest))
    assert kept.total == pytest.approx(energy.terms(moved, WITH_ALL).total, abs=1e-12)


def test_each_constraint_has_its_price(standing):
    state, hull = standing
    energy = PaperEnergy(hull, 1.7)
    right = energy.terms(state, WITH_ALL)
    assert right.limits == right.penetration == 0.0 and right.inclusion < 0.01

    def after(name, amount):
        return energy.terms(state.moved(block_of("one", [{name: amount}]).steps[0]), WITH_ALL)

    assert after("shape_1", 3.0).lengths > right.lengths + 0.01
    assert after("root_x", 0.15).inclusion > 0.1
    assert after("shin_L_y", -0.8).limits > 0.1, "a knee does not bend forwards"
    assert after("shin_L_y", 0.8).limits == 0.0
    assert after("thigh_L_x", -0.5).penetration > right.penetration, "the left leg swung into the right one"


def test_stages_hold_what_exists():
    assert {PART_NAMES[p] for p in WITH_LEGS.parts} - {PART_NAMES[p] for p in WITH_TORSO.parts} == {
        f"{part}_{side}" for part in ("thigh", "shin", "foot") for side in "LR"
    }
    assert len(WITH_ALL.parts) == len(PART_NAMES)
    assert (JOINT["hip_L"], JOINT["knee_L"]) in {tuple(bone) for bone in WITH_LEGS.bones.tolist()}
    assert (JOINT["hip_L"], JOINT["knee_L"]) not in {tuple(bone) for bone in WITH_TORSO.bones.tolist()}


def test_refining_a_block_brings_a_displaced_limb_back(standing):
    state, hull = standing
    energy, block = PaperEnergy(hull, 1.7), LIMBS["leg", "R"]
    displaced = state.moved(np.array([0.9, -1.2, 0.0, 1.0, 0.0, 0.0]) @ block.steps)
    refined, result = energy.refine(displaced, block, 400, WITH_ALL)
    before, after = energy.terms(displaced, WITH_ALL).overlap, energy.terms(refined, WITH_ALL).overlap
    assert after < 0.35 * before
    gap = np.linalg.norm(place(refined).joints - place(state).joints, axis=1)
    assert gap[JOINT["knee_R"]] < 0.03 and gap[JOINT["ankle_R"]] < 0.03
    assert result.evaluations <= 420


def median_error(branch: Branch, truth, frame):
    joints = place(branch.state).joints
    return float(np.median([np.linalg.norm(joints[JOINT[name]] - truth[name][frame]) for name in LIMB13]))


@pytest.mark.parametrize(
    ("case", "frame"), [("poses_p_woman_avg", 0), ("poses_p_child_8y", 14)], ids=["a_pose", "kick"]
)
def test_benchmark_people_are_found_within_the_papers_five_centimetres(case, frame):
    data = load_case(PUBLIC / case)
    hull = carve(data.masks(frame), data.rig, HullConfig(voxel_m=0.03))
    assert isinstance(hull, Hull)
    found = fit_state(hull)
    assert not isinstance(found, NoPerson)
    branch, seen = found
    assert median_error(branch, data.truth, frame) < 0.05
    assert branch.terms.overlap < 0.4
    assert branch.search is not None and branch.search.stop in ("converged", "stagnated", "max_evaluations")
    assert set(branch.limbs) == {"leg_L", "leg_R", "arm_L", "arm_R"}
    assert len(seen.geodesic) == len(seen.surface) and np.isfinite(seen.variability).all()


def test_a_hull_without_a_head_and_torso_is_no_person():
    axes = [(np.arange(-10, 10) + 0.5) * VOXEL] * 3
    p = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    sdf = np.minimum(np.linalg.norm(p, axis=-1) - 0.07, 0.06).astype(np.float32)
    assert isinstance(fit_state(Hull(VOXEL, (-10, -10, -10), sdf, 0.06, (), {})), NoPerson)
