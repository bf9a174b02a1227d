# SPDX-License-Identifier: Apache-2.0
"""A node's backlog: order, patience, and what is skipped."""

from __future__ import annotations

import time

import numpy as np
import pytest
from ros_graph import Graph
from std_msgs.msg import Header

from limbloc_ros.ros import topics
from limbloc_ros.ros.backlog import Backlog, Thinning
from limbloc_ros.ros.messages import make_header, stamp_ns

FRAME_NS = 100_000_000


def test_items_are_worked_off_in_order_and_not_inside_of_add(graph: Graph) -> None:
    done: list[int] = []
    backlog: Backlog[int] = Backlog(graph.tester, done.append, 1.0)
    for n in range(5):
        backlog.add(n * FRAME_NS, n)
    assert (done, len(backlog)) == ([], 5)
    graph.until(lambda: len(done) == 5)
    assert (done, len(backlog), backlog.skipped) == ([0, 1, 2, 3, 4], 0, 0)


def test_messages_that_come_during_slow_work_are_taken_before_the_next_work(graph: Graph) -> None:
    """So that the node sees how far it is behind: a second of work meets the newest message, not the oldest."""
    done: list[int] = []

    def work(n: int) -> None:
        done.append(n)
        if n == 0:
            for k in range(1, 10):
                publisher.publish(make_header(k * FRAME_NS, ""))
            time.sleep(0.3)  # DDS delivers meanwhile

    backlog: Backlog[int] = Backlog(graph.tester, work, 4 * FRAME_NS / 1e9)
    graph.tester.create_subscription(
        Header, "slow", lambda msg: backlog.add(stamp_ns(msg), stamp_ns(msg) // FRAME_NS), topics.WORK_QOS
    )
    publisher = graph.publisher(Header, "slow", topics.WORK_QOS)
    publisher.publish(make_header(0, ""))
    graph.until(lambda: bool(done) and done[-1] == 9)
    assert backlog.skipped == 10 - len(done)
    assert backlog.skipped >= 5


def test_who_is_too_far_behind_skips_all_but_the_newest_and_says_up_to_where(graph: Graph) -> None:
    done: list[int] = []
    told: list[int] = []
    backlog: Backlog[int] = Backlog(graph.tester, done.append, 3 * FRAME_NS / 1e9, told.append)
    for n in range(5):
        backlog.add(n * FRAME_NS, n)
    assert told == [3 * FRAME_NS]
    graph.until(lambda: bool(done))
    assert (done, backlog.skipped) == ([4], 4)


def test_who_has_skipped_waits_less_for_some_seconds_and_skips_every_second(graph: Graph) -> None:
    done: list[int] = []
    backlog: Backlog[int] = Backlog(graph.tester, done.append, 5 * FRAME_NS / 1e9, again_s=3 * FRAME_NS / 1e9)
    for n in range(7):
        backlog.add(n * FRAME_NS, n)
    assert (len(backlog), backlog.skipped) == (1, 6)
    for n in range(7, 11):
        backlog.add(n * FRAME_NS, n)
    assert backlog.skipped == 8
    graph.until(lambda: len(backlog) == 0)
    assert done == [6, 8, 10]
    later = 130  # frames: more than ten seconds
    for n in range(later, later + 5):
        backlog.add(n * FRAME_NS, n)
    assert (len(backlog), backlog.skipped) == (5, 8)


def test_what_others_skipped_is_skipped_also_when_it_comes_later(graph: Graph) -> None:
    done: list[int] = []
    backlog: Backlog[int] = Backlog(graph.tester, done.append, 10.0)
    backlog.add(0, 0)
    backlog.add(2 * FRAME_NS, 2)
    backlog.skip_until(FRAME_NS)
    backlog.add(FRAME_NS, 1)  # late
    backlog.add(3 * FRAME_NS, 3)
    graph.until(lambda: len(done) == 2)
    assert (done, backlog.skipped) == ([2, 3], 2)


def test_a_jump_back_in_time_is_not_mistaken_for_something_to_skip(graph: Graph) -> None:
    done: list[int] = []
    backlog: Backlog[int] = Backlog(graph.tester, done.append, 10.0)
    backlog.add(100 * FRAME_NS, 100)
    backlog.skip_until(100 * FRAME_NS)
    backlog.add(0, 0)
    backlog.add(FRAME_NS, 1)
    graph.until(lambda: len(done) == 2)
    assert done == [0, 1]


def instants(thinning: Thinning, first_s: float, last_s: float, rate_hz: float, late_s: float = 0.0) -> list[int]:
    """Which of a camera's frames it takes, by number; its stamps are a little off."""
    numbers = range(round(first_s * rate_hz), round(last_s * rate_hz))
    return [n for n in numbers if thinning.takes(round((n / rate_hz + late_s) * 1e9))]


def test_cameras_that_hear_the_same_take_the_same_instants() -> None:
    cameras = [Thinning() for _ in range(3)]
    assert instants(cameras[0], 0.0, 1.0, 60.0) == list(range(60))
    for second in range(4):
        for thinning in cameras:
            for n in range(16):  # every camera announces it, again and again; that makes one step a second
                thinning.announced(round((10 + 1.01 * second + n / 20) * 1e9))
    assert {t.rate_hz for t in cameras} == {4.0}
    taken = [instants(t, 14.0, 24.0, 60.0, late_s) for t, late_s in zip(cameras, (0.004, 0.005, 0.006), strict=True)]
    assert taken[0] == taken[1] == taken[2]
    assert len(taken[0]) == 40
    assert np.diff(taken[0]).min() >= 14


def test_a_camera_that_loses_an_image_takes_no_other_in_its_place() -> None:
    whole, lossy = Thinning(), Thinning()
    for thinning in (whole, lossy):
        for second in range(3):
            thinning.announced(round((10 + 1.01 * second) * 1e9))
    assert whole.rate_hz == 8.0
    taken = instants(whole, 14.0, 24.0, 60.0)
    lost = set(taken[5::3])
    kept = [n for n in range(840, 1440) if n not in lost and lossy.takes(round(n / 60.0 * 1e9))]
    assert kept == [n for n in taken if n not in lost]


def test_thinning_ends_when_nobody_is_behind_any_more() -> None:
    thinning = Thinning()
    thinning.announced(0)
    thinning.announced(round(2e9))
    assert thinning.rate_hz == 16.0
    assert len(instants(thinning, 2.0, 20.0, 30.0)) == pytest.approx(18 * 16, abs=2)
    instants(thinning, 20.0, 23.0, 30.0)
    assert thinning.rate_hz == 32.0
    instants(thinning, 23.0, 44.0, 30.0)
    assert instants(thinning, 44.0, 45.0, 60.0) == list(range(2640, 2700))
    # A jump back in time also ends it, a step at a time.
    thinning.announced(round(50e9))
    assert instants(thinning, 0.0, 1.0, 60.0)[:2] == [0, 1]
