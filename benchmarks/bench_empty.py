# SPDX-License-Identifier: Apache-2.0
"""An hour of an empty room, then somebody comes in: what drifts, what grows, what is seen that is not there.

    python benchmarks/bench_empty.py [--minutes 60] [--cameras 4] [--rate 2]

The images of a simulated room (noise, a light that drifts) go through segmentation, carving and the fit of one process,
by their stamps and as fast as it can; nobody waits for the hour. Printed for every tenth of it: the largest share of an
image that was foreground, frames with a hull and with a pose, how far the background's mean is from the images (grey
levels, median of the pixels, under the light's gain), and resident memory. At the end the person stands in the room:
how well the first ten masks overlap the true silhouettes, and which poses are reliable and right. Exit code 1 when an
empty room gave a pose, memory grew by more than 2 %, or the person was not found.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from faults.live import WRONG_M, error_of
from faults.stage import Stage

from limbloc_ros.core.background import BackgroundModel
from limbloc_ros.core.config import BackgroundConfig, FitConfig
from limbloc_ros.core.hull import Hull
from limbloc_ros.core.people import People
from limbloc_ros.core.pipeline import Carver
from limbloc_ros.core.pose import Pose
from limbloc_ros.ros.health import give_back_memory
from limbloc_ros.simulation.room import default_rig

PARTS, ENDS = 10, 10
GROWTH = 0.02


class EmptyRoom:
    """A room, and the whole chain behind its cameras."""

    def __init__(self, cameras: int, rate_hz: float) -> None:
        self.rig = default_rig(cameras, 400, 300)
        self.stage = Stage(self.rig, ("t_pose",))
        self.stage.clear()
        config = dataclasses.replace(BackgroundConfig(), learning_frames=15)
        self.models = {name: BackgroundModel(config) for name in self.rig.names}
        self.carver, self.people = Carver(self.rig), People(FitConfig(temporal=True))
        self.period_s, self.clock_s = 1.0 / rate_hz, 1.7e9
        self.images: dict[str, np.ndarray] = {}
        self.truth: np.ndarray | None = None

    def step(self) -> tuple[dict[str, np.ndarray], Hull | None, Pose | None]:
        """The next instant: masks, the hull and the first person's pose, if any."""
        self.images, self.truth = self.stage.shoot(self.period_s, self.clock_s)
        self.clock_s += self.period_s
        masks = {name: model.segment(self.images[name]).mask for name, model in self.models.items()}
        hull = self.carver.carve(masks)
        found = self.people.look(hull) if isinstance(hull, Hull) else hull
        outcome = self.people.follow(found, round(self.clock_s * 1e9))[0].outcome
        return masks, hull if isinstance(hull, Hull) else None, outcome if isinstance(outcome, Pose) else None

    def apart(self) -> float:
        """How far the backgrounds are from the last images, grey levels."""
        far = []
        for name, model in self.models.items():
            background, image = model.background, self.images[name]
            assert background is not None
            gain = np.median(image.reshape(-1, 3) / np.maximum(background.reshape(-1, 3), 1), axis=0)
            far.append(float(np.median(np.abs(image - background * gain))))
        return max(far)


def resident_mb() -> float:
    """Of this process, without mapped files, after what can be was given back."""
    give_back_memory()
    status = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in status if line.startswith("RssAnon"))) / 1024


def main() -> int:
    """Run, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--rate", type=float, default=2.0, help="images a second of each camera")
    args = parser.parse_args()
    room = EmptyRoom(args.cameras, args.rate)
    frames = round(60 * args.minutes * args.rate / PARTS)
    print("minutes  foreground %  hulls  poses  background off by  MB")
    memory, seen = [], 0
    for part in range(PARTS):
        most, hulls, poses = 0.0, 0, 0
        for _ in range(frames):
            masks, hull, pose = room.step()
            most = max(most, *(float(np.count_nonzero(mask)) / mask.size for mask in masks.values()))
            hulls, poses = hulls + (hull is not None), poses + (pose is not None and pose.reliable)
        memory.append(resident_mb())
        seen += poses
        done = (part + 1) * args.minutes / PARTS
        print(
            f"{done:7.0f}  {100 * most:12.3f}  {hulls:5d}  {poses:5d}  {room.apart():17.2f}  {memory[-1]:.1f}",
            flush=True,
        )
    room.stage.enter()
    overlaps, right = [], 0
    for _ in range(ENDS):
        masks, _, pose = room.step()
        for name, mask in masks.items():
            true = room.stage.render_with_mask(name, room.clock_s - room.period_s)[1] > 0
            overlaps.append(np.count_nonzero((mask > 0) & true) / max(np.count_nonzero((mask > 0) | true), 1))
        right += pose is not None and pose.reliable and error_of(pose.joints, room.truth)[1] <= WRONG_M
    print(
        f"then somebody comes in: masks overlap by {np.mean(overlaps):.3f}, {right} of {ENDS} poses reliable and right"
    )
    grown = memory[-1] / memory[1] - 1
    print(f"memory {100 * grown:+.1f} % since the first fifth")
    return 1 if seen or grown > GROWTH or right < ENDS // 2 else 0


if __name__ == "__main__":
    raise SystemExit(main())
