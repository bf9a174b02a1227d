# SPDX-License-Identifier: Apache-2.0
"""Sets by stamp: worked examples, order independence, lost, late and doubled frames, jumps in time."""

import numpy as np
import pytest

from limbloc_ros.core.config import SyncConfig
from limbloc_ros.core.errors import ConfigError, InputError
from limbloc_ros.core.synchroniser import FrameSet, StampSynchroniser

MS = 1_000_000
PERIOD = 33 * MS
NAMES = ("a", "b", "c")


def make(**kwargs):
    return StampSynchroniser(kwargs.pop("names", NAMES), **kwargs)


def frames(count, names=NAMES, skew_ms=2, start=1_000 * PERIOD):
    """(name, stamp, item) of `count` instants; camera i is i * skew_ms behind."""
    return [
        (name, start + k * PERIOD + i * skew_ms * MS, (name, k)) for k in range(count) for i, name in enumerate(names)
    ]


def run(sync, stream):
    sets = []
    for name, stamp, item in stream:
        sets += sync.add(name, stamp, item)
    return sets + sync.flush()


def contents(sets):
    return [(s.stamp_ns, s.items, s.missing) for s in sets]


def test_complete_sets_leave_at_once_with_the_earliest_stamp_and_the_skew():
    sync = make()
    assert sync.add("b", 102 * MS, "B") == []
    assert sync.add("a", 100 * MS, "A") == []
    assert sync.waiting == 1
    (done,) = sync.add("c", 105 * MS, "C")
    assert done == FrameSet(100 * MS, {"a": "A", "b": "B", "c": "C"}, (), 5 * MS)
    assert list(done.items) == list(NAMES)
    assert sync.waiting == 0
    assert sync.counters.complete == 1


def test_the_slop_bounds_the_whole_set_not_just_neighbours():
    sync = make(slop_s=0.020)
    sets = run(sync, [("a", 0, 0), ("b", 15 * MS, 0), ("c", 30 * MS, 0)])
    # c is 15 ms from b but 30 ms from a: two sets; the second has one camera only and is dropped
    assert contents(sets) == [(0, {"a": 0, "b": 0}, ("c",))]
    assert sync.counters.dropped == 1


@pytest.mark.parametrize("seed", range(20))
def test_the_order_between_cameras_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    stream = frames(12)
    lost = {int(i) for i in rng.choice(len(stream), 5, replace=False)}
    stream = [frame for i, frame in enumerate(stream) if i not in lost]
    expected = run(make(), stream)
    # Each camera keeps its own order; between them up to two periods of delay.
    delay = {name: int(rng.integers(0, 2 * PERIOD)) for name in NAMES}
    shuffled = sorted(stream, key=lambda frame: frame[1] + delay[frame[0]])
    sync = make()
    assert contents(run(sync, shuffled)) == contents(expected)
    assert sum(sync.counters.late.values()) == 0
    assert sum(sync.counters.received.values()) == len(stream)


def test_a_lost_frame_is_noticed_when_its_camera_sends_the_next_one():
    sync = make()
    stream = [f for f in frames(2) if f[2] != ("b", 0)]
    sets = []
    for k, (name, stamp, item) in enumerate(stream):
        sets += sync.add(name, stamp, item)
        assert len(sets) == (0 if k < 3 else 1 if k < 4 else 2)  # b's second frame lets the first set go
    assert [s.missing for s in sets] == [("b",), ()]
    assert sync.counters.missing == {"a": 0, "b": 1, "c": 0}
    assert (sync.counters.complete, sync.counters.incomplete) == (1, 1)


def test_a_timeout_lets_an_incomplete_set_go_and_what_comes_later_is_late():
    sync = make(timeout_s=0.1)
    sync.add("a", 100 * MS, "A", now_ns=0)
    sync.add("b", 101 * MS, "B", now_ns=50 * MS)
    assert sync.tick(99 * MS) == []
    (done,) = sync.tick(100 * MS)
    assert done.missing == ("c",)
    assert sync.add("c", 102 * MS, "C") == []
    assert sync.counters.late["c"] == 1
    assert sync.waiting == 0


def test_without_a_clock_the_timeout_counts_from_the_first_tick():
    sync = make(timeout_s=0.1)
    sync.add("a", 0, "A")
    sync.add("b", 0, "B")
    assert sync.tick(10_000 * MS) == []
    assert sync.tick(10_099 * MS) == []
    assert len(sync.tick(10_100 * MS)) == 1


def test_sets_below_min_cameras_are_dropped_and_counted():
    sync = make(min_cameras=3)
    stream = [f for f in frames(3) if f[2] != ("b", 1)]
    assert [s.stamp_ns for s in run(sync, stream)] == [1_000 * PERIOD, 1_002 * PERIOD]
    assert sync.counters.dropped == 1


def test_no_more_than_queue_sets_wait():
    sync = make(queue=4, silent_sets=0)
    sets = []
    for name, stamp, item in [f for f in frames(10) if f[0] != "c"]:
        sets += sync.add(name, stamp, item)
        assert sync.waiting <= 4
    assert len(sets) == 6
    assert len(sets + sync.flush()) == 10


def test_a_dead_camera_stops_delaying_the_others_and_comes_back():
    sync = make(silent_sets=3, timeout_s=0.1)
    now, at_once = 0, []
    for k in range(8):
        now += 33 * MS
        before = len(sync.add("a", k * PERIOD, k, now) + sync.add("b", k * PERIOD, k, now))
        at_once.append(before)
        sync.tick(now + 200 * MS)
        now += 200 * MS
    assert at_once == [0, 0, 0, 1, 1, 1, 1, 1]
    assert sync.silent == ("c",)
    # c's first frame only wakes it up, whoever comes first
    done = run(sync, frames(3, start=8 * PERIOD, skew_ms=0))
    assert [s.missing for s in done] == [("c",), (), ()]
    assert sync.counters.late["c"] == 1


@pytest.mark.parametrize("first", ["c", "a"])
@pytest.mark.parametrize("ticking", [True, False])
def test_a_camera_back_from_silence_gives_the_same_sets_live_and_offline(first, ticking):
    """With or without timeouts, and whichever camera's frame comes first."""
    sync = make(silent_sets=3, timeout_s=0.01)
    sets, order = [], (["c", "a", "b"] if first == "c" else ["a", "b", "c"])
    for k in range(12):
        for name in order:
            if name == "c" and 2 <= k < 7:
                continue
            sets += sync.add(name, k * PERIOD, (name, k), k * PERIOD)
        if ticking:
            sets += sync.tick(k * PERIOD + 20 * MS)
    sets += sync.flush()
    assert [k for k, s in enumerate(sets) if s.missing] == [2, 3, 4, 5, 6, 7]
    assert len(sets) == 12


def test_a_duplicate_is_counted_and_not_used():
    sync = make()
    sync.add("a", 100, "first")
    sync.add("a", 100, "second")
    sets = sync.add("b", 100, "B") + sync.add("c", 100, "C")
    assert sets[0].items["a"] == "first"
    assert sync.counters.duplicate == {"a": 1, "b": 0, "c": 0}


def test_a_loop_starts_anew_without_mixing_the_ends():
    sync = make()
    once = frames(60)  # 2 s
    sets = []
    # In the second round a is ahead: its first frames come before the others' last ones.
    head, tail = [f for f in once if f[0] == "a"][:3], [f for f in once if f[0] != "a"][-4:]
    rest = [f for f in once if f not in head]
    stream = [f for f in once if f not in tail] + head + tail + rest
    for name, stamp, item in stream:
        sets += sync.add(name, stamp, item)
    sets += sync.flush()
    assert sync.counters.resets == 1
    for s in sets:
        assert len({k for _, k in s.items.values()}) == 1
    complete = [s.stamp_ns for s in sets if not s.missing]
    all_stamps = [1_000 * PERIOD + k * PERIOD for k in range(60)]
    assert complete == all_stamps[:58] + all_stamps
    assert sum(sync.counters.late.values()) == len(tail)


def test_one_camera_whose_clock_jumps_back_does_not_stop_the_others():
    sync = make(queue=3)
    sets = run(sync, frames(30))
    shifted = [(n, t - (10_000 * MS if n == "a" else 0), i) for n, t, i in frames(60, start=1_030 * PERIOD)]
    after = []
    for name, stamp, item in shifted:
        after += sync.add(name, stamp, item)
        if name == "c":
            after += sync.tick(stamp) + sync.tick(stamp + 1_000 * MS)
    assert len(sets) == 30
    assert sync.counters.resets == 1
    assert [s.items.keys() for s in after[-20:]] == [{"b", "c"}] * 20


def test_reset_forgets_what_waits():
    sync = make()
    sync.add("a", 100 * PERIOD, 1)
    sync.reset()
    assert sync.waiting == 0
    assert len(run(sync, frames(2, start=0))) == 2


def test_from_config_takes_the_shared_parameters():
    sync = StampSynchroniser.from_config(NAMES, SyncConfig(slop_s=0.005, queue=2), 3)
    assert (sync.slop_s, sync.queue, sync.min_cameras) == (0.005, 2, 3)


def test_bad_arguments_are_named():
    with pytest.raises(ConfigError, match="unique camera names"):
        make(names=("a", "a"))
    with pytest.raises(ConfigError, match="queue"):
        make(queue=0)
    with pytest.raises(ConfigError, match="slop_s"):
        make(slop_s=float("nan"))
    with pytest.raises(InputError, match=r"'d'.*a, b, c"):
        make().add("d", 0, None)


def test_frames_that_some_cameras_skipped_are_skipped_for_all():
    sync = make()
    stream = frames(3)
    assert run_without_flush(sync, stream[:1]) == []  # a sent instant 0, b and c skip it
    first, second = 1_000 * PERIOD, 1_001 * PERIOD
    sync.skip_until(first + 4 * MS)
    assert (sync.waiting, sync.counters.skipped) == (0, 1)
    sets = run_without_flush(sync, stream[1:])  # what still comes of instant 0 opens no set
    assert [(s.stamp_ns, s.missing) for s in sets] == [(second, ()), (second + PERIOD, ())]
    assert sync.counters.late == {"a": 0, "b": 1, "c": 1}
    sync.skip_until(first)  # told by another camera, late: nothing to do
    assert sync.counters.skipped == 1


def run_without_flush(sync, stream):
    return [done for name, stamp, item in stream for done in sync.add(name, stamp, item)]
