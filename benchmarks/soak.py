# SPDX-License-Identifier: Apache-2.0
"""Runs the real graph for long and looks what grows: `make soak`.

    python benchmarks/soak.py [--minutes 30] [--cameras 8] [--rate 5] [--csv FILE]

Every node runs in its own process on the cameras of a simulated room; a person comes in, stays a while and leaves, ever
again. Every few seconds the graph's resident memory (without mapped files), threads, open files, shared memory segments
and rate are noted. At the end the first quarter after a warm-up is compared with the last one, and after the graph's
end it is looked whether shared memory was left behind. Exit code 1 when memory grew by more than 2 %, anything leaked,
the rate fell, or a process had to be restarted.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from faults.live import Live
from faults.processes import Footprint, footprint, left_behind

#: The person is in the room this long, and then away this long, s.
STAYS_S, AWAY_S = 40.0, 8.0
#: Instants whose truth is kept, for the poses that are still on their way.
REMEMBERED = 200
#: Growth of memory that is allowed, and loss of rate.
GROWTH, SLOWER = 0.02, 0.05


@dataclass(frozen=True)
class Sample:
    """The graph at one time."""

    at_s: float
    held: Footprint
    rate_hz: float
    wrong: int


@dataclass(frozen=True)
class Verdict:
    """The first quarter after the warm-up against the last: medians of MB, threads, files and answers a second."""

    before: tuple[float, ...]
    after: tuple[float, ...]
    restarts: int
    leaked: list[str]

    def problems(self, growth: float = GROWTH) -> list[str]:
        """What is not as it should be."""
        (mb, threads, files, rate), (mb2, threads2, files2, rate2) = self.before, self.after
        found = []
        if mb2 > mb * (1 + growth):
            found.append(f"memory grew from {mb:.0f} to {mb2:.0f} MB, {100 * (mb2 / mb - 1):.1f} %")
        if threads2 > threads or files2 > files:
            found.append(f"threads {threads:.0f} -> {threads2:.0f}, open files {files:.0f} -> {files2:.0f}")
        if rate2 < rate * (1 - SLOWER):
            found.append(f"the rate fell from {rate:.2f} to {rate2:.2f} Hz")
        if self.restarts:
            found.append(f"{self.restarts} restarts")
        if self.leaked:
            found.append(f"left in /dev/shm: {', '.join(self.leaked)}")
        return found


def soak(live: Live, seconds: float, every_s: float, warm_up_s: float) -> tuple[list[Sample], Verdict]:
    """Run a graph that is not started yet for so long, with a sample now and then; it has ended afterwards."""
    samples: list[Sample] = []
    with live:
        if not live.start():
            raise SystemExit("the graph does not start:\n" + "\n".join(live.lines[-20:]))
        began = time.monotonic()
        turn_s, present = began + STAYS_S, True
        while time.monotonic() - began < warm_up_s + seconds:
            first = len(live.answers)
            until = time.monotonic() + every_s
            while (now := time.monotonic()) < until:
                if now >= turn_s:
                    present = not present
                    turn_s = now + (STAYS_S if present else AWAY_S)
                    (live.stage.come_in if present else live.stage.leave)()
                live.spin(min(until, turn_s) - now)
            answers = live.answers[first:]
            held = footprint(live.graph.pids)
            wrong = sum(a.wrong for a in answers)
            samples.append(Sample(time.monotonic() - began, held, len(answers) / every_s, wrong))
            live.answers.clear()  # or this process itself would grow
            live.cameras.forget_all_but(REMEMBERED)
        restarts = sum(live.graph.restarts.values())
    warm = [s for s in samples if s.at_s > warm_up_s] or samples
    quarter = max(len(warm) // 4, 1)
    leaked = left_behind(frozenset().union(*(s.held.segments for s in samples)))
    return samples, Verdict(_medians(warm[:quarter]), _medians(warm[-quarter:]), restarts, leaked)


def _medians(samples: list[Sample]) -> tuple[float, ...]:
    rows = [(s.held.rss_mb, s.held.threads, s.held.files, s.rate_hz) for s in samples]
    return tuple(statistics.median(column) for column in zip(*rows, strict=True))


def main() -> int:
    """Run, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="after the warm-up")
    parser.add_argument("--warm-up", type=float, default=5.0, metavar="MINUTES")
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--rate", type=float, default=5.0, help="images a second of each camera")
    parser.add_argument("--csv", type=Path, help="write the samples to this file")
    args = parser.parse_args()
    live = Live(cameras=args.cameras, rate_hz=args.rate)
    samples, verdict = soak(live, 60 * args.minutes, 10.0, 60 * args.warm_up)
    names = list(samples[0].held.each_mb)
    lines = [f"minutes,{','.join(f'{name}_mb' for name in names)},rss_mb,threads,files,segments,rate_hz,wrong"]
    for s in samples:
        h = s.held
        each = ",".join(str(h.each_mb.get(name, "")) for name in names)
        lines.append(
            f"{s.at_s / 60:.2f},{each},{h.rss_mb:.1f},{h.threads},{h.files},{len(h.segments)},{s.rate_hz:.2f},{s.wrong}"
        )
    print("\n".join(lines[:1] + lines[1 :: max(len(lines) // 20, 1)]))
    if args.csv:
        args.csv.write_text("\n".join(lines) + "\n", encoding="utf-8")
    for name, values in (("first quarter", verdict.before), ("last quarter", verdict.after)):
        mb, threads, files, rate = values
        print(f"{name}: {mb:.1f} MB, {threads:.0f} threads, {files:.0f} files, {rate:.2f} answers a second")
    found = verdict.problems()
    print("\n".join(found) or f"nothing grew in {args.minutes:g} minutes; nothing is left in /dev/shm")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
