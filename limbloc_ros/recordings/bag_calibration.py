# SPDX-License-Identifier: Apache-2.0
"""The cameras' calibration and poses out of a bag: CameraInfo and static transforms."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from limbloc_ros.core.errors import RigError
from limbloc_ros.recordings.bags import BagReader
from limbloc_ros.rig.formats.common import CAMERA_TO_WORLD, FoundCamera, Reading
from limbloc_ros.rig.formats.ros import Transforms, transform
from limbloc_ros.rig.rig_file import MODEL_ALIASES

CAMERA_INFO, TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"


def bag_intrinsics(path: Path) -> tuple[Reading, dict[str, str]]:
    """The first CameraInfo of every camera.

    Returns:
        the cameras, named like the topics' prefix, without poses; and camera -> frame.

    Raises:
        RigError: no CameraInfo, or one without calibration.
    """
    cameras: dict[str, FoundCamera] = {}
    frames = {}
    with BagReader(path) as bag:
        topics = [name for name, topic in bag.topics.items() if topic.type == CAMERA_INFO]
        for message in bag.messages(topics):
            name = message.topic.removesuffix("/camera_info").strip("/").replace("/", "_")
            if name in cameras:
                continue
            info = bag.deserialise(message.topic, message.cdr)
            if not np.any(info.k):
                raise RigError(f"{path}: {message.topic}: K is all zeros: the driver had no calibration")
            D = np.asarray(info.d, dtype=np.float64)
            model = MODEL_ALIASES.get(info.distortion_model, info.distortion_model) if D.any() else "none"
            K = np.asarray(info.k, dtype=np.float64).reshape(3, 3)
            cameras[name] = FoundCamera(name, (info.width, info.height), K, D if D.any() else np.zeros(0), model, None)
            frames[name] = info.header.frame_id.lstrip("/")
            if len(cameras) == len(topics):
                break
    if not cameras:
        raise RigError(f"{path} holds no CameraInfo; give the cameras' ost.yaml files and this bag as --tf")
    ordered = tuple(cameras[name] for name in sorted(cameras))
    return Reading(str(path), ordered, CAMERA_TO_WORLD, 1.0, "room"), frames


def bag_transforms(path: Path) -> Transforms:
    """The transforms on /tf_static, and those on /tf that never change.

    Raises:
        RigError: the bag holds none.
    """
    found: Transforms = {}
    moved: set[tuple[str, str]] = set()
    with BagReader(path) as bag:
        topics = [name for name, topic in bag.topics.items() if topic.type == TF]
        for message in bag.messages(topics):
            for entry in bag.deserialise(message.topic, message.cdr).transforms:
                key = (entry.header.frame_id.lstrip("/"), entry.child_frame_id.lstrip("/"))
                t, q = entry.transform.translation, entry.transform.rotation
                T = transform(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]), f"{path}: {key[1]}")
                if key in found and np.abs(found[key] - T).max() > 1e-6:
                    moved.add(key)
                found[key] = T
    still = {key: T for key, T in found.items() if key not in moved}
    if not still:
        raise RigError(f"{path} holds no static transform: record /tf_static too, or give --tf FILE")
    return still
