"""What the dashboard keeps and says, without a browser and without ROS."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eha_monitor.dashboard import charts, words
from eha_monitor.dashboard.state import ESTIMATES_EVERY, History, State, alarms
from eha_monitor.health.alarms import NO_LIMIT
from eha_monitor.health.judge import Finding
from eha_monitor.quantity import Scale
from eha_monitor.settings import Settings, settings_from_tree

TOPICS = {"measured": "/eha/joint_states", "estimates": "/eha/monitor/viscous_damping",
          "health": "/eha/monitor/health"}


class Clock:
    """A time of day that a test sets."""

    def __init__(self):
        self.now = 1.7e9

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def state(clock):
    return State(Settings(), clock)


@given(st.lists(st.floats(0.0, 5.0), max_size=300))
def test_history_is_bounded_thinned_and_in_order(steps):
    history, now = History(span=10.0, every=0.5, gap=2.0), 0.0
    for step in steps:
        now += step
        history.add(now, now)
    rows = history.rows(now - 10.0)
    times = [row[0] for row in rows if math.isfinite(row[1])]
    assert len(history._dense) <= 21 and len(rows) <= 2 * len(times)
    assert times == sorted(times) and all(now - 10.0 <= t <= now for t in times)
    assert len({t // 0.5 for t in times}) == len(times)
    gaps = sum(b - a > 2.0 for a, b in pairwise(times))
    assert sum(math.isnan(row[1]) for row in rows) == gaps


def test_history_starts_anew_when_time_jumps_back():
    history = History(span=10.0, every=0.5, gap=2.0)
    for time_s in (100.0, 101.0, 5.0, 6.0):
        history.add(time_s, 1.0)
    assert [row[0] for row in history.rows()] == [5.0, 6.0]


def test_a_day_of_estimates_does_not_grow(state, clock):
    for k in range(5000):
        clock.now += 0.1
        state.take_value("B", 600.0, 0.1 * k)
        state.take_stddev("B", 2.0, 0.1 * k)
    rows = state.history("B", 500.0)
    assert len(rows) == pytest.approx(500.0 / ESTIMATES_EVERY, rel=0.05)
    assert state.view(500.0).value["B"] == 600.0


def test_an_estimate_that_came_before_its_own_measurement_is_paired(state):
    state.take_position("measured", 0.019, 0.001, 0.0)
    state.take_position("estimated", 0.020, 0.0079, 0.1)
    assert not state.view(0.1).same_stamp
    state.take_position("measured", 0.020, 0.008, 0.2)  # batches of them are taken by a timer
    view = state.view(0.2)
    assert view.same_stamp and (view.measured, view.estimated) == (0.008, 0.0079)


def test_positions_are_compared_at_the_same_stamp(state):
    for k in range(100):
        state.take_position("measured", 1e-3 * k, 1e-4 * k, 0.0)
    state.take_position("estimated", 0.0801, 0.0079, 0.0)
    view = state.view(0.0)
    assert view.same_stamp and (view.measured, view.estimated) == (pytest.approx(0.008), 0.0079)
    assert words.position_texts(view, Scale(1e3, "mm"))[2] == "difference +100.0 µm"
    state.take_position("measured", 5.0, 0.03, 2.0)  # the estimate has stopped
    view = state.view(2.0)
    assert not view.same_stamp and view.measured == 0.03


def test_limits_are_the_monitors_once_it_is_heard(state):
    def limits(symbol):
        return [one[:4] for one in state.limits(symbol)]

    assert limits("beta_e") == [("low", "WARN", 4e8, 4e8), ("low", "ERROR", 1.5e8, 1.5e8)]
    heard = Finding("bulk_modulus_low", "OK", "", {"limit_warn": "5e+08", "limit_error": ""})
    state.take_findings("rig_7", [heard], 0.0)
    assert limits("beta_e") == [("low", "WARN", 5e8, 5e8)]
    # Judged at the reference temperature, B is 5/4 of what it is in this oil.
    heard = Finding("viscous_damping_high", "OK", "",
                    {"limit_warn": "900", "at_reference": "1.25"})
    state.take_findings("rig_7", [heard], 0.0)
    high = [one for one in state.limits("B") if one.side == "high" and one.degree == "WARN"]
    assert [one[2:4] for one in high] == [(900.0, 720.0)]
    (mark,) = charts.estimate_data([], high, Scale(1.0, "N·s/m"), (0.0, 1.0))["series"][-1][
        "markLine"]["data"]
    assert mark["yAxis"] == 720.0 and mark["label"]["formatter"] == "WARN 900 at 40 °C"
    assert state.view(0.0).hardware == "rig_7"


def test_alarms_that_are_no_longer_heard_are_stale(state):
    assert {alarm.level for alarm in alarms(state.view(0.0))} == {"STALE"}
    state.take_findings("eha", [Finding("bulk_modulus_low", "ERROR", "too soft")], 10.0)
    by_name = {alarm.name: alarm for alarm in alarms(state.view(12.0))}
    assert by_name["bulk_modulus_low"].level == "ERROR"
    assert words.worst(list(by_name.values())) == "ERROR"
    by_name = {alarm.name: alarm for alarm in alarms(state.view(14.0))}
    assert by_name["bulk_modulus_low"].level == "STALE"
    assert by_name["bulk_modulus_low"].message == "last received ERROR: too soft"


def heard(state, data, **levels):
    """The header while the data are ``data``; alarms that are left out are OK."""
    names = [alarm.name for alarm in alarms(state.view(0.0))]
    state.take_findings("eha", [Finding(name, levels.get(name, "OK"), "") for name in (
        *names, "model_mismatch")] + [Finding("data", data, "")], 0.0)
    return words.overall(state.view(1.0))


def test_the_header_is_stale_only_where_no_data_come(state):
    assert words.overall(state.view(0.0)) == ("STALE", "◌ STALE")
    assert heard(state, "OK") == ("OK", "✓ OK")
    # x_d is not recorded: nothing is known of βe, and B is well.
    without = dict.fromkeys(("bulk_modulus_high", "bulk_modulus_low"), "STALE")
    assert heard(state, "OK", **without) == ("OK", "✓ OK, 2 of 4 not judged")
    assert heard(state, "WARN", viscous_damping_high="ERROR", **without)[0] == "ERROR"
    assert heard(state, "OK", model_mismatch="WARN", **without)[0] == "WARN"
    assert heard(state, "OK", model_mismatch="STALE") == ("OK", "✓ OK")
    nothing = dict.fromkeys((alarm.name for alarm in alarms(state.view(0.0))), "STALE")
    assert heard(state, "OK", **nothing) == ("STALE", "◌ not judged yet")
    assert heard(state, "STALE", viscous_damping_high="ERROR") == ("STALE", "◌ STALE")
    heard(state, "OK")
    assert words.overall(state.view(60.0)) == ("STALE", "◌ STALE")  # the monitor is not heard


def test_an_actuator_without_limits_is_not_ok(state):
    def header(model, **messages):
        names = [alarm.name for alarm in alarms(state.view(0.0))]
        state.take_findings("eha", [
            *(Finding(name, "OK", messages.get(name, NO_LIMIT)) for name in names),
            Finding("model_mismatch", model, ""), Finding("data", "OK", "")], 0.0)
        return words.overall(state.view(1.0))

    assert header("OK") == ("STALE", "◌ no limits set")
    assert header("WARN")[0] == "WARN"
    assert header("OK", bulk_modulus_low="above its limit") == ("OK", "✓ OK")


def test_the_footer_says_in_words_how_the_data_come(state):
    state.take_findings("eha", [Finding("data", "OK", "data come", {
        "rows": "123456", "rate_joint_states_Hz": "999.871", "lost_messages": "0",
        "latency_p50_ms": "12.3456", "cpu_share_percent": "", "jumped_stamps": "3"})], 0.0)
    assert words.data_text(state.view(0.0)) == (
        "data: data come; 123456 rows so far, 1000 messages a second on joint_states, "
        "0 messages lost, half of the rows done within 12.3 ms")


def test_what_is_not_judged_has_a_word_and_a_sign_of_its_own(state):
    held = Finding("viscous_damping_high", "WARN", "not judged: ...", {"not_judged": "1"})
    fine = Finding("bulk_modulus_low", "OK", "", {"not_judged": "0"})
    state.take_findings("eha", [held, fine], 10.0)
    by_name = {alarm.name: alarm for alarm in alarms(state.view(10.0))}
    assert (held.word, fine.word) == ("not judged", "OK") and not held.raised
    assert words.level_text(by_name["viscous_damping_high"].word) == "? not judged"
    assert words.worst([held, fine]) == "not judged"
    by_name = {alarm.name: alarm for alarm in alarms(state.view(14.0))}
    assert by_name["viscous_damping_high"].word == "STALE"


def test_silence_says_which_topic_and_since_when(state):
    settings = state.settings
    assert words.silence_text(state.view(0.0), settings, TOPICS).startswith("No data yet on /eha")
    for now in (10.0, 10.5):
        state.take_value("B", 600.0, now)
        state.take_position("measured", now, 0.01, now)
        state.take_findings("eha", [], now)
    assert words.silence_text(state.view(11.0), settings, TOPICS) == ""
    told = words.silence_text(state.view(12.5), settings, TOPICS)
    assert "(2 s): nothing on /eha/joint_states, /eha/monitor/viscous_damping" in told
    assert "health" not in told
    assert words.silence_text(state.view(14.0), settings, TOPICS).endswith(
        "/eha/monitor/health; nothing is received from the monitor")


@pytest.mark.parametrize(("value", "stddev", "scale", "shown"), [
    (600.123, 2.34, Scale(1.0, "N·s/m"), ("600.1", "± 2.3", "N·s/m")),
    (5.9876e8, 1.2e6, Scale(1e-6, "MPa"), ("598.8", "± 1.2", "MPa")),
    (math.nan, math.nan, Scale(1e-6, "MPa"), ("–", "", "MPa")),
    (600.0, math.nan, Scale(1.0, "N·s/m"), ("600", "± not known", "N·s/m")),
])
def test_numbers_as_people_write_them(value, stddev, scale, shown):
    found = words.shown(value, stddev, scale)
    assert (found.value, found.stddev, found.unit) == shown


def test_the_band_is_the_number_beside_it():
    for stddev, band in ((5e6, 5.0), (3e4, 0.18)):  # MPa; the number reads 600.0 ± 0.2
        chart = charts.estimate_data([(0.0, 6e8, stddev, 0.0)], [], Scale(1e-6, "MPa"), (0.0, 1.0))
        lower, width, value = (series["data"][0][1] for series in chart["series"][:3])
        assert (value - lower, width) == (pytest.approx(band), pytest.approx(2 * band))


@pytest.mark.parametrize("said, doubted", [
    ({}, False), ({"in_doubt": "1"}, True), ({"in_doubt": "1", "by_least_squares": "1"}, False)])
def test_what_is_in_doubt_is_drawn_apart_and_stretches_no_axis(state, said, doubted):
    """3100 of a stage beside 1440 by least squares had been one unbroken line through a limit."""
    values = {key: value for key, value in said.items() if key != "by_least_squares"}
    alarm = {key: value for key, value in said.items() if key == "by_least_squares"}
    for k, value in enumerate((1440.0, 3100.0)):
        found = [Finding("stage_one", "WARN", "", values if k else {}),
                 Finding("viscous_damping_high", "OK", "", alarm if k else {})]
        state.take_findings("eha", found, float(k))
        state.take_value("B", value, float(k))
        state.take_stddev("B", 5.0, float(k))
    rows = state.history("B", 2.0)
    assert [row[3] for row in rows] == [0.0, float(doubted)]
    drawn = charts.estimate_data(rows, [], Scale(1.0, "N·s/m"), (0.0, 2.0))
    lines = {one["id"]: [y for _, y in one["data"]] for one in drawn["series"] if "data" in one}
    assert lines["value"] == [1440.0, None if doubted else 3100.0]
    assert lines["doubted"] == [None, 3100.0 if doubted else None]
    assert (drawn["yAxis"]["max"] < 3000.0) == doubted


def test_units_follow_the_rig():
    rotary = words.scales(settings_from_tree({"rig": {"motion": "rotary"}}, "test"))
    assert rotary["B"].unit == "N·m·s/rad"
    assert words.scales(Settings())["beta_e"] == Scale(1e-6, "MPa")


@given(st.lists(st.floats(-1e12, 1e12) | st.just(math.nan), max_size=50),
       st.lists(st.floats(0.0, 1e10), max_size=4))
def test_an_axis_holds_the_limits_and_the_last_value(values, limits):
    low, high = charts.value_range(values, limits)
    assert low < high
    finite = [value for value in values if math.isfinite(value)]
    for inside in (*limits, *finite[-1:]):
        assert low <= inside <= high


def test_the_scale_of_the_drawing_is_round_and_holds_the_motion():
    for largest in (1e-6, 0.0011, 0.04, 0.05, 3.3):
        half = charts.half_range([0.0, -largest])
        assert largest <= half < 12.0 * max(largest, 1e-3)
        assert abs(charts.place(-largest, half)) <= 150.0
    assert "−50 mm" in charts.drawing(0.05, "m")


def test_a_change_of_the_machine_is_in_the_header(state):
    fine = [Finding("bulk_modulus_low", "OK", ""), Finding("data", "OK", "data come")]
    state.take_findings("eha", [*fine, Finding("machine", "OK", "nothing has changed")], 0.0)
    assert words.overall(state.view(0.0))[0] == "OK"
    state.take_findings("eha", [*fine, Finding("machine", "WARN", "a leak has grown")], 0.0)
    assert words.overall(state.view(0.0))[0] == "WARN"
    state.take_findings("eha", [*fine, Finding("indicator leakage", "ERROR", "beyond")], 0.0)
    assert words.overall(state.view(0.0))[0] == "ERROR"
