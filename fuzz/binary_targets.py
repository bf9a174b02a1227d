# SPDX-License-Identifier: Apache-2.0
"""Targets of binary input: archives, recordings, pictures and messages."""

from __future__ import annotations

import dataclasses
import math
import os
import random
import struct
from functools import cache
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from fuzz.inputs import SPLIT, Draw, mutate_npz, mutate_text, packed_npz, split
from fuzz.targets import file, folder, rig_seeds, target
from limbloc_ros.core.confidence import describe_pose
from limbloc_ros.core.errors import InputError, LimblocError, NoPerson
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
        pose = describe_pose(FigureState.standing(np.array([0.1 * k, 0, 0.9])), hull, None, {"search": 2.0})
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


def _bag_files() -> list[bytes]:
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


def _mutate_bytes(data: bytes, most: int, rng: random.Random) -> bytes:
    """Cuts, and numbers of all sizes overwritten, as headers and lengths are."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(out)) if out else 0
        kind = rng.randrange(5)
        if kind == 0:
            del out[at:]
        elif kind == 1:
            del out[at : at + rng.choice((1, 4, 64, 512))]
        else:
            form = rng.choice("BHIQ")
            limit = 2 ** (8 * struct.calcsize(form))
            value = rng.choice((0, 1, limit - 1, limit // 2, rng.randrange(limit), 10**9 % limit))
            raw = struct.pack(f"<{form}", value)
            out[at : at + len(raw)] = raw
    return bytes(out[:most])


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


@target("bag_mcap", lambda: _bag_files()[:1], _mutate_bytes, most=32_000)
def bag_mcap(data: bytes) -> None:
    """An MCAP file: every message, frame sets, pictures, intrinsics and transforms."""
    _read_bag(file("bag.mcap", data))


@target("bag_sqlite", lambda: _bag_files()[1:], _mutate_bytes, most=32_000)
def bag_sqlite(data: bytes) -> None:
    """The same in sqlite3."""
    _read_bag(file("bag.db3", data))


# --- pictures ---

_ENCODINGS = (
    *("mono8", "8UC1", "bgr8", "rgb8", "bgra8", "rgba8", "mono16", "16UC1", "bgr16", "rgb16", "uyvy", "yuyv", "nv12"),
    *("nv21", "bayer_rggb8", "bayer_grbg16", "32FC1", "", "mono8 ", "h264"),
)


@target("image", lambda: [bytes(range(256)), b"\0\0" * 20 + bytes(200), b"\1" * 300], most=4096)
def image(data: bytes) -> None:
    """A raw image of any encoding, size and step."""
    from limbloc_ros.core.images import image_to_pixels, message_to_mask

    draw = Draw(data)
    encoding = draw.choice(_ENCODINGS) if draw.below(16) else draw.text()
    width, height, step = draw.integer(), draw.integer(), draw.integer()
    big = draw.below(2)
    if draw.below(2):
        step = min(width * (1 + draw.below(8)), 2**32 - 1)
    pixels = draw.rest()
    kinds: Any = pixels if draw.below(2) else np.frombuffer(pixels, np.uint8)
    msg = SimpleNamespace(width=width, height=height, encoding=encoding, is_bigendian=big, step=step, data=kinds)
    try:
        mask = message_to_mask(msg)
        assert mask.shape == (height, width) or "nv" in encoding
        assert set(np.unique(mask)) <= {0, 255}
    except InputError:
        found = image_to_pixels(msg)
        assert found.dtype == np.uint8 and found.shape[0] <= height and found.shape[1] == width


def _picture_seeds() -> list[bytes]:
    rng = np.random.default_rng(1)
    grey, colour = rng.integers(0, 256, (9, 13), np.uint8), rng.integers(0, 256, (9, 13, 3), np.uint8)
    made = [
        *(cv2.imencode(".jpg", p, [cv2.IMWRITE_JPEG_PROGRESSIVE, k])[1] for p in (grey, colour) for k in (0, 1)),
        *(cv2.imencode(".png", p)[1] for p in (grey, colour, grey.astype(np.uint16) * 257)),
        cv2.imencode(".png", grey, [cv2.IMWRITE_PNG_BILEVEL, 1])[1],
        cv2.imencode(".png", rng.integers(0, 256, (9, 13, 4), np.uint8))[1],
    ]
    return [np.asarray(m).tobytes() for m in made]


@target("compressed_image", _picture_seeds, _mutate_bytes, most=4096)
def compressed_image(data: bytes) -> None:
    """A JPEG or PNG."""
    from limbloc_ros.core.images import compressed_to_pixels

    pixels = compressed_to_pixels(SimpleNamespace(format="jpeg", data=data))
    assert pixels.dtype == np.uint8 and pixels.ndim in (2, 3) and pixels.size
    assert pixels.ndim == 2 or pixels.shape[2] == 3


# --- messages ---


@target("camera_info", lambda: [bytes(range(256)) * 2, b"\3\0\1\0" * 100, b"\2\0" * 200], most=600)
def camera_info(data: bytes) -> None:
    """CameraInfo and a pose -> camera -> CameraInfo."""
    from sensor_msgs.msg import CameraInfo
    from std_msgs.msg import Header

    from limbloc_ros.ros.image_messages import camera_to_info, info_to_camera

    draw = Draw(data)
    msg = CameraInfo(width=draw.integer(), height=draw.integer())
    msg.distortion_model = draw.choice(("plumb_bob", "rational_polynomial", "equidistant", "", draw.text()))
    msg.d = [draw.number() for _ in range(draw.choice((0, 4, 5, 8, 14, draw.below(20))))]
    msg.k = [draw.number() for _ in range(9)] if draw.below(2) else [50.0, 0, 8, 0, 50, 6, 0, 0, 1]
    msg.binning_x, msg.binning_y = draw.integer(), draw.integer()
    roi = msg.roi
    roi.x_offset, roi.y_offset, roi.width, roi.height = (draw.integer() for _ in range(4))
    T = np.eye(4)
    if draw.below(2):
        T[draw.below(4), draw.below(4)] = draw.number()
    camera = info_to_camera(msg, "cam0", T)
    assert np.isfinite(camera.K).all() and camera.width * camera.height <= 64_000_000
    uv, _ = camera.world_to_image(np.array([[0.1, 0.2, 3.0]]))
    again = info_to_camera(camera_to_info(camera, Header()), "cam0", T)
    assert np.array_equal(again.K, camera.K) and uv.shape == (1, 2)


def _cloud_seeds() -> list[bytes]:
    from std_msgs.msg import Header

    from limbloc_ros.ros.cloud_messages import hull_to_cloud

    x, y, z = np.meshgrid(*(np.arange(-4, 4) for _ in range(3)), indexing="ij")
    sdf = ((np.sqrt(x * x + y * y + z * z) - 2.5) * 0.02).astype(np.float32)
    cloud = hull_to_cloud(Hull(0.02, (0, 0, 0), np.minimum(sdf, np.float32(0.06)), 0.06), Header())
    points = bytes(cloud.data)
    return [bytes(8) + points[: 44 * 150], b"\1" * 8 + points[: 44 * 20], bytes(8)]


@target("hull_cloud", _cloud_seeds, _mutate_bytes, most=8000)
def hull_cloud(data: bytes) -> None:
    """A hull's PointCloud2: any header, any points."""
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import Header

    from limbloc_ros.ros.cloud_messages import _HULL_FIELDS, cloud_to_hull, hull_to_cloud

    draw = Draw(data[:64] if data[:1] == b"\1" else data[:8])
    points = data[64 if data[:1] == b"\1" else 8 :]
    msg = PointCloud2(height=1, width=len(points) // 44, point_step=44, fields=list(_HULL_FIELDS))
    if data[:1] == b"\1":
        draw.take(1)
        msg.width, msg.height, msg.point_step = draw.integer(), draw.integer(), draw.integer()
        msg.fields = msg.fields[: draw.below(15)]
        msg.is_bigendian = bool(draw.below(2))
    else:
        points = points[: 44 * msg.width]
    msg.data.frombytes(points)
    hull = cloud_to_hull(msg)
    if hull is None:
        return
    assert np.isfinite(hull.sdf).all() and hull.sdf.nbytes <= 4 * 10**8
    if hull.sdf.size < 10**6:
        assert hull.inside_count >= 0
        hull_to_cloud(hull, Header())


def _cdr_seeds() -> list[bytes]:
    from limbloc_ros.recordings.bags import BagReader

    found = []
    with BagReader(file("seed.mcap", _bag_files()[0])) as bag:
        for message in bag.messages(stop_ns=1):
            found.append(bag.topics[message.topic].type.encode().ljust(48) + message.cdr)
    return found


@target("cdr", _cdr_seeds, lambda d, most, rng: d[:48] + _mutate_bytes(d[48:], most - 48, rng), most=4096)
def cdr(data: bytes) -> None:
    """Serialised messages as a bag or the network holds them -> what our nodes make of them."""
    from limbloc_ros.core.images import message_to_pixels
    from limbloc_ros.recordings.bag_frames import header_stamp_ns
    from limbloc_ros.recordings.bags import deserialise
    from limbloc_ros.ros.cloud_messages import cloud_to_hull
    from limbloc_ros.ros.image_messages import info_to_camera
    from limbloc_ros.ros.messages import message_to_joints, message_to_transform
    from limbloc_ros.ros.raw_messages import check_cdr

    kind, raw = data[:48].strip().decode(errors="replace"), data[48:]
    check_cdr(kind, raw, "message")
    msg: Any = deserialise(kind, raw)
    if not kind.startswith("tf2_msgs"):
        header_stamp_ns(raw)
    convert = {
        "sensor_msgs/msg/Image": message_to_pixels,
        "sensor_msgs/msg/CompressedImage": message_to_pixels,
        "sensor_msgs/msg/CameraInfo": lambda m: info_to_camera(m, "cam0", np.eye(4)),
        "sensor_msgs/msg/PointCloud2": cloud_to_hull,
        "geometry_msgs/msg/PoseArray": message_to_joints,
        "tf2_msgs/msg/TFMessage": lambda m: [message_to_transform(t) for t in m.transforms],
    }.get(kind)
    if convert is not None:
        convert(msg)


# --- a node ---


@cache
def _node() -> Any:
    """A node with every parameter of every node of ours."""
    import rclpy
    from rclpy.node import Node

    from limbloc_ros.core.config import BackgroundConfig, FitConfig, HullConfig, SyncConfig
    from limbloc_ros.nodes.carving import CarvingSettings
    from limbloc_ros.nodes.pose import PoseSettings
    from limbloc_ros.nodes.record import RecordSettings
    from limbloc_ros.nodes.replay import ReplaySettings
    from limbloc_ros.nodes.segmentation import SegmentationSettings
    from limbloc_ros.nodes.simulated_cameras import SimulationSettings
    from limbloc_ros.ros.parameters import NodeParameters

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=1 + os.getpid() % 100)
    node = Node("fuzzed", context=context)
    parameters = NodeParameters(node)
    values: dict[str, Any] = {}
    kinds: tuple[Any, ...] = (
        *(HullConfig, FitConfig, SyncConfig, BackgroundConfig, CarvingSettings, PoseSettings, RecordSettings),
        *(ReplaySettings, SegmentationSettings, SimulationSettings),
    )
    for kind in kinds:
        prefix = kind.__name__

        def keep(value: Any, prefix: str = prefix) -> None:
            values[prefix] = value

        values[prefix] = parameters.declare(kind, prefix, keep)
    names = [f"{prefix}.{name}" for prefix in values for name in node.get_parameters_by_prefix(prefix)]
    return context, node, values, sorted(names)


@target("node_parameters", lambda: [bytes(range(200)), b"\5\0" * 60], most=300)
def node_parameters(data: bytes) -> None:
    """Parameters of a running node, set to anything."""
    from rclpy.exceptions import ParameterNotDeclaredException
    from rclpy.parameter import Parameter

    from limbloc_ros.core.config import validated

    _, node, values, names = _node()
    draw = Draw(data)
    wanted = []
    for _ in range(1 + draw.below(4)):
        kind = draw.below(7)
        value: Any = (
            draw.number, lambda: draw.integer(2**63) - 2**31 * draw.below(2), lambda: bool(draw.below(2)), draw.text,
            lambda: [draw.number() for _ in range(draw.below(4))], lambda: [draw.text() for _ in range(draw.below(4))],
            lambda: None,
        )[kind]()  # fmt: skip
        name = draw.choice(names) if draw.below(8) else draw.text()
        types = (
            *(Parameter.Type.DOUBLE, Parameter.Type.INTEGER, Parameter.Type.BOOL, Parameter.Type.STRING),
            *(Parameter.Type.DOUBLE_ARRAY, Parameter.Type.STRING_ARRAY, Parameter.Type.NOT_SET),
        )
        wanted.append(Parameter(name, types[kind], value))
    try:
        results = node.set_parameters(wanted)
    except ParameterNotDeclaredException as error:  # the node's service answers with a refusal
        raise InputError(str(error)) from None
    for section in values.values():
        validated(section)
        assert all(math.isfinite(v) for v in vars(section).values() if isinstance(v, float))
    if not all(r.successful for r in results):
        raise InputError("; ".join(r.reason for r in results if not r.successful) or "refused without a reason")
