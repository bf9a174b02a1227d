# SPDX-License-Identifier: Apache-2.0
"""One target under atheris (libFuzzer), in a process of its own: `python -m fuzz.child TARGET libFuzzer's options`.

Coverage of our own Python code leads the way. Memory is limited beyond what the process holds after its start, so that
a header that claims 10^9 points ends in a fault, not in a slow machine.
"""

from __future__ import annotations

import random
import resource
import sys
import time
from pathlib import Path

import atheris

#: Compiled by numba, which cannot read instrumented byte code.
KERNELS = [
    f"limbloc_ros.{p.parent.name}.{p.stem}"
    for p in (Path(__file__).parent.parent / "limbloc_ros").glob("*/_*_kernels.py")
]

with atheris.instrument_imports(include=["limbloc_ros"], exclude=[*KERNELS, "limbloc_ros.simulation._quaternions"]):
    import fuzz.message_targets
    import fuzz.recording_targets  # noqa: F401  (they enter their targets)
    from fuzz.targets import TARGETS, check
    from limbloc_ros import cli  # noqa: F401
    from limbloc_ros.commands import report  # noqa: F401
    from limbloc_ros.export import bvh, gltf, tables, trc  # noqa: F401
    from limbloc_ros.nodes import composed, graph_plan  # noqa: F401
    from limbloc_ros.recordings import background_file, bag_calibration, bag_frames, cases, kept_frames  # noqa: F401
    from limbloc_ros.report import compare, summary  # noqa: F401
    from limbloc_ros.rig import importing, rig_file  # noqa: F401
    from limbloc_ros.rig.formats import recognise  # noqa: F401
    from limbloc_ros.ros import cloud_messages, image_messages, messages, parameters, raw_messages  # noqa: F401

#: Address space that one input may take beyond what the process has before it, bytes.
MEMORY = 1 << 30


class Slowest:
    """How long the slowest input took, and how many were taken as good; printed when the process ends."""

    def __init__(self, name: str) -> None:
        self.name, self.seconds, self.good, self.count = name, 0.0, 0, 0

    def __call__(self, data: bytes) -> None:
        start = time.process_time()
        self.count += 1
        self.good += not check(self.name, data)
        self.seconds = max(self.seconds, time.process_time() - start)
        if self.count % 50 == 0:
            self.tell()

    def tell(self) -> None:
        """A line that the driver reads."""
        print(f"FUZZED {self.count} good {self.good} slowest {self.seconds:.2f}", flush=True)


def main() -> None:
    """Fuzz until the runs or the time are over, or a fault is found."""
    name = sys.argv[1]
    target, slowest = TARGETS[name], Slowest(name)
    for seed in target.seeds():  # what is loaded once must not count as an input's memory
        check(name, seed)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))

    def mutated(data: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if target.mutate is None or rng.random() < 0.25:
            return bytes(atheris.Mutate(data, most))
        return target.mutate(bytes(data), most, rng)[:most]

    atheris.Setup([sys.argv[0], *sys.argv[2:]], slowest, custom_mutator=mutated)
    try:
        atheris.Fuzz()
    finally:
        slowest.tell()


if __name__ == "__main__":
    main()
