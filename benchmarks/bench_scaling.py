# SPDX-License-Identifier: Apache-2.0
"""How cost grows: with cores, voxel size, cameras and image size, beside what the machine could do at best.

    python benchmarks/bench_scaling.py [--frames N] [--plots docs/images] [--only cores|voxels|cameras|images|memory]

Frames against cores are offline runs, `limbloc process --jobs`, by the clock, from the end of the first frames to that
of the last. All else is process time of one core, medians over consecutive frames of the simulated room, one thing
changed at a time from 8 cameras, 640x480, 2 cm. Memory is the largest resident set of each process.

The physical limit of a stage (`least_work`) is the larger of two times: the bytes that it must touch at least over the
bandwidth of a large copy, and the operations that it must do at least over the rate of a large matrix product, both
measured here, on one core, in the same run.
"""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import measuring
from measuring import ROOT, STAGES, Chain, median, simulated_film, sums

import matplotlib as mpl  # isort: skip  # after measuring, which sets the number of threads

mpl.use("Agg")

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from limbloc_ros.core import energy, figure
from limbloc_ros.core.camera import Camera
from limbloc_ros.core.config import BackgroundConfig, HullConfig
from limbloc_ros.core.figure import FigureState
from limbloc_ros.core.lm import System
from limbloc_ros.core.surface import extract_surface
from limbloc_ros.core.tracker import Tracker
from limbloc_ros.recordings import offline
from limbloc_ros.recordings.cases import load_case
from limbloc_ros.recordings.offline import OfflineConfig, process
from limbloc_ros.recordings.sources import CaseSource

CASE = ROOT / "test/data/benchmark/public/seq_wave"
VOXELS_M = (0.01, 0.015, 0.02, 0.03, 0.04)
CAMERAS = (2, 4, 6, 8, 12, 16)
SIZES = ((640, 480), (1280, 960), (1920, 1080))


@dataclass(frozen=True)
class Rates:
    """What one core of this machine does: bytes a second of a large copy (read and written), operations a second."""

    bytes_s: float
    flops_s: float


def measured_rates() -> Rates:
    """The best of several large copies (far beyond the caches) and matrix products (double precision)."""
    source = np.ones(32_000_000)
    target = np.empty_like(source)
    a = np.random.default_rng(0).normal(size=(1024, 1024))
    copying = min(measuring.timed(lambda: np.copyto(target, source))[0] for _ in range(7))
    multiplying = min(measuring.timed(lambda: a @ a)[0] for _ in range(7))
    return Rates(2e3 * source.nbytes / copying, 1e3 * 2 * len(a) ** 3 / multiplying)


@dataclass
class Evaluations:
    """How often the smooth energy was worked out, and its process time, ms."""

    count: int = 0
    ms: float = 0.0

    def __enter__(self) -> Evaluations:
        self._real = energy.system

        def counting(*args: object) -> System:
            ms, result = measuring.timed(lambda: self._real(*args))  # type: ignore[arg-type]
            self.count += 1
            self.ms += ms
            return result

        energy.system = counting  # type: ignore[assignment]
        return self

    def __exit__(self, *_: object) -> None:
        energy.system = self._real


def least_work(chain: Chain, evaluations: float) -> dict[str, tuple[float, float]]:
    """Bytes and operations that each stage of a followed frame needs at least; the caches may serve all that is read
    twice.

    - background: a pixel's three bytes and its model's level and noise (two bytes each for three channels) are read, a
      byte of mask is written; some 20 operations. Of images larger than the model's working size, only the image and
      the mask count at full size.
    - carve: a byte of every mask's pixel is read; distances to the outline are written and read once where they are
      needed, in some 10 operations; each voxel near the hull is projected into each camera and a distance looked up
      between four pixels, in some 35, and written once.
    - surface: the grid is read once; a point of the surface takes 27 neighbours in three filters and the way along the
      normal, some 220, and is written with its normal.
    - fit: each evaluation finds the nearest flesh of every point, some 30, and adds a block of 12 x 12, symmetric, some
      160; the figure's Jacobian (only what is not zero) carries the blocks to the parameters; a system is solved. The
      number of evaluations is taken as it is.
    - describe: the grid is read once; the errors of 25 joints are solved for.
    """
    cameras = chain.film.rig.cameras
    pixels = [camera.width * camera.height for camera in cameras]
    working = [mask_pixels // _shrunk(mask_pixels) for mask_pixels in pixels]
    shell, points = chain.hull.shell()[0], len(extract_surface(chain.hull))
    near = sum(_pixels_needed(chain, camera, shell) for camera in cameras)
    state = FigureState.standing(np.zeros(3))  # how many parameters move a sphere does not depend on the pose
    moved = figure.place_jacobian(state)[: figure.N_SPHERES].any(axis=1).sum(axis=1).astype(float)
    parameters = 3 + figure.N_DOF + len(state.shape)
    points_asked = 0.5 * (Tracker.POINTS + Tracker.FINAL_POINTS)  # about half of the evaluations each
    evaluation = points_asked * 190 + float((3 * 32 * moved + 4 * moved**2).sum()) + parameters**3 / 3
    return {
        "background": (sum(4.0 * full + 12.0 * small for full, small in zip(pixels, working, strict=True)),
                       20.0 * sum(working)),
        "carve": (sum(pixels) + 8.0 * near + 4.0 * len(shell), 10.0 * near + 35.0 * len(shell) * len(cameras)),
        "surface": (4.0 * len(shell) + 60.0 * points, 220.0 * points),
        "fit": (4.0 * len(shell) + 80.0 * (Tracker.POINTS + Tracker.FINAL_POINTS), evaluations * evaluation),
        "describe": (4.0 * len(shell), parameters**3 / 3 + 2.0 * 75 * parameters**2),
    }  # fmt: skip


def _pixels_needed(chain: Chain, camera: Camera, shell: NDArray[np.int32]) -> int:
    """Of how many pixels the distance to the outline is needed: the mask's rectangle and the hull's shell around it."""
    T = camera.T_camera_world
    nearest = float((T[2, :3] @ ((shell + 0.5) * chain.hull.voxel_m).T + T[2, 3]).min())
    margin = camera.K[0, 0] * chain.hull.band_m / max(nearest, 0.1)
    _, _, width, height = cv2.boundingRect(chain.masks[camera.name])
    return int(min(width + 2 * margin, camera.width) * min(height + 2 * margin, camera.height))


def _shrunk(pixels: int) -> int:
    factor = 1
    while pixels // factor**2 > BackgroundConfig().max_pixels:
        factor *= 2
    return factor**2


@dataclass(frozen=True)
class Point:
    """One setting: medians of a frame in ms by stage, of each frame alone as a whole, and the limit by stage."""

    label: str
    stages: dict[str, float]
    whole: float
    mean: float
    alone: float
    limit: dict[str, float]
    work: dict[str, tuple[float, float]]
    evaluations: Evaluations


def measure(label: str, film: measuring.Film, config: HullConfig, rates: Rates, args: argparse.Namespace) -> Point:
    """Run the chain on a film."""
    chain, evaluations = Chain(film, config), Evaluations()
    counts: list[int] = []
    for number in range(args.frames):
        images, before = film.shoot(number), evaluations.count
        with evaluations:
            chain.see(images)
        counts.append(evaluations.count - before)
        if number % max(args.frames // args.alone, 1) == 0:
            chain.fit_alone()
    work = least_work(chain, float(np.median(counts)))
    limit = {stage: 1e3 * max(b / rates.bytes_s, f / rates.flops_s) for stage, (b, f) in work.items()}
    totals = sums(chain.following)
    stages = {stage: median(chain.following, stage) for stage in STAGES}
    point = Point(label, stages, float(np.median(totals)), float(totals.mean()), float(np.median(sums(chain.alone))),
                  limit, work, evaluations)  # fmt: skip
    cells = [f"{stages[stage]:.1f}" for stage in STAGES]
    cells += [f"{point.whole:.1f}", f"{point.mean:.1f}", f"{point.alone:.0f}", f"{sum(limit.values()):.2f}"]
    print(f"| {label} | " + " | ".join(cells) + f" | {point.whole / sum(limit.values()):.0f} |", flush=True)
    return point


def head(title: str) -> None:
    """Begin a table."""
    names = [title, *STAGES, "whole, following", "its mean", "whole, each alone", "limit", "whole / limit"]
    print("\n| " + " | ".join(names) + " |\n|" + "---|" * len(names))


def explain(point: Point, frames: int) -> None:
    """Where the time of one setting goes, beside the limit."""
    print(f"\n{point.label}:\n\n| stage | ms | MB at least | Mflop at least | limit ms | ms / limit |")
    print("|---|---|---|---|---|---|")
    for stage, (bytes_, flops) in point.work.items():
        ms, limit = point.stages[stage], point.limit[stage]
        print(f"| {stage} | {ms:.2f} | {bytes_ / 1e6:.2f} | {flops / 1e6:.2f} | {limit:.3f} | {ms / limit:.0f} |")
    e = point.evaluations
    print(f"\nfit: {e.count / frames:.1f} evaluations of the energy a frame, {1e3 * e.ms / e.count:.0f} us each")


def draw(points: list[Point], axis: str, values: list[float], labels: list[str], path: Path) -> None:
    """One plot: ms of a frame against one setting, with the limit."""
    figure_, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    x = np.array(values)
    lines = {
        "whole frame, each frame alone": ([p.alone for p in points], "#b2182b", "-", "s"),
        "whole frame, following": ([p.whole for p in points], "#000000", "-", "o"),
        "backgrounds": ([p.stages["background"] for p in points], "#1b7837", "-", "."),
        "hull (carve)": ([p.stages["carve"] for p in points], "#2166ac", "-", "."),
        "pose, following (surface, fit, describe)": (
            [sum(p.stages[s] for s in STAGES[2:]) for p in points], "#e08214", "-", ".",
        ),
        "physical limit, following": ([sum(p.limit.values()) for p in points], "#666666", "--", ""),
    }  # fmt: skip
    for name, (ms, colour, style, marker) in lines.items():
        axes.plot(x, ms, style, color=colour, marker=marker, label=name, linewidth=1.6)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_major_locator(FixedLocator(values))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(values, [label.split()[0] for label in labels])
    axes.set_xlabel(axis)
    axes.set_ylabel("process time of a frame on one core, ms")
    right = axes.secondary_yaxis("right", functions=(_inverse, _inverse))
    right.set_ylabel("frames a second on one core")
    finish(axes, [right.yaxis, axes.yaxis])
    figure_.savefig(path, dpi=110)
    plt.close(figure_)


def _inverse(ms: np.ndarray) -> np.ndarray:
    return np.asarray(1e3 / np.maximum(ms, 1e-9))


def finish(axes: Axes, logarithmic: Iterable[Axis]) -> None:
    """Grid, legend beside the lines, numbers as people write them."""
    for one in logarithmic:
        one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(which="major", color="#d0d0d0", linewidth=0.7)
    axes.grid(which="minor", axis="y", color="#ececec", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)


def cores(args: argparse.Namespace, limit_ms: float) -> None:
    """Frames a second of offline runs with 1, 2, ... processes, in turn, each as often as the others."""
    case = load_case(CASE)
    many = range(1, offline.usable_cores() + 1)
    rates: dict[int, list[float]] = {jobs: [] for jobs in many}
    neighbours = measuring.Neighbours()
    for _ in range(args.turns):
        for jobs in many:
            ends: list[float] = []
            process(
                CaseSource(case), OfflineConfig(), jobs=jobs, progress=lambda *_, e=ends: e.append(time.monotonic())
            )
            skip = 1 + 2 * jobs  # the first wait for the processes to start; the last have all cores to themselves
            rates[jobs].append((len(ends) - 1 - skip) / (ends[-1] - ends[skip]))
    best = {jobs: max(values) for jobs, values in rates.items()}  # whatever else runs can only slow it down
    print(f"\n{CASE.name}, {len(case)} frames, masks to poses, each frame alone, by the clock; {neighbours.share()}\n")
    print("| --jobs | frames a second, best run | each run | times one job |\n|---|---|---|---|")
    for jobs, rate in best.items():
        each = ", ".join(f"{value:.2f}" for value in rates[jobs])
        print(f"| {jobs} | {rate:.2f} | {each} | {rate / best[1]:.2f} |")
    if args.plots is not None:
        draw_cores(best, limit_ms, args.plots / "scaling_cores.png")


def draw_cores(best: dict[int, float], limit_ms: float, path: Path) -> None:
    """One plot: frames a second against processes, with the limit."""
    figure_, axes = plt.subplots(figsize=(6.0, 4.2), layout="constrained")
    x = np.array(list(best))
    axes.plot(x, x * 1e3 / limit_ms, "--", color="#666666", label="physical limit of a search like ours")
    axes.plot(x, x * best[1], ":", color="#2166ac", label="so many times one process")
    axes.plot(x, list(best.values()), "-o", color="#b2182b", label="limbloc process, each frame alone")
    for jobs, rate in best.items():
        axes.annotate(f"{rate:.1f}", (jobs, rate), textcoords="offset points", xytext=(0, 8), ha="center", fontsize=9)
    axes.set_yscale("log")
    axes.set_ylim(1, 3e3 / limit_ms * x[-1])
    axes.set_xlim(0.7, x[-1] + 0.3)
    axes.set_xticks(x)
    axes.set_xlabel("processes (--jobs), one core each")
    axes.set_ylabel("frames a second, by the clock")
    finish(axes, [axes.yaxis])
    figure_.savefig(path, dpi=110)
    plt.close(figure_)


def search_limit_ms(rates: Rates) -> float:
    """The limit of a frame alone, masks to pose: as of a followed one, with as many evaluations as a search makes."""
    film = simulated_film()
    chain, counts = Chain(film), []
    for number in (0, 20, 40, 60, 80):
        chain.see(film.shoot(number))
        with Evaluations() as evaluations:
            chain.fit_alone()
        counts.append(evaluations.count)
    work = least_work(chain, float(np.median(counts)))
    print(f"\na frame alone: {np.median(counts):.0f} evaluations of the energy")
    return sum(1e3 * max(b / rates.bytes_s, f / rates.flops_s) for s, (b, f) in work.items() if s != "background")


def memory() -> None:
    """Peak resident memory of offline runs: the largest that each of their processes ever had."""
    print(f"\n| limbloc process {CASE.name} | processes | largest resident set, MB | sum, MB |\n|---|---|---|---|")
    for options in (["--jobs", "1"], ["--temporal"], ["--jobs", "2"]):
        peaks: dict[int, float] = {}
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "limbloc_ros", "process", str(CASE), "--out", folder, *options]
            run = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            while run.poll() is None:
                peaks.update(_peaks_mb(run.pid))
                time.sleep(0.05)
        if run.returncode != 0:
            raise SystemExit(f"{' '.join(command)} ended with {run.returncode}")
        working = [mb for mb in peaks.values() if mb > 50]  # multiprocessing has helpers that only watch
        print(f"| {' '.join(options)} | {len(working)} | {max(working):.0f} | {sum(working):.0f} |", flush=True)


def _peaks_mb(pid: int) -> dict[int, float]:
    """The largest resident set so far of a process and those that it has started, by pid."""
    peaks: dict[int, float] = {}
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it may end meanwhile
        status = Path(f"/proc/{pid}/status").read_text()
        if "VmHWM:" in status:  # not any more when it has ended
            peaks[pid] = int(status.partition("VmHWM:")[2].split()[0]) / 1024
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            peaks |= _peaks_mb(int(child))
    return peaks


def main() -> int:
    """Run, print Markdown tables, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60, help="consecutive frames of each setting")
    parser.add_argument("--alone", type=int, default=6, help="so many of them are also fitted alone")
    parser.add_argument("--turns", type=int, default=3, help="offline runs with each number of processes")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw scaling_*.png there")
    parts = ("voxels", "cameras", "images", "cores", "memory")
    parser.add_argument("--only", choices=parts, action="append", help="only this part; may be repeated")
    args = parser.parse_args()
    parts = tuple(args.only or parts)
    if args.plots is not None:
        args.plots.mkdir(parents=True, exist_ok=True)  # not after minutes of work
    offline.prepare(lambda text: print(text, file=sys.stderr))
    neighbours, rates = measuring.Neighbours(), measured_rates()
    print(f"{measuring.machine()}; {args.frames} frames of each setting, ms")
    print(f"one core copies {rates.bytes_s / 1e9:.1f} GB/s (read and written)")
    print(f"and does {rates.flops_s / 1e9:.1f} Gflop/s in double precision")
    voxels, images = [100 * v for v in VOXELS_M], [w * h / 1e6 for w, h in SIZES]
    # Title of the axis, values, their labels, and what is measured at each.
    sweep: dict[str, tuple[str, list[float], list[str], Callable[[int], tuple[measuring.Film, HullConfig]]]] = {
        "voxels": (
            "edge of a voxel, cm", voxels, [f"{v:g} cm" for v in voxels],
            lambda n: (simulated_film(), HullConfig(voxel_m=VOXELS_M[n])),
        ),
        "cameras": (
            "cameras, 640x480", list(map(float, CAMERAS)), [f"{n} cameras" for n in CAMERAS],
            lambda n: (simulated_film(CAMERAS[n]), HullConfig()),
        ),
        "images": (
            "size of each of 8 images", images, [f"{w}x{h}" for w, h in SIZES],
            lambda n: (simulated_film(size=SIZES[n]), HullConfig()),
        ),
    }  # fmt: skip
    for name, (axis, values, labels, setting) in sweep.items():
        if name not in parts:
            continue
        head(name)
        points = [measure(label, *setting(n), rates, args) for n, label in enumerate(labels)]
        if name == "voxels":
            explain(points[VOXELS_M.index(0.02)], args.frames)
        if args.plots is not None:
            draw(points, axis, values, labels, args.plots / f"scaling_{name}.png")
    if "cores" in parts:
        cores(args, search_limit_ms(rates))
    if "memory" in parts:
        memory()
    print(f"\nin all: {neighbours.share()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
