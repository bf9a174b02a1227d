# SPDX-License-Identifier: Apache-2.0
"""Bake many random people of the body model Anny, in the format of the simulated ones, for `fit_flesh.py`.

    pip install anny==0.6.2 torch
    python tools/bake_population.py movable.npz --people 260

Sex, age, muscle, weight, proportions and height are drawn at random, statures are 1.15 m to 2.0 m. Fingers are curled,
for nobody carries them straight: each person's by another amount. Otherwise this is `bake_person.py`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import bake_person
import numpy as np

#: How far the three joints of a finger bend on average, rad.
BEND = np.radians([24.0, 22.0, 12.0])


def drawn(rng: np.random.Generator) -> dict[str, float]:
    """A random phenotype; a fifth of the people each are all male and all female, the others in between."""
    return {
        "gender": float(np.clip(rng.uniform(-0.3, 1.3), 0.0, 1.0)),
        "age": float(rng.uniform(0.34, 1.0)),
        "muscle": float(rng.uniform(0.2, 0.9)),
        "weight": float(rng.uniform(0.15, 0.95)),
        "proportions": float(rng.uniform(0.1, 0.9)),
        "height": float(rng.uniform(0.15, 0.85)),
    }


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """[3, 3] the rotation about an axis by an angle, rad."""
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


def with_curled_fingers(
    source: bake_person.Source, vertices: np.ndarray, heads: np.ndarray, bend: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Rest vertices and bone heads with the fingers of side "L", "R" bent by bend[side] [3] rad, towards the palm."""
    own = np.tile(np.eye(3), (len(source.bones), 1, 1))
    for side in "LR":

        def head(bone: str, side: str = side) -> np.ndarray:
            return np.asarray(heads[source.bones.index(f"{bone}.{side}")])

        along = head("finger3-2") - head("finger3-1")
        palm = np.cross(along, head("finger5-1") - head("finger2-1"))
        palm *= np.sign(palm @ (head("finger1-2") - head("wrist")))  # the thumb lies on the palm's side
        for finger in (2, 3, 4, 5):
            for k in (1, 2, 3):
                after, before = f"finger{finger}-{min(k + 1, 3)}", f"finger{finger}-{min(k, 2)}"
                axis = np.cross(head(after) - head(before), palm)
                own[source.bones.index(f"finger{finger}-{k}.{side}")] = turn(axis, bend[side][k - 1])
    turned, moved = own.copy(), heads.copy()
    for bone, parent in enumerate(source.parents):
        if parent >= 0:
            turned[bone] = turned[parent] @ own[bone]
            moved[bone] = moved[parent] + turned[parent] @ (heads[bone] - heads[parent])
    carriers, weights = source.model.vertex_bone_indices.numpy(), source.model.vertex_bone_weights.numpy()
    skin = np.zeros_like(vertices)
    for bones, share in zip(carriers.T, weights.T.astype(float), strict=True):
        skin += share[:, None] * (np.einsum("vij,vj->vi", turned[bones], vertices - heads[bones]) + moved[bones])
    return skin / weights.sum(axis=1, keepdims=True), moved


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="the .npz file to write")
    parser.add_argument("--people", type=int, default=260)
    parser.add_argument("--seed", type=int, default=77)
    arguments = parser.parse_args()

    rng, fingers = np.random.default_rng(arguments.seed), np.random.default_rng(9)
    small, detailed = bake_person.Source(bake_person.MESH), bake_person.Source(bake_person.DETAILED_MESH)
    detailed_weights = detailed.weights()
    people: dict[str, list[np.ndarray]] = {"vertices": [], "bone_heads": [], "joint_rest": []}
    while len(people["vertices"]) < arguments.people:
        phenotype = drawn(rng)
        rest, heads = small.rest(phenotype)
        if not 1.15 < np.ptp(rest[:, 2]) < 2.0:
            continue
        amount = fingers.uniform(0.3, 1.5)
        bend = {side: BEND * amount * fingers.uniform(0.8, 1.2) for side in "LR"}
        vertices, _ = with_curled_fingers(small, rest, heads, bend)
        skin, bones = with_curled_fingers(detailed, *detailed.rest(phenotype), bend)
        floor = np.array([0.0, 0.0, skin[:, 2].min()])
        joints = bake_person.joints_of(detailed, detailed_weights, skin, bones)
        people["vertices"].append(vertices - floor)
        people["bone_heads"].append(bones[bake_person.kept_bones(detailed)] - floor)
        people["joint_rest"].append(np.array([position for _, position in joints]) - floor)
    bake_person.save(arguments.output, small, joints, people)


if __name__ == "__main__":
    main()
