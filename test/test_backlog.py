# SPDX-License-Identifier: Apache-2.0
"""A node's backlog: order, patience, and what is skipped."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from ros_graph import Graph
from std_msgs.msg import Header

from limbloc_ros.ros import topics
from limbloc_ros.ros.backlog import Backlog
from limbloc_ros.ros.messages import make_header, stamp_ns

FRAME_NS = 100_000_000


@pytest.fixture
def graph() -> Iterator[Graph]:
    graph = Graph()
    yield graph
    graph.close()


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
