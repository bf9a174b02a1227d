# SPDX-License-Identifier: Apache-2.0
"""Masks of all cameras -> visual hull (paper section 1)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_msgs.msg import Header

from limbloc_ros.core.camera import Rig
from limbloc_ros.core.config import HullConfig, SyncConfig, setting
from limbloc_ros.core.errors import InputError, NoPerson
from limbloc_ros.core.images import Pixels, message_to_mask
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.synchroniser import FrameSet, StampSynchroniser
from limbloc_ros.ros import cloud_messages, node_main, topics
from limbloc_ros.ros.backlog import Backlog
from limbloc_ros.ros.carving_report import CarvingReport
from limbloc_ros.ros.cdr import read_sent
from limbloc_ros.ros.health import Health
from limbloc_ros.ros.messages import make_header, message_to_joints, stamp_ns
from limbloc_ros.ros.parameters import NodeParameters
from limbloc_ros.ros.rig_source import RigFromTopics, rig_from_file

#: How often it is seen whether a set has waited long enough for its last cameras.
TICK_S = 0.02

#: While some camera's process is behind, masks of one instant come far apart: then sets wait this long for the rest, s,
#: until nothing has been skipped for some seconds.
BEHIND_TIMEOUT_S, BEHIND_S = 1.0, 10.0


@dataclass(frozen=True)
class CarvingSettings:
    """What only this node needs to know."""

    rig_file: str = setting("", "rig file; empty: the cameras' CameraInfo and TF are used")
    cameras: tuple[str, ...] = setting((), "the cameras that take part; empty: all of the rig file")
    mask_transport: str = setting("compressed", "which mask topics are read", choices=("raw", "compressed"))
    world_frame: str = setting("room", "TF frame of the world, in which the hull is published")
    volume_min: tuple[float, ...] = setting((), "lower corner of the carve volume without a rig file", unit="m")
    volume_max: tuple[float, ...] = setting((), "upper corner; both empty: what the cameras see", unit="m")
    catch_up_s: float = setting(
        1.0,
        "sets of masks may wait this long, by their stamps, for a slow moment to pass; then only the newest is carved",
        unit="s",
        low=0.0,
        high=10.0,
    )


class CarvingNode(Node):
    """Synchronises masks, carves them, and publishes `hull`; an empty cloud when nobody is there."""

    def __init__(self, node_name: str = "carving", **node_options: Any) -> None:
        super().__init__(node_name, **node_options)
        parameters = NodeParameters(self)
        self.settings = parameters.declare(CarvingSettings)
        self.hull_config = parameters.declare(HullConfig, "hull", self._on_hull_config)
        self.sync_config = parameters.declare(SyncConfig, "sync", self._on_sync_config)
        cloud_messages.check_voxel_size(self.hull_config.voxel_m, self.hull_config.band_m)
        self.rig: Rig | None = None
        self.carver: Carver | None = None
        self.rig_source: RigFromTopics | None = None
        self.synchroniser: StampSynchroniser[Pixels] | None = None
        self.skipped_s = -BEHIND_S
        Carver.warm_up()
        cloud_messages.warm_up()
        self.backlog: Backlog[FrameSet[Pixels]] = Backlog(self, self.carve, self.settings.catch_up_s)
        self.hull = self.create_publisher(PointCloud2, topics.HULL, topics.STREAM_QOS)
        s = self.settings
        if s.rig_file:
            self.use_rig(rig_from_file(s.rig_file, s.cameras))
        else:
            volume = (s.volume_min, s.volume_max)
            self.rig_source = RigFromTopics(
                self, s.cameras, s.world_frame, volume, self.hull_config.min_cameras, self.on_rig
            )
        mask_topics = {name: self.mask_topic(name) for name in s.cameras or (self.rig.names if self.rig else ())}
        self.report = CarvingReport(self, mask_topics)
        self.report.watch(self.rig)
        self.health = Health(self, self.describe)
        self.kind = Image if s.mask_transport == "raw" else CompressedImage
        for name, topic in mask_topics.items():
            self.create_subscription(self.kind, topic, self.make_callback(name), topics.WORK_QOS, raw=True)
        self.create_subscription(Header, topics.FRAMES_SKIPPED, self.on_skipped, topics.STREAM_QOS)
        # A pose node that died cannot say so; whose hulls are not answered can.
        self.create_subscription(PoseArray, topics.JOINTS, self.on_joints, topics.STREAM_QOS)
        self.create_timer(TICK_S, self.on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def mask_topic(self, camera: str) -> str:
        """Where a camera's masks come from."""
        raw = self.settings.mask_transport == "raw"
        return topics.mask(camera) if raw else topics.mask_compressed(camera)

    def on_rig(self, rig: Rig) -> None:
        """The rig came by topics, or has changed there."""
        self.use_rig(rig)
        self.report.watch(rig)

    def use_rig(self, rig: Rig) -> None:
        """Carve with this rig from now on.

        Raises:
            RigError: a lens that cannot be; the rig before stays in use.
        """
        self.carver = Carver(rig, self.hull_config)
        self.synchroniser = StampSynchroniser.from_config(rig.names, self.sync_config, self.hull_config.min_cameras)
        self.rig = rig
        self.backlog.clear()
        self.get_logger().info(f"carving with {len(rig.cameras)} cameras: {', '.join(rig.names)}")

    def make_callback(self, camera: str) -> Callable[[bytes], None]:
        """The subscription callback of one camera."""
        return lambda cdr: self.on_mask(camera, cdr)

    def on_mask(self, camera: str, cdr: bytes) -> None:
        """One mask: into the synchroniser, and what that finishes into the backlog."""
        if self.rig is None or self.synchroniser is None or camera not in self.rig.names:
            return  # the diagnostics say what is missing of the rig
        with self.health.guard(f"camera {camera}"):
            sent = read_sent(self.kind, cdr)
            mask = message_to_mask(sent)
            expected = self.rig.camera(camera)
            if mask.shape != (expected.height, expected.width):
                raise InputError(
                    f"expected a mask of {expected.width}x{expected.height} px as in the rig, got "
                    f"{mask.shape[1]}x{mask.shape[0]}; is the stream scaled, or the rig another camera's?"
                )
            stamp = sent.stamp_ns
            self.report.mask(camera, mask, stamp, self.health.latency_s(stamp))
            self.put_by(self.synchroniser.add(camera, stamp, mask, time.monotonic_ns()))

    def on_tick(self) -> None:
        """Let incomplete sets go when their time is up."""
        if self.synchroniser is not None:
            behind = time.monotonic() - self.skipped_s < BEHIND_S
            timeout_s = self.sync_config.timeout_s
            self.synchroniser.timeout_s = max(timeout_s, BEHIND_TIMEOUT_S) if behind else timeout_s
            self.put_by(self.synchroniser.tick(time.monotonic_ns()))

    def on_joints(self, msg: PoseArray) -> None:
        """A hull was answered; who moves tells what the cameras' skew costs."""
        with self.health.guard("joints"):
            self.report.answered(stamp_ns(msg.header), message_to_joints(msg))

    def on_skipped(self, msg: Header) -> None:
        """A camera's segmentation is behind and skipped its images up to this stamp, and so do the others."""
        self.skipped_s = time.monotonic()
        if self.synchroniser is not None:
            self.synchroniser.skip_until(stamp_ns(msg))

    def put_by(self, finished: Sequence[FrameSet[Pixels]]) -> None:
        """Sets to be carved, oldest first, when no mask waits to be taken."""
        for frames in finished:
            self.backlog.add(frames.stamp_ns, frames)

    def carve(self, frames: FrameSet[Pixels]) -> None:
        """Carve one set and publish its hull."""
        assert self.carver is not None
        header = make_header(frames.stamp_ns, self.settings.world_frame)
        started = time.thread_time()
        with self.health.guard("carving"):
            hull = self.carver.carve(frames.items)
            if isinstance(hull, NoPerson):
                self.hull.publish(cloud_messages.empty_hull_cloud(header))
            else:
                self.hull.publish(cloud_messages.hull_to_cloud(hull, header))
            carve_ms = 1e3 * (time.thread_time() - started)
            self.report.carved(frames, hull, carve_ms, self.health.latency_s(frames.stamp_ns))

    def describe(self) -> Sequence[DiagnosticStatus]:
        """The hull, and one entry per camera."""
        problems = self.rig_source.problems if self.rig_source else {}
        return self.report.statuses(self.synchroniser, self.backlog, problems, self.rig)

    def _on_hull_config(self, config: HullConfig) -> None:
        self.hull_config = config
        if self.rig is not None and self.synchroniser is not None:
            self.carver = Carver(self.rig, config)
            self.synchroniser.min_cameras = config.min_cameras

    def _on_sync_config(self, config: SyncConfig) -> None:
        if self.synchroniser is not None:
            self.synchroniser.slop_s = config.slop_s
        self.sync_config = config


def main() -> int:
    """Run the carving node."""
    return node_main.main(CarvingNode)


if __name__ == "__main__":
    raise SystemExit(main())
