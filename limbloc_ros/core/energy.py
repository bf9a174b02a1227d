# SPDX-License-Identifier: Apache-2.0
"""The energy of a figure in a hull: eq. 2 of the paper, and the smooth terms that a least-squares fit minimises."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _energy_kernels as kernels
from limbloc_ros.core import _figure_kernels as figure_kernels
from limbloc_ros.core import figure
from limbloc_ros.core._figure_topology import PARTS
from limbloc_ros.core._surface_fit_kernels import surface_term
from limbloc_ros.core._xor_kernels import xor_counts
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.lm import System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weights:
    """How much each term counts, and the widths (m) within which a residual is believed.

    The surface term is a mean over points, the others are sums, all in square metres. `x` without a suffix is the
    weight of term x.

    Attributes:
        surface: every point of the hull's surface (or some point of its ray) is explained by the flesh;
            `surface_inside` is how much more a point inside of the flesh counts, `normal_gate_m` by how much a part
            whose surface looks the other way counts as further off.
        inclusion: the flesh stays in the hull (constraint 3), but for `inclusion_slack_m`.
        penetration: limbs stay out of other parts (constraint 5), but for `penetration_allowed` of their radii.
        posture: joints rest in the middle of their ranges (constraint 4).
        limits: joints stay within their ranges.
        spine: the spine bends and twists evenly.
        proportions: sizes are likely ones (constraints 1 and 2).
        clothing: nobody wears loose clothes without need.
    """

    surface: float = 1.0
    surface_width_m: float = 0.03
    surface_inside: float = 2.0
    normal_gate_m: float = 0.10
    inclusion: float = 0.0012
    inclusion_width_m: float = 0.06
    inclusion_slack_m: float = 0.002
    penetration: float = 0.01
    penetration_allowed: float = 0.5
    penetration_width_m: float = 0.06
    posture: float = 2e-7
    limits: float = 2e-2
    spine: float = 2e-4
    proportions: float = 2e-6
    clothing: float = 4e-6


class NearestParts(NamedTuple):
    """What `surface_term` remembers of Q points and a figure of P parts and S spheres; it is written in place.

    Attributes:
        hints: int64 [Q] the part that explained each point.
        least: float32 [Q, P] how near, m, each part is at least, plus the way it had gone when that was found out.
        way: float32 [P] the way, m, that the spheres of each part have gone in all.
        spheres: [S, 3] where they were the last time, m.
        radii: [S] their radii then, m.
    """

    hints: NDArray[np.int64]
    least: NDArray[np.float32]
    way: NDArray[np.float32]
    spheres: Array
    radii: Array

    @staticmethod
    def unknown(points: int, parts: int, spheres: int) -> NearestParts:
        """Of a figure that was never looked at: it was infinitely far away."""
        far_away = np.full((spheres, 3), np.inf)
        least, way = np.zeros((points, parts), np.float32), np.zeros(parts, np.float32)
        return NearestParts(np.full(points, -1), least, way, far_away, np.zeros(spheres))


@dataclass(frozen=True)
class Evidence:
    """What the fit looks at: points of the hull's surface and the signed distance grid.

    Attributes:
        points: [Q, 3] on the hull's surface, m, world.
        normals: [Q, 3] outward.
        rays: [Q, 3] unit direction in which the camera that cut the hull at a point looks at it; zero where the
            point itself is to be explained, not just some point of its ray.
        point_weights: [Q], they sum to 1.
        sdf: float32 [nx, ny, nz], m.
        origin: [3] centre of sdf[0, 0, 0], m, world.
        voxel_m: edge length of a voxel, m.
        nearest: what was found out when the energy was worked out before; saves time only.
    """

    points: Array
    normals: Array
    rays: Array
    point_weights: Array
    sdf: NDArray[np.float32]
    origin: Array
    voxel_m: float
    nearest: NearestParts = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        nothing = NearestParts.unknown(len(self.points), figure.N_PARTS, figure.N_SPHERES)
        object.__setattr__(self, "nearest", nothing)


def _axis_rotation(axis: int, degrees: float) -> Array:
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    return np.asarray(figure_kernels.exp_so3(vector))


# Rest rotations (the middle of each joint's range), then per axis: lowest and highest angle from there, spread; deg.
# The shoulder's middle is an arm held out to the side and a little forward, so that its range is well inside pi.
_RANGES: dict[str, dict[str, tuple[float, float, float]]] = {
    "abdomen": {"x": (-20, 20, 6), "y": (-15, 30, 8), "z": (-20, 20, 7)},
    "thorax": {"x": (-20, 20, 6), "y": (-15, 30, 8), "z": (-20, 20, 7)},
    "chest": {"x": (-20, 20, 6), "y": (-15, 30, 8), "z": (-20, 20, 7)},
    "head": {"x": (-40, 40, 14), "y": (-50, 50, 18), "z": (-70, 70, 25)},
    "clavicle": {"x": (-20, 45, 14), "z": (-30, 30, 10)},
    "upper_arm": {"x": (-95, 105, 45), "y": (-125, 80, 45), "z": (-75, 75, 35)},
    "forearm": {"y": (-150, 3, 60)},
    "hand": {"x": (-60, 60, 18), "y": (-30, 30, 10), "z": (-90, 90, 40)},
    "thigh": {"x": (-50, 60, 18), "y": (-100, 60, 40), "z": (-45, 45, 15)},
    "shin": {"y": (-3, 150, 60)},
    "foot": {"x": (-25, 25, 10), "y": (-35, 50, 18), "z": (-25, 25, 10)},
}
_REST = {
    "upper_arm_L": _axis_rotation(2, -30) @ _axis_rotation(0, 50),
    "upper_arm_R": _axis_rotation(2, 30) @ _axis_rotation(0, -50),
    "thigh_L": _axis_rotation(1, -30),
    "thigh_R": _axis_rotation(1, -30),
}


def _posture_table() -> tuple[Array, Array, Array, Array]:
    rest = np.tile(np.eye(3), (figure.N_BONES, 1, 1))
    low, high, spread = np.full(figure.N_DOF, -np.pi), np.full(figure.N_DOF, np.pi), np.full(figure.N_DOF, 1e3)
    for name, R in _REST.items():
        rest[figure.BONE[name]] = R
    for d in range(figure.N_DOF):
        bone = figure.BONE_NAMES[figure.DOF_BONES[d]]
        if bone == "pelvis":
            continue
        base, side = (bone[:-2], bone[-1]) if bone[-2:] in ("_L", "_R") else (bone, "L")
        axis = "xyz"[int(figure.DOF_AXES[d].argmax())]
        a, b, s = _RANGES[base][axis]
        if side == "R" and axis in "xz":  # the mirror image of a turn about x or z is the opposite turn
            a, b = -b, -a
        low[d], high[d], spread[d] = np.radians([a, b, s])
    return rest, low, high, spread


REST_ROTATIONS, LOW, HIGH, SPREAD = _posture_table()


def _dof(bone: str, axis: int) -> int:
    return next(
        d for d in range(figure.N_DOF) if figure.DOF_BONES[d] == figure.BONE[bone] and figure.DOF_AXES[d, axis] == 1.0
    )


SPINE_PAIRS = np.array(
    [(_dof(a, k), _dof(b, k)) for a, b in (("abdomen", "thorax"), ("thorax", "chest")) for k in range(3)], np.int64
)


def _inclusion_samples() -> tuple[Array, NDArray[np.int64]]:
    """Spheres of the family that each part spans: its corners (once each over all parts) and the middles between."""
    weights: list[tuple[float, float, float]] = []
    parts: list[int] = []
    seen: set[tuple[int, ...]] = set()
    for p, (a, b, c) in enumerate(figure.PART_SPHERES):
        corners = ((1.0, 0.0, 0.0), a, a), ((0.0, 1.0, 0.0), b, b), ((0.0, 0.0, 1.0), c, c)
        middles = ((0.5, 0.5, 0.0), a, b), ((0.0, 0.5, 0.5), b, c), ((0.5, 0.0, 0.5), a, c)
        for w, i, j in (*corners, *middles):
            key = (min(i, j), max(i, j))
            if key in seen or (w[0] == 0.5 and i == j):
                continue
            seen.add(key)
            weights.append(w)
            parts.append(p)
    return np.array(weights), np.array(parts, np.int64)


INCLUSION_SAMPLES, INCLUSION_PARTS = _inclusion_samples()


def _penetration_pairs() -> NDArray[np.int64]:
    """Limb spheres against the parts of trunk, head and the other limbs."""
    trunk = {"pelvis", "belly", "abdomen", "thorax", "chest", "head"}
    arm = ("elbow", "bulge", "wrist", "palm", "knuckles")
    leg = ("thigh_mid", "knee", "calf", "shin_low", "ankle", "ball")
    pairs = []
    for side, other in (("L", "R"), ("R", "L")):
        for p, (part, _) in enumerate(PARTS):
            base = part[:-2] if part[-2:] in ("_L", "_R") else part
            for sphere in arm:
                if (
                    base in trunk
                    or base in ("thigh", "shin")
                    or (part.endswith(other) and base in ("upper_arm", "forearm"))
                ):
                    pairs.append((figure.SPHERE[f"{sphere}_{side}"], p))
            for sphere in leg:
                if (part.endswith(other) and base in ("thigh", "shin", "foot")) or (
                    base in ("abdomen", "belly", "thorax", "chest") and sphere in ("knee", "calf")
                ):
                    pairs.append((figure.SPHERE[f"{sphere}_{side}"], p))
    return np.array(pairs, np.int64)


PENETRATION_PAIRS = _penetration_pairs()


def system(state: FigureState, evidence: Evidence, weights: Weights) -> System:
    """Cost, gradient and Gauss-Newton matrix of the smooth energy at a state.

    The terms are those of `Weights`.
    """
    table = figure.proportions()
    points = (
        table.point_bones[: figure.N_SPHERES],
        table.point_offsets[: figure.N_SPHERES],
        table.point_radii[: figure.N_SPHERES],
    )
    origins, world, spheres, radii = figure_kernels.forward(
        state.root, state.rotations, state.shape, figure.PARENTS, table.bone_offsets, *points
    )
    J = figure_kernels.jacobian(
        origins,
        world,
        spheres,
        radii,
        state.shape,
        figure.PARENTS,
        table.bone_offsets,
        *points,
        figure.DOF_BONES,
        figure.DOF_AXES,
        figure.SUBTREE,
    )
    n = J.shape[2]
    A, g = np.zeros((n, n)), np.zeros(n)
    blocks, slopes = np.zeros((figure.N_PARTS, 12, 12)), np.zeros((figure.N_PARTS, 12))
    flesh = (figure.PART_SPHERES, spheres, radii)
    w = weights
    cost = surface_term(
        evidence.points,
        evidence.normals,
        evidence.rays,
        w.surface * evidence.point_weights,
        *evidence.nearest,
        *flesh,
        w.surface_width_m,
        w.normal_gate_m,
        w.surface_inside,
        blocks,
        slopes,
    )
    cost += kernels.inclusion_term(
        INCLUSION_SAMPLES,
        INCLUSION_PARTS,
        *flesh,
        evidence.sdf,
        evidence.origin,
        evidence.voxel_m,
        w.inclusion_slack_m,
        w.inclusion_width_m,
        w.inclusion,
        blocks,
        slopes,
    )
    kernels.gather(blocks, slopes, figure.PART_SPHERES, J, A, g)
    cost += kernels.penetration_term(
        PENETRATION_PAIRS, *flesh, J, w.penetration_allowed, w.penetration_width_m, w.penetration, A, g
    )
    cost += kernels.posture_term(
        state.rotations,
        state.shape,
        figure.DOF_BONES,
        figure.DOF_AXES,
        REST_ROTATIONS,
        LOW,
        HIGH,
        SPREAD,
        w.posture,
        w.limits,
        SPINE_PAIRS,
        w.spine,
        w.proportions,
        w.clothing,
        table.clothing_from,
        table.log_stature_mean,
        table.log_stature_std,
        A,
        g,
    )
    return System(float(cost), g, A)


def xor_energy(hull: Hull, placed: figure.Placed) -> float:
    """Eq. 2: voxels in exactly one of hull and flesh, over voxels of the hull."""
    hull_only, flesh_only, inside = xor_counts(
        hull.sdf, hull.origin_m, hull.voxel_m, figure.PART_SPHERES, placed.spheres, placed.radii
    )
    return float((hull_only + flesh_only) / max(inside, 1))
