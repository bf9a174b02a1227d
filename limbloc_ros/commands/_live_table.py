# SPDX-License-Identifier: Apache-2.0
"""A node that listens to a running graph and prints how it does, beside the truth where there is one."""

from __future__ import annotations

import csv
import io
import time
from pathlib import Path
from types import TracebackType

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException

from limbloc_ros.core.pose import JOINT, LIMB_JOINTS, Array
from limbloc_ros.files import write_text
from limbloc_ros.recordings.results import stamp_text
from limbloc_ros.ros import topics
from limbloc_ros.ros.messages import message_to_joints, stamp_ns, status_values
from limbloc_ros.ros.node_main import make_executor

PERIOD_S = 2.0
COLUMNS = ("time s", "poses/s", "latency ms", "energy", "error mm", "worst mm", "")
LIMBS = [JOINT[name] for name in LIMB_JOINTS]

#: True joints that wait for their pose; more are forgotten.
TRUTHS = 500


class LiveTable:
    """Use it as a context manager, and call `spin` again and again.

    Attributes:
        rows: what arrived: stamp ns, latency ms (NaN without a pose), median and worst error of the limb joints in mm
            (NaN where there is no truth or no pose).
    """

    def __init__(self) -> None:
        self.rows: list[tuple[int, float, float, float]] = []
        self._truth: dict[int, Array] = {}
        self._energy = ""
        self._state = ""
        self._first_s: float | None = None
        self._printed_s = 0.0
        self._printed_rows = 0

    def __enter__(self) -> LiveTable:
        self._context = Context()
        rclpy.init(context=self._context, args=[])
        node = rclpy.create_node("demo_table", context=self._context)
        node.create_subscription(PoseArray, topics.JOINTS, self._on_joints, topics.STREAM_QOS)
        node.create_subscription(PoseArray, topics.TRUE_JOINTS, self._on_truth, topics.STREAM_QOS)
        node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, topics.DIAGNOSTICS_QOS)
        self._executor = make_executor(self._context)
        self._executor.add_node(node)
        self._node = node
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    @property
    def seconds(self) -> float:
        """Time since the first pose, s; 0 before it."""
        return 0.0 if self._first_s is None else time.monotonic() - self._first_s

    def spin(self) -> None:
        """Take what has arrived, and print a row every other second."""
        try:
            self._executor.spin_once(timeout_sec=0.05)
        except ExternalShutdownException:
            raise KeyboardInterrupt from None
        if self._first_s is not None and time.monotonic() - self._printed_s >= PERIOD_S:
            self._print()

    def _on_truth(self, msg: PoseArray) -> None:
        joints = message_to_joints(msg)
        if joints is not None:
            self._truth[stamp_ns(msg.header)] = joints
            while len(self._truth) > TRUTHS:
                del self._truth[next(iter(self._truth))]

    def _on_joints(self, msg: PoseArray) -> None:
        stamp = stamp_ns(msg.header)
        joints = message_to_joints(msg)
        if joints is None:
            self.rows.append((stamp, np.nan, np.nan, np.nan))
            return
        if self._first_s is None:
            self._first_s = self._printed_s = time.monotonic()
            print("".join(f"{name:>11s}" for name in COLUMNS))
        latency_ms = (time.time_ns() - stamp) / 1e6
        truth = self._truth.get(stamp)
        median = worst = float("nan")
        if truth is not None:
            error = 1000.0 * np.linalg.norm(joints[LIMBS] - truth[LIMBS], axis=1)
            median, worst = float(np.median(error)), float(error.max())
        self.rows.append((stamp, latency_ms, median, worst))

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name.endswith(": posture"):
                self._energy = status_values(status).get("xor_energy", "")
                self._state = "" if status.message == "tracking" else status.message

    def _print(self) -> None:
        now = time.monotonic()
        recent = np.array(self.rows[self._printed_rows :], dtype=np.float64).reshape(-1, 4)[:, 1:]
        rate = np.isfinite(recent[:, 0]).sum() / (now - self._printed_s)
        latency, median, worst = (_middle(recent[:, i]) for i in range(3))
        cells = (f"{self.seconds:.0f}", f"{rate:.1f}", latency, self._energy or "-", median, worst)
        print("".join(f"{cell:>11s}" for cell in cells) + f"   {self._state}", flush=True)
        self._printed_s, self._printed_rows = now, len(self.rows)

    def summary(self) -> str:
        """The whole time in a few words."""
        if self._first_s is None:
            return "no pose arrived"
        rows = np.array(self.rows, dtype=np.float64)[:, 1:]
        posed = rows[np.isfinite(rows[:, 0])]
        text = f"{len(posed)} poses in {self.seconds:.0f} s, latency median {_middle(posed[:, 0])} ms"
        if np.isfinite(posed[:, 1]).any():
            text += (
                f", error of {len(LIMBS)} joints: median {_middle(posed[:, 1])} mm"
                f", worst joint of a frame: median {_middle(posed[:, 2])} mm"
            )
        return text

    def save(self, path: Path) -> None:
        """Write every row as CSV; raises OutputError when that fails."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["stamp_s", "latency_ms", "median_error_mm", "worst_error_mm"])
        for stamp, *values in self.rows:
            writer.writerow([stamp_text(stamp), *(f"{value:.3f}" for value in values)])
        write_text(path, text.getvalue())


def _middle(values: Array) -> str:
    known = values[np.isfinite(values)]
    return f"{np.median(known):.0f}" if len(known) else "-"
