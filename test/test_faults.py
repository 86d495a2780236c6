"""Faults of the data: each has its sentence, and none leaves a trace in the estimates."""

import math
import random
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_tools import BETA, SINE, one_by_one, simulated
from test_live_estimator import Stream, rows_of

from eha_monitor.live.faults import HELD_S, REACH_S, FaultWatch, Leaps
from eha_monitor.live.rows import RowAligner, Source

MS = 1_000_000
LOOK = 200  # samples
DRAIN = 8  # samples: the monitor's drain takes some at a time as well


class Rig:
    """Position, demand and a pressure, sample by sample; a look every 0.2 s."""

    def __init__(self, sample_time=1e-3):
        self.x, self.p = Source("joints (piston)", ("x", "v")), Source("gauge", ("p1",))
        self.x_d = Source("command", ("x_d",))
        self.aligner = RowAligner([self.x, self.p, self.x_d], 0.02)
        self.watch = FaultWatch(self.aligner.sources, sample_time, 0.02)
        self.rows, self.frozen, self.told = [], {}, set()
        self.k, self.now = 0, 0.0

    def values(self, k):
        t = k * 1e-3
        x = 0.01 * math.sin(9.0 * t)
        return {"x": (x, math.nan), "p1": (2e6 + 1e5 * math.cos(9.0 * t),), "x_d": (1.1 * x,)}

    def take(self):
        rows = self.watch.take(self.aligner.pop(self.now))
        self.rows += one_by_one(rows)

    def send(self, count, spoil=lambda k, name, values: [(0, values)], rate=1.0):
        """Send samples; ``spoil`` returns for each (stamp's offset in ms, values) to be sent."""
        for _ in range(count):
            sample = self.values(self.k)
            for name, source in (("x", self.x), ("p1", self.p), ("x_d", self.x_d)):
                for offset, values in spoil(self.k, name, sample[name]):
                    if values is None:
                        self.aligner.unread(source, empty=True)
                    else:
                        stamp = round(self.k * MS / rate) + round(offset * MS)
                        self.aligner.push(source, stamp, values, self.now)
            self.k += 1
            self.now += 1e-3
            if self.k % DRAIN == 0:
                self.take()
            if self.aligner.reset_reason:
                self.watch.restart(self.aligner.take_reset(), self.now)
                self.take()
            if self.k % LOOK == 0:
                self.frozen |= self.watch.look(self.now)
                self.told |= set(self.watch.sentences(self.now))
        return " | ".join(self.watch.sentences(self.now))


def some(share, seed=0):
    draw = random.Random(seed)
    return lambda: draw.random() < share


def drop():
    chance = some(0.1)
    return lambda k, name, values: [] if chance() else [(0, values)]


def double():
    chance = some(0.1)
    return lambda k, name, values: [(0, values)] * (1 + chance())


def shuffle():
    chance = some(0.1)
    return lambda k, name, values: [(-2.5 if chance() else 0, values)]


def frozen(channel, since):
    rig = Rig()
    held = rig.values(since)[channel]
    return lambda k, name, values: [(0, held if name == channel else values)]


CASES = {
    "dropped": (drop, "gauge: messages are dropped, "),
    "repeated": (double, "stamps repeat"),
    "out of order": (shuffle, "came out of order"),
    "nan": (lambda: lambda k, name, values: [
        (0, None if name == "p1" and k % 500 < 60 else values)], "p1: NaN in "),
    "nan in part": (lambda: lambda k, name, values: [
        (0, (math.nan, math.nan) if name == "x" and k % 500 < 60 else values)], "x: NaN in "),
    "jump back": (lambda: lambda k, name, values: [(-2500, values)], "the clock jumped back"),
    "jump ahead": (lambda: lambda k, name, values: [(5000, values)],
                   "stamps jump ahead by 5.00 s"),
    "frozen p1": (lambda: frozen("p1", 3000),
                  "p1 has not changed for"),
    "frozen x": (lambda: frozen("x", 3000), "x has not changed for"),
    "frozen demand": (lambda: frozen("x_d", 3000), "x_d has not changed for"),
    "ten times the rate": (lambda: lambda k, name, values: [(j / 10, values) for j in range(10)],
                           "10 times as fast as configured, every 0.1 ms"),
}


@pytest.mark.parametrize("name", CASES)
def test_each_fault_is_named_within_two_seconds_and_no_longer(name):
    make, words = CASES[name]
    rig = Rig()
    assert rig.send(3000) == ""
    spoil = make()
    rig.send(2000, spoil)
    assert any(words in sentence for sentence in rig.told), rig.told
    # What jumped back stays there: the clock goes on from where it is.
    rig.send(round(HELD_S * 1000) + 3 * LOOK, spoil if "jump" in name else
             lambda k, name, values: [(0, values)])
    assert rig.watch.sentences(rig.now) == []


def test_stamps_that_jitter_by_half_a_period_drop_nothing():
    """At 100 Hz with 5 ms of it "messages are dropped" stood for as long as it ran."""
    rig, draw = Rig(), random.Random(3)
    rig.send(6000, lambda k, name, values: [(draw.uniform(-0.49, 0.49), values)])
    assert not [one for one in rig.told if "dropped" in one]
    rig.send(3000, lambda k, name, values: [] if draw.random() < 0.2 else [
        (draw.uniform(-0.49, 0.49), values)])
    assert [one for one in rig.told if "dropped" in one]


def test_missing_samples_are_counted():
    rig = Rig()
    rig.send(3000)
    assert rig.watch.missing == 0
    rig.send(2000, lambda k, name, values: [] if name == "x" and k % 10 == 5 else [(0, values)])
    rig.send(1000)
    assert rig.watch.missing == 200


@pytest.mark.parametrize("rate", [0.5, 1.0, 3.0])
def test_what_comes_late_is_named_whatever_the_clock_of_the_stamps(rate):
    rig = Rig(1e-3 / rate)
    assert rig.send(4000, rate=rate) == ""
    late = []

    def hold(k, name, values):
        if name != "p1":
            return [(0, values)]
        late.append((k, values))
        if len(late) < 300:
            return []
        sent, values = late.pop(0)
        return [((sent - k) / rate, values)]
    told = rig.send(2000, hold, rate=rate)
    assert re.search(r"gauge: messages come 0\.[23]\d s later after their stamp", told), told
    assert "gauge: " in told and "rows were processed without it" in told


def test_a_quantised_slow_or_resting_sensor_is_not_frozen():
    rig = Rig()
    slow = lambda k: 0.004 * math.sin(0.8 * k * 1e-3) if k < 9000 else 0.0  # noqa: E731

    def spoil(k, name, values):
        x = slow(k)
        shown = {"x": (2e-5 * round(x / 2e-5), math.nan), "x_d": (x,),
                 "p1": (1e4 * round(2e6 / 1e4 + math.copysign(1.0, math.cos(0.8 * k * 1e-3))),)}
        return [(0, shown[name])]
    rig.send(14000, spoil)
    assert not rig.told and not rig.frozen


def test_a_pause_is_no_frozen_demand():
    """At rest the position covers its own noise, and nothing more: that is no motion."""
    class Pausing(Rig):
        def values(self, k):
            moving, noise = super().values(min(k, 6000)), 2e-5 * math.sin(1e3 * k)
            return {**moving, "x": (moving["x"][0] + noise, math.nan)}

    rig = Pausing()
    rig.send(40_000)
    assert not rig.frozen and not any("x_d has not changed" in one for one in rig.told)


def test_a_frozen_channel_is_withheld_until_it_moves():
    rig = Rig()
    rig.send(3000)
    rig.send(1000, frozen("p1", 3000))
    assert rig.frozen == {"p1": 3000 * MS + 1}
    stamps = [stamp // MS for stamp, row in rig.rows if "p1" not in row]
    assert 3200 <= stamps[0] <= 3600 and stamps[-1] == 3999
    rig.send(10)
    assert all("p1" in row for stamp, row in rig.rows if stamp // MS >= 4000)


@pytest.fixture(scope="module")
def rows():
    return list(rows_of(simulated(SINE, 4.5).recording(0)))


@pytest.mark.parametrize("channel", ["p2", "x", "x_d"])
def test_what_a_frozen_channel_did_to_the_estimates_is_undone(rows, channel):
    made = Stream()
    before = made.push(rows[:2000])
    held = rows[2000][1][channel]
    made.push([(time, {**row, channel: held}) for time, row in rows[2001:2500]])
    made.live.withdraw(channel, rows[2001][0])
    at_once = made.look()
    for name, truth in (("B", 600.0), ("beta_e", BETA)):
        assert at_once.parameters[name].value == pytest.approx(
            before.parameters[name].value, rel=0.01)
        assert at_once.parameters[name].value == pytest.approx(truth, rel=0.02)
    made.push([(time, {n: v for n, v in row.items() if n != channel})
               for time, row in rows[2500:3000]])
    end = made.push(rows[3000:])
    assert end.model.status != "mismatch"
    assert end.parameters["B"].value == pytest.approx(600.0, rel=0.01)
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)


def test_a_channel_that_is_wrong_from_the_start_begins_it_anew(rows):
    made = Stream()
    made.push(rows[:100])
    made.live.withdraw("p2", 0.0)
    made.push(rows[100:400])
    made.live.withdraw("p2", rows[101][0])
    made.look()
    assert made.told("p2 has been invalid since the start")
    end = made.push(rows[400:2000])
    assert end.parameters["B"].value == pytest.approx(600.0, rel=0.01)


def test_ten_times_the_rate_is_the_same_motion():
    """Of ten rows on one place of the grid the nearest counts, wherever the others lie."""
    fine = simulated(SINE, 2.4, rig={"sample_time": 1e-4}).recording(0)
    rows = list(rows_of(fine))
    made = Stream()
    made.push(rows[:12000:10])
    made.push(rows[12000:15000])
    end = made.push(rows[15000::10])
    assert end.model.status == "consistent" and not made.told("changed")
    assert end.parameters["B"].value == pytest.approx(600.0, rel=0.01)
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)
    assert np.isfinite(end.position)


@pytest.mark.parametrize("late", [("p1", "p2"), ("x_d", "omega"), ("x",)])
def test_a_channel_may_come_back_from_a_gap_later_than_the_others(rows, late):
    """A monitor that was held up, or publishers that are started one after the other."""
    made = Stream()
    made.push(rows[:1500])
    made.push([(time + 3.0, {n: v for n, v in row.items() if k >= 300 or n not in late})
               for k, (time, row) in enumerate(rows[1500:3500])])
    end = made.history[-1]
    assert end.model.status == "consistent"
    assert end.parameters["B"].value == pytest.approx(600.0, rel=0.01)
    assert end.parameters["beta_e"].value == pytest.approx(BETA, rel=0.02)


def test_a_position_in_another_unit_is_left_out_until_it_is_back():
    rig = Rig()
    rig.send(3000)
    assert not rig.watch.sentences(rig.now)

    def in_mm(k, name, values):
        return [(0, (1e3 * values[0], math.nan) if name == "x" else values)]

    said = rig.send(4000, in_mm)
    assert "x leaps to" in said and "another unit" in said
    begun = len(rig.rows)
    rig.send(2000)
    x = np.array([(stamp, row["x"]) for stamp, row in rig.rows if "x" in row])
    assert np.abs(x[:, 1]).max() < 0.011  # no millimetre came through
    assert np.sum(x[:, 0] > 7.1e9) > 1800 and begun
    rig.send(4000)
    assert not rig.watch.sentences(rig.now)


def test_a_counter_that_was_reset_is_taken_after_a_second():
    rig = Rig()
    rig.send(2000)
    said = rig.send(3000, lambda k, name, values: [
        (0, (values[0] + 2.0, math.nan) if name == "x" else values)])
    assert "x leaps to 2" in said and "NaN" not in said
    x = np.array([(stamp, row["x"]) for stamp, row in rig.rows if "x" in row])
    assert (x[:, 1] > 1.5).sum() == pytest.approx(2000, abs=50)


def test_single_wild_values_cost_two_samples():
    chance = some(0.01)
    rig = Rig()
    rig.send(4000, lambda k, name, values: [
        (0, (values[0] + 3.0, math.nan) if name == "x" and chance() else values)])
    x = np.array([row["x"] for _, row in rig.rows if "x" in row])
    assert np.abs(x).max() < 0.011 and len(x) > 3880


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.floats(1e-4, 0.05), st.floats(-5.0, 5.0)), min_size=5, max_size=60),
       st.integers(1, 20))
def test_what_a_piston_can_do_is_never_left_out(steps, each):
    time = np.cumsum([dt for dt, _ in steps])
    x = np.cumsum([min(dt, REACH_S) * speed for dt, speed in steps])
    leaps = Leaps(20.0, 1e-4)
    for first in range(0, len(time), each):
        assert not leaps.take(time[first:first + each], x[first:first + each]).any()
