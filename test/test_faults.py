# SPDX-License-Identifier: Apache-2.0
"""Faults injected into the real graph, and a soak: the code of benchmarks/bench_faults.py and soak.py, in brief."""

import dataclasses
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from bench_faults import run
from faults.live import Live
from faults.processes import footprint, left_behind
from faults.scenarios import SCENARIOS
from soak import soak


def test_nothing_leaks_while_people_come_and_go():
    samples, verdict = soak(Live(), seconds=4.0, every_s=1.0, warm_up_s=2.0)
    assert all(s.held.threads > 4 and s.held.segments for s in samples)
    (mb, threads, files, _), (mb_later, threads_later, files_later, _) = verdict.before, verdict.after
    assert mb_later < 1.2 * mb
    assert (threads_later, files_later) == (threads, files)
    assert (verdict.restarts, verdict.leaked) == (0, [])


@pytest.fixture(scope="module")
def live():
    with Live() as live:
        assert live.start(), "\n".join(live.lines[-20:])
        yield live


@pytest.mark.parametrize(
    ("name", "seconds", "restarts", "words"),
    [("lights_on", 3.0, 0, "the light was switched"), ("kill_cameras", 1.0, 1, "")],
)
def test_the_graph_says_what_is_wrong_and_is_right_again(live, name, seconds, restarts, words):
    fault = next(s for s in SCENARIOS if s.name == name)
    first = len(live.said)
    outcome = run(live, dataclasses.replace(fault, lasts_s=seconds, patience_s=60.0))
    assert outcome.right_s is not None
    assert outcome.wrong <= 3  # of about five a second
    assert outcome.restarts == restarts
    assert any(words in said.message for said in live.said[first:] if said.level)


def test_shared_memory_in_use_is_not_left_behind(live):
    held = footprint(live.graph.pids).segments
    assert any(name.startswith("fast") for name in held)
    assert left_behind(held) == []
