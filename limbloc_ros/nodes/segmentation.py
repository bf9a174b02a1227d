# SPDX-License-Identifier: Apache-2.0
"""Camera image -> mask of the person (paper section 1); one node per camera."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from limbloc_ros.core.background import UNREST, BackgroundModel, warm_up
from limbloc_ros.core.config import BackgroundConfig, setting
from limbloc_ros.core.errors import InputError
from limbloc_ros.core.images import Pixels
from limbloc_ros.core.segmentation import Segmentation
from limbloc_ros.recordings.background_file import load_background, save_background
from limbloc_ros.recordings.videos import pictures_in, read_picture
from limbloc_ros.ros import image_messages, node_main, topics
from limbloc_ros.ros.backlog import Backlog, Thinning
from limbloc_ros.ros.cdr import SentCompressed, SentImage, mask_cdr, read_sent
from limbloc_ros.ros.health import SILENT_S, WINDOW_S, Health, Meter
from limbloc_ros.ros.messages import ERROR, NANOSECONDS, OK, WARN, make_header, make_status, stamp_ns
from limbloc_ros.ros.parameters import NodeParameters

#: A camera that sends the very same picture for this long (by its stamps) is frozen: a live sensor has noise.
FROZEN_S = 1.0

#: With less of the background's light than this, or more than its inverse, masks lose parts of low contrast.
DIM = 0.5
#: With less than this they lose arms and legs, and the figure is put elsewhere: of a simulated room's poses in 0.35 of
#: the light all 42 were wrong, in 0.45 none.
TOO_DARK = 0.4

#: The background follows the light; so often what is kept of it does too.
SAVE_PERIOD_S = 60.0


@dataclass(frozen=True)
class SegmentationSettings:
    """What only this node needs to know."""

    camera: str = setting("camera", "name of the camera, the prefix of its topics")
    transport: str = setting("raw", "which of the camera's topics is read", choices=("raw", "compressed"))
    reliability: str = setting(
        "best_effort",
        "of the image subscription; best_effort works with every camera",
        choices=("best_effort", "reliable"),
    )
    background_picture: str = setting(
        "", "picture of the empty room, or a folder with one named like the camera; empty: the first images show it"
    )
    state_folder: str = setting(
        "", "the learned background is kept here and found again after a restart; empty: it is learned anew"
    )
    publish: str = setting("on_demand", "masks nobody subscribed to are left out", choices=("on_demand", "always"))
    catch_up_s: float = setting(
        0.5,
        "images may wait this long, by their stamps, for a slow moment to pass; then all cameras skip the same ones",
        unit="s",
        low=0.0,
        high=10.0,
    )


class SegmentationNode(Node):
    """Subscribes to a camera's images and publishes `<camera>/mask` and `<camera>/mask/compressed`."""

    def __init__(self, node_name: str = "segmentation", **node_options: Any) -> None:
        super().__init__(node_name, **node_options)
        parameters = NodeParameters(self)
        self.settings = parameters.declare(SegmentationSettings)
        self.model = BackgroundModel(parameters.declare(BackgroundConfig, "background", self._on_config))
        if self.settings.background_picture:
            self.model.seed(background_picture(Path(self.settings.background_picture), self.settings.camera))
        warm_up()
        folder = self.settings.state_folder
        self.state_file = Path(folder) / f"{self.settings.camera}.npz" if folder else None
        self.saved_s: float | None = None
        self.last: Segmentation | None = None
        self.last_pixels: Pixels | None = None
        self.same_since_ns = 0
        self.frozen_s = 0.0
        self.relit_s = -WINDOW_S
        self.meter = Meter()
        self.segment_ms = float("nan")
        self.thinning = Thinning()
        self.backlog: Backlog[SentImage | SentCompressed] = Backlog(
            self, self.segment, self.settings.catch_up_s, self.tell_others
        )
        self.skips = self.create_publisher(Header, topics.FRAMES_SKIPPED, topics.STREAM_QOS)
        self.create_subscription(Header, topics.FRAMES_SKIPPED, self.on_skipped, topics.STREAM_QOS)
        camera = self.settings.camera
        self.raw_mask = self.create_publisher(Image, topics.mask(camera), topics.STREAM_QOS)
        self.png_mask = self.create_publisher(CompressedImage, topics.mask_compressed(camera), topics.STREAM_QOS)
        self.health = Health(self, self.describe)
        qos = topics.image_subscription(self.settings.reliability)
        if self.settings.transport == "raw":
            self.topic, self.kind = topics.image(camera), Image
        else:
            self.topic, self.kind = topics.image_compressed(camera), CompressedImage
        self.restore_background()
        self.create_subscription(self.kind, self.topic, self.on_image, qos, raw=True)
        self.create_service(Trigger, topics.RECAPTURE_BACKGROUND, self.on_recapture)
        self.create_service(SetBool, topics.FREEZE_BACKGROUND, self.on_freeze)

    def on_image(self, cdr: bytes) -> None:
        """One image: into the backlog."""
        with self.health.guard(f"camera {self.settings.camera}"):
            sent = read_sent(self.kind, cdr)
            if self.thinning.takes(sent.stamp_ns):
                self.backlog.add(sent.stamp_ns, sent)
            else:
                self.backlog.left_out()

    def tell_others(self, stamp: int) -> None:
        """We skipped our images up to this stamp (ns): without them the other cameras' are worth little."""
        self.skips.publish(make_header(stamp, self.settings.camera))

    def on_skipped(self, msg: Header) -> None:
        """Another camera (or we) skipped its images up to this stamp."""
        stamp = stamp_ns(msg)
        self.thinning.announced(stamp)
        self.backlog.skip_until(stamp)

    def segment(self, sent: SentImage | SentCompressed) -> None:
        """Segment one image, publish its mask with the image's stamp and frame."""
        started = time.thread_time()
        with self.health.guard(f"camera {self.settings.camera}"):
            pixels = image_messages.message_to_pixels(sent)
            stamp, relit = sent.stamp_ns, self.model.relit
            self.watch_for_freeze(pixels, stamp)
            self.last = self.model.segment(pixels)
            if self.model.relit > relit:
                self.relit_s, self.saved_s = time.monotonic(), None  # who is started again needs the new light
            self.meter.tick(self.health.latency_s(stamp))
            if self.last.mask.any() and (self.frozen_s > FROZEN_S or min(self.last.gain) < TOO_DARK):
                return  # an old silhouette, or half of one, would cut the hull of who is there
            always = self.settings.publish == "always"
            if always or self.raw_mask.get_subscription_count():
                self.raw_mask.publish(image_messages.mask_to_image(self.last.mask, make_header(stamp, sent.frame_id)))
            if always or self.png_mask.get_subscription_count():
                self.png_mask.publish(mask_cdr(self.last.mask, stamp, sent.frame_id))
            self.save_background()
            self.segment_ms = 1e3 * (time.thread_time() - started)

    def watch_for_freeze(self, pixels: Pixels, stamp: int) -> None:
        """Count for how long (by stamps, ns) the camera has sent the same picture."""
        last = self.last_pixels
        # Of a picture that is new, as almost all are, a row tells.
        if last is None or _middle_row(pixels) != _middle_row(last) or not np.array_equal(pixels, last):
            self.same_since_ns = stamp
        self.last_pixels = pixels
        self.frozen_s = (stamp - self.same_since_ns) / NANOSECONDS

    def restore_background(self) -> None:
        """Go on with the background of the process before, if there was one."""
        if self.state_file is None or not self.state_file.is_file():
            return
        with self.health.guard("background"):
            age_s = time.time() - self.state_file.stat().st_mtime
            load_background(self.model, self.state_file)
            self.saved_s = time.monotonic()
            self.get_logger().info(f"going on with the background of {self.state_file}, {age_s:.0f} s old")

    def save_background(self) -> None:
        """Keep the background for the process after us, now and then."""
        now = time.monotonic()
        if self.state_file is None or self.model.learning or (self.saved_s and now - self.saved_s < SAVE_PERIOD_S):
            return
        self.saved_s = now
        with self.health.guard("background"):
            save_background(self.model, self.state_file)

    def forget_background(self) -> None:
        """What was saved is no longer to be used."""
        self.saved_s = None
        try:
            if self.state_file is not None:
                self.state_file.unlink(missing_ok=True)
        except OSError as error:
            self.health.fault("background", f"{self.state_file} cannot be removed: {error.strerror}; remove it")

    def on_recapture(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Learn the background anew from the next images."""
        self.model.recapture()
        self.forget_background()
        response.success = True
        response.message = f"learning the background of {self.settings.camera}: keep the room empty"
        return response

    def on_freeze(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Stop or resume the background's slow update."""
        self.model.freeze(request.data)
        response.success = True
        response.message = f"background of {self.settings.camera} {'frozen' if request.data else 'follows the light'}"
        return response

    def describe(self) -> Sequence[DiagnosticStatus]:
        """Rate, latency, how much is foreground, and whether it still learns."""
        level, message, fill = OK, "segmenting", float("nan")
        if self.last is not None:
            fill = 100.0 * self.last.foreground_fraction
            wanted = self.model.config.learning_frames
            if self.last.blind:
                level, message = (
                    ERROR,
                    "the images show nothing but one brightness: is the lens covered, the light off?",
                )
            elif self.last.moved:
                level = ERROR
                message = (
                    "the camera shows another view than its background: was it moved, covered or exchanged? There are "
                    "no masks until the view is back; if it is to stay, calibrate anew and call "
                    f"{self.get_name()}/recapture_background"
                )
            elif self.last.light_jump:
                level, message = WARN, "most of the image changed at once: was the light switched or the camera moved?"
            elif self.last.learning:
                progress = f"{self.last.frames_learned} of {wanted} images"
                level, message = WARN, f"learning the background ({progress}): keep the room empty"
        if level == OK and self.frozen_s > FROZEN_S:
            level, message = ERROR, f"the camera has sent the very same picture for {self.frozen_s:.0f} s: it is frozen"
        if level == OK and self.last is not None and not DIM < min(self.last.gain) <= max(self.last.gain) < 1 / DIM:
            dark = min(self.last.gain) < TOO_DARK
            level = ERROR if dark else WARN
            lost = "there are no masks of people" if dark else "parts of people may be missed"
            message = (
                f"the light is {100 * min(self.last.gain):.0f} % of the background's: {lost}; "
                f"light the room as before, or empty it and call {self.get_name()}/recapture_background"
            )
        if level == OK and time.monotonic() - self.relit_s < WINDOW_S:
            level, message = WARN, "the light was switched: the background was brought to the new light"
        if level == OK and self.model.unrest > UNREST:
            level = WARN
            message = (
                f"{100 * self.model.unrest:.0f} % of the image moved while the background was learned: "
                f"empty the room and call {self.get_name()}/recapture_background"
            )
        if level == OK and self.backlog.behind:
            level, message = WARN, self.backlog.behind
            if self.thinning.rate_hz < float("inf"):
                message += f"; all cameras take {self.thinning.rate_hz:g} images a second at most"
        if self.meter.silence_s > SILENT_S:
            publishers = self.count_publishers(self.topic)
            why = "nobody publishes it" if publishers == 0 else f"{publishers} publisher(s), but no usable image came"
            level, message = ERROR, f"no image on {self.topic} for {self.meter.silence_s:.0f} s: {why}"
        values = {
            "rate_hz": self.meter.rate_hz,
            "latency_ms": self.meter.latency_ms,
            "segment_ms": self.segment_ms,
            "images_segmented": self.meter.count,
            "images_skipped": self.backlog.skipped,
            "mask_fill_percent": fill,
            "learning": self.model.learning,
            "frozen": self.model.frozen,
            "times_relit": self.model.relit,
        }
        return [make_status(f"{self.get_name()}: mask", level, message, values, self.settings.camera)]

    def _on_config(self, config: BackgroundConfig) -> None:
        self.model.config = config


def _middle_row(pixels: Pixels) -> bytes:
    return bytes(pixels[len(pixels) // 2])


def background_picture(path: Path, camera: str) -> Pixels:
    """The picture of the empty room; `path` is the file, or a folder with a file named like the camera.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    if path.is_dir():
        found = [file for file in pictures_in(path) if file.stem == camera]
        if not found:
            raise InputError(f"parameter background_picture: {path} has no file {camera}.png or {camera}.jpg")
        path = found[0]
    return read_picture(path)


def main() -> int:
    """Run one segmentation node."""
    return node_main.main(SegmentationNode)


if __name__ == "__main__":
    raise SystemExit(main())
