# SPDX-License-Identifier: Apache-2.0
"""Score a run on real footage against reference joints of another system.

    python benchmarks/score_real.py OUT/joints.npz reference_joints.npz reference_mediapipe.npz [--fps 60]

Row k of a reference belongs to video frame k, and the stamps of the run (s, from the first frame on) say which frames
it has. Distances are over shoulders, elbows, wrists, hips, knees and ankles; a missing joint counts 1000 mm. Two
systems place these joints by different definitions, some 20 to 40 mm apart: the score is no pure error.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LIMBS = [f"{joint}_{side}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in "LR"]
MISSING_MM = 1000.0


def load_reference(path: Path) -> Array:
    """[F, 12, 3] m, by LIMBS, from OpenPose names (`RKnee`) or MediaPipe names (`RIGHT_KNEE`)."""
    with np.load(path, allow_pickle=False) as archive:
        names = [str(name) for name in archive["names"]]
        joints = archive["xyz_world_m"] if "xyz_world_m" in archive.files else archive["xyz"]
    columns = []
    for limb in LIMBS:
        joint, side = limb.split("_")
        forms = (f"{side}{joint.capitalize()}", f"{'LEFT' if side == 'L' else 'RIGHT'}_{joint.upper()}")
        columns.append(next(names.index(form) for form in forms if form in names))
    return np.asarray(joints[:, columns], dtype=np.float64)


def load_run(path: Path, fps: float) -> tuple[Array, NDArray[np.int64]]:
    """Joints [F, 12, 3] m, by LIMBS, and frame numbers [F]."""
    with np.load(path, allow_pickle=False) as archive:
        names = [str(name) for name in archive["joint_names"]]
        joints = archive["joints"][:, [names.index(limb) for limb in LIMBS]]
        frames = np.round(np.asarray(archive["stamps"]) * fps).astype(np.int64)
    return joints, frames


def swapped(found: Array, truth: Array) -> dict[str, NDArray[np.bool_]]:
    """Frames in which the other side's limb fits clearly better, as the benchmark counts them."""
    result = {}
    for limb, joints in (("arms", ("elbow", "wrist")), ("legs", ("knee", "ankle"))):
        straight, crossed = np.zeros(len(found)), np.zeros(len(found))
        for joint in joints:
            left, right = LIMBS.index(f"{joint}_L"), LIMBS.index(f"{joint}_R")
            for a, b in ((left, right), (right, left)):
                straight += np.linalg.norm(found[:, a] - truth[:, a], axis=-1)
                crossed += np.linalg.norm(found[:, a] - truth[:, b], axis=-1)
        result[limb] = (crossed < 0.6 * straight) & (straight / 4 > 0.10)
    return result


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="joints.npz of `limbloc process`")
    parser.add_argument("references", type=Path, nargs="+")
    parser.add_argument("--fps", type=float, default=60.0, help="frame rate of the videos, Hz")
    parser.add_argument("--per-frame", action="store_true")
    args = parser.parse_args()
    joints, frames = load_run(args.run, args.fps)
    for path in args.references:
        truth = load_reference(path)[frames]
        mm = 1e3 * np.linalg.norm(joints - truth, axis=-1)
        known = np.isfinite(truth).all(axis=-1)  # the reference misses some joints itself
        missing = np.isnan(mm) & known
        mm[missing] = MISSING_MM
        swaps = ", ".join(f"{limb} {int(hit.sum())}" for limb, hit in swapped(joints, truth).items())
        print(f"{path.stem}: {len(mm)} frames, mean {np.nanmean(mm):.0f} mm, median {np.nanmedian(mm):.0f} mm, "
              f"95th percentile {np.nanpercentile(mm, 95):.0f} mm, missing {100 * missing.sum() / known.sum():.1f} %, "
              f"frames with swapped {swaps}")  # fmt: skip
        by_limb, by_frame = np.nanmean(mm, axis=0), np.nanmean(mm, axis=1)
        print("   " + "  ".join(f"{limb} {value:.0f}" for limb, value in zip(LIMBS, by_limb, strict=True)))
        if args.per_frame:
            print("   " + "  ".join(f"{f}: {value:.0f}" for f, value in zip(frames, by_frame, strict=True)))
    step = 1e3 * np.linalg.norm(np.diff(joints, axis=0), axis=-1)
    usual = 1e3 * np.linalg.norm(np.diff(load_reference(args.references[0])[frames], axis=0), axis=-1)
    print(f"largest step of a joint between frames: {np.nanmax(step):.0f} mm (reference {np.nanmax(usual):.0f} mm)")


if __name__ == "__main__":
    main()
