# SPDX-License-Identifier: Apache-2.0
"""Record and replay over real DDS: the same bytes, in step with the results, and what happens on bad input."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseArray
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String

from limbloc_ros.core.errors import ConfigError, InputError, OutputError
from limbloc_ros.nodes.record import RecordNode
from limbloc_ros.nodes.replay import ReplayNode
from limbloc_ros.recordings.bags import BagReader, BagWriter
from limbloc_ros.ros import topics
from limbloc_ros.ros.image_messages import mask_to_compressed, pixels_to_image
from limbloc_ros.ros.messages import make_header, stamp_ns
from limbloc_ros.ros.node_main import spin
from limbloc_ros.ros.raw_messages import check_cdr, message_class

MS = 1_000_000
T0 = 1_700_000_000_000_000_000
IMAGE, COMPRESSED, TEXT = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "std_msgs/msg/String"
DOMAIN = 1 + os.getpid() % 100


@pytest.fixture
def context(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    context = Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    yield context
    context.try_shutdown()


@pytest.fixture
def make(context):
    """Builds nodes in this test's domain and destroys them at the end."""
    nodes = []

    def build(kind, *args, **parameters):
        overrides = [Parameter(name.replace("__", "."), value=value) for name, value in parameters.items()]
        node = kind(*args, context=context, parameter_overrides=overrides)
        nodes.append(node)
        return node

    yield build
    for node in nodes:
        node.destroy_node()


def picture(camera, k):
    return ((np.arange(48 * 64 * 3) * (3 + camera) + k) % 256).astype(np.uint8).reshape(48, 64, 3)


def image(camera, k):
    return pixels_to_image(picture(camera, k), make_header(T0 + 40 * k * MS + camera * MS, f"cam{camera}_optical"))


def png(camera, k):
    mask = np.zeros((48, 64), np.uint8)
    mask[k : k + 10, camera : camera + 20] = 255
    return mask_to_compressed(mask, make_header(T0 + 40 * k * MS + camera * MS, f"cam{camera}_optical"))


def write_bag(path, count=6, cameras=2, lost=(), make_message=image, ending="image_raw", kind=IMAGE):
    """A recording of camera frames, a latched text and results that must not be replayed; returns its messages."""
    written = []
    with BagWriter(path) as bag:
        bag.add_topic("/humans/bodies/p1/urdf", TEXT, latched=True)
        bag.add_topic("/joints", "geometry_msgs/msg/PoseArray")
        for camera in range(cameras):
            bag.add_topic(f"/cam{camera}/{ending}", kind)
        bag.write("/humans/bodies/p1/urdf", T0, serialize_message(String(data="<robot/>")))
        for k in range(count):
            for camera in range(cameras):
                if (camera, k) in lost:
                    continue
                entry = (
                    f"/cam{camera}/{ending}",
                    T0 + 40 * k * MS + camera,
                    serialize_message(make_message(camera, k)),
                )
                bag.write(*entry)
                written.append(entry)
            bag.write("/joints", T0 + 40 * k * MS + 9, serialize_message(PoseArray()))
    return written


class Listener(Node):
    """Collects raw messages."""

    def __init__(self, names, kind, **options):
        super().__init__("listener", **options)
        self.received = []
        for name in names:
            self.create_subscription(kind, name, self.keep(name), 50, raw=True)

    def keep(self, name):
        return lambda cdr: self.received.append((name, cdr))


class Answerer(Node):
    """Answers the first camera's image of each set on `joints`, after a while: a slow graph."""

    def __init__(self, silent_for=(), **options):
        super().__init__("answerer", **options)
        self.received = []
        self.silent_for = silent_for
        self.joints = self.create_publisher(PoseArray, topics.JOINTS, topics.STREAM_QOS)
        for camera in range(2):
            self.create_subscription(Image, f"/cam{camera}/image_raw", self.keep(camera), 1)  # a queue of one
        self.open = 0

    def keep(self, camera):
        return lambda msg: self.on_image(camera, msg)

    def on_image(self, camera, msg):
        self.received.append((camera, stamp_ns(msg.header)))
        k = (self.received[-1][1] - T0) // (40 * MS)
        self.open += 1
        if self.open == 2 and k not in self.silent_for:
            time.sleep(0.05)
            self.joints.publish(PoseArray(header=make_header(T0 + 40 * k * MS, "room")))
        self.open %= 2


def test_a_failure_of_the_replay_is_not_taken_for_its_end(make, tmp_path, monkeypatch):
    write_bag(tmp_path / "walk")
    monkeypatch.setattr(BagReader, "messages", lambda *_: 1 / 0)
    failures = []
    monkeypatch.setattr(threading, "excepthook", failures.append)
    node = make(ReplayNode, bag=str(tmp_path / "walk"), wait_for_subscribers_s=0.0)
    assert node.done.wait(5.0)
    node._thread.join()
    assert "division by zero" in node.error
    assert failures[0].exc_type is ZeroDivisionError  # with its trace, for whoever mends it


def test_the_clock_never_goes_back(make, context, tmp_path):
    """The timer and the replay's thread both publish it."""
    write_bag(tmp_path / "walk", count=50)
    node = make(ReplayNode, bag=str(tmp_path / "walk"), wait_for_subscribers_s=0.0, rate=4.0)
    told = []
    node._clock.publish = lambda msg: told.append(msg.clock.sec * 10**9 + msg.clock.nanosec)
    publish = node._publish_clock

    def slow_timer():
        while not node.done.is_set():
            publish()

    timers = [threading.Thread(target=slow_timer) for _ in range(2)]
    for timer in timers:
        timer.start()
    assert node.done.wait(10.0)
    for timer in timers:
        timer.join()
    assert told == sorted(told)


def test_recording_a_replay_gives_the_same_bytes(make, context, tmp_path):
    written = write_bag(tmp_path / "first", count=10)
    record = make(RecordNode, bag=str(tmp_path / "second"))
    replay = make(ReplayNode, bag=str(tmp_path / "first"), rate=2.0, settle_s=0.3)

    def finished():
        return replay.done.is_set() and sum(record.writer.counts.values()) >= len(written)

    assert spin([record, replay], context, until=finished, timeout_s=20)
    record.finish()
    assert (replay.published, replay.invalid, replay.error) == (len(written), 0, None)
    with BagReader(tmp_path / "second") as bag:
        assert bag.damage == ""
        assert set(bag.topics) == {"/cam0/image_raw", "/cam1/image_raw"}  # no results, no /clock
        got = sorted((m.topic, m.cdr) for m in bag.messages())
    assert len(got) == len(written)
    assert got == sorted((name, cdr) for name, _, cdr in written)
    assert "recorded 20 messages" in record.summary()
    assert "10 " in record.summary()


def test_realtime_keeps_the_pace_and_the_clock(make, context, tmp_path):
    write_bag(tmp_path / "bag", count=10)  # 0.36 s
    ticks = []
    listener = make(Listener, ["/cam0/image_raw", "/cam1/image_raw"], Image)
    listener.create_subscription(Clock, "/clock", lambda m: ticks.append(m.clock.sec * 10**9 + m.clock.nanosec), 100)
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), rate=0.5, settle_s=0.3)
    began = []

    def finished():
        if listener.received and not began:
            began.append(time.monotonic())
        return len(listener.received) == 20

    assert spin([listener, replay], context, until=finished, timeout_s=20)
    assert 0.5 < time.monotonic() - began[0] < 5.0  # 0.72 s at half the pace
    assert ticks == sorted(ticks)
    assert len(set(ticks)) > 15  # also between the messages
    assert ticks[0] >= T0 and ticks[-1] <= T0 + 400 * MS


def test_start_and_duration_choose_a_part(make, context, tmp_path):
    write_bag(tmp_path / "bag", count=10)
    replay = make(
        ReplayNode, bag=str(tmp_path / "bag"), start_s=0.1, duration_s=0.2, wait_for_subscribers_s=0.0, clock=False
    )
    assert spin([replay], context, until=replay.done.is_set, timeout_s=20)
    assert replay.published == 2 * 5  # frames 3 to 7


def test_loop_begins_again(make, context, tmp_path):
    written = write_bag(tmp_path / "bag", count=2)
    listener = make(Listener, ["/cam0/image_raw", "/cam1/image_raw"], Image)
    make(ReplayNode, bag=str(tmp_path / "bag"), loop=True, settle_s=0.3)
    assert spin([listener], context, until=lambda: len(listener.received) >= 12, timeout_s=20)
    assert set(listener.received) == {(name, cdr) for name, _, cdr in written}


def test_stepped_replay_waits_for_each_result(make, context, tmp_path):
    written = write_bag(tmp_path / "bag", count=8)
    answerer = make(Answerer)
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), mode="stepped", rate=100.0, settle_s=0.3)
    assert spin([answerer, replay], context, until=replay.done.is_set, timeout_s=30)
    # Nothing is lost although the receiver is slow and holds one message only; sets do not mix.
    assert len(answerer.received) == len(written)
    for k in range(8):
        assert {camera for camera, _ in answerer.received[2 * k : 2 * k + 2]} == {0, 1}
    assert (replay.steps, replay.unanswered) == (8, 0)


def test_stepped_replay_goes_on_without_an_answer_and_says_so(make, context, tmp_path):
    write_bag(tmp_path / "bag", count=4)
    answerer = make(Answerer, (1,))
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), mode="stepped", result_timeout_s=0.3, settle_s=0.3)
    assert spin([answerer, replay], context, until=replay.done.is_set, timeout_s=30)
    assert (replay.steps, replay.unanswered, len(answerer.received)) == (4, 1, 8)
    assert "4 sets of images, 1 without a result" in replay.summary()


def test_stepped_replay_expects_no_answer_to_a_single_image(make, context, tmp_path):
    write_bag(tmp_path / "bag", count=3, lost={(1, 0)})
    answerer = make(Answerer)
    answerer.open = 1  # the first image stands alone and is not answered
    answerer.silent_for = (0,)
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), mode="stepped", result_timeout_s=20.0, settle_s=0.3)
    assert spin([answerer, replay], context, until=replay.done.is_set, timeout_s=15)
    assert (replay.steps, replay.unanswered, replay.published) == (2, 0, 5)


def test_a_replay_that_expects_results_waits_for_who_makes_them(make, context, tmp_path):
    """The first start of a smart space compiles kernels for a minute; a short bag would be over by then."""
    write_bag(tmp_path / "bag")
    listener = make(Listener, [f"/cam{c}/image_raw" for c in range(2)], Image)
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), wait_for_results=True, settle_s=0.0, rate=100.0)
    assert not spin([listener, replay], context, until=replay.done.is_set, timeout_s=1.0)
    assert replay.published == 0
    listener.create_publisher(PoseArray, topics.JOINTS, topics.STREAM_QOS)
    assert spin([listener, replay], context, until=replay.done.is_set, timeout_s=15)
    assert replay.published > 0


def test_masks_are_replayed_when_there_are_no_images(make, context, tmp_path):
    write_bag(tmp_path / "bag", make_message=png, ending="mask/compressed", kind=COMPRESSED)
    listener = make(Listener, ["/cam0/mask/compressed"], CompressedImage)
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), settle_s=0.3, wait_for_subscribers_s=1.0)
    assert spin([listener, replay], context, until=replay.done.is_set, timeout_s=20)
    assert replay.published == 12


def test_a_companion_whose_type_is_not_installed_is_left_out(make, context, tmp_path, monkeypatch):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
        bag.write("/tf_static", T0, b"\0\1\0\0" + bytes(4))
        bag.add_topic("/cam0/image_raw", IMAGE)
        for k in range(2):
            bag.write("/cam0/image_raw", T0 + k, serialize_message(image(0, k)))
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", None)  # as where only the PyPI wheels are installed
    message_class.cache_clear()
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), wait_for_subscribers_s=0.0)
    assert spin([replay], context, until=replay.done.is_set, timeout_s=10)
    assert replay.error is None
    assert "replayed 2 messages of 1 topics" in replay.summary()


@pytest.mark.parametrize("mode", ["realtime", "stepped"])
def test_damaged_messages_are_left_out_and_counted(make, context, tmp_path, mode):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/cam0/image_raw", IMAGE)
        for k in range(4):
            cdr = serialize_message(image(0, k))
            bag.write("/cam0/image_raw", T0 + k, cdr[:100] if k == 1 else b"garbage" if k == 2 else cdr)
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), wait_for_subscribers_s=0.0, mode=mode)
    assert spin([replay], context, until=replay.done.is_set, timeout_s=20)
    assert (replay.published, replay.invalid) == (2, 2)
    assert "2 damaged messages left out" in replay.summary()


def test_a_truncated_bag_is_replayed_up_to_the_damage(make, context, tmp_path):
    write_bag(tmp_path / "bag", count=60)
    file = tmp_path / "bag" / "bag.mcap"
    os.truncate(file, file.stat().st_size // 2)
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), rate=100.0, wait_for_subscribers_s=0.0)
    assert spin([replay], context, until=replay.done.is_set, timeout_s=20)
    assert 50 <= replay.published <= 60
    assert "breaks off" in replay.summary()


def test_a_latched_topic_reaches_late_joiners_after_record_and_replay(make, context, tmp_path):
    talker = make(Node, "talker")
    publisher = talker.create_publisher(String, "/humans/bodies/p1/urdf", topics.LATCHED_QOS)
    publisher.publish(String(data="<robot name='x'/>"))
    record = make(RecordNode, bag=str(tmp_path / "bag"))  # comes later, gets it all the same
    name = "/humans/bodies/p1/urdf"
    assert spin([talker, record], context, until=lambda: record.writer.counts.get(name) == 1, timeout_s=20)
    record.finish()
    talker.destroy_publisher(publisher)
    with BagReader(tmp_path / "bag") as bag:
        assert bag.topics[name].latched
    replay = make(ReplayNode, bag=str(tmp_path / "bag"), select="all", wait_for_subscribers_s=0.0)
    assert spin([replay], context, until=replay.done.is_set, timeout_s=20)
    heard = []
    late = make(Node, "late")
    late.create_subscription(String, name, lambda m: heard.append(m.data), topics.LATCHED_QOS)
    assert spin([late, replay], context, until=lambda: bool(heard), timeout_s=20)
    assert heard == ["<robot name='x'/>"]


def test_the_default_recording_prefers_compressed_images_and_leaves_the_rest(make, context, tmp_path):
    camera = make(Node, "camera")
    outputs = {
        name: camera.create_publisher(kind, name, 10)
        for name, kind in {
            "/cam0/image_raw": Image,
            "/cam0/image_raw/compressed": CompressedImage,
            "/cam1/image_raw": Image,
            "/cam0/mask/compressed": CompressedImage,
            "/chatter": String,
        }.items()
    }
    record = make(RecordNode, bag=str(tmp_path / "bag"))
    expected = {"/cam0/image_raw/compressed", "/cam1/image_raw", "/cam0/mask/compressed"}
    assert spin([camera, record], context, until=lambda: set(record.writer.counts) >= expected, timeout_s=20)
    spin([camera, record], context, timeout_s=1.2)  # two more looks
    assert set(record.writer.counts) == expected
    assert len(outputs) == 5


def test_topics_by_name_and_expression(make, context, tmp_path):
    talker = make(Node, "talker")
    publishers = [talker.create_publisher(String, name, 10) for name in ("/a/x", "/a/y", "/b/x", "/c")]
    record = make(RecordNode, bag=str(tmp_path / "bag"), topics=["/a/.*", "/c"], exclude=["/a/y"], storage="sqlite3")

    def all_three():
        for publisher in publishers:
            publisher.publish(String(data=publisher.topic_name))
        return all(record.writer.counts.get(name, 0) >= 3 for name in ("/a/x", "/c"))

    assert spin([talker, record], context, until=all_three, timeout_s=20)
    record.finish()
    with BagReader(tmp_path / "bag") as bag:
        assert set(bag.topics) == {"/a/x", "/c"}
        assert {bag.deserialise(m.topic, m.cdr).data for m in bag.messages()} == {"/a/x", "/c"}


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_the_record_process_survives_being_stopped(make, context, tmp_path, how):
    env = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    command = [sys.executable, "-m", "limbloc_ros.nodes.record", "--ros-args", "-p", f"bag:={tmp_path / 'bag'}"]
    process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        camera = make(Node, "camera")
        publisher = camera.create_publisher(Image, "/cam0/image_raw", 10)
        assert spin([camera], context, until=lambda: publisher.get_subscription_count() == 1, timeout_s=30)
        messages = [serialize_message(image(0, k)) for k in range(20)]  # its padding differs from call to call
        for cdr in messages:
            publisher.publish(cdr)
            spin([camera], context, timeout_s=0.02)
        spin([camera], context, timeout_s=0.3)
        process.send_signal(how)
        output, _ = process.communicate(timeout=20)
    finally:
        if process.poll() is None:
            process.kill()
    assert process.returncode == 0, output
    assert "recorded 20 messages" in output
    assert "/cam0/image_raw" in output
    with BagReader(tmp_path / "bag") as bag:
        assert bag.damage == ""
        assert [m.cdr for m in bag.messages()] == messages


def test_a_full_disk_ends_the_recording_with_a_complete_bag(make, context, tmp_path):
    talker = make(Node, "talker")
    publisher = talker.create_publisher(String, "/text", 10)
    record = make(RecordNode, bag=str(tmp_path / "bag"), topics=["/text"])
    record.writer._min_free_bytes = 2**62
    record.writer._flush_s = 0.0

    def done():
        publisher.publish(String(data="x"))
        return record.done.is_set()

    assert spin([talker, record], context, until=done, timeout_s=20)
    assert "MB of disk are left" in record.error
    with BagReader(tmp_path / "bag") as bag:
        assert (bag.damage, bag.message_count) == ("", 1)


def test_bad_parameters_are_named(make, tmp_path):
    with pytest.raises(ConfigError, match="parameter bag: expected a rosbag2 folder"):
        make(ReplayNode)
    with pytest.raises(InputError, match="there is nothing"):
        make(ReplayNode, bag=str(tmp_path / "missing"))
    write_bag(tmp_path / "bag", count=1)
    with pytest.raises(InputError, match=r"none of the wanted topics.*it has /cam0/image_raw"):
        make(ReplayNode, bag=str(tmp_path / "bag"), topics=["/nothing"])
    with pytest.raises(ConfigError, match=r"parameter topics.*no regular expression"):
        make(RecordNode, bag=str(tmp_path / "new"), topics=["("])
    with pytest.raises(OutputError, match="exists already"):
        make(RecordNode, bag=str(tmp_path / "bag"))


def test_message_classes_and_bytes_are_checked():
    assert message_class(IMAGE) is Image
    with pytest.raises(InputError, match="not installed"):
        message_class("my_robot_msgs/msg/Thing")
    with pytest.raises(InputError, match="expected a message type such as"):
        message_class("os.system")
    check_cdr(TEXT, serialize_message(String(data="hello")), "/text")
    with pytest.raises(InputError, match="/text: expected a CDR message"):
        check_cdr(TEXT, b"\xff\xff\x00\x00hello", "/text")
    with pytest.raises(InputError, match="/text: the bytes are no std_msgs/msg/String"):
        check_cdr(TEXT, b"\x00\x01\x00\x00\xff\xff\xff\xff", "/text")
