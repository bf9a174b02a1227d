# SPDX-License-Identifier: Apache-2.0
"""The searches for head, torso and limbs on a person of capsules, which the figure did not draw."""

from __future__ import annotations

import numpy as np
import pytest

from limbloc_ros.core import _anchors_kernels as kernels
from limbloc_ros.core.anchors import TORSO_PARTS, Grid, Head, find_heads, find_torsos, part_of
from limbloc_ros.core.figure import FigureState, flesh_distance, place
from limbloc_ros.core.geodesic import centre_of_mass, geodesic_map, wide_maxima
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.limb_search import FRUSTUM, bend_to, best_pairs, cues_of, find_limbs
from limbloc_ros.core.pose import JOINT
from limbloc_ros.core.surface import curvature_variability, extract_surface

VOXEL = 0.02
#: A person of 1.75 m who faces +x: left arm out, right arm forward, left knee lifted.
JOINTS = {
    "head": (0.04, 0.0, 1.62),
    "neck": (0.0, 0.0, 1.45),
    "shoulder_L": (0.0, 0.18, 1.39),
    "elbow_L": (0.0, 0.45, 1.37),
    "wrist_L": (0.0, 0.69, 1.37),
    "fingertip_L": (0.0, 0.86, 1.37),
    "shoulder_R": (0.0, -0.18, 1.39),
    "elbow_R": (0.27, -0.20, 1.37),
    "wrist_R": (0.51, -0.20, 1.37),
    "fingertip_R": (0.68, -0.20, 1.37),
    "chest_L": (0.0, 0.09, 1.33),
    "chest_R": (0.0, -0.09, 1.33),
    "hip_L": (0.0, 0.11, 0.93),
    "knee_L": (0.38, 0.13, 0.80),
    "ankle_L": (0.34, 0.13, 0.37),
    "toe_L": (0.53, 0.13, 0.30),
    "hip_R": (0.0, -0.11, 0.93),
    "knee_R": (0.0, -0.12, 0.51),
    "ankle_R": (0.0, -0.12, 0.08),
    "toe_R": (0.19, -0.12, 0.03),
}
CAPSULES = [
    ("head", "head", 0.10, 0.10),
    ("head", "neck", 0.055, 0.06),
    ("shoulder_L", "shoulder_R", 0.06, 0.06),
    ("hip_L", "hip_R", 0.10, 0.10),
    *(
        (f"{a}_{s}", f"{b}_{s}", ra, rb)
        for s in "LR"
        for a, b, ra, rb in (
            ("chest", "hip", 0.11, 0.09),
            ("shoulder", "elbow", 0.05, 0.04),
            ("elbow", "wrist", 0.04, 0.028),
            ("wrist", "fingertip", 0.03, 0.018),
            ("hip", "knee", 0.09, 0.055),
            ("knee", "ankle", 0.055, 0.038),
            ("ankle", "toe", 0.04, 0.028),
        )
    ),
]


def capsule(p, a, b, ra, rb):
    a, b = np.asarray(a), np.asarray(b)
    t = np.clip(((p - a) @ (b - a)) / max(float((b - a) @ (b - a)), 1e-9), 0, 1)
    return np.linalg.norm(p - a - t[..., None] * (b - a), axis=-1) - (ra + t * (rb - ra))


def turned(point, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y, z = point
    return np.array([c * x - s * y + 0.7, s * x + c * y - 0.4, z])


def person(degrees=0.0):
    joints = {name: turned(point, degrees) for name, point in JOINTS.items()}
    points = np.array(list(joints.values()))
    first = np.floor((points.min(axis=0) - 0.2) / VOXEL).astype(int)
    last = np.ceil((points.max(axis=0) + 0.2) / VOXEL).astype(int)
    axes = [(np.arange(a, b) + 0.5) * VOXEL for a, b in zip(first, last, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    sdf = np.min([capsule(grid, joints[a], joints[b], ra, rb) for a, b, ra, rb in CAPSULES], axis=0)
    hull = Hull(VOXEL, tuple(int(i) for i in first), np.minimum(sdf, 0.06).astype(np.float32), 0.06, (), {})
    return hull, joints


@pytest.fixture(scope="module", params=[0.0, 130.0])
def scene(request):
    hull, joints = person(request.param)
    surface = extract_surface(hull)
    mean, _ = curvature_variability(surface, 0.08)
    return hull, joints, surface, mean


def test_the_head_is_the_best_sphere(scene):
    hull, joints, surface, mean = scene
    heads = find_heads(Grid.of(hull), surface, mean, centre_of_mass(hull))
    assert np.linalg.norm(heads[0].centre - joints["head"]) < 0.03
    assert heads[0].radius == pytest.approx(0.10, abs=0.011)
    assert heads[0].explained == 1.0
    assert (np.diff([head.explained for head in heads]) <= 0).all()


def test_the_torso_hangs_where_it_is_and_comes_with_both_facings(scene):
    hull, joints, _, _ = scene
    torsos = find_torsos(Grid.of(hull), Head(joints["head"], 0.10, 1.0), centre_of_mass(hull), 2)
    placed = [place(torso.state).joints for torso in torsos]
    error = [
        np.mean(
            [np.linalg.norm(p[JOINT[name]] - joints[name]) for name in ("shoulder_L", "shoulder_R", "hip_L", "hip_R")]
        )
        for p in placed
    ]
    assert min(error[:2]) < 0.09
    assert max(error[:2]) > 0.2, "the second answer should face the other way"
    assert all(np.linalg.norm(p[JOINT["head_centre"]] - joints["head"]) < 1e-6 for p in placed)


def true_torso(joints, degrees):
    """The figure with its torso where the person's is; limbs hang."""
    state = FigureState.standing(np.zeros(3), np.radians(degrees), 1.75)
    shift = (joints["hip_L"] + joints["hip_R"]) / 2 - place(state).joints[[JOINT["hip_L"], JOINT["hip_R"]]].mean(axis=0)
    return FigureState(state.root + shift, state.rotations, state.shape)


@pytest.mark.parametrize(("kind", "names"), [("leg", ("knee", "ankle")), ("arm", ("elbow", "wrist"))])
@pytest.mark.parametrize("degrees", [0.0, 130.0])
def test_limbs_are_found_on_the_spheres_around_hip_and_shoulder(kind, names, degrees):
    hull, joints = person(degrees)
    surface = extract_surface(hull)
    mean, _ = curvature_variability(surface, 0.08)
    grid = Grid.of(hull)
    cues = cues_of(grid, surface, mean, wide_maxima(surface, geodesic_map(hull, surface), 0.1))
    state = true_torso(joints, degrees)
    explained = TORSO_PARTS
    if kind == "arm":  # the fitting sequence finds legs first
        explained += tuple(f"{part}_{side}" for part in ("thigh", "shin", "foot") for side in "LR")
        for side in "LR":
            state = bend_to(
                state, "leg", side, np.array([joints[f"{name}_{side}"] for name in ("knee", "ankle", "toe")])
            )
    free = grid.without(part_of(place(state).flesh(), explained), 0.3)
    found = {side: find_limbs(free, state, kind, side, cues) for side in "LR"}
    pair = best_pairs(free, found["L"], found["R"], state, kind, 1)[0]
    for side, limb in zip("LR", pair, strict=True):
        assert limb.gain > 0.3
        for n, name in enumerate(names):
            assert np.linalg.norm(limb.points[n] - joints[f"{name}_{side}"]) < 0.09, (name, side)


@pytest.mark.parametrize("kind", ["leg", "arm"])
@pytest.mark.parametrize("side", ["L", "R"])
def test_bending_brings_the_bones_into_the_directions_asked_for(kind, side):
    names = ("hip", "knee", "ankle", "toe") if kind == "leg" else ("shoulder", "elbow", "wrist", "fingertip")
    begin, *wanted = (np.array(JOINTS[f"{name}_{side}"]) for name in names)
    state = FigureState.standing(np.array([0.2, 0.1, 1.0]), 0.4, 1.6)
    start = place(state).joints[JOINT[f"{names[0]}_{side}"]]
    bent = place(bend_to(state, kind, side, np.array(wanted) - begin + start)).joints
    for n in range(2):
        (a, b), (p, q) = names[n : n + 2], (begin, *wanted)[n : n + 2]
        got, asked = bent[JOINT[f"{b}_{side}"]] - bent[JOINT[f"{a}_{side}"]], q - p
        cosine = got @ asked / np.linalg.norm(got) / np.linalg.norm(asked)
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 8.0, (a, b)
    hip = place(state).joints
    assert np.array_equal(bent[JOINT["head_centre"]], hip[JOINT["head_centre"]])


def test_frustum_samples_measure_the_volume_and_skip_what_the_bone_before_claims():
    weight = np.ones((40, 40, 40), dtype=np.float32)
    a, end = np.array([20.0, 20.0, 8.0]), np.array([[20.0, 20.0, 30.0]])
    gain = kernels.frustum_gain(weight, a, 5.0, end, 3.0, FRUSTUM, np.zeros(4), 0.3)[0]
    assert gain == pytest.approx(np.pi * 22 * (25 + 15 + 9) / 3, rel=0.01)
    back = kernels.frustum_gain(weight, a, 5.0, end, 3.0, FRUSTUM, np.array([20.0, 20.0, 38.0, 5.0]), 0.3)[0]
    assert back == pytest.approx(-0.3 * gain, rel=0.05)


def test_cover_frustum_equals_the_capsule_formula():
    voxels = np.argwhere(np.ones((20, 20, 20))).astype(float)
    covered = np.zeros(len(voxels), dtype=bool)
    a, b = np.array([4.0, 5.0, 6.0]), np.array([15.0, 12.0, 10.0])
    kernels.cover_frustum(covered, voxels, a, 4.0, b, 2.0)
    assert np.array_equal(covered, capsule(voxels, a, b, 4.0, 2.0) <= 1e-12)


def test_a_grid_gives_up_what_flesh_explains():
    hull, joints = person()
    grid, flesh = Grid.of(hull), place(true_torso(joints, 0.0)).flesh()
    free = grid.without(flesh, 0.3, contact_m=0.02)
    inside = np.argwhere(hull.sdf < 0)
    distance, _ = flesh_distance(grid.world(inside.astype(float)), flesh)
    values = free.earns[tuple(inside.T)]
    assert (values[distance < -0.02] == np.float32(-0.3)).all()
    assert (values[(distance >= -0.02) & (distance < 0)] == 0).all()
    assert np.array_equal(values[distance >= 0], grid.earns[tuple(inside.T)][distance >= 0])
    assert grid.local(grid.world(np.array([3.0, 4.0, 5.0]))) == pytest.approx([3, 4, 5])
