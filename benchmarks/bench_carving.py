# SPDX-License-Identifier: Apache-2.0
"""Carving: ours beside a brute force in numba and Open3D's `carve_silhouette`, in one run, and how its cost grows.

    python benchmarks/bench_carving.py [--voxels 0.01 0.02] [--repeats N] [--no-open3d] [--no-scaling]

Everybody sees the same masks of the simulated person, 8 cameras of 640x480 without distortion around 3 x 3 x 2.2 m.
Times are process times of one thread, medians. "Strict" asks like the paper and Open3D: the voxels that lie inside all
silhouettes (ours and the brute force still give each its distance). "Near the hull" is what the fit needs: also the
shell around the hull, and the voxels that only one camera denies. The brute force asks every voxel of the room the same
with the same arithmetic but for the order of sums, leaves a voxel as soon as it is denied, and must find the same
voxels, to a millionth of a metre. Open3D
(`pip install open3d-cpu`, with libusb-1.0-0 on Debian and Ubuntu) keeps a voxel when one of its corners falls on every
mask; the time to fill its dense grid is not counted. It is run once a voxel size.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

for threads in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numba import njit  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from limbloc_ros.core._hull_kernels import camera_distance  # noqa: E402
from limbloc_ros.core._projection_kernels import row_start  # noqa: E402
from limbloc_ros.core.camera import Rig  # noqa: E402
from limbloc_ros.core.config import HullConfig  # noqa: E402
from limbloc_ros.core.hull import Hull, Voxels, carve_silhouettes, evaluate  # noqa: E402
from limbloc_ros.core.silhouettes import (  # noqa: E402
    Silhouettes,
    lattice_bounds,
    measure_silhouettes,
    min_seen,
    pack_cameras,
)
from limbloc_ros.simulation.room import SimulatedRoom, default_rig  # noqa: E402

Masks = dict[str, NDArray[np.uint8]]

#: Instants of the simulation, s.
INSTANTS = (4.0, 9.0, 17.0, 26.0)
LOW, HIGH = np.array([-1.5, -1.5, 0.0]), np.array([1.5, 1.5, 2.2])


@njit(cache=True, error_model="numpy")  # type: ignore[misc, unused-ignore]
def every_voxel(
    low: Any,
    high: Any,
    cams: Any,
    boxes: Any,
    field: Any,
    voxel: float,
    band: float,
    keep_second: bool,
    needed: int,
    room: int,
) -> Any:
    """The brute force: what `evaluate` finds, from all voxels between `low` and `high`."""
    index = np.empty((room, 3), np.int32)
    first = np.empty(room, np.float32)
    second = np.empty(room, np.float32)
    who = np.empty(room, np.int16)
    count = 0
    for i in range(low[0], high[0]):
        x = (i + 0.5) * voxel
        for j in range(low[1], high[1]):
            y = (j + 0.5) * voxel
            for k in range(low[2], high[2]):
                z = (k + 0.5) * voxel
                d1 = -math.inf
                d2 = -math.inf
                largest = -1
                seen = 0
                for c in range(len(cams)):
                    d = camera_distance(cams, c, boxes, field, band, row_start(cams, c, x, y), z)
                    if d == -math.inf:
                        continue
                    seen += 1
                    if d > d1:
                        d2 = d1
                        d1 = d
                        largest = c
                    elif d > d2:
                        d2 = d
                    if d1 >= band and (not keep_second or d2 >= 0.0):
                        break
                if (d1 >= band and (not keep_second or d2 >= 0.0)) or seen < needed:
                    continue
                index[count, 0], index[count, 1], index[count, 2] = i, j, k
                first[count], second[count], who[count] = min(d1, band), d2, largest
                count += 1
    return index[:count], first[:count], second[:count], who[:count]


def brute_force(silhouettes: Silhouettes, rig: Rig, voxel_m: float, band_m: float, keep_second: bool) -> Voxels:
    """Ask every voxel of the volume."""
    low, high = lattice_bounds(rig, voxel_m)
    table = (silhouettes.cameras, silhouettes.boxes, silhouettes.field)
    room = int((high - low).prod())
    needed = min_seen(len(silhouettes.names))
    return every_voxel(low, high, *table, voxel_m, band_m, keep_second, needed, room)  # type: ignore[no-any-return]


class Open3D:
    """Open3D's silhouette carving of a dense grid."""

    def __init__(self) -> None:
        import open3d

        self.open3d = open3d
        self.name = f"Open3D {open3d.__version__} carve_silhouette"

    def carve(self, masks: Masks, rig: Rig, voxel_m: float) -> tuple[float, int]:
        """Process time in s without the filling of the grid, and the number of voxels that stay."""
        o3d = self.open3d
        size = rig.volume_max - rig.volume_min
        grid = o3d.geometry.VoxelGrid.create_dense(rig.volume_min, np.zeros(3), voxel_m, *(float(n) for n in size))
        views = []
        for camera in rig.cameras:
            view = o3d.camera.PinholeCameraParameters()
            view.extrinsic = camera.T_camera_world
            view.intrinsic = o3d.camera.PinholeCameraIntrinsic(camera.width, camera.height, camera.K)
            views.append((o3d.geometry.Image((masks[camera.name] > 0).astype(np.float32)), view))
        start = time.process_time()
        for image, view in views:
            grid.carve_silhouette(image, view, True)
        seconds = time.process_time() - start
        return seconds, len(grid.get_voxels())


def simulated(cameras: int = 8, size: tuple[int, int] = (640, 480), lenses: bool = False) -> tuple[Rig, list[Masks]]:
    """A rig around the room and the person's masks at a few instants."""
    rig = default_rig(cameras, *size)
    if not lenses:
        plain = [dataclasses.replace(c, distortion_model="none", distortion=np.zeros(0)) for c in rig.cameras]
        rig = Rig(tuple(plain), LOW, HIGH)
    rig = Rig(rig.cameras, LOW, HIGH)
    room = SimulatedRoom(rig)
    return rig, [{name: room.render_with_mask(name, t)[1] for name in rig.names} for t in INSTANTS]


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Process time (s) and the result."""
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def in_order(voxels: Voxels) -> list[NDArray[Any]]:
    """Sorted by lattice index, so that two lists of voxels can be compared."""
    order = np.lexsort(voxels[0].T)
    return [part[order] for part in voxels]


def agree(mine: list[NDArray[Any]], theirs: list[NDArray[Any]], band_m: float) -> bool:
    """Whether both found the same voxels, distances and, where it matters to more than rounding, cameras."""
    pairs = zip(mine[1:3], theirs[1:3], strict=True)
    close = [np.abs(a - b)[np.minimum(a, b) < band_m] < 1e-6 for a, b in pairs]
    clear = mine[1] - mine[2] > 1e-6
    return (
        np.array_equal(mine[0], theirs[0])
        and all(part.all() for part in close)
        and np.array_equal(mine[3][clear], theirs[3][clear])
    )


def compare(voxel_m: float, repeats: int, rival: Open3D | None) -> list[str]:
    """One table: ours, the brute force and Open3D on the same masks."""
    rig, frames = simulated()
    packed, config = pack_cameras(rig), HullConfig(voxel_m=voxel_m)
    questions = {"strict": (0.0, False), "near the hull": (config.band_m, True)}
    times: dict[str, list[float]] = {}
    found: dict[str, int] = {}
    for turn in range(-1, repeats):  # the first turn loads the kernels
        for masks in frames[: 1 if turn < 0 else None]:
            seconds, silhouettes = timed(lambda m=masks: measure_silhouettes(m, rig, packed, config))
            now = {"masks measured": seconds}
            for name, (band, second) in questions.items():
                now[f"ours, {name}"], mine = timed(lambda s=silhouettes, b=band, k=second: evaluate(s, b, k))
                if turn > 0:
                    continue
                size = voxel_m if turn == 0 else 0.1
                now[f"numba brute force, {name}"], theirs = timed(
                    lambda s=silhouettes, b=band, k=second, v=size: brute_force(s, rig, v, b, k)
                )
                if turn < 0:
                    continue
                same = [a.shape == b.shape for a, b in zip(mine, theirs, strict=True)]
                if not all(same) or not agree(in_order(mine), in_order(theirs), band):
                    raise SystemExit("ours and the brute force differ: this is a bug")
                found[f"ours, {name}"] = found[f"numba brute force, {name}"] = len(mine[0])
            seconds, hull = timed(lambda s=silhouettes: carve_silhouettes(s, rig, config))
            assert isinstance(hull, Hull), hull
            now["ours, masks to hull"] = now["masks measured"] + seconds
            if turn >= 0:
                for name, seconds in now.items():
                    times.setdefault(name, []).append(seconds)
    if rival is not None:
        seconds, left = rival.carve(frames[-1], rig, voxel_m)
        times[rival.name], found[rival.name] = [seconds], left
    low, high = lattice_bounds(rig, voxel_m)
    medians = {name: 1e3 * float(np.median(values)) for name, values in times.items()}
    base = [medians["ours, strict"], medians["ours, near the hull"]]
    base += [medians["ours, strict"] + medians["masks measured"], medians["ours, masks to hull"]]
    table = [
        f"\n8 cameras, 640x480, voxels of {100 * voxel_m:g} cm, {int((high - low).prod())} in the room\n",
        "| | ms | times ours, strict | times ours, near | times measured + strict | times masks to hull | voxels |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, ms in sorted(medians.items(), key=lambda item: item[1]):
        ratios = " | ".join(f"{ms / one:.3g}" for one in base)
        table.append(f"| {name} | {ms:.1f} | {ratios} | {found.get(name, '')} |")
    return table


def growth(repeats: int) -> list[str]:
    """How the cost grows with cameras, image size, voxel size, and what lens distortion adds."""
    cases: list[tuple[str, dict[str, Any], float]] = [
        (f"{n} cameras", {"cameras": n}, 0.02) for n in (2, 4, 6, 8, 12, 16)
    ]
    cases += [(f"{w}x{h}", {"size": (w, h)}, 0.02) for w, h in ((640, 480), (1280, 720), (1920, 1080))]
    cases += [(f"{100 * v:g} cm", {}, v) for v in (0.01, 0.015, 0.02, 0.03, 0.04)]
    cases += [("8 distorted lenses", {"lenses": True}, 0.02)]
    table = [
        "\nEach row changes one thing of 8 cameras, 640x480, 2 cm. MB: the stored distances to the outlines.",
        "Distances: voxels near the hull times cameras, which every exact method must compute.\n",
        "| | measure ms | near the hull ms | masks to hull ms | MB | 1000 distances | ns a distance |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, how, voxel_m in cases:
        rig, frames = simulated(**how)
        packed, config = pack_cameras(rig), HullConfig(voxel_m=voxel_m)
        times: list[tuple[float, float, float]] = []
        megabytes, distances = [], []
        for turn in range(-1, repeats):
            for masks in frames:
                t_measure, s = timed(lambda m=masks, r=rig, p=packed, c=config: measure_silhouettes(m, r, p, c))
                t_evaluate, voxels = timed(lambda s=s, c=config: evaluate(s, c.band_m))
                t_carve, _ = timed(lambda s=s, r=rig, c=config: carve_silhouettes(s, r, c))
                if turn >= 0:
                    times.append((t_measure, t_evaluate, t_measure + t_carve))
                    megabytes.append(s.field.nbytes / 1e6)
                    distances.append(len(voxels[0]) * len(s.names) / 1e3)
        measure, near, all_of_it = np.median(np.array(times), axis=0) * 1e3
        count = float(np.median(distances))
        table.append(
            f"| {name} | {measure:.1f} | {near:.1f} | {all_of_it:.1f} | {np.median(megabytes):.2f} | {count:.0f} "
            f"| {1e3 * near / count:.0f} |"
        )
    return table


def main() -> int:
    """Run and print Markdown tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voxels", type=float, nargs="+", default=[0.01, 0.02], help="edges of the compared voxels, m")
    parser.add_argument("--repeats", type=int, default=5, help="times that every frame is carved")
    parser.add_argument("--no-open3d", action="store_true", help="leave out Open3D (minutes at 1 cm, 3 GB of memory)")
    parser.add_argument("--no-scaling", action="store_true", help="leave out the table of how the cost grows")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rival = None
    if not arguments.no_open3d:
        try:
            rival = Open3D()
        except (ImportError, OSError) as error:
            print(f"Open3D is left out, it does not load: {error}", file=sys.stderr)
    print("Process times of one thread, medians.")
    for voxel_m in arguments.voxels:
        print("\n".join(compare(voxel_m, arguments.repeats, rival)), flush=True)
    if not arguments.no_scaling:
        print("\n".join(growth(arguments.repeats)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
