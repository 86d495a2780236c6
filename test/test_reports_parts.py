"""The parts of reports: units, envelopes, smoothing, windows, correlations, timelines."""

import numpy as np
import pytest

from eha_monitor.estimation.results import Event
from eha_monitor.health.alarms import NO_LIMIT, Alarm
from eha_monitor.reports.estimate_report import _alarm_table
from eha_monitor.reports.figure import time_scale
from eha_monitor.reports.page import alarm_timeline, interval_timeline, spans
from eha_monitor.reports.traces import (
    Smoother,
    autocorrelation,
    choose_smoother,
    envelope,
    in_gap,
    informative_window,
    reversals,
    robust_range,
    running_rms,
)


def test_time_in_the_unit_of_the_record():
    assert [time_scale(d).unit for d in (0.01, 30, 1200, 86400)] == ["ms", "s", "min", "h"]


def test_envelope_keeps_peaks_and_ends():
    values = np.random.default_rng(1).standard_normal(300_000)
    values[123_456], values[7] = 50.0, -40.0
    time = np.arange(len(values)) * 1e-3
    t, v = envelope(time, values, bins=500)
    assert len(t) <= 5 * 500 and (np.diff(t) >= 0).all()
    assert v.max() == 50.0 and v.min() == -40.0
    assert (t[0], v[0], t[-1], v[-1]) == (time[0], values[0], time[-1], values[-1])
    at = t[np.argmax(v)]
    assert abs(at - time[123_456]) < 300 / 500


@pytest.mark.parametrize("n", [1000, 100_000])
def test_envelope_leaves_gaps_open_and_joins_slow_channels(n):
    time = np.arange(n) * 1e-3
    values = np.sin(time)
    values[n // 2: n // 2 + n // 10] = np.nan
    t, v = envelope(time, values, bins=200)
    assert np.isnan(v).sum() == 1
    assert t[np.flatnonzero(np.isnan(v))[0]] == pytest.approx(time[n // 2 - 1], abs=n / 200 * 1e-3)
    slow = np.where(np.arange(n) % 20 == 0, np.sin(time), np.nan)
    assert not np.isnan(envelope(time, slow, bins=200)[1]).any()


def test_envelope_of_nothing():
    for values in (np.empty(0), np.full(5, np.nan), np.full(5, np.inf)):
        assert len(envelope(np.arange(len(values)), values)[0]) == 0


@pytest.mark.parametrize("order", [1, 2])
def test_smoothed_derivative_and_its_double(order):
    dt = 1e-3
    t = np.arange(8000) * dt
    w = 2 * np.pi * 4
    x = 3e-3 * np.sin(w * t) + 1e-6 * np.random.default_rng(2).standard_normal(len(t))
    truth = 3e-3 * (w * np.cos(w * t) if order == 1 else -w**2 * np.sin(w * t))
    smoother = choose_smoother(x, dt, order)
    error = smoother.of(x) - truth
    assert np.nanstd(error) < 0.04 * np.std(truth)
    # The known derivative, treated alike, differs from it by noise alone, without a bias.
    alike = smoother.alike(truth, x)
    assert np.nanstd(smoother.of(x) - alike) < 0.04 * np.std(truth)
    assert np.nanstd(alike - truth) < 0.02 * np.std(truth)


def test_smoothing_alike_sees_what_a_slow_channel_saw():
    t = np.arange(6000) * 1e-3
    v = np.cos(60 * t)  # nearly too fast for one sample in ten
    x = np.where(np.arange(6000) % 10 == 0, np.sin(60 * t) / 60, np.nan)
    smoother = choose_smoother(x, 1e-3, 1)
    assert smoother.window * smoother.dt >= 0.07
    assert np.nanmax(np.abs(smoother.of(x) - smoother.alike(v, x))) < 0.02


@pytest.mark.parametrize("order", [1, 2])
def test_smoothing_is_savitzky_and_golays(order):
    from scipy.signal import savgol_filter

    x = np.cumsum(np.random.default_rng(4).standard_normal(500))
    theirs = savgol_filter(x, 25, 3, deriv=order, delta=0.01, mode="constant", cval=np.nan)
    ours = Smoother(25, 0.01, order).of(x)
    assert np.allclose(ours[12:-12], theirs[12:-12], rtol=1e-9, atol=1e-7)
    x[100:200] = np.nan
    assert np.flatnonzero(np.isnan(Smoother(25, 0.01, order).of(x)))[[12, -13]].tolist() == [
        88, 211]


def test_no_smoother_without_data():
    assert choose_smoother(np.full(100, np.nan), 1e-3, 1) is None
    assert choose_smoother(np.zeros(3), 1e-3, 2) is None


def test_gaps_are_found():
    values = np.zeros(50)
    values[[10, 11]] = np.nan  # two lost samples are no gap
    values[20:30] = np.nan
    values[45:] = np.nan
    assert np.flatnonzero(in_gap(values)).tolist() == [*range(20, 30), 48, 49]
    assert in_gap(np.full(4, np.nan)).all()


def test_windows_show_what_tells():
    dt = 1e-3
    t = np.arange(24_000) * dt
    triangle = 0.04 * (1 - 4 * np.abs(np.mod(0.25 * t + 0.25, 1) - 0.5))
    assert np.allclose(reversals(triangle) * dt, np.arange(1, 24, 2), atol=2 * dt)
    start, stop, words = informative_window(triangle, dt)
    assert words == "a reversal" and start < 15_000 < stop and stop - start == 1000
    start, stop, _ = informative_window(triangle, dt, near=3.2)
    assert start < 3000 < stop
    start, stop, words = informative_window(np.sin(2 * np.pi * 4 * t), dt)
    assert words == "three periods" and stop - start == pytest.approx(750, abs=5)
    gap = triangle.copy()
    gap[14_900:15_100] = np.nan  # the favourite is not there
    start, stop, _ = informative_window(gap, dt)
    assert np.isfinite(gap[start:stop]).all()
    for n in (0, 1, 3):
        assert informative_window(np.zeros(n), dt)[1] <= n


def test_single_samples_do_not_set_the_limits():
    values = np.sin(np.arange(10_000) / 50)
    assert robust_range([values])[2] == 0.0
    values[77] = -500.0
    low, high, peak = robust_range([values])
    assert -3 < low < -1 and high == pytest.approx(1, abs=0.01) and peak == 500.0


def test_an_estimate_that_diverges_does_not_flatten_what_it_follows():
    measured = 0.1 * np.sin(np.arange(10_000) / 50)
    wild = np.linspace(0.0, 2e4, 10_000)
    low, high, peak = robust_range([measured], [wild])
    assert -0.31 < low < -0.09 and 0.09 < high < 0.31 and peak == 2e4
    assert robust_range([measured], [1.1 * measured])[2] == 0.0
    assert robust_range([np.full(9, np.nan)], [wild])[1] == 2e4


def test_autocorrelation_of_known_noise():
    rng = np.random.default_rng(3)
    e = rng.standard_normal(100_000)
    r, used = autocorrelation(e, 50)
    assert used == 100_000 and np.abs(r).max() < 5 / np.sqrt(used)
    moving = e[1:] + 0.5 * e[:-1]  # r1 = 0.5/1.25
    moving[::7] = np.nan
    r, _ = autocorrelation(moving, 5)
    assert r[0] == pytest.approx(0.4, abs=0.02) and np.abs(r[1:]).max() < 0.02
    assert len(autocorrelation(np.full(9, np.nan), 5)[0]) == 0


def test_running_rms_leaves_gaps():
    values = np.r_[np.ones(500), np.full(500, np.nan), 2 * np.ones(500)]
    _, rms = running_rms(values, 15)
    assert rms[0] == 1 and rms[-1] == 2 and np.isnan(rms[7])


def test_spans_follow_the_changes():
    history = (Alarm("a", "OK", "", 1.0), Alarm("a", "WARN", "", 4.0),
               Alarm("a", "ERROR", "", 6.0), Alarm("b", "OK", "", 0.0))
    found = spans("a", (Alarm("a", "ERROR", "", 6.0),), history, 10.0)
    assert [(s.start, s.stop, s.level) for s in found] == [
        (1.0, 4.0, "OK"), (4.0, 6.0, "WARN"), (6.0, 10.0, "ERROR")]
    late = spans("a", (Alarm("a", "STALE", "", 99.0),), (), 10.0)
    assert [(s.start, s.level) for s in late] == [(10.0, "STALE")]


def test_what_is_not_judged_is_a_lane_of_its_own_and_never_green():
    held = Alarm("viscous_damping_high", "WARN", "not judged: ...", 0.0, not_judged=True)
    silent = Alarm("bulk_modulus_low", "STALE", "not judged: ...", 0.0, not_judged=True)
    timeline = alarm_timeline((held, silent), (held, silent), (), 10.0)
    assert {bar.level for _, bars in timeline.lanes for bar in bars} == {"not judged"}
    raised = Alarm("viscous_damping_high", "WARN", "", 5.0)
    bars = alarm_timeline((raised,), (held, raised), (), 10.0).lanes[0][1]
    assert [bar.level for bar in bars] == ["not judged", "WARN"]


def test_without_a_limit_there_is_no_level_and_no_green_lane():
    without = Alarm("bulk_modulus_high", "OK", NO_LIMIT, 0.0)
    fine = Alarm("bulk_modulus_low", "OK", "above", 0.0)
    assert [name for name, _ in alarm_timeline((without, fine), (), (), 10.0).lanes] == ["βe low"]
    assert alarm_timeline((without,), (without,), (), 10.0).note
    level = _alarm_table((without, fine), "alarms").rows
    assert [row[1].badge for row in level] == ["", "OK"]


def test_timeline_in_percent_with_marks_that_do_not_overlap():
    alarms = (Alarm("viscous_damping_high", "WARN", "", 5.0),)
    history = (Alarm("viscous_damping_high", "OK", "", 0.0), *alarms)
    events = tuple(Event(time, "one", "") for time in (0.0, 0.1, 0.2, 8.0))
    timeline = alarm_timeline(alarms, history, events, 10.0)
    (name, bars), = timeline.lanes
    assert name == "B high"
    assert [(bar.left, bar.width, bar.level) for bar in bars] == [(0, 50, "OK"), (50, 50, "WARN")]
    assert [(mark.left, mark.label) for mark in timeline.marks] == [(0, "1–3"), (80, "4")]
    assert all(0 <= tick.left <= 100.01 for tick in timeline.ticks)
    assert [mark.label for mark in timeline.ticks] == ["0", "2", "4", "6", "8", "10"]
    assert interval_timeline("worst", ((2.0, 3.0),), 10.0).lanes[0][1][0].left == 20
    assert interval_timeline("worst", ((float("nan"), 3.0),), 10.0) is None
    assert alarm_timeline((), (), (), 10.0).note
    assert alarm_timeline(alarms, history, (), 0.0).note


@pytest.mark.parametrize("slope", [-1.0, 0.0, 1.0])
def test_the_name_of_a_limit_hides_no_value(slope):
    """Values that rise to a limit, fall from it, or lie along it: there is always room beside."""
    from eha_monitor.reports import figure
    from eha_monitor.reports.estimate_figures import add_limits

    along = np.linspace(0.0, 1.0, 12)
    value = 930.0 + slope * 300.0 * (along - 0.5)
    panel = figure.Panel(figure.Side("t", limits=(0.0, 1.0)), figure.Side(
        "B", limits=(300.0, 1500.0)))
    add_limits(panel, value, [(1000.0, "WARN above"), (1480.0, "ERROR above")], "N·s/m", along)
    (name,) = [one for one in panel.shown if isinstance(one, figure.Text) and "1000" in one.words]
    wide, high = 0.5, 0.07 * 1200.0
    there = (along < wide if name.across == "left" else along > 1.0 - wide) & (
        (value > name.y) & (value < name.y + high) if name.up == "bottom" else
        (value < name.y) & (value > name.y - high))
    assert not there.any()


def test_numbers_of_a_filter_that_has_diverged_are_written_in_silence():
    import base64
    import warnings

    from eha_monitor.reports.plotly_chart import numbers

    values = np.array([1.0, 1e200, -1e200])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = numbers(values)
    assert np.frombuffer(base64.b64decode(found["bdata"]), found["dtype"]).tolist() == list(values)
