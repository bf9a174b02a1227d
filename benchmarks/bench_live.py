# SPDX-License-Identifier: Apache-2.0
"""The live graph: poses a second, latency, lost frames, CPU and memory of every process.

    python benchmarks/bench_live.py [--seconds 30] [--rate 20] [--number 8] [--record FOLDER] [--set KEY=VALUE ...]

Starts the whole graph on simulated cameras over DDS, as `limbloc demo` does, and measures `--seconds` from the first
pose on. Frames are counted by their stamps: those the simulated cameras filmed, and those `joints` came for. Latency is
from a frame's stamp, when real cameras would expose, to the arrival of its joints in another process (this one). CPU is
user and system time of the whole process, DDS threads and all, in percent of one core; memory is the proportional set
size (PSS), which counts shared pages once, and the resident set. The kernels are compiled before.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray

from limbloc_ros.nodes.graph_plan import plan_graph
from limbloc_ros.nodes.smart_space import add_arguments, config_from_arguments
from limbloc_ros.recordings import offline
from limbloc_ros.ros import topics
from limbloc_ros.ros.environment import graph_environment
from limbloc_ros.ros.messages import stamp_ns, status_values
from limbloc_ros.ros.node_main import make_executor
from limbloc_ros.ros.supervisor import Supervisor

TICKS = os.sysconf("SC_CLK_TCK")

#: Without a pose after this long something is wrong, s.
START_S = 120.0

#: What the diagnostics say about each stage, printed at the end: (end of the status' name, keys).
SHOWN = (
    (": images", ("rate_hz", "render_ms", "frames", "frames_skipped")),
    (": mask", ("rate_hz", "latency_ms", "segment_ms", "images_segmented", "images_skipped")),
    (": hull", ("rate_hz", "latency_ms", "carve_ms", "sets_complete", "sets_incomplete", "sets_dropped",
                "sets_skipped")),
    (": posture", ("rate_hz", "latency_ms", "surface_ms", "fit_ms", "hulls", "hulls_skipped")),
)  # fmt: skip


class Watcher:
    """Hears the true joints of each frame, the fitted ones, and the diagnostics."""

    def __init__(self) -> None:
        self.filmed: set[int] = set()
        self.answered: dict[int, tuple[float, bool]] = {}  # stamp -> latency ms, whether it is a pose
        self.statuses: dict[str, DiagnosticStatus] = {}
        self.first_answer_s: float | None = None
        self.first_pose_s: float | None = None
        self.node = rclpy.create_node("bench_live")
        self.node.create_subscription(PoseArray, topics.TRUE_JOINTS, self._on_truth, topics.STREAM_QOS)
        self.node.create_subscription(PoseArray, topics.JOINTS, self._on_joints, topics.STREAM_QOS)
        self.node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, topics.DIAGNOSTICS_QOS)
        self._executor = make_executor()
        self._executor.add_node(self.node)

    def spin(self) -> None:
        """Take what has arrived."""
        self._executor.spin_once(timeout_sec=0.05)

    def _on_truth(self, msg: PoseArray) -> None:
        self.filmed.add(stamp_ns(msg.header))

    def _on_joints(self, msg: PoseArray) -> None:
        now = time.monotonic()
        stamp = stamp_ns(msg.header)
        self.answered[stamp] = (time.time_ns() - stamp) / 1e6, bool(msg.poses)
        self.first_answer_s = self.first_answer_s or now
        if msg.poses:
            self.first_pose_s = self.first_pose_s or now

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            self.statuses[status.name] = status


def pids(graph: Supervisor) -> dict[str, int]:
    """Process ids by name, with the process that forks the others."""
    return graph.pids | ({} if graph.server_pid is None else {"(forks them)": graph.server_pid})


def cpu_s(pid: int) -> float:
    """User and system time of a process with all its threads, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def machine_cpu_s() -> float:
    """What all processes of the machine have used since it started, s."""
    fields = [int(field) for field in Path("/proc/stat").read_text().split("\n")[0].split()[1:]]
    return (sum(fields[:8]) - fields[3] - fields[4]) / TICKS  # all but idle and waiting for a disk


def memory_mb(pid: int) -> tuple[float, float]:
    """Proportional and resident set size, MB."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    kb = {line.split()[0]: int(line.split()[1]) for line in lines if line.split()[0] in ("Pss:", "Rss:")}
    return kb["Pss:"] / 1024, kb["Rss:"] / 1024


def main() -> int:
    """Run, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser)
    parser.add_argument("--seconds", type=float, default=30.0, help="from the first pose on")
    parser.add_argument("--rate", type=float, default=20.0, help="images a second of each camera")
    parser.add_argument("--number", type=int, default=8, help="simulated cameras")
    args = parser.parse_args()
    args.source = args.source or "simulated"
    args.set = [
        f"simulated_cameras.rate_hz={args.rate}",
        f"simulated_cameras.number_of_cameras={args.number}",
        "record.images=none",
        f"network.domain_id={os.environ.get('ROS_DOMAIN_ID') or 1 + os.getpid() % 100}",
        *args.set,
    ]
    config = config_from_arguments(args)
    offline.prepare(print)
    with tempfile.TemporaryDirectory() as folder:
        plans = plan_graph(config, Path(folder))
        environment = graph_environment(config.network)
        os.environ.update(environment)
        rclpy.init()
        watcher = Watcher()
        lines: list[str] = []
        started = time.monotonic()
        with Supervisor(plans, environment, config.processes, lines.append) as graph:
            while watcher.first_pose_s is None:
                if not graph.poll() or time.monotonic() - started > START_S:
                    print("\n".join(lines), file=sys.stderr)
                    return 1
                watcher.spin()
            begin_s, begin_ns, begin_cpu = time.monotonic(), time.time_ns(), {p: cpu_s(p) for p in pids(graph).values()}
            begin_all, begin_me = machine_cpu_s(), time.process_time()
            while time.monotonic() - begin_s < args.seconds:
                graph.poll()
                watcher.spin()
            seconds, end_ns = time.monotonic() - begin_s, time.time_ns()
            others = machine_cpu_s() - begin_all - (time.process_time() - begin_me)
            used = {name: (cpu_s(p) - begin_cpu.get(p, 0.0), *memory_mb(p)) for name, p in pids(graph).items()}
            settled = time.monotonic() + 2.0
            while time.monotonic() < settled:
                watcher.spin()
        report(watcher, used, seconds, begin_ns, end_ns, args)
        others -= sum(cpu for cpu, _, _ in used.values())
        print(f"the rest of the machine meanwhile: {100 * others / seconds:.0f} % of a core, of {os.cpu_count()} cores")
        print(
            f"start, warm: {watcher.first_answer_s - started:.1f} s to the first frame's answer, "  # type: ignore[operator]
            f"{watcher.first_pose_s - started:.1f} s to the first pose (the room is empty for 2 s of it)"
        )
        if graph.restarts and any(graph.restarts.values()):
            print("restarts:", graph.restarts)
        rclpy.try_shutdown()
    return 0


def report(
    watcher: Watcher,
    used: dict[str, tuple[float, float, float]],
    seconds: float,
    begin_ns: int,
    end_ns: int,
    args: argparse.Namespace,
) -> None:
    """Print the tables."""
    filmed = sorted(s for s in watcher.filmed if begin_ns <= s < end_ns)
    due = round((filmed[-1] - filmed[0]) / 1e9 * args.rate) + 1
    answers = [watcher.answered[s] for s in filmed if s in watcher.answered]
    latency = np.array([ms for ms, posed in answers if posed])
    print(f"\n{args.number} cameras at {args.rate:g} Hz, {seconds:.0f} s")
    print(
        f"frames: {due} due, {len(filmed)} filmed, {len(answers)} answered ({len(filmed) - len(answers)} lost), "
        f"{len(latency)} poses = {len(latency) / seconds:.1f} a second"
    )
    low, middle, high, most = np.percentile(latency, (5, 50, 95, 100))
    print(f"latency ms: 5 % {low:.0f}, median {middle:.0f}, 95 % {high:.0f}, largest {most:.0f}")
    print(f"\n| {'process':18s} | % of a core | ms a frame | PSS MB | RSS MB |\n|---|---|---|---|---|")
    total = np.zeros(3)
    for name, values in [*used.items(), ("all", None)]:
        cpu, pss, rss = total if values is None else values
        total += 0 if values is None else np.array(values)
        print(
            f"| {name:18s} | {100 * cpu / seconds:11.0f} | {1e3 * cpu / len(filmed):10.1f} | {pss:6.0f} | {rss:6.0f} |"
        )
    print()
    for suffix, keys in SHOWN:
        for name in sorted(n for n in watcher.statuses if n.endswith(suffix)):
            values = status_values(watcher.statuses[name])
            print(f"{name}: " + ", ".join(f"{key} {values[key]}" for key in keys if key in values))


if __name__ == "__main__":
    raise SystemExit(main())
