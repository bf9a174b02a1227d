# SPDX-License-Identifier: Apache-2.0
"""A whole frame: what 8 backgrounds, the hull and the pose take, stage by stage, and MediaPipe Pose on the same images.

    python benchmarks/bench_frame.py [--frames N] [--case DIR] [--mediapipe-python PYTHON]

Process times of one thread on one core, medians. The images are of the simulated room, or of a benchmark case that has
some (test/data/rgb_walk). Every frame is segmented, carved and fitted from the frame before ("following"); every few
also alone ("each frame alone"). "Mean" counts the frames in which a lost figure is searched anew.

MediaPipe Pose (full, the model that its package brings) runs in turn with ours on the same images and the same core,
with the Python of an environment that has it, for it needs an older numpy:

    python3.11 -m venv DIR && DIR/bin/pip install mediapipe==0.10.21
    python benchmarks/bench_frame.py --mediapipe-python DIR/bin/python

Its process time is measured inside that process, without the conversion to rgb and the copying. It gives 33 points in
each image, and what a triangulation of them would take is not counted.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import measuring
from measuring import STAGES, Chain, Film, Pixels, median, sums

import numpy as np  # isort: skip  # after measuring, which sets the number of threads
from tqdm import tqdm  # isort: skip

from limbloc_ros.recordings import offline

#: What the issue wants: ms of a frame alone and of a followed one, both with the hull; share of the rival's time.
ALONE_MS, FOLLOWING_MS, RIVAL_SHARE = 150.0, 30.0, 0.25


class MediaPipe:
    """The rival's process."""

    def __init__(self, python: Path, film: Film) -> None:
        camera = film.rig.cameras[0]
        self._names = film.rig.names
        self.times: dict[str, list[float]] = {}
        self.found: dict[str, list[float]] = {}
        self._process = subprocess.Popen(
            [python, Path(__file__).with_name("rival_mediapipe.py")],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, "GLOG_minloglevel": "2"},
        )  # fmt: skip
        head = {"cameras": len(self._names), "height": camera.height, "width": camera.width}
        self.version = self._ask(json.dumps(head).encode() + b"\n")["version"]

    def see(self, images: dict[str, Pixels]) -> None:
        """The next instant."""
        for way, (ms, found) in self._ask(b"".join(images[name].tobytes() for name in self._names)).items():
            self.times.setdefault(way, []).append(ms)
            self.found.setdefault(way, []).append(found / len(self._names))

    def _ask(self, data: bytes) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended, and its own words stand on the terminal
            self._process.stdin.write(data)
            self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise SystemExit("MediaPipe's process ended; expected a Python with mediapipe 0.10.21, see --help")
        return dict(json.loads(answer))

    def close(self) -> None:
        """Let it end."""
        self._process.communicate()


def table(chain: Chain, rival: MediaPipe | None) -> list[str]:
    """All results as Markdown."""
    ways = {"following": chain.following, "each frame alone": chain.alone}
    lines = ["| median ms | " + " | ".join(ways) + " |", "|---|" + "---|" * len(ways)]
    for stage in STAGES:
        lines.append(f"| {stage} | " + " | ".join(f"{median(w, stage):.1f}" for w in ways.values()) + " |")
    hull_and_pose = {way: sums(frames, ("background",)) for way, frames in ways.items()}
    lines.append("| hull and pose | " + " | ".join(f"{np.median(ms):.1f}" for ms in hull_and_pose.values()) + " |")
    lines.append("| wanted, at most | " + f"{FOLLOWING_MS:g} | {ALONE_MS:g} |")
    lines.append("| hull and pose, mean | " + " | ".join(f"{ms.mean():.1f}" for ms in hull_and_pose.values()) + " |")
    lines.append("| whole frame | " + " | ".join(f"{np.median(sums(frames)):.1f}" for frames in ways.values()) + " |")
    if rival is None:
        return lines
    ours = float(np.median(sums(chain.following)))
    lines += ["", "| whole frame | median ms | ours / theirs | person found in |", "|---|---|---|---|"]
    lines += [f"| ours, following | {ours:.1f} | | |"]
    for way, times in rival.times.items():
        ms, found = float(np.median(times)), f"{100 * np.mean(rival.found[way]):.0f} % of images"
        lines.append(f"| MediaPipe Pose {rival.version}, {way} | {ms:.1f} | {ours / ms:.2f} | {found} |")
    return [*lines, f"\nwanted: ours / theirs at most {RIVAL_SHARE:g}"]


def main() -> int:
    """Run and print Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200, help="frames, one after the other")
    parser.add_argument("--alone-every", type=int, default=5, metavar="N", help="every such one is fitted alone too")
    parser.add_argument("--case", type=Path, help="case folder with rgb/<camera>/ instead of the simulated room")
    parser.add_argument("--mediapipe-python", type=Path, metavar="PYTHON", help="of an environment that has mediapipe")
    args = parser.parse_args()
    measuring.stay_on_one_core()
    offline.prepare(lambda text: print(text, file=sys.stderr))
    film = measuring.case_film(args.case) if args.case else measuring.simulated_film()
    chain, neighbours = Chain(film), measuring.Neighbours()
    rival = MediaPipe(args.mediapipe_python, film) if args.mediapipe_python else None
    for number in tqdm(range(args.frames), file=sys.stderr, disable=None):
        images = film.shoot(number)
        chain.see(images)
        if number % args.alone_every == 0:
            chain.fit_alone()
        if rival is not None:
            rival.see(images)
    if rival is not None:
        rival.close()
    print(f"{film.title}; {args.frames} frames, {len(chain.alone)} of them also alone; one core")
    print(f"{measuring.machine()}; {neighbours.share()}\n")
    print("\n".join(table(chain, rival)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
