# SPDX-License-Identifier: Apache-2.0
"""The learned background outlives its process: bit for bit in a file, and over DDS when a camera process is killed."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from ros_graph import DOMAIN, Graph
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from limbloc_ros.core.background import BackgroundModel
from limbloc_ros.core.config import BackgroundConfig
from limbloc_ros.core.errors import InputError
from limbloc_ros.nodes.segmentation import SegmentationNode
from limbloc_ros.recordings.background_file import load_background, save_background
from limbloc_ros.ros.environment import NetworkConfig, graph_environment
from limbloc_ros.ros.image_messages import message_to_mask, pixels_to_image
from limbloc_ros.ros.messages import make_header
from limbloc_ros.ros.supervisor import ProcessConfig, ProcessPlan, Supervisor

LEARNING = 6
BOX = (slice(30, 100), slice(60, 90))


class Room:
    """Noisy pictures of a wall, with or without a box in front of it."""

    def __init__(self) -> None:
        self.random = np.random.default_rng(0)

    def picture(self, box: bool) -> np.ndarray:
        picture = np.full((120, 160, 3), (90, 120, 100), np.int16)
        if box:
            picture[BOX] = (30, 40, 200)
        return np.clip(picture + self.random.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)


def learned(room: Room, config: BackgroundConfig | None = None) -> BackgroundModel:
    model = BackgroundModel(config or BackgroundConfig(learning_frames=LEARNING))
    for _ in range(LEARNING + 3):
        model.segment(room.picture(box=False))
    return model


def test_a_restored_model_goes_on_bit_for_bit(tmp_path: Path) -> None:
    room = Room()
    model = learned(room)
    model.freeze()
    save_background(model, tmp_path / "new" / "cam0.npz")
    again = BackgroundModel(BackgroundConfig(learning_frames=LEARNING))
    load_background(again, tmp_path / "new" / "cam0.npz")
    assert not again.learning
    assert again.frozen
    for _ in range(4):
        picture = room.picture(box=True)
        expected, got = model.segment(picture), again.segment(picture)
        assert expected.mask[BOX].mean() > 250
        np.testing.assert_array_equal(got.mask, expected.mask)
        assert got.gain == expected.gain


def test_a_model_that_still_learns_leaves_no_file(tmp_path: Path) -> None:
    model = BackgroundModel(BackgroundConfig(learning_frames=LEARNING))
    model.segment(Room().picture(box=False))
    save_background(model, tmp_path / "cam0.npz")
    assert list(tmp_path.iterdir()) == []


def test_damaged_and_foreign_files_are_refused_and_change_nothing(tmp_path: Path) -> None:
    room = Room()
    path = tmp_path / "cam0.npz"
    save_background(learned(room), path)
    model = learned(room)
    before = model.background
    smaller = BackgroundModel(BackgroundConfig(learning_frames=LEARNING, max_pixels=76_800))
    with pytest.raises(InputError, match="max_pixels"):
        load_background(smaller, path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError, match=r"cam0\.npz.*learned anew"):
        load_background(model, path)
    np.savez(path, mean=np.zeros(3))
    with pytest.raises(InputError, match="saved background"):
        load_background(model, path)
    np.testing.assert_array_equal(model.background, before)


def test_a_node_with_a_damaged_file_says_so_and_learns_anew(tmp_path: Path) -> None:
    (tmp_path / "cam0.npz").write_bytes(b"PK not really")
    graph = Graph()
    try:
        node = graph.add(SegmentationNode, camera="cam0", state_folder=str(tmp_path))
        diagnostics = graph.diagnostics()
        graph.until(diagnostics.says("segmentation: mask", "learned anew"))
        assert node.model.learning
    finally:
        graph.close()


def test_recapturing_forgets_the_file(tmp_path: Path) -> None:
    graph = Graph()
    try:
        node = graph.add(
            SegmentationNode,
            camera="cam0",
            state_folder=str(tmp_path),
            background__learning_frames=LEARNING,
            publish="always",
            reliability="reliable",
        )
        images, room = graph.publisher(Image, "cam0/image_raw"), Room()
        for n in range(LEARNING):
            images.publish(pixels_to_image(room.picture(box=False), make_header(n, "")))
            graph.until(lambda n=n: node.meter.count == n + 1)
        assert (tmp_path / "cam0.npz").is_file()
        graph.call(Trigger, "segmentation/recapture_background", Trigger.Request())
        assert not (tmp_path / "cam0.npz").exists()
    finally:
        graph.close()


def test_a_file_that_cannot_be_removed_is_a_fault_and_no_end(tmp_path: Path) -> None:
    (tmp_path / "cam0.npz").mkdir()  # as if the folder were not ours
    graph = Graph()
    try:
        node = graph.add(SegmentationNode, camera="cam0", state_folder=str(tmp_path))
        diagnostics = graph.diagnostics()
        assert graph.call(Trigger, "segmentation/recapture_background", Trigger.Request()).success
        graph.until(diagnostics.says("segmentation: mask", "cam0.npz cannot be removed"))
        assert node.model.learning
    finally:
        graph.close()


def test_a_killed_camera_process_does_not_learn_the_person_as_background(tmp_path: Path) -> None:
    """Killed and started again while somebody stands before the wall: the first mask already shows him."""
    parameters = {
        "camera": "cam0",
        "reliability": "reliable",
        "background": {"learning_frames": LEARNING},
        "state_folder": str(tmp_path),
    }
    node = {"kind": "segmentation", "name": "segmentation_cam0", "parameters": parameters}
    environment = graph_environment(NetworkConfig(domain_id=DOMAIN))
    graph, room, sent = Graph(), Room(), 0

    def send(box: bool) -> int:
        nonlocal sent
        sent += 1
        images.publish(pixels_to_image(room.picture(box), make_header(sent * 33_000_000, "")))
        return sent * 33_000_000

    try:
        with Supervisor([ProcessPlan("camera", "", (node,))], environment, ProcessConfig(restart_delay_s=0.1)) as run:
            masks = graph.collect(Image, "cam0/mask")
            images = graph.publisher(Image, "cam0/image_raw")
            graph.until(lambda: graph.tester.count_publishers("cam0/mask") == 1)
            graph.spin(0.3)
            for _ in range(LEARNING + 2):
                send(box=False)
                graph.spin(0.05)
            graph.until(lambda: (tmp_path / "cam0.npz").is_file() and len(masks) >= LEARNING + 2)
            first = run.pids["camera"]
            os.kill(first, signal.SIGKILL)
            graph.until(lambda: run.poll() and run.restarts["camera"] == 1)
            graph.until(lambda: run.poll() and images.get_subscription_count() == 1 and run.pids["camera"] != first)
            before, deadline = len(masks), time.monotonic() + 20.0
            while len(masks) == before:
                assert time.monotonic() < deadline
                send(box=True)
                graph.spin(0.1)
            mask = message_to_mask(masks[before])
            assert mask[BOX].mean() > 0.95 * 255
            assert (mask > 0).sum() < 1.1 * mask[BOX].size
    finally:
        graph.close()
