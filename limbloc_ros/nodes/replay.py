# SPDX-License-Identifier: Apache-2.0
"""rosbag2 recording -> topics and `/clock`, in real time or step by step with the results.

Step by step (`mode: stepped`) the images of one instant are published, and the next ones wait until the pose node has
answered: nothing is lost on a slow machine, and the same bag gives bit-identical joint angles every time.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import PoseArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage

from limbloc_ros.core.config import SyncConfig, setting
from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.core.synchroniser import NANOSECONDS, StampSynchroniser
from limbloc_ros.recordings.bag_frames import header_stamp_ns
from limbloc_ros.recordings.bags import BagMessage, BagReader, BagTopic
from limbloc_ros.ros import node_main
from limbloc_ros.ros.messages import stamp_ns
from limbloc_ros.ros.parameters import NodeParameters
from limbloc_ros.ros.raw_messages import check_cdr, message_class
from limbloc_ros.ros.topics import JOINTS, STREAM_QOS, patterns

IMAGES = re.compile(r"/image_raw(/compressed)?$")
MASKS = re.compile(r"/mask(/compressed)?$")
#: What goes with the images: calibration, fixed frames, a simulated person's true joints.
COMPANIONS = re.compile(r"/(camera_info|tf_static|true_joints)$")

CLOCK_PERIOD_S = 0.01


@dataclass(frozen=True)
class ReplaySettings:
    """How a recording is replayed."""

    bag: str = setting("", "rosbag2 folder, or an .mcap or .db3 file")
    mode: str = setting(
        "realtime", "at the recorded pace, or step by step with the results", choices=("realtime", "stepped")
    )
    rate: float = setting(1.0, "pace of realtime mode, 2 is twice as fast", low=0.01, high=100.0)
    start_s: float = setting(0.0, "skip this much of the recording", unit="s", low=0.0, high=1e6)
    duration_s: float = setting(0.0, "replay this much of it (0: to the end)", unit="s", low=0.0, high=1e6)
    loop: bool = setting(False, "begin again at the end")
    select: str = setting(
        "inputs",
        "what is published: the images and what belongs to them (the masks where there are no images), or everything",
        choices=("inputs", "images", "masks", "all"),
    )
    topics: tuple[str, ...] = setting((), "names or regular expressions of topics, in place of `select`")
    clock: bool = setting(True, "publish /clock (start the other nodes with use_sim_time)")
    wait_for_subscribers_s: float = setting(
        30.0,
        "wait this long for somebody to listen to the images or masks (0: begin at once)",
        unit="s",
        low=0.0,
        high=3600.0,
    )
    wait_for_results: bool = setting(
        False, "wait as long for somebody to publish `result_topic`, too (stepped mode and a smart space always do)"
    )
    settle_s: float = setting(
        1.0, "pause between the first subscriber and the first message", unit="s", low=0.0, high=60.0
    )
    result_topic: str = setting(JOINTS, "PoseArray that answers each set of images in stepped mode")
    min_cameras: int = setting(2, "stepped mode expects no answer to fewer images than this", low=1, high=64)
    result_timeout_s: float = setting(
        10.0, "stepped mode goes on without an answer after this", unit="s", low=0.1, high=3600.0
    )


class ReplayNode(Node):
    """Publishes a recording from a thread of its own, so that it keeps its pace beside other nodes.

    Attributes:
        done: set when the recording has ended or failed.
        error: why it failed; None otherwise.
        published, unanswered, invalid: messages published; sets without a result; messages left out as damaged.

    Raises:
        InputError: no readable bag, or none of the wanted topics in it.
        ConfigError: `bag` is not set, or a topic pattern is no regular expression.
    """

    def __init__(self, node_name: str = "replay", **node_options: Any) -> None:
        super().__init__(node_name, **node_options)
        parameters = NodeParameters(self)
        self.settings = parameters.declare(ReplaySettings)
        self._sync = parameters.declare(SyncConfig, "sync")
        if not self.settings.bag:
            raise ConfigError("parameter bag: expected a rosbag2 folder or file, got none")
        self.done = threading.Event()
        self.error: str | None = None
        self.published = self.unanswered = self.invalid = self.steps = 0
        self._stop = threading.Event()
        self._clock_lock = threading.Lock()
        self._answered = threading.Condition()
        self._answers: set[int] = set()
        self._bag = BagReader(self.settings.bag)
        try:
            self._open()
        except BaseException:
            self._bag.close()
            raise
        # Time must go on, for timers on ROS time, also while nothing is published.
        self.create_timer(CLOCK_PERIOD_S, self._publish_clock, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._thread = threading.Thread(target=self._run, name="replay", daemon=True)
        self._thread.start()

    def _open(self) -> None:
        """Choose the topics and make their publishers."""
        if self._bag.damage:
            self.get_logger().warning(f"{self._bag.path}: {self._bag.damage}")
        self._selected = self._select()
        self._pixels = {name for name in self._selected if IMAGES.search(name) or MASKS.search(name)}
        if self.settings.mode == "stepped" and not self._pixels:
            raise InputError(f"{self._bag.path}: stepped mode needs image_raw or mask topics, found none")
        self._outputs = {t.name: self._publisher(t) for t in self._selected.values()}
        self._clock = self.create_publisher(ClockMessage, "/clock", 10) if self.settings.clock else None
        self._now_ns = self._start_ns = self._bag.start_ns + round(self.settings.start_s * NANOSECONDS)
        self._stop_ns = 2**63 - 1
        if self.settings.duration_s:
            self._stop_ns = self._start_ns + round(self.settings.duration_s * NANOSECONDS)
        if self.settings.mode == "stepped":
            self.create_subscription(PoseArray, self.settings.result_topic, self._on_result, STREAM_QOS)

    def destroy_node(self) -> None:
        """Stop the thread, close the bag, destroy the node."""
        self._stop.set()
        with self._answered:
            self._answered.notify_all()
        self._thread.join()
        self._bag.close()
        super().destroy_node()

    def summary(self) -> str:
        """What was replayed, for people."""
        text = f"replayed {self.published} messages of {len(self._selected)} topics from {self._bag.path}"
        if self.settings.mode == "stepped":
            text += f", {self.steps} sets of images, {self.unanswered} without a result"
        if self.invalid:
            text += f", {self.invalid} damaged messages left out"
        return text + (f". {self._bag.damage}" if self._bag.damage else "")

    # --- what is replayed ---

    def _select(self) -> dict[str, BagTopic]:
        """The bag's topics that are wanted."""
        known = self._bag.topics
        if self.settings.topics:
            wanted = patterns("topics", self.settings.topics)
            chosen = {n: t for n, t in known.items() if any(p.fullmatch(n) for p in wanted)}
        elif self.settings.select == "all":
            chosen = {n: t for n, t in known.items() if n != "/clock"}
        else:
            select = self.settings.select
            if select == "inputs":
                select = "images" if any(IMAGES.search(n) and t.count for n, t in known.items()) else "masks"
            pattern = IMAGES if select == "images" else MASKS
            chosen = {n: t for n, t in known.items() if pattern.search(n)}
            if chosen:
                chosen |= {n: t for n, t in known.items() if COMPANIONS.search(n) and self._is_installed(t)}
        if not chosen:
            raise InputError(
                f"{self._bag.path} has none of the wanted topics (select {self.settings.select}, topics "
                f"{list(self.settings.topics)}); it has {', '.join(sorted(known)) or 'no topics at all'}"
            )
        return chosen

    def _is_installed(self, topic: BagTopic) -> bool:
        """Whether a companion can be published here: tf2_msgs is only part of an installed ROS."""
        try:
            message_class(topic.type)
        except InputError as error:
            self.get_logger().warning(f"{topic.name} is left out: {error}")
            return False
        return True

    def _publisher(self, topic: BagTopic) -> Publisher:
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=10,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE,
        )
        return self.create_publisher(message_class(topic.type), topic.name, qos)

    def _messages(self) -> Iterator[BagMessage]:
        return self._bag.messages(self._selected, self._start_ns, self._stop_ns)

    # --- the thread ---

    def _run(self) -> None:
        try:
            self._wait_for_subscribers()
            while not self._stop.is_set():
                before = self.published
                if self.settings.mode == "stepped":
                    self._replay_stepped()
                else:
                    self._replay_realtime()
                if not self.settings.loop or self._stop.is_set() or self.published == before:
                    break
                self.get_logger().info(f"{self._bag.path}: from the start again")
            if not self._stop.is_set():
                self.get_logger().info(self.summary())
        except InputError as error:
            self.error = str(error)
            self.get_logger().fatal(self.error)
        except Exception as error:
            self.error = f"{type(error).__name__}: {error}"
            raise
        finally:
            self.done.set()

    def _wait_for_subscribers(self) -> None:
        if not self.settings.wait_for_subscribers_s:
            return
        needed = self._pixels or set(self._outputs)
        results = self.settings.wait_for_results or self.settings.mode == "stepped"
        deadline = time.monotonic() + self.settings.wait_for_subscribers_s
        while not self._stop.is_set():
            waiting = sorted(name for name in needed if not self._outputs[name].get_subscription_count())
            if results and not self.count_publishers(self.settings.result_topic):
                waiting.append(f"{self.settings.result_topic} (nobody publishes it)")
            if not waiting:
                self._stop.wait(self.settings.settle_s)
                return
            if time.monotonic() > deadline:
                self.get_logger().warning(
                    f"no other end of {', '.join(waiting)} after {self.settings.wait_for_subscribers_s:g} s; "
                    "starting all the same"
                )
                return
            self._stop.wait(0.05)

    def _replay_realtime(self) -> None:
        began = time.monotonic()
        for message in self._messages():
            due = began + (message.stamp_ns - self._start_ns) / 1e9 / self.settings.rate
            while (wait := due - time.monotonic()) > 0:
                self._now_ns = message.stamp_ns - round(wait * self.settings.rate * NANOSECONDS)
                if self._stop.wait(min(wait, CLOCK_PERIOD_S)):
                    return
            self._now_ns = message.stamp_ns
            self._publish(message)
            if self._stop.is_set():
                return

    def _replay_stepped(self) -> None:
        """One set of images, wait for its result, the next."""
        # Every frame is published, so no set may be dropped and no camera be given up.
        synchroniser: StampSynchroniser[BagMessage] = StampSynchroniser(
            sorted(self._pixels), self._sync.slop_s, max(self._sync.queue, 30), min_cameras=1, silent_sets=0
        )
        companions: list[BagMessage] = []
        for message in self._messages():
            if message.topic not in self._pixels:
                companions.append(message)
                continue
            try:
                stamp = header_stamp_ns(message.cdr, message.topic)
            except InputError as error:
                self._leave_out(error)
                continue
            sets = synchroniser.add(message.topic, stamp, message)
            for frame_set in sets:
                companions = self._step(frame_set.stamp_ns, frame_set.skew_ns, frame_set.items, companions)
            if self._stop.is_set():
                return
        for frame_set in synchroniser.flush():
            companions = self._step(frame_set.stamp_ns, frame_set.skew_ns, frame_set.items, companions)
        for message in companions:
            self._publish(message)
        if late := sum(synchroniser.counters.late.values()):
            self.get_logger().warning(f"{late} images were recorded too late to belong to a set and were left out")

    def _step(
        self, stamp: int, skew: int, frames: dict[str, BagMessage], companions: list[BagMessage]
    ) -> list[BagMessage]:
        """Publish one set, after what was recorded before its end; returns what was recorded later."""
        if self._stop.is_set():
            return companions
        end_ns = max(message.stamp_ns for message in frames.values())
        self._now_ns = end_ns
        for message in companions:
            if message.stamp_ns <= end_ns:
                self._publish(message)
        with self._answered:
            self._answers.clear()
        for message in frames.values():
            self._publish(message)
        later = [message for message in companions if message.stamp_ns > end_ns]
        if len(frames) < self.settings.min_cameras:
            return later
        self.steps += 1
        with self._answered:
            answered = self._answered.wait_for(
                lambda: self._stop.is_set() or any(stamp <= answer <= stamp + skew for answer in self._answers),
                self.settings.result_timeout_s,
            )
        if not answered:
            self.unanswered += 1
            missing = sorted(self._pixels - set(frames))
            self.get_logger().warning(
                f"no {self.settings.result_topic} for the images of {stamp / 1e9:.3f} s within "
                f"{self.settings.result_timeout_s:g} s"
                + (f" (not in the bag: {', '.join(missing)})" if missing else "")
            )
        return later

    def _publish(self, message: BagMessage) -> None:
        try:
            check_cdr(self._selected[message.topic].type, message.cdr, message.topic)
        except InputError as error:
            self._leave_out(error)
            return
        self._publish_clock()
        self._outputs[message.topic].publish(message.cdr)
        self.published += 1

    def _leave_out(self, error: InputError) -> None:
        self.invalid += 1
        self.get_logger().error(f"left out a damaged message: {error}", throttle_duration_sec=5.0)

    def _publish_clock(self) -> None:
        if self._clock is None or self._stop.is_set():
            return
        with self._clock_lock:  # the timer and the thread must not overtake each other: time would go back
            msg = ClockMessage()
            msg.clock.sec, msg.clock.nanosec = divmod(self._now_ns, NANOSECONDS)
            self._clock.publish(msg)

    def _on_result(self, msg: PoseArray) -> None:
        with self._answered:
            self._answers.add(stamp_ns(msg.header))
            self._answered.notify_all()


def main() -> int:
    """Replay one bag; ends with it."""
    made: list[ReplayNode] = []

    def make() -> ReplayNode:
        made.append(ReplayNode())
        return made[0]

    code = node_main.main(make, until=lambda: made[0].done.is_set())
    return 1 if made and made[0].error else code


if __name__ == "__main__":
    raise SystemExit(main())
