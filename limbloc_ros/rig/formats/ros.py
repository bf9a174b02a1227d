# SPDX-License-Identifier: Apache-2.0
"""ROS: one `ost.yaml` of camera_calibration per camera, and the cameras' poses from static transforms.

Transforms are metres; a child's pose in its parent, as TF has it. An optical frame looks along z with x right and y
down (REP-103), a camera body's frame looks along x with z up.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import RigError
from limbloc_ros.files import write_text
from limbloc_ros.rig.formats.common import CAMERA_TO_WORLD, Format, FoundCamera, Reading, row
from limbloc_ros.rig.geometry import inverse
from limbloc_ros.rig.plain_values import kind, numbers, read_text, read_values, required, yaml_values
from limbloc_ros.rig.rig_file import MODEL_ALIASES

Array = NDArray[np.float64]

#: (parent frame, child frame) -> T_parent_child [4, 4], m.
Transforms = dict[tuple[str, str], Array]

#: From a camera body's axes (x forward, y left, z up) to the optical ones.
BODY_TO_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

#: Names that camera_calibration gives every camera, so they tell nothing.
_NAMELESS = ("narrow_stereo", "camera", "head_camera", "")


def read(paths: Sequence[Path]) -> Reading:
    """Read the intrinsics of each camera; poses are added by `with_poses`."""
    cameras = tuple(_camera(path) for path in paths)
    return Reading(", ".join(map(str, paths)), cameras, CAMERA_TO_WORLD, 1.0, "room")


def _camera(path: Path) -> FoundCamera:
    data = read_values(path, "camera calibration", "the ost.yaml in it")
    if not isinstance(data, Mapping):
        raise RigError(f"{path}: expected image_width, camera_matrix, ..., got {kind(data)}")
    name = str(data.get("camera_name", ""))
    if name.split("/")[0] in _NAMELESS:
        name = path.parent.name if path.stem == "ost" else path.stem
    K = _matrix(data, "camera_matrix", (3, 3), path)
    distortion = _matrix(data, "distortion_coefficients", None, path)
    said = str(data.get("distortion_model", "plumb_bob"))
    model = MODEL_ALIASES.get(said, said)
    if not distortion.any():
        distortion, model = np.zeros(0), "none"
    size = tuple(int(numbers([required(data, key, str(path))], (1,), f"{path}: key {key}")[0])
                 for key in ("image_width", "image_height"))  # fmt: skip
    return FoundCamera(name, (size[0], size[1]), K, distortion, model, None)


def _matrix(data: Mapping[str, Any], key: str, shape: tuple[int, ...] | None, path: Path) -> Array:
    entry = required(data, key, str(path))
    values = entry.get("data") if isinstance(entry, Mapping) else entry
    return numbers(values, shape, f"{path}: key {key}")


def read_transforms(path: Path) -> Transforms:
    """Static transforms out of a text file.

    Understood are what `ros2 topic echo /tf_static` prints (YAML with `transforms`), a YAML list of such transforms,
    and lines of `static_transform_publisher` with its old or its new arguments.

    Raises:
        RigError: nothing of the kind, or a damaged one.
    """
    text = read_text(path, "transforms", "the YAML in it")
    commands = [line for line in text.splitlines() if "static_transform_publisher" in line and not line.startswith("#")]
    if commands:
        return dict(_from_command(line, str(path)) for line in commands)
    try:
        documents = [d for d in yaml_values(text, several=True) if d is not None]
    except ValueError as error:
        raise RigError(f"transforms {path}{error}") from None
    entries: list[Any] = []
    for document in documents:
        listed = document.get("transforms", document) if isinstance(document, Mapping) else document
        entries += listed if isinstance(listed, list) else [listed]
    found = dict(_from_entry(entry, f"{path}: transform {i}") for i, entry in enumerate(entries))
    if not found:
        raise RigError(f"transforms {path}: expected transforms with header.frame_id, child_frame_id, found none")
    return found


def _from_entry(entry: Any, at: str) -> tuple[tuple[str, str], Array]:
    if not isinstance(entry, Mapping):
        raise RigError(f"{at}: expected header, child_frame_id and transform, got {kind(entry)}")
    header = entry.get("header", entry)
    pose = required(entry, "transform", at)
    t, q = (required(pose, key, f"{at}: key transform") for key in ("translation", "rotation"))
    return (_frame(required(header, "frame_id", at)), _frame(required(entry, "child_frame_id", at))), transform(
        numbers([required(t, axis, f"{at}: translation") for axis in "xyz"], (3,), f"{at}: translation"),
        numbers([required(q, axis, f"{at}: rotation") for axis in "xyzw"], (4,), f"{at}: rotation"),
        at,
    )


def _from_command(line: str, source: str) -> tuple[tuple[str, str], Array]:
    words = shlex.split(line)
    words = words[next(i for i, word in enumerate(words) if "static_transform_publisher" in word) + 1 :]
    at = f"{source}: {line.strip()}"
    if any(word.startswith("--") for word in words):
        named = dict(zip([w.lstrip("-") for w in words[::2]], words[1::2], strict=False))
        t = [named.get(axis, "0") for axis in "xyz"]
        turned = any(key in named for key in ("roll", "pitch", "yaw"))
        keys = ("yaw", "pitch", "roll") if turned else ("qx", "qy", "qz", "qw")
        q = [named.get(key, "1" if key == "qw" else "0") for key in keys]
        frames = [named.get(key, "") for key in ("frame-id", "child-frame-id")]
    else:
        count = 6 if len(words) in (8, 9) and not _is_number(words[6]) else 7
        t, q, frames = words[:3], words[3:count], words[count : count + 2]
    if len(frames) != 2 or not all(frames):
        raise RigError(f"{at}: expected x y z, a rotation, and two frames")
    try:
        position, angles = np.array(t, dtype=float), np.array(q, dtype=float)
    except ValueError:
        raise RigError(f"{at}: expected numbers for position and rotation") from None
    if len(angles) == 3:
        angles = Rotation.from_euler("ZYX", angles).as_quat()
    return (_frame(frames[0]), _frame(frames[1])), transform(position, angles, at)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _frame(name: Any) -> str:
    return str(name).lstrip("/")


def transform(position: Array, quaternion: Array, at: str) -> Array:
    """T [4, 4] of a position and a quaternion x y z w.

    Raises:
        RigError: the quaternion's length is not 1.
    """
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= 1e-3:  # also when it is no number
        raise RigError(f"{at}: expected a quaternion x y z w of length 1, got {quaternion.tolist()}")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion / length).as_matrix()
    T[:3, 3] = position
    return T


def with_poses(
    reading: Reading, transforms: Transforms, frames: Mapping[str, str], world: str | None, body_frames: bool
) -> Reading:
    """Give every camera its pose out of a tree of transforms.

    Args:
        reading: the cameras.
        transforms: the edges of the tree.
        frames: camera -> its frame; the others are found by name.
        world: the room's frame; None: the only one without a parent.
        body_frames: the cameras' frames are bodies (x forward, z up), not optical frames.

    Raises:
        RigError: no such frame, or no way to it; the frames there are are named.
    """
    names = {name for edge in transforms for name in edge}
    listed = ", ".join(sorted(names))
    roots = sorted(names - {child for _, child in transforms})
    if world is None and len(roots) != 1:
        raise RigError(f"the transforms have {len(roots)} frames without a parent ({', '.join(roots)}): --world-frame")
    root = world or roots[0]
    if root not in names:
        raise RigError(f"--world-frame {root}: the transforms have only {listed}")
    cameras = []
    for camera in reading.cameras:
        frame = frames.get(camera.name) or _camera_frame(camera.name, names, body_frames)
        if frame not in names:
            raise RigError(f"camera {camera.name}: frame {frame!r} is not among the transforms: {listed}")
        T = _chain(transforms, root, frame)
        cameras.append(replace(camera, T=T @ BODY_TO_OPTICAL if body_frames else T))
    return replace(reading, cameras=tuple(cameras))


def _camera_frame(camera: str, names: Iterable[str], body: bool) -> str:
    """The frame that carries the camera's name; an optical one if that is wanted."""
    fits = [name for name in names if name == camera or name.startswith((f"{camera}_", f"{camera}/"))]
    optical = [name for name in fits if name.endswith(("optical_frame", "optical"))]
    chosen = [name for name in fits if name not in optical] if body else optical or fits
    if len(chosen) != 1:
        what = f"several frames ({', '.join(sorted(chosen))})" if chosen else f"none among {', '.join(sorted(names))}"
        raise RigError(f"camera {camera}: its frame: {what}; say --frame {camera}=FRAME")
    return chosen[0]


def _chain(transforms: Transforms, root: str, frame: str) -> Array:
    """T_root_frame along the tree's edges in either direction."""
    reached, waiting = {root: np.eye(4)}, [root]
    while waiting:
        here = waiting.pop()
        for (parent, child), T in transforms.items():
            for a, b, step in ((parent, child, T), (child, parent, inverse(T))):
                if a == here and b not in reached:
                    reached[b] = reached[here] @ step
                    waiting.append(b)
    if frame not in reached:
        raise RigError(f"the transforms do not connect {frame} with {root}")
    return reached[frame]


def write(rig: Rig, path: Path) -> list[str]:
    """Write a folder: `<camera>.yaml` each, as a camera driver's camera_info_url wants it, and `tf_static.yaml`."""
    transforms = []
    for camera in rig.cameras:
        write_intrinsics(camera, path / f"{camera.name}.yaml")
        T = camera.T_world_camera
        q = Rotation.from_matrix(np.array(T[:3, :3])).as_quat()
        transforms += [
            "- header: {frame_id: room}",
            f"  child_frame_id: {json.dumps(camera.name + '_optical_frame')}",
            "  transform:",
            f"    translation: {{x: {float(T[0, 3])!r}, y: {float(T[1, 3])!r}, z: {float(T[2, 3])!r}}}",
            f"    rotation: {{x: {float(q[0])!r}, y: {float(q[1])!r}, z: {float(q[2])!r}, w: {float(q[3])!r}}}",
        ]
    write_text(path / "tf_static.yaml", "transforms:\n" + "\n".join(transforms) + "\n")
    return ["CameraInfo and TF hold no carve volume and no regions to ignore"]


def write_intrinsics(camera: Camera, path: Path) -> None:
    """Write one camera's lens in camera_calibration's layout."""
    names = {"none": "plumb_bob", "radtan": "plumb_bob", "rational": "rational_polynomial", "fisheye": "equidistant"}
    distortion = camera.distortion
    if camera.distortion_model in ("none", "radtan"):
        distortion = np.concatenate([distortion, np.zeros(5 - distortion.size)])
    P = np.column_stack([camera.K, np.zeros(3)])
    blocks = [
        ("camera_matrix", camera.K),
        ("distortion_coefficients", distortion.reshape(1, -1)),
        ("rectification_matrix", np.eye(3)),
        ("projection_matrix", P),
    ]
    lines = [
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        f"camera_name: {json.dumps(camera.name)}",
        f"distortion_model: {names[camera.distortion_model]}",
    ]
    for key, values in blocks:
        rows, cols = values.shape
        lines += [f"{key}:", f"  rows: {rows}", f"  cols: {cols}", f"  data: {row(values)}"]
    write_text(path, "\n".join(lines) + "\n")


FORMAT = Format(
    "ros",
    "camera_calibration's ost.yaml (one per camera, with --tf for the poses)",
    lambda path, text: path.suffix in (".yaml", ".yml") and "image_width:" in text and "camera_matrix:" in text,
    read,
    write,
)
