# SPDX-License-Identifier: Apache-2.0
"""Far too much work: how the graph sheds it.

    python benchmarks/bench_load.py [--cameras 16] [--width 1920] [--rate 60] [--seconds 20]

JPEG images of a simulated room, drawn before, are sent at the full rate of all cameras to the real graph. Expected is
that whole sets are dropped, oldest first, that what comes out is not older than the queues allow, that memory stays,
and that the diagnostics say so.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import cv2
import numpy as np
from faults.cameras import Cameras
from faults.live import Live
from faults.processes import footprint
from faults.stage import Stage
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage

from limbloc_ros.ros import topics
from limbloc_ros.ros.messages import NANOSECONDS, make_header

#: Catch-up times of segmentation, carving and pose, the wait for the last mask of a set, and one search for a lost
#: figure, s.
BOUND_S = 0.5 + 1.0 + 2.0 + 1.0 + 1.5
POSES = 4


class Flood(Cameras):
    """Sends the same few images of each camera again and again, as fast as asked."""

    def __init__(self, node: Node, stage: Stage, rate_hz: float) -> None:
        super().__init__(node, stage, rate_hz)
        self._jpegs = {
            name: node.create_publisher(CompressedImage, topics.image_compressed(name), topics.STREAM_QOS)
            for name in stage.rig.names
        }
        self._empty = self._draw()
        stage.enter()
        self._there = [self._draw() for _ in range(POSES)]
        stage.clear()
        self._turn = itertools.count()
        self.sent = 0

    @property
    def watched(self) -> bool:
        return all(p.get_subscription_count() for p in self._jpegs.values())

    def _draw(self) -> tuple[dict[str, bytes], np.ndarray | None]:
        images, joints = self.stage.shoot(0.3, 1.0)
        return {n: cv2.imencode(".jpg", image)[1].tobytes() for n, image in images.items()}, joints

    def _film(self, now: float) -> None:
        if not self.filming:
            return
        # A walk forth and back, slowly: each picture for a third of a second.
        turn = int(now * 3) % (2 * POSES - 2)
        images, joints = self._there[min(turn, 2 * POSES - 2 - turn)] if self.stage.time_s else self._empty
        stamp = time.time_ns()
        self.truth[stamp] = joints
        for name, jpeg in images.items():
            msg = CompressedImage(header=make_header(stamp, topics.optical_frame(name)), format="jpeg")
            msg.data.frombytes(jpeg)
            self._jpegs[name].publish(msg)
            self.sent += 1


def flood(cameras: int, width: int, height: int, rate_hz: float, seconds: float) -> list[str]:
    """Run it; prints what was seen, and returns what is not as it should be."""
    live = Live(cameras, width, height, rate_hz, settings={"transport": "compressed"})
    with live:
        live.cameras = driver = Flood(live.node, live.stage, rate_hz)
        if not live.start():
            print("not right for five poses running within 30 s", file=sys.stderr)
        live.spin(3.0)
        sets = counted(live)
        before, first, sent, filmed = footprint(live.graph.pids), len(live.answers), driver.sent, len(driver.truth)
        began = time.monotonic()
        live.spin(seconds)
        lasted = time.monotonic() - began
        answers = live.answers[first:]
        offset_s = time.time() - time.monotonic()
        ages = np.array([a.at_s + offset_s - a.stamp_ns / NANOSECONDS for a in answers if a.posed])
        stamps = [a.stamp_ns for a in answers]
        after = footprint(live.graph.pids)
        sets = {key: value - sets[key] for key, value in counted(live).items()}
        slow = sorted({s.name for s in live.said if "too slow" in s.message})
    filmed = len(driver.truth) - filmed
    print(f"sent {(driver.sent - sent) / lasted:.0f} images a second, {filmed / lasted:.1f} instants of {rate_hz:g}")
    wrong = sum(a.wrong for a in answers)
    print(f"answers {len(answers) / lasted:.1f} a second, {len(ages) / lasted:.1f} poses, {wrong} wrong")
    if len(ages):
        low, middle, high, most = np.percentile(ages, (5, 50, 95, 100))
        print(f"age of a pose when it comes: 5 % {low:.2f} s, median {middle:.2f}, 95 % {high:.2f}, oldest {most:.2f}")
    print("sets of masks: " + ", ".join(f"{value} {key}" for key, value in sets.items()))
    print(f"memory {before.rss_mb:.0f} -> {after.rss_mb:.0f} MB; too slow, say {', '.join(slow) or 'none'}")
    problems = []
    if not answers:
        problems.append("nothing comes out")
    if len(ages) and ages.max() > BOUND_S:
        problems.append(f"a pose is {ages.max():.1f} s old, the queues allow {BOUND_S:g} s")
    if stamps != sorted(stamps):
        problems.append("answers come out of order")
    if sets["incomplete"] + sets["dropped"] > max(sets["complete"], 1):
        problems.append("sets are torn: some cameras skip other instants than the rest")
    if len(answers) < 0.9 * filmed and not slow:
        problems.append("instants are lost and nobody says so")
    return problems


def counted(live: Live) -> dict[str, int]:
    """What carving says of its sets so far."""
    values = live.values["carving: hull"]
    return {key: int(values[f"sets_{key}"]) for key in ("complete", "incomplete", "dropped", "skipped")}


def main() -> int:
    """Flood and judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=16)
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--seconds", type=float, default=20.0)
    args = parser.parse_args()
    problems = flood(args.cameras, args.width, args.width * 9 // 16, args.rate, args.seconds)
    print("\n".join(problems) or "whole sets were dropped, and it was said")
    return 1 if problems else 0


if __name__ == "__main__":
    raise SystemExit(main())
