# SPDX-License-Identifier: Apache-2.0
"""A robot that slows down when a hand comes near: `cmd_vel_wanted` in, `cmd_vel` out.

python examples/slow_down_near_hand.py --ros-args -p robot:="[1.0, 0.5, 0.4]"      (m, in the frame `room`)
"""

import numpy as np
from geometry_msgs.msg import PoseArray, Twist
from rclpy.node import Node
from rclpy.time import Time

from limbloc_ros.core.pose import JOINT
from limbloc_ros.ros.node_main import main

HANDS = [JOINT[name] for name in ("wrist_L", "fingertip_L", "wrist_R", "fingertip_R")]
STOP_M, FREE_M, PATIENCE_S = 0.4, 1.2, 0.5  # stops below, full speed beyond; older postures count for nothing


class SlowDown(Node):
    def __init__(self, **options):
        super().__init__("slow_down_near_hand", **options)
        self.robot = np.array(self.declare_parameter("robot", [0.0, 0.0, 0.5]).value)
        self.share, self.seen = 0.0, self.get_clock().now()
        self.speed = self.create_publisher(Twist, "cmd_vel", 1)
        self.create_subscription(PoseArray, "joints", self.on_joints, 1)
        self.create_subscription(Twist, "cmd_vel_wanted", self.on_wanted, 1)

    def on_joints(self, msg):
        if msg.poses:  # an empty array: nobody, or a posture that should not be acted on
            places = np.array([(p.position.x, p.position.y, p.position.z) for p in msg.poses])[HANDS]
            nearest = np.linalg.norm(places - self.robot, axis=1).min()
            self.share = float(np.clip((nearest - STOP_M) / (FREE_M - STOP_M), 0.0, 1.0))
            self.seen = Time.from_msg(msg.header.stamp)  # when the images were taken, not when we heard of it

    def on_wanted(self, msg):
        age = (self.get_clock().now() - self.seen).nanoseconds * 1e-9
        share = self.share if age < PATIENCE_S else 0.0  # not knowing where the hands are is no reason to go
        for axis in ("x", "y", "z"):
            setattr(msg.linear, axis, share * getattr(msg.linear, axis))
        self.speed.publish(msg)


if __name__ == "__main__":
    main(SlowDown)  # rclpy.init, spin, and a clean end on Ctrl-C
