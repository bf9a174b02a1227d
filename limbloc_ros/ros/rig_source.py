# SPDX-License-Identifier: Apache-2.0
"""Where the carving node gets its rig from: a rig file, or CameraInfo and TF."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from limbloc_ros.core.camera import Camera, Rig
from limbloc_ros.core.errors import ConfigError, LimblocError, RigError
from limbloc_ros.rig.rig_file import load_rig
from limbloc_ros.rig.volume import derive_volume
from limbloc_ros.ros import topics
from limbloc_ros.ros.image_messages import info_to_camera
from limbloc_ros.ros.transforms import TransformListener

RETRY_S = 0.5
#: Cameras that are not there after this long are left out until they come.
PATIENCE_S = 10.0


def rig_from_file(path: str, names: Sequence[str] = ()) -> Rig:
    """The rig of a file, with only the cameras `names` if there are any.

    Raises:
        RigError: what `load_rig` refuses, or a name that the rig does not have.
    """
    rig = load_rig(path)
    return Rig(tuple(rig.camera(name) for name in names), rig.volume_min, rig.volume_max) if names else rig


class RigFromTopics:
    """Builds the rig as CameraInfo messages and transforms come in, and anew when a camera is added or changed.

    Args:
        node: where subscriptions live.
        names: the cameras.
        world_frame: parent of the cameras' poses.
        volume: corners min and max of the carve volume, m; both empty: derived from what the cameras see.
        min_cameras: enough to start with when others stay away.
        on_rig: gets every new rig.

    Raises:
        RigError: tf2_msgs is not installed.
        ConfigError: no cameras, or a volume that is not two corners.
    """

    def __init__(
        self,
        node: Node,
        names: Sequence[str],
        world_frame: str,
        volume: tuple[Sequence[float], Sequence[float]],
        min_cameras: int,
        on_rig: Callable[[Rig], None],
    ) -> None:
        if not names:
            raise ConfigError(
                "parameter cameras: expected the names of the cameras when there is no rig_file, got none"
            )
        if any(volume) and not all(len(corner) == 3 for corner in volume):
            raise ConfigError(
                f"parameters volume_min and volume_max: expected three numbers in metres each, got {volume}"
            )
        self._tf = TransformListener(node)
        self._names = tuple(names)
        self._world_frame = world_frame
        self._volume = volume
        self._min_cameras = min_cameras
        self._on_rig = on_rig
        self._infos: dict[str, CameraInfo] = {}
        self._cameras: dict[str, Camera] = {}
        self._used: dict[str, Camera] = {}
        self._started = time.monotonic()
        self.problems: dict[str, str] = {}
        for name in names:
            node.create_subscription(
                CameraInfo, topics.camera_info(name), self._remember(name), topics.image_subscription("best_effort")
            )
        node.create_timer(RETRY_S, self.update, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _remember(self, name: str) -> Callable[[CameraInfo], None]:
        def remember(msg: CameraInfo) -> None:
            self._infos[name] = msg

        return remember

    def update(self) -> None:
        """Look at what has come; hands on a rig when it is new and complete, or complete enough after a while."""
        self.problems = {}
        for name in self._names:
            try:
                self._cameras[name] = self._find(name)
            except LimblocError as error:
                self.problems[name] = str(error)
        patient = time.monotonic() - self._started < PATIENCE_S
        if len(self._cameras) < (len(self._names) if patient else self._min_cameras):
            return
        if all(_same(self._used.get(name), camera) for name, camera in self._cameras.items()):
            return
        try:
            self._on_rig(self._build())
        except LimblocError as error:
            self.problems["rig"] = str(error)
        self._used = dict(self._cameras)

    def _build(self) -> Rig:
        cameras = tuple(self._cameras[name] for name in self._names if name in self._cameras)
        low, high = map(np.asarray, self._volume) if any(self._volume) else derive_volume(cameras)
        return Rig(cameras, low, high)

    def _find(self, name: str) -> Camera:
        info = self._infos.get(name)
        if info is None:
            raise RigError(f"camera {name}: no CameraInfo on {topics.camera_info(name)} yet")
        try:
            T = self._tf.find(self._world_frame, info.header.frame_id)
        except RigError as error:
            raise RigError(f"camera {name}: {error}") from None
        return info_to_camera(info, name, T)


def _same(a: Camera | None, b: Camera) -> bool:
    return (
        a is not None
        and (a.width, a.height, a.distortion_model) == (b.width, b.height, b.distortion_model)
        and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("K", "T_world_camera", "distortion"))
    )
