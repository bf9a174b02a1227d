# SPDX-License-Identifier: Apache-2.0
"""MediaPipe Pose (full) as a rival in a process of its own; `bench_frame.py` starts it with another Python.

Needs `pip install mediapipe==0.10.21`, a version that still has `mediapipe.solutions` with the model inside. Standard
input: a line of JSON with `cameras`, `height`, `width`, then the bgr images of instant after instant, camera by camera,
bytes only. After every instant a line of JSON goes out: process time of its images in ms, and in how many of them a
person was found, for each of the two ways to use it.
"""

from __future__ import annotations

import json
import sys
import time

import mediapipe
import numpy as np


def main() -> None:
    """Read, look, answer, until the input ends."""
    head = json.loads(sys.stdin.buffer.readline())
    shape = (head["cameras"], head["height"], head["width"], 3)
    make = mediapipe.solutions.pose.Pose
    # From frame to frame each camera needs its own: it looks where the person was. Alone, one does for all.
    tracking = [make(static_image_mode=False, model_complexity=1) for _ in range(shape[0])]
    still = make(static_image_mode=True, model_complexity=1)
    ways = {"tracking": tracking, "each image alone": [still] * shape[0]}
    print(json.dumps({"version": mediapipe.__version__}), flush=True)
    while data := sys.stdin.buffer.read(int(np.prod(shape))):
        images = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(shape)[..., ::-1])  # to rgb
        answer = {}
        for way, poses in ways.items():
            start = time.process_time()
            found = [pose.process(image).pose_landmarks for pose, image in zip(poses, images, strict=True)]
            answer[way] = [1e3 * (time.process_time() - start), sum(one is not None for one in found)]
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
