# SPDX-License-Identifier: Apache-2.0
"""Segmentation per image: ours beside OpenCV's MOG2 and the same Gaussian average in plain NumPy, in one run.

    python benchmarks/bench_background.py [--images DIR] [--repeats N]

All three see the same images in turn, so that they share the machine's good and bad moments. Times are process times
of one thread, medians over all images, as ratios to MOG2. The masks are compared with the true ones where DIR has
them (a benchmark case with images, see test/data/rgb_walk), because speed without a mask is worth nothing. MOG2 and the
NumPy version get a median filter and nothing else; ours includes its whole clean-up.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from limbloc_ros.core.background import BackgroundModel, warm_up  # noqa: E402
from limbloc_ros.core.config import BackgroundConfig  # noqa: E402

Pixels = NDArray[np.uint8]


class NumpyGaussian:
    """The running Gaussian average and the shadow test, pixel by pixel, as one would write them in NumPy."""

    def __init__(self, config: BackgroundConfig) -> None:
        self.config, self.frames = config, list[NDArray[np.float32]]()
        self.mean = self.variance = np.zeros(0, dtype=np.float32)

    def __call__(self, image: Pixels) -> Pixels:
        """The mask of the next image."""
        config, x = self.config, image.astype(np.float32)
        if len(self.frames) < config.learning_frames:
            self.frames.append(x)
            self.mean, self.variance = np.mean(self.frames, axis=0), np.var(self.frames, axis=0)
            return np.zeros(image.shape[:2], dtype=np.uint8)
        precision = 1 / (self.variance + config.sigma_floor**2)
        far = ((x - self.mean) ** 2 * precision).sum(axis=2)
        scale = (x * self.mean * precision).sum(axis=2) / ((self.mean**2 * precision).sum(axis=2) + 1e-6)
        near = np.clip(scale, config.shadow_darkest, config.highlight_brightest)[..., None] * self.mean
        rest = ((x - near) ** 2 * precision).sum(axis=2)
        mask = (far > config.threshold_sigmas**2) & (rest > (2 * config.shadow_sigmas) ** 2)
        rate = np.where(far < config.threshold_sigmas**2, np.float32(config.learning_rate), np.float32(0))[..., None]
        off = x - self.mean
        self.variance = (1 - rate) * (self.variance + rate * off**2)
        self.mean = self.mean + rate * off
        return np.asarray(cv2.medianBlur(mask.astype(np.uint8) * 255, 5), dtype=np.uint8)


def mog2() -> Callable[[Pixels], Pixels]:
    """OpenCV's mixture of Gaussians with shadow detection, as most people use it."""
    subtractor = cv2.createBackgroundSubtractorMOG2(detectShadows=True)

    def mask(image: Pixels) -> Pixels:
        foreground = subtractor.apply(image)
        return cv2.medianBlur(cv2.threshold(foreground, 200, 255, cv2.THRESH_BINARY)[1], 5)

    return mask


def overlap(mask: Pixels, truth: NDArray[np.bool_]) -> float:
    """Intersection over union."""
    return float(np.count_nonzero((mask > 0) & truth) / max(np.count_nonzero((mask > 0) | truth), 1))


def main() -> int:
    """Run and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--images", type=Path, default=ROOT / "test/data/rgb_walk", help="case folder with rgb/<camera>/"
    )
    parser.add_argument("--repeats", type=int, default=8, help="times that the images with the person are shown")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    empty = int(json.loads((arguments.images / "meta.json").read_text())["background_frames"])
    config = BackgroundConfig(learning_frames=empty)
    times: dict[str, list[float]] = {}
    scores: dict[str, list[float]] = {}
    cameras = sorted(folder.name for folder in (arguments.images / "rgb").iterdir())
    warm_up()
    with np.load(arguments.images / "masks.npz") as archive:
        packed = {name: archive[name] for name in cameras}
    shape: tuple[int, ...] = ()
    for camera in cameras:
        images = [cv2.imread(str(file)) for file in sorted((arguments.images / "rgb" / camera).iterdir())]
        shape = images[0].shape
        truth = np.unpackbits(packed[camera], axis=2)[:, :, : shape[1]] > 0
        model = BackgroundModel(config)
        rivals: dict[str, Callable[[Pixels], Pixels]] = {
            "limbloc, whole chain": lambda image, model=model: model.segment(image).mask,
            "OpenCV MOG2 + median": mog2(),
            "NumPy Gaussian + median": NumpyGaussian(config),
        }
        for image in images[:empty]:
            for rival in rivals.values():
                rival(image)
        for turn in range(arguments.repeats):
            for i, image in enumerate(images[empty:], start=empty):
                for name, rival in rivals.items():
                    if name.startswith("NumPy") and turn > 0:
                        continue
                    start = time.process_time()
                    mask = rival(image)
                    times.setdefault(name, []).append(1e3 * (time.process_time() - start))
                    if turn == 0:
                        scores.setdefault(name, []).append(overlap(mask, truth[i]))
    base = float(np.median(times["OpenCV MOG2 + median"]))
    print(f"{len(cameras)} cameras, {shape[1]}x{shape[0]}, one thread, median process time per image\n")
    print("| | ms | times MOG2 | IoU mean | IoU worst |\n|---|---|---|---|---|")
    for name, values in times.items():
        median, score = float(np.median(values)), scores[name]
        print(f"| {name} | {median:.2f} | {median / base:.2f} | {np.mean(score):.3f} | {min(score):.3f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
