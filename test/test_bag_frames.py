# SPDX-License-Identifier: Apache-2.0
"""Frame sets out of a bag: which topics, which frames belong together, what is refused."""

import cv2
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from limbloc_ros.core.config import SyncConfig
from limbloc_ros.core.errors import InputError
from limbloc_ros.recordings.bag_frames import camera_streams, frame_sets, header_stamp_ns
from limbloc_ros.recordings.bags import BagReader, BagWriter
from limbloc_ros.ros.image_messages import mask_to_compressed, pixels_to_compressed, pixels_to_image
from limbloc_ros.ros.messages import make_header

MS = 1_000_000
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def picture(camera, k):
    return np.full((48, 64, 3), (10 * camera, 5 * k, 99), np.uint8)


def mask(camera, k):
    result = np.zeros((48, 64), np.uint8)
    cv2.circle(result, (20 + camera, 10 + k), 6, 255, -1)
    return result


def write(path, make, ending, kind, cameras=(0, 1, 2), count=5, namespace="", lost=()):
    with BagWriter(path) as bag:
        for camera in cameras:
            bag.add_topic(f"{namespace}/cam{camera}/{ending}", kind)
        for k in range(count):
            for camera in cameras:
                if (camera, k) in lost:
                    continue
                header = make_header(10**18 + 33 * k * MS + camera * MS, f"cam{camera}_optical")
                bag.write(f"{namespace}/cam{camera}/{ending}", 33 * k * MS + camera, make(camera, k, header))


def raw(camera, k, header):
    return serialize_message(pixels_to_image(picture(camera, k), header))


def png(camera, k, header):
    return serialize_message(mask_to_compressed(mask(camera, k), header))


def jpeg(camera, k, header):
    return serialize_message(pixels_to_compressed(picture(camera, k), header))


CAMERAS = ("cam0", "cam1", "cam2")


def test_raw_images_come_out_as_they_went_in(tmp_path):
    write(tmp_path / "bag", raw, "image_raw", IMAGE, namespace="/lab/room1")
    with BagReader(tmp_path / "bag") as bag:
        streams = camera_streams(bag, CAMERAS)
        assert streams["cam1"].topic == "/lab/room1/cam1/image_raw"
        assert not streams["cam1"].is_mask
        sets = list(frame_sets(bag, streams))
        assert [s.stamp_ns for s in sets] == [10**18 + 33 * k * MS for k in range(5)]
        for k, s in enumerate(sets):
            assert s.skew_ns == 2 * MS
            for camera in range(3):
                assert (s.items[f"cam{camera}"].pixels() == picture(camera, k)).all()


def test_masks_are_preferred_to_images_and_decode_without_loss(tmp_path):
    write(tmp_path / "bag", png, "mask/compressed", COMPRESSED)
    with BagReader(tmp_path / "bag") as bag:
        sets = list(frame_sets(bag, camera_streams(bag, CAMERAS)))
        assert len(sets) == 5
        for k, s in enumerate(sets):
            for camera in range(3):
                assert (s.items[f"cam{camera}"].pixels() == mask(camera, k)).all()


def test_compressed_images_decode(tmp_path):
    write(tmp_path / "bag", jpeg, "image_raw/compressed", COMPRESSED, count=1)
    with BagReader(tmp_path / "bag") as bag:
        (s,) = frame_sets(bag, camera_streams(bag, CAMERAS))
        assert np.abs(s.items["cam2"].pixels().astype(int) - picture(2, 0)).max() <= 3


def test_a_lost_frame_is_missing_in_its_set_only(tmp_path):
    write(tmp_path / "bag", png, "mask/compressed", COMPRESSED, lost={(1, 2)})
    with BagReader(tmp_path / "bag") as bag:
        streams = camera_streams(bag, CAMERAS)
        assert [s.missing for s in frame_sets(bag, streams)] == [(), (), ("cam1",), (), ()]
        assert len(list(frame_sets(bag, streams, SyncConfig(), min_cameras=3))) == 4


def test_a_camera_without_topic_is_named_with_what_there_is(tmp_path):
    write(tmp_path / "bag", raw, "image_raw", IMAGE, count=1)
    with (
        BagReader(tmp_path / "bag") as bag,
        pytest.raises(
            InputError,
            match=r"no images of camera kinect: expected a topic such as /kinect/image_raw.*/cam0/image_raw, ",
        ),
    ):
        camera_streams(bag, ("cam0", "kinect"))


def test_a_damaged_message_is_an_input_error(tmp_path):
    def cut(camera, k, header):
        return raw(camera, k, header)[: 200 if camera == 1 else None]

    write(tmp_path / "bag", cut, "image_raw", IMAGE, count=1)
    with BagReader(tmp_path / "bag") as bag:
        (s,) = frame_sets(bag, camera_streams(bag, CAMERAS))
        assert s.items["cam0"].pixels().shape == (48, 64, 3)
        with pytest.raises(InputError, match=r"/cam1/image_raw: the bytes are no sensor_msgs/msg/Image"):
            s.items["cam1"].pixels()


def test_a_message_without_a_header_costs_its_frame_alone(tmp_path):
    def cut(camera, k, header):
        return b"" if (camera, k) == (1, 2) else jpeg(camera, k, header)

    write(tmp_path / "bag", cut, "image_raw/compressed", COMPRESSED)
    damaged = {}
    with BagReader(tmp_path / "bag") as bag:
        sets = list(frame_sets(bag, camera_streams(bag, CAMERAS), damaged=damaged))
    assert [s.missing for s in sets] == [(), (), ("cam1",), (), ()]
    assert damaged == {"cam1": 1}
    with (
        BagReader(tmp_path / "bag") as bag,
        pytest.raises(InputError, match="/cam1/image_raw/compressed: expected a CDR"),
    ):
        list(frame_sets(bag, camera_streams(bag, CAMERAS)))


def test_header_stamps_are_read_without_decoding():
    header = Header(frame_id="x")
    header.stamp.sec, header.stamp.nanosec = 1_700_000_000, 123_456_789
    cdr = serialize_message(pixels_to_image(mask(0, 0), header))
    assert header_stamp_ns(cdr) == 1_700_000_000_123_456_789
    big = b"\x00\x00\x00\x00" + (5).to_bytes(4, "big") + (7).to_bytes(4, "big")
    assert header_stamp_ns(big) == 5_000_000_007
    with pytest.raises(InputError, match="expected a CDR message"):
        header_stamp_ns(b"\x00\x01")
