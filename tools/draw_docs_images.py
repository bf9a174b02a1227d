# SPDX-License-Identifier: Apache-2.0
"""Draw the documentation's pictures anew, from a walk in a rendered room and from the code as it is.

    make docs-images                       of the piece of the walk in test/data/rgb_walk
    make docs-images ARGS=WALK             of the whole walk: a folder with rgb/, calib.json, meta.json and gt.npz

The walk is processed and reported with the commands that docs/method.md and docs/how_to/results.md show, and the
report's pictures are put into docs/images. By other means come `demo.jpg` (panels of the report that `make demo`
leaves), `viewer.jpg` (a window of `limbloc view`) and `real_balance_overlay.jpg` (tools/draw_overlay.py; its footage is
not here).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
#: Pictures of the report, and how wide they are in the documentation, px; photographs become JPEG.
PHOTOGRAPHS = {"flesh_figure": 1100, "geodesic_distance": 1100, "curvature": 1100, "overlay": 1100}
PLOTS = ("error", "bland_altman", "ranges_of_motion", "trajectories")


def run(*words: str | Path) -> None:
    """Run a Python program of ours; its failure ends this one."""
    subprocess.run([sys.executable, *map(str, words)], cwd=ROOT, check=True)


def report_of(walk: Path, folder: Path) -> Path:
    """Process a walk and compare it with its truth; returns the folder of the pictures."""
    empty = int(json.loads((walk / "meta.json").read_text(encoding="utf-8"))["background_frames"])
    config = folder / "learn.yaml"
    config.write_text(f"segmentation: {{background: {{learning_frames: {empty}}}}}\n", encoding="utf-8")
    out = folder / "walk"
    run("-m", "limbloc_ros", "process", walk / "rgb", "--rig", walk / "calib.json", "--leave-out", str(empty),
        "--temporal", "--config", config, "--out", out)  # fmt: skip
    run("-m", "limbloc_ros", "report", out, "--reference", walk / "gt.npz")
    return out / "report"


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("walk", type=Path, nargs="?", default=ROOT / "test" / "data" / "rgb_walk", help="the footage")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        pictures = report_of(args.walk.resolve(), Path(folder))
        for name, width in PHOTOGRAPHS.items():
            picture = cv2.imread(str(pictures / f"{name}.png"))
            height = round(picture.shape[0] * width / picture.shape[1])
            small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(IMAGES / f"{name}.jpg"), small, [cv2.IMWRITE_JPEG_QUALITY, 85])
        for name in PLOTS:
            (IMAGES / f"{name}.png").write_bytes((pictures / f"{name}.png").read_bytes())
    run("tools/draw_model.py", IMAGES / "model.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
