# SPDX-License-Identifier: Apache-2.0
"""Targets: archives and recordings."""

from __future__ import annotations

import dataclasses
import random
from functools import cache
from typing import Any

import cv2
import numpy as np

from fuzz.inputs import SPLIT, mutate_bytes, mutate_npz, mutate_text, packed_npz, split
from fuzz.targets import file, folder, rig_seeds, target
from limbloc_ros.core.confidence import Judge, describe_pose
from limbloc_ros.core.errors import LimblocError, NoPerson
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.hull import Hull
from limbloc_ros.recordings.offline import OfflineConfig
from limbloc_ros.recordings.results import FrameResult, Run

# --- archives ---


def _mutate_files(npz: int, count: int) -> Any:
    """Damages one of `count` files; the first `npz` are archives, the others texts."""

    def mutate(data: bytes, most: int, rng: random.Random) -> bytes:
        parts = split(data, count)
        which = rng.randrange(count)
        parts[which] = (mutate_npz if which < npz else mutate_text)(parts[which], most, rng)
        return SPLIT.join(parts)[:most]

    return mutate


def _case_seeds() -> list[bytes]:
    calib = rig_seeds()[2][4:]
    bits = np.random.default_rng(0).integers(0, 256, (2, 48, 8), dtype=np.uint8)
    masks, meta = packed_npz(cam0=bits), b'{"kind": "sequence", "fps": 25, "background_frames": 1}'
    truth = packed_npz(joints=np.zeros((1, 3, 3)), joint_names=np.array(["pelvis", "knee_L", "knee_R"]))
    return [SPLIT.join([masks, truth, meta, calib])]


@target("case", _case_seeds, _mutate_files(2, 4))
def case(data: bytes) -> None:
    """A benchmark case, with its masks."""
    from limbloc_ros.recordings.cases import load_case

    inside = folder() / "case"
    inside.mkdir(exist_ok=True)
    for name, part in zip(("masks.npz", "gt.npz", "meta.json", "calib.json"), split(data, 4), strict=True):
        (inside / name).write_bytes(part)
    found = load_case(inside)
    assert np.isfinite(found.stamps).all()
    for frame in range(min(len(found), 3)):
        for name, mask in found.masks(frame).items():
            assert mask.shape == (found.rig.camera(name).height, found.rig.camera(name).width)


@cache
def _saved_run() -> dict[str, bytes]:
    """The files of a run of three frames: a figure that stands, twice, and an empty room."""
    hull = Hull(0.1, (-2, -2, 0), np.full((4, 4, 17), -0.05, np.float32), 0.2)
    frames = [FrameResult(0, NoPerson("nobody"), {"mask": 1.0})]
    for k in (1, 2):
        pose = describe_pose(FigureState.standing(np.array([0.1 * k, 0, 0.9])), Judge(hull), None, {"search": 2.0})
        frames.append(FrameResult(40_000_000 * k, pose))
    about = {"input": "walk", "kind": "bag", "config": dataclasses.asdict(OfflineConfig()), "version": "1"}
    inside = folder() / "saved"
    Run(tuple(frames), about).save(inside)
    return {path.name: path.read_bytes() for path in inside.iterdir()}


def _run_seeds() -> list[bytes]:
    kept = packed_npz(**{"numbers": np.array([0]), "mask 0 64 cam0": np.full((48, 8), 85, np.uint8)})
    return [SPLIT.join([_saved_run()["run.npz"], kept, _saved_run()["run.json"]])]


@target("run", _run_seeds, _mutate_files(2, 3), most=60_000)
def run(data: bytes) -> None:
    """The results of a run, read back for the report and for every motion format."""
    from limbloc_ros.commands.report import run_data
    from limbloc_ros.export import bvh, gltf, trc
    from limbloc_ros.export.clip import clip_of
    from limbloc_ros.export.recording import config_of
    from limbloc_ros.export.skeleton import skeleton_of
    from limbloc_ros.export.tables import csv_text
    from limbloc_ros.recordings.kept_frames import KeptFrames
    from limbloc_ros.recordings.results import Run
    from limbloc_ros.report.summary import summary

    inside = folder() / "run"
    inside.mkdir(exist_ok=True)
    for name, part in zip(("run.npz", "kept_frames.npz", "run.json"), split(data, 3), strict=True):
        (inside / name).write_bytes(part)
    found = Run.load(inside)
    kept = KeptFrames.load(inside)
    for number in kept.numbers[:2]:
        kept.masks(number)
        kept.images(number)
    config_of(found)
    summary(run_data(found))
    csv_text(found)
    clip = clip_of(found)
    trc.trc_text(clip, "run.trc")
    skeleton = skeleton_of(clip)
    bvh.bvh_text(skeleton, "m")
    gltf.write_gltf(skeleton, folder() / "run.glb")


def _reference_seeds() -> list[bytes]:
    trc = b"""PathFileType\t4\t(X/Y/Z)\twalk.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
25\t25\t3\t2\tm\t25\t1\t3
Frame#\tTime\tRKnee\t\t\tLKnee\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2
1\t0.000000\t0.1\t0.5\t0.2\t-0.1\t0.5\t0.2
2\t0.040000\t0.1\t0.5\t0.2\t\t\t
3\t0.080000\t0.1\t0.5\t0.2\t-0.1\t0.5\t0.2
"""
    return [b"trc " + trc, b"npz " + _saved_run()["joints.npz"]]


def _mutate_reference(data: bytes, most: int, rng: random.Random) -> bytes:
    return data[:4] + (mutate_text if data[:3] == b"trc" else mutate_npz)(data[4:], most, rng)


@cache
def _a_run() -> Any:
    _saved_run()
    return Run.load(folder() / "saved")


@target("reference", _reference_seeds, _mutate_reference)
def reference(data: bytes) -> None:
    """What a run is compared with: markers, or joints of somebody else."""
    from limbloc_ros.report.compare import load_reference

    path = file("reference.trc" if data[:3] == b"trc" else "reference.npz", data[4:])
    for align in ("none", "rigid"):
        found = load_reference(path, _a_run(), align=align)
        assert found.joints.shape == (len(_a_run()), 25, 3)


def _background_seeds() -> list[bytes]:
    from limbloc_ros.core.background import BackgroundModel

    model = BackgroundModel()
    model.seed(np.full((24, 32, 3), 100, np.uint8))
    return [packed_npz(**(model.state() or {}))]


@target("background", _background_seeds, mutate_npz)
def background(data: bytes) -> None:
    """A camera's background of an earlier run, and the next picture."""
    from limbloc_ros.core.background import BackgroundModel
    from limbloc_ros.recordings.background_file import load_background

    model = BackgroundModel()
    load_background(model, file("background.npz", data))
    for shape in ((24, 32, 3), (24, 32)):
        result = model.segment(np.full(shape, 90, np.uint8))
        assert result.mask.shape == shape[:2]


# --- recordings ---


def bag_files() -> list[bytes]:
    """Bags of two cameras with masks, CameraInfo and TF, in both storages, compressed and not."""
    from limbloc_ros.recordings.bags import TYPESTORE, BagWriter

    types = TYPESTORE.types
    stamp = types["builtin_interfaces/msg/Time"]
    header = types["std_msgs/msg/Header"]
    pixels = np.zeros((12, 16), np.uint8)
    pixels[3:9, 5:9] = 255
    _, png = cv2.imencode(".png", pixels)
    found = []
    for storage in ("mcap", "sqlite3"):
        path = folder() / "seed_bag"
        with BagWriter(path, storage) as bag:
            for k in range(4):
                for camera, kind, ending in (
                    ("cam0", "Image", "mask"), ("cam1", "CompressedImage", "mask/compressed"),
                    ("cam0", "CameraInfo", "camera_info"),
                ):  # fmt: skip
                    type_name = f"sensor_msgs/msg/{kind}"
                    at = header(stamp(k, 0), camera)
                    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
                    K, P = np.array([50, 0, 8, 0, 50, 6, 0, 0, 1.0]), np.zeros(12)
                    arguments: tuple[Any, ...] = {
                        "Image": (at, 12, 16, "mono8", 0, 16, pixels.ravel()),
                        "CompressedImage": (at, "mono8; png compressed mono8", np.asarray(png).ravel()),
                        "CameraInfo": (at, 12, 16, "plumb_bob", np.zeros(5), K, np.eye(3).ravel(), P, 0, 0, roi),
                    }[kind]
                    bag.add_topic(f"/{camera}/{ending}", type_name)
                    cdr = TYPESTORE.serialize_cdr(types[type_name](*arguments), type_name)
                    bag.write(f"/{camera}/{ending}", k * 10**9, bytes(cdr))
            moved = types["geometry_msgs/msg/TransformStamped"](
                header(stamp(0, 0), "room"), "cam0",
                types["geometry_msgs/msg/Transform"](
                    types["geometry_msgs/msg/Vector3"](2.0, 0.0, 1.0),
                    types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
                ),
            )  # fmt: skip
            bag.add_topic("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
            message = types["tf2_msgs/msg/TFMessage"]([moved])
            bag.write("/tf_static", 0, bytes(TYPESTORE.serialize_cdr(message, "tf2_msgs/msg/TFMessage")))
        (data,) = (f for f in path.iterdir() if f.suffix in (".mcap", ".db3"))
        raw = data.read_bytes()
        if storage == "sqlite3":
            raw = _vacuumed(raw)
        found.append(raw)
        for f in path.iterdir():
            f.unlink()
        path.rmdir()
    return found


def _vacuumed(raw: bytes) -> bytes:
    """The same database in small pages, so that it is short."""
    import sqlite3

    path = file("seed.db3", raw)
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA page_size=512")
    connection.execute("VACUUM")
    connection.close()
    return path.read_bytes()


def _read_bag(path: Any) -> None:
    from limbloc_ros.recordings.bag_calibration import bag_intrinsics, bag_transforms
    from limbloc_ros.recordings.bag_frames import camera_streams, frame_sets
    from limbloc_ros.recordings.bags import BagReader

    refused = []
    with BagReader(path) as bag:
        assert len(str(bag.damage)) < 20_000
        read = 0
        for message in bag.messages():
            read += 1
            try:
                bag.deserialise(message.topic, message.cdr)
            except LimblocError as error:
                refused.append(error)
        assert read <= 10_000
        streams = camera_streams(bag, ("cam0", "cam1"))
        for frames in frame_sets(bag, streams):
            for frame in frames.items.values():
                try:
                    frame.pixels()
                except LimblocError as error:
                    refused.append(error)
    for reader in (bag_intrinsics, bag_transforms):
        reader(path)
    if refused:
        raise refused[0]


@target("bag_mcap", lambda: bag_files()[:1], mutate_bytes, most=32_000)
def bag_mcap(data: bytes) -> None:
    """An MCAP file: every message, frame sets, pictures, intrinsics and transforms."""
    _read_bag(file("bag.mcap", data))


@target("bag_sqlite", lambda: bag_files()[1:], mutate_bytes, most=32_000)
def bag_sqlite(data: bytes) -> None:
    """The same in sqlite3."""
    _read_bag(file("bag.db3", data))
