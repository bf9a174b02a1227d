# SPDX-License-Identifier: Apache-2.0
"""What each replacement bought: from the paper's engine to ours, one step at a time, on the public suites.

    python benchmarks/bench_ablation.py [--every N] [--steps 1-11]

Every frame is fitted alone, from the same hull, by each step's engine; one thread. Columns: median distance of the 13
limb joints in mm and, after the slash, the frames with all of them within 15 cm in %, per suite; then the median
process time of a frame's fit (least squares after the paper's engine: without that). A frame without a pose counts
1000 mm. `--every 1` takes all frames: some hours, nearly all of them for the paper's engine.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from score import LIMB13  # noqa: E402
from tqdm import tqdm  # noqa: E402

from limbloc_ros.core import engine_paper, engine_robust  # noqa: E402
from limbloc_ros.core.confidence import Judge  # noqa: E402
from limbloc_ros.core.config import HullConfig  # noqa: E402
from limbloc_ros.core.energy import Weights  # noqa: E402
from limbloc_ros.core.engine_robust import QUICK, SEARCHES, Effort  # noqa: E402
from limbloc_ros.core.errors import NoPerson  # noqa: E402
from limbloc_ros.core.figure import FigureState, place  # noqa: E402
from limbloc_ros.core.hull import Hull, evaluate, largest_component  # noqa: E402
from limbloc_ros.core.pipeline import Carver  # noqa: E402
from limbloc_ros.core.pose import JOINT_NAMES  # noqa: E402
from limbloc_ros.core.silhouettes import measure_silhouettes, pack_cameras  # noqa: E402
from limbloc_ros.core.surface import extract_surface  # noqa: E402
from limbloc_ros.recordings.cases import Case, load_case  # noqa: E402

Array = NDArray[np.float64]

SUITES = ("public", "public_clothed", "public_noisy", "public_few")
ROWS = [JOINT_NAMES.index(name) for name in LIMB13]

#: No figure is searched twice, no limb looked for again: one torso with both facings, one pair of legs, one of arms.
SIMPLEST = Effort(
    torsos=1, leg_pairs=1, starts=2, survivors=1, repaired=0, arm_repairs=0, leg_repairs=0, strict=1, single_arms=0,
    single_legs=0, rounds=0, finalists=1, candidates=QUICK.candidates, enough=0.0,
)  # fmt: skip


class Paper:
    """The paper's own chain. It remembers the last hull's figure, for the next step goes on from the same one."""

    def __init__(self) -> None:
        self._last: tuple[Hull, FigureState | None] | None = None

    def fit(self, hull: Hull) -> FigureState | None:
        """The paper's figure."""
        if self._last is None or self._last[0] is not hull:
            found = engine_paper.fit_state(hull)
            self._last = hull, None if isinstance(found, NoPerson) else found[0].state
        return self._last[1]

    def fit_and_go_on(self, hull: Hull) -> FigureState | None:
        """The paper's figure, then least squares on our energy."""
        state = self.fit(hull)
        if state is None:
            return None
        weights = Weights()
        evidence = engine_robust.gather_evidence(hull, extract_surface(hull), 1000, np.random.default_rng(0))
        state = engine_robust.refine(state, evidence, engine_robust.firm(weights), 20).state
        return engine_robust.refine(state, evidence, weights, 12).state


def searched(*searches: Effort, doubting: bool = False) -> Callable[[Hull], FigureState | None]:
    """Our engine with these searches, one after the other while the energy is high, or the figure doubtful."""

    def fit(hull: Hull) -> FigureState | None:
        surface = extract_surface(hull)

        risk_of = Judge(hull, surface).risk_worth_a_search if doubting else None
        found = engine_robust.fit_from_scratch(hull, surface, 0, None, searches, risk_of)
        return None if found is None else found.state

    return fit


CONFIG = HullConfig()


def voted(case: Case, frame: int) -> Hull | None:
    """The hull of cameras that may be outvoted, and what they saw."""
    found = Carver(case.rig, CONFIG).carve(case.masks(frame))
    return None if isinstance(found, NoPerson) else largest_component(found)


def blindly_voted(case: Case, frame: int) -> Hull | None:
    """The same hull, without the silhouettes by which figures are judged."""
    found = voted(case, frame)
    return None if found is None else dataclasses.replace(found, views=None)


def intersected(case: Case, frame: int) -> Hull | None:
    """The paper's hull: what no camera denies."""
    silhouettes = measure_silhouettes(case.masks(frame), case.rig, pack_cameras(case.rig), CONFIG)
    indices, distance, _, _ = evaluate(silhouettes, CONFIG.band_m, keep_second=False)
    if not (distance < 0).any():
        return None
    return largest_component(Hull.from_shell(CONFIG.voxel_m, CONFIG.band_m, indices, distance))


@dataclass(frozen=True)
class Step:
    """One line of the table."""

    title: str
    fit: Callable[[Hull], FigureState | None]
    carve: Callable[[Case, int], Hull | None] = blindly_voted


PAPER = Paper()
_SEVERAL = dataclasses.replace(QUICK, single_arms=0, single_legs=0, rounds=0, enough=0.0)
STEPS = (
    Step("`paper`, hull by plain intersection", PAPER.fit, intersected),
    Step("`paper`, hull by voting", PAPER.fit),
    Step("+ least squares on our energy after its simplex", PAPER.fit_and_go_on),
    Step("our search in the place of its anchor points: one torso, one pair of legs, one of arms", searched(SIMPLEST)),
    Step("+ more torsos, pairs of legs and of arms", searched(_SEVERAL)),
    Step("+ each limb of the winner tried elsewhere", searched(dataclasses.replace(QUICK, enough=0.0))),
    Step("+ a second search while the energy is high", searched(*SEARCHES[:2])),
    Step("+ a third, and loose clothes", searched(*SEARCHES)),
    Step("+ figures judged by the silhouettes", searched(*SEARCHES), voted),
    Step("+ another search when they call a figure doubtful: `robust`", searched(*SEARCHES, doubting=True), voted),
    Step("`robust`, hull by plain intersection", searched(*SEARCHES), intersected),
)


Carve = Callable[[Case, int], Hull | None]


def frames(data: Path, suite: str, every: int) -> Iterator[tuple[Callable[[Carve], Hull | None], Array]]:
    """Every so many frames of a suite: what carves it, and the true joints [13, 3]."""
    for folder in sorted(folder for folder in (data / suite).iterdir() if (folder / "calib.json").is_file()):
        case = load_case(folder)
        for frame in range(0, len(case), every):

            @functools.cache
            def hull(carve: Carve, case: Case = case, frame: int = frame) -> Hull | None:
                return carve(case, frame)

            yield hull, np.stack([case.truth[name][frame] for name in LIMB13])


def fit_all(steps: Sequence[Step], data: Path, every: int) -> list[str]:
    """The table's lines."""
    cells: list[list[str]] = [[] for _ in steps]
    times: list[list[float]] = [[] for _ in steps]
    for suite in SUITES:
        errors: list[list[Array]] = [[] for _ in steps]
        for carve, truth in tqdm(frames(data, suite, every), desc=suite, unit="frame", disable=None):
            for n, step in enumerate(steps):
                hull = carve(step.carve)
                started = time.process_time()
                state = None if hull is None else step.fit(hull)
                times[n].append(1e3 * (time.process_time() - started))
                joints = np.full((len(ROWS), 3), np.nan) if state is None else place(state).joints[ROWS]
                errors[n].append(1e3 * np.linalg.norm(joints - truth, axis=1))
        for n, rows in enumerate(errors):
            far = np.nan_to_num(np.array(rows), nan=1000.0)
            cells[n].append(f"{np.median(far):.1f} / {100 * (far < 150).all(axis=1).mean():.0f}")
    return [
        f"| {step.title} | " + " | ".join(of_step) + f" | {np.median(ms):.0f} |"
        for step, of_step, ms in zip(steps, cells, times, strict=True)
    ]


def main() -> int:
    """Run and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=6, metavar="N", help="every such frame (default: %(default)s)")
    parser.add_argument("--steps", default=f"1-{len(STEPS)}", metavar="A-B", help="lines to work out (default: all)")
    parser.add_argument("--data", type=Path, default=ROOT / "test/data/benchmark", help="folder of the suites")
    args = parser.parse_args()
    first, last = (int(number) for number in args.steps.split("-"))
    lines = fit_all(STEPS[first - 1 : last], args.data, args.every)
    print("| | " + " | ".join(SUITES) + " | ms |\n|---|" + "---|" * (len(SUITES) + 1))
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
