# SPDX-License-Identifier: Apache-2.0
"""The paper's energy: eq. 2 (XOR of hull and flesh figure) and constraints 1 to 5 as penalties (section 2.2).

Constraint 2, same size left and right, is built into the figure: both sides share one shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core import _engine_paper_kernels as kernels
from limbloc_ros.core.energy import HIGH, LOW, PENETRATION_PAIRS, REST_ROTATIONS, SPREAD
from limbloc_ros.core.figure import (
    BONE,
    DOF_AXES,
    DOF_BONES,
    N_BONES,
    N_DOF,
    N_SPHERES,
    PART_NAMES,
    PART_SPHERES,
    SUBTREE,
    FigureState,
    place,
    proportions,
)
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.pose import JOINT, STICK_BONES
from limbloc_ros.core.simplex import SimplexResult, minimise

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

#: Voxels along the edge of a block of neighbours.
_BLOCK = 4
_SPHERE_BONES = proportions().point_bones[:N_SPHERES]


@dataclass(frozen=True)
class PaperWeights:
    """What each term costs, against eq. 2 (a hull that nothing explains costs 1).

    Attributes:
        lengths: constraint 1, per squared standard deviation off the standard proportions and the head's scale.
        inclusion: constraint 3, the "extra-high penalty": all bones wholly outside the hull cost this.
        limits: constraint 4, per squared rad beyond a joint's range.
        posture: constraint 4, per squared standard deviation from the middle of a joint's range; settles what the
            voxels leave open, such as the turn of a straight limb about itself.
        penetration: constraint 5, per metre that parts reach into each other.
    """

    lengths: float = 0.002
    inclusion: float = 0.6
    limits: float = 0.3
    posture: float = 0.0003
    penetration: float = 0.1


@dataclass(frozen=True)
class PaperTerms:
    """The energy of one state, term by term, weights applied; `overlap` is eq. 2."""

    overlap: float
    lengths: float
    inclusion: float
    limits: float
    posture: float
    penetration: float

    @property
    def total(self) -> float:
        """Their sum."""
        return self.overlap + self.lengths + self.inclusion + self.limits + self.posture + self.penetration


@dataclass(frozen=True)
class Stage:
    """How much of the figure exists at one point of the fitting sequence.

    Attributes:
        parts: int64 [M] the flesh parts.
        bones: int64 [N, 2] the bones of the stick figure, as pairs of joints.
    """

    parts: Rows
    bones: Rows


def stage_of(*limbs: str) -> Stage:
    """Head and torso, with `leg`, `arm` or both."""
    missing = {name for kind, names in _LIMB_PARTS.items() if kind not in limbs for name in names}
    absent = {joint for kind, joints in _LIMB_JOINTS.items() if kind not in limbs for joint in joints}
    absent |= {"fingertip", "head_top"}  # they only touch the surface
    parts = [p for p, name in enumerate(PART_NAMES) if name.removesuffix("_L").removesuffix("_R") not in missing]
    bones = [(JOINT[a], JOINT[b]) for a, b in STICK_BONES if b.removesuffix("_L").removesuffix("_R") not in absent]
    return Stage(np.array(parts), np.array(bones))


_LIMB_PARTS = {"leg": ("thigh", "shin", "foot"), "arm": ("upper_arm", "forearm", "hand")}
_LIMB_JOINTS = {"leg": ("knee", "ankle", "heel", "toe"), "arm": ("elbow", "wrist", "hand")}


@dataclass(frozen=True)
class Block:
    """Parameters that are refined together (the branched sequence of section 2.3).

    Attributes:
        name: for reports.
        steps: [n, 3 + D + 1 + K] what one unit of each parameter adds to the step of `FigureState.moved`; one unit is
            the edge of the first simplex.
        parts: [M] the flesh parts that move.
    """

    name: str
    steps: Array
    parts: Rows


class PaperEnergy:
    """Eq. 2 and the constraints for one hull, on a body-centred sublattice with soft edges.

    A quarter of the voxels stands for all of them in and near the hull, and a 32nd in the empty space around it.

    Args:
        hull: the visual hull.
        stature_m: what the head's size says (section 2.3: "a first raw approximation of the skeleton size").
        weights: of the constraints.
    """

    def __init__(self, hull: Hull, stature_m: float, weights: PaperWeights | None = None) -> None:
        self.weights = weights or PaperWeights()
        self.log_stature = float(np.log(stature_m))
        self.sdf, self.voxel_m = np.ascontiguousarray(hull.sdf, dtype=np.float32), hull.voxel_m
        self.origin = (np.asarray(hull.index_min) + 0.5) * hull.voxel_m
        self.width = 1.5 * hull.voxel_m
        close = self.sdf < np.float32(2.0 * hull.voxel_m)
        near = self._sublattice(np.argwhere(close), np.asarray(hull.index_min))
        far = self._sublattice(np.argwhere(~close[::2, ::2, ::2]), np.zeros(3, dtype=np.int64)) * 2
        parts = [self._blocks(near, _BLOCK), self._blocks(far, 3 * _BLOCK)]
        voxels = np.concatenate([part[0] for part in parts])
        self.query = voxels * hull.voxel_m + self.origin
        self.starts = np.concatenate([parts[0][1], parts[1][1][1:] + len(near)])
        self.blocks = np.concatenate([part[2] for part in parts])
        self.worth = np.where(np.arange(len(voxels)) < len(near), 1.0, 8.0)
        values = self.sdf[tuple(voxels.T)].astype(np.float64)
        self.hull_share = np.clip(0.5 - values / self.width, 0.0, 1.0)
        self.nothing = np.full(len(voxels), self.width)

    @staticmethod
    def _sublattice(voxels: Rows, shift: Rows) -> Rows:
        """Those with indices all even or all odd: a quarter of the voxels, as evenly spread as can be."""
        odd = (voxels + shift) & 1
        return np.asarray(voxels[(odd == odd[:, :1]).all(axis=1)], dtype=np.int64)

    def _blocks(self, voxels: Rows, edge: int) -> tuple[Rows, Rows, Array]:
        """Neighbours together, so that the kernel can settle many of them at once: voxels, first rows, spheres."""
        cell = voxels // edge
        order = np.lexsort(cell.T)
        voxels, cell = voxels[order], cell[order]
        fresh = np.append(True, (np.diff(cell, axis=0) != 0).any(axis=1)) if len(cell) else np.zeros(0, dtype=np.bool_)
        starts = np.append(np.flatnonzero(fresh), len(voxels))
        middle = (cell[starts[:-1]] + 0.5) * edge - 0.5
        radius = np.full(len(middle), 0.5 * np.sqrt(3.0) * (edge - 1) * self.voxel_m)
        return voxels, starts, np.column_stack([middle * self.voxel_m + self.origin, radius])

    def known(self, state: FigureState, parts: Rows) -> Array:
        """[Q] distances to `parts`, to be kept while others move."""
        placed = place(state)
        return np.asarray(
            kernels.distance_up_to(
                self.query,
                self.blocks,
                self.starts,
                self.nothing,
                0.5 * self.width,
                PART_SPHERES[parts],
                placed.spheres,
                placed.radii,
            )
        )

    def terms(
        self, state: FigureState, stage: Stage, moving: Rows | None = None, known: Array | None = None
    ) -> PaperTerms:
        """Evaluate the energy.

        Args:
            state: the figure.
            stage: what of it exists.
            moving: the flesh parts to look at, if the distances to all others are `known`.
            known: [Q] distances to the flesh that stays.
        """
        w = self.weights
        placed = place(state)
        flesh = PART_SPHERES[stage.parts if moving is None else moving]
        xor = kernels.soft_xor(
            self.query,
            self.blocks,
            self.starts,
            self.worth,
            self.hull_share,
            self.nothing if known is None else known,
            self.width,
            flesh,
            placed.spheres,
            placed.radii,
        )
        outside = kernels.bones_outside(
            self.sdf,
            self.origin,
            self.voxel_m,
            placed.joints[stage.bones[:, 0]],
            placed.joints[stage.bones[:, 1]],
            2 * self.voxel_m,
        )
        angles = kernels.angles_from_rest(state.rotations, REST_ROTATIONS, DOF_BONES, DOF_AXES)
        beyond = np.maximum(0.0, angles - HIGH) + np.maximum(0.0, LOW - angles)
        scaled = (angles[3:] / SPREAD[3:]) ** 2
        depth = kernels.penetration_depth(PENETRATION_PAIRS, PART_SPHERES, placed.spheres, placed.radii, 0.5)
        size = ((state.shape[0] - self.log_stature) / 0.10) ** 2 + float(state.shape[1:] @ state.shape[1:])
        return PaperTerms(
            overlap=float(xor / max(self.hull_share.sum(), 1.0)),
            lengths=float(w.lengths * size),
            inclusion=w.inclusion * float(outside),
            limits=w.limits * float(beyond @ beyond),
            posture=w.posture * float(scaled.sum()),
            penetration=w.penetration * float(depth),
        )

    def refine(
        self, state: FigureState, block: Block, evaluations: int, stage: Stage
    ) -> tuple[FigureState, SimplexResult]:
        """Minimise over one block with the improved Nelder-Mead (section 2.5).

        Args:
            state: where to start.
            block: what moves.
            evaluations: the budget.
            stage: what of the figure exists.
        """
        moving = np.intersect1d(block.parts, stage.parts)
        known = self.known(state, np.setdiff1d(stage.parts, moving))

        def value(x: Array) -> float:
            return self.terms(state.moved(x @ block.steps), stage, moving, known).total

        result = minimise(
            value,
            np.zeros(len(block.steps)),
            1.0,
            tolerance_x=0.02,
            tolerance_value=1e-4,
            max_evaluations=evaluations,
            max_restarts=2,
        )
        return state.moved(result.x @ block.steps), result


def block_of(name: str, rows: list[dict[str, float]]) -> Block:
    """Build a Block; a row maps `root_x`, `<bone>_<axis>` (rad) or `shape_<k>` to what one unit adds to it."""
    n_shape = proportions().n_shape
    steps = np.zeros((len(rows), 3 + N_DOF + n_shape))
    moved = np.zeros(N_BONES, dtype=np.bool_)
    for r, row in enumerate(rows):
        for key, amount in row.items():
            stem, _, last = key.rpartition("_")
            if stem == "root":
                steps[r, "xyz".index(last)] = amount
                moved[:] = True
            elif stem == "shape":
                steps[r, 3 + N_DOF + int(last)] = amount
                moved[:] = True
            else:
                steps[r, 3 + _dof(stem, "xyz".index(last))] = amount
                moved |= SUBTREE[BONE[stem]]
    parts = np.flatnonzero(moved[_SPHERE_BONES][PART_SPHERES].any(axis=1))
    return Block(name, steps, parts)


def _dof(bone: str, axis: int) -> int:
    matches = np.flatnonzero((BONE[bone] == DOF_BONES) & (DOF_AXES[:, axis] == 1.0))
    return int(matches[0])
