# SPDX-License-Identifier: Apache-2.0
"""Camera drivers that misbehave on cue: they film the stage and publish what a tamper makes of each image."""

from __future__ import annotations

import heapq
import itertools
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import Image

from limbloc_ros.ros import topics
from limbloc_ros.ros.image_messages import pixels_to_image
from limbloc_ros.ros.messages import NANOSECONDS, make_header

from .stage import Stage


@dataclass(frozen=True)
class Shot:
    """One image on its way: of which camera, with which stamp, and when it is sent (monotonic clock)."""

    camera: str
    stamp_ns: int
    pixels: NDArray[np.uint8]
    due_s: float


#: Makes of an image what the faulty camera sends instead: nothing, another one, several, later.
Tamper = Callable[[Shot], Iterable[Shot]]


class Cameras:
    """All cameras of a stage, at one rate, in step.

    Args:
        node: where the publishers live.
        stage: what they film.
        rate_hz: images a second of each.
        namespace: put before the topics.

    Attributes:
        tampers: the fault of a camera, by name.
        shift_s: added to the stamps (a clock that was set, a bag that is looped).
        truth: what was there, by stamp: joints [25, 3] or None; guests: the same of the second person.
        filmed_s: when each instant was filmed, monotonic clock.
        filming: whether they send anything.
    """

    def __init__(self, node: Node, stage: Stage, rate_hz: float, namespace: str = "") -> None:
        self.stage = stage
        self.period_s = 1.0 / rate_hz
        self.tampers: dict[str, Tamper] = {}
        self.shift_s = 0.0
        self.truth: dict[int, NDArray[np.float64] | None] = {}
        self.guests: dict[int, NDArray[np.float64] | None] = {}
        self.filmed_s: list[float] = []
        self.filming = True
        self._publishers = {
            name: node.create_publisher(Image, f"{namespace}{topics.image(name)}", topics.STREAM_QOS)
            for name in stage.rig.names
        }
        self._next_s = time.monotonic()
        self._waiting: list[tuple[float, int, Shot]] = []
        self._order = itertools.count()

    @property
    def watched(self) -> bool:
        """Whether somebody takes the images of every camera."""
        return all(p.get_subscription_count() for p in self._publishers.values())

    def tick(self) -> None:
        """Film when it is time, and send what is due; call it often."""
        now = time.monotonic()
        if now >= self._next_s:
            behind = now - self._next_s
            self._next_s += self.period_s * (1 + behind // self.period_s)
            self._film(now)
        while self._waiting and self._waiting[0][0] <= time.monotonic():
            _, _, shot = heapq.heappop(self._waiting)
            header = make_header(shot.stamp_ns, topics.optical_frame(shot.camera))
            self._publishers[shot.camera].publish(pixels_to_image(shot.pixels, header))

    def forget_all_but(self, last: int) -> None:
        """Keep only what is known of the last instants."""
        for known in (self.truth, self.guests):
            for stamp in list(known)[:-last]:
                del known[stamp]
        del self.filmed_s[:-last]

    def _film(self, now: float) -> None:
        wall_ns = time.time_ns()
        images, joints = self.stage.shoot(self.period_s, wall_ns / NANOSECONDS)
        stamp_ns = wall_ns + round(self.shift_s * NANOSECONDS)
        self.truth[stamp_ns], self.guests[stamp_ns] = joints, self.stage.guest_joints
        self.filmed_s.append(now)
        if not self.filming:
            return
        for name, pixels in images.items():
            shot = Shot(name, stamp_ns, pixels, now)
            for sent in self.tampers[name](shot) if name in self.tampers else (shot,):
                heapq.heappush(self._waiting, (sent.due_s, next(self._order), sent))
