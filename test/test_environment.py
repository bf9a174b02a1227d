# SPDX-License-Identifier: Apache-2.0
"""The environment of the graph's processes: discovery, domain, threads, and the DDS profile that large images need."""

import os
import subprocess
import sys

import pytest

from limbloc_ros.core.errors import ConfigError
from limbloc_ros.ros.environment import NetworkConfig, config_file, graph_environment


def test_environment_for_large_images():
    added = graph_environment(NetworkConfig(domain_id=5), base={"HOME": "/nowhere", "OMP_NUM_THREADS": "3"})
    for name in ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
        assert added[name] == str(config_file("fastdds_localhost.xml"))
    assert added["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert added["ROS_DOMAIN_ID"] == "5"
    assert int(added["MALLOC_MMAP_THRESHOLD_"]) == 67108864
    assert added["NUMBA_NUM_THREADS"] == "1"
    assert "OMP_NUM_THREADS" not in added  # what the user has set stays


def test_environment_follows_the_user_when_asked():
    added = graph_environment(NetworkConfig(discovery="environment", dds_profile="none"), base={})
    assert not any("FAST" in name or name.startswith("ROS_") for name in added)
    with pytest.raises(ConfigError, match=r"network.dds_profile.*missing.xml"):
        graph_environment(NetworkConfig(dds_profile="missing.xml"), base={})


LARGE = """
import sys, time, rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from array import array
rclpy.init()
node = Node(sys.argv[1])
qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
if sys.argv[1] == "talker":
    publisher = node.create_publisher(Image, "large", qos)
    while publisher.get_subscription_count() < 1:
        time.sleep(0.05)
    time.sleep(0.5)
    msg = Image(data=array("B", bytes(1920 * 1080)))
    for k in range(20):
        publisher.publish(msg)
        time.sleep(0.1)
    time.sleep(0.5)
else:
    got = []
    node.create_subscription(Image, "large", lambda m: got.append(len(m.data)), qos)
    deadline = time.monotonic() + 30.0
    while len(got) < 20 and time.monotonic() < deadline and (len(got) == 0 or time.monotonic() - last < 3.0):
        before = len(got)
        rclpy.spin_once(node, timeout_sec=0.1)
        if len(got) > before:
            last = time.monotonic()
    print(got.count(1920 * 1080))
node.destroy_node()
rclpy.shutdown()
"""


def test_the_dds_profile_carries_large_best_effort_messages():
    env = {**os.environ, **graph_environment(NetworkConfig(domain_id=1 + os.getpid() % 100))}
    listener = subprocess.Popen([sys.executable, "-c", LARGE, "listener"], env=env, stdout=subprocess.PIPE, text=True)
    talker = subprocess.Popen([sys.executable, "-c", LARGE, "talker"], env=env)
    try:
        output, _ = listener.communicate(timeout=60)
        talker.wait(timeout=60)
    finally:
        for process in (listener, talker):
            if process.poll() is None:
                process.kill()
                process.wait()
    # Best effort may lose one on a busy machine; with the default profile most of them are lost.
    assert int(output) >= 18
