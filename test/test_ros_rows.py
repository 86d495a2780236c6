"""Rows out of streams with stamps of their own; no ROS graph is needed here."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig_tools import one_by_one

from eha_monitor.live.rows import RowAligner, Source

MS = 1_000_000


def make(latency=0.02):
    position, pressure = Source("joints", ("x", "v")), Source("pressure", ("p1",))
    oil = Source("oil", ("temperature",), held=True)
    return RowAligner([position, pressure, oil], latency), position, pressure, oil


def rows(aligner, now):
    return [(stamp // MS, row) for stamp, row in one_by_one(aligner.pop(now))]


def test_equal_stamps_make_a_row_at_once():
    aligner, x, p, _ = make()
    aligner.push(p, 0, (1.0,), 0.0)
    aligner.push(x, 0, (0.1, math.nan), 0.0)
    assert rows(aligner, 0.0) == [(0, {"x": 0.1, "p1": 1.0})]


def test_others_are_interpolated_to_the_position_stamp():
    aligner, x, p, _ = make()
    aligner.push(p, 0, (1.0,), 0.0)
    aligner.push(x, 4 * MS, (0.1, 0.2), 0.004)
    assert rows(aligner, 0.004) == []
    aligner.push(p, 10 * MS, (2.0,), 0.010)
    assert rows(aligner, 0.010) == [(4, {"x": 0.1, "v": 0.2, "p1": pytest.approx(1.4)})]


def test_nothing_is_interpolated_across_a_gap():
    aligner, x, p, _ = make()
    aligner.push(p, 0, (1.0,), 0.0)
    aligner.push(x, 4 * MS, (0.1, 0.2), 0.004)
    aligner.push(p, 500 * MS, (2.0,), 0.5)
    assert rows(aligner, 0.5) == [(4, {"x": 0.1, "v": 0.2})]
    assert aligner.incomplete == 1


def test_a_row_waits_no_longer_than_the_latency():
    aligner, x, p, _ = make()
    aligner.push(p, 0, (1.0,), 0.0)
    aligner.push(x, 1 * MS, (0.1, 0.2), 0.0)
    assert rows(aligner, 0.0199) == []
    assert rows(aligner, 0.0201) == [(1, {"x": 0.1, "v": 0.2})]


def test_a_silent_source_is_not_waited_for():
    aligner, x, _, _ = make()
    aligner.push(x, 0, (0.1, 0.2), 0.0)
    assert rows(aligner, 0.0) == [(0, {"x": 0.1, "v": 0.2})]


def test_temperature_is_held_and_never_waited_for():
    aligner, x, _, oil = make()
    aligner.push(oil, 0, (40.0,), 0.0)
    aligner.push(x, 1 * MS, (0.1, 0.2), 0.001)
    aligner.push(x, 900 * MS, (0.1, 0.2), 0.9)
    aligner.push(x, 59_000 * MS, (0.1, 0.2), 59.0)
    aligner.push(x, 61_000 * MS, (0.1, 0.2), 61.0)
    assert ["temperature" in row for _, row in rows(aligner, 61.0)] == [True] * 3 + [False]


def test_repeated_and_late_stamps_are_dropped_and_counted():
    aligner, x, _, _ = make()
    for stamp in (0, 1, 1, 0, 2):
        aligner.push(x, stamp * MS, (float(stamp), 0.0), 0.0)
    assert [stamp for stamp, _ in rows(aligner, 1.0)] == [0, 1, 2]
    assert (x.late, x.repeated, x.taken, aligner.take_reset()) == (1, 1, 3, None)


@pytest.mark.parametrize("garbled", [-5_000, 10_000_000, -10**9])
def test_one_garbled_stamp_costs_one_sample(garbled):
    aligner, x, _, _ = make()
    for stamp in (0, 1, garbled, 2, 3):
        aligner.push(x, stamp * MS, (0.1, 0.0), 0.0)
    assert [stamp for stamp, _ in rows(aligner, 1.0)] == [0, 1, 2, 3]
    assert (x.jumped, aligner.take_reset()) == (1, None)


def test_a_stuck_stamp_gives_nothing():
    aligner, x, _, _ = make()
    for _ in range(100):
        aligner.push(x, MS, (0.1, 0.0), 0.0)
    assert len(rows(aligner, 1.0)) == 1 and aligner.take_reset() is None


def test_a_loop_starts_anew_with_a_reason():
    aligner, x, p, _ = make()
    for start in (10_000, 0):
        for k in range(10):
            aligner.push(p, (start + k) * MS, (1.0,), 0.0)
            aligner.push(x, (start + k) * MS, (0.1, 0.0), 0.0)
        found = rows(aligner, 0.0)
        reason = aligner.take_reset()
        if start:
            assert (len(found), reason) == (10, None)
    assert found == []  # all rows of the time before had been given out
    found = rows(aligner, 0.0)
    assert "jumped back by" in reason and "10.0" in reason
    assert [stamp for stamp, _ in found] == list(range(2, 10))
    assert all("p1" in row for _, row in found)
    assert aligner.take_reset() is None


def test_samples_of_the_time_before_a_jump_do_no_harm():
    aligner, x, p, _ = make()
    for k in range(5):
        aligner.push(p, (10_000 + k) * MS, (1.0,), 0.0)
        aligner.push(x, (10_000 + k) * MS, (0.1, 0.0), 0.0)
    for k in range(4):
        aligner.push(x, k * MS, (0.1, 0.0), 0.0)
    assert aligner.take_reset()
    aligner.push(p, 10_005 * MS, (1.0,), 0.0)  # still under way
    for k in range(4):
        aligner.push(p, k * MS, (1.0,), 0.0)
    assert aligner.take_reset() is None
    assert all("p1" in row for _, row in rows(aligner, 0.0))


@given(st.integers(0, 2**32), st.integers(1, 60))
def test_the_rows_do_not_depend_on_how_the_streams_interleave(seed, count):
    """Each stream in order, everything within the latency: always the same rows."""
    draw = random.Random(seed)
    aligner, x, p, _ = make(latency=1e9)
    samples = [[(x, k * MS, (float(k), 0.0)) for k in range(count)],
               [(p, k * MS + MS // 2, (k + 0.5,)) for k in range(-1, count)]]
    found = []
    while any(samples):
        source, stamp, values = draw.choice([s for s in samples if s]).pop(0)
        aligner.push(source, stamp, values, 0.0)
        found += rows(aligner, 0.0)
    found += rows(aligner, 1.0)
    assert [stamp for stamp, _ in found] == list(range(count))
    for k, row in found:
        assert "p1" not in row or row["p1"] == pytest.approx(k)
