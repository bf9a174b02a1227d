# SPDX-License-Identifier: Apache-2.0
"""What free-running cameras cost, worked by hand."""

import math

import numpy as np
import pytest

from limbloc_ros.ros.stamp_skew import StampSkew

MS = 1_000_000
FRAME_NS = 100 * MS


def walked(skew, frames, speed, start_ns=0, apart_ns=12 * MS):
    """Joint 1 moves at `speed`, the others rest; cam1 is always `apart_ns` behind cam0."""
    for n in range(frames):
        stamp = start_ns + n * FRAME_NS
        skew.mask("cam0", stamp)
        skew.mask("cam1", stamp + apart_ns)
        skew.carved(stamp, apart_ns)
        places = np.zeros((3, 3))
        places[1, 0] = speed * n * 0.1
        skew.joints(stamp, places)


def test_speed_times_skew_is_what_it_costs():
    skew = StampSkew()
    assert math.isnan(skew.skew_ms)
    assert math.isnan(skew.costs_mm)
    walked(skew, 20, speed=1.5)
    assert skew.skew_ms == pytest.approx(12)
    assert skew.speed_m_s == pytest.approx(1.5)
    assert skew.costs_mm == pytest.approx(18)
    assert skew.behind_ms() == {"cam0": 0, "cam1": pytest.approx(12)}
    assert "12 ms apart, which at 1.5 m/s smears hands and feet by 18 mm" in skew.in_words()


def test_a_single_leap_of_the_fit_is_no_speed():
    skew = StampSkew()
    walked(skew, 20, speed=0.5)
    skew.joints(20 * FRAME_NS, np.full((3, 3), 2.0))
    assert skew.speed_m_s == pytest.approx(0.5)


def test_a_fast_camera_gives_the_same_speed_as_a_slow_one():
    """At 100 Hz one frame's way is a centimetre, as much as the fit trembles: the way of 80 ms is taken."""
    skew = StampSkew()
    rng = np.random.default_rng(0)
    for n in range(300):
        places = rng.normal(0, 0.002, (3, 3))
        places[1, 0] += 1.0 * n * 0.01
        skew.joints(n * 10 * MS, places)
    assert skew.speed_m_s == pytest.approx(1.0, abs=0.1)


def test_only_the_last_seconds_count_and_a_looped_recording_begins_anew():
    skew = StampSkew()
    walked(skew, 60, speed=2.0)
    walked(skew, 60, speed=0.2, start_ns=60 * FRAME_NS, apart_ns=3 * MS)
    assert skew.skew_ms == pytest.approx(3)
    assert skew.speed_m_s == pytest.approx(0.2)
    walked(skew, 3, speed=1.0, apart_ns=7 * MS)
    assert skew.skew_ms == pytest.approx(7)
    assert skew.speed_m_s == pytest.approx(1.0)


def test_nobody_moves_where_nobody_is():
    skew = StampSkew()
    walked(skew, 20, speed=1.5)
    skew.nobody()
    assert math.isnan(skew.costs_mm)
    assert skew.in_words() == ""
    assert skew.skew_ms == pytest.approx(12)


def test_triggered_cameras_are_not_worth_a_word():
    skew = StampSkew()
    walked(skew, 20, speed=1.5, apart_ns=1 * MS)
    assert skew.costs_mm == pytest.approx(1.5)
    assert skew.in_words() == ""
