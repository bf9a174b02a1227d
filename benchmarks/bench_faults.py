# SPDX-License-Identifier: Apache-2.0
"""Injects faults into the real graph and says how it bears them: the table of docs/reliability.md.

    python benchmarks/bench_faults.py [NAME ...] [--list] [--verbose] [--json FILE]

Every node runs in the process it always has, over DDS; only the cameras are ours: eight of 400x300 px at 5 Hz in the
simulated room. Each fault begins when the pose has been right for a second, lasts for some seconds, and ends; then we
wait until five answers running are right again. A pose is right when every joint of arms and legs is within 150 mm of
the truth, and wrong otherwise; when nobody is there, only no pose is right. The graph publishes no pose that it does
not call reliable, so each wrong one is a confident one. `published` counts the poses while the fault lasts and until
the graph is right again, of the images filmed then.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from faults.live import Answer, Live, Said, steady
from faults.processes import Footprint, footprint
from faults.scenarios import SCENARIOS, Scenario

#: Watched this long after being right again: whether it stays so.
AFTER_S = 3.0
LEVELS = ("fine", "warning", "error")


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a scenario showed.

    Attributes:
        filmed, published, guests, wrong: instants filmed, poses published, those of a second person, wrong ones among
            both, from the fault's begin until the graph is right again.
        warned_s: from the fault's begin to the first new warning; None: never.
        warning: it.
        right_s: from the fault's end (or begin, when it stays) to the first of five right answers; None: never.
        unsteady: wrong poses in the seconds after.
        restarts: processes that the supervisor started again.
        grown_mb: by how much the graph's resident memory grew.
    """

    name: str
    title: str
    filmed: int
    published: int
    guests: int
    wrong: int
    warned_s: float | None
    warning: str
    right_s: float | None
    unsteady: int
    restarts: int
    grown_mb: float


def run(live: Live, scenario: Scenario, verbose: bool = False) -> Outcome:
    """Begin, wait, end, wait."""
    restarts, before = sum(live.graph.restarts.values()), footprint(live.graph.pids)
    bad = {name for name, (level, _) in live.levels.items() if level}
    first_said, first_answer, first_guest = len(live.said), len(live.answers), len(live.guests)
    began = time.monotonic()
    scenario.begin(live)
    live.spin(scenario.lasts_s)
    counted_from = began
    if scenario.end is not None:
        counted_from = time.monotonic()
        scenario.end(live)
    fresh = next((i for i, a in enumerate(live.answers) if a.at_s >= counted_from), len(live.answers))
    live.until(lambda: steady(live.answers[fresh:]) is not None, scenario.patience_s)
    right_at = steady(live.answers[fresh:])
    until = time.monotonic() if right_at is None else right_at
    answers = [a for a in live.answers[first_answer:] if a.at_s < until]
    filmed = sum(began <= at_s < until for at_s in live.cameras.filmed_s)
    guests = live.guests[first_guest:]
    rest = len(live.answers)
    live.spin(AFTER_S)
    said = [s for s in live.said[first_said:] if s.level and s.at_s <= until + 1.0]
    new = [s for s in said if s.name not in bad and ": posture" not in s.name] or said
    if verbose:
        show(live, first_said, live.answers[first_answer:] + live.guests[first_guest:], began)
    after = footprint(live.graph.pids)
    return Outcome(
        scenario.name,
        scenario.title,
        filmed,
        sum(a.posed for a in answers),
        sum(a.posed for a in guests),
        sum(a.wrong for a in (*answers, *guests)),
        new[0].at_s - began if new else None,
        f"{new[0].name}: {new[0].message}" if new else "",
        None if right_at is None else max(right_at - counted_from, 0.0),
        sum(a.wrong for a in live.answers[rest:]),
        sum(live.graph.restarts.values()) - restarts,
        after.rss_mb - before.rss_mb,
    )


def show(live: Live, first_said: int, answers: list[Answer], began: float) -> None:
    """Everything that was heard, in order."""
    events: list[tuple[float, str]] = [(s.at_s, _say(s)) for s in live.said[first_said:]]
    for a in answers:
        mark = "right" if a.right else "WRONG" if a.wrong else "no pose"
        events.append((a.at_s, f"  {mark} {1e3 * a.error_m[0]:.0f} {1e3 * a.error_m[1]:.0f} mm, there: {a.there}"))
    for at_s, text in sorted(events):
        print(f"    {at_s - began:6.2f} {text}")


def _say(said: Said) -> str:
    return f"{LEVELS[min(said.level, 2)]}: {said.name}: {said.message}"


def make_live(scenario: Scenario) -> Live:
    """The graph that a scenario needs."""
    settings = {"processes": {"restart_delay_s": 1.0}}
    return Live(settings=settings, relayed=scenario.graph == "relay")


def table(outcomes: list[Outcome]) -> str:
    """As Markdown."""
    lines = [
        "| fault | poses / images | wrong | first warning | after s | right again after s |",
        "|---|---|---|---|---|---|",
    ]
    for o in outcomes:
        warned = "" if o.warned_s is None else f"{o.warned_s:.1f}"
        right = "never" if o.right_s is None else f"{o.right_s:.1f}"
        poses = f"{o.published} and {o.guests}" if o.guests else f"{o.published}"
        lines.append(f"| {o.title} | {poses} / {o.filmed} | {o.wrong} | {o.warning} | {warned} | {right} |")
    return "\n".join(lines)


def main() -> int:
    """Run the scenarios, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="scenarios; default: all")
    parser.add_argument("--list", action="store_true", help="only list the scenarios")
    parser.add_argument("--verbose", action="store_true", help="print everything that is heard")
    parser.add_argument("--json", type=Path, help="write the outcomes to this file, too")
    args = parser.parse_args()
    if args.list:
        for s in SCENARIOS:
            print(f"{s.name:15s} {s.title}")
        return 0
    if unknown := set(args.names) - {s.name for s in SCENARIOS}:
        parser.error(f"no scenario is called {', '.join(sorted(unknown))}; --list shows them")
    wanted = [s for s in SCENARIOS if s.name in args.names or not args.names]
    outcomes: list[Outcome] = []
    for graph in ("plain", "relay"):
        outcomes += run_all([s for s in wanted if s.graph == graph], args.verbose)
    print("\n" + table(outcomes))
    if args.json:
        args.json.write_text(json.dumps([dataclasses.asdict(o) for o in outcomes], indent=1))
    return 0 if all(o.right_s is not None for o in outcomes) else 1


def run_all(scenarios: list[Scenario], verbose: bool) -> list[Outcome]:
    """One after the other on the same graph; a new one when it does not come right again."""
    outcomes: list[Outcome] = []
    waiting = list(scenarios)
    while waiting:
        with make_live(waiting[0]) as live:
            if not live.start():
                print("\n".join(live.lines[-20:]), file=sys.stderr)
                raise SystemExit("the graph does not get right without any fault")
            start: Footprint = footprint(live.graph.pids)
            while waiting:
                scenario = waiting.pop(0)
                outcome = run(live, scenario, verbose)
                outcomes.append(outcome)
                print(f"{scenario.name}: {outcome}", flush=True)
                if not live.until_right(15.0):
                    print(f"after {scenario.name}: not right, a new graph", flush=True)
                    break
            end = footprint(live.graph.pids)
            print(
                f"graph: {start.rss_mb} -> {end.rss_mb} MB, {start.threads} -> {end.threads} threads, "
                f"{start.files} -> {end.files} files, {len(start.segments)} -> {len(end.segments)} shared segments",
                flush=True,
            )
            for line in live.lines:
                if "Traceback" in line or "terminate called" in line or "died" in line:
                    print("   ", line)
    return outcomes


if __name__ == "__main__":
    raise SystemExit(main())
