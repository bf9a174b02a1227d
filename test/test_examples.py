# SPDX-License-Identifier: Apache-2.0
"""The examples over real DDS, as processes of their own."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray, Twist
from ros_graph import DOMAIN

from limbloc_ros.core.pose import JOINT, JOINT_NAMES
from limbloc_ros.ros import topics
from limbloc_ros.ros.messages import joints_to_message, make_header

EXAMPLE = Path(__file__).parents[1] / "examples" / "slow_down_near_hand.py"


def test_the_robot_slows_down_near_a_hand(graph):
    command = [sys.executable, str(EXAMPLE), "--ros-args", "-p", "robot:=[1.0, 0.0, 1.0]"]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    try:
        posture = graph.publisher(PoseArray, topics.JOINTS)
        wanted = graph.publisher(Twist, "cmd_vel_wanted", 1)
        speeds = graph.collect(Twist, "cmd_vel", 1)
        graph.until(lambda: graph.tester.count_publishers("/cmd_vel") > 0)
        graph.until(lambda: min(topic.get_subscription_count() for topic in (posture, wanted)) > 0)
        graph.spin(0.3)
        command = Twist()
        command.linear.x, command.angular.z = 0.5, 0.2

        def ask(joints):
            """What the robot does with a posture; the last of several answers, so that order does not matter."""
            speeds.clear()
            for _ in range(200):  # what is published before DDS has brought both together is lost
                if joints is not None:
                    posture.publish(joints)
                graph.spin(0.05)
                wanted.publish(command)
                if len(speeds) >= 3:
                    break
            assert len(speeds) >= 3
            assert speeds[-1].angular.z == pytest.approx(0.2)  # it may turn
            return speeds[-1].linear.x

        def hand_at(distance, age_s=0.0):
            joints = np.full((len(JOINT_NAMES), 3), 5.0)
            joints[JOINT["fingertip_R"]] = (1.0, distance, 1.0)
            stamp = graph.tester.get_clock().now().nanoseconds - round(age_s * 1e9)
            return joints_to_message(joints, make_header(stamp, "room"))

        assert ask(None) == 0.0  # nobody knows where hands are
        assert ask(hand_at(2.0)) == pytest.approx(0.5)
        assert ask(hand_at(0.8)) == pytest.approx(0.25)
        assert ask(hand_at(0.2)) == 0.0
        assert ask(hand_at(2.0)) == pytest.approx(0.5)
        assert ask(hand_at(2.0, age_s=0.8)) == 0.0  # it was old when it came
        assert ask(hand_at(2.0)) == pytest.approx(0.5)
        time.sleep(0.6)  # the posture grows old
        assert ask(PoseArray()) == 0.0  # and an unreliable one does not renew it
    finally:
        process.terminate()
        _, error = process.communicate(timeout=20)
    assert (process.returncode, error) == (0, "")


def test_the_example_is_as_short_as_it_claims():
    lines = EXAMPLE.read_text().splitlines()
    body = lines[lines.index("import numpy as np") :]
    assert len([line for line in body if line.strip()]) <= 40
