# SPDX-License-Identifier: Apache-2.0
"""Read exported files with programs that are not ours, and say how far joints lie from the run's.

    pip install "bpy>=4.2,<5.1" c3d "numpy<2"       in an environment of its own: Blender is 300 MB
    python tools/reread_exports.py out/walk out/walk/export

RUN is the folder that `limbloc process` wrote, FILES holds what `limbloc export RUN --format bvh gltf c3d` made of it.
BVH and glTF are imported by Blender with its defaults (z up, y away from the viewer: a quarter turn of our world), C3D
by py-c3d. Of this package only the reader of joints.npz is imported (PYTHONPATH=. is enough).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from limbloc_ros.recordings.npz_file import read_npz

#: Bone -> the joint at which it begins. Blender has none where a chain ends in an end site.
HEADS = {
    "pelvis": "pelvis_centre",
    **{
        f"{bone}_{side}": f"{joint}_{side}"
        for side in "LR"
        for bone, joint in (("upper_arm", "shoulder"), ("forearm", "elbow"), ("hand", "wrist"),
                            ("thigh", "hip"), ("shin", "knee"), ("foot", "ankle"))
    },
}  # fmt: skip


def load_run(run: Path) -> tuple[np.ndarray, list[str], np.ndarray]:
    """Joints [F, 25, 3] m, their names, stamps [F] s."""
    data = read_npz(run / "joints.npz")
    return data["joints"], [str(name) for name in data["joint_names"]], data["stamps"]


def blender_places(path: Path, seconds: np.ndarray) -> np.ndarray:
    """Where Blender has the beginnings of the bones HEADS [F, B, 3] at these times, turned back into our axes."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    import addon_utils  # there only once bpy is

    if path.suffix == ".bvh":
        addon_utils.enable("io_anim_bvh")
        bpy.ops.import_anim.bvh(filepath=str(path), update_scene_fps=True)
        first = 1
    else:
        addon_utils.enable("io_scene_gltf2")
        bpy.ops.import_scene.gltf(filepath=str(path))
        first = 0
    scene = bpy.context.scene
    (armature,) = [thing for thing in bpy.data.objects if thing.type == "ARMATURE"]
    places = []
    for second in seconds:
        frame = first + second * scene.render.fps / scene.render.fps_base
        scene.frame_set(int(frame + 1e-6), subframe=max(0.0, frame - int(frame + 1e-6)))
        bones: Any = armature.pose.bones
        places.append([(armature.matrix_world @ bones[bone].matrix).translation[:] for bone in HEADS])
    x, y, z = np.moveaxis(np.array(places), -1, 0)
    return np.stack([-y, x, z], axis=-1)


def c3d_places(path: Path) -> tuple[list[str], np.ndarray]:
    """Labels, and points [F, P, 3] in m."""
    import c3d

    with path.open("rb") as file:
        reader = c3d.Reader(file)
        labels = [label.strip() for label in reader.point_labels]
        unit = {"mm": 1e-3, "m": 1.0}[reader.get("POINT:UNITS").string_value.strip()]
        return labels, unit * np.array([points[:, :3] for _, points, _ in reader.read_frames()])


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder with joints.npz")
    parser.add_argument("files", type=Path, help="folder with the exported files")
    args = parser.parse_args()
    joints, names, stamps = load_run(args.run)
    wanted = joints[:, [names.index(joint) for joint in HEADS.values()]]
    good = np.isfinite(wanted).all(axis=(1, 2))
    for path in sorted(args.files.iterdir()):
        if path.suffix in (".bvh", ".glb"):
            found = 1000 * np.linalg.norm(blender_places(path, stamps - stamps[0])[good] - wanted[good], axis=-1)
            program = "Blender"
        elif path.suffix == ".c3d":
            labels, places = c3d_places(path)
            ours = joints[:, [names.index(label) for label in labels]]
            found, program = 1000 * np.linalg.norm(places[good] - ours[good], axis=-1), "py-c3d"
        else:
            continue
        print(f"{path.name}: {program}, {found.shape[0]} frames, {found.shape[1]} joints: "
              f"median {np.median(found):.3f} mm, most {found.max():.3f} mm")  # fmt: skip
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
