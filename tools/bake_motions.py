# SPDX-License-Identifier: Apache-2.0
"""Bake reference motions of DeepMimic into limbloc_ros/simulation/data/motions.npz.

Run it only to change the clips; the package itself needs nothing but the baked file:

    pip download --no-deps pybullet==3.2.7     # the clips are in its pybullet_data/data/motions
    python tools/bake_motions.py FOLDER_WITH_TXT_FILES limbloc_ros/simulation/data/motions.npz

A clip's frame holds 44 numbers: dt, root position, then unit quaternions (w x y z) of a figure that stands straight
with hanging arms at zero, in axes x forward, y up, z right; knees and elbows are one angle about z. We store every
link's rotation relative to its parent as a quaternion in our axes (x forward, y left, z up), 16 bits a number.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from limbloc_ros.simulation.retarget import LINKS

#: Longer clips are cut here: the person must stay in the room.
MOST_FRAMES = {"punch": 34}

#: Played at this share of their speed: hands and feet of these athletes move at up to 15 m/s.
PACES = {"kick": 0.8, "dance": 0.85, "twirl": 0.65}

CLIPS = {
    "walk": "0walk_forward",
    "dance": "humanoid3d_dance_b",
    "twirl": "humanoid3d_dance_a",
    "kick": "humanoid3d_kick",
    "punch": "humanoid3d_punch",
    "jump": "humanoid3d_jump",
}

# Order and size of the rotations in a frame, after dt and the root position.
SOURCE = [
    ("root", 4), ("chest", 4), ("neck", 4),
    ("hip_R", 4), ("knee_R", 1), ("ankle_R", 4), ("shoulder_R", 4), ("elbow_R", 1),
    ("hip_L", 4), ("knee_L", 1), ("ankle_L", 4), ("shoulder_L", 4), ("elbow_L", 1),
]  # fmt: skip

#: Leg length (hip to ankle) of DeepMimic's figure, m: humanoid.urdf at its scale of 0.25.
SOURCE_LEG_M = (1.686184 + 1.639480) * 0.25


def read_clip(path: Path, most_frames: int | None) -> tuple[float, np.ndarray, np.ndarray]:
    """Frame time s, root positions [F, 3] in leg lengths, link rotations [F, 13, 4]."""
    frames = np.array(json.loads(path.read_text())["Frames"][:most_frames])
    root = np.stack([frames[:, 1], -frames[:, 3], frames[:, 2]], axis=1) / SOURCE_LEG_M
    rotations, column = {}, 4
    for link, size in SOURCE:
        value = frames[:, column : column + size]
        column += size
        if size == 1:
            half, zero = value[:, 0] / 2, np.zeros(len(value))
            value = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)
        q = np.stack([value[:, 0], value[:, 1], -value[:, 3], value[:, 2]], axis=1)
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(1) < 0, -1, 1))
        q[1:] *= flips[:, None]
        rotations[link] = q
    return float(frames[0, 0]), root, np.stack([rotations[link] for link in LINKS], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the folder of DeepMimic's .txt clips")
    parser.add_argument("output", type=Path, help="the .npz file to write")
    args = parser.parse_args()
    clips = [read_clip(args.folder / f"{source}.txt", MOST_FRAMES.get(name)) for name, source in CLIPS.items()]
    np.savez_compressed(
        args.output,
        names=np.array(list(CLIPS)),
        lengths=np.array([len(root) for _, root, _ in clips], dtype=np.int32),
        frame_s=np.array(
            [dt / PACES.get(name, 1.0) for name, (dt, _, _) in zip(CLIPS, clips, strict=True)], dtype=np.float32
        ),
        root=np.concatenate([root for _, root, _ in clips]).astype(np.float32),
        rotations=np.round(np.concatenate([q for _, _, q in clips]) * 32767).astype(np.int16),
    )
    print(f"{args.output}: {args.output.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
