# SPDX-License-Identifier: Apache-2.0
"""Bags of one message a camera."""

from rclpy.serialization import serialize_message

from limbloc_ros.recordings.bags import BagWriter


def write_bag(path, topic, kind, message):
    with BagWriter(path) as bag:
        for camera in range(3):
            name = topic.format(f"cam{camera}")
            bag.add_topic(name, kind)
            bag.write(name, camera, serialize_message(message))
