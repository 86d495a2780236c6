"""Events, acknowledgements, the long history, CSV and metrics, without a browser and ROS."""

import csv
import io
import math
import time
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eha_monitor.dashboard import charts, words
from eha_monitor.dashboard.detail import who_is
from eha_monitor.dashboard.events import ACKNOWLEDGED, QUALITY, Change, EventLog
from eha_monitor.dashboard.exports import estimates_csv
from eha_monitor.dashboard.state import HEALTH_STALE_AFTER, History, Span, State, thinned
from eha_monitor.health.judge import Finding
from eha_monitor.settings import Settings

HIGH = "viscous_damping_high"


class Rig:
    """A state whose time goes on by itself, with what a monitor would say."""

    def __init__(self):
        self.now, self.wall = 100.0, 1.7e9
        self.log = EventLog()
        self.state = State(Settings(), lambda: self.wall + self.now, self.log)

    def hears(self, level, name=HIGH, seconds=1.0, **data):
        self.now += seconds
        self.state.take_findings("eha", [
            Finding(name, level, f"{name} is {level}"), Finding("data", "OK", "data come", data)],
            self.now)
        return self.state.view(self.now)

    def told(self, kind):
        return [event.text for event in reversed(self.log.latest()) if event.kind == kind]


@pytest.fixture
def rig():
    return Rig()


def test_an_alarm_asks_until_it_is_acknowledged_and_again_when_it_comes_back(rig):
    assert not words.waiting(rig.hears("OK"))
    assert rig.state.acknowledge([HIGH], "Ada") == []  # nothing is raised
    assert words.waiting(rig.hears("WARN")) == [HIGH]
    assert rig.state.acknowledge(ACKNOWLEDGED, "Ada") == [HIGH]
    assert rig.state.acknowledge([HIGH], "Bob") == []  # Ada was first
    view = rig.hears("WARN")
    assert words.quiet(view) and words.overall(view)[0] == "WARN"
    assert words.acknowledged_text(view, HIGH).startswith("acknowledged by Ada, ")
    assert words.quiet(rig.hears("WARN"))
    view = rig.hears("STALE")  # nothing is known: that is no clearing
    assert HIGH in view.acknowledged and words.quiet(rig.hears("WARN"))
    assert words.waiting(rig.hears("ERROR")) == [HIGH]  # it got worse
    assert rig.state.acknowledge([HIGH], "Bob") == [HIGH]
    assert words.quiet(rig.hears("WARN"))  # and better
    assert not words.waiting(rig.hears("OK"))
    assert words.waiting(rig.hears("WARN")) == [HIGH]
    assert rig.told("acknowledged") == [
        "Viscous damping high: WARN acknowledged by Ada",
        "Viscous damping high: ERROR acknowledged by Bob"]


def test_an_acknowledgement_outlives_the_dashboard_and_no_other_alarm_takes_it(tmp_path):
    file = tmp_path / "bags" / "eha_acknowledged.json"

    def begun():
        rig = Rig()
        rig.state = State(Settings(), lambda: rig.wall + rig.now, rig.log, file)
        return rig

    def hears(rig, level, since):
        rig.state.take_findings("eha", [Finding(HIGH, level, "", {"since_s": since})], rig.now)
        return rig.state.view(rig.now)

    first = begun()
    hears(first, "WARN", "12.5")
    assert first.state.acknowledge([HIGH], "Ada") == [HIGH]
    again = begun()
    assert not hears(again, "STALE", "0").acknowledged  # nothing is known: that is no clearing
    assert words.acknowledged_text(hears(again, "WARN", "12.5"), HIGH).startswith(
        "acknowledged by Ada, ")
    assert words.waiting(hears(begun(), "WARN", "80.1")) == [HIGH]  # it was OK in between
    assert words.waiting(hears(begun(), "WARN", "12.5")) == [HIGH]  # and that is kept too
    again.state.acknowledge([HIGH], "Bob")
    assert not hears(again, "OK", "90.0").acknowledged
    assert words.waiting(hears(begun(), "WARN", "12.5")) == [HIGH]

    file.write_text("[]")
    broken = begun()  # it says so, and goes on
    assert broken.told("acknowledged") == [
        f"{file}: expected the acknowledgements that a dashboard wrote"]
    file.unlink()
    file.parent.rmdir()
    file.parent.write_text("no folder")
    hears(broken, "WARN", "1.0")
    assert broken.state.acknowledge([HIGH], "Ada") == [HIGH]
    assert "cannot make the folder" in broken.told("acknowledged")[-1]


def test_what_is_not_judged_is_nothing_to_acknowledge(rig):
    rig.state.take_findings("eha", [Finding(HIGH, "WARN", "held", {"not_judged": "1"})], rig.now)
    assert rig.state.acknowledge([HIGH, "data", "no such"], "Ada") == []


def test_the_log_has_transitions_resets_mismatch_bags_and_silence(rig):
    for level in ("STALE", "OK", "OK", "WARN", "ERROR", "ERROR", "OK"):
        rig.hears(level)
    assert rig.told("alarm") == [
        "Viscous damping high: OK → WARN; viscous_damping_high is WARN",
        "Viscous damping high: WARN → ERROR; viscous_damping_high is ERROR",
        "Viscous damping high: ERROR → OK; viscous_damping_high is OK"]
    rig.hears("OK", "model_mismatch")
    rig.hears("WARN", "model_mismatch")
    assert rig.told("model") == ["Model mismatch: OK → WARN; model_mismatch is WARN"]
    rig.hears("OK", last_bag="/tmp/a")
    rig.hears("OK", last_bag="/tmp/a")
    assert rig.told("bag") == ["bag saved: /tmp/a"]
    # A bag in a loop: the same event at the same time of the data, and one more jump.
    for jumps, seconds in (("0", 9.0), ("1", 0.3), ("1", 9.0), ("2", 0.5)):
        rig.hears("OK", seconds=seconds, jumped_stamps=jumps, last_bag="/tmp/a",
                  last_event_s="9.5", last_event="estimates reset: the clock jumped back")
    assert rig.told("reset") == ["estimates reset: the clock jumped back"] * 2
    rig.state.watch(rig.now + 1.0)
    assert not rig.told("monitor")
    for seconds in (1.0, 2.0, 3.0):
        rig.state.watch(rig.now + HEALTH_STALE_AFTER + seconds)
    rig.hears("OK")
    assert rig.told("monitor") == ["the monitor is not heard for 3 s",
                                   "the monitor is heard again"]


def test_a_diagnosis_is_an_event_and_a_card(rig):
    def tells(number, event, *effects, **values):
        rig.state.take_diagnosis([
            Finding("diagnosis", "WARN", "friction", {
                "event": event, "event_number": number, "event_level": "OK", "state": "idle"}
                | values), Finding("model_in_force", "OK", "the config's model"), *effects])
        return words.diagnosis_lines(rig.state.view(rig.now))

    assert not words.diagnosis_lines(rig.state.view(rig.now))
    tells("3", "of before the page was there")
    assert tells("4", "diagnosis begun by service", state="a diagnosis is under way") == [
        "• The config's model", "• A diagnosis is under way"]
    found = Finding("effect coulomb_friction", "WARN", "40 N", {"probability": "0.999"})
    assert tells("5", "adopted", found, report="why.html") == [
        "• The config's model", "• 40 N (>99 %)", "• Report: why.html"]
    found = Finding("changed F_c", "WARN", "since 2023-11-14T22:13:20+00:00",
                    {"since_utc": "2023-11-14T22:13:20+00:00"})
    assert tells("5", "adopted", found)[1] == f"• Since {words.clock_text(1.7e9)}"
    tells("5", "adopted", found)
    assert rig.told("diagnosis") == ["diagnosis begun by service", "adopted"]


def test_warnings_about_samples_can_be_left_out_and_stops_cannot(rig):
    for level in ("OK", "WARN", "OK", "STALE", "OK"):
        rig.state.take_findings("eha", [Finding("data", level, level)], rig.now)
    shown = [event.level for event in rig.log.latest(without=QUALITY)]
    assert shown == ["OK", "STALE", "OK"] and len(rig.log.latest()) == 5


def test_the_log_is_bounded_and_its_csv_holds_what_it_is_given():
    log = EventLog()
    nasty = 'a "quoted", text\nof two lines; ±'
    for k in range(6000):
        log.add(1.7e9 + k, "left", Change("alarm", "WARN", nasty if k == 5999 else "=1+1"))
    rows = list(csv.reader(io.StringIO(log.csv().removeprefix("\ufeff"))))
    assert len(rows) == 5001 and rows[-1][4] == nasty and rows[-2][4] == "'=1+1"
    assert rows[-1][:4] == ["2023-11-14T23:53:19.000+00:00", "left", "alarm", "WARN"]


@given(st.lists(st.floats(0.01, 200.0), min_size=1, max_size=400))
def test_a_long_history_keeps_extremes_order_and_bounds(steps):
    history = History(100.0, 0.5, 2.0, long_span=2000.0, stretch=60.0)
    now, all_rows = 0.0, []
    for k, step in enumerate(steps):
        now += step
        all_rows.append((now, math.sin(37.0 * k)))
        history.add(*all_rows[-1])
    rows = [row for row in history.rows() if math.isfinite(row[1])]
    assert len(history._dense) <= 201 and sum(map(len, history._old)) <= 70
    assert all(a[0] < b[0] for a, b in pairwise(rows)) and set(rows) <= set(all_rows)
    kept_since = history._old[0][0][0]
    dense_since = history._dense[0][0]
    if kept_since < dense_since:
        before = [row[1] for row in all_rows if kept_since <= row[0] < dense_since // 60 * 60]
        if before:
            assert {min(before), max(before)} <= {row[1] for row in rows}


def test_thinning_keeps_a_spike_and_every_gap():
    rows = [(0.5 * k, 100.0 if k == 1234 else math.sin(0.01 * k)) for k in range(5000)]
    rows.insert(3000, (1499.8, math.nan))
    few = thinned(rows, 400)
    assert len(few) <= 410 and max(row[1] for row in few if row[1] == row[1]) == 100.0
    assert sum(math.isnan(row[1]) for row in few) == 1
    assert [row[0] for row in few] == sorted(row[0] for row in few)
    assert thinned(rows[:300], 400) == rows[:300]


def test_a_clock_that_is_set_moves_the_history_and_clears_nothing(rig):
    for _ in range(20):
        rig.now += 1.0
        rig.state.take_value("B", 600.0, rig.now)
        rig.state.take_stddev("B", 2.0, rig.now)
    before = rig.state.history("B", rig.now)
    rig.wall += 0.01  # steered: nothing moves
    assert rig.state.history("B", rig.now) == before
    rig.wall -= 3600.0
    after = rig.state.history("B", rig.now)
    assert len(after) == 20
    assert after[0][0] == pytest.approx(before[0][0] - 3600.0, abs=0.02)


def test_csv_of_what_is_shown(rig):
    for k in range(10):
        rig.now += 1.0
        rig.state.take_value("B", 600.0 + k, rig.now)
        rig.state.take_stddev("B", 2.0, rig.now)
        rig.state.take_value("beta_e", 6e8, rig.now + 0.002)
        rig.state.take_stddev("beta_e", 5e6, rig.now + 0.002)
    today = rig.wall + rig.now
    text = estimates_csv(rig.state, rig.now, today - 4.5, today - 0.5)
    rows = list(csv.DictReader(io.StringIO(text.removeprefix("\ufeff"))))
    assert [float(row["viscous_damping [N·s/m]"]) for row in rows] == [605, 606, 607, 608]
    assert {row["bulk_modulus [Pa]"] for row in rows} == {"600000000"}
    assert {row["bulk_modulus_in_doubt"] for row in rows} == {"0"}
    assert float(rows[0]["time_s"]) == pytest.approx(today - 4.0, abs=0.002)
    assert estimates_csv(rig.state, rig.now, today + 5.0).count("\n") == 1  # nothing: the header


def test_metrics_are_read_by_prometheus_own_parser(rig):
    pytest.importorskip("prometheus_client")
    from prometheus_client.parser import text_string_to_metric_families

    from eha_monitor.dashboard.exports import metrics

    def scraped():
        families = text_string_to_metric_families(metrics({"left": rig.state}).decode())
        return {(s.name.removeprefix("eha_monitor_"), *sorted(
            v for k, v in s.labels.items() if k != "actuator")): s.value
            for family in families for s in family.samples}

    found = scraped()  # nothing has come yet
    assert found["up",] == 0 and found["data_age_seconds", "health"] == math.inf
    assert found["alarm_level", HIGH] == 3
    assert "viscous_damping_newton_seconds_per_meter" not in {key[0] for key in found}
    now = time.monotonic()
    rig.state.take_value("B", 612.5, now)
    rig.state.take_stddev("B", 2.5, now)
    rig.state.take_findings("eha", [
        Finding(HIGH, "ERROR", ""), Finding("bulk_modulus_low", "WARN", "", {"not_judged": "1"}),
        Finding("stage_one", "OK", "", {"status": "converged"})], now)
    rig.state.acknowledge([HIGH], "Ada")
    found = scraped()
    assert found["viscous_damping_newton_seconds_per_meter",] == 612.5
    assert found["viscous_damping_stddev_newton_seconds_per_meter",] == 2.5
    assert (found["alarm_level", HIGH], found["alarm_acknowledged", HIGH]) == (2, 1)
    assert (found["alarm_level", "bulk_modulus_low"],
            found["alarm_not_judged", "bulk_modulus_low"]) == (3, 1)
    assert found["estimate_status", "converged", "viscous_damping"] == 1
    assert found["estimate_status", "bulk_modulus", "no_data"] == 1
    assert found["up",] == 1 and 0 <= found["data_age_seconds", "health"] < 5.0


def test_the_header_says_when_the_last_data_came(rig):
    view = rig.state.view(rig.now)
    assert words.last_data(view, rig.wall + rig.now) == (False, "no data yet")
    rig.state.take_position("measured", rig.wall + rig.now, 0.01, rig.now)
    live, text = words.last_data(rig.state.view(rig.now), rig.wall + rig.now)
    assert live and text.startswith("last data ") and "ago" not in text and "stamped" not in text
    live, text = words.last_data(rig.state.view(rig.now + 90.0), rig.wall + rig.now + 90.0)
    assert not live and "(1 min 30 s ago)" in text
    rig.state.take_position("measured", 1000.0, 0.01, rig.now)
    assert "stamped 1970-01-01" in words.last_data(rig.state.view(rig.now), rig.wall + rig.now)[1]


def test_a_chosen_time():
    span = Span()
    assert span.since(1000.0) == 700.0 and span.query("left") == "actuator=left&last=300"
    assert not span.drag(10.0, 10.2) and not span.drag(math.nan, 5.0) and span.zoom is None
    assert span.drag(10.0, 20.0) and span.since(1e6) == 10.0
    assert span.query("a b") == "actuator=a+b&since=10.000&until=20.000"
    span.choose("all")
    assert span.zoom is None and span.since(1000.0) == -math.inf
    assert charts.ends_of(math.inf, 100.0, None) == (70.0, 100.0)
    assert charts.ends_of(0.0, 1000.0, 300.0) == (700.0, 1000.0)
    assert charts.ends_of(0.0, 1000.0, None) == (0.0, 1000.0)


def test_who_acknowledges_is_kept_short_and_on_one_line():
    assert who_is("Ada\n  Lovelace", "::1") == "Ada Lovelace"
    assert who_is("x" * 500, "10.0.0.7") == "x" * 40 + " (10.0.0.7)"
