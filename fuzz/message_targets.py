# SPDX-License-Identifier: Apache-2.0
"""Targets: pictures, messages, and a node's parameters."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from fuzz.inputs import Draw, mutate_bytes
from fuzz.recording_targets import bag_files
from fuzz.targets import file, target
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.hull import Hull

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


@target("compressed_image", _picture_seeds, mutate_bytes, most=4096)
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
    return [bytes(8) + points[: 24 * 150], b"\1" * 8 + points[: 24 * 20], bytes(8), bytes(8) + _cloud_with_views()]


def _cloud_with_views() -> bytes:
    """Points of a hull that carries the views of one camera."""
    from std_msgs.msg import Header

    from limbloc_ros.core.views import Views
    from limbloc_ros.ros.cloud_messages import hull_to_cloud

    camera = np.zeros((1, 35))
    camera[0, [0, 4, 8]], camera[0, 11:16], camera[0, 31:33] = 1.0, (3.0, 100.0, 100.0, 32.0, 24.0), (64.0, 48.0)
    views = Views(camera, np.array([[8, 8, 8, 6, 2, 0]]), np.arange(48, dtype=np.uint8) % 3)
    indices = np.stack(np.unravel_index(np.arange(100), (5, 5, 4)), axis=1).astype(np.int32)
    hull = Hull.from_shell(0.02, 0.06, indices, np.full(100, -0.02, np.float32))
    return bytes(hull_to_cloud(replace(hull, views=views), Header()).data)


@target("hull_cloud", _cloud_seeds, mutate_bytes, most=8000)
def hull_cloud(data: bytes) -> None:
    """A hull's PointCloud2: any header, any points."""
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import Header

    from limbloc_ros.ros.cloud_messages import _HULL_FIELDS, cloud_to_hull, hull_to_cloud

    draw = Draw(data[:64] if data[:1] == b"\1" else data[:8])
    points = data[64 if data[:1] == b"\1" else 8 :]
    msg = PointCloud2(height=1, width=len(points) // 24, point_step=24, fields=list(_HULL_FIELDS))
    if data[:1] == b"\1":
        draw.take(1)
        msg.width, msg.height, msg.point_step = draw.integer(), draw.integer(), draw.integer()
        msg.fields = msg.fields[: draw.below(16)]
        msg.is_bigendian = bool(draw.below(2))
    else:
        points = points[: 24 * msg.width]
    msg.data.frombytes(points)
    hull = cloud_to_hull(msg)
    if hull is None:
        return
    assert np.isfinite(hull.sdf).all() and hull.sdf.nbytes <= 4 * 10**8
    if hull.sdf.size < 10**6:
        assert hull.inside_count >= 0
        hull_to_cloud(hull, Header())
    if hull.views is not None:
        mismatch = hull.views.mismatch(
            np.array([[0, 1, 1]]), np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.2]]), np.full(2, 0.1)
        )
        assert np.isfinite(mismatch)


def _cdr_seeds() -> list[bytes]:
    from limbloc_ros.recordings.bags import BagReader

    found = []
    with BagReader(file("seed.mcap", bag_files()[0])) as bag:
        for message in bag.messages(stop_ns=1):
            found.append(bag.topics[message.topic].type.encode().ljust(48) + message.cdr)
    return found


@target("cdr", _cdr_seeds, lambda d, most, rng: d[:48] + mutate_bytes(d[48:], most - 48, rng), most=4096)
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
