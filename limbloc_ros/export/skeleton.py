# SPDX-License-Identifier: Apache-2.0
"""A clip -> a moving skeleton: nodes with parents, each with a rotation and a place in its parent.

The figure's 19 bones are the nodes, with five tips (top of the head, fingertips, toes) behind them. The axes are those
of animation files: y up, z forward, x to the person's left, a cyclic change of the world's axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.core.figure import BONE, BONE_NAMES, N_BONES, N_SPHERES, PARENTS, FigureState, proportions
from limbloc_ros.core.pose import JOINT
from limbloc_ros.export.clip import Clip

Array = NDArray[np.float64]

#: p_file = Y_UP @ p_world.
Y_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])

LENGTHS = ("auto", "frame", "person")
#: Lengths that change by less over a clip count as constant, m.
STEADY_M = 0.0005

#: The published joint at the end of a bone that has no child.
TIPS = {"head": "head_top"} | {
    f"{bone}_{side}": f"{joint}_{side}" for bone, joint in (("hand", "fingertip"), ("foot", "toe")) for side in "LR"
}
#: The published joint at the origin of a bone.
ORIGINS = {"pelvis": "pelvis_centre", "head": "neck_base"} | {
    f"{bone}_{side}": f"{joint}_{side}"
    for bone, joint in (
        ("upper_arm", "shoulder"),
        ("forearm", "elbow"),
        ("hand", "wrist"),
        ("thigh", "hip"),
        ("shin", "knee"),
        ("foot", "ankle"),
    )
    for side in "LR"
}


@dataclass(frozen=True)
class Skeleton:
    """A skeleton that moves over F frames; axes y up, z forward, lengths in metres.

    Attributes:
        names: N names, the bones in the figure's order, then the tips (named like their joints).
        parents: [N] index of the parent, -1 for the root.
        rest: [N, 3] each node in its parent, for the person of median size; the root's is its place in the first frame.
        places: [F, N, 3] each node in its parent; constant but for the root unless `stretches`.
        rotations: [F, N, 3, 3] of each node in its parent; the tips' are the identity.
        rate_hz: frames a second.
        stretches: lengths follow the fit of each frame.
        shape: `FigureState.shape` of the person of median size.
    """

    names: tuple[str, ...]
    parents: NDArray[np.int64]
    rest: Array
    places: Array
    rotations: Array
    rate_hz: float
    stretches: bool
    shape: Array

    @property
    def joint_of(self) -> dict[str, str]:
        """The published joint at each node that has one."""
        return ORIGINS | {name: name for name in self.names[N_BONES:]}

    def world(self) -> tuple[Array, Array]:
        """Forward kinematics: places [F, N, 3] and rotations [F, N, 3, 3] of all nodes in the file's axes."""
        at, turned = self.places.copy(), self.rotations.copy()
        for node, parent in enumerate(self.parents):
            if parent >= 0:
                at[:, node] = at[:, parent] + np.einsum("fij,fj->fi", turned[:, parent], self.places[:, node])
                turned[:, node] = turned[:, parent] @ self.rotations[:, node]
        return at, turned

    def deviation_m(self, clip: Clip) -> Array:
        """[F, J] how far the nodes lie from the published joints of the same frame; NaN in empty rows."""
        joints = clip.joints @ Y_UP.T
        at, _ = self.world()
        nodes = self.joint_of
        pairs = [(self.names.index(node), JOINT[joint]) for node, joint in nodes.items()]
        here, there = (list(side) for side in zip(*pairs, strict=True))
        return np.asarray(np.linalg.norm(at[:, here] - joints[:, there], axis=2))


def skeleton_of(clip: Clip, lengths: str = "auto") -> Skeleton:
    """The clip's figure as a skeleton.

    Args:
        clip: frames at an even rate; an empty row repeats the pose before it.
        lengths: `frame`: every frame has the lengths that were fitted to it, so that joints lie where they were found;
            `person`: the person's median lengths throughout; `auto`: `frame` unless they hardly change.

    Raises:
        ConfigError: an unknown choice of lengths.
        InputError: the run was made by a version with another figure.
    """
    if lengths not in LENGTHS:
        raise ConfigError(f"lengths: expected one of {', '.join(LENGTHS)}, got {lengths!r}")
    states = clip.states()
    shapes = np.array([state.shape for state in states])
    shape = np.median(shapes, axis=0)
    rest = _offsets(shape)
    fitted = np.array([_offsets(s) for s in shapes])
    stretches = lengths == "frame" or (lengths == "auto" and float(np.abs(fitted - rest).max()) > STEADY_M)
    places = fitted if stretches else np.tile(rest, (len(states), 1, 1))
    places[:, 0] = [state.root for state in states]
    rotations = np.tile(np.eye(3), (len(states), len(rest), 1, 1))
    rotations[:, :N_BONES] = [state.rotations for state in states]
    rest[0] = states[0].root
    return Skeleton(
        names=(*BONE_NAMES, *TIPS.values()),
        parents=np.concatenate([PARENTS, [BONE[bone] for bone in TIPS]]),
        rest=rest @ Y_UP.T,
        places=places @ Y_UP.T,
        rotations=Y_UP @ rotations @ Y_UP.T,
        rate_hz=clip.rate_hz,
        stretches=stretches,
        shape=shape,
    )


def rest_state(shape: Array) -> FigureState:
    """The figure that a skeleton of this shape is at rest: straight, hanging arms, pelvis in the origin."""
    return FigureState(np.zeros(3), np.tile(np.eye(3), (N_BONES, 1, 1)), shape)


def _offsets(shape: Array) -> Array:
    """[N, 3] each node in its parent, m, world axes (`core.figure.Proportions` says how sizes follow from shape)."""
    table = proportions()
    weights = np.concatenate([[1.0], shape[1:]])
    tips = table.point_offsets[[N_SPHERES + JOINT[joint] for joint in TIPS.values()]]
    return np.asarray(np.exp(shape[0]) * np.concatenate([table.bone_offsets @ weights, tips @ weights]))
