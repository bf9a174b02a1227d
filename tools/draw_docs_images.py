# SPDX-License-Identifier: Apache-2.0
"""Draw the documentation's pictures anew, from a walk in a rendered room and from the code as it is.

    make docs-images                       of the piece of the walk in test/data/rgb_walk
    make docs-images ARGS=WALK             of the whole walk: a folder with rgb/, calib.json, meta.json and gt.npz
    make docs-images ARGS="WALK --demo out/demo-..."    and of what `make demo` left

The walk is processed and reported with the commands that docs/method.md and docs/how_to/results.md show, and the
report's pictures are put into docs/images; so are those of `rig plan`, and of `rig check` with a camera turned on
purpose. With `--demo` also `demo.jpg` (panels of that run's report) and, where there is Xvfb, `viewer.jpg` (the window
of `limbloc view`). `real_balance_overlay.jpg` comes from tools/draw_overlay.py; its footage is not here.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from limbloc_ros.recordings.kept_frames import KeptFrames
from limbloc_ros.rig.rig_file import load_rig, save_rig

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
#: Pictures of the report, and how wide they are in the documentation, px; photographs become JPEG.
PHOTOGRAPHS = {"flesh_figure": 1100, "geodesic_distance": 1100, "curvature": 1100, "overlay": 1100}
PLOTS = ("error", "bland_altman", "ranges_of_motion", "trajectories")


#: Which panels (row, column) of the demo's report stand in demo.jpg; their size, and how far they are apart, px.
DEMO_PANELS = (
    ("flesh_figure", 0, 0),
    ("flesh_figure", 0, 1),
    ("flesh_figure", 0, 2),
    ("geodesic_distance", 0, 1),
)
PANEL, APART = (400, 540), (408, 574)
#: The viewer's window, how wide it is shown, the frame that it shows or one near it, how long it may take to appear, s.
WINDOW, WINDOW_WIDTH, WINDOW_FRAME, APPEARS_S = (1400, 900), 1120, 40, 25.0


def run(*words: str | Path, codes: tuple[int, ...] = (0,)) -> None:
    """Run a Python program of ours; its failure ends this one."""
    done = subprocess.run([sys.executable, *map(str, words)], cwd=ROOT, check=False)
    if done.returncode not in codes:
        raise SystemExit(f"{' '.join(map(str, words))} ended with {done.returncode}")


def put(picture: np.ndarray, name: str, width: int) -> None:
    """A picture as docs/images/NAME, no wider than `width`; JPEG for photographs, PNG for plots."""
    if picture.shape[1] > width:
        height = round(picture.shape[0] * width / picture.shape[1])
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, 85] if name.endswith(".jpg") else [cv2.IMWRITE_PNG_COMPRESSION, 9]
    cv2.imwrite(str(IMAGES / name), picture, options)


def trimmed(picture: np.ndarray, margin: int = 8) -> np.ndarray:
    """A plot without most of its white margins."""
    rows, columns = (np.flatnonzero((picture < 250).any(axis=(axis, 2))) for axis in (1, 0))
    top, left = max(rows[0] - margin, 0), max(columns[0] - margin, 0)
    return picture[top : rows[-1] + margin, left : columns[-1] + margin]


def rig_pictures(walk: Path, folder: Path) -> None:
    """A proposal of eight cameras, and the check of the walk's rig with one camera turned by 2 degrees."""
    run("-m", "limbloc_ros", "rig", "plan", "--cameras", "8", "--room", "5x5x2.8", "--out", folder / "plan")
    put(trimmed(cv2.imread(str(folder / "plan" / "rig.png"))), "rig_plan.png", 1100)
    put(trimmed(cv2.imread(str(folder / "plan" / "coverage.png"))), "rig_coverage.png", 700)
    rig = load_rig(walk / "calib.json")
    turned = rig.cameras[5].T_world_camera.copy()
    turned[:3, :3] = turned[:3, :3] @ Rotation.from_euler("y", 2, degrees=True).as_matrix()
    cameras = (*rig.cameras[:5], replace(rig.cameras[5], T_world_camera=turned), *rig.cameras[6:])
    save_rig(replace(rig, cameras=cameras), folder / "turned.yaml")
    empty = json.loads((walk / "meta.json").read_text(encoding="utf-8"))["background_frames"]
    run("-m", "limbloc_ros", "rig", "check", walk / "rgb", "--rig", folder / "turned.yaml", "--skip", str(empty),
        "--config", folder / "learn.yaml", "--report", folder / "check", codes=(0, 1))  # fmt: skip
    put(trimmed(cv2.imread(str(folder / "check" / "silhouettes.png"))), "rig_check.png", 1100)


def demo_pictures(demo: Path) -> None:
    """Panels of the demo's report, and the viewer's window."""
    panels = []
    for name, row, column in DEMO_PANELS:
        picture = cv2.imread(str(demo / "report" / f"{name}.png"))
        top, left = row * APART[1], column * APART[0]
        panels.append(picture[top : top + PANEL[1], left : left + PANEL[0]])
    gap = np.full((PANEL[1], 8, 3), 255, np.uint8)
    put(np.hstack([part for panel in panels for part in (panel, gap)][:-1]), "demo.jpg", 1624)
    if shutil.which("Xvfb"):
        put(viewer_window(demo), "viewer.jpg", WINDOW_WIDTH)


def viewer_window(demo: Path) -> np.ndarray:
    """What `limbloc view` shows on a virtual screen of the window's size."""
    with tempfile.TemporaryDirectory() as folder:
        screen = f":{90 + os.getpid() % 900}"
        x = subprocess.Popen(["Xvfb", screen, "-screen", "0", f"{WINDOW[0]}x{WINDOW[1]}x24", "-fbdir", folder])
        time.sleep(2)
        frame = min(KeptFrames.load(demo).numbers, key=lambda number: abs(number - WINDOW_FRAME))  # it has its hull
        words = [sys.executable, "-m", "limbloc_ros", "view", str(demo), "--frame", str(frame)]
        viewer = subprocess.Popen(words, cwd=ROOT, env={**os.environ, "DISPLAY": screen})
        try:
            time.sleep(APPEARS_S)
            return xwd_picture((Path(folder) / "Xvfb_screen0").read_bytes())
        finally:
            for process in (viewer, x):
                process.terminate()
                process.wait()


def xwd_picture(data: bytes) -> np.ndarray:
    """The picture (bgr) in an X window dump of 32 bits a pixel."""
    words = np.frombuffer(data[:100], ">u4")
    header, width, height, line, colours = (int(words[i]) for i in (0, 4, 5, 12, 19))
    pixels = np.frombuffer(data, np.uint8, height * line, header + 12 * colours)
    return pixels.reshape(height, line)[:, : 4 * width].reshape(height, width, 4)[..., :3].copy()


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
    parser.add_argument("--demo", type=Path, metavar="RUN", help="the folder that `make demo` left")
    args = parser.parse_args()
    walk = args.walk.resolve()
    with tempfile.TemporaryDirectory() as folder:
        pictures = report_of(walk, Path(folder))
        for name, width in PHOTOGRAPHS.items():
            put(cv2.imread(str(pictures / f"{name}.png")), f"{name}.jpg", width)
        for name in PLOTS:
            (IMAGES / f"{name}.png").write_bytes((pictures / f"{name}.png").read_bytes())
        rig_pictures(walk, Path(folder))
    run("tools/draw_model.py", IMAGES / "model.png")
    if args.demo:
        demo_pictures(args.demo.resolve())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
