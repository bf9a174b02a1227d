# SPDX-License-Identifier: Apache-2.0
"""The nodes over real DDS: what comes in, what goes out, and what they say when the input is bad."""

from __future__ import annotations

import time
from array import array
from pathlib import Path

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from rclpy.parameter import Parameter
from ros_graph import Graph
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import SetBool, Trigger

from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.core.segmentation import Segmentation
from limbloc_ros.nodes.segmentation import SegmentationNode
from limbloc_ros.nodes.simulated_cameras import SimulatedCamerasNode
from limbloc_ros.rig.rig_file import load_rig
from limbloc_ros.ros import topics
from limbloc_ros.ros.image_messages import (
    info_to_camera,
    message_to_mask,
    message_to_pixels,
    pixels_to_compressed,
    pixels_to_image,
)
from limbloc_ros.ros.messages import make_header, message_to_joints, stamp_ns
from limbloc_ros.simulation.room import SimulatedRoom, default_rig

LEARNING = 4
FRAME_NS = 33_333_333


class Room:
    """Noisy pictures of a plain wall, with or without a box in front of it."""

    def __init__(self, width: int = 160, height: int = 120) -> None:
        self.random = np.random.default_rng(0)
        self.box = np.zeros((height, width), bool)
        self.box[30:100, 60:90] = True

    def picture(self, box: bool) -> np.ndarray:
        picture = np.full((*self.box.shape, 3), (90, 120, 100), np.int16)
        if box:
            picture[self.box] = (30, 40, 200)
        return np.clip(picture + self.random.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)


def header(n: int):
    return make_header(1_000_000_000_000 + n * FRAME_NS, "cam0_optical")


def test_segmentation_learns_then_gives_masks_with_the_images_stamps(graph: Graph) -> None:
    graph.add(SegmentationNode, camera="cam0", background__learning_frames=LEARNING, reliability="reliable")
    raw, png = graph.collect(Image, "cam0/mask"), graph.collect(CompressedImage, "cam0/mask/compressed")
    diagnostics = graph.diagnostics()
    images = graph.publisher(Image, "cam0/image_raw")
    room = Room()
    for n in range(LEARNING):
        images.publish(pixels_to_image(room.picture(box=False), header(n)))
        graph.until(lambda n=n: len(raw) == len(png) == n + 1)
    graph.until(diagnostics.says("segmentation: mask", f"{LEARNING} of {LEARNING} images"))
    assert not message_to_mask(raw[-1]).any()
    for n in range(LEARNING, LEARNING + 3):
        images.publish(pixels_to_image(room.picture(box=True), header(n)))
        graph.until(lambda n=n: len(raw) == len(png) == n + 1)
    mask = message_to_mask(raw[-1])
    assert (raw[-1].encoding, raw[-1].header.frame_id) == ("mono8", "cam0_optical")
    assert [stamp_ns(msg.header) for msg in png] == [stamp_ns(header(n)) for n in range(7)]
    np.testing.assert_array_equal(message_to_mask(png[-1]), mask)
    overlap = ((mask > 0) & room.box).sum() / ((mask > 0) | room.box).sum()
    assert overlap > 0.95
    graph.until(diagnostics.says("segmentation: mask", "segmenting"))
    fill = 100 * float((mask > 0).mean())
    graph.until(
        lambda: float(diagnostics.value("segmentation: mask", "mask_fill_percent")) == pytest.approx(fill, 0.02)
    )


def test_segmentation_computes_only_the_masks_somebody_wants(graph: Graph) -> None:
    node = graph.add(SegmentationNode, camera="cam0", transport="compressed", reliability="reliable")
    png = graph.collect(CompressedImage, "cam0/mask/compressed")
    graph.until(lambda: node.png_mask.get_subscription_count() == 1)
    published: list[object] = []
    node.raw_mask.publish = published.append
    images = graph.publisher(CompressedImage, "cam0/image_raw/compressed")
    images.publish(pixels_to_compressed(Room().picture(box=False), header(0)))
    graph.until(lambda: len(png) == 1)
    assert not published


def test_segmentation_recaptures_and_freezes_its_background(graph: Graph) -> None:
    node = graph.add(
        SegmentationNode, camera="cam0", background__learning_frames=LEARNING, reliability="reliable", publish="always"
    )
    masks = graph.collect(Image, "cam0/mask")
    images = graph.publisher(Image, "cam0/image_raw")
    room = Room()

    def send(box: bool, count: int) -> np.ndarray:
        for _ in range(count):
            before = len(masks)
            images.publish(pixels_to_image(room.picture(box), header(before)))
            graph.until(lambda before=before: len(masks) == before + 1)
        return message_to_mask(masks[-1])

    send(False, LEARNING)
    assert send(True, 1).any()
    response = graph.call(SetBool, "segmentation/freeze_background", SetBool.Request(data=True))
    assert response.success
    assert "frozen" in response.message
    assert node.model.frozen
    response = graph.call(Trigger, "segmentation/recapture_background", Trigger.Request())
    assert "keep the room empty" in response.message
    assert not send(True, LEARNING).any()  # now the box is background
    assert not send(True, 1).any()
    assert send(False, 1).any()


def test_an_overloaded_camera_makes_all_skip_the_same_images(graph: Graph) -> None:
    """cam0's segmentation is slow. cam1 keeps up, but masks of one camera alone are worth nothing: whole sets go."""
    names = ("cam0", "cam1")
    nodes = {}
    for name in names:
        nodes[name] = graph.add(
            SegmentationNode,
            f"segmentation_{name}",
            camera=name,
            reliability="reliable",
            catch_up_s=3.5 * FRAME_NS / 1e9,
        )
    masks = {name: graph.collect(CompressedImage, f"{name}/mask/compressed", topics.WORK_QOS) for name in names}
    images = {name: graph.publisher(Image, f"{name}/image_raw", topics.WORK_QOS) for name in names}
    graph.until(lambda: all(node.skips.get_subscription_count() == 2 for node in nodes.values()))
    diagnostics = graph.diagnostics()
    picture = Room().picture(box=False)
    fast = nodes["cam0"].model.segment

    def slow(pixels: np.ndarray) -> Segmentation:
        if nodes["cam0"].meter.count == 0:  # images of both cameras come while cam0 is busy with its first one
            for n in range(1, 9):
                for name in names:
                    images[name].publish(pixels_to_image(picture, header(n)))
            time.sleep(0.4)
        return fast(pixels)

    nodes["cam0"].model.segment = slow
    images["cam0"].publish(pixels_to_image(picture, header(0)))
    last = stamp_ns(header(8))
    graph.until(lambda: all(masks[name] and stamp_ns(masks[name][-1].header) == last for name in names))
    graph.until(lambda: int(diagnostics.value("segmentation_cam0: mask", "images_skipped") or 0) > 0)
    stamps = {name: [stamp_ns(msg.header) for msg in masks[name]] for name in names}
    assert stamps["cam0"][1:] == stamps["cam1"]
    skipped = nodes["cam0"].backlog.skipped
    assert skipped == 9 - len(stamps["cam0"]) >= 4
    assert diagnostics.value("segmentation_cam0: mask", "images_skipped") == str(skipped)
    assert "too slow" in nodes["cam0"].backlog.behind


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("truncated", ["camera cam0", "JPEG", "truncated"]),
        ("h264", ["camera cam0", "expected a JPEG or PNG"]),
        ("size", ["camera cam0", "160x120", "320x240"]),
    ],
)
def test_segmentation_survives_bad_images_and_says_so(graph: Graph, kind: str, words: list[str]) -> None:
    graph.add(SegmentationNode, camera="cam0", transport="compressed", reliability="reliable")
    masks = graph.collect(CompressedImage, "cam0/mask/compressed")
    diagnostics = graph.diagnostics()
    images = graph.publisher(CompressedImage, "cam0/image_raw/compressed")
    good = pixels_to_compressed(Room().picture(box=False), header(0))
    images.publish(good)
    graph.until(lambda: len(masks) == 1)
    bad = pixels_to_compressed(Room(320, 240).picture(box=False), header(1))
    if kind == "truncated":
        bad.data = array("B", bad.data[: len(bad.data) // 2])
    elif kind == "h264":
        bad.format, bad.data = "h264", array("B", bytes(100))
    images.publish(bad)
    graph.until(diagnostics.says("segmentation: mask", *words))
    assert diagnostics["segmentation: mask"].level == DiagnosticStatus.ERROR
    images.publish(good)
    graph.until(lambda: len(masks) == 2)


def test_a_frozen_camera_is_named_and_its_masks_are_left_out(graph: Graph) -> None:
    graph.add(SegmentationNode, camera="cam0", background__learning_frames=LEARNING, reliability="reliable")
    masks, diagnostics = graph.collect(Image, "cam0/mask"), graph.diagnostics()
    images = graph.publisher(Image, "cam0/image_raw")
    room = Room()
    for n in range(LEARNING):
        images.publish(pixels_to_image(room.picture(box=False), header(n)))
    frozen = room.picture(box=True)
    per_second = round(1e9 / FRAME_NS)
    for n in range(LEARNING, LEARNING + 2 * per_second):
        images.publish(pixels_to_image(frozen, header(n)))
        graph.spin(0.005)
    graph.until(diagnostics.says("segmentation: mask", "the very same picture", "frozen"))
    assert len(masks) == LEARNING + per_second + 1
    last = LEARNING + 2 * per_second
    images.publish(pixels_to_image(room.picture(box=True), header(last)))
    graph.until(lambda: stamp_ns(masks[-1].header) == stamp_ns(header(last)))
    graph.until(diagnostics.says("segmentation: mask", "segmenting"))


def test_in_too_little_light_there_are_no_masks_of_people(graph: Graph) -> None:
    graph.add(SegmentationNode, camera="cam0", background__learning_frames=LEARNING, reliability="reliable")
    masks, diagnostics = graph.collect(Image, "cam0/mask"), graph.diagnostics()
    images = graph.publisher(Image, "cam0/image_raw")
    room = Room()
    for n in range(LEARNING):
        images.publish(pixels_to_image(room.picture(box=False), header(n)))
        graph.until(lambda n=n: len(masks) == n + 1)

    def send(n: int, box: bool, light: float) -> None:
        images.publish(pixels_to_image(np.rint(light * room.picture(box)).astype(np.uint8), header(n)))

    send(LEARNING, True, 0.35)
    graph.until(diagnostics.says("segmentation: mask", "35 %", "no masks"))
    send(LEARNING + 1, False, 0.35)
    send(LEARNING + 2, True, 0.45)
    graph.until(lambda: len(masks) == LEARNING + 2)
    stamps = [stamp_ns(mask.header) for mask in masks[LEARNING:]]
    assert stamps == [stamp_ns(header(n)) for n in (LEARNING + 1, LEARNING + 2)]
    graph.until(diagnostics.says("segmentation: mask", "45 %", "may be missed"))


def test_a_covered_and_a_turned_camera_are_named(graph: Graph) -> None:
    graph.add(SegmentationNode, camera="cam0", background__learning_frames=LEARNING, reliability="reliable")
    masks, diagnostics = graph.collect(Image, "cam0/mask"), graph.diagnostics()
    images = graph.publisher(Image, "cam0/image_raw")
    rng = np.random.default_rng(2)
    view = np.kron(rng.integers(30, 220, (12, 16, 3)), np.ones((10, 10, 1)))

    def send(picture: np.ndarray, times: int) -> None:
        for _ in range(times):
            before = len(masks)
            pixels = np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
            images.publish(pixels_to_image(pixels, header(before)))
            graph.until(lambda before=before: len(masks) == before + 1)

    send(view, LEARNING + 1)
    send(np.zeros_like(view), 4)
    graph.until(diagnostics.says("segmentation: mask", "nothing but one brightness", "covered"))
    send(view[:, ::-1], 5)
    graph.until(diagnostics.says("segmentation: mask", "another view", "recapture_background"))
    assert not message_to_mask(masks[-1]).any()
    send(0.8 * view * (1, 0.95, 0.9), 1)  # the view is back, and the light another one
    graph.until(diagnostics.says("segmentation: mask", "segmenting"))


@pytest.mark.parametrize("as_folder", [True, False])
def test_segmentation_starts_from_a_picture_of_the_empty_room(graph: Graph, tmp_path: Path, as_folder: bool) -> None:
    room = Room()
    cv2.imwrite(str(tmp_path / "cam0.png"), room.picture(box=False))
    picture = tmp_path if as_folder else tmp_path / "cam0.png"
    graph.add(SegmentationNode, camera="cam0", reliability="reliable", background_picture=str(picture))
    masks = graph.collect(Image, "cam0/mask")
    images = graph.publisher(Image, "cam0/image_raw")
    for n in range(2):  # the first image only gives the noise
        images.publish(pixels_to_image(room.picture(box=True), header(n)))
        graph.until(lambda n=n: len(masks) == n + 1)
    mask = message_to_mask(masks[-1]) > 0
    assert (mask & room.box).sum() / (mask | room.box).sum() > 0.95


def test_segmentation_needs_the_picture_it_was_promised(graph: Graph, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no file cam7\.png"):
        graph.add(SegmentationNode, camera="cam7", background_picture=str(tmp_path))
    (tmp_path / "cam7.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="expected a JPEG or PNG image"):
        graph.add(SegmentationNode, camera="cam7", background_picture=str(tmp_path))


def test_segmentation_says_when_no_camera_is_there(graph: Graph) -> None:
    graph.add(SegmentationNode, "left_eye", camera="left")
    diagnostics = graph.diagnostics()
    graph.until(diagnostics.says("left_eye: mask", "no image on left/image_raw", "nobody publishes it"))
    assert diagnostics["left_eye: mask"].hardware_id == "left"


def test_segmentation_takes_live_parameters(graph: Graph) -> None:
    node = graph.add(SegmentationNode, camera="cam0")
    assert node.set_parameters([Parameter("background.threshold_sigmas", value=9.0)])[0].successful
    assert node.model.config.threshold_sigmas == 9.0


# --- simulated cameras ---


def test_simulated_cameras_publish_what_the_room_shows(graph: Graph, tmp_path: Path) -> None:
    rig_file = tmp_path / "rig.yaml"
    node = graph.add(
        SimulatedCamerasNode,
        number_of_cameras=2,
        width=160,
        height=120,
        rate_hz=10.0,
        empty_s=0.5,
        transport="both",
        save_rig=str(rig_file),
    )
    raw, jpeg = graph.collect(Image, "cam0/image_raw"), graph.collect(CompressedImage, "cam1/image_raw/compressed")
    infos, truth = graph.collect(CameraInfo, "cam1/camera_info"), graph.collect(PoseArray, "true_joints")
    graph.until(lambda: len(raw) > 8 and len(jpeg) > 8 and message_to_joints(truth[-1]) is not None)
    room = SimulatedRoom(default_rig(2, 160, 120), empty_s=0.5)
    for msg in (raw[0], raw[-1]):
        t = (stamp_ns(msg.header) - node.start_ns) / 1e9
        np.testing.assert_array_equal(message_to_pixels(msg), room.render("cam0", t))
        assert stamp_ns(msg.header) % 100_000_000 == 0
    t = (stamp_ns(jpeg[-1].header) - node.start_ns) / 1e9
    assert np.abs(message_to_pixels(jpeg[-1]).astype(int) - room.render("cam1", t)).mean() < 4
    t = (stamp_ns(truth[-1].header) - node.start_ns) / 1e9
    np.testing.assert_array_equal(message_to_joints(truth[-1]), room.joints(t))
    for msg in truth:  # the room is empty at first
        assert (message_to_joints(msg) is None) == (stamp_ns(msg.header) < node.start_ns + 500_000_000)
    saved = load_rig(rig_file).camera("cam1")
    received = info_to_camera(infos[-1], "cam1", saved.T_world_camera)
    np.testing.assert_array_equal(received.K, saved.K)
    np.testing.assert_array_equal(received.distortion[:4], saved.distortion)
    assert infos[-1].header.frame_id == "cam1_optical"


def test_two_simulation_processes_share_their_instants(graph: Graph) -> None:
    common = {"number_of_cameras": 2, "width": 64, "height": 64, "rate_hz": 10.0, "start_s": 1_700_000_000.0}
    first = graph.add(SimulatedCamerasNode, "first", cameras=["cam0"], **common)
    second = graph.add(SimulatedCamerasNode, "second", cameras=["cam1"], **common)
    assert first.tells_truth
    assert not second.tells_truth
    a, b = graph.collect(Image, "cam0/image_raw"), graph.collect(Image, "cam1/image_raw")
    graph.until(lambda: len(a) > 3 and len(b) > 3)
    assert len({stamp_ns(m.header) for m in a} & {stamp_ns(m.header) for m in b}) >= 2


def test_simulated_cameras_refuse_a_motion_they_do_not_know(graph: Graph) -> None:
    with pytest.raises(ConfigError, match="moonwalk"):
        graph.add(SimulatedCamerasNode, number_of_cameras=2, width=64, height=64, motions=["moonwalk"])
