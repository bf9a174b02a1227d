# SPDX-License-Identifier: Apache-2.0
"""Rates, latencies and faults as `/diagnostics` tells them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from ros_graph import Graph

from limbloc_ros.core.errors import InputError
from limbloc_ros.ros import health
from limbloc_ros.ros.messages import ERROR, OK, make_status


def test_meter_counts_the_last_seconds_only() -> None:
    now = 100.0
    meter = health.Meter(lambda: now)
    assert meter.rate_hz == 0.0
    assert math.isnan(meter.latency_ms)
    for k in range(21):
        now = 100.0 + k / 10
        meter.tick(0.01 if k % 3 else 0.5)  # a median is not moved by some slow ones
    assert meter.rate_hz == pytest.approx(10.0)
    assert meter.latency_ms == pytest.approx(10.0)
    assert meter.silence_s == 0.0
    now = 103.0
    assert meter.silence_s == pytest.approx(1.0)
    now = 110.0
    assert meter.rate_hz == 0.0


def test_faults_are_told_counted_and_forgotten(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    status: list[DiagnosticStatus] = []

    def describe() -> list[DiagnosticStatus]:
        status.append(make_status("tester: x", OK, "fine", {"n": 1}))
        return [status[-1]]

    reporter = health.Health(graph.tester, describe)
    diagnostics = graph.diagnostics()
    graph.until(diagnostics.says("tester: x", "fine"))
    for k in range(3):
        with reporter.guard("camera a"):
            raise InputError(f"bad {k}")
    graph.until(diagnostics.says("tester: x", "camera a: bad 2"))
    assert diagnostics["tester: x"].level == ERROR
    assert diagnostics.value("tester: x", "errors of camera a") == "3"
    monkeypatch.setattr(health, "WINDOW_S", 0.0)
    graph.until(diagnostics.says("tester: x", "fine"))
    assert diagnostics["tester: x"].level == OK
    assert diagnostics.value("tester: x", "errors of camera a") == "3"


def test_the_same_fault_is_logged_once_in_a_while(graph: Graph, capfd: pytest.CaptureFixture[str]) -> None:
    reporter = health.Health(graph.tester, list)
    for _ in range(100):
        reporter.fault("camera a", "bad")
    reporter.fault("camera a", "worse")
    logged = capfd.readouterr().err
    assert logged.count("camera a: bad") == 1
    assert logged.count("camera a: worse") == 1


def test_bugs_are_not_swallowed(graph: Graph) -> None:
    reporter = health.Health(graph.tester, list)
    with pytest.raises(ZeroDivisionError), reporter.guard("x"):
        raise ZeroDivisionError


def resident_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return int(next(line.split()[1] for line in status.splitlines() if line.startswith("RssAnon"))) / 1024


def test_what_a_harder_frame_needed_is_given_back_to_the_system(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    told = health.Health(graph.tester, lambda: [make_status("a", OK, "fine", {})])
    blocks = [np.ones(12_500) for _ in range(1000)]  # of 100 KB: from the heap, not mappings of their own
    kept = blocks[::50]
    blocks.clear()
    before = resident_mb()
    monkeypatch.setattr(health, "GIVE_BACK_S", 1e6)
    told.publish()
    assert resident_mb() > before - 10
    monkeypatch.setattr(health, "GIVE_BACK_S", 0.0)
    told.publish()
    assert resident_mb() < before - 70
    assert len(kept) == 20
