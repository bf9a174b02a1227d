# SPDX-License-Identifier: Apache-2.0
"""What benchmarks share: films of a room, our chain run on them stage by stage, and what else the machine did.

Import it before numpy: it keeps every library to one thread, so that process time is the work of one core.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

for threads in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from limbloc_ros.core.background import BackgroundModel  # noqa: E402
from limbloc_ros.core.camera import Rig  # noqa: E402
from limbloc_ros.core.config import BackgroundConfig, FitConfig, HullConfig  # noqa: E402
from limbloc_ros.core.hull import Hull  # noqa: E402
from limbloc_ros.core.pipeline import Carver, PoseEstimator  # noqa: E402
from limbloc_ros.core.pose import Pose  # noqa: E402
from limbloc_ros.recordings.cases import load_case  # noqa: E402
from limbloc_ros.simulation.room import SimulatedRoom, default_rig  # noqa: E402

Pixels = NDArray[np.uint8]
T = TypeVar("T")

#: The simulated person is well inside the room from here on, s.
BEGIN_S = 4.0
#: The parts of a frame's time, in order; `describe` is the rest of the pose: parts of the hull, energy, sigma, angles.
STAGES = ("background", "carve", "surface", "fit", "describe")


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Process time (ms) and the result."""
    start = time.process_time()
    result = work()
    return 1e3 * (time.process_time() - start), result


@dataclass(frozen=True)
class Film:
    """Images of a room that is empty at first.

    Attributes:
        title: what it shows.
        rig: its cameras.
        empty: how many images of the empty room there are.
        shoot: number -> camera name -> uint8 [height, width, 3] bgr; below 0 of the empty room, from -empty on.
    """

    title: str
    rig: Rig
    empty: int
    shoot: Callable[[int], dict[str, Pixels]]


def simulated_film(cameras: int = 8, size: tuple[int, int] = (640, 480), rate_hz: float = 20.0) -> Film:
    """The simulated person, a skinned body that our figure did not draw; rendered when asked for."""
    rig, empty = default_rig(cameras, *size), BackgroundConfig().learning_frames
    room = SimulatedRoom(rig, empty_s=(empty + 1) / rate_hz)

    def shoot(number: int) -> dict[str, Pixels]:
        t = BEGIN_S + number / rate_hz if number >= 0 else (number + empty) / rate_hz
        return room.frame(t).images

    return Film(f"simulated room, {cameras} cameras {size[0]}x{size[1]} at {rate_hz:g} Hz", rig, empty, shoot)


def case_film(folder: Path) -> Film:
    """The images of a benchmark case (`rgb/<camera>/`), shown forth and back for ever."""
    case = load_case(folder)
    files = {name: sorted((folder / "rgb" / name).iterdir()) for name in case.rig.names}
    empty = int(case.meta["background_frames"])
    last = min(map(len, files.values())) - empty - 1

    def shoot(number: int) -> dict[str, Pixels]:
        turn = number % (2 * last) if number >= 0 else 0
        row = empty + (min(turn, 2 * last - turn) if number >= 0 else number)
        return {name: np.asarray(cv2.imread(str(paths[row])), np.uint8) for name, paths in files.items()}

    camera = case.rig.cameras[0]
    title = f"{folder.name}, {len(case.rig.cameras)} cameras {camera.width}x{camera.height}, {last + 1} instants"
    return Film(title, case.rig, empty, shoot)


@dataclass
class Chain:
    """Our whole chain on one film: images -> masks -> hull -> pose.

    Attributes:
        following, alone: process times (ms) of each frame by stage, of the temporal engine and of each frame alone.
        hull, masks: of the last frame.
    """

    film: Film
    hull_config: HullConfig = field(default_factory=HullConfig)

    def __post_init__(self) -> None:
        config = BackgroundConfig(learning_frames=self.film.empty)
        self._models = {name: BackgroundModel(config) for name in self.film.rig.names}
        self._carver = Carver(self.film.rig, self.hull_config)
        self._following = PoseEstimator(FitConfig(temporal=True))
        self.following: list[dict[str, float]] = []
        self.alone: list[dict[str, float]] = []
        for number in range(-self.film.empty, 0):
            for name, image in self.film.shoot(number).items():
                self._models[name].segment(image)

    def see(self, images: dict[str, Pixels]) -> None:
        """The next frame, fitted from the one before."""
        background, self.masks = timed(lambda: {n: self._models[n].segment(i).mask for n, i in images.items()})
        carve, hull = timed(lambda: self._carver.carve(self.masks))
        assert isinstance(hull, Hull), hull
        self.hull = hull
        self._before = {"background": background, "carve": carve}
        self.following.append({**self._before, **_stages(self._following, hull)})

    def fit_alone(self) -> None:
        """Fit the last frame once more, without the ones before."""
        self.alone.append({**self._before, **_stages(PoseEstimator(), self.hull)})


def _stages(estimator: PoseEstimator, hull: Hull) -> dict[str, float]:
    total, pose = timed(lambda: estimator.estimate(hull))
    assert isinstance(pose, Pose), pose
    inner = {stage: pose.stage_ms[stage] for stage in ("surface", "fit")}
    return {**inner, "describe": total - sum(inner.values())}


def sums(frames: list[dict[str, float]], without: tuple[str, ...] = ()) -> NDArray[np.float64]:
    """[F] ms of each frame, of all stages but some."""
    return np.array([sum(ms for stage, ms in frame.items() if stage not in without) for frame in frames])


def median(frames: list[dict[str, float]], stage: str) -> float:
    """The median of a stage, ms."""
    return float(np.median([frame[stage] for frame in frames]))


class Neighbours:
    """What the rest of the machine does beside this process and the children that it has waited for."""

    def __init__(self) -> None:
        self._start = self._now()

    def share(self) -> str:
        """In words, since this was made."""
        wall, others = (now - then for now, then in zip(self._now(), self._start, strict=True))
        return f"other work took {100 * max(others, 0.0) / wall:.0f} % of a core of {os.cpu_count()}"

    @staticmethod
    def _now() -> tuple[float, float]:
        ticks = [int(text) for text in Path("/proc/stat").read_text().split("\n")[0].split()[1:9]]
        busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")  # all but idle and waiting for a disk
        return time.monotonic(), busy - sum(os.times()[:4])


def machine() -> str:
    """The processor and the Python, in words."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.machine())
    return f"{model}, {os.cpu_count()} cores, Python {platform.python_version()}"


def stay_on_one_core() -> None:
    """Keep this process, and the children that it starts, to one of the cores that it may use."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)
