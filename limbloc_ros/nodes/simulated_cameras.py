# SPDX-License-Identifier: Apache-2.0
"""A simulated room: camera images, CameraInfo and everybody's true joints, as if camera drivers were running.

Stamps are whole multiples of the frame period, so that several processes, each with some of the cameras, deliver
images of exactly the same instants; give them the same `start_s`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from limbloc_ros.core.config import setting
from limbloc_ros.core.errors import ConfigError
from limbloc_ros.rig.rig_file import load_rig, save_rig
from limbloc_ros.ros import node_main, topics
from limbloc_ros.ros.cdr import ImageCdr, StampedCdr, joints_cdr
from limbloc_ros.ros.health import Health, Meter
from limbloc_ros.ros.image_messages import camera_to_info, pixels_to_compressed
from limbloc_ros.ros.messages import (
    NANOSECONDS,
    OK,
    WARN,
    make_header,
    make_status,
    transform_to_message,
)
from limbloc_ros.ros.parameters import NodeParameters
from limbloc_ros.ros.transforms import TransformOutput
from limbloc_ros.simulation.company import MOST, TOGETHER, chair, company
from limbloc_ros.simulation.ring import default_rig
from limbloc_ros.simulation.room import SimulatedRoom

#: Looks a frame: whether it is time to draw the next one, or to send it.
TICKS = 8


@dataclass(frozen=True)
class SimulationSettings:
    """What the room looks like and which of its cameras this process runs."""

    rig_file: str = setting("", "cameras inside the simulated room; empty: a ring of `number_of_cameras`")
    number_of_cameras: int = setting(8, "cameras of the ring", low=2, high=16)
    width: int = setting(640, "image width of the ring's cameras", unit="px", low=64, high=8192)
    height: int = setting(480, "image height of the ring's cameras", unit="px", low=64, high=8192)
    save_rig: str = setting("", "write the rig here, for the carving node")
    cameras: tuple[str, ...] = setting((), "the cameras that this process runs; empty: all")
    rate_hz: float = setting(15.0, "images per second of each camera", unit="Hz", low=0.1, high=120.0)
    transport: str = setting("raw", "which image topics there are", choices=("raw", "compressed", "both"))
    jpeg_quality: int = setting(90, "of compressed images", low=1, high=100, live=True)
    start_s: float = setting(
        0.0, "time since the epoch at which the simulation starts; 0: when the node does", unit="s", low=0.0, high=1e11
    )
    wait_for_viewers_s: float = setting(
        0.0,
        "with start_s 0: start when every camera is watched, or after this long all the same, so that the room is "
        "still empty when the other nodes are ready",
        unit="s",
        low=0.0,
        high=3600.0,
    )
    person: str = setting("man", "who moves", choices=("man", "woman", "child", "heavy"))
    people: int = setting(1, "how many there are; the others are the other kinds of `person`", low=1, high=MOST)
    together: str = setting(
        "apart",
        "what several people do: each at an own place, walking past each other, or meeting shoulder to shoulder",
        choices=TOGETHER,
    )
    chair: tuple[float, ...] = setting((), "a chair stands there (x y) from chair_s on; empty: none", unit="m")
    chair_s: float = setting(6.0, "when the chair is put there, after the start", unit="s", low=0.0, high=3600.0)
    motions: tuple[str, ...] = setting((), "names of motions in order, repeated for ever; empty: a varied sequence")
    empty_s: float = setting(2.0, "the room is empty this long at first", unit="s", low=0.0, high=3600.0)
    noise_sigma: float = setting(2.5, "sensor noise", unit="grey levels", low=0.0, high=25.0)
    light_drift: float = setting(0.03, "slow change of the light", unit="fraction", low=0.0, high=0.5)
    seed: int = setting(0, "of textures, motions and noise", low=0, high=2**31 - 1)
    world_frame: str = setting("room", "TF frame of the world")


class SimulatedCamerasNode(Node):
    """Renders and publishes the cameras of one simulated room."""

    def __init__(self, node_name: str = "simulated_cameras", **node_options: Any) -> None:
        super().__init__(node_name, **node_options)
        self.settings = s = NodeParameters(self).declare(SimulationSettings, on_change=self._on_settings)
        rig = load_rig(s.rig_file) if s.rig_file else default_rig(s.number_of_cameras, s.width, s.height)
        if s.save_rig:
            save_rig(rig, s.save_rig)
        self.cameras = tuple(rig.camera(name) for name in s.cameras or rig.names)
        # one process tells the truth: the one with the rig's first camera
        self.tells_truth = self.cameras[0].name == rig.names[0]
        if s.chair and len(s.chair) != 2:
            raise ConfigError(f"parameter chair: expected two numbers x y in m, or none, got {list(s.chair)}")
        self.room = SimulatedRoom(
            rig,
            s.person,
            s.seed,
            s.empty_s,
            s.motions or None,
            s.noise_sigma,
            s.light_drift,
            motions=company(s.people, s.together, s.seed, s.empty_s, s.person) if s.people > 1 else (),
            things=[chair([(s.chair_s, s.chair[0], s.chair[1], 0.3)])] if s.chair else (),
        )
        self.get_logger().info("painting the room")
        self.room.warm_up()
        self.raw = self._image_publishers(Image, topics.image, ("raw", "both"))
        self.jpeg = self._image_publishers(CompressedImage, topics.image_compressed, ("compressed", "both"))
        self.infos = {
            c.name: self.create_publisher(CameraInfo, topics.camera_info(c.name), topics.STREAM_QOS)
            for c in self.cameras
        }
        self.truth = [
            self.create_publisher(PoseArray, topics.true_joints(n), topics.STREAM_QOS)
            for n in range(1, s.people + 1)
            if self.tells_truth
        ]
        # Only stamps and pixels change; making the whole messages anew costs more than sending them.
        self.images = {c.name: ImageCdr(c.height, c.width, topics.optical_frame(c.name)) for c in self.cameras}
        self.info_messages = {
            c.name: StampedCdr(camera_to_info(c, make_header(0, topics.optical_frame(c.name)))) for c in self.cameras
        }
        self.transforms = TransformOutput(self, static=True)
        self.transforms.send(
            [
                transform_to_message(c.T_world_camera, topics.optical_frame(c.name), make_header(0, s.world_frame))
                for c in self.cameras
            ]
        )
        self.meter, self.render_ms = Meter(), float("nan")
        self.health = Health(self, self.describe)
        self.period_ns = round(NANOSECONDS / s.rate_hz)
        self.start_ns: int | None = None
        if s.start_s:
            self.start_ns = round(s.start_s * NANOSECONDS) // self.period_ns * self.period_ns
        self.made_s = time.monotonic()
        self.last_frame, self.skipped = -1, 0
        self.rendered: tuple[int, list[str]] = (-1, [])  # a frame, and the cameras whose `images` show it
        self.tick_ns = self.period_ns // TICKS
        self.create_timer(self.tick_ns / NANOSECONDS, self.on_timer, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def on_timer(self) -> None:
        """Publish the newest frame that is due; under load frames are skipped, as a camera driver would.

        Frames are drawn ahead, because real cameras need no time for it, and are sent at their stamps.
        """
        now = self.get_clock().now().nanoseconds
        if self.start_ns is None:
            if not self._is_watched() and time.monotonic() - self.made_s < self.settings.wait_for_viewers_s:
                return
            self.start_ns = now // self.period_ns * self.period_ns
        frame, since_ns = divmod(now - self.start_ns, self.period_ns)
        until_ns = self.period_ns - since_ns
        if frame > self.last_frame:
            self.publish(frame)
        elif until_ns <= self.tick_ns:
            time.sleep(until_ns / NANOSECONDS)
            self.publish(frame + 1)
        elif since_ns > self.period_ns // 2 and self.rendered[0] <= frame:
            self.render(frame + 1)

    def render(self, frame: int) -> None:
        """Draw what the watched cameras see in a frame."""
        started, t = time.thread_time(), frame * self.period_ns / NANOSECONDS
        watched = [c.name for c in self.cameras if _watched(self.raw.get(c.name)) or _watched(self.jpeg.get(c.name))]
        for name in watched:
            self.room.render(name, t, self.images[name].pixels)
        self.rendered = frame, watched
        self.render_ms = 1e3 * (time.thread_time() - started)

    def _is_watched(self) -> bool:
        """Whether somebody subscribed to every camera."""
        return all(_watched(self.raw.get(c.name)) or _watched(self.jpeg.get(c.name)) for c in self.cameras)

    def publish(self, frame: int) -> None:
        """Publish one instant."""
        assert self.start_ns is not None
        if self.last_frame >= 0:
            self.skipped += frame - self.last_frame - 1
        self.last_frame = frame
        stamp, t = self.start_ns + frame * self.period_ns, frame * self.period_ns / NANOSECONDS
        if self.rendered[0] != frame:
            self.render(frame)
        for camera in self.cameras:
            self.infos[camera.name].publish(self.info_messages[camera.name].stamped(stamp))
            if camera.name not in self.rendered[1]:
                continue
            image = self.images[camera.name]
            raw, jpeg = _watched(self.raw.get(camera.name)), _watched(self.jpeg.get(camera.name))
            if raw is not None:
                raw.publish(image.stamped(stamp))
            if jpeg is not None:
                header = make_header(stamp, topics.optical_frame(camera.name))
                jpeg.publish(pixels_to_compressed(image.pixels, header, self.settings.jpeg_quality))
        if self.truth:
            for publisher, joints in zip(self.truth, self.room.everybodys_joints(t), strict=True):
                publisher.publish(joints_cdr(joints, stamp, self.settings.world_frame))
        self.meter.tick(self.health.latency_s(stamp))

    def describe(self) -> Sequence[DiagnosticStatus]:
        """Whether the images keep their pace."""
        wanted, level, message = self.settings.rate_hz, OK, "filming"
        if 0 < self.meter.rate_hz < 0.9 * wanted:
            level, message = WARN, f"only {self.meter.rate_hz:.1f} of {wanted:g} images per second: the machine is busy"
        values = {
            "rate_hz": self.meter.rate_hz,
            "latency_ms": self.meter.latency_ms,
            "render_ms": self.render_ms,
            "frames": self.meter.count,
            "frames_skipped": self.skipped,
            "cameras": " ".join(camera.name for camera in self.cameras),
        }
        return [make_status(f"{self.get_name()}: images", level, message, values)]

    def _image_publishers(self, kind: Any, name_topic: Any, transports: Sequence[str]) -> dict[str, Any]:
        if self.settings.transport not in transports:
            return {}
        return {c.name: self.create_publisher(kind, name_topic(c.name), topics.STREAM_QOS) for c in self.cameras}

    def _on_settings(self, settings: SimulationSettings) -> None:
        self.settings = settings


def _watched(publisher: Any | None) -> Any | None:
    """The publisher if it exists and somebody subscribed to it."""
    return publisher if publisher is not None and publisher.get_subscription_count() else None


def main() -> int:
    """Run the simulated cameras."""
    return node_main.main(SimulatedCamerasNode)


if __name__ == "__main__":
    raise SystemExit(main())
