# SPDX-License-Identifier: Apache-2.0
"""`make fuzz`: many damaged inputs for every reader. One process a target, as many at once as asked for.

A fault ends its process; the input is kept, and the target goes on in a new process with the runs that are left.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import hashlib
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import fuzz.message_targets
import fuzz.recording_targets  # noqa: F401  (they enter their targets)
from fuzz.targets import CORPUS, TARGETS

#: One input may take so long, s.
TIMEOUT_S = 10
#: A target with so many faults has told enough.
MOST_FAULTS = 20
_TOLD = re.compile(r"FUZZED (\d+) good (\d+) slowest ([\d.]+)")


@dataclass
class Result:
    """What became of a target."""

    name: str
    runs: int = 0
    good: int = 0
    slowest_s: float = 0.0
    seconds: float = 0.0
    faults: dict[str, Path] = field(default_factory=dict)


def fuzz_target(name: str, runs: int, seconds: float, out: Path, seed: int) -> Result:
    """Run one target until its runs or seconds are over."""
    result, start = Result(name), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="limbloc_corpus_") as text:
        corpus = Path(text)
        fixed = CORPUS / name
        seeds = TARGETS[name].seeds() + [p.read_bytes() for p in (sorted(fixed.iterdir()) if fixed.is_dir() else [])]
        for i, raw in enumerate(seeds):
            (corpus / f"seed{i}").write_bytes(raw)
        while result.runs < runs and len(result.faults) < MOST_FAULTS:
            left = seconds - (time.monotonic() - start)
            if left < 1:
                break
            prefix = out / f"{name}-"
            command = [
                *(sys.executable, "-m", "fuzz.child", name, str(corpus), f"-runs={runs - result.runs}"),
                *(f"-max_total_time={int(left)}", f"-timeout={TIMEOUT_S}", "-rss_limit_mb=0", f"-seed={seed}"),
                *(f"-max_len={TARGETS[name].most}", f"-artifact_prefix={prefix}", "-print_final_stats=0"),
            ]
            before = set(out.iterdir())
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
            told = _TOLD.findall(done.stdout)
            if told:
                result.runs += int(told[-1][0])
                result.good += int(told[-1][1])
                result.slowest_s = max(result.slowest_s, float(told[-1][2]))
            if done.returncode == 0:
                break
            found = sorted(set(out.iterdir()) - before)
            log = done.stdout[-2000:] + done.stderr[-6000:]
            where = _where(log)
            if where in result.faults or not found:
                where += " " + hashlib.sha256(log.encode()).hexdigest()[:6]
            path = found[0] if found else out / f"{name}-log"
            result.faults[where] = path
            (out / f"{path.name}.txt").write_text(log)
            seed += 1
            # libFuzzer loads its corpus anew; what it had found is kept in it.
    result.seconds = time.monotonic() - start
    return result


def _where(log: str) -> str:
    """The error and the last of our own lines in a log."""
    lines = re.findall(r'File ".*?(limbloc_ros/[^"]+|fuzz/\w+\.py)", line (\d+)', log)
    error = re.findall(r"^\s*(\w*(?:Error|Exception|Warning)\b.*)$", log, re.M)
    what = "timeout" if "ALARM" in log else error[-1][:100] if error else "the process died"
    return f"{what} at {':'.join(lines[-1]) if lines else 'an unknown place'}"


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser("python -m fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"default: all of {', '.join(TARGETS)}")
    parser.add_argument("--runs", type=int, default=100_000, help="inputs of each target (default: 100000)")
    parser.add_argument("--seconds", type=float, default=3600, help="at most so long for each target (default: 3600)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="targets at once (default: one per core)")
    parser.add_argument("--seed", type=int, default=1, help="of the random choices (default: 1)")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="for inputs that fail (default: out/fuzz)")
    args = parser.parse_args()
    if unknown := sorted(set(args.targets) - set(TARGETS)):
        parser.error(f"no target {', '.join(unknown)}; there are {', '.join(TARGETS)}")
    args.out.mkdir(parents=True, exist_ok=True)
    names = args.targets or list(TARGETS)
    faults = 0
    print(f"{'target':20s} {'inputs':>8s} {'good':>7s} {'seconds':>8s} {'slowest s':>10s}  faults", flush=True)
    with concurrent.futures.ThreadPoolExecutor(max_workers=args.jobs) as pool:
        waiting = [pool.submit(fuzz_target, name, args.runs, args.seconds, args.out, args.seed) for name in names]
        for done in concurrent.futures.as_completed(waiting):
            r = done.result()
            faults += len(r.faults)
            line = f"{r.name:20s} {r.runs:8d} {r.good:7d} {r.seconds:8.0f} {r.slowest_s:10.2f}  {len(r.faults)}"
            print("\n    ".join([line, *(f"{where}: {path}" for where, path in r.faults.items())]), flush=True)
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
